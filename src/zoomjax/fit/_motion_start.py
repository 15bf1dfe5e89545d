"""A start for `fit_motion`: frames chained one after the other, from guesses of the first field of view.

The rays of the first frame follow from a guess of its focal length. Each frame after it is fitted to the
rays that frames before it gave (log f and rotation, robustly), and its views give or improve rays. All
guesses run side by side; those that most views follow best are starts. Nothing carries the focal length
over a cut: there each chain begins with its guess again, and one more start has of each part of a clip the
guess that is best there.

A camera often follows something that moves. What has a share of the tracks, and stays where it was in the
image, then draws a fit that begins with the frame before. So each fit begins with what most of the frame's
views agree with, among what two tracks each say (Fischler, Bolles 1981).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._core.arrays import places
from ._structure import bucket
from ._views import MEDIAN_OF_SIZE, core_median
from .losses import CAUCHY

FIELDS_OF_VIEW = (70.0, 45.0, 28.0, 17.0, 10.0, 5.0)
"""Guesses, degrees across the image."""

STARTS = 3
"""Chains that are tried further: where a camera turns little, residuals hardly tell good from bad."""

_TURNS = 12  # Gauss-Newton steps a frame
_LEAST_VIEWS = 4
_PAIRS = 24  # of tracks: with half of all on things that move, none is without in one frame of 1,000
_AGREES = 1 / 400  # of the image's width: what is farther off than this hardly agrees


class Path(NamedTuple):
    """A camera that turns and zooms, and what it sees.

    Attributes:
        log_focal: of each frame, of f in px.
        rotation: of each frame, from the scene to the camera: x right, y down, z forward.
        rays: direction of each track in the scene, of length 1.
    """

    log_focal: Float[Array, "frame"]
    rotation: Float[Array, "frame 3 3"]
    rays: Float[Array, "track 3"]


class _State(NamedTuple):
    log_focal: Array
    rotation: Array
    rays: Array  # sums of directions, weighted
    residual: Array  # median of the frame's


def turned(vector: Float[Array, "3"], rotation: Float[Array, "3"]) -> Float[Array, "3"]:
    """A vector turned by a rotation vector (Rodrigues' formula), smooth at 0."""
    squared = jnp.sum(rotation**2)
    safe = jnp.where(squared > 1e-12, squared, 1.0)
    angle = jnp.sqrt(safe)
    first = jnp.where(squared > 1e-12, jnp.sin(angle) / angle, 1 - squared / 6)
    second = jnp.where(squared > 1e-12, (1 - jnp.cos(angle)) / safe, 0.5 - squared / 24)
    cross = jnp.cross(rotation, vector)
    return vector + first * cross + second * jnp.cross(rotation, cross)


def rotation_vector(matrix: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """The rotation vector of a rotation matrix, of an angle below 180 degrees; smooth at 0."""
    twice = jnp.stack(
        [matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]
    )
    squared = jnp.sum(twice**2)  # (2 sin)^2
    safe = jnp.where(squared > 1e-12, squared, 1.0)
    angle = jnp.arctan2(jnp.sqrt(safe), jnp.trace(matrix) - 1)
    return twice * jnp.where(squared > 1e-12, angle / jnp.sqrt(safe), 0.5)


def shrunk_ray(ray: Float[Array, "3"], factor: Float[Array, ""]) -> Float[Array, "3"]:
    """A direction at `factor` times its angle to the z axis."""
    across = jnp.sum(ray[:2] ** 2)
    safe = jnp.where(across > 1e-16, across, 1.0)
    sine = jnp.sqrt(safe)
    angle = factor * jnp.arctan2(sine, ray[2])
    scale = jnp.where(across > 1e-16, jnp.sin(angle) / sine, factor)
    along = jnp.where(across > 1e-16, jnp.cos(angle), 1.0)
    return jnp.concatenate([scale * ray[:2], along[None]])


def starts_of(
    points: Float[Array, "view 2"],
    tracks: int,
    width: float,
    by_frame: tuple,
    part: tuple[Int[Array, "frame"], Int[Array, "track"]],
    root: Float[Array, "view"] | None = None,
) -> tuple[Path, Array]:
    """The best `STARTS` chains of all guesses, best first, and the medians of their frames' residuals, px.

    And after these a chain made of the best of each part. Where views have weights, residuals are times
    their roots.

    Args:
        points: of each view, about the centre of the image, px.
        tracks: their number.
        width: of the image, px.
        by_frame: of `views_by_frame`.
        part: the number of each frame's and of each track's part, as tracks link them.
        root: of each view's weight; None for equal ones.
    """
    track, view, present = by_frame
    seen, roots = points[view], None if root is None else root[view]
    guesses = width / 2 / np.tan(np.radians(FIELDS_OF_VIEW) / 2)
    drawn = np.random.default_rng(0).uniform(size=(1, _PAIRS, 2))
    drawn = (drawn + 0.618 * jnp.arange(len(track))[:, None, None]) % 1  # other ones in each frame

    number = jnp.arange(len(track))
    there = jnp.where(jnp.any(present, axis=1), number, len(track))
    first = jax.ops.segment_min(there, part[0], len(track))

    def chain(focal):
        state = _State(jnp.log(focal), jnp.eye(3), jnp.zeros((tracks, 3)), jnp.zeros(()))

        def step(state, frame):
            *frame, fresh = frame
            state = state._replace(log_focal=jnp.where(fresh, jnp.log(focal), state.log_focal))
            state = _next(state, *frame, near=_AGREES * width)
            return state, (state.log_focal, state.rotation, state.residual)

        frames = (track, present, seen, drawn, roots, number == first[part[0]])
        final, (log_focal, rotation, residual) = jax.lax.scan(step, state, frames)
        norm = jnp.linalg.norm(final.rays, axis=1, keepdims=True)
        rays = jnp.where(norm > 0, final.rays / jnp.where(norm > 0, norm, 1), jnp.array([[0.0, 0.0, 1.0]]))
        return Path(log_focal, rotation, rays), jnp.nanmean(residual)

    def missed(path):
        def frame(log_focal, rotation, track, present, seen, root):
            errors = _errors(path.rays[track] @ rotation.T, log_focal, seen, root)
            return jnp.where(present, jnp.linalg.norm(errors, axis=1), jnp.nan)

        return jax.vmap(frame)(path.log_focal, path.rotation, track, present, seen, roots)

    def cost(path):
        """The sums of each part's disagreement, and of its views."""
        cost, weight = _costs(missed(path), near), 1.0 if roots is None else roots**2
        there = ~jnp.isnan(cost)
        sums = [jnp.sum(jnp.where(there, of, 0), axis=1) for of in (weight * cost, weight * there)]
        return [jax.ops.segment_sum(of, part[0], len(part[0])) for of in sums]

    paths, residuals = jax.vmap(chain)(jnp.asarray(guesses, points.dtype))
    residuals = jnp.where(jnp.isfinite(residuals), residuals, jnp.inf)
    near = CAUCHY * jnp.min(residuals) / MEDIAN_OF_SIZE
    costs, views = jax.lax.map(cost, paths)
    usable = jnp.isfinite(residuals)
    total = jnp.where(usable, jnp.sum(costs, axis=1) / jnp.sum(views, axis=1), jnp.inf)
    best = jnp.argsort(total)[:STARTS]
    of_part = jnp.argmin(jnp.where(usable[:, None] & (views > 0), costs, jnp.inf), axis=0)
    frame, track = (of_part[of] for of in part)
    mixed = Path(
        paths.log_focal[frame, number],
        paths.rotation[frame, number],
        paths.rays[track, jnp.arange(tracks)],
    )
    paths = jax.tree.map(lambda leaf, more: jnp.concatenate([leaf[best], more[None]]), paths, mixed)
    return paths, residuals[jnp.append(best, best[0])]


def disagreement(
    size: Float[Array, "*some"],
    near: Float[Array, ""] | float,
    weight: Float[Array, "*some"] | None = None,
) -> Float[Array, ""]:
    """How far views are off, in all, where those far off count little more: a mean; NaN is no view."""
    cost = _costs(size, near)
    if weight is None:
        return jnp.nanmean(cost)
    return jnp.nansum(weight * cost) / jnp.sum(jnp.where(jnp.isnan(cost), 0, weight))


def _costs(size, near):
    return jnp.log1p((size / near) ** 2)


def views_by_frame(
    track: Int[np.ndarray, "view"], moment: Int[np.ndarray, "view"], frames: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The views of each frame, padded: their tracks, their numbers, which are there."""
    order = np.argsort(moment, kind="stable")
    count = np.bincount(moment, minlength=frames)
    padded = np.zeros((2, frames, bucket(int(count.max()))), np.int32)
    padded[:, moment[order], places(count)] = track[order], order
    return padded[0], padded[1], np.arange(padded.shape[2]) < count[:, None]


def _errors(ahead, log_focal, seen, root):
    """How far points ahead of a camera without distortion are from where they were seen, px.

    Times the roots of their weights, if there are any.
    """
    errors = jnp.exp(log_focal) * ahead[:, :2] / jnp.maximum(ahead[:, 2:], 0.05) - seen
    return errors if root is None else root[:, None] * errors


def _next(state, track, present, seen, drawn, root, *, near):
    """The state after one more frame: its focal length and rotation, and the rays with its views."""
    known = present & (jnp.sum(state.rays[track] ** 2, axis=1) > 0)
    directions = state.rays[track]
    directions = directions / jnp.maximum(jnp.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
    enough = jnp.sum(known) >= _LEAST_VIEWS
    own = None if root is None else root**2

    def residuals(unknown):
        ahead = jax.vmap(lambda ray: turned(state.rotation @ ray, unknown[1:]))(directions)
        return _errors(ahead, state.log_focal + unknown[0], seen, root)

    def change(error, jacobian, weight):
        normal = jnp.einsum("vri,vrj,v->ij", jacobian, jacobian, weight)
        right = jnp.einsum("vri,vr,v->i", jacobian, error, weight)
        normal = normal + 1e-9 * (1 + jnp.trace(normal)) * jnp.eye(4)
        return -jnp.clip(jnp.linalg.solve(normal, right), -0.3, 0.3)

    def of_pair(pair):
        return change(error[pair], jacobian[pair], jnp.ones(2))

    def cost(unknown):
        size = jnp.linalg.norm(residuals(unknown), axis=1)
        return disagreement(jnp.where(known, size, jnp.nan), near, own)

    def spread(unknown):
        size = core_median(jnp.linalg.norm(residuals(unknown), axis=1), known, own)
        return jnp.maximum(jnp.nan_to_num(size), 0.1)

    def turn(unknown, _):
        error, scale = residuals(unknown), 2 * spread(unknown)
        weight = jnp.where(known, 1 / (1 + jnp.sum(error**2, axis=1) / scale**2), 0)
        return unknown + change(error, jax.jacfwd(residuals)(unknown), weight), None

    still = jnp.zeros(4, seen.dtype)
    error, jacobian = residuals(still), jax.jacfwd(residuals)(still)
    count = jnp.cumsum(known)
    pairs = jnp.sum(count[None, None] <= jnp.floor(drawn * count[-1])[..., None], axis=-1)
    begins = jnp.concatenate([still[None], jax.vmap(of_pair)(pairs)])
    costs = jax.vmap(cost)(begins)
    start = begins[jnp.argmin(jnp.where(jnp.isfinite(costs), costs, jnp.inf))]
    unknown, _ = jax.lax.scan(turn, start, None, length=_TURNS)
    unknown = jnp.where(enough, unknown, 0)
    rotation = jax.vmap(turned, (1, None), 1)(state.rotation, unknown[1:])
    focal = jnp.exp(state.log_focal + unknown[0])
    ahead = jnp.concatenate([seen / focal, jnp.ones_like(seen[:, :1])], axis=1)
    direction = ahead @ rotation / jnp.linalg.norm(ahead, axis=1, keepdims=True)
    size = jnp.linalg.norm(residuals(unknown), axis=1)
    weight = jnp.where(known, 1 / (1 + (size / (3 * spread(unknown))) ** 2), 1.0)
    weight = weight if own is None else own * weight
    rays = state.rays.at[track].add(jnp.where(present, weight, 0)[:, None] * direction)
    residual = jnp.where(enough, spread(unknown), jnp.nan)
    return _State(jnp.log(focal), rotation, rays, residual)
