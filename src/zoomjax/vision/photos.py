"""Photographs from file to file, corrected at the focal length in their EXIF data, metadata kept.

Pixels are taken as they are stored, before the orientation tag turns them: that is how the lens saw them.
The tag goes over with the other metadata, so that the result is shown the same way up.
"""

import os
import re
import warnings
from pathlib import Path

import cv2
import numpy as np

from .._files import whole_file
from ..framing import Framing
from ..io.exif import exif_focal
from ..lens import ZoomLens
from ..sizes import lens_for_size
from .undistort import undistort_image

_FORMATS = {  # suffix: bits a sample, and numbers of channels, that the format holds
    **dict.fromkeys([".jpg", ".jpeg"], ((8,), (1, 3))),
    ".png": ((8, 16), (1, 3, 4)),
    ".webp": ((8,), (3, 4)),
    **dict.fromkeys([".tif", ".tiff"], ((8, 16, 32, 64), (1, 3, 4))),
    ".bmp": ((8,), (1, 3, 4)),
}
SUFFIXES = tuple(_FORMATS)
"""Of files that count as photographs."""

_OPTIONS = {
    ".jpg": [
        *(cv2.IMWRITE_JPEG_QUALITY, 97),
        *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
    ],
    ".webp": [cv2.IMWRITE_WEBP_QUALITY, 101],  # above 100: without loss
}
_OPTIONS[".jpeg"] = _OPTIONS[".jpg"]

_NO_METADATA = (".tif", ".tiff", ".bmp")
"""Formats whose metadata OpenCV neither reads nor writes."""


def undistort_photo(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    lens: ZoomLens,
    focal: float | int | None = None,
    keep: str | Framing = "same",
    interpolation: str = "linear",
    border: str = "constant",
) -> None:
    """Correct a photograph into a new file, with its metadata.

    Args:
        source: the photograph: JPEG, PNG, WebP, TIFF or BMP. All its bits and channels are kept.
        target: the file to write, all of it or none. Its suffix tells the format; JPEG in quality 97.
        lens: the lens; for another size of the same aspect ratio it is scaled.
        focal: in the lens's unit; by default what the EXIF data say.
        keep, interpolation, border: as for `undistort_image`.

    Raises:
        FileNotFoundError: there is no such photograph.
        OSError: the target cannot be written; nothing is left of it.
        ValueError: the photograph cannot be decoded, tells no focal length, or has another aspect ratio
            than the lens; or the target's suffix is unknown, or its format does not hold such pixels.

    Warns:
        UserWarning: as `undistort_image` and `ZoomLens` do; or metadata are lost, as TIFF's are.
    """
    target = Path(target)
    suffix = target.suffix.lower()
    if suffix not in _FORMATS:
        raise ValueError(
            f"Argument target must end in one of {', '.join(SUFFIXES)}, but it is {target.name!r}."
        )
    image, metadata = read_photo(source)
    bits, channels = 8 * image.dtype.itemsize, 1 if image.ndim == 2 else image.shape[2]
    if bits not in _FORMATS[suffix][0] or channels not in _FORMATS[suffix][1]:
        raise ValueError(
            f"Cannot write {channels} channels of {bits} bits, as in {os.fspath(source)}, to a {suffix} "
            "file: choose .png or .tif."
        )
    if focal is None:
        focal = photo_focal(source, lens)
    lens = lens_for_size(lens, (image.shape[1], image.shape[0]))
    corrected = undistort_image(image, lens(focal), keep=keep, interpolation=interpolation, border=border)
    lost = Path(source).suffix.lower() in (".tif", ".tiff") or (metadata and suffix in _NO_METADATA)
    if lost:
        warnings.warn(
            f"Metadata of {os.fspath(source)} are not kept: OpenCV has none of TIFF and BMP files.",
            stacklevel=2,
        )
    with whole_file(target) as part:
        part.write_bytes(_encoded(corrected, suffix, metadata))


def photo_focal(source: str | os.PathLike[str], lens: ZoomLens) -> float:
    """The focal length in a photograph's EXIF data, for a lens in mm.

    Raises:
        FileNotFoundError: there is no such photograph.
        ValueError: it cannot be decoded or tells none, or the lens is in px.
    """
    focal = metadata_focal(source, read_photo(source)[1]) if lens.focal_unit == "mm" else None
    if focal is None:
        raise ValueError(
            f"The focal length of {os.fspath(source)} is not known: its EXIF data have none in "
            f"{lens.focal_unit}. Give it: --focal, a number or a CSV file image,focal."
        )
    return focal


def metadata_focal(source: str | os.PathLike[str], metadata: list[tuple[int, np.ndarray]]) -> float | None:
    """The focal length, mm, that a photograph's EXIF data tell, given what `read_photo` found in it."""
    blocks = [data.tobytes() for kind, data in metadata if kind == cv2.IMAGE_METADATA_EXIF]
    path = Path(source)
    if path.suffix.lower() in (".tif", ".tiff"):
        blocks = [path.read_bytes()]
    return next((exif_focal(block) for block in blocks), None)


def read_photo(source: str | os.PathLike[str]) -> tuple[np.ndarray, list[tuple[int, np.ndarray]]]:
    """The pixels as stored, and metadata (EXIF, XMP, colour profile) as pairs of kind and bytes.

    Raises:
        FileNotFoundError: there is no such photograph.
        ValueError: it cannot be decoded.
    """
    path = Path(source)
    if not path.exists():
        raise FileNotFoundError(f"There is no photograph {path}.")
    _check_whole(path)
    kinds, blocks = [], []
    if path.suffix.lower() in _NO_METADATA:
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    else:
        image, kinds, blocks = cv2.imreadWithMetadata(str(path), flags=cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError(f"Cannot read a photograph from {path}: it is damaged, or of an unknown format.")
    return image, [
        (int(kind), np.asarray(data, np.uint8)) for kind, data in zip(kinds, blocks, strict=True)
    ]


def _check_whole(path: Path) -> None:
    """Refuse an empty file, and a JPEG that is cut off: OpenCV fills up what is missing with grey."""
    content = path.read_bytes()
    if not content:
        raise ValueError(f"Cannot read a photograph from {path}: the file is empty.")
    if content[:2] == b"\xff\xd8" and not _ends(content):
        raise ValueError(f"Cannot read a photograph from {path}: the file is damaged or cut off.")


def _ends(jpeg: bytes) -> bool:
    """Whether a JPEG's first picture comes to its end; phones append films and other pictures."""
    at = 2
    while (mark := _MARK.search(jpeg, at)) is not None:
        if mark[0][1] == 0xD9:
            return True
        at = mark.end() + int.from_bytes(jpeg[mark.end() : mark.end() + 2], "big")
    return False


_MARK = re.compile(rb"\xff[^\x00\x01\xd0-\xd8\xff]", re.DOTALL)
"""What begins a segment, or ends the picture: not what pixels contain, nor what has no length."""


def _encoded(image: np.ndarray, suffix: str, metadata: list[tuple[int, np.ndarray]]) -> bytes:
    options = _OPTIONS.get(suffix, [])
    try:
        if metadata and suffix not in _NO_METADATA:
            kinds, blocks = zip(*metadata, strict=True)
            done, content = cv2.imencodeWithMetadata(suffix, image, list(kinds), list(blocks), options)
        else:
            done, content = cv2.imencode(suffix, image, options)
    except cv2.error as error:
        raise ValueError(f"Cannot write this photograph as {suffix}: {error.err}.") from error
    if not done:
        raise ValueError(f"Cannot write an image of {image.dtype} and shape {image.shape} as {suffix}.")
    return content.tobytes()
