"""What a photo file tells besides its pixels, whatever its format; and the mark of what zoomjax has made.

The mark is a property in the XMP packet: EXIF data stay as they are, byte for byte, because the notes
of camera makers in them do not survive being moved.
"""

import dataclasses
import importlib.metadata
import re

from .exif import exif_with_size

NAMESPACE = "https://zoomjax.invalid/ns/1.0/"
"""Of zoomjax's properties in XMP: a name, which leads nowhere."""

GEOMETRIES = ("undistorted", "distorted")
"""What the mark can tell: that distortion was removed from a photo, or applied to it again."""


@dataclasses.dataclass(frozen=True)
class Metadata:
    """Metadata of a photo, or of a page of a TIFF file.

    Attributes:
        exif: EXIF data, from their TIFF header on; empty if there are none.
        xmp: the XMP packet, in UTF-8.
        icc: the colour profile.
        iptc: Photoshop's image resources, as in JPEG and TIFF files, which hold the IPTC data.
        comment: a comment in no known encoding.
        dpi: pixels per inch across and down, or None.
        shape: pixels across and down of one unknown length, where a file tells that these differ, or None.
        chunks: what only a file of the same format can hold: pairs of name and content.
    """

    exif: bytes = b""
    xmp: bytes = b""
    icc: bytes = b""
    iptc: bytes = b""
    comment: bytes = b""
    dpi: tuple[float, float] | None = None
    shape: tuple[int, int] | None = None
    chunks: tuple[tuple[bytes, bytes], ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "xmp", _in_utf8(self.xmp))


NAMES = {
    "exif": "EXIF data",
    "xmp": "XMP",
    "icc": "the colour profile",
    "iptc": "IPTC data",
    "comment": "the comment",
    "dpi": "the resolution",
    "shape": "the shape of the pixels",
}
"""How messages call the fields."""


def missing(metadata: Metadata, *held: str) -> list[str]:
    """Names of the fields that are filled but not among those that a format holds."""
    return [name for field, name in NAMES.items() if field not in held and getattr(metadata, field)]


def geometry_of(metadata: Metadata) -> str | None:
    """What the mark tells: "undistorted", "distorted", or None without a mark."""
    found = _mark(metadata, b"Geometry").decode("ascii", "replace")
    return found if found in GEOMETRIES else None


def work_of(metadata: Metadata) -> str | None:
    """What the mark tells of the work that made a photo; None where it tells nothing."""
    found = _mark(metadata, b"Work")
    return found.decode() if geometry_of(metadata) and re.fullmatch(rb"[0-9a-f]*", found) else None


def framing_of(metadata: Metadata) -> tuple[float, float, float] | None:
    """What the mark tells of a corrected photo's framing: scale and origin; None where it tells nothing."""
    try:
        scale, x, y = map(float, _mark(metadata, b"Framing").split())
    except ValueError:
        return None
    return (scale, x, y) if scale > 0 else None


def _mark(metadata: Metadata, name: bytes) -> bytes:
    """A property of zoomjax's, whichever program has written it down again; empty where there is none."""
    there = NAMESPACE.encode() in metadata.xmp
    return _property(metadata.xmp, b"zoomjax:" + name) if there else b""


def straightened_by(metadata: Metadata) -> str | None:
    """Which program says in a photo that it has corrected the distortion; None if none does.

    Adobe's programs, darktable and digiKam do, where they are left to write their settings into a photo.
    Cameras, and other programs, say nothing that can be relied on.
    """
    if geometry_of(metadata) == "undistorted":
        return "zoomjax"
    return next((name for name, says in _STRAIGHTENED.items() if says(metadata.xmp)), None)


def with_size(metadata: Metadata, before: tuple[int, int], after: tuple[int, int]) -> Metadata:
    """The metadata of an image of another size: EXIF data and XMP tell that where they told its own."""
    if before == after:
        return metadata
    return dataclasses.replace(
        metadata,
        exif=exif_with_size(metadata.exif, before, after),
        xmp=_xmp_with_size(metadata.xmp, before, after),
    )


def not_corrected_again(metadata: Metadata) -> Metadata:
    """The metadata without the order to Adobe's programs to correct the distortion of the photo.

    They follow it wherever the photo is opened. What they have done already stays told.
    """
    if not _ordered(metadata.xmp):
        return metadata
    xmp = metadata.xmp
    for name in (_PROFILE, _BY_HAND):
        xmp = re.sub(_property_of(b"crs:" + name), rb"\g<1>0", xmp)
    return dataclasses.replace(metadata, xmp=xmp)


def squeezed(metadata: Metadata) -> tuple[float, float] | None:
    """Pixels across and down of one length, where they differ: pixels are not square; else None."""
    across, down = metadata.shape or metadata.dpi or (1, 1)
    return (float(across), float(down)) if max(across, down) > _SQUARE * min(across, down) else None


def marked(
    metadata: Metadata, geometry: str, work: str = "", framing: tuple[float, float, float] | None = None
) -> Metadata:
    """The metadata with the mark, in place of an earlier one. The rest of the XMP packet stays as it is.

    Other programs that write a photo's XMP put the properties of the mark among their own, or in another
    form.

    Args:
        metadata: of the photo.
        geometry: what the photo is now.
        work: stands for all that the result depends on, in hexadecimal digits.
        framing: scale and origin of a corrected photo, as in `Framing`.
    """
    xmp = metadata.xmp
    for pattern in _EARLIER:
        xmp = pattern.sub(b"", xmp)
    version = importlib.metadata.version("zoomjax")
    shown = "" if framing is None else ' zoomjax:Framing="{!r} {!r} {!r}"'.format(*framing)
    description = (
        f'<rdf:Description rdf:about="" xmlns:zoomjax="{NAMESPACE}" zoomjax:Version="{version}" '
        f'zoomjax:Geometry="{geometry}" zoomjax:Work="{work}"{shown} xmlns:rdf="{_RDF}"/>'
    ).encode()
    if (end := _end(xmp)) is None:
        xmp, end = _EMPTY, _EMPTY.index(b"</rdf:RDF>")
    return dataclasses.replace(metadata, xmp=xmp[:end] + description + xmp[end:])


def has_no_place(metadata: Metadata) -> bool:
    """Whether there is an XMP packet that is damaged, so that `marked` leaves it out."""
    return bool(metadata.xmp.strip(b"\0 \n")) and _end(metadata.xmp) is None


def _end(xmp: bytes) -> int | None:
    """Where the properties of a packet end; None where it is damaged, or there is none."""
    ends = [found.start() for found in re.finditer(rb"</(?:[\w.-]+:)?RDF\s*>", xmp)]
    return ends[-1] if ends else None


_RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"

_EMPTY = (
    '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
    f'<rdf:RDF xmlns:rdf="{_RDF}"></rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
).encode()

_EARLIER = (
    re.compile(
        rb"<rdf:Description(\s+(rdf:about|xmlns:\w+|zoomjax:\w+)\s*=\s*(\"[^\"<]*\"|'[^'<]*'))*"
        rb"\s+zoomjax:\w+=[^<>]*/>"
    ),
    re.compile(rb"\s+zoomjax:\w+\s*=\s*(\"[^\"<]*\"|'[^'<]*')"),
    re.compile(rb"<zoomjax:(\w+)>[^<]*</zoomjax:\1>\s*"),
)
"""The mark in XMP: by itself, or among the attributes or elements of others."""

_SQUARE = 1.01
"""Ratio of a pixel's sides that is more than rounding."""


_PROFILE, _BY_HAND = b"LensProfileEnable", b"LensManualDistortionAmount"
"""Adobe's settings that correct distortion."""


def _by_adobe(xmp: bytes) -> bool:
    """Settings in a photo made from another file have been applied; elsewhere they are still to be."""
    return _set(xmp) and _setting(xmp, b"AlreadyApplied").lower() == b"true"


def _ordered(xmp: bytes) -> bool:
    return _set(xmp) and _setting(xmp, b"AlreadyApplied").lower() != b"true"


def _set(xmp: bytes) -> bool:
    profile, by_hand = _setting(xmp, _PROFILE), _setting(xmp, _BY_HAND)
    return profile not in (b"", b"0") or by_hand.strip(b"+-0.") != b""


def _setting(xmp: bytes, name: bytes) -> bytes:
    """One of Adobe's settings; empty where there is none."""
    return _property(xmp, b"crs:" + name)


def _property(xmp: bytes, name: bytes) -> bytes:
    """A simple property, in an attribute or an element of its own; empty where there is none."""
    found = re.search(_property_of(name), xmp)
    return b"" if found is None else found[2].strip()


def _property_of(name: bytes) -> bytes:
    """A pattern of a property: what is before its value, and the value."""
    return rb"((?<![/\w-])" + name + rb"(?:\s*=\s*[\"']|>))([^\"'<]*)"


_SIZES = ((b"tiff:ImageWidth", b"tiff:ImageLength"), (b"exif:PixelXDimension", b"exif:PixelYDimension"))
"""Properties that tell the size of an image."""


def _xmp_with_size(xmp: bytes, before: tuple[int, int], after: tuple[int, int]) -> bytes:
    for names in _SIZES:
        told = tuple(_property(xmp, name) for name in names)
        for one, other in ((before, after), (before[::-1], after[::-1])):
            if told == tuple(b"%d" % number for number in one):
                for name, number in zip(names, other, strict=True):
                    xmp = re.sub(_property_of(name), rb"\g<1>%d" % number, xmp)
                break
    return xmp


def _in_utf8(xmp: bytes) -> bytes:
    """A packet in UTF-8, in which nearly all are; those of other encodings begin with a mark or a zero."""
    marks = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16", b"<\0": "utf-16-le", b"\0<": "utf-16-be"}
    encoding = marks.get(xmp[:2])
    if encoding is None:
        return xmp
    try:
        return xmp.decode(encoding).removeprefix("\ufeff").encode()
    except UnicodeError:
        return xmp


_STRAIGHTENED = {
    "Adobe's lens correction": _by_adobe,
    "darktable": re.compile(
        rb"<rdf:li(?=[^>]*darktable:operation=.lens.)(?=[^>]*darktable:enabled=.1.)"
    ).search,
    "digiKam": re.compile(rb"digiKam:LensCorrectionSettings[^<]*Distortion Correction: enabled").search,
}
"""Programs, and whether an XMP packet says that they have corrected the distortion."""
