"""AVIF photos by Pillow; those of more than eight bits, of which it drops the others, by OpenCV.

Both decode pixels as stored. Pillow tells how to turn them in the EXIF data.
"""

import contextlib
import io
import warnings
from collections.abc import Generator

import cv2
import numpy as np
from PIL import Image, features

from .heic import metadata_in, shows_a_part
from .metadata import Metadata

_QUALITY = 95
"""At which differences do not show; the encoder has no lossless one."""

_DEEP, _TWELVE = 0x40, 0x20
"""Flags in the third byte of an AV1 configuration: more than 8 bits, and 12 instead of 10."""


@contextlib.contextmanager
def _quiet() -> Generator[None, None, None]:
    """Pillow warns of damaged EXIF data, many times a file: they do not matter unless f is gone."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def avif_size(content: bytes) -> tuple[int, int]:
    """Width and height. No pixel is decoded.

    Raises:
        ValueError: Pillow lacks AVIF, or cannot read it.
    """
    return _opened(content).size


def avif_metadata(content: bytes) -> Metadata:
    """EXIF data, XMP and colour profile. No pixel is decoded; raises as `avif_size`."""
    return metadata_in(_opened(content).info)


@_quiet()
def decode_avif(content: bytes) -> tuple[np.ndarray, Metadata, list[str]]:
    """The pixels as stored, as OpenCV has them, metadata, and what else there is. Raises as `avif_size`."""
    picture = _opened(content)
    bits = _bits(content)
    try:
        if bits > 8:
            image = np.asarray(cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED))
            if image.dtype != np.uint16:
                raise ValueError
            image = (image << (16 - bits)) | (image >> (2 * bits - 16))  # all of 0 to 65535
        else:
            image = np.array(picture)
            image = image[..., [2, 1, 0, 3][: image.shape[2]]] if image.ndim == 3 else image
    except MemoryError:
        raise
    except Exception as error:  # of whatever kind the decoders' are
        raise ValueError("the file is damaged or cut off") from error
    more = ["further pictures"] if getattr(picture, "n_frames", 1) > 1 else []
    more += ["that a part of the pixels alone is to be shown"] if shows_a_part(content) else []
    return np.ascontiguousarray(image), metadata_in(picture.info), more


@_quiet()
def encode_avif(image: np.ndarray, metadata: Metadata) -> bytes:
    """An AVIF file of 8 bits, colours at full resolution."""
    content = io.BytesIO()
    blocks = {"exif": _as_it_is(metadata.exif), "xmp": metadata.xmp, "icc_profile": metadata.icc}
    picture = Image.fromarray(np.ascontiguousarray(image[..., [2, 1, 0, 3][: image.shape[2]]]))
    given = {name: block for name, block in blocks.items() if block}
    picture.save(content, "AVIF", quality=_QUALITY, subsampling="4:4:4", **given)
    return content.getvalue()


class _Exif(Image.Exif):
    """EXIF data of which Pillow takes the orientation, and which it does not write anew.

    It would damage texts that are not ASCII, and lose thumbnails and what is at a certain place.
    """

    block = b""

    def __bool__(self) -> bool:
        """Whether there are any, though Pillow may read nothing of them."""
        return bool(self.block)

    def tobytes(self, offset: int = 8) -> bytes:
        """The data as they came."""
        return self.block


def _as_it_is(block: bytes) -> bytes | _Exif:
    if not block:
        return b""
    exif = _Exif()
    exif.block = block
    with contextlib.suppress(Exception):  # of many kinds where offsets lead nowhere
        exif.load(block)
    return exif


def _bits(content: bytes) -> int:
    """Bits a sample, from the AV1 configuration."""
    at = content.find(b"av1C")
    flags = content[at + 6] if 0 <= at < len(content) - 6 else 0
    return 8 if not flags & _DEEP else 12 if flags & _TWELVE else 10


@_quiet()
def _opened(content: bytes) -> Image.Image:
    if not features.check("avif"):
        raise ValueError("this Pillow was built without AVIF: install a newer one")
    try:
        return Image.open(io.BytesIO(content), formats=["AVIF"])
    except Exception as error:  # as above
        raise ValueError("it is damaged, or of an unknown format") from error
