"""Levers of tracks: how far the entrance pupil is before the axis of rotation, over each point's distance.

Where a parallax is seen (`_motion_parallax`), each track has a lever beside its ray, with a normal prior
whose variance the tracks tell.

What all levers have in common looks like a lens, and no track tells it. But distances are positive: it is
likely a few times as large as the levers' standard deviation, and on the side of the near points, to which
levers have their long tail. So that is guessed, as far as the tail is seen, and the covariance has in it
by how much the guess may be off.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ._columns import Columns, Rows, Unknowns
from ._motion_model import Levers, Model
from ._motion_parallax import Spread
from ._schur import Reduced, reduced_of, solution
from ._structure import Structure

COMMON, COMMON_STD = 2.5, 1.25
"""What levers have in common, in standard deviations of them, and how far that varies from scene to scene.

Of points that are spread evenly from 40 to 120 m away it is 3.1, from 10 to 50 m 2.1, from 20 to 40 m 5.0.
"""


def guessed_levers(spread: Spread, tracks: int) -> Levers:
    """Levers before there is any data: of either sign, as likely as the tracks tell."""
    side, std = spread.side, spread.std
    mean = COMMON * side * std
    mean_std = std * jnp.sqrt(COMMON_STD**2 + COMMON**2 * (1 - side**2))
    return Levers(jnp.full(tracks, mean), std, mean, mean_std)


class Common(NamedTuple):
    """By how much estimates are off if what levers have in common is as large as its standard deviation."""

    log_focal: Float[Array, "frame"]
    lens: Float[Array, "lens"]


def determined_levers(model: Model, matrix: Reduced, units: Unknowns) -> Float[Array, ""] | int:
    """How many levers the tracks determine: of each, the share that is not the prior's."""
    if model.levers is None:
        return 0
    variance = matrix.rays[0][:, 2, 2] * units.rays[:, 2] ** 2
    return jnp.sum(1 - jnp.minimum(variance / model.levers.std**2, 1))


def common_lever(
    model: Model,
    rows_at: Callable[[Unknowns], Rows],
    of_rows: Columns,
    units: Unknowns,
    structure: Structure,
) -> Common:
    """What the covariance lacks, as what levers have in common is a guess; 0 without levers.

    Args:
        model: the fitted one.
        rows_at: the rows, by the unknowns.
        of_rows: their columns.
        units: of the unknowns.
        structure: which track and frame each view belongs to.
    """
    still = jax.tree.map(jnp.zeros_like, units)
    of_lens = ravel_pytree(units.lens)[0]
    if model.levers is None:
        return Common(jnp.zeros(len(units.frames)), jnp.zeros_like(of_lens))
    equal = model.levers.mean_std / units.rays[:, 2]
    along = still._replace(rays=still.rays.at[:, 2].set(equal))
    seen = jax.jvp(rows_at, (still,), (along,))[1]
    seen = seen._replace(rays=jnp.zeros_like(seen.rays))  # the prior is of what levers differ by
    moved = solution(reduced_of(of_rows, seen, still, structure, jnp.zeros(())), still, structure)
    lens = ravel_pytree(moved.lens)[0] * of_lens
    return Common(moved.frames[:, 0] * units.frames[:, 0] + lens[-1], lens)
