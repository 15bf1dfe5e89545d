"""What the photos of a calibration were taken with, for ``lens.json``."""

import dataclasses
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from .._core.text import plain
from ..interop.matching import crop_factor
from ..io.equipment import FILM, Equipment, read_equipment
from ..io.metadata import Metadata
from ..io.photo import read_metadata
from ..models.about import UNKNOWN
from ..models.lens import ZoomLens, load_lens
from ..models.smooth import SmoothZoom
from .earlier import is_of_results

_SAME = 0.01
"""Share by which crop factors of photos may differ and count as one."""

_ROUNDED = 1.1
"""Ratio up to which what cameras round may be apart: crop factors by focal lengths of equal view, whole mm,
and a focal length and the end of its lens."""


@dataclasses.dataclass(frozen=True)
class KnownLens:
    """What a prior knows of a zoom lens, from the EXIF data of photos.

    Attributes:
        shortest, longest: the ends of its range, mm.
        crop: crop factor of the photos.
    """

    shortest: float
    longest: float
    crop: float

    def prior(self) -> SmoothZoom:
        """The smooth zoom model with the prior for such lenses."""
        return SmoothZoom.for_lens(self.shortest, self.longest, crop=self.crop)

    def sentence(self) -> str:
        """That it has been used."""
        return (
            f"The prior of the zoom model is that of a lens of {self.shortest:g} to {self.longest:g} mm at "
            f"crop factor {self.crop:.2g}, by the EXIF data of the photos."
        )


def known_lens(
    photos: Iterable[Path], focal: Sequence[float], image_size: tuple[int, int]
) -> KnownLens | None:
    """The zoom lens that the EXIF data of all photos, of one size and these focal lengths in mm, agree on.

    None where one of them does not tell the ends of the lens's range, or nothing tells a crop factor, or
    where their focal lengths are none of the lens's, as with a converter.
    """
    found = [equipment_of(photo) for photo in photos]
    ranges = {one.zoom_range for one in found}
    crops = [crop_factor(one, image_size) for one in found]
    if len(ranges) != 1 or (ends := ranges.pop()) is None or not all(crops):
        return None
    close = _ROUNDED * min(focal) >= ends[0] and max(focal) <= _ROUNDED * ends[1]
    known = np.array(crops, float)
    if not close or known.max() > _ROUNDED * known.min():
        return None
    return KnownLens(*ends, float(np.median(known)))


def with_equipment(lens: ZoomLens, photos: Iterable[Path]) -> ZoomLens:
    """The lens with the camera, lens, crop factor and pixel pitch that all its photos agree on.

    Where EXIF data do not tell a crop factor, it is that of the body in the lensfun database, if there is
    lensfunpy: a photo is taken to show the whole sensor.

    Photos without EXIF data, or of formats whose data cannot be read any more, say nothing.
    """
    found = [equipment_of(photo) for photo in photos]
    crops = [crop for one in found if (crop := crop_factor(one, lens.image_size))]
    crop = crops[0] if crops and max(crops) - min(crops) <= _SAME * min(crops) else None
    pitch = None if crop is None else FILM / (crop * 2 * lens.scale)
    facts = {
        "camera": _common(_camera(one) for one in found),
        "lens": _common(one.lens for one in found),
        "crop_factor": None if crop is None else round(crop, 3),
    }
    about = {**lens.about, **{name: fact for name, fact in facts.items() if fact}}
    return dataclasses.replace(lens, pixel_pitch=pitch, about=about)


def with_earlier(lens: ZoomLens, files: Sequence[Path]) -> ZoomLens:
    """The lens of lines of earlier results, with what those know of it beside its numbers.

    Camera, lens, crop factor and pixel pitch, as far as all agree, and that its focal length is not known.

    Raises:
        ValueError: there are several files, and the focal length of one is not known.
    """
    found = [_earlier(file, lens) for file in files]
    for file, one in zip(files, found, strict=True):
        if len(files) > 1 and one is not None and one.about.get("focal") == UNKNOWN:
            raise ValueError(
                f"{file} is of photos whose focal length is not known: leave it out, or calibrate its "
                "photo again together with the others, with --focal."
            )
    known = [one for one in found if one is not None]
    if len(known) < len(files) or not _spans(known, lens):
        return lens
    facts = [name for name, fact in known[0].about.items() if all(k.about.get(name) == fact for k in known)]
    pitches = {one.pixel_pitch for one in known}
    return dataclasses.replace(
        lens,
        pixel_pitch=pitches.pop() if len(pitches) == 1 else None,
        about={**{name: known[0].about[name] for name in facts}, **lens.about},
    )


def _earlier(file: Path, lens: ZoomLens) -> ZoomLens | None:
    """The lens of the results that a file of lines is one of; None if it is of none, or another lens."""
    if not is_of_results(file):
        return None  # a lens.json without its summary is of another command
    try:
        found = load_lens(file.with_name("lens.json"))
    except (OSError, ValueError):
        return None
    same = found.image_size == lens.image_size and found.focal_unit == lens.focal_unit
    return found if same else None


def _spans(known: Sequence[ZoomLens], lens: ZoomLens) -> bool:
    """Whether focal lengths are among those of earlier lenses: else lines and lenses are of other runs."""
    low, high = np.transpose([np.asarray(one.focal_range, float) for one in known])
    first, last = np.asarray(lens.focal_range, float)
    return bool(low.min() * (1 - 1e-6) <= first and last <= high.max() * (1 + 1e-6))


def equipment_of(photo: Path) -> Equipment:
    """Camera and lens of a photo; a photo that cannot be read says nothing."""
    try:
        return read_equipment(photo)
    except (OSError, ValueError):
        return Equipment()


def taken_otherwise(lens: ZoomLens, photos: Iterable[Path]) -> list[str]:
    """That EXIF data say that photos were not taken as those of a lens, in sentences."""
    found = [equipment_of(photo) for photo in photos]
    told, own = [], lens.about.get("lens")
    if own and (others := Counter(one.lens for one in found if one.lens and one.lens != own)):
        name, _ = others.most_common(1)[0]
        told.append(
            f"The lens is that of {own}, and by their EXIF data {others.total()} of {len(found)} photos "
            f"were taken with another one ({plain(name)})."
        )
    focal = [one.focal for one in found if one.focal]
    if lens.about.get("focal") == UNKNOWN and focal and max(focal) > _SAME_ZOOM * min(focal):
        told.append(
            "The lens is for one zoom, whose focal length is not known, and by their EXIF data photos are "
            f"of {min(focal):.4g} to {max(focal):.4g} mm: some are of another zoom."
        )
    return told


_SAME_ZOOM = 1.05
"""Ratio of focal lengths up to which one zoom's may be apart in EXIF data."""


def metadata_of(photo: Path) -> Metadata:
    """The metadata of a photo; a photo that cannot be read has none."""
    try:
        return read_metadata(photo)
    except (OSError, ValueError):
        return Metadata()


def _camera(one: Equipment) -> str:
    """The body, with its maker unless it names that itself."""
    named = one.maker.split()[:1]
    own = not named or one.camera.casefold().startswith(named[0].casefold())
    return one.camera if own else f"{one.maker} {one.camera}"


def _common(names: Iterable[str]) -> str | None:
    """The name that all share who have one."""
    different = {name for name in names if name}
    return different.pop() if len(different) == 1 else None


def without_focal(lens: ZoomLens) -> ZoomLens:
    """The lens of one zoom whose focal length nobody knows: a number stands for it."""
    return dataclasses.replace(lens, pixel_pitch=None, about={**lens.about, "focal": UNKNOWN})
