"""The focal length of each image, from the best available source.

Sources are EXIF data, a table, a number, or the images themselves: a board parallel to the sensor at a
known distance (eq. 14), or oblique views of a flat grid or of a football pitch (Zhang's constraints). These
need corrected points, and the correction is not known yet. So points are corrected twice: first without
focal lengths, by a separate fit of each image (of a pitch, which has few lines, by one fit of all), then by
the zoom model fitted with the focal lengths found.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._core.fields import without_rounding
from .._core.types import AnyArray
from ..detect.batch import Detection
from ..fit.frames import fit_frames
from ..fit.robust import fit_robust
from ..focal.estimate import FocalEstimate
from ..focal.pitch import focal_from_pitch, name_pitch_lines
from ..io.focal_table import read_focal_table
from ..io.focal_track import read_focal_track
from ..io.text_table import has_columns, plain_number, read_text_table
from ..lines.compressed import compress
from ..lines.lines import Lines
from ..models.distortion import Distortion
from ..models.zoom import PolynomialZoom
from .board_focals import NOT_THE_BOARD, Board, check_board, focal_of_board
from .plane_focals import MOST_UNCERTAIN, ONE_ZOOM, FocalGroup, Found, Sharing, focals_from_grids
from .relative import is_relative_track

SOURCES = (
    "one focal length for all (--focal 24), which need not be known (--focal same); a CSV file with the "
    "columns image,focal (--focal focal.csv); "
    "EXIF data in the photos (--focal exif); a board parallel to the sensor (--focal board --spacing MM "
    "--distance MM --pixel-pitch MM); oblique photos of a flat checkerboard or dot grid (--focal plane); "
    "or markings of a football pitch (--focal pitch)"
)

_VIDEO_SOURCES = (
    "one focal length, a CSV file with time,focal or frame,focal, motion, or plane, board or pitch as for "
    "photos"
)

MEASURED = ("plane", "board", "pitch")
"""Sources that are the images themselves."""


@dataclasses.dataclass(frozen=True)
class Focals:
    """Focal lengths of images.

    Attributes:
        focal: focal lengths by the images' names; images without one are missing.
        unit: "mm" or "px".
        origin: the source of the focal lengths, in words.
        absent: why an image may have no focal length.
        deviation: standard deviations by name, where known: estimated from images, or given.
        groups: the images that share a focal length.
        known: whether they are: of one zoom alone, one millimetre may stand for what nobody knows.
        one_zoom: whether all images are of one zoom, where nothing says so: True where that is supposed,
            False where they contradict it, None where it is not asked.
        instead: the standard deviations that given ones took the place of.
    """

    focal: dict[str, float]
    unit: str
    origin: str
    absent: str
    deviation: dict[str, float] = dataclasses.field(default_factory=dict)
    groups: tuple[FocalGroup, ...] = ()
    known: bool = True
    one_zoom: bool | None = None
    instead: dict[str, float] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        same = without_rounding(np.array([*self.focal.values()], float))
        object.__setattr__(self, "focal", dict(zip(self.focal, same.tolist(), strict=True)))

    def deviating_by(self, deviation: dict[str, float]) -> "Focals":
        """The same with other standard deviations."""
        groups = (dataclasses.replace(group, std=deviation[group.names[0]]) for group in self.groups)
        return dataclasses.replace(self, deviation=deviation, groups=tuple(groups), instead=self.deviation)

    def absence(self, detection: Detection) -> str:
        """Why an image has no focal length."""
        return _TOO_FRONTAL if self.absent == _NO_PLANE and detection.nodes is not None else self.absent

    def number_of_group(self, name: str) -> int:
        """Of an image: the number of its group, from 0; -1 where it has a focal length of its own."""
        return next((n for n, group in enumerate(self.groups) if name in group.names), -1)


def check_source(source: str | None, board: Board | None, *, video: bool) -> None:
    """Check a focal source before any image is read.

    Raises:
        FileNotFoundError: there is no such CSV file.
        ValueError: the source is unknown or incomplete; the message lists the sources.
    """
    if source == "board" or (source is None and board):
        if board is None:
            raise ValueError(_NO_BOARD)
    elif video and source in (None, "exif"):
        raise ValueError(f"A video needs --focal: {_VIDEO_SOURCES}.")
    elif video and source == "same":
        raise ValueError(
            "--focal same is for photos: give one focal length for the video, such as --focal 24."
        )
    elif source not in (None, "exif", "plane", "pitch", "same") and _number(source) is None:
        if not source.lower().endswith(".csv"):
            raise ValueError(
                f"--focal is {source!r}, which is not a source of focal lengths. Give "
                f"{_VIDEO_SOURCES if video else SOURCES}."
            )
        if is_relative_track(source):
            raise ValueError(
                f"The focal lengths of {source} are relative: only their ratios are known. Calibrate the "
                "clip that they are of with --lines, or give it a known focal length (--known-focal)."
            )
        read_focal_track(source) if video else read_focal_table(source)


_NO_BOARD = (
    "--focal board needs the board's --spacing and --distance, and the sensor's --pixel-pitch, in mm."
)


def choose_focals(
    detections: Sequence[Detection],
    source: str | None = None,
    *,
    unit: str = "mm",
    board: Board | None = None,
    sharing: Sharing | None = None,
) -> Focals:
    """Find the focal length of each image.

    Args:
        detections: detections of images of one size, all with lines.
        source: the source: "exif", "board", "plane", "pitch", a number, a CSV file, or "same" for one that
            nobody knows. None for the best
            available one: the `board` if it is given, else EXIF data, else an oblique grid; else, of one
            image alone, none: one millimetre stands for its focal length. Grids are then supposed to be of
            one zoom, if `sharing` does not say.
        unit: unit of a number or of the focal lengths in a CSV file.
        board: the board, for "board".
        sharing: which images share a focal length, for "plane".

    Raises:
        FileNotFoundError: there is no such CSV file.
        ValueError: no focal length was found; the message lists the other sources.
    """
    whole = source
    if source is None:
        source = "board" if board else "exif" if any(d.focal for d in detections) else "plane"
    if source == "exif":
        found = Focals(_own(detections), "mm", _EXIF, "its EXIF data have no focal length")
    elif source == "track":
        found = Focals(_own(detections), unit, _TRACK, "the track has none for it")
    elif source == "board":
        if board is None:
            raise ValueError(_NO_BOARD)
        found = _estimated(
            detections,
            "mm",
            "the board's pitch (eq. 14)",
            NOT_THE_BOARD,
            _each(functools.partial(focal_of_board, board)),
        )
        check_board(board, found.focal.values(), detections[0].image_size)
    elif source == "same":
        return _unknown(detections)
    elif source == "plane" and all(d.nodes is None for d in detections):
        found = Focals({}, "px", GRID, _NO_PLANE)
    elif source == "plane":
        one = _of_one_zoom(detections) if whole is None and sharing is None else None
        found = one or _from_grids(detections, sharing)
    elif source == "pitch":
        found = _estimated(
            detections, "px", "the markings of the pitch", _NO_PITCH, _each(_from_pitch), few=True
        )
    elif (number := _number(source)) is not None:
        found = Focals({d.name: number for d in detections}, unit, "--focal", "")
    else:
        table = read_focal_table(source)
        known = table.of([d.file for d in detections])
        sigma = {d.name: table.sigma(d.file) for d in detections if d.file in known}
        found = Focals(
            {d.name: known[d.file] for d in detections if d.file in known},
            unit,
            Path(source).name,
            f"{Path(source).name} has no row for it",
            {name: value for name, value in sigma.items() if value is not None},
        )
    if not found.focal and whole is None and board is None and len(detections) == 1:
        return _unknown(detections)
    if not found.focal:
        raise ValueError(
            f"No focal length found for any image. Source: {found.origin}; problem: {found.absent}. Give "
            f"{SOURCES}. (Straight lines alone do not determine focal lengths: other focal lengths with "
            "another zoom model give the same correction.)"
        )
    return found


def known_focals(detections: Sequence[Detection], source: str | None, others: Focals) -> dict[str, float]:
    """The focal lengths of images without lines, as far as they are known without them.

    Args:
        detections: of these images.
        source: the source of focal lengths that was asked for.
        others: the focal lengths of the images with lines.
    """
    if others.origin in (_EXIF, _TRACK):
        return _own(detections)
    if source is None or source in MEASURED or source == "exif" or not detections:
        return {}
    try:
        return choose_focals(detections, source, unit=others.unit).focal
    except ValueError:  # a table without them
        return {}


def _of_one_zoom(detections: Sequence[Detection]) -> Focals | None:
    """One focal length for all images; None where not even two grids give one by themselves."""
    if len(detections) < 2:
        return None
    found = _from_grids(detections, Sharing(ONE_ZOOM))
    several = any(group.spread() > 1 for group in found.groups)
    return dataclasses.replace(found, one_zoom=True) if several else None


def _from_grids(detections: Sequence[Detection], sharing: Sharing | None) -> Focals:
    """Focal lengths from grids seen obliquely."""
    return _estimated(
        detections,
        "px",
        GRID,
        _NO_PLANE,
        functools.partial(focals_from_grids, sharing=sharing),
        zooms=sharing.known(detections) if sharing else None,
    )


_EXIF, _TRACK = "EXIF data", "the track of the video"


def _unknown(detections: Sequence[Detection]) -> Focals:
    """One millimetre for all images."""
    of = "one photo" if len(detections) == 1 else "photos of one zoom"
    found = dict.fromkeys((d.name for d in detections), 1.0)
    return Focals(found, "mm", f"not known, and not needed for {of}: 1 mm stands for it", "", known=False)


GRID = "homographies of the grid"


_TOO_FRONTAL = "its grid is seen too squarely, or too little of it, to determine a focal length"


_NO_PLANE = "no flat grid was found in it, or the view is too frontal to determine a focal length"


_NO_PITCH = (
    "its lines cannot be identified as the markings of a football pitch, of which at least four must be "
    "seen, two along and two across it, or they do not determine a focal length"
)


def _own(detections: Sequence[Detection]) -> dict[str, float]:
    return {detection.name: detection.focal for detection in detections if detection.focal}


def _number(text: str) -> float | None:
    value = plain_number(text)
    if value is not None and value <= 0:
        raise ValueError(f"Argument focal must be a positive number, but it is {text}.")
    return value


Estimator = Callable[[Detection, Distortion], FocalEstimate | None]
Estimators = Callable[[Sequence[Detection], Sequence[Distortion]], Found]


def _estimated(
    detections: Sequence[Detection],
    unit: str,
    origin: str,
    absent: str,
    estimate: Estimators,
    *,
    few: bool = False,
    zooms: np.ndarray | None = None,
) -> Focals:
    """Focal lengths from corrected points. The correction is done twice, see the module.

    Where images have `few` lines, the corrections have one coefficient, at first the same in all of them.
    Images of one number in `zooms` are corrected alike; by default each has a number of its own.
    """
    zooms = np.arange(len(detections)) if zooms is None else zooms
    without = compress(lines_of(detections, np.ones(zooms.max() + 1), unit, zooms))
    if few:
        one = fit_robust(without, zoom=PolynomialZoom(degree=0), terms=1, throw=False).fit.lens
        corrections = [one(1.0)] * len(detections)
    else:
        each = fit_frames(without, throw=False)
        corrections = [each.distortion(zoom) for zoom in zooms.tolist()]
    found = estimate(detections, corrections)
    usable = [d for d in detections if d.name in found.focal]
    if len(usable) > 2:
        focal = np.array([float(found.focal[d.name].focal) for d in usable])
        lines = compress(lines_of(usable, focal, unit))
        degree = min(2, np.unique(focal).size - 1)
        lens = fit_robust(
            lines, zoom=PolynomialZoom(degree=degree), terms=1 if few else 2, throw=False
        ).fit.lens
        again = estimate(usable, [lens(float(f)) for f in focal])
        found = again if again.focal else found
    return Focals(
        {name: float(f.focal) for name, f in found.focal.items()},
        unit,
        origin,
        absent,
        {name: float(f.std) for name, f in found.focal.items()},
        found.groups,
    )


def _each(estimator: Estimator) -> Estimators:
    """Estimates of images by themselves, where they are precise enough."""

    def estimate(detections: Sequence[Detection], corrections: Sequence[Distortion]) -> Found:
        found = {}
        for detection, correction in zip(detections, corrections, strict=True):
            if not np.isfinite(np.asarray(correction.coefficients)).all():
                continue
            value = estimator(detection, correction)
            if value is not None and float(value.std) < MOST_UNCERTAIN * float(value.focal):
                found[detection.name] = value
        return Found(found)

    return estimate


def lines_of(
    detections: Sequence[Detection], focal: np.ndarray, unit: str, frame: np.ndarray | None = None
) -> Lines:
    """The lines of all images: of each the number of its frame, by default a frame of its own."""
    frame = np.arange(len(detections)) if frame is None else frame
    return Lines.from_ragged(
        [line for detection in detections for line in detection.lines],
        np.repeat(frame, [len(detection.lines) for detection in detections]),
        jnp.asarray(focal, float),
        image_size=detections[0].image_size,
        focal_unit=unit,
    )


def _from_pitch(detection: Detection, correction: Distortion) -> FocalEstimate | None:
    principal = np.asarray(correction.centre)
    corrected = [np.asarray(correction.undistort(line)) for line in detection.lines]
    named = name_pitch_lines(corrected, principal=principal, image_size=detection.image_size)
    return focal_from_pitch(named, principal=principal) if named else None


def focal_sigmas(text: str, focal: Float[AnyArray, "frame"]) -> Float[np.ndarray, "frame"]:
    """Parse standard deviations: a number in the unit of f, or a percentage of f such as "1%".

    Raises:
        ValueError: the text is neither, or negative.
    """
    number, percent, rest = text.strip().partition("%")
    value = plain_number(number)
    if rest or value is None or value < 0:
        raise ValueError(f"Argument focal_sigma must be a number such as 0.3, or 1%, but it is {text!r}.")
    return value / 100 * np.asarray(focal) if percent else np.full(np.shape(focal), value)


def refuse_sigma_column(file: str | Path, focal_sigma: str | None) -> None:
    """Refuse standard deviations beside focal lengths of lines or of a video: they would not count.

    Unless `focal_sigma` tells what does. What is no CSV file has none.
    """
    table = str(file).lower().endswith(".csv")
    if focal_sigma is not None or not table or not has_columns(file, ("focal", "sigma")):
        return
    told = read_text_table(file, "focal lengths", numbers=("focal", "sigma"), gaps=("focal", "sigma"))
    share = 100 * told.numbers["sigma"] / told.numbers["focal"]
    share = share[np.isfinite(share) & (share > 0)]
    usual = f"{np.median(share):.2g}%, as most of it says," if len(share) else "1%"
    raise ValueError(
        f"The column sigma of {file} would not count: such a column is for photos. Give argument "
        f"focal_sigma, one for all, such as {usual} or 0 for focal lengths that are exact."
    )
