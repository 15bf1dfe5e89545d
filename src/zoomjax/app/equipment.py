"""What the photos of a calibration were taken with, for ``lens.json``."""

import dataclasses
from collections.abc import Iterable
from pathlib import Path

from ..io.equipment import FILM, Equipment, read_equipment
from ..lenses.matching import crop_factor
from ..models.lens import ZoomLens

_SAME = 0.01
"""Share by which crop factors of photos may differ and count as one."""


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


def equipment_of(photo: Path) -> Equipment:
    """Camera and lens of a photo; a photo that cannot be read says nothing."""
    try:
        return read_equipment(photo)
    except (OSError, ValueError):
        return Equipment()


def _camera(one: Equipment) -> str:
    """The body, with its maker unless it names that itself."""
    named = one.maker.split()[:1]
    own = not named or one.camera.casefold().startswith(named[0].casefold())
    return one.camera if own else f"{one.maker} {one.camera}"


def _common(names: Iterable[str]) -> str | None:
    """The name that all share who have one."""
    different = {name for name in names if name}
    return different.pop() if len(different) == 1 else None
