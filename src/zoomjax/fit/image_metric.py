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

from .._core.arguments import kinds_checked
from ..lines.base import AbstractLines
from .problem import posed


@kinds_checked
def in_image(lines: AbstractLines) -> AbstractLines:
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
    return posed(lines, metric="distorted")


def in_corrected(lines: AbstractLines) -> AbstractLines:
    """The same lines with distances measured in the corrected image, as the paper does."""
    return posed(lines, metric="corrected")


def measured_as(lines: AbstractLines, other: AbstractLines) -> AbstractLines:
    """The lines in the metric of other ones."""
    return posed(lines, metric=other.metric)
