import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj

MODELS = {
    "constant": zj.PolynomialZoom(degree=0),
    "linear": zj.PolynomialZoom(degree=1),
    "quadratic": zj.PolynomialZoom(),
    "cubic": zj.PolynomialZoom(degree=3),
}
LINEAR = {name: model for name, model in MODELS.items() if isinstance(model, zj.AbstractLinearZoom)}
FOCAL = np.array([18.0, 24.0, 35.0, 70.0, 200.0])
TERMS = (1, 2, 3)

every_model = pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
every_linear_model = pytest.mark.parametrize("model", LINEAR.values(), ids=LINEAR)


def with_random_parameters(model, seed=0, terms=2):
    """The prepared model with parameters of the size that lenses have."""
    rng = np.random.default_rng(seed)
    prepared = model.prepare(jnp.asarray(FOCAL), terms)
    random = jax.tree.map(
        lambda leaf: jnp.asarray(0.1 * rng.standard_normal(leaf.shape)), prepared.parameters
    )
    return eqx.tree_at(lambda zoom: zoom.parameters, prepared, random)


def close(actual, expected):
    np.testing.assert_allclose(actual, expected, rtol=1e-14, atol=1e-15)


@every_model
@pytest.mark.parametrize("terms", TERMS)
def test_prepared_models_give_zero_coefficients(model, terms):
    prepared = model.prepare(jnp.asarray(FOCAL), terms)
    for f in jnp.asarray(FOCAL):
        np.testing.assert_array_equal(prepared(f), np.zeros(terms))


@every_model
def test_coefficients_have_the_dtype_of_the_focal_lengths(model):
    prepared = model.prepare(jnp.asarray(FOCAL, jnp.float32), 2)
    assert prepared(jnp.float32(30)).dtype == jnp.float32


@every_model
def test_model_that_was_only_specified_raises(model):
    with pytest.raises(ValueError, match="not fitted"):
        model(jnp.asarray(35.0))


@every_model
def test_jit_and_eager_agree(model):
    zoom = with_random_parameters(model)
    with jax.disable_jit():
        eager = zoom(jnp.asarray(35.0))
    close(eqx.filter_jit(zoom)(jnp.asarray(35.0)), eager)


@every_model
def test_vmap_and_loop_agree(model):
    zoom = with_random_parameters(model)
    close(jax.vmap(zoom)(jnp.asarray(FOCAL)), np.stack([zoom(jnp.asarray(f)) for f in FOCAL]))


@every_model
def test_file_keeps_every_digit(model, tmp_path):
    zoom = with_random_parameters(model)
    lens = zj.ZoomLens(zoom, jnp.array([319.5, 239.5]), jnp.array([18.0, 200.0]), (640, 480))
    lens.save(tmp_path / "lens.json")
    loaded = zj.load_lens(tmp_path / "lens.json")
    assert type(loaded.zoom) is type(zoom)
    for f in jnp.asarray(FOCAL):
        np.testing.assert_array_equal(loaded(f).coefficients, lens(f).coefficients)


@every_linear_model
def test_coefficients_are_the_basis_times_the_parameters(model):
    zoom = with_random_parameters(model)
    close(zoom(jnp.asarray(35.0)), zoom.basis(jnp.asarray(35.0)) @ zoom.parameters)


@every_linear_model
def test_linear_in_the_parameters(model):
    first, second = with_random_parameters(model, 1), with_random_parameters(model, 2)
    both = eqx.tree_at(lambda zoom: zoom.parameters, first, first.parameters - 2 * second.parameters)
    f = jnp.asarray(27.0)
    close(both(f), first(f) - 2 * second(f))


@every_linear_model
def test_too_few_distinct_focal_lengths_raise(model):
    unknowns = with_random_parameters(model).parameters.shape[0]
    enough = np.repeat(FOCAL[:unknowns], 2)
    assert model.prepare(jnp.asarray(enough), 1) is not None
    if unknowns > 1:
        too_few = np.repeat(FOCAL[: unknowns - 1], 2)
        with pytest.raises(ValueError, match=f"there are {unknowns - 1}"):
            model.prepare(jnp.asarray(too_few), 1)


def test_polynomial_is_equation_9():
    zoom = with_random_parameters(zj.PolynomialZoom(degree=2))
    a = zoom.in_inverse_focal()
    for f in jnp.asarray(FOCAL):
        close(zoom(f), a[0] + a[1] / f + a[2] / f**2)


def test_polynomial_is_about_the_shortest_focal_length():
    assert zj.PolynomialZoom().prepare(jnp.asarray(FOCAL[::-1]), 2).focal_ref == FOCAL.min()


def test_polynomials_in_one_over_f_come_back():
    coefficients = np.array([[0.02, -0.01], [-3.0, 0.2], [40.0, -1.0]])
    zoom = zj.PolynomialZoom.from_inverse_focal(coefficients, 18.0)
    assert zoom.degree == 2
    np.testing.assert_allclose(zoom.in_inverse_focal(), coefficients, rtol=1e-14)


@pytest.mark.parametrize("degree", [-1, True])
def test_degree_that_is_none_raises(degree):
    with pytest.raises(ValueError, match="degree must be an integer of at least 0"):
        zj.PolynomialZoom(degree=degree)


def test_parameters_of_another_degree_raise():
    with pytest.raises(ValueError, match="3 rows for degree 2"):
        zj.PolynomialZoom(2, jnp.zeros((2, 2)), jnp.asarray(18.0))
