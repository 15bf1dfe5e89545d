"""Shots of a clip that show one scene from one place, found and joined."""

import itertools
from collections.abc import Callable, Iterable
from typing import Protocol

import numpy as np
from jaxtyping import Float

from .._core.arguments import kinds_checked
from ..tracks.tracks import Tracks
from .joining import Matches, Turn, frames_apart, join_shots, turn_between
from .motion_fit import MotionFit
from .result import RESULTS
from .same_camera import check_tracks_of

_SHOTS = 30
"""That are compared, the longest ones: all are compared with all."""

_FRAMES = 48
"""That are compared in all, if each shot has as many as `_OF_A_SHOT` allow."""

_OF_A_SHOT = (2, 6)

_LINKS = 20
"""Tracks that go from one shot to another, at least: fewer do not hold the one to the other."""

Points = Float[np.ndarray, "point 2"]


class Look(Protocol):
    """What some frames of a clip show, as `zoomjax.tracks.KeyFrames` says."""

    def matches(self, one: int, other: int) -> tuple[Points, Points]:
        """Points of one frame and points of another that look like them, px."""
        ...

    def alike(self, one: int, other: int, carry: Callable[[Points], Points], size: tuple[int, int]) -> bool:
        """Whether the frame `one` shows what `other` shows, whose points `carry` takes to `one`."""
        ...


@kinds_checked
def shot_turns(fit: MotionFit, tracks: Tracks, *, look: Callable[[Iterable[int]], Look]) -> list[Turn]:
    """How the camera turned between shots of a clip that show the same from the same place.

    Some frames of each shot, those that differ most in direction and zoom, are compared with those of the
    others. Of more than thirty shots the longest are compared.

    Args:
        fit: of the clip.
        tracks: to which it was fitted.
        look: called once with the numbers of the frames that are compared; returns what they show, such as
            ``functools.partial(KeyFrames, "clip.mp4")``.

    Returns:
        A turn for each pair of shots that show the same: `join_shots` takes them. None leads to shots that
        show something else, or that look in one direction at one zoom, where a caption would do the same.
        There are none if the fit is not successful, as without a scale of f.

    Raises:
        ValueError: tracks are of another fit.
    """
    check_tracks_of(fit, tracks)
    if fit.fit.result != RESULTS.successful:
        return []
    shot = np.asarray(fit.shot)
    counts = np.bincount(shot[np.isfinite(np.asarray(fit.focal)) & (shot >= 0)])
    longest = np.sort(np.argsort(-counts, kind="stable")[:_SHOTS])
    if len(longest) < 2:
        return []
    most = int(np.clip(_FRAMES // len(longest), *_OF_A_SHOT))
    frames = {number: frames_apart(fit, number, most) for number in longest.tolist()}
    pairs = list(itertools.combinations(frames, 2))
    compared = sum(len(frames[one]) * len(frames[other]) for one, other in pairs)
    seen = look(itertools.chain(*frames.values()))
    turns = []
    for pair in pairs:
        both = itertools.product(*(frames[number] for number in pair))
        matches = [Matches((one, other), seen.matches(one, other)) for one, other in both]
        turn = turn_between(fit, matches, compared)
        if turn is not None and seen.alike(
            *_carry(join_shots(fit, [turn], tracks=tracks, scaled=True), turn)
        ):
            turns.append(turn)
    return turns


def _carry(fit: MotionFit, turn: Turn) -> tuple[int, int, Callable[[Points], Points], tuple[int, int]]:
    """The frame with the shorter f and the other one, and where the one shows the points of the other."""
    one, other = sorted(turn.frames, key=lambda frame: float(fit.focal[frame]))

    def carry(points: Points) -> Points:
        return fit.carried(np.full(len(points), other), points, one)

    return one, other, carry, fit.lens.image_size


@kinds_checked
def linked_well(tracks: Tracks, fit: MotionFit) -> Tracks:
    """The tracks without views in shots to which few of those that begin in the same shot go.

    Fewer than twenty, which may all be mistakes, do not hold one shot to another; a fit would take them
    for a link.

    Args:
        tracks: of which some go from shot to shot, by `zoomjax.tracks.find_again`.
        fit: of the same clip, which says what its shots are.

    Raises:
        ValueError: the fit is of another number of frames.

    Warns:
        UserWarning: tracks of which one view is left are dropped.
    """
    if len(fit.shot) != tracks.frames:
        raise ValueError(
            f"Argument fit must be of the clip of the tracks, but it has {len(fit.shot)} frames and they "
            f"have {tracks.frames}."
        )
    shot = np.asarray(fit.shot)
    number, frame, points = tracks.views()
    _, first, track = np.unique(number, return_index=True, return_inverse=True)
    begun, there = shot[frame[first]][track], shot[frame]
    links = np.unique(np.stack([track, begun, there]), axis=1)
    size = shot.max() + 2  # of a frame without tracks, -1, the last
    count = np.zeros((size, size), int)
    np.add.at(count, (links[1], links[2]), 1)
    both = count + count.T
    good = (begun == there) | (both[begun, there] >= _LINKS)
    if good.all():
        return tracks
    weight = tracks.view_weights()
    return Tracks.from_arrays(
        number[good],
        frame[good],
        points[good],
        image_size=tracks.image_size,
        frames=tracks.frames,
        weight=None if weight is None else weight[good],
    )
