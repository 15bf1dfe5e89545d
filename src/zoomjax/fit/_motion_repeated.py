"""How often lines repeat one another: how many of their points count as one.

Points of a line have errors in common: the detector's, and those of a marking that is not quite straight.
Where a camera turns little, it sees the same few lines in every frame, with the same errors. Lines as a
whole then say much less than as many independent points would.

At the minimum each line pulls at the lens: its score is the gradient of its part of the energy. Lines of
all frames that lie in one plane through the camera are the same line of the scene, and their scores add up.
If errors were independent, a sum of scores g would have the covariance ``H_g - H_g V H_g``, with what these
lines tell of the lens, H_g, and V, the covariance of the lens. The mean of ``g^T V g`` over its expectation
is how often the same is said. It does not depend on which lines are put together if errors are independent,
and so two lines that are mistaken for one do no harm.

Views of a track may have errors in common, too: the track drifts, its point is nearer than others, or it is
on a thing that moves. The same mean, of the scores of tracks, is then what variances are too small by.

Scores of all tracks of a shot, and what they tell of the lens, are what its own lens would be told from.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

from ._columns import CHUNK, Columns, Rows, over_views
from ._motion_model import Data, Model, Noise, Stage, pinned, units_of
from ._motion_rows import columns_of, line_planes_of, residuals_of, rows_of
from ._schur import Reduced, lens_equations, reduced_of
from ._small_matrices import products
from ._structure import Structure

_NEAR = 0.01
"""Between the normals of planes, radians: below this two lines are one, seen twice."""

_LITTLE = 1e-9  # added to the diagonal: unknowns that no view sees


class Pulls(NamedTuple):
    """How groups of frames that nothing links pull at the lens that they share, without frames and rays.

    Attributes:
        score: of each group, the sum of its views' pulls.
        fisher: what each group tells of the lens.
        of_tracks: what its tracks alone tell.
        scatter: sum over its tracks of the products of their own scores. Where errors of views are
            independent, and as large as they are taken to be, it is as `of_tracks`.
    """

    score: Float[Array, "group lens"]
    fisher: Float[Array, "group lens lens"]
    of_tracks: Float[Array, "group lens lens"]
    scatter: Float[Array, "group lens lens"]


def groups_of(data: Data, model: Model, scene: Int[np.ndarray, "frame"]) -> Int[np.ndarray, "line"]:
    """The number of the line of the scene that each line shows."""
    plane, frame = np.asarray(line_planes_of(data, model)), np.asarray(data.structure.line_frame)
    # Cameras of different scenes have no rotation in common.
    place = np.column_stack(
        [plane, np.where(frame < len(scene), scene[np.minimum(frame, len(scene) - 1)], -1)]
    )
    tree = KDTree(place)
    other = KDTree(place * [-1, -1, -1, 1])  # a plane has two normals
    pairs = [tree.sparse_distance_matrix(of, _NEAR, output_type="coo_matrix") for of in (tree, other)]
    one, two = (np.concatenate([getattr(of, name) for of in pairs]) for name in ("row", "col"))
    links = scipy.sparse.coo_array((np.ones(len(one)), (one, two)), (len(place),) * 2)
    return scipy.sparse.csgraph.connected_components(links, directed=False)[1]


@eqx.filter_jit
def repeated(
    data: Data, model: Model, noise: Noise, stage: Stage, group: Int[Array, "line"]
) -> Float[Array, ""]:
    """How many points of lines count as one, beside what `noise` says of that; 1 if there is no line."""
    data = pinned(data, residuals_of(data, model), noise)
    zeros = jax.tree.map(jnp.zeros_like, units_of(data, model, noise))
    args = data, model, noise, stage
    rows, of_rows = rows_of(zeros, args), columns_of(args, zeros)
    matrix = reduced_of(of_rows, rows, zeros, data.structure, jnp.asarray(_LITTLE))
    information, by_lens = lens_equations(matrix)
    by_frame, of_lens = of_rows.by_frame, of_rows.by_lens
    answer = by_lens.reshape(-1, 4, by_lens.shape[-1])[data.structure.line_frame]
    effect = of_lens.lines - jnp.einsum("lrf,lfp->lrp", by_frame.lines, answer)
    score = jnp.einsum("lrp,lr->lp", effect, rows.lines)
    fisher = jnp.einsum("lrp,lrq->lpq", effect, effect)
    score, fisher = (jax.ops.segment_sum(of, group, len(group)) for of in (score, fisher))
    return _more_than_chance((score, fisher), lambda group: group, information)


def common_errors_of(
    of_rows: Columns, pull: Rows, matrix: Reduced, structure: Structure, group: Int[Array, "frame"]
) -> tuple[Float[Array, ""], Pulls]:
    """The mean square of how tracks pull at the lens, over what independent views of noise 1 would do.

    Args:
        of_rows: the Jacobian's columns.
        pull: of each view, and of what is known of each ray, the derivative of its loss by its residual.
        matrix: the normal equations.
        structure: which track and frame each view belongs to.
        group: of each frame, the number of what tracks link.

    Returns:
        That, and how the groups pull.
    """
    information, by_lens = lens_equations(matrix)
    answer = by_lens.reshape(-1, 4, by_lens.shape[-1])
    of_known, size, own = of_rows.by_ray.rays, by_lens.shape[-1], matrix.rays[0].shape[-1]

    def step(sums, number, there):
        by_frame, by_ray, of_lens = of_rows.split(number, there)
        of_frame = answer[structure.frame[number]]
        effect = of_lens - sum(by_frame[..., i, None] * of_frame[:, None, i] for i in range(4))
        beside = jnp.concatenate([effect, pull.views[number][..., None]], axis=-1)
        track = structure.track[number]
        found = products(effect, beside), products(by_ray, beside)
        return tuple(
            of.at[track].add(new, indices_are_sorted=True) for of, new in zip(sums, found, strict=True)
        ), None

    start = tuple(jnp.zeros((structure.tracks, n, size + 1)) for n in (size, own))
    (fisher, of_rays), _ = over_views(len(structure.track), step, start)
    if of_known is not None and pull.rays is not None:
        of_rays = of_rays.at[..., -1].add(jnp.einsum("tki,tk->ti", of_known, pull.rays))

    def without_ray(track):
        fisher, of_ray, inverse = track
        fisher = fisher - of_ray[:, :-1].T @ inverse @ of_ray
        return fisher[:, -1], fisher[:, :-1]

    parts = fisher, of_rays, matrix.rays[0]
    of_track = jnp.zeros(structure.tracks, int).at[structure.track].max(group[structure.frame])

    def add(sums, number, there):
        score, fisher = jax.vmap(without_ray)(jax.tree.map(lambda of: of[number], parts))
        new = score, fisher, score[:, :, None] * score[:, None]
        where = jnp.where(there, of_track[number], len(group))  # beyond: dropped
        return tuple(of.at[where].add(more) for of, more in zip(sums, new, strict=True)), None

    shapes = (size,), (size, size), (size, size)
    sums = tuple(jnp.zeros((len(group), *shape)) for shape in shapes)
    (score, of_tracks, scatter), _ = over_views(structure.tracks, add, sums)
    by_frame, of_lens = of_rows.by_frame, of_rows.by_lens
    frame, of_line = jnp.arange(len(group)), structure.line_frame
    rows = (
        (frame, of_lens.frames - by_frame.frames[..., None] * answer[frame], pull.frames),
        (of_line, of_lens.lines - jnp.einsum("lrf,lfp->lrp", by_frame.lines, answer[of_line]), pull.lines),
    )
    told = of_tracks
    for place, effect, row in rows:
        score = score.at[group[place]].add(jnp.einsum("lrp,lr->lp", effect, row))
        told = told.at[group[place]].add(jnp.einsum("lrp,lrq->lpq", effect, effect))
    pulls = Pulls(score, told, of_tracks, scatter)
    return _more_than_chance(parts, without_ray, information), pulls


def _more_than_chance(groups, of_group, information):
    """The mean of ``g^T V g`` over its expectation; 1 if nothing is expected.

    Args:
        groups: what each group has, in arrays.
        of_group: gives a group's score g and its Fisher information.
        information: the inverse of V.
    """
    covariance = jnp.linalg.inv(information)

    def one(group):
        score, fisher = of_group(group)
        own = fisher @ covariance  # H V
        return score @ covariance @ score, jnp.trace(own) - jnp.sum(own * own.T)

    found, expected = (jnp.sum(of) for of in jax.lax.map(one, groups, batch_size=CHUNK))
    return jnp.where(expected > 0, found / jnp.where(expected > 0, expected, 1), 1.0)
