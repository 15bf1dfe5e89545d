"""The verdict on a fit: good, doubtful or not determined, with what was found and what to do about it.

A lens is good if its correction is right to within a small part of itself. Three errors are compared with
the displacement (RMS over the image, at its largest): that of the noise (the bands), half the distance
between lenses fitted to halves of the lines where it exceeds what noise explains, and the error of frames
left out beyond that of their own fits. Vanishing points that ask for another correction make it doubtful.
An error below `NEGLIGIBLE` of the image's diagonal does no harm, however small the displacement; nor do
lines that were rejected for less. Between two or three focal lengths nothing contradicts a model: there it
is compared with what zoom lenses do (see `between`).

A tenth of a strong lens's displacement is much, and all of it may bend lines. So what the noise leaves
uncertain beyond a homography must be small in px of the image, too. Of one photo that alone counts: its
bands are those of lines, and the homography in them is no distortion.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from .._core.arguments import kinds_checked
from .._core.checks import points_beyond
from .._core.types import of_known_values
from ..fit.own_weights import own_weights
from ..fit.result import RESULTS, ZoomFit, is_status
from ..lines.base import AbstractLines
from ..lines.lines import Lines
from ..models.polynomial import RadialPolynomial
from ..models.zoom import AbstractPriorZoom
from .between import FEWEST_CHECKED, deviation_between, zoom_places
from .evidence import NEGLIGIBLE, UNSEEN_PX, Evidence, evidence
from .folds import focals_there

Verdict = Literal["good", "doubtful", "not determined"]

VERDICTS: tuple[Verdict, ...] = ("good", "doubtful", "not determined")
"""From the best to the worst."""

_DOUBTFUL, _UNDETERMINED = 0.1, 0.5  # errors, in displacements
_BEYOND_NOISE = 3.0  # how many times farther apart halves are than by chance
_UNPREDICTED = 1.5  # how many times the RMS of frames left out may exceed that of their own fits
_REJECTED = 1 / 3  # of the lines
_OUTSIDE = 0.01  # of the points
_FEW_LINES = 4  # per frame
_BENT_PX, _BENT = 0.4, 3.5e-4
"""How uncertain a good lens may be beyond a homography: px, a part of the diagonal, whichever is larger."""
_BENT_SHARE, _BENT_MOST = 0.03, 1e-3
"""A strong one by this part of what it straightens, up to this one of the diagonal."""
_UNPARALLEL, _SURE = 0.25, 4.0  # a factor's distance from 1 that counts: at least, and in deviations


@dataclasses.dataclass(frozen=True)
class Finding:
    """One thing that was found.

    Attributes:
        about: what it is about, in a word or two.
        verdict: the best verdict that it allows; "good" for a remark.
        found: a sentence with figures.
        advice: a sentence on what to do.
        cause: whether it says what is wrong with the photos, where others say what came of it.
    """

    about: str
    verdict: Verdict
    found: str
    advice: str
    cause: bool = False


@dataclasses.dataclass(frozen=True)
class Assessment:
    """The verdict on a fit.

    Attributes:
        findings: what was found: causes first, then the worst.
        evidence: what it was found in.
    """

    findings: tuple[Finding, ...]
    evidence: Evidence

    @property
    def verdict(self) -> Verdict:
        """The worst of the findings' verdicts; "good" if there are none."""
        return VERDICTS[max((VERDICTS.index(finding.verdict) for finding in self.findings), default=0)]

    @property
    def sentence(self) -> str:
        """The verdict and its main reason."""
        if self.verdict == "good":
            return (
                f"Good: the correction moves points by {_px(self.evidence.displacement)} px (RMS), "
                f"with a standard deviation of {_px(self.evidence.std)} px. Apart from a change of view it "
                f"is uncertain by {_px(self.evidence.bent_std)} px of the image."
            )
        return f"{self.verdict.capitalize()}: {self.findings[0].found}"

    def joined_by(self, findings: Sequence[Finding]) -> "Assessment":
        """The assessment with further findings."""
        ranked = sorted(
            [*self.findings, *findings], key=lambda of: (not of.cause, -VERDICTS.index(of.verdict))
        )
        return dataclasses.replace(self, findings=tuple(ranked))

    def summary(self) -> dict[str, Any]:
        """The verdict, its findings and figures as plain values; None for what is not known."""
        figures = dataclasses.asdict(self.evidence, dict_factory=_known)
        return {
            "verdict": self.verdict,
            "verdict_sentence": self.sentence,
            "findings": [dataclasses.asdict(finding) for finding in self.findings],
            "evidence": figures,
        }


def _known(figures: list[tuple[str, Any]]) -> dict[str, Any]:
    """Figures by name; None for what is not finite."""
    return {
        name: None if isinstance(value, float) and not np.isfinite(value) else value
        for name, value in figures
    }


@kinds_checked
@of_known_values
def assess(
    lines: Lines,
    fit: ZoomFit,
    *,
    compressed: AbstractLines | None = None,
    rms_held_out: Float[np.ndarray, "frame"] | None = None,
    rms_frames_held_out: Float[np.ndarray, "frame"] | None = None,
) -> Assessment:
    """Judge a fit.

    Args:
        lines: the lines of the fit, with their points and weights.
        fit: the fit.
        compressed: the same lines compressed for the fit's distortion model, if they are at hand.
        rms_held_out, rms_frames_held_out: from `cross_validate_zoom` and `cross_validate_frames`, if they
            are to be compared. Of one frame the second alone is.

    Raises:
        ValueError: as `evidence`; or there is not one number a frame in these two, or one of them alone.

    Example:
        >>> from zoomjax import compress, fit_zoom, scenes
        >>> focal = scenes.focal_sweep(4)
        >>> lines = scenes.board_lines(scenes.nikkor_18_200(), focal, spacing=99, noise=0.5)
        >>> assess(lines, fit_zoom(compress(lines))).verdict
        'good'
    """
    for name, values in {"rms_held_out": rms_held_out, "rms_frames_held_out": rms_frames_held_out}.items():
        if values is not None and np.shape(values) != np.shape(lines.focal):
            raise ValueError(
                f"Argument {name} must hold one number for each of the {len(lines.focal)} frames, but its "
                f"shape is {np.shape(values)}."
            )
    if (rms_held_out is None) != (rms_frames_held_out is None):
        raise ValueError(
            "Arguments rms_held_out and rms_frames_held_out are compared: give both, or neither."
        )
    found = evidence(lines, fit, compressed=compressed)
    places = zoom_places(focals_there(lines))
    counting = np.asarray(lines.mask) & (own_weights(lines) > 0)[:, None]
    findings = [
        *_of_bands(found, fit, len(places)),
        *_of_halves(found),
        *_of_lines(found),
        *_of_vanishing(found),
        *findings_outside(np.asarray(lines.points), counting, lines.image_size),
    ]
    findings += _of_places(found, fit, places)
    if rms_held_out is not None and rms_frames_held_out is not None:
        both = (np.asarray(values, float) for values in (rms_held_out, rms_frames_held_out))
        focal = np.asarray(lines.focal, float)
        findings += _of_one_frame(found, float(np.nansum(rms_frames_held_out)))
        findings += _of_frames(found, np.where(np.isin(focal, focals_there(lines)), focal, np.nan), *both)
    return Assessment((), found).joined_by(findings)


def findings_outside(points: np.ndarray, mask: np.ndarray, size: tuple[int, int]) -> list[Finding]:
    """That points, (x, y) last, lie outside of the image: its size is wrong, so centre and scale are."""
    share = points_beyond(points, mask, size)[1].sum() / max(mask.sum(), 1)
    if share <= _OUTSIDE:
        return []
    found = f"{share:.0%} of the points lie outside of the image of {size[0]} x {size[1]} px."
    advice = "Check the size of the images, width first, and that x and y of the points are not exchanged."
    return [Finding("points outside", "doubtful", found, advice, cause=True)]


def _judged(error: float, of: Evidence) -> Verdict:
    """What an error of the displacement, px, allows."""
    if not np.isfinite(error):
        return "not determined"
    if error <= NEGLIGIBLE * of.diagonal or error <= _DOUBTFUL * of.raster_displacement:
        return "good"
    return "doubtful" if error <= _UNDETERMINED * of.raster_displacement else "not determined"


def _is_bent(of: Evidence) -> bool:
    """Whether what is uncertain beyond a homography may be seen, or is much of what is straightened."""
    if of.bent_std <= max(UNSEEN_PX, NEGLIGIBLE * of.diagonal):
        return False
    strong = min(_BENT_SHARE * of.bent, _BENT_MOST * of.diagonal)
    most = max(_BENT_PX, _BENT * of.diagonal, strong)
    return not of.bent_std <= (most if of.frames > 1 else min(most, _DOUBTFUL * of.bent))


def _of_bands(of: Evidence, fit: ZoomFit, places: int) -> Iterator[Finding]:
    more = "Add photos with long straight lines near the edges of the image"
    more += ", at several focal lengths." if of.frames > 1 else "."
    if is_status(fit.result, RESULTS.folded):
        yield Finding(
            "fold",
            "not determined",
            "the corrected image folds over.",
            "Add lines near the corners, or choose a smaller degree or fewer terms.",
        )
    if not np.isfinite([of.std, of.bent_std]).all():
        yield Finding("bands", "not determined", "the lines do not determine the correction.", more)
    elif of.frames > 1 and (verdict := _judged(of.raster_std, of)) != "good":
        found = (
            f"the correction moves points by {_px(of.displacement)} px (RMS), but is uncertain by "
            f"{_px(of.std)} px."
        )
        if 1 < places < FEWEST_CHECKED and isinstance(fit.lens.zoom, AbstractPriorZoom):
            more += (
                f" Between these {places} focal lengths the correction is that of other zoom lenses which "
                "agree with it there."
            )
        yield Finding("bands", verdict, found, more)
    elif _is_bent(of):
        but = f"is uncertain by {_px(of.bent_std)} px in that."
        if of.to_centre:
            but = (
                f"lines are straighter about a centre of distortion that is {_px(of.to_centre)} px away, "
                f"which changes {_px(of.bent_std)} px of that."
            )
            more = (
                "Have the centre fitted, with a radial or the division model: cropped images have it off "
                "their middle. If it comes out nowhere near, the lines are bent."
            )
        yield Finding(
            "bending",
            "doubtful" if of.bent_std <= _UNDETERMINED * of.bent else "not determined",
            f"the correction straightens what is bent by {_px(of.bent)} px (RMS), but {but}",
            more,
            cause=of.to_centre > 0,
        )
    if of.lines < _FEW_LINES * of.frames:
        yield Finding(
            "few lines",
            "doubtful",
            f"there are only {of.lines} usable lines in {of.frames} photo{'s' * (of.frames > 1)}, fewer "
            f"than {_FEW_LINES} each.",
            "Photograph a scene with more straight lines, or try another detector.",
        )


_PARTED = {
    "lines": (
        "two halves of the lines give different corrections",
        "Some lines are not straight in the scene, or too few determine the lens: look at the drawn lines.",
    ),
    "directions": (
        "steep and flat lines give different corrections",
        "Check that what was photographed is straight and flat: a board may be bent, a cup is round.",
    ),
    "frames": (
        "two halves of the photos give different corrections",
        "Check that all photos come from one lens, and that their focal lengths are right.",
    ),
}


def _of_halves(of: Evidence) -> Iterator[Finding]:
    for halves in of.halves:
        error = halves.apart / 2
        if halves.excess <= _BEYOND_NOISE or (verdict := _judged(error, of)) == "good":
            continue
        if halves.parting == "directions" and not of.crooked:
            verdict = "good"  # what either direction tells alone, the lines of both do not contradict
        found, advice = _PARTED[halves.parting]
        yield Finding(
            f"halves by {halves.parting}",
            verdict,
            f"{found}, {_px(halves.apart)} px apart where noise explains {_px(halves.expected)} px.",
            advice,
        )


def _of_lines(of: Evidence) -> Iterator[Finding]:
    if of.astray > _REJECTED * (of.lines + of.rejected):
        yield Finding(
            "rejected lines",
            "doubtful",
            f"{of.rejected} of {of.lines + of.rejected} lines were rejected as not straight.",
            "Check the detected lines: if they follow straight things, photos of two lenses may be mixed.",
        )
    if not of.crooked:
        return
    found = (
        f"corrected lines deviate by {_px(of.rms)} px from straight ones, while their points scatter by "
        f"{_px(of.noise)} px only."
    )
    hardly = of.rms_uncorrected < 2 * of.rms
    yield Finding(
        "crooked lines",
        "doubtful" if hardly else "good",
        found[:-1] + (f"; uncorrected, by {_px(of.rms_uncorrected)} px." if hardly else "."),
        "Check that the photographed lines are straight and the board is flat; else choose a larger model.",
    )


def _of_vanishing(of: Evidence) -> Iterator[Finding]:
    """Vanishing points that ask for another correction by far: things are parallel only roughly."""
    other = of.vanishing
    if not abs(other.factor - 1) > max(_UNPARALLEL, _SURE * other.std):
        return
    if _judged(abs(other.factor - 1) * of.raster_displacement, of) == "good":
        return
    yield Finding(
        "vanishing points",
        "doubtful",
        f"{other.lines} lines meet in {other.points} vanishing points, but best with {other.factor:.2f} "
        f"\u00b1 {other.std:.2g} times the correction.",
        "Check the detected lines: lines of different things may have become one. Add long lines near the "
        "edges of the image.",
    )


def _of_places(of: Evidence, fit: ZoomFit, places: np.ndarray) -> Iterator[Finding]:
    """A model that was measured at two or three places in the zoom, and has no prior, or one for others."""
    if not 1 < len(places) < FEWEST_CHECKED or not np.isfinite(of.std):
        return
    number, unit = len(places), fit.lens.focal_unit
    if isinstance(fit.lens.zoom, AbstractPriorZoom):
        if not isinstance(fit.lens.distortion_model, RadialPolynomial):
            yield Finding(
                "few focal lengths",
                "doubtful",
                f"lines are at {number} focal lengths only; between them the prior is for weaker lenses.",
                "Add photos at focal lengths between them, four in all or more.",
            )
        return
    deviation, focal = deviation_between(fit.lens, places)
    if (verdict := _judged(deviation, of)) == "good":
        return
    yield Finding(
        "few focal lengths",
        verdict,
        f"lines are at {number} focal lengths only; between them, at {focal:.4g} {unit}, other zoom lenses "
        f"with that distortion there are {_px(deviation)} px (RMS) from the model.",
        "Add photos at focal lengths between them, or choose the model smooth, whose bands allow for that.",
    )


def _of_frames(of: Evidence, focal: np.ndarray, zoom: np.ndarray, each: np.ndarray) -> Iterator[Finding]:
    """Frames left out and their own fits, but not those at the ends of the zoom, which are extrapolated."""
    inner = (focal > np.nanmin(focal)) & (focal < np.nanmax(focal)) & np.isfinite(zoom) & np.isfinite(each)
    if inner.sum() < 2:
        return
    joint, own = (float(np.sqrt(np.mean(values[inner] ** 2))) for values in (zoom, each))
    if joint > _UNPREDICTED * own and joint > NEGLIGIBLE * of.diagonal / 2:
        yield Finding(
            "photos left out",
            "doubtful",
            f"the model leaves {_px(joint)} px in photos that it was not fitted to, but {_px(own)} px in "
            "each photo by itself.",
            "Check that all photos come from one lens with the right focal lengths, or try another model.",
        )


def _of_one_frame(of: Evidence, each: float) -> Iterator[Finding]:
    """Lines of a single photo that no other line makes straighter: there is no lens in them.

    Where what is uncertain does no harm, there may be nothing to straighten.
    """
    if of.frames > 1 or of.bent_std <= max(UNSEEN_PX, NEGLIGIBLE * of.diagonal):
        return
    if each >= of.rms_uncorrected:
        yield Finding(
            "lines left out",
            "not determined",
            f"lines that were left out of the fit deviate by {each:.3g} px corrected, and by "
            f"{of.rms_uncorrected:.3g} px as they are.",
            "Check the detected lines: do they follow straight things? Photograph long ones, near the "
            "border of the image.",
        )


def _px(value: float) -> str:
    return f"{value:.0f}" if 100 <= value < 1e6 else f"{value:.2g}"
