"""OpenCV's decoders of photos, and the damage that they fill up and only print."""

import re
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from .._core.quiet import heard

_PRINTED = re.compile(
    rb"\[ *(?:INFO|WARN|ERROR):|libpng |Corrupt JPEG data|Premature end of JPEG|Invalid SOS parameters|"
    rb"Inconsistent progression|Unknown Adobe color|Warning: unknown JFIF"
)
"""How lines begin that OpenCV and its libraries print, which name no file."""

_DAMAGE = re.compile(
    r"TIFF_Error (?!.*(?:SetField|Directory|Fetch))(?P<tiff>.*)"
    r"|Corrupt JPEG data: (?P<jpeg>(?!\d+ extraneous).*|(?:1[6-9]|[2-9]\d|\d{3,}) extraneous.*)"
    r"|(?P<end>Premature end of JPEG)"
)
"""Those by which a part of the picture is missing. A few bytes too many are harmless, as of webcams."""


def by_opencv(decode: Callable[..., Any], content: bytes, **options: Any) -> Any:
    """What a function of OpenCV's makes of an image file; nothing is printed.

    Raises:
        MemoryError: there is not enough for it.
        ValueError: it raises an error, or a part of the picture is missing, which it fills up.
    """
    try:
        with heard(_PRINTED) as lines:
            image = decode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED, **options)
    except cv2.error as error:
        if error.code == cv2.Error.StsNoMem:
            raise MemoryError from error
        raise ValueError(f"OpenCV cannot decode it ({error.err})") from error
    if found := next(filter(None, map(_DAMAGE.search, lines)), None):
        raise ValueError(f"its data are damaged ({found[found.lastgroup or 0].strip()})")
    return image
