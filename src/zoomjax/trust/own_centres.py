"""The centre of distortion of each frame by itself, about a fit of all (as in the paper's Figure 7).

`fit_frame_centres` finds each by a fit. Here it is one Gauss-Newton step of the frame's coefficients and
centre from the zoom lens, which costs next to nothing: a picture of what the frames say beside the centre
fitted to all. Variances are of the scores of the frame's lines, each of which errs as a whole.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..fit.distortion_models import with_distortion_model
from ..fit.energy import frame_coefficients
from ..fit.moved_centre import for_terms
from ..fit.own_weights import own_weights
from ..fit.problem import data_of
from ..fit.result import ZoomFit
from ..fit.same_camera import placed_as
from ..lines.base import AbstractLines
from ..lines.free_centre import AnyCentreLines
from ..models.polynomial import RadialPolynomial
from ._linearised import by_coefficients

_SINGULAR = 1e-10  # eigenvalues, of the largest
_CERTAIN = 0.05
"""Standard deviation of a centre, in half diagonals, from which on a frame does not determine it."""


@dataclasses.dataclass(frozen=True)
class OwnCentres:
    """The centres of the frames.

    Attributes:
        centre: px, (frame, 2); NaN where a frame's lines do not determine one.
        std: standard deviations, px, likewise.
    """

    centre: Float[np.ndarray, "frame 2"]
    std: Float[np.ndarray, "frame 2"]

    @property
    def known(self) -> np.ndarray:
        """Of which frames the centre is known, (frame,)."""
        return np.isfinite(self.std[:, 0])


def own_centres(fit: ZoomFit, lines: AbstractLines) -> OwnCentres | None:
    """The centre of each frame, from one step.

    Args:
        fit: a fit of the radial polynomial with one centre.
        lines: its lines, compressed for any centre, with their weights and in their metric.

    Returns:
        The centres; None for lines about one centre, for other distortion models, and for lenses whose
        centre moves along the zoom.
    """
    lens = fit.lens
    polynomial = isinstance(lens.distortion_model, RadialPolynomial)
    if not polynomial or lens.shift is not None or not isinstance(data_of(lines), AnyCentreLines):
        return None
    k = np.asarray(frame_coefficients(placed_as(lens, lines), lens.zoom), float)
    offset = (np.asarray(lens.centre) - np.asarray(lines.centre)) / lens.scale
    both = np.concatenate([k, np.broadcast_to(offset, (len(k), 2))], axis=1)
    few = for_terms(with_distortion_model(lines, lens.distortion_model), k.shape[1])
    dtype = jnp.asarray(lines.focal).dtype
    rows, by_own = (np.asarray(p, float) for p in by_coefficients(few, np.asarray(both, dtype)))
    score, matrix = np.einsum("lri,lr->li", by_own, rows), np.einsum("lri,lrj->lij", by_own, by_own)
    used = own_weights(lines) > 0
    frame, centre, std = np.asarray(lines.frame), *np.full((2, len(k), 2), np.nan)
    for number in np.unique(frame[used]):
        of = used & (frame == number)
        left = of.sum() - both.shape[1]
        values, vectors = np.linalg.eigh(matrix[of].sum(axis=0))
        if left < 1 or values[0] < _SINGULAR * values[-1]:
            continue
        inverse = (vectors / values) @ vectors.T
        step = inverse @ score[of].sum(axis=0)
        after = score[of] - matrix[of] @ step
        covariance = inverse @ (after.T @ after) @ inverse * of.sum() / left
        own = np.sqrt(np.diagonal(covariance)[-2:])
        if own.max() < _CERTAIN:
            centre[number] = np.asarray(lens.centre) - lens.scale * step[-2:]
            std[number] = lens.scale * own
    return OwnCentres(centre, std)
