"""Small pictures of a calibration's photos for the report: before and after, and crops of the worst lines.

Each is a JPEG of some tens of kB.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import UInt8

from ..correct.framing import Framing, frame_output
from ..correct.image import checked_image, position_map
from ..correct.sampler import border_values, remap
from ..models.distortion import Distortion
from .choice import colour_limit
from .overlay import draw_lines, for_picture

if TYPE_CHECKING:
    from ..detect.batch import Detection
    from .calibration import Calibration
    from .image_job import ImageJob
    from .meanwhile import State

MOST = 12
"""Photos shown: the page stays small enough to be sent by mail."""

_WIDE = 560  # px of the longer side
_LEAST_SCALE = 0.5
"""Of corrected pictures: corners that a strong lens moves far out are cut off, for the rest to be seen."""
_CROP, _CROP_SIDE = 3, 260  # crops per photo, and px of their side
_QUALITY = 78


@runtime_checkable
class Photos(Protocol):
    """What pictures are drawn of: an `ImageCalibration`."""

    @property
    def job(self) -> "ImageJob":
        """The settings."""
        ...

    @property
    def calibration(self) -> "Calibration":
        """The fits; one frame for each photo used."""
        ...

    @property
    def used(self) -> "tuple[Detection, ...]":
        """The photos used."""
        ...

    @property
    def states(self) -> "Mapping[str, State | None]":
        """Of the files of photos before the work began."""
        ...

    def members(self) -> list[np.ndarray]:
        """For each of them, the numbers of its lines."""
        ...

    def overlays(self) -> list[str]:
        """For each of them, the name of its picture; empty if it is not drawn."""
        ...


@dataclasses.dataclass(frozen=True)
class Pictures:
    """Pictures of one photo, as JPEG.

    Attributes:
        frame: its number among the frames of the calibration.
        focal: its focal length.
        before, after: the photo and its correction, each with the lines.
        crops: the photo about the middle of its worst lines, by the lines' numbers in ``lines.npz``.
    """

    frame: int
    focal: float
    before: bytes
    after: bytes
    crops: dict[int, bytes]


def pictures_of(images: "Photos", frame: int, image: UInt8[np.ndarray, "..."]) -> Pictures:
    """Pictures of one photo."""
    calibration = images.calibration
    members = np.flatnonzero(np.asarray(calibration.lines.frame) == frame)
    rms, rejected = calibration.line_rms[members], calibration.rejected[members]
    lines = images.used[frame].lines
    named = members[np.argsort(-np.where(rejected, 0, rms), kind="stable")[:_CROP]]
    labels = {int(np.flatnonzero(members == line)[0]): str(line) for line in named}
    small, scale = for_picture(image, _WIDE)
    look = {"rejected": rejected.tolist(), "rms": rms, "labels": labels, "limit": colour_limit(calibration)}
    before = draw_lines(small, [_at(line, scale) for line in lines], **look)
    focal = float(np.asarray(calibration.lines.focal)[frame])
    distortion = _resized(calibration.fit.lens(focal), image, small)
    corrected, framing = _corrected(small, distortion)
    origin, enlarged = np.asarray(framing.origin), float(framing.scale)
    joined = np.asarray(distortion.undistort(_at(np.concatenate(lines), scale)))  # all lines at once
    ends = np.cumsum([len(line) for line in lines])[:-1]
    shown = np.split((joined - origin) * enlarged, ends)
    known = [points[np.isfinite(points).all(axis=1)] for points in shown]
    after = draw_lines(corrected, known, **look)
    crops = {int(line): _crop(image, lines[place]) for line, place in zip(named, labels, strict=True)}
    return Pictures(frame, focal, _jpeg(before), _jpeg(after), crops)


def before_after(image: UInt8[np.ndarray, "..."], distortion: Distortion) -> tuple[bytes, bytes]:
    """A small picture of an image, and one of its correction, as JPEG."""
    small, _ = for_picture(image, _WIDE)
    return _jpeg(small), _jpeg(_corrected(small, _resized(distortion, image, small))[0])


def _corrected(small: np.ndarray, distortion: Distortion) -> tuple[np.ndarray, Framing]:
    """A picture, corrected, and how it is framed: all of it, unless that would be too small to see."""
    size = (small.shape[1], small.shape[0])
    framing = frame_output(distortion, size, keep="all")
    if framing.scale < _LEAST_SCALE:
        fixed = np.asarray(distortion.centre)  # stays where it is
        framing = Framing(np.array(_LEAST_SCALE), fixed - fixed / _LEAST_SCALE, size, size)
    # As `undistort_image`, without its warning of a fold, which the report states.
    x, y = position_map(distortion, framing, size)
    grey = border_values(128, math.prod(small.shape[2:]), small.dtype)
    return remap(checked_image(small), x, y, "linear", "constant", grey), framing


def _crop(image: np.ndarray, line: np.ndarray) -> bytes:
    """The photo about the middle of a line, with the line's points."""
    middle = line[len(line) // 2]
    half = max(_CROP_SIDE, round(0.12 * max(image.shape[:2]))) // 2
    x, y = (
        int(np.clip(round(float(at)) - half, 0, max(side - 2 * half, 0)))
        for at, side in zip(middle, image.shape[1::-1], strict=True)
    )
    part, scale = for_picture(np.ascontiguousarray(image[y : y + 2 * half, x : x + 2 * half]), _CROP_SIDE)
    return _jpeg(draw_lines(part, [_at(line - [x, y], scale)], [False], dim=1.0))


def _at(points: np.ndarray, scale: float) -> np.ndarray:
    """Points in an image made smaller."""
    return (points + 0.5) * scale - 0.5


def _resized(distortion: Distortion, image: np.ndarray, small: np.ndarray) -> Distortion:
    """The distortion of an image made smaller."""
    ratio = small.shape[1] / image.shape[1]
    centre = (np.asarray(distortion.centre) + 0.5) * ratio - 0.5
    return dataclasses.replace(distortion, centre=centre, scale=np.asarray(distortion.scale) * ratio)


def _jpeg(picture: np.ndarray) -> bytes:
    done, content = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    assert done
    return content.tobytes()
