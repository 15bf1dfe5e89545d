"""Rejection of single outlier points on otherwise good lines.

A detector that follows something else for a few pixels leaves outlier points on a good line. `fit_robust`
weights whole lines and does not remove them. Here a point is dropped if, in the corrected image, it is
farther than `_CUT` standard deviations from its line. The line is the one that most points agree on (IRLS,
from least absolute distances to Tukey's weights), the standard deviation is 1.48 times the median distance
of the line's points, drawn, as much as `_BORROWED` points weigh, to that of the typical line. Lens and
decisions are found in turns, each from all points, so that wrong rejections are undone.

Points are dropped, not weighted. Weights of points would rule out exact compression, and counts, covariance
and figures would need them; a line with fewer points is an ordinary line. As points within the cut keep
full weight, the loss is small: fewer than one in a thousand good points are dropped, on lines whose spread
is underestimated. Tukey's weights at their usual width lose 5 % of the information.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from .._core.arguments import kinds_checked
from .._core.programs import program
from .._core.types import of_known_values
from ..lines.best_line import line_normal
from ..lines.lines import Lines
from ..models.distortion_model import AbstractDistortionModel
from ..models.model import Model
from ..models.zoom import AbstractZoom
from .distortion_models import compress_for, with_distortion_model
from .energy import coefficients_by
from .prepare import asked_for, ready_model
from .robust import RobustFit, fit_robust

_CUT = 4.0
"""Standard deviations from its line beyond which a point is dropped."""

_BORROWED = 50
"""Points that the typical line's spread counts as, in that of each line: a few points tell little of it."""

_LEAST_SPREAD = 0.01
"""px: points without noise are all alike."""

_FEWEST = 5
"""Points of a line of which any may go: half of them agree, and those must be three."""

_LINE_STEPS = 12
"""Of the reweighted line: half of them towards least absolute distances, half with Tukey's weights."""


class PointRejection(NamedTuple):
    """Lines without their outlier points.

    Attributes:
        lines: the lines with a mask that excludes outlier points; as many lines as were given.
        rejected: which points of the given lines were dropped.
        fit: the robust fit of the remaining points; lines that it rejects have kept most of their points.
        spread: spread of the points of each line, px, in the corrected image; the cut is 4 times this.
    """

    lines: Lines
    rejected: Bool[np.ndarray, "line point"]
    fit: RobustFit
    spread: Float[np.ndarray, "line"]


@kinds_checked
@of_known_values
def reject_points(
    lines: Lines,
    *,
    zoom: AbstractZoom | Model | None = None,
    distortion_model: AbstractDistortionModel | None = None,
    terms: int | None = None,
    throw: bool = True,
) -> PointRejection:
    """Remove single outlier points from lines, together with a robust fit of the zoom model.

    At most half of a line's points are dropped, and none of a line of three or four. Line weights are kept.

    Args:
        lines: the lines, not compressed.
        zoom, distortion_model, terms, throw: as for `fit_robust`, which is used in every turn.

    Raises:
        TypeError: `lines` are not `Lines`.

    Example:
        >>> import numpy as np
        >>> from zoomjax import PolynomialZoom
        >>> rng, t = np.random.default_rng(2), np.linspace(10.0, 470.0, 60)
        >>> points = [np.stack([x + 0.1 * rng.standard_normal(60), t], -1) for x in range(20, 620, 60)]
        >>> points[3][7] += 5
        >>> lines = Lines.from_ragged(points, [0] * 10, [50], image_size=(640, 480))
        >>> np.argwhere(reject_points(lines, zoom=PolynomialZoom(degree=0), terms=1).rejected).tolist()
        [[3, 7]]
    """
    _, model = asked_for(lines, zoom, terms, distortion_model)
    ready_model(lines, model)  # complains of too few focal lengths
    everything, kept, seen = np.asarray(lines.mask), lines, set[bytes]()
    few = everything.sum(axis=1, keepdims=True) < _FEWEST
    while True:
        fit = fit_robust(
            compress_for(kept, model.distortion_model, terms=model.terms), zoom=model, throw=throw
        )
        distance, spread = map(np.asarray, _distances(lines, model.distortion_model, fit.fit.lens.zoom))
        good = everything & (few | (np.abs(distance) <= _CUT * spread[:, None]))
        seen.add(np.asarray(kept.mask).tobytes())
        if good.tobytes() in seen:  # settled, or a doubtful point comes and goes
            return PointRejection(kept, everything & ~np.asarray(kept.mask), fit, spread)
        kept = eqx.tree_at(lambda lines: lines.mask, lines, jnp.asarray(good))


@program
def _distances(lines, distortion_model, zoom):
    """Signed distance of each corrected point from the line that most agree on, and each line's spread."""
    corrected = with_distortion_model(lines, distortion_model).corrected(coefficients_by(zoom, lines))
    distance, spread = jax.vmap(_from_most)(corrected, lines.mask)
    counts = lines.counts
    typical = jnp.nanmedian(jnp.where(counts >= _FEWEST, spread, jnp.nan))
    borrowed = (counts * spread**2 + _BORROWED * typical**2) / (counts + _BORROWED)
    return distance, jnp.maximum(jnp.sqrt(borrowed), _LEAST_SPREAD)


def _from_most(points, mask):
    """Of one line: signed distances from the robust line, and 1.48 times the median of their sizes."""

    def distances(weight):
        mean = weight @ points / jnp.sum(weight)
        normal = line_normal(jnp.sqrt(weight)[:, None] * (points - mean[None]))
        distance = (points - mean[None]) @ normal
        return distance, 1.4826 * jnp.nanmedian(jnp.where(mask, jnp.abs(distance), jnp.nan))

    def reweighted(weight, tukey):
        distance, spread = distances(weight)
        size = jnp.abs(distance) / jnp.where(spread > 0, spread, 1)
        least = 1 / jnp.maximum(size, 0.1)
        return jnp.where(
            mask, jnp.where(tukey, jnp.maximum(1 - (size / _CUT) ** 2, 0) ** 2, least), 0
        ), None

    halves = jnp.arange(_LINE_STEPS) >= _LINE_STEPS // 2
    weight, _ = jax.lax.scan(reweighted, mask.astype(points.dtype), halves)
    return distances(weight)
