"""The reduction on a GPU: the kernel is interpreted here, and lowered for CUDA."""

import importlib
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.lines import kernel


def reduced(points, mask, centre, terms=2):
    return kernel.triangles(points, mask, centre, 400.0, terms)


def data(rng, points=300, dtype=np.float64):
    """Lines that are noisy, straight, through the centre, short and empty."""
    t = np.linspace(-180, 250, points)
    ends = np.stack([t, 0.3 * t], axis=1), np.stack([t, 0 * t], axis=1), np.stack([0 * t + 90, t], axis=1)
    noisy = ends[0] + rng.normal(size=ends[0].shape)
    lines = np.array([320, 240]) + np.stack([noisy, *ends, ends[0], ends[1]])
    mask = rng.uniform(size=lines.shape[:2]) < 0.9
    mask[-2, 5:] = False
    mask[-1] = False
    return jnp.asarray(lines, dtype), jnp.asarray(mask), jnp.asarray([320.0, 240.0], dtype)


def by_compress(points, mask, centre, terms=2):
    lines = zj.Lines(points, mask, jnp.zeros(len(points), int), np.ones(1), centre, (640, 480))
    return zj.compress(lines, terms).triangle * 1.0


def products(triangles):
    """``R^T R`` over the norms of the columns, with which rounding is compared."""
    r = np.asarray(triangles, float)
    size = np.linalg.norm(r, axis=1) + 1e-300
    return np.einsum("lij,lik->ljk", r, r) / size[:, :, None] / size[:, None]


def independent(triangles):
    """What each column has that those before do not, of its norm."""
    r = np.asarray(triangles, float)
    return np.diagonal(r, axis1=1, axis2=2) / (np.linalg.norm(r, axis=1) + 1e-300)


@pytest.mark.parametrize("terms", [1, 2, 3])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_triangles_are_those_of_compress(terms, dtype, rng):
    arrays = data(rng, dtype=dtype)
    one, other = reduced(*arrays, terms), by_compress(*arrays, terms)
    assert one.dtype == other.dtype == dtype
    np.testing.assert_allclose(products(one), products(other), atol=40 * np.finfo(dtype).eps)
    np.testing.assert_allclose(independent(one), independent(other), atol=40 * np.finfo(dtype).eps)


@pytest.mark.parametrize("points", [1, 256, 257, 256 * 36 + 1])
def test_runs_of_any_number_merge(points, rng):
    """The last number takes three rounds: 37 triangles become two, and these one."""
    arrays = data(rng, max(points, 6))
    arrays = (arrays[0][:1, :points], arrays[1][:1, :points], arrays[2])
    np.testing.assert_allclose(products(reduced(*arrays)), products(by_compress(*arrays)), atol=1e-14)


def test_what_is_masked_does_not_count(rng):
    points, mask, centre = data(rng)
    wild = jnp.where(mask[..., None], points, jnp.nan)
    np.testing.assert_array_equal(reduced(wild, mask, centre), reduced(points, mask, centre))


def test_derivatives_by_points_and_centre(rng):
    points, mask, centre = data(rng)
    moves = jnp.asarray(rng.normal(size=points.shape)), jnp.asarray(rng.normal(size=2))

    def of(triangles):
        """A sum that fits could take: a function of ``R^T R``."""

        def total(points, centre):
            r = triangles(points, mask, centre)
            return jnp.sum(jnp.einsum("lij,lik->ljk", r, r)[:4, 1:, 1:] ** 2)

        return jax.jvp(total, (points, centre), moves)[1]

    scaled = by_compress(points, mask, centre), reduced(points, mask, centre)
    np.testing.assert_allclose(products(scaled[0]), products(scaled[1]), atol=1e-14)
    np.testing.assert_allclose(of(reduced), of(by_compress), rtol=1e-11)


def test_it_maps_and_has_gradients_and_second_derivatives(rng):
    points, mask, centre = data(rng, 40)
    many = jnp.stack([points, points[::-1]]), jnp.stack([mask, mask[::-1]])
    both = jax.vmap(lambda points, mask: reduced(points, mask, centre))(*many)
    np.testing.assert_allclose(both[1], both[0, ::-1], atol=1e-13)

    def scatter(triangles):
        def total(centre):
            r = triangles(points[:1], mask[:1], centre)[0, 1:, 1:]
            return jnp.sum(jnp.matmul(r.T, r))

        return jax.grad(total)(centre), jax.hessian(total)(centre)

    for one, other in zip(scatter(reduced), scatter(by_compress), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9)


@pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated:DeprecationWarning")
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_it_compiles_for_cuda_as_far_as_that_needs_no_gpu(dtype, rng, monkeypatch):
    arrays = data(rng, dtype=dtype)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    try:
        lowered = jax.jit(reduced).trace(*arrays).lower(lowering_platforms=("cuda",)).as_text()
    except RuntimeError as error:  # JAX 0.12 asks the GPU itself
        pytest.skip(str(error))
    assert lowered.count("triton") >= 2  # points, then rows


def test_only_devices_that_triton_supports_have_it(monkeypatch):
    assert not kernel.has_kernel(2)
    for capability, has in (("7.5", False), ("8.0", True), ("9.0", True), ("gfx942", False)):
        device = SimpleNamespace(compute_capability=capability)
        monkeypatch.setattr(jax, "devices", lambda device=device: [device])
        assert kernel.has_kernel(2) is has
        assert not kernel.has_kernel(4)


def test_there_is_none_where_jax_has_no_triton(monkeypatch):
    """JAX 0.12 says that it will go."""
    monkeypatch.setattr(jax, "devices", lambda: [SimpleNamespace(compute_capability="9.0")])
    assert kernel.has_kernel(2)
    name = "jax.experimental.pallas.triton"
    monkeypatch.delattr(sys.modules[name.rpartition(".")[0]], "triton", raising=False)
    monkeypatch.setitem(sys.modules, name, None)
    try:
        assert not importlib.reload(kernel).has_kernel(2)
    finally:
        monkeypatch.undo()
        importlib.reload(kernel)
