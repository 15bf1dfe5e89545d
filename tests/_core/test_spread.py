"""Numbers spread over points: values, and derivatives, which are those of broadcasting each by itself."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from zoomjax._core.spread import spread

SHAPES = [(1, 1), (3, 1), (1, 7), (3, 7)]


def by_spread(numbers, points):
    a, b, c, d = spread(numbers, points.shape)
    return jnp.sum(jnp.sin(a * points + b) * jnp.exp(c * points) * d)


def by_broadcasting(numbers, points):
    return by_spread([jnp.broadcast_to(number, points.shape) for number in numbers], points)


@pytest.fixture
def data(rng):
    return [jnp.asarray(rng.normal(size=shape)) for shape in SHAPES], jnp.asarray(rng.normal(size=(3, 7)))


def close(found, expected):
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    "derivative",
    [
        lambda f: f,
        jax.grad,
        lambda f: jax.grad(f, 1),
        jax.hessian,
        lambda f: jax.jacrev(jax.jacfwd(f)),
        lambda f: jax.jacrev(jax.jacrev(f)),
        lambda f: jax.grad(jax.checkpoint(f)),
    ],
    ids=["value", "grad", "grad by points", "hessian", "reverse of forward", "reverse twice", "checkpoint"],
)
@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit], ids=["eager", "jit"])
def test_derivatives_are_those_of_broadcasting(derivative, wrap, data):
    close(wrap(derivative(by_spread))(*data), wrap(derivative(by_broadcasting))(*data))


@pytest.mark.parametrize("batched", [(0, 0), (0, None), (None, 0), ([0, None, None, 0], None)])
def test_batches(batched, data):
    numbers, points = data
    axes = batched[0] if isinstance(batched[0], list) else [batched[0]] * 4
    many = [x if axis is None else jnp.stack([x, 2 * x]) for x, axis in zip(numbers, axes, strict=True)]
    places = points if batched[1] is None else jnp.stack([points, points + 1])

    def mapped(function):
        return jax.vmap(jax.grad(function), batched)(many, places)

    close(mapped(by_spread), mapped(by_broadcasting))
    total = [
        jax.grad(lambda x, f=f: jnp.sum(jax.vmap(f, batched)(x, places)))(many)
        for f in (by_spread, by_broadcasting)
    ]
    close(*total)


def test_only_what_is_differentiated_is_summed(data):
    numbers, points = data

    def of_one(function):
        return jax.grad(lambda x: function([numbers[0], x, *numbers[2:]], points))(numbers[1])

    close(of_one(by_spread), of_one(by_broadcasting))


def test_all_sums_are_one_pass_over_the_points(rng):
    points = jnp.asarray(rng.normal(size=100_000))
    numbers = [jnp.ones(1), jnp.ones(1), jnp.zeros(1), jnp.ones(1)]
    program = jax.jit(jax.grad(by_spread)).lower(numbers, points).as_text()
    assert program.count("stablehlo.reduce(") == 2  # of blocks, and of their sums


@pytest.mark.parametrize("number", [1000, 1024, 1025, 300_000])
def test_sums_keep_their_digits(number, rng):
    terms = (1 + rng.uniform(size=number)).astype(np.float32)

    def product(x):
        return jnp.sum(spread([x], terms.shape)[0] * terms)

    total = jax.jit(jax.grad(product))(jnp.ones(1, np.float32))
    assert total[0] == pytest.approx(math.fsum(terms), rel=4e-6)


@pytest.mark.parametrize("shape", [(0,), (3, 0), (0, 3)])
def test_no_points_have_gradients_of_zero(shape):
    one = jnp.ones((1,) * len(shape))
    gradient = jax.grad(lambda x: jnp.sum(spread([x, x], shape)[0]))(one)
    np.testing.assert_array_equal(gradient, 0 * one)


def test_numpy_stays_numpy():
    [array] = spread([np.ones(1)], (4,))
    assert isinstance(array, np.ndarray)
    assert array.shape == (4,)
