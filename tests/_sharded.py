"""Run in a process of its own by `test_compression`: lines spread over four devices of the CPU."""

import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import zoomjax as zj
from zoomjax import scenes
from zoomjax.fit._least_squares import default_solver
from zoomjax.fit.minimise import fit_prepared
from zoomjax.fit.prepare import ready_model
from zoomjax.lines.compressed import _columns, _reduce_shards, _sharding_of_lines
from zoomjax.lines.free_centre import _monomials
from zoomjax.models.model import Model

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

FRAMES = 4
K = jnp.asarray(0.1 * np.random.default_rng(1).standard_normal((FRAMES, 2)))


def scene() -> zj.Lines:
    """320 points a line, a size that is not padded on one device either."""
    rng = np.random.default_rng(0)
    x = np.linspace(9, 600, 320)
    points = [np.stack([x, y + rng.standard_normal(320)], axis=-1) for y in np.linspace(5, 470, 40)]
    return zj.Lines.from_ragged(
        points, np.arange(40) % FRAMES, [24.0, 35.0, 50.0, 70.0], image_size=(640, 480)
    )


def gram(triangles) -> np.ndarray:
    """``R^T R`` of each line, whose points are 320."""
    triangles = np.asarray(triangles)
    return np.einsum("lij,lik->ljk", triangles, triangles) / 320


def exchanged(compiled) -> dict[str, int]:
    """How many numbers each kind of collective of a compiled program exchanges."""
    found: dict[str, int] = {}
    pattern = r"= (\([^)]*\)|\S+) (all-\w+|collective-\w+|reduce-scatter)(?:-start)?\("
    for shapes, kind in re.findall(pattern, compiled.compiled.as_text()):
        number = 0
        for shape in re.findall(r"\w+\[([\d,]*)\]", shapes):  # several arrays may go at once
            number += int(np.prod([int(side) for side in shape.split(",") if side], initial=1))
        found[kind] = max(found.get(kind, 0), number)
    return found


def check_fits(lines: zj.Lines, plain: zj.lines.CompressedLines) -> None:
    """Fits of points and of triangles that stay where they are: the lens of one device."""
    one = zj.fit_zoom(plain, zoom=zj.PolynomialZoom(1))
    whole = zj.lines.shard(lines)
    for data in (whole, zj.compress(whole)):
        fit = zj.fit_zoom(data, zoom=zj.PolynomialZoom(1))
        np.testing.assert_allclose(
            fit.lens.zoom.parameters, one.lens.zoom.parameters, rtol=1e-12, atol=1e-12
        )
        model = ready_model(data, Model(one.lens.zoom, 2, data.distortion_model))
        program = eqx.filter_jit(fit_prepared).lower(data, model, default_solver(data), 256).compile()
        found = exchanged(program)
        assert set(found) == {"all-reduce"}, found
        assert found["all-reduce"] <= 400, found  # sums of parameters and frames, of 12,800 points


def check_device(plain: zj.lines.CompressedLines) -> None:
    """All of a fit is where the lines are, its covariance too, which is NumPy's on the usual device."""
    last = jax.devices()[-1]
    fit = zj.fit_zoom(jax.device_put(plain, last), zoom=zj.PolynomialZoom(1))
    assert fit.covariance.devices() == fit.rms.devices() == {last}


def main() -> None:
    assert len(jax.devices()) == 4
    lines = scene()
    over = NamedSharding(Mesh(np.array(jax.devices()), ("line",)), PartitionSpec("line"))
    over_points = NamedSharding(over.mesh, PartitionSpec("line"))
    every = tuple(jax.device_put(getattr(lines, name), over) for name in ("points", "mask", "frame"))
    layouts = {
        "points alone": eqx.tree_at(lambda data: data.points, lines, every[0]),
        "all": eqx.tree_at(lambda data: (data.points, data.mask, data.frame), lines, every),
    }
    plain = zj.compress(lines)
    any_centre = zj.lines.compress_any_centre(lines)
    for data in layouts.values():
        small = zj.compress(data)
        assert small.triangle.sharding.is_equivalent_to(over, 3)
        np.testing.assert_allclose(small.triangle, plain.triangle, rtol=1e-11, atol=1e-12)
        of_any = zj.lines.compress_any_centre(data).triangle
        assert of_any.sharding.is_equivalent_to(over, 3)
        # One device leaves few points to LAPACK, whose R has other digits, and the same R^T R.
        np.testing.assert_allclose(gram(of_any), gram(any_centre.triangle), rtol=0, atol=1e-12)

        sharding = _sharding_of_lines(data)
        for columns in (_columns, _monomials):
            program = _reduce_shards.lower(
                data.points, jax.device_put(data.mask, over), data.centre, data.scale, columns, 2, sharding
            ).compile()
            assert exchanged(program) == {}, exchanged(program)

        for measured in (data, small):
            for function in (zj.fit.frame_energy, zj.fit.global_energy):
                np.testing.assert_allclose(function(measured, K), function(lines, K), rtol=1e-12)
                sums = exchanged(eqx.filter_jit(function).lower(measured, K).compile())
                assert set(sums) == {"all-reduce"}, sums
                assert sums["all-reduce"] <= 2 * FRAMES, sums  # of each frame an error and a weight
    check_fits(lines, plain)
    check_device(plain)
    distortion = scenes.nikkor_18_200()(35.0)
    points = jnp.asarray(np.random.default_rng(2).uniform(0, 400, (5000, 2)))

    def total(distortion, points):
        return jnp.sum(distortion.undistort(points) ** 2)

    for number in (5000, 4000):  # not, and a multiple of devices times anything
        gradient = eqx.filter_jit(eqx.filter_grad(total))
        spread = jax.device_put(points[:number], over_points)
        found = gradient(distortion, spread).coefficients
        expected = gradient(distortion, points[:number]).coefficients
        np.testing.assert_allclose(found, expected, rtol=1e-12)
        sums = exchanged(gradient.lower(distortion, spread).compile())
        assert max(sums.values()) <= 8 * len(jax.devices()), sums
    spread, plain = jax.device_put(points[:4000], over_points), distortion.distort(points[:4000])
    local = jax.shard_map(
        lambda points: distortion.distort(points),
        mesh=over.mesh,
        in_specs=PartitionSpec("line"),
        out_specs=PartitionSpec("line"),
    )
    # That Newton's steps arrived everywhere is one flag; on each device by itself it is none.
    for function, expected in ((lambda p: distortion.distort(p), {"all-reduce": 1}), (local, {})):
        program = eqx.filter_jit(function)
        found = exchanged(program.lower(spread).compile())
        assert found == expected, found
        np.testing.assert_allclose(program(spread), plain, rtol=1e-12)
    found = exchanged(eqx.filter_jit(lambda p: distortion.undistort(p)).lower(spread).compile())
    assert found == {}, found
    print("as on one device")


if __name__ == "__main__":
    main()
