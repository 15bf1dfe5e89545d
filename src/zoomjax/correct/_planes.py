"""Correction of video frames plane by plane, in their own pixel format.

YUV is not converted to RGB and back, and chroma of 4:2:0 is warped at its own size: half the samples of
RGB, and no rounding in between. Per frame: the focal length's distortion, one map a sampling (U and V share
theirs, and frames at one focal length all), and `cv2.remap` of each plane.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from ..io.pyav import av
from ..models.lens import ZoomLens
from ..models.sizes import at_focal
from .framing import Framing
from .image import position_map
from .maps import OUTSIDE, Plane
from .redistort import redistortion_map
from .sampler import remap

_PACKED = {
    **{"nv12": "yuv420p", "nv21": "yuv420p", "p010le": "yuv420p10le", "p012le": "yuv420p12le"},
    **{"yuyv422": "yuv422p", "uyvy422": "yuv422p", "nv16": "yuv422p", "p210le": "yuv422p10le"},
    **{"rgb24": "gbrp", "bgr24": "gbrp", "rgb0": "gbrp", "bgr0": "gbrp", "pal8": "gbrap"},
    **{"rgba": "gbrap", "bgra": "gbrap", "argb": "gbrap", "abgr": "gbrap", "rgb48le": "gbrp16le"},
    "rgba64le": "gbrap16le",
}
"""Formats that interleave their channels, and planar ones that hold the same values."""


class FrameWarper:
    """Corrects the frames of one video.

    Args:
        lens: for frames of this size.
        framing: of the output; common to all frames.
        interpolation, border: as for `undistort_image`; a constant border is black.
        back: whether corrected frames are given, and distortion is applied.
    """

    def __init__(
        self, lens: ZoomLens, framing: Framing, *, interpolation: str, border: str, back: bool = False
    ):
        self.framing = framing
        self.given, self.made = (framing.size, lens.image_size)[:: 1 if back else -1]
        self._positions: Callable[..., tuple[np.ndarray, np.ndarray]] = (
            redistortion_map if back else position_map
        )
        self._lens, self._interpolation, self._border = lens, interpolation, border
        self._dtype = np.asarray(lens.centre).dtype
        self._key: tuple[float, str] | None = None
        self._maps: list[tuple[np.ndarray, np.ndarray]] = []

    def __call__(self, frame: Any, focal: float) -> Any:
        """The corrected frame, with the times and colours of the given one.

        Raises:
            ValueError: the frame has another size than the first.
        """
        size = (frame.width, frame.height)
        if size != self.given:
            raise ValueError(
                f"The frame at {frame.time or 0:.3f} s has {size[0]} x {size[1]} px, but earlier ones have "
                f"{self.given[0]} x {self.given[1]} px. Split the video there."
            )
        name = planar_format(frame.format.name)
        given = frame if frame.format.name == name else frame.reformat(format=name)
        result = av.VideoFrame(*self.made, name)
        result.pts, result.time_base, result.duration = frame.pts, frame.time_base, frame.duration
        result.color_range, result.colorspace = frame.color_range, frame.colorspace
        for component, maps, fill in zip(
            result.format.components, self._maps_at(focal, name), _black(result), strict=True
        ):
            out = _samples(result, component)
            self._warp(_samples(given, component), maps, fill, out)
            if component.bits not in (8, 16) and self._interpolation in ("cubic", "lanczos"):
                # They overshoot, beyond what the bits can hold.
                np.minimum(out, (1 << component.bits) - 1, out=out)
        return result

    def _warp(self, plane: np.ndarray, maps: tuple[np.ndarray, np.ndarray], black: int, out) -> None:
        remap(plane, *maps, self._interpolation, self._border, np.array([float(black)]), out)
        if self._border != "constant":
            out[maps[0] == OUTSIDE] = black  # beyond a fold there is no image to continue

    def _maps_at(self, focal: float, name: str) -> list[tuple[np.ndarray, np.ndarray]]:
        """One pair of maps a component, kept while the focal length stays the same."""
        if (focal, name) != self._key:
            distortion = at_focal(self._lens, np.asarray(focal, self._dtype))
            planes = sampled_planes(name, self.made)
            made = {
                plane: self._positions(
                    distortion,
                    self.framing,
                    self._lens.image_size,
                    plane=plane,
                    extend=self._border != "constant",
                )
                for plane in dict.fromkeys(planes)
            }
            self._key, self._maps = (focal, name), [made[plane] for plane in planes]
        return self._maps


def planar_format(name: str) -> str:
    """The pixel format, one plane a component, 8 to 16 bits, in which frames of another are warped.

    Colours stay what they are, red, green and blue or luma and chroma, and transparency stays.
    """
    ours = name.removesuffix("be") + "le" if name.endswith("be") else name
    if name in _PACKED or ours in _PACKED:
        return _PACKED.get(name) or _PACKED[ours]
    if _is_planar(ours):
        return ours
    given = av.VideoFormat(name, 16, 16)
    deep = "16le" if any(component.bits > 8 for component in given.components) else ""
    alpha = "a" if any(component.is_alpha for component in given.components) else ""
    if len(given.components) == 1:
        return f"gray{deep}"
    return f"gbr{alpha}p{deep}" if given.is_rgb else f"yuv{alpha}444p{deep}"


def _is_planar(name: str) -> bool:
    components = av.VideoFormat(name, 16, 16).components
    return (
        len(components) > 0
        and len({component.plane for component in components}) == len(components)
        and all(8 <= component.bits <= 16 for component in components)
        and not name.endswith(("f16le", "msble"))
    )


def sampled_planes(name: str, size: tuple[int, int]) -> list[Plane]:
    """How the components of a planar format sample an image.

    Chroma of 4:2:0 is taken to lie as in H.264: on the left pixels, between two rows. Where it lies in the
    middle instead, taking it for left moves colours by half a pixel times the change of scale: a few
    hundredths of a pixel.
    """
    planes = []
    even = av.VideoFormat(name, _EVEN, _EVEN).components  # of odd sizes chroma is rounded up
    for component, whole in zip(av.VideoFormat(name, *size).components, even, strict=True):
        step = (_EVEN / whole.width, _EVEN / whole.height)
        planes.append(Plane((component.width, component.height), step, (0.0, (step[1] - 1) / 2)))
    return planes


_EVEN = 64
"""px, a multiple of every step between samples of chroma."""


def _black(frame: Any) -> list[int]:
    """The value of each component in black, and of alpha where nothing is seen."""
    name, told = frame.format.name, int(frame.color_range)  # 0 not told, 1 limited, 2 full
    unmarked_yuv = told == 0 and name.startswith("yuv") and not name.startswith("yuvj")
    limited = not frame.format.is_rgb and (told == 1 or unmarked_yuv)
    values = []
    for component in frame.format.components:
        if component.is_chroma and not frame.format.is_rgb:
            values.append(1 << (component.bits - 1))
        else:
            values.append(16 << (component.bits - 8) if limited and component.is_luma else 0)
    return values


def _samples(frame: Any, component: Any) -> np.ndarray:
    """A component's samples, (height, width), in place."""
    plane = frame.planes[component.plane]
    dtype = np.dtype(np.uint8 if component.bits == 8 else "<u2")
    rows = np.frombuffer(plane, dtype).reshape(plane.height, plane.line_size // dtype.itemsize)
    return rows[:, : plane.width]
