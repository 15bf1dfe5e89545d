"""Photographs from file to file, corrected at the focal length in their EXIF data, metadata kept.

Pixels are taken as they are stored, before the orientation tag turns them: that is how the lens saw them.
The tag goes over with the other metadata, so that the result is shown the same way up.
"""

import contextlib
import io
import os
import stat
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from .._files import refuse_inputs, whole_file
from ..framing import Framing, framing_for_size
from ..io.exif import exif_focal
from ..lens import ZoomLens
from .headers import announced_size, jpeg_segments
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
        keep: as for `undistort_image`; a `Framing` for images of another size is scaled as the lens is.
        interpolation, border: as for `undistort_image`.

    Raises:
        FileNotFoundError: there is no such photograph.
        OSError: the target cannot be written; nothing is left of it.
        ValueError: the photograph cannot be decoded, tells no focal length, or has another aspect ratio
            than the lens; or the target is the photograph itself, its suffix is unknown, or its format does
            not hold such pixels.

    Warns:
        UserWarning: as `undistort_image` and `ZoomLens` do; or metadata are lost, as TIFF's are.
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
    if target.suffix.lower() not in _FORMATS:
        raise ValueError(
            f"Argument target must end in one of {', '.join(SUFFIXES)}, but it is {target.name!r}."
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
    if bits not in _FORMATS[suffix][0] or channels not in _FORMATS[suffix][1]:
        raise ValueError(
            f"Cannot write {channels} channels of {bits} bits, as in {os.fspath(source)}, to a {suffix} "
            "file: choose .png or .tif."
        )
    if focal is None:
        focal = photo_focal(source, lens)
    size = (image.shape[1], image.shape[0])
    corrected = undistort_image(
        image, lens, focal=focal, keep=keep(size), interpolation=interpolation, border=border
    )
    lost = Path(source).suffix.lower() in (".tif", ".tiff") or (metadata and suffix in _NO_METADATA)
    if lost:
        warnings.warn(
            f"Metadata of {os.fspath(source)} are not kept: OpenCV has none of TIFF and BMP files.",
            stacklevel=3,
        )
    return _encoded(corrected, suffix, metadata)


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
        with open_photo(path) as file:
            blocks = [file.read(_MOST_BYTES)]
    return next((exif_focal(block) for block in blocks), None)


def read_photo(source: str | os.PathLike[str]) -> tuple[np.ndarray, list[tuple[int, np.ndarray]]]:
    """The pixels as stored, and metadata (EXIF, XMP, colour profile) as pairs of kind and bytes.

    The header is looked at before anything is decoded, and what is no ordinary file is not opened.

    Raises:
        FileNotFoundError: there is no such photograph.
        OSError: it cannot be read.
        ValueError: it cannot be decoded, or has more than 500 million pixels or 4 GB.
    """
    path = Path(source)
    try:
        with open_photo(path) as file:
            content = file.read(_MOST_BYTES)
        if not content:
            raise ValueError("the file is empty")
        kind, width, height = announced_size(content)
        if width * height > _MOST_PIXELS:
            raise ValueError(f"its header announces {width}x{height} px, more than {_MOST_PIXELS:,} in all")
        if kind == "JPEG" and all(mark != _END for mark, _ in jpeg_segments(content)):
            raise ValueError("the file is damaged or cut off")  # OpenCV fills up what is missing with grey
        return _decoded(np.frombuffer(content, np.uint8), metadata=kind in ("JPEG", "PNG", "WebP"))
    except (ValueError, MemoryError) as error:
        reason = error if isinstance(error, ValueError) else "it takes more memory than there is"
        raise ValueError(f"Cannot read a photograph from {path}: {reason}.") from error


_MOST_BYTES = 4_000_000_000
_MOST_PIXELS = 500_000_000
"""Cameras that shift their sensor give 400 million; three bytes each, and five times that to find lines."""

_END = 0xD9
"""The marker at the end of a JPEG's picture; phones append films and other pictures."""


@contextlib.contextmanager
def open_photo(path: Path) -> Iterator[io.BufferedReader]:
    """The file for reading: one that has an end, and not a pipe, which would be waited for.

    Raises:
        FileNotFoundError: there is no such photograph.
        OSError: it cannot be read.
        ValueError: it is no ordinary file, or too large.
    """
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    try:
        descriptor = os.open(path, flags)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"There is no photograph {path}.") from error
    with open(descriptor, "rb") as file:
        about = os.fstat(descriptor)
        if not stat.S_ISREG(about.st_mode):
            raise ValueError("it is no ordinary file")
        if about.st_size > _MOST_BYTES:
            raise ValueError(f"it has {about.st_size / 1e9:.1f} GB, more than {_MOST_BYTES / 1e9:.0f}")
        yield file


def _decoded(content: np.ndarray, *, metadata: bool) -> tuple[np.ndarray, list[tuple[int, np.ndarray]]]:
    kinds, blocks = [], []
    try:
        if metadata:
            image, kinds, blocks = cv2.imdecodeWithMetadata(content, flags=cv2.IMREAD_UNCHANGED)
        else:
            image = cv2.imdecode(content, cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        if error.code == cv2.Error.StsNoMem:
            raise MemoryError from error
        raise ValueError(f"OpenCV cannot decode it ({error.err})") from error
    if image is None:
        raise ValueError("it is damaged, or of an unknown format")
    return image, [
        (int(kind), np.asarray(data, np.uint8)) for kind, data in zip(kinds, blocks, strict=True)
    ]


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
