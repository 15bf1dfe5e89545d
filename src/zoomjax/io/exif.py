"""EXIF data, read and written by Pillow: where they are in a file, and the focal length in them.

No pixel is decoded. That is why `find_exif` searches the chunks of PNG and WebP files itself:
Pillow decodes a PNG to find what is behind its pixels, and takes the memory of two pictures for a WebP.
"""

import io
import math
import struct
import warnings
from collections.abc import Callable, Iterator, MutableMapping
from typing import Any, NamedTuple

from PIL import ExifTags, Image
from PIL.JpegImagePlugin import JpegImageFile
from PIL.TiffImagePlugin import IFDRational

from .._core.arguments import check_kind
from .._core.checks import check_above
from .bigtiff import is_bigtiff, usual_tags

File = io.BytesIO | io.BufferedReader
"""What is read, at its beginning."""

_PREFIX = b"Exif\0\0"
_FINENESS = 10_000  # parts of a mm
_UNKNOWN = 2**32 - 1  # as numerator
_FORMS = {3: "H", 4: "I"}  # of whole numbers of 16 and 32 bits, by their type


def exif_focal(block: bytes) -> float | None:
    """The focal length, mm, in EXIF data or at the start of a TIFF file; None if they hold none."""
    check_kind("block", block, (bytes, bytearray))
    exif = parse_exif(io.BytesIO(block.removeprefix(_PREFIX)))
    focal = None if exif is None else exif.get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.FocalLength)
    if isinstance(focal, IFDRational) and (not focal.denominator or focal.numerator == _UNKNOWN):
        return None
    if not isinstance(focal, IFDRational | float | int):  # the standard's type, or one that some write
        return None
    return float(focal) if math.isfinite(focal) and focal > 0 else None


def exif_with_focal(focal: float) -> bytes:
    """EXIF data that hold a focal length, mm, and nothing else."""
    check_above(0, focal=focal)
    exif = Image.Exif()
    fraction = IFDRational(round(focal * _FINENESS), _FINENESS)
    exif[ExifTags.IFD.Exif] = {ExifTags.Base.FocalLength: fraction}
    return exif.tobytes().removeprefix(_PREFIX)


def exif_with_orientation(block: bytes, orientation: int) -> bytes:
    """EXIF data with this orientation, 1 to 8, in the place of their own; all else stays byte for byte.

    Data without an orientation are written anew with it, unless it is 1.
    """
    if place := _place(block, ExifTags.Base.Orientation):
        return _with_number(block, place, orientation)
    if orientation == 1:
        return block
    exif = parse_exif(io.BytesIO(block)) or Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    return exif.tobytes().removeprefix(_PREFIX)


def exif_with_size(block: bytes, before: tuple[int, int], after: tuple[int, int]) -> bytes:
    """EXIF data with another width and height, px, where they tell these, or both exchanged.

    All else stays byte for byte.
    """
    for tags in _SIZES:
        across, down = (_place(block, tag) for tag in tags)
        if across is None or down is None:
            continue
        told = across.number(block), down.number(block)
        if told in (before, before[::-1]):
            wide, high = after if told == before else after[::-1]
            block = _with_number(_with_number(block, across, wide), down, high)
    return block


def exif_in_srgb(block: bytes) -> bytes:
    """EXIF data of an image in sRGB: they tell no other colour space, if they tell one."""
    exif = parse_exif(io.BytesIO(block))
    own = {} if exif is None else exif.get_ifd(ExifTags.IFD.Exif)
    if exif is None or own.get(ExifTags.Base.ColorSpace, _SRGB) == _SRGB:
        return block
    own[ExifTags.Base.ColorSpace] = _SRGB
    own.pop(ExifTags.IFD.Interop, None)  # which tells it in another way
    return exif.tobytes().removeprefix(_PREFIX)


_SRGB = 1

_SIZES = (
    (ExifTags.Base.ImageWidth, ExifTags.Base.ImageLength),
    (ExifTags.Base.ExifImageWidth, ExifTags.Base.ExifImageHeight),
)
"""Tags by which EXIF data tell the size of their image."""


class _Place(NamedTuple):
    """Where EXIF data hold a whole number, and in which form."""

    at: int
    form: str

    def number(self, block: bytes) -> int:
        return struct.unpack_from(self.form, block, self.at)[0]


def _with_number(block: bytes, place: _Place, number: int) -> bytes:
    """EXIF data with another number in a place; as they are where it is too large for that."""
    try:
        written = struct.pack(place.form, number)
    except struct.error:
        return block
    return block[: place.at] + written + block[place.at + len(written) :]


def _place(block: bytes, tag: int) -> _Place | None:
    """Where a tag's whole number is, in the first folder or that of EXIF's own; None if it has none."""
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(block[:4])
    if order is None:
        return None
    try:
        [first] = struct.unpack_from(f"{order}I", block, 4)
        entries = {name: (kind, at) for name, kind, at in _entries(block, first, order)}
        if tag not in entries and ExifTags.IFD.Exif in entries:
            [own] = struct.unpack_from(f"{order}I", block, entries[ExifTags.IFD.Exif][1])
            entries = {name: (kind, at) for name, kind, at in _entries(block, own, order)}
        kind, at = entries.get(tag, (0, 0))
        place = _Place(at, order + _FORMS[kind]) if kind in _FORMS else None
        if place is not None:
            place.number(block)
    except struct.error:  # damaged or cut off
        return None
    return place


def _entries(block: bytes, folder: int, order: str) -> Iterator[tuple[int, int, int]]:
    """Of each value by itself in a folder: its tag, its type, and where it is if it is short."""
    [number] = struct.unpack_from(f"{order}H", block, folder)
    for at in range(folder + 2, folder + 2 + 12 * number, 12):
        tag, kind, count = struct.unpack_from(f"{order}HHI", block, at)
        if count == 1:
            yield tag, kind, at + 8


def parse_exif(file: File, offset: int | None = None) -> Image.Exif | None:
    """The EXIF data of a TIFF file, which EXIF data are by themselves; None if they are damaged.

    An offset leads to another page than the first.
    """
    exif, head = Image.Exif(), file.read(16)
    file.seek(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of damage, which does not matter unless the focal length is gone
        try:
            if is_bigtiff(head):
                exif.load_from_fp(io.BytesIO(usual_tags(file.read(), offset)))
            elif offset is None:
                exif.load_from_fp(file)
            else:
                _load_page(exif, file, offset)
            own = exif.get_ifd(ExifTags.IFD.Exif)
            if ExifTags.IFD.Interop in own:  # else only the place where it was
                own[ExifTags.IFD.Interop] = dict(exif.get_ifd(ExifTags.IFD.Interop))
            for folder in (ExifTags.IFD.Exif, ExifTags.IFD.GPSInfo):
                _keep_texts(exif.get_ifd(folder))  # read while warnings are caught
            _keep_texts(exif)
        except Exception:  # Pillow raises errors of many kinds where offsets lead nowhere
            return None
    return exif


class _Text(str):
    """A text in EXIF data, whatever its encoding: Pillow reads bytes as Latin 1, and writes ASCII alone."""

    def encode(self, encoding: str = "latin-1", errors: str = "replace") -> bytes:
        """The bytes that were read."""
        return super().encode("latin-1", "replace")


def _keep_texts(folder: MutableMapping[int, Any]) -> None:
    for tag, value in list(folder.items()):
        if isinstance(value, str):
            folder[tag] = _Text(value)


def _load_page(exif: Image.Exif, file: File, offset: int) -> None:
    """Load what a TIFF file has at an offset, in the file's own order of bytes."""
    head = file.read(8)
    exif.endian = "<" if head[:2] == b"II" else ">"
    exif.load_from_fp(file, offset)


def find_exif(file: File, kind: str) -> bytes | None:
    """The EXIF data of a file of a kind such as "JPEG", PNG, WebP or TIFF; None if it holds none."""
    try:
        if kind == "JPEG":
            return JpegImageFile(file).info.get("exif")
        if kind == "PNG":
            return _find_chunk(file, 8, ">I4s", b"eXIf", lambda size: size + 4)  # and a checksum
        if kind == "TIFF" and (exif := parse_exif(file)) is not None:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of IPTC data in whole numbers, as exiftool writes them
                return exif.tobytes()
        if kind == "WebP":
            return _find_chunk(file, 12, "<4sI", b"EXIF", lambda size: size + size % 2)
    except Exception:  # as above
        return None
    return None


def _find_chunk(
    file: File, start: int, layout: str, wanted: bytes, length: Callable[[int], int]
) -> bytes | None:
    """The content of the first chunk of a name."""
    file.seek(start)
    while len(head := file.read(8)) == 8:
        fields = struct.unpack(layout, head)
        size, name = sorted(fields, key=lambda field: isinstance(field, bytes))
        if name == wanted:
            return file.read(size)
        file.seek(length(size), io.SEEK_CUR)
    return None
