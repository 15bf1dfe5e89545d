"""The interface of detectors: a detector finds, in one image, points on straight lines of the scene."""

import abc

import equinox as eqx
import numpy as np
from jaxtyping import UInt8


class AbstractDetector(eqx.Module):
    """Finds points on straight lines of the scene in one image; its fields are its settings.

    `Lines.from_ragged` takes the concatenated results of all images.
    """

    @abc.abstractmethod
    def __call__(self, image: UInt8[np.ndarray, "height width *channels"]) -> list[np.ndarray]:
        """Detect lines in an image.

        Args:
            image: (h, w) grey, or (h, w, 3) blue, green, red, as OpenCV reads them; uint8.

        Returns:
            For each line an (n, 2) float64 array, n >= 3, of sub-pixel points ``(x, y)`` px in order
            along the line; (0, 0) is the centre of the top-left pixel. Empty if no line is found.

        Raises:
            ValueError: the image has another shape or type.
        """
