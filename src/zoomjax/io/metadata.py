"""What a photo file tells besides its pixels, whatever its format; and the mark of what zoomjax has made.

The mark is a property in the XMP packet: EXIF data stay as they are, byte for byte, because the notes
of camera makers in them do not survive being moved.
"""

import dataclasses
import importlib.metadata
import re

NAMESPACE = "https://zoomjax.invalid/ns/1.0/"
"""Of zoomjax's properties in XMP: a name, which leads nowhere."""

GEOMETRIES = ("undistorted", "distorted")
"""What the mark can tell: that distortion was removed from a photo, or applied to it again."""


@dataclasses.dataclass(frozen=True)
class Metadata:
    """Metadata of a photo, or of a page of a TIFF file.

    Attributes:
        exif: EXIF data, from their TIFF header on; empty if there are none.
        xmp: the XMP packet.
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
    found = _MARK.search(metadata.xmp)
    return None if found is None else found[1].decode()


def work_of(metadata: Metadata) -> str | None:
    """What the mark tells of the work that made a photo; None where it tells nothing."""
    found = _WORK.search(metadata.xmp)
    return None if found is None else found[1].decode()


def framing_of(metadata: Metadata) -> tuple[float, float, float] | None:
    """What the mark tells of a corrected photo's framing: scale and origin; None where it tells nothing."""
    if (found := _FRAMING.search(metadata.xmp)) is None:
        return None
    try:
        scale, x, y = map(float, found[1].split())
    except ValueError:
        return None
    return (scale, x, y) if scale > 0 else None


def straightened_by(metadata: Metadata) -> str | None:
    """Which program says in a photo that it has corrected the distortion; None if none does.

    Adobe's programs, darktable and digiKam do, where they are left to write their settings into a photo.
    Cameras, and other programs, say nothing that can be relied on.
    """
    if geometry_of(metadata) == "undistorted":
        return "zoomjax"
    return next((name for name, says in _STRAIGHTENED.items() if says(metadata.xmp)), None)


def squeezed(metadata: Metadata) -> tuple[float, float] | None:
    """Pixels across and down of one length, where they differ: pixels are not square; else None."""
    across, down = metadata.shape or metadata.dpi or (1, 1)
    return (float(across), float(down)) if max(across, down) > _SQUARE * min(across, down) else None


def marked(
    metadata: Metadata, geometry: str, work: str = "", framing: tuple[float, float, float] | None = None
) -> Metadata:
    """The metadata with the mark, in place of an earlier one. The rest of the XMP packet stays as it is.

    Args:
        metadata: of the photo.
        geometry: what the photo is now.
        work: stands for all that the result depends on, in hexadecimal digits.
        framing: scale and origin of a corrected photo, as in `Framing`.
    """
    xmp = _DESCRIPTION.sub(b"", metadata.xmp)
    version = importlib.metadata.version("zoomjax")
    shown = "" if framing is None else ' zoomjax:Framing="{!r} {!r} {!r}"'.format(*framing)
    description = (
        f'<rdf:Description rdf:about="" xmlns:zoomjax="{NAMESPACE}" zoomjax:Version="{version}" '
        f'zoomjax:Geometry="{geometry}" zoomjax:Work="{work}"{shown} xmlns:rdf="{_RDF}"/>'
    ).encode()
    end = max(xmp.rfind(f"</{prefix}:RDF>".encode()) for prefix in ("rdf", "RDF"))
    if end < 0:  # no packet, or one that is damaged, or in UTF-16, which only old programs wrote
        xmp, end = _EMPTY, _EMPTY.index(b"</rdf:RDF>")
    return dataclasses.replace(metadata, xmp=xmp[:end] + description + xmp[end:])


_RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"

_EMPTY = (
    '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
    f'<rdf:RDF xmlns:rdf="{_RDF}"></rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
).encode()

_DESCRIPTION = re.compile(rb'<rdf:Description [^<>]*xmlns:zoomjax="[^<>]*/>')

_WORK = re.compile(
    re.escape(f'xmlns:zoomjax="{NAMESPACE}"').encode() + rb'[^<>]*zoomjax:Work="([0-9a-f]*)"'
)

_FRAMING = re.compile(
    re.escape(f'xmlns:zoomjax="{NAMESPACE}"').encode() + rb'[^<>]*zoomjax:Framing="([-+.0-9e ]*)"'
)

_MARK = re.compile(
    re.escape(f'xmlns:zoomjax="{NAMESPACE}"').encode()
    + rb'[^<>]*zoomjax:Geometry="('
    + "|".join(GEOMETRIES).encode()
    + rb')"'
)

_SQUARE = 1.01
"""Ratio of a pixel's sides that is more than rounding."""


def _by_adobe(xmp: bytes) -> bool:
    """Settings in a photo made from another file have been applied; elsewhere they are still to be."""
    profile, by_hand = _setting(xmp, b"LensProfileEnable"), _setting(xmp, b"LensManualDistortionAmount")
    used = profile not in (b"", b"0") or by_hand.strip(b"+-0.") != b""
    return used and _setting(xmp, b"AlreadyApplied").lower() == b"true"


def _setting(xmp: bytes, name: bytes) -> bytes:
    """One of Adobe's settings, in an attribute or an element of its own; empty where there is none."""
    found = re.search(rb"crs:" + name + rb"(?:\s*=\s*[\"']|>)\s*([^\"'<]*?)\s*[\"'<]", xmp)
    return b"" if found is None else found[1]


_STRAIGHTENED = {
    "Adobe's lens correction": _by_adobe,
    "darktable": re.compile(
        rb"<rdf:li(?=[^>]*darktable:operation=.lens.)(?=[^>]*darktable:enabled=.1.)"
    ).search,
    "digiKam": re.compile(rb"digiKam:LensCorrectionSettings[^<]*Distortion Correction: enabled").search,
}
"""Programs, and whether an XMP packet says that they have corrected the distortion."""
