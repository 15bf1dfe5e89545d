"""Correction of photo files at the focal length in their EXIF data, with their metadata.

Pixels are used as stored, before rotation by the orientation tag, because the lens model refers to these.
The tag is copied with the other metadata, so that the result is shown the same way up.
"""

import os
import warnings
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from .._core.files import refuse_inputs, whole_file
from ..io.photo import FORMATS, metadata_focal, read_focal, read_photo
from ..io.tiff import Metadata, encode_tiff
from ..models.lens import ZoomLens
from .framing import Framing, framing_for_size
from .image import undistort_image

_OPTIONS = {
    ".jpg": [
        *(cv2.IMWRITE_JPEG_QUALITY, 97),
        *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
    ],
    ".webp": [cv2.IMWRITE_WEBP_QUALITY, 101],  # above 100: without loss
}
_OPTIONS[".jpeg"] = _OPTIONS[".jpg"]

_NO_METADATA = (".bmp",)
"""Formats that hold no metadata."""


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
    """Correct a photo and write it to a new file, with its metadata.

    Args:
        source: the photo: JPEG, PNG, WebP, TIFF, BMP, or HEIC with the extra ``heic``. All its bits and
            channels are kept.
        target: the file to write, completely or not at all. Its suffix sets the format; JPEG in quality 97.
        lens: the lens; for another size of the same aspect ratio it is scaled.
        focal: focal length in the lens's unit; by default that in the EXIF data.
        keep: as for `undistort_image`; a `Framing` for images of another size is scaled as the lens is.
        interpolation, border: as for `undistort_image`.

    Raises:
        FileNotFoundError: there is no such photo.
        OSError: the target cannot be written; nothing is left of it.
        ValueError: the photo cannot be decoded, has no focal length, or has another aspect ratio than the
            lens; or the target is the photo itself, its suffix is unknown, or its format cannot store such
            pixels.

        Warns:
        UserWarning: as `undistort_image` and `ZoomLens` do; or metadata are lost, as in BMP files.
    """
    target = Path(target)
    check_target(target)
    refuse_inputs([target], [source])
    content = corrected_photo(
        source,
        target.suffix,
        lens=lens,
        focal=focal,
        keep=lambda size: framing_for_size(keep, size) if isinstance(keep, Framing) else keep,
        interpolation=interpolation,
        border=border,
    )
    with whole_file(target) as part:
        part.write_bytes(content)


def check_target(target: Path) -> None:
    """Refuse names of files that are no photographs.

    Raises:
        ValueError: the suffix is unknown.
    """
    if target.suffix.lower() not in FORMATS:
        raise ValueError(
            f"Argument target must end in one of {', '.join(FORMATS)}, but it is {target.name!r}."
        )


def corrected_photo(
    source: str | os.PathLike[str],
    suffix: str,
    *,
    lens: ZoomLens,
    focal: float | int | None,
    keep: Callable[[tuple[int, int]], str | Framing],
    interpolation: str,
    border: str,
) -> bytes:
    """What `undistort_photo` writes into a file with that suffix, and raises of the source.

    `keep` tells what to show, given the photograph's size.
    """
    suffix = suffix.lower()
    image, metadata = read_photo(source)
    bits, channels = 8 * image.dtype.itemsize, 1 if image.ndim == 2 else image.shape[2]
    if bits not in FORMATS[suffix][0] or channels not in FORMATS[suffix][1]:
        raise ValueError(
            f"Cannot write {channels} channels of {bits} bits, as in {os.fspath(source)}, to a {suffix} "
            "file: choose .png or .tif."
        )
    if focal is None:
        focal = _known(metadata_focal(metadata) if lens.focal_unit == "mm" else None, source, lens)
    size = (image.shape[1], image.shape[0])
    corrected = undistort_image(
        image, lens, focal=focal, keep=keep(size), interpolation=interpolation, border=border
    )
    if metadata and suffix in _NO_METADATA:
        warnings.warn(
            f"Metadata of {os.fspath(source)} are not kept: BMP files cannot store metadata.",
            stacklevel=3,
        )
    return _encoded(corrected, suffix, metadata)


def photo_focal(source: str | os.PathLike[str], lens: ZoomLens) -> float:
    """The focal length in a photograph's EXIF data, for a lens in mm. No pixel is decoded.

    Raises:
        FileNotFoundError: there is no such photograph.
        ValueError: it cannot be read or tells none, or the lens is in px.
    """
    return _known(read_focal(source) if lens.focal_unit == "mm" else None, source, lens)


def _known(focal: float | None, source: str | os.PathLike[str], lens: ZoomLens) -> float:
    if focal is None:
        raise ValueError(
            f"The focal length of {os.fspath(source)} is not known: its EXIF data have none in "
            f"{lens.focal_unit}. Give it (argument focal)."
        )
    return focal


def _encoded(image: np.ndarray, suffix: str, metadata: Metadata) -> bytes:
    if suffix in (".tif", ".tiff"):
        return encode_tiff(image, metadata)
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
