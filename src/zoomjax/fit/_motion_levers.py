"""Levers of tracks: how far the entrance pupil is before the axis of rotation, over each point's distance.

Where a parallax is seen (`_motion_parallax`), each track has a lever beside its ray, with a normal prior
of mean 0 whose variance the tracks tell.

What all levers have in common looks like a lens, so that the fit takes it for one. Distances are positive,
and it is likely a few times as large as the levers' standard deviation: the covariance has that in it.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ._motion_model import Model
from ._schur import Reduced, Unknowns, reduced, solution
from ._structure import Structure

COMMON = 3.0
"""What levers have in common, in standard deviations of them: that of points from 40 to 120 m away."""


class Common(NamedTuple):
    """By how much estimates are off if what levers have in common is as large as its standard deviation."""

    log_focal: Float[Array, "frame"]
    lens: Float[Array, "lens"]


def told_levers(model: Model, matrix: Reduced, units: Unknowns) -> Float[Array, ""] | int:
    """How many levers the tracks tell: of each, the share that is not the prior's; 0 without levers."""
    if model.levers is None:
        return 0
    variance = matrix.rays[0][:, 2, 2] * units.rays[:, 2] ** 2
    return jnp.sum(1 - jnp.minimum(variance / model.levers.std**2, 1))


def common_lever(model: Model, jacobian: Any, units: Unknowns, structure: Structure) -> Common:
    """What the covariance lacks, as the fit takes what levers have in common for a lens; 0 without levers.

    Args:
        model: the fitted one.
        jacobian: of the rows by the unknowns.
        units: of the unknowns.
        structure: which track and frame each view belongs to.
    """
    still = jax.tree.map(jnp.zeros_like, units)
    of_lens = ravel_pytree(units.lens)[0]
    if model.levers is None:
        return Common(jnp.zeros(len(units.frames)), jnp.zeros_like(of_lens))
    equal = COMMON * model.levers.std / units.rays[:, 2]
    seen = jacobian(still._replace(rays=still.rays.at[:, 2].set(equal)))
    seen = seen._replace(rays=jnp.zeros_like(seen.rays))  # the prior is of what levers differ by
    moved = solution(reduced(jacobian, seen, still, structure, jnp.zeros(())), still, structure)
    lens = ravel_pytree(moved.lens)[0] * of_lens
    return Common(moved.frames[:, 0] * units.frames[:, 0] + lens[-1], lens)
