"""Distances measured in the distorted image, where the noise is, instead of the corrected image.

The paper's energy is that of corrected points. Correction stretches some parts of the image and shrinks
others, and the noise with them. So shrinking noisy parts lowers the energy: a bias of the lens that grows
with the square of the noise. To first order an error d of a point moves its corrected point by ``n . J d``
across the line, J being the derivative of the correction and n the line's normal. A line's distances are
therefore divided by the stretch across it, the root of the mean over its points of

    |J^T n|^2 = sum_ij kappa_i kappa_j (r^2(i+j) + (2i + 2j + 4ij) r^(2(i+j)-2) (z.n)^2),

kappa = (1, k1, ..., kN), for radial models. The mean is made of second moments, which compressed lines
have, too; for other models of all monomials (`AbstractLines.squared_stretch`). In the mean over the noise
the quotient is then least at the true lens, to first order. To hold the stretch fixed while the fit moves,
as reweighting would, does not remove the bias: the stretch's derivative does.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core.arguments import kinds_checked
from .._core.types import Centres
from ..lines.base import AbstractLines
from .energy import line_normal
from .wrapper import AbstractWrapper, wrapped

LEAST_STRETCH = 1e-4
"""Of the squared stretch. Beyond a fold, where it may vanish, nothing is to be gained either."""


class ImageLines(AbstractWrapper):
    """Lines whose distances are measured in the distorted image: made by `in_image`.

    Attributes:
        lines: the lines.
        frame, focal, focus, centre, image_size, focal_unit, weight: those of the lines.
    """

    def corrected(self, coefficients: Float[Array, "line terms"]) -> Float[Array, "line rows 2"]:
        """Corrected points of each line about their mean, divided by the stretch across the line."""
        rows = self.lines.corrected(coefficients)
        squared = self.lines.squared_stretch(coefficients, jax.vmap(line_normal)(rows))
        return rows / jnp.sqrt(jnp.maximum(squared, LEAST_STRETCH))[:, None, None]

    def about(self, centre: Centres) -> "ImageLines":
        """The same lines about another centre of distortion; see `AbstractLines.about`."""
        return in_image(self.as_weighted().about(centre))

    def take(self, lines: Int[Array, "some"], present: Bool[Array, "some"]) -> "ImageLines":
        """The chosen lines as a data set of one frame."""
        return in_image(self.as_weighted().take(lines, present))


@kinds_checked
def in_image(lines: AbstractLines) -> ImageLines:
    """The same lines with distances measured in the distorted image, px, which removes the paper's bias.

    `fit_zoom`, `fit_frames`, `fit_robust` and `frame_rms` accept them like other lines; every RMS is then
    in px of the distorted image. Use this where points have errors of half a pixel or more.

    Args:
        lines: the lines, or their compressed form.

    Example:
        >>> import numpy as np
        >>> from zoomjax import Lines, compress, fit_zoom
        >>> t = np.linspace(0.0, 479.0, 50)
        >>> bent = [np.stack([x + f * (t / 240 - 1) ** 2, t], axis=-1) for f in (1, 2, 3) for x in (9, 599)]
        >>> lines = Lines.from_ragged(bent, [0, 0, 1, 1, 2, 2], [50, 70, 100], image_size=(640, 480))
        >>> bool(fit_zoom(in_image(compress(lines))).rms < 1)
        True
    """
    if isinstance(lines, ImageLines):
        return lines
    return wrapped(ImageLines, lines)


def in_corrected(lines: AbstractLines) -> AbstractLines:
    """The same lines with distances measured in the corrected image, as the paper does."""
    return lines.as_weighted() if isinstance(lines, ImageLines) else lines


def measured_as(lines: AbstractLines, other: AbstractLines) -> AbstractLines:
    """The lines in the metric of other ones."""
    return in_image(lines) if isinstance(other, ImageLines) else lines
