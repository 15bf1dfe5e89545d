"""Whether to fit the centre of distortion: held-out straightness about a fitted centre and a given one."""

import dataclasses

import numpy as np

from ..fit.centre import CentreFit, fit_centre, refit_centre
from ..fit.energy import line_squares
from ..fit.own_weights import own_weights
from ..lines.base import AbstractLines
from ..models.model import Model
from ..models.zoom import AbstractZoom
from .cross_validation import errors_of
from .folds import folds_of

_FOLDS = 5

_FAR = 0.05
"""Distance of a fitted centre from the given one, half diagonals, that fewer frames than folds do not tell.

Their lines share what bends them, such as a board that is not flat, so that lines left out are no test.
"""


@dataclasses.dataclass(frozen=True)
class CentreChoice:
    """The centre of distortion found, and lines that were not fitted about it and about the given one.

    Attributes:
        found: the fit with its centre.
        fitted: cross-validated RMS about the fitted centre, px; each part of the lines has another one,
            fitted to the others.
        given: the same about the lines' own centre.
        far: how far the fitted one is from the given one, px, where that is farther than so few frames can
            tell; otherwise None.
    """

    found: CentreFit
    fitted: float
    given: float
    far: float | None = None

    @property
    def better(self) -> bool:
        """Whether the lines determine the centre, and lines left out are straighter about it."""
        return bool(self.found.determined) and self.fitted <= self.given and self.far is None


def choose_centre(lines: AbstractLines, model: Model, *, along: AbstractZoom | None = None) -> CentreChoice:
    """Fit the centre of distortion and cross-validate it.

    A fifth of the frames is left out at a time, or, with fewer than five, of the lines of each frame. These
    few do not tell a centre that is far from the given one.

    Args:
        lines: the lines, compressed for any centre, in either metric.
        model: the zoom model, without parameters, and its number of coefficients.
        along: how the centre depends on the focal length, as for `fit_centre`; by default it is one.

    Raises:
        ValueError, RuntimeError: as for `fit_centre`.
    """
    if lines.weight is None:
        lines = lines.weighted(np.ones(lines.frame.shape))  # as in every fold: one compiled program
    found = fit_centre(lines, zoom=model, centre=along)
    small = lines.about(lines.centre)
    own = own_weights(small)
    frames = np.unique(np.asarray(small.frame)[own > 0]).size
    parts = folds_of(small, "frame" if frames >= _FOLDS else "line", _FOLDS, 0)
    given = errors_of(small, model.with_parameters(None), parts).unseen
    fitted = np.full(given.shape, np.nan)
    for fold in range(parts.number) if found.determined else ():
        out = parts.fold == fold
        kept = lines.weighted(own * ~out)
        fitted[out] = np.asarray(line_squares(lines, refit_centre(kept, found)))[out]
    share = np.where(np.isfinite(given) & np.isfinite(fitted), parts.share, 0)
    if not share.any():
        return CentreChoice(found, np.nan, np.nan)
    away = float(np.max(np.linalg.norm(np.asarray(found.centre) - np.asarray(lines.centre), axis=1)))
    far = away if frames < _FOLDS and away > _FAR * float(found.fit.lens.scale) else None
    fitted, given = (float(np.sqrt(np.average(np.nan_to_num(of), weights=share))) for of in (fitted, given))
    return CentreChoice(found, fitted, given, far)
