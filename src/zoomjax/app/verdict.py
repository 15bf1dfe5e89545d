"""The verdict on a calibration from photos: that of the fit, and what the photos say about themselves."""

import contextlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from .._core.text import listed, plain
from ..detect.batch import Detection
from ..detect.bend import bends_apart
from ..io.equipment import Equipment
from ..io.metadata import Metadata, squeezed, straightened_by
from ..io.photo import count_pages
from ..trust.assessment import Finding, Verdict
from ..trust.evidence import NEGLIGIBLE
from .calibration import Calibration
from .equipment import OTHER_CROP, OTHER_FOCAL, equipment_of, metadata_of
from .focal_sources import Focals
from .plane_focals import FocalGroup
from .tying import APART, bend_at

_MOST = 4
_SHAPE = 1.01
"""Ratio of the shapes of images that differ by more than rounding."""
_OTHER_ZOOM = 1.1
"""Ratio of ratios of focal lengths that differ by more than EXIF data are rounded to, or measured."""
_FEWEST = 3
"""Straight lines of a photo that can tell something."""
_UNPREDICTED = 1.5
"""How many times the RMS of a photo left out may exceed that of its own fit."""
_NOT_CHECKED = "not checked: the other photos do not determine the lens at its focal length"
_UNEXPLAINED = 0.5
"""Of the length of a photo's long smooth edges: lines that hold less are little of what there is."""


def findings_of_photos(photos: Iterable[Path], image_size: tuple[int, int]) -> list[Finding]:
    """What speaks against one lens having taken all photos in one way, and unchanged, by what they say.

    That is different bodies or lenses; sizes of other shapes, of which what is left was cropped; parts of
    the sensor of different size; distortion that a program has corrected; pixels that are not square.
    And what was left out of files of several pages. Photos that say nothing of it, or that cannot be read
    any more, count for nothing.
    """
    photos = list(photos)
    bodies, lenses, sizes = Counter[str](), Counter[str](), Counter[tuple[int, int]]()
    equipment = [equipment_of(photo) for photo in photos]
    for found in equipment:
        bodies.update(filter(None, [found.camera]))
        lenses.update(filter(None, [found.lens]))
        if found.written:
            sizes[max(found.written), min(found.written)] += 1
    of_camera = [*_mixed("lenses", lenses), *_mixed("cameras", bodies), *_reshaped(sizes)]
    of_camera += _of_other_parts(equipment, image_size)
    return [*of_camera, *_changed([metadata_of(photo) for photo in photos]), *_of_pages(photos)]


def findings_of_sizes(left_out: int, used: int) -> list[Finding]:
    """That photos were left out, being of another size than most: a remark, as they do no harm."""
    if not left_out:
        return []
    return [
        Finding(
            "other sizes",
            "good",
            f"{left_out} of {_photos(left_out + used)} are of another size than most and were left out.",
            "Use the photos as the camera stored them, and calibrate those of each size by themselves.",
        )
    ]


def findings_of_exif(
    detections: Iterable[Detection], focal: Mapping[str, float], *, in_mm: bool, measured: bool
) -> list[Finding]:
    """That focal lengths are not those of the photos' EXIF data.

    One factor common to all says nothing of those in px. In mm it counts from a quarter on, for photos are
    corrected at those of the EXIF data; less may be how the lens is focused.

    Args:
        detections: of the photos used.
        focal: what is used for them, by name.
        in_mm: whether it is known, and in mm.
        measured: whether it was measured from the photos: then how it differs among them says nothing.
    """
    ratio = {d.name: d.focal / focal[d.name] for d in detections if d.focal and d.name in focal}
    if not ratio:
        return []
    low, high = min(ratio, key=lambda name: ratio[name]), max(ratio, key=lambda name: ratio[name])
    apart = not measured and ratio[high] >= _OTHER_ZOOM * ratio[low]
    scaled = in_mm and (ratio[low] > OTHER_FOCAL or ratio[high] * OTHER_FOCAL < 1)
    if not apart and not scaled:
        return []
    known = sorted(ratio, key=lambda name: focal[name])
    pair = dict.fromkeys((low, high) if apart else (known[0], known[-1]))
    told = " and ".join(f"{plain(name)} {ratio[name] * focal[name]:.4g} mm" for name in pair)
    counts = " and ".join(dict.fromkeys(f"{focal[name]:.4g}" for name in pair))
    are = "are of other zooms" if len(pair) > 1 else "is of another zoom"
    do = "Check --focal, or leave it out: then the EXIF data count."
    if measured:
        do = "Check the board's measures: photos are corrected at the focal lengths of their EXIF data."
    return [
        Finding(
            "EXIF data",
            "doubtful",
            f"by their EXIF data {told} {are} than the focal lengths used say, {counts}.",
            do,
            cause=True,
        )
    ]


def findings_of_focals(focals: Focals) -> list[Finding]:
    """What speaks against focal lengths: what photos that share one give alone, if that is too far apart.

    And standard deviations that were given, if they are far smaller than those that they took the place of.
    """
    return [*_apart(focals), *_too_sure(focals)]


def _too_sure(focals: Focals) -> list[Finding]:
    names = [name for name in focals.instead if name in focals.deviation]
    given, own = (
        np.array([deviation[name] for name in names]) for deviation in (focals.deviation, focals.instead)
    )
    return findings_of_surer(given, own, unit=focals.unit, of=f"photos ({focals.origin})")


def findings_of_surer(given: np.ndarray, own: np.ndarray, *, unit: str, of: str) -> list[Finding]:
    """That standard deviations of focal lengths are given that are far smaller than those known before.

    Args:
        given: the standard deviations.
        own: those that they took the place of.
        unit: of both.
        of: what they are of, in words.
    """
    known = own > 0
    middle, before = (float(np.median(std[known])) if known.any() else 0.0 for std in (given, own))
    if middle * _SURER >= before:
        return []
    return [
        Finding(
            "focal lengths",
            "doubtful",
            f"their standard deviation was given as {middle:.3g} {unit}, in place of {before:.3g} {unit}, "
            f"in the middle of {known.sum()} {of}: bands may be too narrow.",
            "Leave --focal-sigma out.",
            cause=True,
        )
    ]


_SURER = 3
"""Ratio of standard deviations from which one is no other estimate of the same."""


def _apart(focals: Focals) -> list[Finding]:
    apart = [group for group in focals.groups if not group.agree]
    if not apart:
        return []
    worst = max(apart, key=FocalGroup.spread)
    others = {1: "", 2: " Another group disagrees, too."}
    more = others.get(len(apart), f" {len(apart) - 1} other groups disagree, too.")
    return [
        Finding(
            "shared focal lengths",
            "doubtful",
            worst.sentence(focals.unit) + more,
            "Check that the photos of a group were taken at one zoom, and that the board is flat.",
            cause=True,
        )
    ]


def findings_of_own_focals(options: str, verdict: Verdict) -> list[Finding]:
    """That photos may share focal lengths that each has by itself, where the verdict is not good.

    Args:
        options: that would say which photos do; empty if none would.
        verdict: on all that is known.
    """
    if not options or verdict == "good":
        return []
    return [
        Finding(
            "focal lengths of single photos",
            verdict,
            "each photo has a focal length of its own, by a homography of the board as if it was flat.",
            f"Say which photos are of one zoom: {options.rstrip(',')}.",
            cause=True,
        )
    ]


def findings_of_edges(detections: Iterable[Detection]) -> list[Finding]:
    """What speaks against the lines being those of the scene: strong long edges that are on none of them.

    A remark: foliage and round things have such edges, too.
    """
    shares = {d.name: d.unexplained for d in detections if d.unexplained is not None}
    many = {name: share for name, share in shares.items() if share > _UNEXPLAINED}
    if not many or 2 * len(many) < len(shares):
        return []
    worst = max(many, key=lambda name: many[name])
    of = "" if len(shares) == 1 else f" of {len(many)} of {_photos(len(shares))}"
    share = f"{many[worst]:.0%} in {plain(worst)}"
    return [
        Finding(
            "edges without lines",
            "good",
            f"more than half of the long smooth edges{of} are on no line: {share}.",
            "Check the detected lines: if straight edges have none, photograph a scene with fewer curves.",
        )
    ]


def verdict_of_photo(
    calibration: Calibration, frame: int, detection: Detection, rejected: np.ndarray
) -> tuple[Verdict, str]:
    """The verdict on one photo, and why: its lines left out, and whether it agrees with the lens of all.

    That on the only photo is that on the lens. Of a good photo that no other photo could contradict the
    reason says so.

    Args:
        calibration: of all photos.
        frame: the photo's number in it.
        detection: what was found in the photo.
        rejected: which of its lines were rejected.
    """
    if len(calibration.rms_uncorrected) == 1:
        of = calibration.assessment
        return of.verdict, "" if of.verdict == "good" else of.findings[0].found.rstrip(".")
    lens, kept = calibration.fit.lens, int((~rejected).sum())
    diagonal = float(np.hypot(*lens.image_size))
    if kept < _FEWEST:
        return "not determined", f"{kept} of its lines are straight: too few to say anything"
    if kept < rejected.sum():
        return "doubtful", f"{rejected.sum()} of its {len(rejected)} lines were rejected"
    joint, own = (float(of[frame]) for of in (calibration.rms_held_out, calibration.rms_frames_held_out))
    others = np.delete(np.asarray(calibration.lines.focal, float), frame)
    focal = float(np.asarray(calibration.lines.focal)[frame])
    if joint > _UNPREDICTED * own and joint > NEGLIGIBLE * diagonal / 2:
        how = "" if others.min() <= focal <= others.max() else ", extrapolated to its focal length,"
        leaves = f"the lens of the other photos{how} leaves {joint:.2g} px, its own lines {own:.2g} px"
        return "doubtful", leaves
    if detection.bend is not None:
        apart = bends_apart(lens.image_size, bend_at(lens, focal), detection.bend)
        if apart > APART * diagonal:
            return "doubtful", f"its own lines are bent by {apart:.2g} px differently from the lens"
    return "good", "" if np.isfinite(joint) else _NOT_CHECKED


def nothing_usable(detections: Sequence[Detection]) -> str:
    """The error message when no image can be used."""
    problems = Counter(d.problem.rstrip(".") for d in detections)
    if len(problems) == 1 and len(detections) > 1:
        return f"None of the {len(detections)} images can be used: {next(iter(problems))}."
    listed = "; ".join(f"{plain(d.name)}: {plain(d.problem)}" for d in detections[:4])
    more = f"; and {len(detections) - 4} more" if len(detections) > 4 else ""
    return f"None of the images can be used. {listed}{more}."


def _mixed(what: str, names: Counter[str]) -> Iterable[Finding]:
    if len(names) < 2:
        return
    first = listed((f"{plain(name)} ({_photos(number)})" for name, number in names.most_common()), _MOST)
    yield Finding(
        f"different {what}",
        "doubtful",
        f"the photos were taken with {len(names)} different {what}, by their EXIF data: {first}.",
        "Calibrate the photos of each lens and camera by themselves.",
        cause=True,
    )


def _reshaped(sizes: Counter[tuple[int, int]]) -> Iterable[Finding]:
    """Photos, now of one size, that the camera wrote in sizes of different shapes: some were cropped."""
    shapes = [width / height for width, height in sizes]
    if not shapes or max(shapes) < _SHAPE * min(shapes):
        return
    told = listed((f"{w} x {h} px ({_photos(number)})" for (w, h), number in sizes.most_common()), _MOST)
    yield Finding(
        "cropped photos",
        "doubtful",
        f"the camera wrote these photos in different shapes, by their EXIF data: {told}.",
        "Use the photos as the camera stored them: where a photo is cropped, the lens's centre moves.",
        cause=True,
    )


def _of_other_parts(photos: Sequence[Equipment], image_size: tuple[int, int]) -> Iterable[Finding]:
    """Photos, now of one size, that show parts of the sensor of different size."""
    zooms = [one.digital_zoom for one in photos if one.enlarged]
    crops = [crop for one in photos if (crop := one.crop_factor(image_size)) is not None]
    told = []
    if zooms and (len(zooms) < len(photos) or max(zooms) > _SHAPE * min(zooms)):
        told = [f"with digital zoom, up to {max(zooms):.3g}, for {len(zooms)} of {_photos(len(photos))}"]
    if crops and max(crops) > OTHER_CROP * min(crops):
        told.append(f"at crop factors of {min(crops):.3g} to {max(crops):.3g}")
    if told:
        yield Finding(
            "parts of the sensor",
            "doubtful",
            "by their EXIF data the photos show parts of the sensor of different size, as they were taken "
            f"{' and '.join(told)}.",
            "Calibrate the photos of each digital zoom and crop factor by themselves.",
            cause=True,
        )


def _changed(photos: Sequence[Metadata]) -> Iterable[Finding]:
    """Photos whose distortion was corrected before, and those whose pixels are not square."""
    programs = Counter(filter(None, map(straightened_by, photos)))
    if programs:
        told, number = listed(programs, _MOST), programs.total()
        yield Finding(
            "corrected photos",
            "doubtful",
            f"{number} of {_photos(len(photos))} say that their distortion was corrected before, "
            f"by {told}: the fitted lens is what remained.",
            "Switch that correction off, save the photos again, and calibrate from these.",
            cause=True,
        )
    shapes = Counter(filter(None, map(squeezed, photos)))
    if shapes:
        across, down = shapes.most_common(1)[0][0]
        yield Finding(
            "pixels that are not square",
            "doubtful",
            f"{shapes.total()} of {_photos(len(photos))} say that their pixels are not square, "
            f"{across:.4g} on {down:.4g}, but the model assumes the same distortion in all directions of "
            "the stored image.",
            "Scale the photos to square pixels first.",
            cause=True,
        )


def _of_pages(photos: Iterable[Path]) -> Iterable[Finding]:
    """Files of several photos, of which one was used: a remark, as they do no harm."""
    several: list[str] = []
    for photo in photos:
        with contextlib.suppress(OSError, ValueError):
            several += [photo.name] * (photo.suffix.lower() in (".tif", ".tiff") and count_pages(photo) > 1)
    if several:
        yield Finding(
            "further pages",
            "good",
            f"of the pages of {listed(map(plain, several), _MOST)} the first alone was used.",
            "Save each page as a photo of its own, with its focal length.",
        )


def _photos(number: int) -> str:
    return f"{number} photo" + "s" * (number != 1)
