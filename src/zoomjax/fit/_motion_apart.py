"""Whether groups of frames that nothing links, as shots of a clip with cuts, contradict their one lens.

At the minimum each group pulls at the lens (`Pulls`): its score g is the gradient of its part of the
energy, without its frames and rays, and H is what it tells of the lens. By itself it would have the lens
``-H^-1 g`` away. If all have one lens, the sum of ``g^T H^-1 g``, less that of all together, is chi-squared
(Rao's test). What is wrong with a group's errors is in c, by which scores of its own tracks scatter more
than by noise.

Any model is a little wrong, and enough views tell. So groups that do not agree are fitted by themselves, by
the programs that all were fitted by, and count if their own lens or focal lengths are far off.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.stats import chi2

from ._motion_estimate import lens_of
from ._motion_model import Data, Model, Noise
from ._motion_repeated import Pulls
from ._motion_stages import refitted
from .joining import flat_points

_CHANCE = 1e-8
"""Of the pulls of all groups, and of a group's own: what is less likely is no chance."""

_LEAST = 0.5
"""Of how scores scatter by noise: a group of few tracks may scatter less by chance."""

_UNTOLD = 1e-8
"""Of the most that a group tells of any parameter: what it tells less of, it does not tell."""

_MOST = 3
"""Groups that are fitted by themselves: those that pull most."""

_LONGER, _BENT = 0.01, 1e-3
"""Of f, and of the image's diagonal: what a lens of its own changes by less, hardly matters."""

_LEVERS = 4.0
"""Times the standard deviation of levers: what all levers of a shot have in common looks like a lens."""


class Apart(NamedTuple):
    """A group of frames that has another lens than others.

    Attributes:
        group: its number.
        longer: how much longer its f would be by its own lens, the logarithm.
        corner: how much farther outwards that lens would move the corners of the image, px; NaN beyond a
            fold.
    """

    group: int
    longer: float
    corner: float


def group_apart(
    data: Data, model: Model, noise: Noise, group: Int[np.ndarray, "frame"], pulls: Pulls
) -> Apart | None:
    """The group of frames that contradicts the lens of all most; None if none does.

    Args:
        data: tracks and lines.
        model, noise: fitted to them.
        group: of each frame, the number of what tracks link; -1 for those without views.
        pulls: of the groups.
    """
    number = int(np.max(group)) + 1
    if number < 2 or not all(np.isfinite(np.asarray(part)[:number]).all() for part in pulls):
        return None
    total, free, squares, own = heterogeneity(pulls, number)
    if not chi2.sf(total, max(free, 1)) < _CHANCE:
        return None
    lever = _LEVERS * (0.0 if model.levers is None else float(model.levers.std))
    diagonal = 2 * data.scale
    least = _LONGER + lever, diagonal * (_BENT + lever / 2)
    found = []
    for name in np.argsort(-squares)[:_MOST].tolist():
        if chi2.sf(squares[name], max(own[name], 1)) < _CHANCE:
            apart = _by_itself(data, model, noise, group, name)
            off = np.abs([apart.longer, apart.corner]) / least
            found += [(float(np.nanmax(off)), apart)] if np.isfinite(off).any() else []
    far, apart = max(found, default=(0.0, None), key=lambda of: of[0])
    return apart if far > 1 else None


def heterogeneity(
    pulls: Pulls, groups: int
) -> tuple[float, int, Float[np.ndarray, "group"], Int[np.ndarray, "group"]]:
    """How far groups are from one lens.

    Args:
        pulls: of the groups.
        groups: their number.

    Returns:
        The sum of squares, how large it is by chance, and both for each group's own.
    """
    alone = [_without_own(*(np.asarray(part)[number] for part in pulls)) for number in range(groups)]
    inverse = [_inverse(fisher) for _, fisher in alone]
    squares = np.array([score @ of @ score for (score, _), (of, _) in zip(alone, inverse, strict=True)])
    ranks = np.array([rank for _, rank in inverse])
    together, rank = _inverse(np.sum([fisher for _, fisher in alone], axis=0))
    score = np.sum([score for score, _ in alone], axis=0)
    total = float(np.sum(squares) - score @ together @ score)
    return total, int(np.sum(ranks) - rank), squares, ranks


def _without_own(score, fisher, of_tracks, scatter):
    """A group's score and Fisher information of the lens, where its shutter and its scale are its own."""
    inverse, rank = _inverse(of_tracks)
    more = max(np.sum(inverse * scatter) / max(rank, 1), _LEAST)
    lens, own = slice(0, -2), slice(-2, None)
    by_own = fisher[lens, own] @ _inverse(fisher[own, own])[0]
    score = score[lens] - by_own @ score[own]
    fisher = fisher[lens, lens] - by_own @ fisher[own, lens]
    return score / more, fisher / more


def _inverse(matrix):
    """The inverse of a symmetric matrix where it is not next to 0, and its rank."""
    values, vectors = np.linalg.eigh(matrix)
    told = values > _UNTOLD * max(values[-1], 0)
    some = vectors[:, told]
    return some / values[told] @ some.T, int(told.sum())


def _by_itself(data, model, noise, group, number):
    """A group with the lens that it has by itself."""
    frames = len(data.log_focal)
    mine = np.pad(group == number, (0, frames - len(group)))
    there = data.there & jnp.asarray(mine)[data.structure.frame]
    fixed = data.fixed | jnp.asarray(~mine)
    part = eqx.tree_at(lambda data: (data.there, data.fixed), data, (there, fixed))
    if data.lines is not None:
        weight = jnp.where(jnp.asarray(mine)[data.structure.line_frame], data.lines.weight, 0)
        part = eqx.tree_at(lambda data: data.lines.weight, part, weight)
    own = refitted(part, model, noise)
    focal = [np.exp(np.asarray(of.path.log_focal)[mine]) for of in (model, own)]
    longer = np.log(focal[1] / focal[0])
    order = np.argsort(focal[0])
    places = order[[0, len(order) // 2, -1]]
    corner = [_corner(data, of, f[places]) for of, f in zip((model, own), focal, strict=True)]
    off = corner[1] - corner[0]
    return Apart(number, float(np.median(longer)), float(off[np.argmax(np.abs(off))]))


def _corner(data: Data, model: Model, focal: Float[np.ndarray, "focal"]) -> Float[np.ndarray, "focal"]:
    """How far a lens moves the corners of the image outwards at focal lengths, px, in the mean."""
    lens = lens_of(data, model, jnp.asarray(focal))
    corners = np.array([[x, y] for x in (0, data.size[0] - 1) for y in (0, data.size[1] - 1)], float)
    moved = []
    for f in focal:
        centre = np.asarray(lens.centre_at(float(f)))
        ahead = f * np.linalg.norm(flat_points(lens, float(f), corners), axis=1)
        moved.append(np.mean(ahead - np.linalg.norm(corners - centre, axis=1)))
    return np.array(moved)
