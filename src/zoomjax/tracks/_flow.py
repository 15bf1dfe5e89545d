"""The way of points from one image to the next: pyramidal Lucas-Kanade, there and back."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

Grey = UInt8[np.ndarray, "height width"]
Points = Float[np.ndarray, "point 2"]

_WINDOW = (21, 21)
_COARSEST = 60
"""px: least side of the smallest image of the pyramid."""

_FEW = 0.5
"""Share of points below which the whole image may have jumped."""

_COARSE = 160
"""px: about the width of the images whose jump is looked for."""


_FADED = 0.04
"""Relative change of contrast, and of brightness beside white, that is one of the whole image."""


def followed(
    before: Grey, after: Grey, points: Points, guess: Points, *, back: float
) -> tuple[Points, Bool[np.ndarray, "point"]]:
    """Where points of an image are in the next one, and which of them were found.

    Args:
        before, after: the images.
        points: in the one.
        guess: where they might be in the other. Where that misleads most, the shift of the whole image is
            tried instead.
        back: how near the way back must return, px.
    """
    found, good = _there_and_back(before, after, points, guess, back)
    if good.mean() < _FEW:
        others, better = _there_and_back(before, after, points, points + _jump(before, after), back)
        found = np.where((better & ~good)[:, None], others, found)
        good |= better
    return found, good


def as_bright(image: Grey, other: Grey) -> Grey:
    """An image with the mean and the contrast of another, if they differ much, as where a clip is faded.

    What is darker at the same place would be taken for another place.
    """
    (mean, spread), (wanted, contrast) = (
        (float(of[0, 0]) for of in cv2.meanStdDev(one)) for one in (image, other)
    )
    gain = contrast / max(spread, 1.0)
    if abs(np.log(max(gain, 0.01))) < _FADED and abs(wanted - gain * mean) < _FADED * 255:
        return image
    table = np.clip(wanted + gain * (np.arange(256) - mean), 0, 255)
    return cv2.LUT(image, np.rint(table).astype(np.uint8))


def _there_and_back(before, after, points, guess, back):
    points, guess = points.astype(np.float32), guess.astype(np.float32)
    options = {
        "winSize": _WINDOW,
        "maxLevel": int(np.clip(np.log2(min(before.shape) / _COARSEST), 0, 5)),
        "criteria": (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01),
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
        "minEigThreshold": 1e-5,
    }
    found, there, _ = cv2.calcOpticalFlowPyrLK(before, after, points, guess, **options)
    start = points + (found - guess)  # not the answer itself
    again, here, _ = cv2.calcOpticalFlowPyrLK(after, before, found, start, **options)
    good = (there.ravel() > 0) & (here.ravel() > 0) & (np.linalg.norm(again - points, axis=1) < back)
    return found.astype(np.float64), good


def _jump(before: Grey, after: Grey) -> np.ndarray:
    """The shift of the whole image, px, to some px."""
    factor = max(1, round(before.shape[1] / _COARSE))
    size = (before.shape[1] // factor, before.shape[0] // factor)
    one, two = (
        cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        for image in (before, after)
    )
    shift, _ = cv2.phaseCorrelate(one, two, cv2.createHanningWindow(size, cv2.CV_32F))
    return factor * np.array(shift)
