"""What `fit_motion` is given, in arrays of few sizes, as the residuals need it."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse.csgraph
from jaxtyping import Array, Float, Int

from .._core.types import AnyArray, traced
from ..lines.free_centre import AnyCentreLines, compress_any_centre
from ..lines.lines import Lines
from ..models.distortion_model import AbstractDistortionModel
from ..models.requirements import check
from ..models.zoom import AbstractZoom
from ..tracks.repeats import originals, without_rests
from ..tracks.tracks import Tracks
from ._motion_model import Data
from ._structure import bucket, padded, structure_of
from .motion_fit import MotionFit

_READOUT = (0.0, 0.5)
"""What is known of the readout before there is any data, and its standard deviation, in frames."""

_TOLD = 1e-4  # standard deviation of a readout that is given

_LONGEST = 48
"""Frames of a track that share a ray in a long clip. Longer tracks are cut, so that only frames near each
other are coupled: time is then linear in the frames."""

LONGEST_LOOP = 256
"""Frames of a clip whose tracks stay whole if there are longer ones: a camera that comes back to where it
looked before then closes a loop. The frames' matrix is full, and its cost of little account."""

_NEAR = 4
"""Frames with views from one view of a track to the next, at most, that are of one shot: tracks are found
again after more (`find_again`), and maybe beyond a cut."""

_MANY_VIEWS = 100_000
"""From so many on, the way to the minimum is gone with fewer of them."""

_ENOUGH = 60
"""Tracks in each frame for that."""


_LEAST = 1e-9
"""Share of its variance that is left of a residual, where rounding leaves less."""


class Given(NamedTuple):
    """What a fit is made from.

    `unit` is the root of the mean weight, by which `relative` has divided all: times this, the noise of the
    fit is that of a view of weight 1.
    """

    tracks: Tracks
    lines: Lines | AnyCentreLines | None
    line_frames: Int[AnyArray, "some"] | None
    focal: Float[AnyArray, "frame"] | None
    focal_std: float | int | Float[AnyArray, "frame"] | None
    begin: MotionFit | None = None
    unit: float | Array = 1.0


class Asked(NamedTuple):
    """What is fitted."""

    zoom: AbstractZoom
    distortion_model: AbstractDistortionModel
    terms: int
    shift: AbstractZoom | None
    readout: float | int | None


class Problem(NamedTuple):
    """The data of a fit, and where its views are among the tracks'.

    Attributes:
        data: as `_motion_rows` needs them.
        track, view: of each view, its place in the tracks.
        moment: its frame.
        piece: its track, cut into pieces.
        linked: of each frame, the number of the group that tracks link; -1 for frames without views.
        shot: of each frame, so: parts of such a group that follow each other without a cut.
        scene: of each frame, so: such groups, joined as in the fit from which this one begins.
    """

    data: Data
    track: np.ndarray
    view: np.ndarray
    moment: np.ndarray
    piece: np.ndarray
    linked: np.ndarray
    shot: np.ndarray
    scene: np.ndarray


def problem_of(given: Given, asked: Asked) -> Problem:
    """The data, in arrays of few sizes. Frames and masks are known; all else may be traced."""
    tracks = given.tracks
    focal, std = _known_focal(given.focal, given.focal_std, tracks.frames)
    track, view = np.nonzero(np.asarray(tracks.mask))
    moment = np.asarray(tracks.frame)[track, view]
    linked, shot, scene = _groups(track, moment, tracks.frames, given.begin)
    frames = bucket(tracks.frames)
    more = frames - tracks.frames
    lines, line_frame = _ready_lines(
        given, frames, asked.distortion_model, asked.distortion_model.num_coefficients(asked.terms)
    )
    block = _block(track, moment, frames)
    piece = _pieces(track, moment, block)
    structure = structure_of(piece, moment, frames, block, line_frame=line_frame)
    wide = padded(structure)
    points = jnp.asarray(tracks.points, float)[track, view] - (np.array([tracks.image_size]) - 1) / 2
    views = len(wide.track) - len(points)
    new = linked < 0
    new[np.unique(linked, return_index=True)[1]] = True  # the first of each, and no other after a gap
    open_ = (linked >= 0) & jnp.isinf(std)
    weight = None if tracks.weight is None else jnp.asarray(tracks.weight)[track, view]
    redundant = None if weight is None else _redundant(weight, piece)
    data = Data(
        points=jnp.pad(points, ((0, views), (0, 0))),
        there=jnp.arange(len(wide.track)) < len(points),
        structure=wide,
        fixed=jnp.asarray(np.pad(new, (0, more), constant_values=1)),
        pinned=jnp.pad((np.arange(tracks.frames) == jnp.argmax(open_)) & jnp.any(open_), (0, more)),
        log_focal=jnp.pad(jnp.log(focal), (0, more)),
        log_std=jnp.pad(std / focal, (0, more), constant_values=np.inf),
        unknowns=jnp.asarray(4.0 * np.sum(linked >= 0) + 2 * structure.tracks)
        if weight is None
        else _unknowns(weight, redundant, moment, piece),
        neighbours=jnp.asarray(_neighbours(np.pad(shot, (0, more), constant_values=-1), _first(tracks))),
        readout=jnp.asarray(_known_readout(asked.readout)),
        lines=lines,
        moments=None if lines is None else lines.second_moments(2 * lines.terms),
        scale=tracks.scale,
        size=tracks.image_size,
        root=None if weight is None else _widened(jnp.sqrt(weight), views),
        redundant=None if redundant is None else _widened(redundant, views),
    )
    return Problem(data, track, view, moment, piece, linked, shot, scene)


def relative(given: Given) -> Given:
    """The same with weights whose mean is 1, of views that count, and no others.

    Views of weight 0 do not count, nor does what is left of a track if that is one view. Which these are is
    known; weights may be traced.
    """
    tracks = given.tracks
    if tracks.weight is None or traced((tracks.mask, jnp.asarray(tracks.weight) > 0)):
        return given  # in the latter case to be refused
    weight = jnp.asarray(tracks.weight, float)
    mask = np.asarray(tracks.mask) & np.asarray(weight > 0)
    mask = mask & (np.sum(mask, axis=1, keepdims=True) > 1)
    if not mask.any():
        raise ValueError(
            "Argument tracks has no track with two views of a weight above 0: give more views a weight, or "
            "leave weight out for equal weights."
        )
    top = np.max(jax.lax.stop_gradient(weight), where=mask, initial=0)  # whose sum may be infinite
    mean = jnp.mean(weight / top, where=jnp.asarray(mask))
    weight = jnp.where(mask, weight / top / mean, 1)
    tracks = eqx.tree_at(lambda t: (t.mask, t.weight), tracks, (jnp.asarray(mask), weight))
    return given._replace(tracks=tracks, unit=jnp.sqrt(mean) * np.sqrt(top))


def _widened(values, more):
    """Numbers of views, and 1 for so many that pad."""
    return jnp.pad(values, (0, more), constant_values=1)


def _redundant(weight, piece):
    """What a view's ray leaves of its residual's variance, over what it leaves where weights are equal.

    A view with most of its track's weight draws the ray to where it is, and says nothing of the noise.
    """
    pieces = piece.max() + 1
    total, count = (jax.ops.segment_sum(of, piece, pieces)[piece] for of in (weight, jnp.ones(len(piece))))
    left = jnp.maximum((total - weight) / total, _LEAST)
    return jnp.where(count > 1, left * count / jnp.maximum(count - 1, 1), 1.0)


def _unknowns(weight, redundant, moment, piece):
    """How many numbers of frames and rays are fitted, in the mean over views by which noise is found."""
    total = jax.ops.segment_sum(weight, moment, moment.max() + 1)[moment]
    count = np.bincount(piece)[piece]
    return jnp.sum(weight * redundant * (4 * weight / total + 2 / count))


def thinned(given: Given) -> Given | None:
    """The same with some of the tracks, drawn by chance, enough in each frame; None if that is not less."""
    tracks = given.tracks
    mask = np.asarray(tracks.mask)
    if mask.sum() < _MANY_VIEWS:
        return None
    track, view = np.nonzero(mask)
    moment = np.asarray(tracks.frame)[track, view]
    ends = np.cumsum(np.sum(mask, axis=1))
    kept, count = np.zeros(len(mask), bool), np.zeros(tracks.frames, int)
    for number in np.random.default_rng(0).permutation(len(mask)):
        seen = moment[ends[number - 1] if number else 0 : ends[number]]
        kept[number] = np.any(count[seen] < _ENOUGH)
        count[seen] += kept[number]
    if count.sum() > len(moment) / 2:
        return None
    some = Tracks(
        np.asarray(tracks.points)[kept],
        np.asarray(tracks.frame)[kept],
        mask[kept],
        tracks.image_size,
        tracks.frames,
        np.asarray(tracks.number)[kept],
        None if tracks.weight is None else np.asarray(tracks.weight)[kept],
    )
    return given._replace(tracks=some)


def _known_focal(focal, focal_std, frames):
    """Known focal lengths and standard deviations of all frames; 1 and infinity where there is none."""
    if (focal is None) != (focal_std is None):
        raise ValueError(
            "Arguments focal and focal_std belong together, the focal lengths known beforehand and their "
            "standard deviations, px: give both, or neither."
        )
    if focal is None:
        return jnp.ones(frames), jnp.full(frames, jnp.inf)
    values, std = jnp.asarray(focal, float), jnp.asarray(focal_std, float)
    if values.shape != (frames,) or std.shape not in ((), (frames,)):
        raise ValueError(
            f"Arguments focal and focal_std must have a number for each of the {frames} frames, focal NaN "
            f"where it is not known and focal_std or one for all, but their shapes are {values.shape} and "
            f"{std.shape}."
        )
    if not traced((focal, focal_std)) and (
        np.any(values <= 0) or np.any(np.isinf(values)) or not np.all(np.asarray(std) > 0)
    ):
        raise ValueError("Arguments focal and focal_std must be positive, and focal finite or NaN.")
    there = jnp.isfinite(values)
    return jnp.where(there, values, 1.0), jnp.where(there, std, jnp.inf)


def _known_readout(readout):
    """What is known of the readout, and its standard deviation, frames."""
    if readout is None:
        return _READOUT
    numeric = (
        isinstance(readout, float | int | np.ndarray | np.number | jax.Array) and np.ndim(readout) == 0
    )
    if not traced(readout) and not (numeric and abs(readout) <= 1):
        raise ValueError(
            "Argument readout must be the time from the first row to the last, in frames: a number from -1 "
            f"to 1, 0 for a global shutter, but it is {readout}."
        )
    return readout, _TOLD


def _ready_lines(given, padded_frames, distortion_model, size):
    """Compressed lines, padded to one of few numbers of lines, and their frames among so many."""
    lines, line_frames, tracks = given.lines, given.line_frames, given.tracks
    if lines is None:
        if line_frames is not None:
            raise ValueError("Argument line_frames is for argument lines, which is not given.")
        return None, np.zeros(0, int)
    check("fit_motion with lines", distortion_model=distortion_model)
    if lines.image_size != tracks.image_size:
        raise ValueError(
            f"Argument lines is of images of {lines.image_size} px, but the tracks are of "
            f"{tracks.image_size} px."
        )
    frames = np.arange(tracks.frames) if line_frames is None else np.asarray(line_frames)
    whole = frames.dtype.kind in "iu" and frames.shape == lines.focal.shape
    if not whole or frames.min() < 0 or frames.max() >= tracks.frames:
        raise ValueError(
            f"Argument line_frames must say which of the {tracks.frames} frames of the tracks each of the "
            f"{len(lines.focal)} frames of the lines is, and it does not."
        )
    if np.unique(frames).size < frames.size:
        twice = np.flatnonzero(np.bincount(frames) > 1)[0]
        raise ValueError(
            f"Argument line_frames must name each frame of the tracks once, but {twice} is there "
            f"{np.sum(frames == twice)} times: lines of one frame are one frame of the lines."
        )
    middle = (np.array(tracks.image_size) - 1) / 2
    terms = distortion_model.expansion_terms(size)
    small = compress_any_centre(lines.about(middle), terms) if isinstance(lines, Lines) else lines
    if not np.allclose(small.centre, middle):
        raise ValueError("Argument lines must be compressed about the centre of the image, and it is not.")
    if small.terms < terms:
        raise ValueError(
            f"Argument lines is compressed for {small.terms} terms, but {terms} are needed: "
            f"compress_any_centre(lines, terms={terms})."
        )
    frame = frames[np.asarray(small.frame)]
    more = bucket(len(frame)) - len(frame)
    frame = np.pad(frame, (0, more))
    triangle = jnp.pad(small.triangle.astype(float), ((0, more), (0, 0), (0, 0)))
    weight = jnp.pad(_relative_weights(small), (0, more))
    ready = AnyCentreLines(
        triangle=triangle,
        frame=frame,
        focal=jnp.ones(padded_frames),  # nothing here depends on them
        centre=small.centre,
        image_size=small.image_size,
        focal_unit=small.focal_unit,
        weight=weight,
    )
    return ready, frame


def _relative_weights(lines):
    """Weights of lines, 1 in the mean over those of a frame that count."""
    if lines.weight is None:
        return jnp.ones(len(lines.frame))
    both = jnp.stack([lines.weight, 1.0 * (lines.weight > 0)], axis=1)
    sums = jax.ops.segment_sum(both, lines.frame, len(lines.focal))
    mean = (sums[:, 0] / jnp.maximum(sums[:, 1], 1))[lines.frame]
    return lines.weight / jnp.where(mean > 0, mean, 1)


def _first(tracks):
    """Of each frame the first that shows the same moment. Where points are traced, all is fitted before."""
    if traced(tracks.points):
        return np.arange(tracks.frames)
    return without_rests(originals(tracks), tracks)


def _neighbours(shot, first):
    """Of each frame, the frames before and after it that show something else in the same shot, or itself.

    Args:
        shot: number of each frame's shot.
        first: of each frame the first that shows the same moment.
    """
    frame = np.arange(len(shot))
    first = np.concatenate([first, frame[len(first) :]])
    last = np.searchsorted(first, first, side="right") - 1
    before, after = np.where(first > 0, first - 1, frame), np.where(last + 1 < len(shot), last + 1, frame)
    return np.stack([np.where(shot[to] == shot, to, frame) for to in (before, after)], axis=1)


def _groups(track, moment, frames, begin):
    """Of each frame the numbers of what tracks link, of its shot and of its scene; -1 without views.

    A track that is found again may go across a cut, but not from a frame to one that is near.
    """
    seen = np.bincount(moment, minlength=frames) > 0
    same = track[1:] == track[:-1]
    links = np.stack([moment[:-1][same], moment[1:][same]])
    apart = np.diff(np.cumsum(seen)[links], axis=0)[0]  # in frames with views: none is seen in the dark
    near, joined = apart <= _NEAR, links
    if begin is not None:
        shot, scene = np.asarray(begin.shot), np.asarray(begin.scene)
        one, other = shot[links]
        near &= (one == other) | (one < 0) | (other < 0)  # what it did not see is of no shot of its
        order = np.argsort(scene, kind="stable")
        follows = (np.diff(scene[order]) == 0) & (scene[order[1:]] >= 0)
        joined = np.concatenate([links, np.stack([order[:-1], order[1:]])[:, follows]], axis=1)
    return [_numbers(of, seen) for of in (links, links[:, near], joined)]


def _numbers(links, seen):
    """Numbers of the groups of frames that links join, in the order of their first; -1 where not seen."""
    matrix = scipy.sparse.coo_array((np.ones(links.shape[1]), (links[0], links[1])), (len(seen),) * 2)
    _, names = scipy.sparse.csgraph.connected_components(matrix, directed=False)
    _, first, place = np.unique(names[seen], return_index=True, return_inverse=True)
    number = np.full(len(seen), -1)
    number[seen] = np.argsort(np.argsort(first))[place]
    return number


def _block(track, moment, frames):
    """Frames that are coupled with one another: all of a short clip that has long tracks, or some."""
    _, first, number = np.unique(track, return_index=True, return_inverse=True)
    longest = int(np.max(moment - moment[first][number])) + 1
    return frames if frames <= LONGEST_LOOP and longest > _LONGEST else min(_LONGEST, frames)


def _pieces(track, moment, block):
    """Names of the tracks' pieces, each at most as long as a block, for each view."""
    _, first, number = np.unique(track, return_index=True, return_inverse=True)
    part = (moment - moment[first][number]) // block
    return np.unique(np.stack([track, part]), axis=1, return_inverse=True)[1].ravel()
