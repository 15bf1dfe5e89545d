"""What a clip cannot tell, with what to do about it: the findings of a calibration from motion."""

import re
from collections.abc import Iterator, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from ..fit.contradiction import OTHER_LENS
from ..fit.losses import CAUCHY, IGNORED
from ..fit.motion import MotionFit
from ..fit.result import RESULTS
from ..models.lens import ZoomLens
from ..tracks.tracks import Tracks
from ..trust.assessment import NEGLIGIBLE, VERDICTS, Finding, findings_outside
from ..trust.evidence import UNSEEN_PX
from .frame_findings import BLIND, of_blind, of_dissolves, of_repeated

_LOOSE_SCALE = 0.01
"""Standard deviation of the common factor of focal lengths, relative, from which it is worth a word."""

_NO_WORSE = 3.0
"""Times the standard deviation of a known focal length, up to which the scale is as good as that: it grows
with all others where residuals are not those of noise alone."""

_NO_SCALE = 0.1
"""From here on it is not known."""

_ROUGH, _WRONG = 0.8, 1.2
"""px, of the noise of points: two and three times what the way of a point there and back may miss, so that
more is hardly noise. Much moves by itself, or what is seen is no camera that turns."""

_UNCERTAIN = 0.1
"""How uncertain a good lens may be in what it does to a corner, beside that."""

_MOST = 5e-4
"""And beside the diagonal of the image, however strong the lens is: a pixel of 1080p."""

_FEW = 0.3  # of the views that do follow it: below, most of what is seen may move by itself
# Of the views that follow, the share for which the loss hardly flattens: 0.94 of noise alone. Where four of
# five points are on things that move, what these are off is taken for noise, and the share is 0.7 to 0.76.
_CLOSE = 0.77
_HARMLESS = 5e-4  # of the pupil's offset over distances: its standard deviation, by the test
_FAR_OFF = 4.0  # standard deviations of a known focal length that are no chance
_LEAST_ZOOM = 1.2  # between the ends of the focal lengths


def findings_of_motion(
    fit: MotionFit,
    tracks: Tracks,
    known: tuple[np.ndarray, np.ndarray] | None = None,
    *,
    numbers: np.ndarray | None = None,
) -> list[Finding]:
    """What the clip cannot tell, with what to do about it: the worst first; empty if all is good.

    Args:
        fit: the lens and the path.
        tracks: what was followed.
        known: of each frame the focal length that was known, NaN where it was not, and its standard
            deviation.
        numbers: of frames, in the file; by default they are counted.
    """
    numbers = np.arange(tracks.frames) if numbers is None else numbers
    found = [
        *_of_turning(fit, known),
        *_of_parts(fit, numbers),
        *_of_known(fit, known),
        *_of_zooming(fit),
        *_of_points(fit, tracks),
        *_of_lens(fit),
        *_of_cuts(fit),
        *of_dissolves(tracks, follows(fit, tracks), np.asarray(fit.shot), numbers),
        *of_repeated(tracks),
        *of_blind(fit, numbers),
        *findings_outside(np.asarray(tracks.points), np.asarray(tracks.mask), tracks.image_size),
    ]
    return sorted(found, key=lambda of: -VERDICTS.index(of.verdict))


def with_contradictions(found: Sequence[Finding], contradicted: Sequence[str]) -> list[Finding]:
    """Findings, and what warnings of `fit_motion` say to be contradicted.

    That is that known focal lengths give all another scale, and that shots have different lenses.
    """
    told = [_of_other_lens(of) if of.startswith(OTHER_LENS) else _of_other_scale(of) for of in contradicted]
    once = {of.about: of for of in reversed(told)}  # of a clip that is fitted twice
    return sorted([*once.values(), *found], key=lambda of: -VERDICTS.index(of.verdict))


def _of_other_scale(warning: str) -> Finding:
    found = _begun(warning.partition(" Check")[0])
    todo = "Check --known-focal, --focal-unit and --pixel-pitch, or leave them out."
    return Finding("known focal lengths", "doubtful", found, todo)


def _of_other_lens(warning: str) -> Finding:
    found = _begun(warning.partition(" Fit ")[0])
    of_shot = re.search(r"frames (\d+) to (\d+)", found)
    assert of_shot is not None
    first, last = of_shot.groups()
    return Finding(
        "different lenses",
        "doubtful",
        found,
        "Calibrate the shots of each camera and lens by themselves, or each shot if there is one only, cut "
        f"as by ffmpeg -i CLIP -vf trim=start_frame={first}:end_frame={int(last) + 1},setpts=PTS-STARTPTS "
        "-an -crf 10 SHOT.mp4.",
    )


def _begun(sentence: str) -> str:
    """As it stands after a colon."""
    return sentence[0].lower() + sentence[1:]


def following(fit: MotionFit, tracks: Tracks) -> float:
    """The share of the views that follow the model: the rest are on things that move, or mistakes.

    Views that did not count in the fit, as of weight 0, do not count here.
    """
    missed = _missed(fit, tracks)
    return float(np.mean(missed < IGNORED, where=np.isfinite(missed)))


def follows(fit: MotionFit, tracks: Tracks) -> Bool[np.ndarray, "view"]:
    """Which of the views follow the model."""
    return _missed(fit, tracks) < IGNORED


def scale_std(fit: MotionFit) -> float:
    """Standard deviation of the factor common to all focal lengths, relative."""
    variance = float(fit.covariance[-1, -1])
    return float(np.sqrt(variance)) if variance >= 0 else np.nan


def is_relative(fit: MotionFit) -> bool:
    """Whether no focal length has a scale, so that only their ratios are known."""
    return (
        bool(fit.fit.result == RESULTS.undetermined) or not _own_scales(fit).min(initial=np.inf) < _NO_SCALE
    )


def _own_scales(fit: MotionFit) -> Float[np.ndarray, "known"]:
    """Standard deviations of the focal lengths that are known, relative."""
    ratio = np.asarray(fit.focal_std) / np.asarray(fit.focal)
    return ratio[np.isfinite(ratio)]


def _missed(fit: MotionFit, tracks: Tracks) -> np.ndarray:
    """Of each view, what it is off over where the loss begins to flatten; NaN of weight 0."""
    residual, weight = np.asarray(fit.residual)[np.asarray(tracks.mask)], tracks.view_weights()
    residual = residual if weight is None else np.sqrt(weight) * residual
    return residual / (CAUCHY * float(fit.noise))


_TURN = "turn the camera by some 10 degrees or more while it zooms."

_TELL = (
    "Give the focal length of one frame: --known-focal 24@0 --pixel-pitch 0.0055 if it is 24 mm in frame 0 "
    f"and pixels are 0.0055 mm apart, or --known-focal 4364@0 --focal-unit px. Or film again and {_TURN}"
)


def _of_turning(fit: MotionFit, known: tuple[np.ndarray, np.ndarray] | None) -> Iterator[Finding]:
    given = 0.0 if known is None else _together(fit, known)[1]
    if fit.fit.result not in (RESULTS.successful, RESULTS.undetermined):
        message = RESULTS[fit.fit.result]
        again = "Film a scene at rest again, and turn slowly."
        yield Finding("fit", "not determined", message[:1].lower() + message[1:], again)
    elif is_relative(fit):
        straight = " Lens and track together straighten the clip all the same." * (not [*_of_lens(fit)])
        yield Finding(
            "turning",
            "not determined",
            "the camera hardly turns, so the scale of the focal lengths is not determined: only their "
            f"ratios are.{straight}",
            _TELL
            if known is None
            else f"Give a focal length that is known better, one in each shot, or film again and {_TURN}",
        )
    elif scale_std(fit) > max(_LOOSE_SCALE, _NO_WORSE * given):
        yield Finding(
            "scale",
            "doubtful",
            f"all focal lengths have a common factor that is known to {scale_std(fit):.1%} only.",
            "Turn the camera farther while it zooms, or give the f of a frame with --known-focal."
            if known is None
            else "Turn the camera farther while it zooms, or give a focal length that is known better.",
        )


def _of_parts(fit: MotionFit, numbers: np.ndarray) -> Iterator[Finding]:
    """Scenes whose focal lengths have a looser scale than others, as nothing but the lens links them."""
    focal, std, scene = (np.asarray(of) for of in (fit.focal, fit.focal_std, fit.scene))
    seen = np.isfinite(focal) & (scene >= 0)
    scenes = np.unique(scene[seen])
    own = np.array([np.median((std / focal)[seen & (scene == number)]) for number in scenes.tolist()])
    loose = ~(own <= _LOOSE_SCALE)
    if is_relative(fit) or not loose.any() or loose.all():
        return
    frames = np.flatnonzero(seen & np.isin(scene, scenes[loose]))
    worst = float(np.max(np.nan_to_num(own, nan=np.inf)))
    open_ = not worst < _NO_SCALE
    known = "is not determined" if open_ else f"is known to {worst:.1%} only"
    yield Finding(
        "turning",
        "not determined" if open_ and len(frames) > BLIND * np.sum(seen) else "doubtful",
        f"in {len(frames)} of the frames, the first of them {numbers[frames[0]]}, the camera hardly turns, "
        f"and cuts part them from the others: the scale of their focal lengths {known}.",
        "Cut these frames off, or give the focal length of one in each such shot (--known-focal).",
    )


def _of_known(fit: MotionFit, known: tuple[np.ndarray, np.ndarray] | None) -> Iterator[Finding]:
    if known is None:
        return
    focal, given, std = np.asarray(fit.focal), *known
    unseen = np.flatnonzero(np.isfinite(given) & ~np.isfinite(focal))
    if len(unseen):
        yield Finding(
            "known focal lengths",
            "good",
            f"{len(unseen)} of the frames whose f is given show nothing that can be followed.",
            "Give the f of another frame: theirs has no effect.",
        )
    off = np.nan_to_num(np.abs(np.log(focal / given)) / (std / given))
    if off.max() > _FAR_OFF:
        worst = int(np.argmax(off))
        yield Finding(
            "known focal lengths",
            "doubtful",
            f"motion and lines say {focal[worst]:.5g} px where {given[worst]:.5g} px is given, "
            f"{off[worst]:.2g} of its standard deviations away: it takes all focal lengths along.",
            "Leave out known focal lengths that are wrong, or give them a larger sigma (--focal-sigma).",
        )

    mean, sigma = _together(fit, known)
    if abs(mean) > _FAR_OFF * sigma and off.max() <= _FAR_OFF:
        yield Finding(
            "known focal lengths",
            "doubtful",
            f"motion and lines say that f is {abs(mean):.1%} {'longer' if mean > 0 else 'shorter'} than "
            f"what is known of {np.sum(np.isfinite(given))} frames, {abs(mean) / sigma:.2g} standard "
            "deviations of all of it together: it takes all focal lengths along.",
            "Leave out known focal lengths, or give them a larger sigma (--focal-sigma).",
        )


def _together(fit: MotionFit, known: tuple[np.ndarray, np.ndarray]) -> tuple[float, float]:
    """The mean of log f over what is known of it, by its weights, and the deviation of what is known."""
    focal, given, std = np.asarray(fit.focal), *known
    off, weight = np.log(focal / given), (given / std) ** 2
    seen = np.isfinite(off) & (weight > 0)
    if not seen.any():
        return 0.0, np.inf
    total = float(np.sum(weight[seen]))
    return float(np.sum((weight * off)[seen])) / total, total**-0.5


def _of_zooming(fit: MotionFit) -> Iterator[Finding]:
    low, high = (float(f) for f in fit.lens.focal_range)
    if high < _LEAST_ZOOM * low:
        yield Finding(
            "zoom",
            "good",
            f"the focal length hardly changes, {low:.0f} to {high:.0f} px: this is one zoom only.",
            "Zoom while you film, if the lens is to be known at other focal lengths.",
        )


def _of_points(fit: MotionFit, tracks: Tracks) -> Iterator[Finding]:
    missed = _missed(fit, tracks)
    if (share := following(fit, tracks)) < _FEW:
        yield Finding(
            "moving things",
            "not determined",
            f"only {share:.0%} of the tracked points move as a camera that turns makes them: much in "
            "the clip moves by itself, or the camera does not stand still.",
            "Use a tripod, and film a scene at rest.",
        )
    elif (close := float(np.mean(missed[missed < IGNORED] < 1))) < _CLOSE:
        yield Finding(
            "moving things",
            "doubtful",
            f"only {close:.0%} of the points that follow the camera do so as closely as noise lets "
            "them: many may be on things that move.",
            "Use a tripod, and film a scene at rest.",
        )
    yield from _of_parallax(fit)
    if (noise := float(fit.noise)) > _ROUGH:
        yield Finding(
            "noise",
            "doubtful" if noise <= _WRONG else "not determined",
            f"points are off the model by {noise:.2f} px: the clip is blurred, much in it moves by "
            "itself, or things near the camera shift as it turns.",
            "Turn more slowly, and film a scene at rest.",
        )


def _of_parallax(fit: MotionFit) -> Iterator[Finding]:
    if (spread := float(fit.lever_std)) > 0 and not is_relative(fit):  # else it may be the lens
        yield Finding(
            "parallax",
            "doubtful" if float(fit.parallax) > _HARMLESS else "good",
            "near points move differently from far ones as the camera turns, by a share of "
            f"{spread:.2%}: its entrance pupil is off the axis of rotation. That is modelled, but the "
            "part that all points share looks like a lens, and is assumed: focal lengths may be off by "
            "once or twice that share, and the lens with them. The bands allow for that.",
            "Turn the camera about its entrance pupil, or film what is farther away.",
        )


_LINES = "Let straight lines in the frames help (--lines)"
_MORE_LINES = "Film more and longer straight lines near the borders of the image"


def _of_lens(fit: MotionFit) -> Iterator[Finding]:
    if fit.fit.result not in (RESULTS.successful, RESULTS.undetermined):  # which is said
        return
    moved, std = (float(np.max(np.abs(of))) for of in own_corner(fit))
    diagonal = float(np.hypot(*fit.lens.image_size))
    unseen, most = max(UNSEEN_PX, NEGLIGIBLE * diagonal), _MOST * diagonal
    if std <= max(unseen, min(_UNCERTAIN * moved, most)):
        return
    yield Finding(
        "lens",
        "doubtful" if std <= max(moved, most) else "not determined",  # or NaN
        f"the correction moves a corner of the image by up to {moved:.2g} px, but is uncertain by "
        f"{f'{std:.2g} px' if np.isfinite(std) else 'more than that'} there.",
        f"{_LINES if np.isnan(float(fit.line_noise)) else _MORE_LINES}, or turn farther before detail up "
        "to the corners.",
    )


def own_corner(fit: MotionFit) -> tuple[np.ndarray, np.ndarray]:
    """How far the correction moves a corner outwards at both ends of the zoom and in its middle, px.

    Returns:
        The displacements and their standard deviations: those of frames with such an f, which has errors
        in common with the lens. Where all f are too long by a factor, so are those that the lens is for.
    """
    low, high = (float(f) for f in fit.lens.focal_range)
    covariance = np.delete(np.delete(np.asarray(fit.covariance), -2, 0), -2, 1)  # without the readout
    moved, by = _corner(fit.lens, jnp.array([low, np.sqrt(low * high), high]))
    variance = np.einsum("fi,ij,fj->f", by, covariance, by)
    return np.asarray(moved), np.sqrt(np.where(variance >= 0, variance, np.nan))


@eqx.filter_jit
def _corner(lens: ZoomLens, focal: Float[Array, "focal"]) -> tuple[Array, Array]:
    """Displacements, and their derivatives by the lens's parameters and by the logarithm of all f."""
    parts = lens.zoom.parameters, None if lens.shift is None else lens.shift.parameters
    start, unravel = ravel_pytree(parts)

    def moved(flat):
        zoom, shift = unravel(flat[:-1])
        other = eqx.tree_at(lambda lens: lens.zoom.parameters, lens, zoom)
        if lens.shift is not None:
            other = eqx.tree_at(lambda lens: lens.shift.parameters, other, shift)

        def one(f):
            distortion = other(f)
            ahead = distortion.undistort(jnp.zeros(2)) - distortion.centre
            return jnp.linalg.norm(ahead) - jnp.linalg.norm(distortion.centre)

        return jax.vmap(one)(focal * jnp.exp(flat[-1]))

    flat = jnp.append(start, 0.0)
    return moved(flat), jax.jacfwd(moved)(flat)


def _of_cuts(fit: MotionFit) -> Iterator[Finding]:
    shots, scenes = (int(np.max(np.asarray(of))) + 1 for of in (fit.shot, fit.scene))
    if shots > 1:
        told = "All shots show one scene, and are joined. They share one lens."
        if scenes > 1:
            told = (
                f"Its {shots} shots show {scenes} scenes. They share one lens, but how the camera "
                "turned between scenes is not known; the panorama is of the longest."
            )
        yield Finding(
            "cuts",
            "good",
            f"the clip has {shots - 1} cut{'s' * (shots > 2)}. {told}",
            "Check that all of them were filmed with the same lens.",
        )
