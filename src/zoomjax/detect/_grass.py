"""Where the grass of a pitch is, and which colours are grass.

The pitch is the largest thing of one green in an image of it. Its hue is the peak of the histogram of hues
among greens; light, shadow and mowing change saturation and brightness far more than hue. The region is
found in a small copy of the image, with markings and players closed over and narrow outgrowths cut off.
"""

import dataclasses

import cv2
import numpy as np

_SMALL = 180
"""px, the shorter side of the copy in which the region is found."""

_GREENS = (25, 90)
"""Hues that grass may have, in OpenCV's unit of 2 degrees: from straw to bluish artificial turf."""

_HUE_WIDTH = 12
"""How far a hue of grass may be from the peak, in the same unit."""

_LEAST_SATURATION = 40
_OF_USUAL_SATURATION = 0.35
_LEAST_BRIGHTNESS = 30

_OF_FIELD = 0.75
"""Share of the usual saturation that grass has in the field of play: beyond its lines there may be other or
trodden turf, and nets veil what is behind them."""

_LEAST_AREA = 0.1
"""Share of the image below which there is no pitch in it."""

_OF_LARGEST = 0.1
"""Parts of the region that are smaller than this share of the largest one are not the pitch."""

_CLOSED, _OPENED = 0.06, 0.06
"""Shares of the shorter side: what is closed over, and the least width of what is kept."""


@dataclasses.dataclass(frozen=True)
class Grass:
    """The grass of one image.

    Attributes:
        region: (h, w) uint8, 255 on the pitch with all that is on it, 0 elsewhere; a small copy.
        hue: the usual hue, in units of 2 degrees.
        saturation: the usual saturation, 0 to 255.
    """

    region: np.ndarray
    hue: float
    saturation: float

    def has_colour(self, colours: np.ndarray) -> np.ndarray:
        """Whether colours (n, 3), uint8 BGR, are colours of this grass."""
        return self._within(colours, _OF_USUAL_SATURATION)

    def is_field(self, colours: np.ndarray) -> np.ndarray:
        """Whether colours are as saturated as well, as about all grass in the field of play is."""
        return self._within(colours, _OF_FIELD)

    def mask(self, image_size: tuple[int, int]) -> np.ndarray:
        """The region in an image of that size, (w, h) px."""
        return cv2.resize(self.region, image_size, interpolation=cv2.INTER_NEAREST)

    def _within(self, colours: np.ndarray, saturation: float) -> np.ndarray:
        if not len(colours):
            return np.zeros(0, bool)
        hsv = cv2.cvtColor(colours[:, None], cv2.COLOR_BGR2HSV)
        return cv2.inRange(hsv, *_bounds(self.hue, saturation * self.saturation))[:, 0] > 0


def find_grass(image: np.ndarray) -> Grass | None:
    """The grass in an image (h, w, 3), uint8 BGR, or None if there is no pitch in it."""
    scale = min(1.0, _SMALL / min(image.shape[:2]))
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    hsv = cv2.cvtColor(small, cv2.COLOR_BGR2HSV)
    green = cv2.inRange(hsv, (_GREENS[0], _LEAST_SATURATION, _LEAST_BRIGHTNESS), (_GREENS[1], 255, 255)) > 0
    if green.mean() < _LEAST_AREA:
        return None
    hues = np.bincount(hsv[green, 0], minlength=180)
    hue = float(np.argmax(np.convolve(hues, np.ones(5), "same")))
    saturation = float(np.median(hsv[green & (abs(hsv[..., 0] - hue) <= _HUE_WIDTH), 1]))
    region = _region(cv2.inRange(hsv, *_bounds(hue, _OF_USUAL_SATURATION * saturation)))
    return Grass(region, hue, saturation) if np.mean(region > 0) >= _LEAST_AREA else None


def _bounds(hue: float, saturation: float) -> tuple[np.ndarray, np.ndarray]:
    """The least and the greatest hue, saturation and brightness of grass at least so saturated."""
    least = (hue - _HUE_WIDTH, max(_LEAST_SATURATION, saturation), _LEAST_BRIGHTNESS)
    return np.array(least), np.array([hue + _HUE_WIDTH, 255.0, 255.0])


def _region(grass: np.ndarray) -> np.ndarray:
    """The large parts of the grass, with all that is on it."""
    side = min(grass.shape)
    # Beyond the image the pitch goes on: without a margin, opening would round the image's corners off.
    margin = round(_CLOSED * side)
    wide = cv2.copyMakeBorder(grass, margin, margin, margin, margin, cv2.BORDER_REPLICATE)
    for operation, share in ((cv2.MORPH_CLOSE, _CLOSED), (cv2.MORPH_OPEN, _OPENED)):
        across = 2 * round(share * side / 2) + 1
        wide = cv2.morphologyEx(wide, operation, np.ones((across, across), np.uint8))
    contours, _ = cv2.findContours(wide, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    areas = [cv2.contourArea(contour) for contour in contours]
    large = [
        contour for contour, area in zip(contours, areas, strict=True) if area > _OF_LARGEST * max(areas)
    ]
    region = cv2.drawContours(np.zeros_like(wide), large, -1, 255, cv2.FILLED)
    return np.ascontiguousarray(region[margin:-margin, margin:-margin])
