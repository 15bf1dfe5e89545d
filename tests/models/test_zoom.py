import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.interpolate

import zoomjax as zj

MODELS = {
    "constant": zj.PolynomialZoom(degree=0),
    "linear": zj.PolynomialZoom(degree=1),
    "quadratic": zj.PolynomialZoom(),
    "cubic": zj.PolynomialZoom(degree=3),
    "table": zj.models.TableZoom(),
    "short table in f": zj.models.TableZoom(number=3, inverse=False),
    "table of one": zj.models.TableZoom(number=1),
    "spline": zj.models.SplineZoom(),
    "spline of four knots": zj.models.SplineZoom(number=4),
    "power law": zj.models.PowerZoom(),
    "two regions": zj.models.TwoRegionZoom(jnp.asarray(30.0)),
}
LINEAR = {name: model for name, model in MODELS.items() if isinstance(model, zj.models.AbstractLinearZoom)}
FOCAL = np.array([18.0, 21.0, 24.0, 35.0, 70.0, 200.0])
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


KEYED = {
    **LINEAR,
    "smooth": zj.models.SmoothZoom(),
    "of a lens": zj.models.SmoothZoom.for_lens(16.0, 200.0, crop=1.0),
}


@pytest.mark.parametrize("model", KEYED.values(), ids=KEYED)
def test_settings_of_one_key_prepare_one_model(model):
    """And those of different models have different keys."""
    prepared = {}
    for left in itertools.product([True, False], repeat=len(FOCAL)):
        focal = np.append(FOCAL, FOCAL[3])[[*left, left[3]]]  # one of them twice
        try:
            own = jax.tree.leaves(model.prepare(focal, 2))
        except ValueError as error:
            own = [str(error)]
        first = prepared.setdefault(model.prepared_by(focal), own)
        assert len(first) == len(own)
        for one, other in zip(first, own, strict=True):
            np.testing.assert_array_equal(one, other)
    assert len(prepared) > 1


@pytest.mark.parametrize(
    "model", [v for v in KEYED.values() if v.elementwise], ids=lambda v: type(v).__name__
)
def test_an_elementwise_basis_is_numpys_of_numpy_arrays(model):
    prepared = model.prepare(jnp.asarray(FOCAL), 2)
    values = jax.tree.map(np.asarray, prepared).basis(FOCAL)
    assert isinstance(values, np.ndarray)
    np.testing.assert_allclose(
        values, jax.vmap(prepared.basis)(jnp.asarray(FOCAL)).T, rtol=1e-14, atol=1e-14
    )


@every_linear_model
def test_linear_in_the_parameters(model):
    first, second = with_random_parameters(model, 1), with_random_parameters(model, 2)
    both = eqx.tree_at(lambda zoom: zoom.parameters, first, first.parameters - 2 * second.parameters)
    f = jnp.asarray(27.0)
    close(both(f), first(f) - 2 * second(f))


@every_model
def test_focal_lengths_that_do_not_determine_a_model_raise(model):
    for least in range(1, len(FOCAL) + 1):
        try:
            prepared = model.prepare(jnp.asarray(np.repeat(FOCAL[:least], 2)), 1)
        except ValueError as error:
            assert "distinct focal lengths, but there are" in str(error)  # noqa: PT017
            continue
        if isinstance(model, zj.models.AbstractLinearZoom):
            basis = jax.vmap(prepared.basis)(jnp.asarray(FOCAL[:least]))
            assert np.linalg.matrix_rank(basis) == basis.shape[1]
    assert prepared is not None


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
    with pytest.raises(ValueError, match=r"must have shape \(3, terms\), but its shape is \(2, 2\)"):
        zj.PolynomialZoom(2, jnp.zeros((2, 2)), jnp.asarray(18.0))


# Tables and splines


def test_a_table_is_linear_interpolation():
    zoom = with_random_parameters(zj.models.TableZoom())
    for f in (10.0, 18.0, 20.0, 30.0, 100.0, 300.0):
        expected = [np.interp(1 / f, zoom.knots, column) for column in zoom.parameters.T]
        close(zoom(jnp.asarray(f)), expected)


def test_a_table_in_f_has_its_entries_spread_over_the_focal_lengths():
    zoom = with_random_parameters(zj.models.TableZoom(number=3, inverse=False))
    np.testing.assert_array_equal(zoom.knots, FOCAL[[0, 2, 5]])
    close(zoom(jnp.asarray(100.0)), [np.interp(100, zoom.knots, column) for column in zoom.parameters.T])


@pytest.mark.parametrize("number", [None, 2, 3])
def test_a_spline_is_the_natural_one_of_scipy(number):
    zoom = with_random_parameters(zj.models.SplineZoom(number))
    spline = scipy.interpolate.CubicSpline(zoom.knots, zoom.parameters, bc_type="natural")
    for f in (18.0, 19.0, 28.0, 60.0, 200.0):
        np.testing.assert_allclose(zoom(jnp.asarray(f)), spline(1 / f), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_spline_whose_curvature_is_of_other_knots_is_refused(dtype):
    zoom = with_random_parameters(zj.models.SplineZoom())
    own = jnp.asarray(zoom.curvature, dtype)
    zj.models.SplineZoom(None, zoom.parameters, jnp.asarray(zoom.knots, dtype), own)
    moved = jnp.asarray(zoom.knots, dtype).at[2].multiply(1.02)
    with pytest.raises(ValueError, match="curvature must be that of the natural spline through its knots"):
        zj.models.SplineZoom(None, zoom.parameters, moved, own)
    with pytest.raises(ValueError, match="curvature must be that of the natural spline through its knots"):
        zj.models.SplineZoom(None, zoom.parameters, zoom.knots, own.at[1, 1].multiply(-1))


def test_a_spline_goes_on_straight_beyond_its_ends():
    zoom = with_random_parameters(zj.models.SplineZoom())
    inside, end, outside = (np.asarray(zoom(jnp.asarray(1 / (1 / 18 + d)))) for d in (-1e-7, 0.0, 0.01))
    np.testing.assert_allclose((outside - end) / 0.01, (end - inside) / 1e-7, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    "model", [zj.models.TableZoom(), zj.models.SplineZoom(), zj.models.PowerZoom()], ids=str
)
def test_models_are_differentiable_in_the_focal_length(model):
    zoom = with_random_parameters(model)
    slope = jax.jacfwd(zoom)(jnp.asarray(28.0))
    difference = (zoom(jnp.asarray(28.001)) - zoom(jnp.asarray(27.999))) / 0.002
    np.testing.assert_allclose(slope, difference, rtol=1e-6, atol=1e-9)


# The paper's other rivals


def test_two_regions_are_two_quadratics():
    zoom = with_random_parameters(zj.models.TwoRegionZoom(30.0))
    for f, rows in ((24.0, slice(0, 3)), (70.0, slice(3, 6))):
        u = 18.0 / f
        close(zoom(jnp.asarray(f)), np.array([1, u, u * u]) @ np.asarray(zoom.parameters)[rows])


def test_the_crossover_is_where_k1_is_zero():
    inverse = 1 / FOCAL
    crossover = zj.models.barrel_crossover(FOCAL[::-1], (3 * (inverse - 1 / 30.0))[::-1])
    assert crossover == pytest.approx(30.0)
    with pytest.raises(ValueError, match="one sign throughout"):
        zj.models.barrel_crossover(FOCAL, inverse)


@pytest.mark.parametrize(
    ("k1", "crossover"),
    [([-0.1, 0.0, 0.1], 40.0), ([0.0, -0.1, 0.1], 160 / 3), ([-1e-200, 1e-200, 0.1], 80 / 3)],
)
def test_a_crossover_beside_zeros_and_tiny_coefficients(k1, crossover):
    found = zj.models.barrel_crossover(np.array([20.0, 40.0, 80.0]), np.array(k1))
    assert found == pytest.approx(crossover, rel=1e-12)


def test_frames_without_a_fit_are_no_crossover():
    k1 = np.array([-0.1, np.nan, -0.05, 0.05])
    found = zj.models.barrel_crossover(np.array([20.0, 25.0, 40.0, 80.0]), k1)
    assert found == pytest.approx(160 / 3, rel=1e-12)


@pytest.mark.parametrize(
    ("focal", "k1", "name"),
    [
        ([20.0, 40.0, 80.0], [0.3, -0.1, 0.1, 0.2], "k1"),
        ([20.0, 40.0, 80.0], [[-0.1], [0.1], [0.2]], "k1"),
        ([20.0, 40.0, 80.0], [-0.1, np.inf, 0.1], "k1"),
        ([20.0, 40.0, 80.0], np.ma.masked_array([-0.1, 0.1, 0.2], [0, 1, 0]), "k1"),
        ([-20.0, -40.0, -80.0], [-0.1, 0.1, 0.1], "focal"),
        ([0.0, 40.0, 80.0], [-0.1, 0.1, 0.1], "focal"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_a_crossover_of_what_are_not_frames_is_refused(focal, k1, name):
    with pytest.raises(ValueError, match=f"Argument {name} must"):
        zj.models.barrel_crossover(np.array(focal), k1)


def test_zeros_are_no_crossover():
    with pytest.raises(ValueError, match="one sign"):
        zj.models.barrel_crossover(np.array([20.0, 40.0, 80.0]), np.array([0.0, 0.1, 0.1]))


def test_two_regions_without_a_crossover_say_where_to_get_it():
    with pytest.raises(ValueError, match="barrel_crossover"):
        zj.models.TwoRegionZoom().prepare(FOCAL, 1)


@every_model
@pytest.mark.usefixtures("unchecked")
def test_a_model_takes_one_focal_length_and_says_so(model):
    """Of two it gave k1 at the one and k2 at the other."""
    zoom = with_random_parameters(model)
    each = [np.asarray(zoom(f)) for f in (20.0, 40.0)]
    np.testing.assert_allclose(jax.vmap(zoom)(jnp.array([20.0, 40.0])), each, rtol=1e-12)
    for several in (np.array([20.0, 40.0]), jnp.array([20.0, 40.0]), [20.0, 40.0], np.array([20.0])):
        with pytest.raises(ValueError, match=r"must be one focal length; jax.vmap"):
            zoom(several)
    for none in (-3.0, 0.0, np.nan, jnp.array(-3.0)):
        with pytest.raises(ValueError, match="focal must be finite and positive"):
            zoom(none)
    for absurd in (5e-324, 1e-300, 1e300):
        with pytest.raises(ValueError, match=r"focal must be from 1e-30 to 1e\+30 mm or px"):
            zoom(absurd)


@pytest.mark.usefixtures("unchecked")
def test_whole_numbers_are_numbers():
    zoom = zj.PolynomialZoom.from_inverse_focal([[0], [2]], 20)
    np.testing.assert_allclose(zoom.parameters, [[0], [0.1]])
    with pytest.raises(ValueError, match=r"coefficients must have shape \(basis, terms\)"):
        zj.PolynomialZoom.from_inverse_focal([0.0, 0.1], 20.0)
