"""How the camera turned between shots of one scene, from points of their frames that look alike.

A shot's frames have rotations from the frame where it begins. Two shots from the same place differ by one
rotation, and by a factor of f, as a short shot tells its f less well than its rotation. Frames are compared
two by two: two matches say a rotation and a factor, and those that most matches agree with are tried
(Fischler, Bolles 1981). That is accepted if so many would hardly agree by chance (Moisan, Stival 2004).
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.special import gammaln

from .._core.arguments import kinds_checked
from ..tracks.tracks import Tracks
from ._structure import bucket
from .motion_fit import MotionFit
from .same_camera import check_tracks_of

_WITHIN = 1 / 300
"""Diagonals of the image, in the frame with the shorter f: matches that are farther off do not agree."""

_STILL = 2.0
"""Times that. What stays in its place in the image may be a caption, and tells nothing."""

_APART = 0.01
"""Diagonals: of what is nearer in both frames, one match counts."""

_FEWEST = 12
"""Matches that agree, at least."""

_CHANCE = 1e-6
"""Of all that is compared, how often so many may agree by chance."""

_SPREAD = 0.04
"""Diagonals: standard deviation of their places in the frame with the longer f, along the shorter axis.
Less is one thing, as a board or a moving line of text."""

_PAIRS = 300  # of matches that are tried
_LOOSE, _SURE = 0.1, 0.002  # the most and the least standard deviation of the factor of f, its logarithm
_NOISE = 1 / 1500  # diagonals: of matches
_ZOOM = 0.35  # change of log f that makes two frames as different as half a field of view does


class Matches(NamedTuple):
    """Points of two frames that look alike.

    Attributes:
        frames: the numbers of both.
        points: of each, px.
    """

    frames: tuple[int, int]
    points: tuple[Float[np.ndarray, "point 2"], Float[np.ndarray, "point 2"]]


class Turn(NamedTuple):
    """From a shot to another.

    Attributes:
        shots: the numbers of both.
        frames: of each, the one in which most points agree.
        agree: how many of these.
        rotation: from directions of the second shot to directions of the first one.
        factor: logarithm of that of f in the second, beside the first one.
    """

    shots: tuple[int, int]
    frames: tuple[int, int]
    agree: int
    rotation: Float[np.ndarray, "3 3"]
    factor: float


def frames_apart(fit: MotionFit, shot: int, most: int) -> list[int]:
    """Some frames of a shot that differ most in where the camera looks and in zoom."""
    focal = np.asarray(fit.focal)
    members = np.flatnonzero((np.asarray(fit.shot) == shot) & np.isfinite(focal))
    if not len(members):
        return []
    reach = np.hypot(*fit.lens.image_size) / 4 / np.sqrt(focal[members] * np.mean(focal[members]))
    place = np.column_stack(
        [np.asarray(fit.rotation)[members, 2] / reach[:, None], np.log(focal[members]) / _ZOOM]
    )
    chosen = [int(np.argmin(focal[members]))]
    while len(chosen) < min(most, len(members)):
        apart = np.min(np.linalg.norm(place[:, None] - place[chosen], axis=-1), axis=1)
        chosen.append(int(np.argmax(apart)))
    return sorted(members[np.unique(chosen)].tolist())


def turn_between(fit: MotionFit, matches: Sequence[Matches], compared: int) -> Turn | None:
    """The rotation between two shots, or None if nothing says that they show the same from the same place.

    Args:
        fit: of the clip.
        matches: of frames of the one with frames of the other.
        compared: number of pairs of frames that are compared in all.
    """
    seen = [_Seen.of(fit, pair) for pair in matches]
    found = [(pair, *_agreed(pair, compared)) for pair in seen if len(pair.flat[0]) >= _FEWEST]
    if not found or (best := max(found, key=lambda of: of[1]))[1] == 0:
        return None
    pair, agree, rotation, factor = best
    rotation, factor = _refined(seen, rotation, factor)
    numbers = np.asarray(fit.shot)[list(pair.frames)].tolist()
    return Turn((numbers[0], numbers[1]), pair.frames, int(agree), rotation, float(factor))


@kinds_checked
def join_shots(fit: MotionFit, turns: Sequence[Turn], *, tracks: Tracks, scaled: bool = False) -> MotionFit:
    """The fit with shots in one scene between which turns lead, by those in which most points agree.

    Args:
        fit: of the clip.
        turns: between shots, by `shot_turns`.
        tracks: to which it was fitted.
        scaled: whether f of the shots are made to agree, too: as a start of another fit, as neither the
            lens nor a standard deviation is changed.

    Raises:
        ValueError: a turn is of a shot that the fit does not have, or by no rotation or factor; or tracks
            are of another fit.
    """
    check_tracks_of(fit, tracks)
    shot, scene = np.asarray(fit.shot), np.asarray(fit.scene)
    numbers, first = np.unique(shot, return_index=True)
    poses = {
        number: _Pose(int(scene[at]), np.eye(3), 0.0)
        for number, at in zip(numbers.tolist(), first, strict=True)
        if number >= 0
    }
    for turn in sorted(turns, key=lambda turn: -turn.agree):
        if not poses.keys() >= set(turn.shots):
            raise ValueError(
                f"Argument turns is of shots {turn.shots}, but those of the fit are {sorted(poses)}: give "
                "what shot_turns finds for this fit."
            )
        _check_turn(turn)
        one, other = (poses[number] for number in turn.shots)
        if one.scene == other.scene:
            continue
        more = one.factor + turn.factor - other.factor
        step = one.rotation @ _powered(turn.rotation, -one.factor) @ _powered(other.rotation, -more).T
        for number, pose in list(poses.items()):
            if pose.scene == other.scene:
                turned = step @ _powered(pose.rotation, -more)
                poses[number] = _Pose(one.scene, turned, pose.factor + more)
    begins = np.argmax(np.asarray(tracks.mask), axis=1)
    first = np.asarray(tracks.frame)[np.arange(len(begins)), begins]
    return _moved(fit, first, poses, scaled)


def _check_turn(turn: Turn) -> None:
    """Refuse a turn by what is no rotation, or by a factor that is no number."""
    turned = np.asarray(turn.rotation, float)
    whole = turned.shape == (3, 3) and np.allclose(turned @ turned.T, np.eye(3), atol=1e-6)
    if not whole or np.linalg.det(turned) < 0 or not np.isfinite(turn.factor):
        raise ValueError(
            f"Argument turns has from shot {turn.shots[0]} to {turn.shots[1]} no rotation and factor of f: "
            "the one must be a 3 x 3 rotation matrix and the other a finite logarithm."
        )


class _Pose(NamedTuple):
    """Of a shot: its scene, the rotation from its directions to those of the scene, and its factor of f."""

    scene: int
    rotation: np.ndarray
    factor: float


class _Seen(NamedTuple):
    """What two frames show, of which nothing stays in its place.

    Attributes:
        frames: the numbers of both.
        points: of each, px.
        flat: the same without distortion, about the centre, over f.
        rotation: of each.
        focal: of each, px.
        diagonal, area: of the image, px.
        loose: standard deviation of the factor of f between them, its logarithm.
    """

    frames: tuple[int, int]
    points: tuple[np.ndarray, np.ndarray]
    flat: tuple[np.ndarray, np.ndarray]
    rotation: tuple[np.ndarray, np.ndarray]
    focal: tuple[float, float]
    diagonal: float
    area: float
    loose: float

    @classmethod
    def of(cls, fit: MotionFit, matches: Matches) -> "_Seen":
        """By the lens and the path of a fit."""
        size = fit.lens.image_size
        diagonal = float(np.hypot(*size))
        one, other = matches.points
        moves = np.linalg.norm(one - other, axis=1) > _STILL * _WITHIN * diagonal
        cells = np.floor(np.column_stack([one, other]) / (_APART * diagonal))
        single = np.zeros(len(one), bool)
        single[np.unique(cells, axis=0, return_index=True)[1]] = True
        points = one[moves & single], other[moves & single]
        focal, std = (np.asarray(of)[list(matches.frames)] for of in (fit.focal, fit.focal_std))
        flat = [flat_points(fit.lens, f, of) for f, of in zip(focal, points, strict=True)]
        turns = np.asarray(fit.rotation)[list(matches.frames)]
        loose = np.nan_to_num(np.hypot(*(std / focal)), nan=_LOOSE)
        return cls(
            matches.frames,
            points,
            (flat[0], flat[1]),
            (turns[0], turns[1]),
            (float(focal[0]), float(focal[1])),
            diagonal,
            float(size[0] * size[1]),
            float(np.clip(loose, _SURE, _LOOSE)),
        )

    def errors(self, rotation: np.ndarray, factor: float) -> np.ndarray:
        """How far matches are apart, (point, 3) px of the frame with the shorter f, by a turn of shots."""
        one = _ahead(self.flat[0]) @ self.rotation[0]
        other = _ahead(self.flat[1] * np.exp(-factor)) @ _powered(self.rotation[1], -factor)
        return (one - other @ rotation.T) * min(self.focal)


def _agreed(pair, compared):
    """How many matches agree with one turn of the camera, 0 if chance explains them; the turn of shots."""
    near = _WITHIN * pair.diagonal
    turn, factor = _drawn(pair, near)
    turn = pair.rotation[0].T @ turn @ _powered(pair.rotation[1], -factor)
    for _ in range(3):
        good = np.linalg.norm(pair.errors(turn, factor), axis=1) < near
        if good.sum() < _FEWEST:
            return 0, turn, factor
        turn, factor = _refined([_some(pair, good)], turn, factor)
    good = np.linalg.norm(pair.errors(turn, factor), axis=1) < near
    count, number = int(good.sum()), len(good)
    if count < _FEWEST:
        return 0, turn, factor
    chance = np.log(compared) + _choices(number, count) + _choices(count, 2)
    chance += (count - 2) * np.log(np.pi * near**2 / pair.area)
    places = pair.points[int(np.argmax(pair.focal))][good]
    spread = np.sqrt(max(np.linalg.eigvalsh(np.cov(places.T))[0], 0)) / pair.diagonal
    return (count if chance < np.log(_CHANCE) and spread > _SPREAD else 0), turn, factor


def _drawn(pair, near):
    """The turn from the second camera to the first, and the factor of f, with which most matches agree."""
    drawn = np.random.default_rng(0).integers(0, len(pair.flat[0]), (_PAIRS, 2))
    drawn = drawn[drawn[:, 0] != drawn[:, 1]]
    one, other = (_ahead(flat) for flat in pair.flat)
    angles = [np.linalg.norm(of[drawn[:, 0]] - of[drawn[:, 1]], axis=1) for of in (one, other)]
    factor = np.log(np.maximum(angles[1], 1e-6) / np.maximum(angles[0], 1e-6))
    factor = np.clip(factor, -3 * pair.loose, 3 * pair.loose)
    other = _ahead(pair.flat[1] * np.exp(-factor)[:, None, None])
    place = np.arange(len(drawn))
    turns = _basis(one[drawn[:, 0]], one[drawn[:, 1]]) @ np.swapaxes(
        _basis(other[place, drawn[:, 0]], other[place, drawn[:, 1]]), 1, 2
    )
    off = np.linalg.norm(one - other @ np.swapaxes(turns, 1, 2), axis=-1) * min(pair.focal)
    best = int(np.argmax(np.sum(off < near, axis=1)))
    return turns[best], float(factor[best])


def _refined(pairs, turn, factor):
    """The turn of shots and the factor of f with which matches agree best, from near ones."""
    noise = _NOISE * pairs[0].diagonal
    near = [
        _some(pair, np.linalg.norm(pair.errors(turn, factor), axis=1) < 3 * _WITHIN * pair.diagonal)
        for pair in pairs
    ]
    near = [pair for pair in near if len(pair.flat[0])]
    loose = float(np.median([pair.loose for pair in near]))

    def rows(step):
        there = Rotation.from_rotvec(step[:3]).as_matrix() @ turn
        errors = [pair.errors(there, factor + step[3]).ravel() / noise for pair in near]
        return np.concatenate([*errors, [(factor + step[3]) / loose]])

    step = least_squares(rows, np.zeros(4), loss="soft_l1", x_scale=[1e-3] * 4).x
    return Rotation.from_rotvec(step[:3]).as_matrix() @ turn, float(factor + step[3])


def _some(pair, which):
    """Some of the matches of two frames."""
    points, flat = (tuple(of[which] for of in both) for both in (pair.points, pair.flat))
    return pair._replace(points=points, flat=flat)


def _moved(fit, first, poses, scaled):
    """The fit with shots at their poses: the first of each scene stays, and f is as it is best known."""
    shot, focal, scene = np.asarray(fit.shot), np.array(fit.focal), np.array(fit.scene)
    rotation, rays = np.array(fit.rotation), np.array(fit.rays)
    log_std = np.nan_to_num(np.asarray(fit.focal_std) / focal, nan=_LOOSE)
    for into in {pose.scene for pose in poses.values()}:
        shots = [number for number, pose in poses.items() if pose.scene == into]
        if len(shots) == 1:
            continue
        std = [np.clip(np.median(log_std[shot == number]), _SURE, _LOOSE) for number in shots]
        factors = np.array([poses[number].factor for number in shots])
        mean = np.average(factors, weights=1 / np.square(std))
        factors, mean = (factors - mean, mean) if scaled else (0 * factors, 0.0)
        base = poses[shots[0]].rotation
        for number, factor in zip(shots, factors.tolist(), strict=True):
            turn = _powered(base.T @ poses[number].rotation, mean)
            frames, tracks = shot == number, shot[first] == number
            rotation[frames] = _powered(rotation[frames], -factor) @ turn.T
            rays[tracks] = _shrunk(rays[tracks], np.exp(-factor)) @ turn.T
            focal[frames] *= np.exp(factor)
            scene[frames] = np.asarray(fit.scene)[shot == shots[0]][0]
    scene[scene >= 0] = np.unique(scene[scene >= 0], return_inverse=True)[1]
    return eqx.tree_at(
        lambda fit: (fit.focal, fit.rotation, fit.rays, fit.scene),
        fit,
        tuple(jnp.asarray(of) for of in (focal, rotation, rays, scene)),
    )


def flat_points(lens, focal, points):
    """Points without distortion, about the centre, over f."""
    more = bucket(len(points)) - len(points)
    return np.asarray(_flattened(lens, focal, np.pad(points, ((0, more), (0, 0)))))[: len(points)]


@eqx.filter_jit
def _flattened(lens, focal, points):
    return (lens(focal).undistort(points) - lens.centre_at(focal)[None]) / focal


def _ahead(flat):
    """Directions of length 1 of points on the plane before the camera."""
    ahead = np.concatenate([flat, np.ones((*flat.shape[:-1], 1))], axis=-1)
    return ahead / np.linalg.norm(ahead, axis=-1, keepdims=True)


def _shrunk(rays, factor):
    """Directions at `factor` times their angles to the z axis."""
    across = np.linalg.norm(rays[:, :2], axis=1)
    angle = factor * np.arctan2(across, rays[:, 2])
    sides = rays[:, :2] * (np.sin(angle) / np.maximum(across, 1e-12))[:, None]
    return np.column_stack([sides, np.cos(angle)])


def _basis(one, other):
    """Orthonormal vectors from pairs of vectors, as columns."""
    middle, across = one + other, one - other
    axes = [of / np.maximum(np.linalg.norm(of, axis=-1, keepdims=True), 1e-12) for of in (middle, across)]
    return np.stack([*axes, np.cross(*axes)], axis=-1)


def _powered(rotation, log_factor):
    """Rotations by angles that are larger by a factor, whose logarithm is given."""
    vector = Rotation.from_matrix(rotation).as_rotvec()
    return Rotation.from_rotvec(np.exp(log_factor) * vector).as_matrix()


def _choices(number, some):
    """The logarithm of the number of ways to choose some."""
    return gammaln(number + 1) - gammaln(some + 1) - gammaln(number - some + 1)
