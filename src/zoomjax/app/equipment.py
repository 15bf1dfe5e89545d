"""What the photos of a calibration were taken with, for ``lens.json``."""

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from .._core.text import listed, plain
from ..interop.matching import crop_factor
from ..io.equipment import FILM, Equipment, read_equipment
from ..io.metadata import Metadata
from ..io.photo import read_metadata
from ..models.about import RELATIVE, UNKNOWN
from ..models.lens import ZoomLens, load_lens
from ..models.smooth import SmoothZoom
from .earlier import is_of_results

OTHER_CROP = 1.2
"""Ratio of crop factors in EXIF data from which images show parts of different size: they are rounded."""

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
    lensfunpy: a photo is taken to show the whole sensor. After digital zoom it is not known.

    Photos without EXIF data, or of formats whose data cannot be read any more, say nothing.
    """
    found = [equipment_of(photo) for photo in photos]
    zooms = [one.digital_zoom if one.enlarged else 1.0 for one in found]
    zoom = round(zooms[0], 3) if zooms and max(zooms) <= (1 + _SAME) * min(zooms) else None
    crops = [crop for one in found if (crop := crop_factor(one, lens.image_size))]
    crop = crops[0] if zoom == 1 and crops and max(crops) <= (1 + _SAME) * min(crops) else None
    pitch = None if crop is None else FILM / (crop * 2 * lens.scale)
    facts = {
        "camera": _common(_camera(one) for one in found),
        "lens": _common(one.lens for one in found),
        "crop_factor": None if crop is None else round(crop, 3),
        "digital_zoom": zoom if zoom is not None and zoom > 1 else None,
    }
    about = {**lens.about, **{name: fact for name, fact in facts.items() if fact}}
    return dataclasses.replace(lens, pixel_pitch=pitch, about=about)


def with_earlier(lens: ZoomLens, files: Sequence[Path]) -> ZoomLens:
    """The lens of lines of earlier results, with what those know of it beside its numbers.

    Camera, lens, crop factor and pixel pitch, as far as all agree, and that its focal length is not known,
    or that its focal lengths are relative.

    Raises:
        ValueError: there are several files, and the focal length of one is not known, or relative.
    """
    found = [_earlier(file, lens) for file in files]
    for file, one in zip(files, found, strict=True):
        if len(files) > 1 and one is not None and one.about.get("focal") == UNKNOWN:
            raise ValueError(
                f"{file} is of photos whose focal length is not known: leave it out, or calibrate its "
                "photo again together with the others, with --focal."
            )
        if len(files) > 1 and one is not None and one.about.get("focal") == RELATIVE:
            raise ValueError(
                f"{file} is of a clip whose focal lengths are relative: leave it out, or calibrate the "
                "clip again with a known focal length (--known-focal)."
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
    """That EXIF data say that photos were not taken as those of a lens, in sentences.

    That is another lens, or where it has no name several lenses or another body; another part of the
    sensor; another zoom than the one of a lens whose focal length is not known.
    """
    found = [equipment_of(photo) for photo in photos]
    told, own = [], lens.about.get("lens")
    named = own is not None and "table_error_px" not in lens.about  # lensfun's names are not those of EXIF
    if named and (others := Counter(one.lens for one in found if one.lens and one.lens != own)):
        name, _ = others.most_common(1)[0]
        told.append(
            f"The lens is that of {own}, and by their EXIF data {others.total()} of {len(found)} photos "
            f"were taken with another one ({plain(name)})."
        )
    told += _parts_taken(lens, found) + (_bodies_taken(lens, found) or ([] if named else _several(found)))
    focal = [one.focal for one in found if one.focal]
    if lens.about.get("focal") == UNKNOWN and focal and max(focal) > _SAME_ZOOM * min(focal):
        told.append(
            "The lens is for one zoom, whose focal length is not known, and by their EXIF data photos are "
            f"of {min(focal):.4g} to {max(focal):.4g} mm: some are of another zoom."
        )
    return told


def taken_at_others(lens: ZoomLens, photos: Iterable[Path], focal_of: Callable[[Path], float]) -> list[str]:
    """That photos' EXIF data contradict the focal lengths that they are corrected at.

    One factor common to all says nothing where the lens counts in px, or where it makes them those of equal
    view on film. In mm it counts from a quarter on: less may be how the lens is focused.
    """
    found = {photo: one for photo in photos if (one := equipment_of(photo)).focal}
    used = {photo: focal_of(photo) for photo in found}
    ratio = {photo: (one.focal or np.nan) / used[photo] for photo, one in found.items()}
    if not ratio:
        return []
    low, high = min(ratio, key=lambda photo: ratio[photo]), max(ratio, key=lambda photo: ratio[photo])
    if not _apart(ratio[low], ratio[high], _OTHER_ZOOM):
        film = [(one.crop_factor(lens.image_size) or 1) * ratio[photo] for photo, one in found.items()]
        in_mm = lens.focal_unit == "mm" and lens.about.get("focal") != UNKNOWN
        if not in_mm or any(min(_off(ratio[low]), _off(of)) <= OTHER_FOCAL for of in film):
            return []
    pair = (low,) if len(ratio) == 1 else (low, high)
    told = [f"{plain(photo.name)} is of {found[photo].focal:.4g} mm" for photo in pair]
    counts = dict.fromkeys(f"{used[photo]:.4g}" for photo in pair)
    advice = "leave it out: then the EXIF data count"
    if lens.focal_unit == "px":
        advice = "give a table with that of each photo: the lens counts in px"
    return [
        f"By their EXIF data {' and '.join(told)}, and the focal length used is {' and '.join(counts)} "
        f"{lens.focal_unit}. Check --focal, or {advice}."
    ]


def _off(ratio: float) -> float:
    return max(ratio, 1 / ratio)


def _several(found: Sequence[Equipment]) -> list[str]:
    """That photos were taken with several lenses, or cameras if they name no lens: one at most is right."""
    kind, taken = "lenses", Counter(one.lens for one in found if one.lens)
    if not taken:
        kind, taken = "cameras", Counter(_camera(one) for one in found if one.camera)
    if len(taken) < 2:
        return []
    names = listed((f"{plain(name)} ({number})" for name, number in taken.most_common()), 3)
    return [
        f"By their EXIF data the photos were taken with {len(taken)} {kind}, {names}, and are corrected as "
        "of one: correct those of each by themselves."
    ]


_OTHER_ZOOM = 1.1
"""Ratio of ratios of focal lengths that differ by more than EXIF data are rounded to, or measured."""

OTHER_FOCAL = 1.25
"""Ratio up to which all focal lengths may be apart from those in EXIF data: those at near things are."""


def _parts_taken(lens: ZoomLens, found: Sequence[Equipment]) -> list[str]:
    """That photos show more or less of the sensor than those of the lens."""
    own, zoom = lens.about.get("crop_factor"), lens.about.get("digital_zoom", 1.0)
    told = []
    if isinstance(zoom, int | float):
        others = [one.digital_zoom for one in found if _apart(one.digital_zoom, zoom, 1 + 2 * _SAME)]
        if others:
            told.append(
                f"The lens is for a digital zoom of {zoom:.3g}, and by their EXIF data {len(others)} of "
                f"{len(found)} photos were taken with {_span(others)}: they show another part of what it "
                "does, and are corrected wrongly."
            )
    parts = [one for one in found if one.cropped(lens.image_size)]
    if isinstance(own, int | float) and parts:  # the lens's own photos were not
        width, height = parts[0].written or lens.image_size
        told.append(
            f"By their EXIF data {len(parts)} of {len(found)} photos were cropped, as the camera wrote "
            f"another shape ({width} x {height} px): they show another part of what the lens does, and are "
            "corrected wrongly."
        )
    crops = [crop for one in found if (crop := one.crop_factor(lens.image_size)) is not None]
    if isinstance(own, int | float) and (
        others := [crop for crop in crops if _apart(crop, own, OTHER_CROP)]
    ):
        told.append(
            f"The lens is for images of crop factor {own:.3g}, and by their EXIF data {len(others)} of "
            f"{len(found)} photos are of {_span(others)}: they show another part of what it does, and are "
            "corrected wrongly."
        )
    return told


def _bodies_taken(lens: ZoomLens, found: Sequence[Equipment]) -> list[str]:
    """That photos are of another body, where that tells the lens, whose name is not known."""
    own = lens.about.get("camera")
    bodies = Counter(_camera(one) for one in found if one.camera and _camera(one) != own)
    if not own or lens.about.get("lens") or not bodies:
        return []
    name, _ = bodies.most_common(1)[0]
    return [
        f"The lens is that of the camera {own}, and by their EXIF data {bodies.total()} of {len(found)} "
        f"photos were taken with another one ({plain(name)})."
    ]


def _apart(one: float, other: float, ratio: float) -> bool:
    return max(one, other) > ratio * min(one, other)


def _span(values: Sequence[float]) -> str:
    low, high = f"{min(values):.3g}", f"{max(values):.3g}"
    return low if low == high else f"{low} to {high}"


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
