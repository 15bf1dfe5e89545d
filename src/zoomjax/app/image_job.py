"""What ``zoomjax calibrate`` is to do with images: its settings, checked before any work."""

import dataclasses
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from .._core.arguments import check_flag
from .._core.text import numbered_name
from ..detect.batch import DETECTORS, Detection
from ..detect.sources import VIDEO_SUFFIXES, Source, find_photos, video_frames
from ..io.focal_track import FocalTrack, read_focal_track
from ..io.photo import read_focal
from ..io.text_table import plain_number
from .board_focals import Board
from .calibration import FILES
from .focal_sources import MEASURED, check_source, focal_sigmas, refuse_sigma_column
from .model_choice import WantedCentre, WantedModel
from .plane_focals import SHARED_BY, Sharing
from .relative import refuse_other_unit


@dataclasses.dataclass(frozen=True)
class ImageJob:
    """Settings of a calibration from images.

    Attributes:
        inputs: photos, folders or patterns; or one video.
        detector: "edges", "grid" or "pitch".
        focal: source of the focal lengths, as for `choose_focals`; for a video also a track.
        focal_unit: unit of the focal lengths in a number, a table or a track.
        focal_sigma: standard deviation of the focal lengths: a number in their unit, or a percentage such
            as "1%"; None for the standard deviation given by their source.
        board: the board, for ``focal="board"``.
        shared_focal: for ``focal="plane"``, which images share a focal length: those of one EXIF focal
            length ("exif"), of one "folder", or of focal lengths that agree ("similarity"); None: none.
        model: the zoom model.
        centre: centre of distortion: "fit", "moving", "image" or its coordinates, px.
        frames: maximum number of frames used from a video.
        workers: number of processes.
        cache: folder for cached detections; None: no cache.
        overlays: which images are drawn with their lines: "some" (all up to 200, beyond that the worst and
            others over the zoom), "all" or "none".
        tied: whether photos that disagree with the lens of all of them are searched for lines again.
    """

    inputs: tuple[str | os.PathLike[str], ...]
    detector: str = "edges"
    focal: str | None = None
    focal_unit: str = "mm"
    focal_sigma: str | None = None
    board: Board | None = None
    shared_focal: str | None = None
    model: WantedModel = WantedModel()  # noqa: RUF009, it is frozen
    centre: WantedCentre = "fit"
    frames: int = 60
    workers: int = 1
    cache: Path | None = None
    overlays: str = "some"
    tied: bool = True

    def __post_init__(self):
        """Check the settings before any work.

        Raises:
            FileNotFoundError: there is no such CSV file.
            TypeError: `tied` is neither True nor False.
            ValueError: a name is unknown, or a file has the wrong type.
        """
        check_flag("tied", self.tied)
        if self.detector not in DETECTORS:
            raise ValueError(
                f"Argument detector must be one of {', '.join(DETECTORS)}, but it is {self.detector!r}."
            )
        if len(self.inputs) > 1 and any(map(is_video, self.inputs)):
            raise ValueError("Give photos, or one video.")
        check_source(self.focal, self.board, video=self.video is not None)
        if self.focal == "pitch" and self.detector != "pitch":
            raise ValueError(
                'Argument focal "pitch" needs the markings of a pitch: give argument detector "pitch", too.'
            )
        focal_sigmas("0" if self.focal_sigma is None else self.focal_sigma, np.ones(1))
        if self.video is not None and self.focal is not None:
            refuse_sigma_column(self.focal, self.focal_sigma)
            refuse_other_unit(self.focal, self.focal_unit)
        self.model.check_centre(self.centre)
        if self.shared_focal is not None:
            self._check_sharing(self.shared_focal)

    def _check_sharing(self, how: str) -> None:
        """Refuse shared focal lengths that have no effect."""
        if how not in SHARED_BY:
            raise ValueError(
                f"Argument shared_focal must be one of {', '.join(SHARED_BY)}, but it is {how!r}."
            )
        if self.focal != "plane":
            raise ValueError(
                "Argument shared_focal is for focal lengths that are measured from a flat grid in the "
                'images: give argument focal "plane", too, or leave it out.'
            )
        if self.video is not None and how != "similarity":
            raise ValueError(
                f'Argument shared_focal "{how}" is for photos: frames of a video can share a focal length '
                'by "similarity".'
            )
        if how == "exif" and not any(map(_has_focal, self.sources()[0])):
            raise ValueError(
                'Argument shared_focal "exif" needs focal lengths in the EXIF data, but no photo has one: '
                'photos of one zoom can share a focal length by "folder" or "similarity".'
            )

    @property
    def sharing(self) -> Sharing | None:
        """Which images share a focal length, if that is asked for."""
        if self.shared_focal is None:
            return None
        text = self.focal_sigma
        return Sharing(self.shared_focal, None if text is None else lambda focal: focal_sigmas(text, focal))

    @property
    def other_sharing(self) -> tuple[str, ...]:
        """Ways by which images could share a focal length, where none is asked for."""
        if self.shared_focal is not None:
            return ()
        return ("similarity",) if self.video is not None else SHARED_BY

    @property
    def video(self) -> Path | None:
        """The video, if the input is one."""
        return Path(self.inputs[0]) if is_video(self.inputs[0]) else None

    @property
    def grid(self) -> str:
        """In which images to search for a grid for the focal length: `detect`'s argument ``grid``."""
        if self.focal == "plane" or (self.focal == "board" and self.detector == "grid"):
            return "all"
        needed = self.focal is None and self.board is None and self.detector != "pitch"
        return "without focal length" if needed else "none"

    def sources(self) -> tuple[Iterable[Source], int]:
        """The images and their number."""
        if self.video is None:
            photos = find_photos(self.inputs)
            return photos, len(photos)
        return video_frames(self.video, self._track(), self.frames), self.frames

    def again(self, detections: Iterable[Detection]) -> Iterator[Source]:
        """The images of some detections, under the same names, whatever is in their folders by now."""
        if self.video is None:
            return (Source(of.name, Path(of.file)) for of in detections)
        names = {of.name for of in detections}
        return (source for source in self.sources()[0] if source.name in names)

    def results(self) -> list[str]:
        """Names of the files that `ImageCalibration.write` writes, as far as known in advance."""
        photos = self.sources()[0] if self.video is None else ()
        return [
            *FILES,
            *(f"lines/{overlay_name(n, photo.name)}" for n, photo in enumerate(photos, start=1)),
        ]

    def _track(self) -> FocalTrack | float:
        """The focal track of a video; 1 where focal lengths are estimated from its frames."""
        if self.focal in (None, *MEASURED):
            return 1.0
        number = plain_number(self.focal)
        return read_focal_track(self.focal) if number is None else number


def _has_focal(photo: Source) -> bool:
    """Whether the EXIF data of a photo have a focal length."""
    try:
        return read_focal(photo.file) is not None
    except (OSError, ValueError):
        return False


def overlay_name(number: int, name: str) -> str:
    """File name of the picture with an image's detected lines, safe for any image name."""
    return numbered_name(number, name, ".jpg")


def is_video(path: str | os.PathLike[str]) -> bool:
    """Whether a file is a video, by its name."""
    return Path(path).suffix.lower() in VIDEO_SUFFIXES
