"""Photographs from file to file, corrected at the focal length in their EXIF data, metadata kept."""

import os
import struct
from pathlib import Path

import cv2
import numpy as np

from .._files import whole_file
from ..framing import Framing
from ..lens import ZoomLens
from ..sizes import lens_for_size
from .undistort import undistort_image

SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp")
"""Of files that count as photographs."""

_FOCAL_LENGTH, _EXIF_FOLDER = 0x920A, 0x8769
_LONG, _RATIONAL = 4, 5


def read_photo(path: str | os.PathLike[str]) -> tuple[np.ndarray, list[tuple[int, np.ndarray]]]:
    """The pixels as they were taken (any depth, not turned by the orientation tag), and the metadata.

    Metadata are pairs of OpenCV's kind (EXIF, XMP, colour profile) and bytes; none from TIFF files.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it cannot be decoded.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"There is no photograph {path}.")
    kinds, blocks = [], []
    if path.suffix.lower() in (".tif", ".tiff"):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    else:
        image, kinds, blocks = cv2.imreadWithMetadata(str(path), flags=cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError(f"Cannot read a photograph from {path}: it is damaged, or of an unknown format.")
    return image, list(zip(map(int, kinds), blocks, strict=True))


def exif_focal(metadata: list[tuple[int, np.ndarray]]) -> float | None:
    """The focal length, mm, that the camera wrote; None if it wrote none."""
    for kind, block in metadata:
        if kind == cv2.IMAGE_METADATA_EXIF:
            try:
                return _exif_rational(np.asarray(block, np.uint8).tobytes())
            except struct.error:
                return None
    return None


def undistort_photo(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    lens: ZoomLens,
    focal: float | int | None = None,
    keep: str | Framing = "same",
    interpolation: str = "linear",
) -> None:
    """Correct a photograph into a new file, with its metadata.

    Args:
        source: the photograph; all its bits are kept.
        target: the file to write, all of it or none. Its suffix tells the format; JPEG in quality 97.
        lens: the lens; for another size of the same aspect ratio it is scaled.
        focal: in the lens's unit; by default what the EXIF data say.
        keep, interpolation: as for `undistort_image`.

    Raises:
        FileNotFoundError: there is no such photograph.
        OSError: the target cannot be written; nothing is left of it.
        ValueError: the photograph cannot be decoded, tells no focal length, or has another aspect ratio
            than the lens; or the target's suffix is unknown.
    """
    target = Path(target)
    if target.suffix.lower() not in SUFFIXES:
        raise ValueError(
            f"Argument target must end in one of {', '.join(SUFFIXES)}, but it is {target.name!r}."
        )
    image, metadata = read_photo(source)
    if focal is None:
        focal = exif_focal(metadata) if lens.focal_unit == "mm" else None
        if focal is None:
            raise ValueError(
                f"The focal length of {os.fspath(source)} is not known: its EXIF data have none in "
                f"{lens.focal_unit}. Give it (--focal)."
            )
    lens = lens_for_size(lens, (image.shape[1], image.shape[0]))
    corrected = undistort_image(image, lens(focal), keep=keep, interpolation=interpolation)
    with whole_file(target) as part:
        part.write_bytes(_encoded(corrected, target.suffix.lower(), metadata))


def _encoded(image: np.ndarray, suffix: str, metadata: list[tuple[int, np.ndarray]]) -> bytes:
    options = [cv2.IMWRITE_JPEG_QUALITY, 97] if suffix in (".jpg", ".jpeg") else []
    try:
        if metadata and suffix not in (".tif", ".tiff", ".bmp"):
            kinds, blocks = zip(*metadata, strict=True)
            done, content = cv2.imencodeWithMetadata(suffix, image, list(kinds), list(blocks), options)
        else:
            done, content = cv2.imencode(suffix, image, options)
    except cv2.error as error:
        raise ValueError(f"Cannot write this photograph as {suffix}: {error.err}.") from error
    if not done:
        raise ValueError(f"Cannot write an image of {image.dtype} and shape {image.shape} as {suffix}.")
    return content.tobytes()


def _exif_rational(block: bytes) -> float | None:
    """The focal length in a TIFF structure: first folder, EXIF folder, one fraction."""
    block = block.removeprefix(b"Exif\0\0")
    order = {b"II": "<", b"MM": ">"}.get(block[:2])
    if order is None:
        return None

    def entries(offset):
        (count,) = struct.unpack_from(f"{order}H", block, offset)
        for i in range(count):
            tag, kind, _, value = struct.unpack_from(f"{order}HHII", block, offset + 2 + 12 * i)
            yield (tag, kind), value

    (first,) = struct.unpack_from(f"{order}I", block, 4)
    folder = dict(entries(first)).get((_EXIF_FOLDER, _LONG))
    fraction = dict(entries(folder)).get((_FOCAL_LENGTH, _RATIONAL)) if folder else None
    if fraction is None:
        return None
    above, below = struct.unpack_from(f"{order}II", block, fraction)
    return above / below if above and below else None
