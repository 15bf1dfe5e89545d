"""Run as two processes by `test_sharding`: each has some of the lines, under ``jax.distributed``."""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_cpu_collectives_implementation", "gloo")
jax.config.update("jax_numpy_rank_promotion", "raise")


def part(lines: zj.Lines, some: slice) -> zj.Lines:
    """Some of the lines, of the same frames."""
    own = {name: np.asarray(getattr(lines, name))[some] for name in ("points", "mask", "frame")}
    return dataclasses.replace(lines, **own, number=None)


def main(rank: int, number: int, address: str) -> None:
    jax.distributed.initialize(address, num_processes=number, process_id=rank)
    assert (jax.process_count(), len(jax.devices())) == (2, 4)
    from ._sharded import FRAMES, K, scene

    lines = scene()
    whole = part(lines, slice(0, 37))
    spread = zj.lines.shard(part(lines, slice(0, 15) if rank == 0 else slice(15, 37)))  # unlike many
    assert spread.points.shape == (44, 320, 2)
    assert not spread.points.is_fully_addressable
    small = zj.compress(spread)
    expected = zj.compress(whole)
    one = zj.fit_zoom(expected, zoom=zj.PolynomialZoom(1))
    for measured in (spread, small):
        for function in (zj.fit.frame_energy, zj.fit.global_energy):
            np.testing.assert_allclose(np.asarray(function(measured, K)), function(whole, K), rtol=1e-12)
        fit = zj.fit_zoom(measured, zoom=zj.PolynomialZoom(1))
        for found, wanted in (
            (fit.lens.zoom.parameters, one.lens.zoom.parameters),
            (fit.frame_rms, one.frame_rms),
        ):
            np.testing.assert_allclose(np.asarray(found), wanted, rtol=1e-12, atol=1e-12)
        # The noise by line is of the scatter of scores, whose order of sums is another one.
        np.testing.assert_allclose(np.asarray(fit.covariance), one.covariance, rtol=1e-9)
    again = zj.lines.shard(zj.compress(part(lines, slice(0, 15) if rank == 0 else slice(15, 37))))
    np.testing.assert_allclose(
        float(zj.fit.global_energy(again, K)), zj.fit.global_energy(whole, K), rtol=1e-12
    )
    other = dataclasses.replace(whole, focal=jnp.asarray(whole.focal) * (1 + rank))
    with pytest.raises(ValueError, match="must have the same focal lengths"):
        zj.lines.shard(other)
    print("as in one process", FRAMES)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3])
