"""Exported functions: symbolic shapes, no calls without a guarantee, and the same numbers elsewhere."""

import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

import zoomjax as zj

from . import _embeddings as table

DISTORTION_MODELS = {
    "RadialPolynomial": ((0.1, -0.02), zj.models.RadialPolynomial()),
    "three terms": ((0.1, -0.02, 0.01), zj.models.RadialPolynomial()),
    "Division": ((-0.1,), zj.models.Division()),
    "BrownConrady": ((0.1, 0.01, -0.02), zj.models.BrownConrady()),
}

READ_BACK = """
import sys
import jax
import numpy as np
jax.config.update("jax_enable_x64", True)
from jax import export
assert "zoomjax" not in sys.modules
given = np.load(sys.argv[2])
with open(sys.argv[1], "rb") as file:
    function = export.deserialize(bytearray(file.read()))
np.savez(sys.argv[3], *jax.tree.leaves(function.call(*given.values())))
"""


def exported(function, *specs):
    return export.export(jax.jit(function))(*specs)


def elsewhere(function, folder, *arrays):
    """The exported function's results in another process."""
    pytest.importorskip("flatbuffers", reason="jax.export needs it to serialise")
    (folder / "function").write_bytes(function.serialize())
    np.savez(folder / "given.npz", *arrays)
    paths = [str(folder / name) for name in ("function", "given.npz", "results.npz")]
    subprocess.run([sys.executable, "-c", READ_BACK, *paths], check=True)
    with np.load(folder / "results.npz") as results:
        return list(results.values())


@pytest.mark.parametrize("method", ["undistort", "distort"])
@pytest.mark.parametrize("name", DISTORTION_MODELS)
def test_any_number_of_points(name, method):
    k, distortion_model = DISTORTION_MODELS[name]
    d = table.distortion(distortion_model, k)
    [n] = export.symbolic_shape("n")
    spec = jax.ShapeDtypeStruct((n, 2), jnp.float64)
    function = exported(lambda points: getattr(d, method)(points), spec)
    for number in (1, 3):
        points = table.points()[:number]
        np.testing.assert_allclose(function.call(points), getattr(d, method)(points), rtol=1e-13)


@pytest.mark.parametrize("method", ["undistort", "distort"])
def test_a_focal_length_for_each_point_in_another_process(method, tmp_path):
    lens = table.lens()
    [n] = export.symbolic_shape("n")
    points = jax.ShapeDtypeStruct((n, 2), jnp.float64)
    focal = jax.ShapeDtypeStruct((n,), jnp.float64)
    function = exported(lambda points, f: getattr(lens, method)(points, f), points, focal)
    [result] = elsewhere(function, tmp_path, table.points(), table.EACH)
    np.testing.assert_allclose(result, getattr(lens, method)(table.points(), table.EACH), rtol=1e-13)


@pytest.mark.parametrize("method", ["undistort", "distort"])
def test_a_lens_by_its_leaves_in_another_process(method, tmp_path):
    """Another lens than that of the export, read where there is no zoomjax; the lens itself is refused."""
    lens = table.lens()
    leaves, structure = jax.tree.flatten(lens)
    [n] = export.symbolic_shape("n")
    points = jax.ShapeDtypeStruct((n, 2), jnp.float64)
    specs = [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves]
    function = exported(
        lambda points, *leaves: getattr(structure.unflatten(leaves)(35.0), method)(points), points, *specs
    )
    other = eqx.tree_at(lambda lens: lens.centre, lens, lens.centre + 1)
    [result] = elsewhere(function, tmp_path, table.points(), *jax.tree.leaves(other))
    np.testing.assert_allclose(result, getattr(other(35.0), method)(table.points()), rtol=1e-12)
    whole = exported(lambda lens, points: getattr(lens(35.0), method)(points), lens, points)
    with pytest.raises(ValueError, match="Cannot serialize"):
        whole.serialize()


def test_images_of_any_size_in_another_process(tmp_path, unchecked):
    # Unchecked, as symbolic sides are no int.
    d = table.small_distortion()
    spec = jax.ShapeDtypeStruct(export.symbolic_shape("h, w, c"), jnp.float64)
    function = exported(lambda image: zj.warp_image(image, d), spec)
    image = jnp.stack([table.image(), 1 - table.image()], axis=-1)
    [result] = elsewhere(function, tmp_path, image)
    np.testing.assert_allclose(result, zj.warp_image(image, d), rtol=0, atol=1e-13)


@pytest.mark.slow
def test_fit_without_calls_that_have_no_guarantee(tmp_path):
    small = zj.compress(table.lines(), 1)

    def fit(triangle, focal):
        lines = eqx.tree_at(lambda lines: (lines.triangle, lines.focal), small, (triangle, focal))
        found = zj.fit_zoom(lines, zoom=zj.PolynomialZoom(1), terms=1, throw=False)
        return found.lens.zoom.parameters, found.rms, found.covariance

    given = small.triangle, small.focal
    function = exported(fit, *given)  # refuses calls without a guarantee
    for got, expected in zip(
        elsewhere(function, tmp_path, *given), jax.tree.leaves(fit(*given)), strict=True
    ):
        np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-12)
