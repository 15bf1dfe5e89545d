"""WebP files: their chunks of metadata, and pictures with transparency by Pillow.

OpenCV before its version 5 changes colours under pixels that do not show, also where it compresses without
loss.
"""

import io
import struct
from collections.abc import Iterator

import numpy as np
from PIL import Image

from .metadata import Metadata

_EFFORT = 70
"""Of lossless compression: that of OpenCV, with files of the same size in the same time."""


def encode_transparent_webp(image: np.ndarray, metadata: Metadata) -> bytes:
    """A WebP file of blue, green, red and alpha without loss, also of colours that do not show.

    Raises:
        ValueError: Pillow cannot write it, such as too large an image.
    """
    content = io.BytesIO()
    more = {"exif": metadata.exif, "xmp": metadata.xmp, "icc_profile": metadata.icc}
    picture = Image.fromarray(np.ascontiguousarray(image[..., [2, 1, 0, 3]]))
    try:
        picture.save(content, "WEBP", lossless=True, exact=True, quality=_EFFORT, **more)
    except (OSError, KeyError, ValueError) as error:
        raise ValueError(f"it cannot be written as .webp: {error}") from error
    return content.getvalue()


def webp_metadata(content: bytes) -> tuple[Metadata, list[str]]:
    """The metadata of a WebP file, and what else it holds that is lost when it is written again."""
    chunks: dict[bytes, bytes] = {}
    for name, block in _chunks(content):
        chunks.setdefault(name, block)
    exif = chunks.get(b"EXIF", b"").removeprefix(b"Exif\0\0")
    metadata = Metadata(exif=exif, xmp=chunks.get(b"XMP ", b""), icc=chunks.get(b"ICCP", b""))
    return metadata, ["further pictures"] if b"ANIM" in chunks else []


def _chunks(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    at = 12
    while len(head := content[at : at + 8]) == 8:
        name, size = struct.unpack("<4sI", head)
        yield name, content[at + 8 : at + 8 + size]
        at += 8 + size + size % 2
