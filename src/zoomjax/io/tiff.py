"""TIFF files of one page or several: pixels as they are stored, and metadata.

Plain pages are decoded by tifffile. It needs a package of codecs for most ways of compressing, so OpenCV
decodes the others; metadata are read by Pillow, and all is written by tifffile.
"""

import dataclasses
import io
import logging
import struct
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import tifffile
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from .decoders import by_opencv
from .exif import parse_exif
from .metadata import Metadata

_BASE, _FOLDERS = ExifTags.Base, (ExifTags.IFD.Exif, ExifTags.IFD.GPSInfo)

_TEXTS = (
    *(_BASE.ImageDescription, _BASE.Make, _BASE.Model, _BASE.Software, _BASE.DateTime, _BASE.Artist),
    *(_BASE.HostComputer, _BASE.Copyright, _BASE.DocumentName, _BASE.PageName, _BASE.ProcessingSoftware),
)
_OF_WINDOWS = {
    **dict.fromkeys((_BASE.Rating, _BASE.RatingPercent), 3),
    **dict.fromkeys((_BASE.XPTitle, _BASE.XPComment, _BASE.XPAuthor, _BASE.XPKeywords, _BASE.XPSubject), 1),
}
"""What Windows lets users write into photos, and the type of each tag: a number, or bytes of UTF-16."""

_RESOLUTION = (_BASE.XResolution, _BASE.YResolution, _BASE.ResolutionUnit)
_DESCRIBING = (*_TEXTS, *_OF_WINDOWS, *_RESOLUTION, _BASE.Orientation, *_FOLDERS)
"""Tags that tell of the photograph, and not of how its pixels are stored."""

_OTHERS = (("xmp", 700, 1), ("icc", 34675, 7), ("iptc", 34377, 7))
"""Fields that are the content of one tag, and the tag's type."""

_IPTC = 33723
"""The tag of IPTC data by themselves, beside those in Photoshop's resources."""

logging.getLogger("tifffile").addHandler(logging.NullHandler())  # what is damaged is said by an error

_MOST_BYTES = 100_000_000  # of metadata
_MOST_PAGES = 10_000

_PLACES = {33550, 33922, 34264, 34735}
"""Tags of GeoTIFF that tie pixels to places."""

_PLAIN = {"NONE", "ADOBE_DEFLATE", "DEFLATE", "PACKBITS", "LZMA"}
"""Compressions that tifffile undoes by itself."""


@dataclasses.dataclass(frozen=True)
class TiffPage:
    """A page of a TIFF file.

    Attributes:
        image: the pixels as stored, with blue, green, red and alpha as OpenCV has them.
        metadata: the page's own.
        orientation: 1 to 8, which is not applied to the pixels.
        colours: what the file's colours are called, where `image` has others; else empty.
        notes: whether the page holds notes of the camera's maker, which `metadata` lacks.
        others: what else the page holds that is in neither.
    """

    image: np.ndarray
    metadata: Metadata
    orientation: int
    colours: str
    notes: bool
    others: tuple[str, ...] = ()


def read_tiff(content: bytes, *, most_pages: int = _MOST_PAGES) -> list[TiffPage]:
    """The pages of a TIFF file, or the first of them.

    Raises:
        ValueError: it is damaged, or its pixels are stored in a way that cannot be decoded.
    """
    with _opened(content) as file:
        return [_page(content, file, number) for number in range(min(_number(file), most_pages))]


def tiff_size(content: bytes) -> int:
    """The number of pixels of all pages, as their headers tell; raises as `read_tiff`."""
    with _opened(content) as file:
        return sum(int(np.prod(file.pages[number].shape[:2])) for number in range(_number(file)))


def tiff_pages(content: bytes) -> int:
    """The number of pages that are as large as the first, as previews are not; raises as `read_tiff`."""
    with _opened(content) as file:
        shapes = [file.pages[number].shape for number in range(_number(file))]
        return shapes.count(shapes[0]) if shapes else 0


def _opened(content: bytes) -> tifffile.TiffFile:
    try:
        return tifffile.TiffFile(io.BytesIO(content))
    except Exception as error:  # of many kinds where offsets lead nowhere
        raise ValueError("the file is damaged or cut off") from error


def _number(file: tifffile.TiffFile) -> int:
    try:
        return len(file.pages)
    except Exception as error:  # as above
        raise ValueError("the file is damaged or cut off") from error


def _page(content: bytes, file: tifffile.TiffFile, number: int) -> TiffPage:
    try:
        page: Any = file.pages[number]
        metadata, orientation = tiff_metadata(content, page)
        image = _plain(page)
        separate = page.planarconfig == 2 and page.samplesperpixel > 1
        kind = getattr(page.photometric, "name", str(page.photometric))
        compression = getattr(page.compression, "name", str(page.compression))
        folder = page.tags.valueof(int(ExifTags.IFD.Exif))
        notes = isinstance(folder, dict) and "MakerNote" in folder
        others = _others(page)
    except MemoryError:
        raise
    except Exception as error:  # as above
        raise ValueError("the file is damaged or cut off") from error
    if not 1 <= page.samplesperpixel <= 4:
        raise ValueError(
            f"it has {page.samplesperpixel} channels, and photos have up to 4, of colours and "
            "transparency: save each channel as a page, in grey"
        )
    if image is None and separate and page.dtype != np.uint8:
        # OpenCV takes its planes for interleaved, and shows noise.
        raise ValueError(f"its colours are stored one after the other and compressed ({compression})")
    if image is None and page.samplesperpixel == 2:
        raise ValueError(f"it is grey with transparency, and compressed ({compression})")  # OpenCV drops it
    if image is None and (page.dtype is None or page.dtype == np.float16 or page.dtype.kind not in "biuf"):
        raise ValueError(f"its numbers ({page.dtype}, compressed by {compression}) cannot be decoded")
    if image is None:
        image = as_stored(_by_opencv(_as_it_is(content, page), number), orientation)  # which it turns
        image = _white_up(image, page) if kind == "MINISWHITE" else image
    return TiffPage(image, metadata, orientation, _COLOURS.get(kind, kind), notes, others)


CMYK = "the four colours of print (CMYK)"

_COLOURS = {
    **dict.fromkeys(("MINISWHITE", "MINISBLACK", "RGB", "PALETTE", "YCBCR"), ""),
    "SEPARATED": CMYK,
    **dict.fromkeys(("CIELAB", "ICCLAB", "ITULAB"), "Lab colours, many of which RGB does not have"),
    **dict.fromkeys(("CFA", "LINEAR_RAW"), "the colours of a sensor"),
}
"""Names of colours in TIFF files, by tifffile's; empty where the decoded pixels are the same."""


def _others(page: Any) -> tuple[str, ...]:
    """What a page holds that is lost when it is written again."""
    tags = {tag.code for tag in page.tags}
    lost = ["further pictures"] if page.subifds else []
    if tags & _PLACES:
        lost.append("the place on a map, which does not hold for a corrected image")
    extra = tuple(map(int, page.extrasamples))
    if page.samplesperpixel in (2, 4) and extra and extra[-1] != 2:  # it is written as transparency alone
        known = "the mark that colours are multiplied by transparency"
        lost.append(known if extra[-1] == 1 else "the mark that the last channel is no transparency")
    return tuple(lost)


def _plain(page: Any) -> np.ndarray | None:
    """A page decoded by tifffile, exactly as stored; None if OpenCV has to."""
    if (
        page.compression.name not in _PLAIN
        or page.photometric.name not in ("MINISBLACK", "RGB")
        or page.dtype not in (np.uint8, np.uint16, np.float16, np.float32, np.float64)
        or page.bitspersample != 8 * np.dtype(page.dtype).itemsize
        or page.samplesperpixel not in (1, 2, 3, 4)
        or page.predictor not in (1, 2)
    ):
        return None
    values = page.asarray()
    if page.planarconfig == 2 and page.samplesperpixel > 1:
        values = np.moveaxis(values, 0, -1)
    if values.ndim not in (2, 3):
        return None
    if values.ndim == 3:
        # Grey with transparency becomes colours with it, as of PNG files.
        values = values[..., [0, 0, 0, 1] if values.shape[2] == 2 else [2, 1, 0, 3][: values.shape[2]]]
    native = values.dtype.newbyteorder("=") if values.dtype != np.float16 else np.float32  # OpenCV lacks it
    return np.ascontiguousarray(values.astype(native, copy=False))


def _as_it_is(content: bytes, page: Any) -> bytes:
    """The file with transparency that OpenCV does not know as such: it would multiply colours by it."""
    tag = page.tags.get(_EXTRA_SAMPLES)
    if page.samplesperpixel != 4 or tag is None or tag.valueoffset + 2 > len(content):
        return content
    return content[: tag.valueoffset] + bytes(2) + content[tag.valueoffset + 2 :]


_EXTRA_SAMPLES = 338
"""The tag of what the channels beyond the colours are; 0 is unspecified."""


def _white_up(image: np.ndarray, page: Any) -> np.ndarray:
    """An image in which white is 0, with black as 0; OpenCV does it with 8 bits and fewer."""
    if page.dtype.kind in "bu" and page.bitspersample <= 8:
        return image
    if image.dtype.kind != "u" or page.bitspersample != 8 * image.dtype.itemsize:
        numbers = f"{page.dtype} numbers of {page.bitspersample} bits"
        raise ValueError(f"in it white is 0, and what black is in {numbers} is not known: save it as RGB")
    return np.iinfo(image.dtype).max - image


def _by_opencv(content: bytes, number: int) -> np.ndarray:
    _, found = by_opencv(cv2.imdecodemulti, content, range=(number, number + 1))
    if not found:
        raise ValueError("it is damaged, or of an unknown format")
    return np.asarray(found[0])


def tiff_metadata(content: bytes, page: Any = None) -> tuple[Metadata, int]:
    """The metadata of one of tifffile's pages, else of the first, and its orientation, 1 to 8."""
    exif = parse_exif(io.BytesIO(content), None if page is None else page.offset)
    if exif is None:
        return Metadata(), 1
    fields = {name: exif.get(tag) for name, tag, _ in _OTHERS}
    iptc = _content_of(_IPTC, content, page) if _IPTC in exif and not fields["iptc"] else b""
    dpi = _dpi(exif)
    for tag in set(exif) - set(_DESCRIBING):
        del exif[tag]
    orientation = orientation_of(exif)
    fields["exif"] = exif.tobytes().removeprefix(b"Exif\0\0") if len(exif) else b""
    if iptc:
        fields["iptc"] = _resource(iptc)
    known: dict[str, Any] = {
        k: v for k, v in fields.items() if isinstance(v, bytes) and len(v) < _MOST_BYTES
    }
    return Metadata(**known, dpi=dpi), orientation


def _content_of(tag: int, content: bytes, page: Any) -> bytes:
    """The bytes of a tag, whatever its type: those of IPTC data are said to be whole numbers, often."""
    try:
        with _opened(content) as file:
            first: Any = file.pages[0]
            found = (first if page is None else page).tags[tag]
            return content[found.valueoffset :][: found.valuebytecount]
    except Exception:  # as in `_opened`
        return b""


def _dpi(exif: Image.Exif) -> tuple[float, float] | None:
    across, down, unit = (exif.get(tag) for tag in _RESOLUTION)
    if unit == 1 or across is None or down is None or not (0 < across < 1e6 and 0 < down < 1e6):
        return None
    inch = 2.54 if unit == 3 else 1.0
    return float(across) * inch, float(down) * inch


_RESOURCE = b"8BIM\x04\x04\0\0"
"""What IPTC data begin with among Photoshop's resources."""


def _resource(iptc: bytes) -> bytes:
    """IPTC data as one of Photoshop's resources."""
    return _RESOURCE + struct.pack(">I", len(iptc)) + iptc + bytes(len(iptc) % 2)


def _iptc_of(resources: bytes) -> bytes:
    """The IPTC data among Photoshop's resources; empty if there are none."""
    _, found, after = resources.partition(_RESOURCE)
    return after[4 : 4 + int.from_bytes(after[:4], "big")] if found else b""


def orientation_of(exif: Image.Exif) -> int:
    """1 to 8; 1, upright, if it is not known."""
    orientation: Any = exif.get(_BASE.Orientation)
    return orientation if orientation in range(1, 9) else 1


def _bytes(text: Any) -> bytes:
    """The bytes of a text as Pillow reads it, of whatever encoding."""
    return str(text).encode("latin-1", "replace")


def as_stored(image: np.ndarray, orientation: int) -> np.ndarray:
    """An image that a decoder has turned by its orientation, 1 to 8, as it was before."""
    if orientation > 4:
        image = image.swapaxes(0, 1)
    down, across = orientation in (3, 4, 6, 7), orientation in (2, 3, 7, 8)
    return np.ascontiguousarray(image[:: -1 if down else 1, :: -1 if across else 1])


def encode_tiff(pages: Sequence[tuple[np.ndarray, Metadata]]) -> bytes:
    """A TIFF file, without loss, of images as OpenCV has them, each with its metadata."""
    content, folders = io.BytesIO(), []
    with tifffile.TiffWriter(content, byteorder="<", bigtiff=is_big(pages)) as file:
        for image, metadata in pages:
            folders.append(_append(file, image, metadata, folders=not is_big(pages)))
    _put_folders(content, folders)
    return content.getvalue()


def is_big(pages: Sequence[tuple[np.ndarray, Metadata]]) -> bool:
    """Whether offsets of 32 bits may not reach over all pages: then folders of EXIF data are left out."""
    return sum(image.nbytes for image, _ in pages) > 2**32 - 2**26


def _append(
    file: tifffile.TiffWriter, image: np.ndarray, metadata: Metadata, *, folders: bool
) -> dict[int, dict[int, Any]]:
    """Write a page; the folders that it lacks still."""
    exif = parse_exif(io.BytesIO(metadata.exif)) or Image.Exif()
    blocks = {name: getattr(metadata, name) for name, _, _ in _OTHERS}
    tags: list[Any] = [(tag, 2, 0, _bytes(exif[tag]), True) for tag in _TEXTS if tag in exif]
    for tag, kind in _OF_WINDOWS.items():
        value: Any = exif.get(tag)
        if isinstance(value, bytes | int) and isinstance(value, bytes) == (kind == 1):
            tags.append((tag, kind, len(value) if isinstance(value, bytes) else 1, value, True))
    tags += [(tag, kind, len(blocks[of]), blocks[of], True) for of, tag, kind in _OTHERS if blocks[of]]
    if iptc := _iptc_of(metadata.iptc):
        tags.append((_IPTC, 7, len(iptc), iptc, True))
    if exif.get(_BASE.Orientation) in range(1, 9):
        tags.append((_BASE.Orientation, 3, 1, exif[_BASE.Orientation], True))
    later = {int(tag): folder for tag in _FOLDERS if folders and (folder := exif.get_ifd(tag))}
    tags += [(tag + 1, 4, 1, 0, True) for tag in later]
    integers = image.dtype.kind == "u"
    channels = 1 if image.ndim == 2 else image.shape[2]
    dpi = metadata.dpi or _dpi(exif)
    file.write(
        image if channels == 1 else image[..., [2, 1, 0, 3][:channels]],
        photometric="minisblack" if channels == 1 else "rgb",
        extrasamples=["unassalpha"] if channels == 4 else None,
        compression="zlib" if integers else None,
        compressionargs={"level": 1} if integers else None,
        predictor=integers,
        rowsperstrip=64,
        metadata=None,
        software=False,
        extratags=tags,
        **({"resolution": dpi, "resolutionunit": 2} if dpi else {}),
    )
    return later


def _put_folders(content: io.BytesIO, folders: Sequence[dict[int, dict[int, Any]]]) -> None:
    """Append each page's folders of EXIF data, which tifffile does not write.

    It does not even write tags that lead to them: so they get these tags' numbers here, one less.
    """
    content.seek(0)
    places = []
    with tifffile.TiffFile(content) as file:
        for page, own in zip(file.pages, folders, strict=True):
            for tag in own:
                entry = page.aspage().tags[tag + 1]
                places.append((own[tag], tag, entry.offset, entry.valueoffset))
    for of, tag, entry, value in places:
        folder = ImageFileDirectory_v2(b"II*\0\0\0\0\0", group=tag)
        for key, what in of.items():
            folder[key] = what
        at = content.seek(0, io.SEEK_END)
        content.write(folder.tobytes(at))
        for place, field in ((entry, struct.pack("<H", tag)), (value, struct.pack("<I", at))):
            content.seek(place)
            content.write(field)
