"""Distances measured in the distorted image, where the noise is, instead of the corrected image.

The paper's energy is that of corrected points. Correction stretches some parts of the image and shrinks
others, and the noise with them. So shrinking noisy parts lowers the energy: a bias of the lens that grows
with the square of the noise. To first order an error d of a point moves its corrected point by ``n . J d``
across the line, J being the derivative of the correction and n the line's normal. A line's distances are
therefore divided by the stretch across it, the root of the mean over its points of

    |J^T n|^2 = sum_ij kappa_i kappa_j (r^2(i+j) + (2i + 2j + 4ij) r^(2(i+j)-2) (z.n)^2),

kappa = (1, k1, ..., kN). The mean is made of second moments, which compressed lines have, too. In the
mean over the noise the quotient is then least at the true lens, to first order. To hold the stretch
fixed while the fit moves, as reweighting would, does not remove the bias: the stretch's derivative does.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._core.arguments import kinds_checked
from .._core.types import Centres, Focal, Focus, FrameIndex, LineWeight, Point
from ..lines.base import AbstractLines, with_fields_of
from ..models.family import AbstractFamily, AbstractRadial
from .energy import line_normal


class ImageLines(AbstractLines):
    """Lines whose distances are measured in the distorted image: made by `in_image`.

    Attributes:
        lines: the lines.
        frame, focal, focus, centre, image_size, focal_unit, weight: those of the lines.
    """

    lines: AbstractLines
    frame: FrameIndex
    focal: Focal
    focus: Focus | None
    centre: Point
    image_size: tuple[int, int] = eqx.field(static=True)
    focal_unit: str = eqx.field(static=True)
    weight: LineWeight | None

    @property
    def family(self) -> AbstractFamily:
        """What the coefficients mean."""
        return self.lines.family

    @property
    def counts(self) -> Float[Array, "line"]:
        """Number of points of each line."""
        return self.lines.counts

    def corrected(self, coefficients: Float[Array, "line terms"]) -> Float[Array, "line rows 2"]:
        """Corrected points of each line about their mean, divided by the stretch across the line."""
        rows = self.lines.corrected(coefficients)
        powers, _ = self.lines.expansion(coefficients)
        moments = self.lines.second_moments(2 * powers.shape[1])
        squared = jax.vmap(squared_stretch)(powers, jax.vmap(line_normal)(rows), moments, self.lines.counts)
        # Beyond a fold, where it may vanish, nothing is to be gained either.
        return rows / jnp.sqrt(jnp.maximum(squared, 1e-4))[:, None, None]

    def second_moments(self, order: int) -> Float[Array, "line moment 2 2"]:
        """``sum_p r_p^(2i) z_p z_p^T`` of the points as they were seen."""
        return self.lines.second_moments(order)

    def about(self, centre: Centres) -> "ImageLines":
        """The same lines about another centre of distortion; see `AbstractLines.about`."""
        return in_image(self.as_weighted().about(centre))

    def take(self, lines: Int[Array, "some"], present: Bool[Array, "some"]) -> "ImageLines":
        """The chosen lines as a data set of one frame."""
        return in_image(self.as_weighted().take(lines, present))

    def as_weighted(self) -> AbstractLines:
        """The lines with the weights and focal lengths that these have been given."""
        return with_fields_of(self.lines, self)


@kinds_checked
def in_image(lines: AbstractLines) -> ImageLines:
    """The same lines with distances measured in the distorted image, px, which removes the paper's bias.

    `fit_zoom`, `fit_frames`, `fit_robust` and `frame_rms` accept them like other lines; every RMS is then
    in px of the distorted image. Use this where points have errors of half a pixel or more.

    Args:
        lines: the lines, or their compressed form, about a fixed centre.

    Raises:
        ValueError: their distortion model is not radial: the stretch then does not follow from the moments.

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
    if not isinstance(lines.family, AbstractRadial):
        raise ValueError(
            "Distances are measured in the image for radial families, but this one is "
            f"{type(lines.family).__name__}: leave in_image out."
        )
    return ImageLines(
        lines=lines,
        frame=lines.frame,
        focal=lines.focal,
        focus=lines.focus,
        centre=lines.centre,
        image_size=lines.image_size,
        focal_unit=lines.focal_unit,
        weight=lines.weight,
    )


def squared_stretch(k, normal, moments, count):
    """The mean of ``|J^T n|^2`` over the points of one line; 1 where there are none."""
    terms = k.shape[0]
    kappa = jnp.concatenate([jnp.ones(1, k.dtype), k])
    i, j = np.indices((terms + 1, terms + 1))
    products = kappa[:, None] * kappa[None]
    radial = jnp.concatenate([count[None].astype(k.dtype), jnp.trace(moments, axis1=1, axis2=2)])
    across = jnp.concatenate([jnp.zeros(1, k.dtype), jnp.einsum("c,mcd,d->m", normal, moments, normal)])
    factor = jnp.asarray(2 * i + 2 * j + 4 * i * j, k.dtype)
    total = jnp.sum(products * (radial[i + j] + factor * across[i + j]))
    return jnp.where(count > 0, total / jnp.maximum(count, 1), 1)
