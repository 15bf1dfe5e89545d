"""The next photo: the focal length and part of the image that would narrow the bands most.

A further photo changes the covariance ``H^-1 D H^-1`` of the fit (`covariance`) through its lines' terms of
H and D, which depend on where the lines are and not on what is measured there. So the band with each
candidate is known in advance. Candidates are focal lengths over the range, nine parts of the image, and
horizontal or vertical lines, as many and as long as in the existing photos. The noise is assumed to stay
the same.

Directions that no line determines get a prior, normalised coefficients of about 1, so that candidates can
be compared there too. The cost is one small Jacobian per candidate; nothing is fitted.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from .._core.arguments import kinds_checked
from .._core.programs import light_program
from .._core.types import of_known_values
from ..fit.distortion_models import with_distortion_model
from ..fit.energy import line_weights
from ..fit.own_weights import own_weights
from ..fit.result import ZoomFit
from ..fit.same_camera import check_lines_of
from ..lines.base import AbstractLines
from ..lines.best_line import line_residuals
from ..lines.buckets import bucketed_jit, of_lines
from ..models.requirements import check
from ..models.sizes import at_focal
from ..models.zoom import with_parameters
from ._linearised import by_parameters
from .bands import displacement_std

_FOCALS = 5  # over the range, evenly in 1/f
_DIRECTIONS = ("horizontal", "vertical")
_REGIONS = (
    *("the top left corner", "the top edge", "the top right corner"),
    *("the left edge", "the middle", "the right edge"),
    *("the bottom left corner", "the bottom edge", "the bottom right corner"),
)
_MIRRORED = {
    "the corners": (0, 2, 6, 8),
    "the top or bottom edge": (1, 7),
    "the left or right edge": (3, 5),
}
_SIMPLEST_FIRST = (4, 1, 7, 3, 5, 0, 2, 6, 8)
_ALIKE = 1.02  # bands that differ by less are as good as each other


@dataclasses.dataclass(frozen=True)
class Suggestion:
    """The photo that would reduce the uncertainty most, and the uncertainty with each candidate.

    Attributes:
        focal: the focal length of the photo.
        direction: direction of its lines, "horizontal" or "vertical".
        region: the part of the image with the lines, in words.
        before, after: the standard deviation of the displacement, px, without and with the photo: the
            geometric mean over image and focal range. Infinite where the lines do not determine the lens.
        focals: the candidates' focal lengths.
        regions: their parts of the image, in words.
        table: `after` of each candidate: of each focal length, region and direction.
        focal_unit: "mm" or "px"; empty where the one focal length is not known.
    """

    focal: float
    direction: str
    region: str
    before: float
    after: float
    focals: np.ndarray
    regions: tuple[str, ...]
    table: np.ndarray
    focal_unit: str

    @property
    def sentence(self) -> str:
        """The suggestion in words."""
        zoom = f"at f = {self.focal:.4g} {self.focal_unit}" if self.focal_unit else "with the same zoom"
        photo = f"Next, photograph {self.direction} lines through {self.region} of the image {zoom}"
        if not np.isfinite(self.before):
            return f"{photo}: of all candidates, this one would determine the lens best."
        where = "image and focal range" if len(self.focals) > 1 else "the image"
        return (
            f"{photo}: the standard deviation that noise gives the displacement, in the geometric mean "
            f"over {where}, would fall from {self.before:.2g} to {self.after:.2g} px."
        )


@kinds_checked
@of_known_values
def suggest_next(
    fit: ZoomFit, lines: AbstractLines, *, focal_range: tuple[float, float] | None = None
) -> Suggestion:
    """Suggest the next photo: the one that would narrow the band of the displacement most.

    Args:
        fit: the fit.
        lines: the lines of the fit, compressed or not.
        focal_range: the shortest and the longest focal length of interest, in the lens's unit; by default
            the fitted range.

    Returns:
        The best candidate, and the values of all candidates.

    Raises:
        ValueError: `focal_range` is not two positive numbers in order, no line is usable, or the lines
            are not those of the fit: of another image size, unit or number of frames.

    Example:
        >>> from zoomjax import compress, fit_zoom, scenes
        >>> focal = scenes.focal_sweep(4)
        >>> lines = compress(scenes.board_lines(scenes.nikkor_18_200(), focal, spacing=99, noise=1))
        >>> suggest_next(fit_zoom(lines), lines).sentence
        'Next, photograph ...
    """
    check_lines_of(fit, lines)
    try:
        low, high = (float(f) for f in (fit.lens.focal_range if focal_range is None else focal_range))
    except (TypeError, ValueError):
        low = high = np.nan
    if not 0 < low <= high < np.inf:
        raise ValueError(
            "Argument focal_range must be two positive numbers, the shorter first, but it is "
            f"{focal_range!r}."
        )
    check("suggest_next", zoom=fit.lens.zoom, shift=fit.lens.shift)
    lines = with_distortion_model(lines, fit.lens.distortion_model).about(fit.lens.centre)
    if not own_weights(lines).any():
        raise ValueError(
            "Argument lines must have a usable line, but all have a weight of 0 or too few points."
        )
    focals = np.unique(1 / np.linspace(1 / low, 1 / high, _FOCALS))
    weights, counts, squares = map(np.asarray, _sizes(lines))
    number, length, points_each = _typical(lines, weights, counts, squares)
    dtype = fit.covariance.dtype
    candidates = jnp.asarray(candidate_lines(fit.lens.image_size, length), dtype)
    grid = jnp.asarray(focals, dtype)
    known = _known(lines, fit.lens.zoom, weights, counts)
    rows, of_points = (np.asarray(part, float) for part in _derivatives(fit.lens, candidates, grid))
    squared = of_points.swapaxes(-1, -2) @ of_points / of_points.shape[-2]
    points = _image_grid(fit.lens.image_size).astype(dtype)[:, None]
    before = np.asarray(displacement_std(fit, points, focal=grid))
    with np.errstate(all="ignore"):
        before = float(_average(before.ravel()))
        now, table = _bands(known, rows, squared, number * points_each, float(np.finfo(dtype).eps))
    # What was measured of the noise is in `before`; how a photo changes it is the ratio.
    table = np.nan_to_num(table, nan=np.inf)  # what rounding alone is left of
    if np.isfinite(before) and float(now) > 0:
        table = before * (table / float(now))
    at_focal, _, in_direction = np.unravel_index(np.argmin(table), table.shape)
    region = _simplest(table[at_focal, :, in_direction])
    return Suggestion(
        focal=float(focals[at_focal]),
        direction=_DIRECTIONS[in_direction],
        region=_named(table[at_focal, :, in_direction], region),
        before=before,
        after=float(table[at_focal, region, in_direction]) if np.isfinite(before) else np.inf,
        focals=focals,
        regions=_REGIONS,
        table=table,
        focal_unit=fit.lens.focal_unit,
    )


def _simplest(stds):
    """Of the regions as good as the best: long lines along an edge run through its corners too."""
    return next(region for region in _SIMPLEST_FIRST if stds[region] <= _ALIKE * min(stds))


def _named(stds, region):
    """The region in words, with those that mirror it if they are as good."""
    for name, group in _MIRRORED.items():
        if region in group and max(stds[list(group)]) <= _ALIKE * stds[region]:
            return name
    return _REGIONS[region]


def _typical(lines, weights, counts, squares):
    """Of the lines there are: how many a frame, how long (px) and of how many points, the medians."""
    there = weights > 0
    per_frame = np.bincount(np.asarray(lines.frame)[there])
    length = np.sqrt(12 * squares[there] / counts[there])  # of points spread evenly
    return tuple(float(np.median(values)) for values in (per_frame[per_frame > 0], length, counts[there]))


@bucketed_jit(returns=[of_lines] * 3)
def _sizes(lines):
    unchanged = lines.corrected(
        jnp.zeros((lines.focal.shape[0], lines.distortion_model.num_coefficients(1)), lines.focal.dtype)
    )
    return line_weights(lines), lines.counts, jnp.sum(unchanged**2, axis=(1, 2))


def candidate_lines(
    image_size: tuple[int, int], length: float
) -> Float[np.ndarray, "region direction line point 2"]:
    """Lines through each part of the image, level and upright: three across each, 25 points on each.

    They are `length` px long, or as long as the image; moved along themselves to lie within it.
    """
    size = np.array(image_size, float)
    steps = np.linspace(-0.5, 0.5, 25)
    lines = np.empty((len(_REGIONS), len(_DIRECTIONS), 3, 25, 2))
    for region, direction, line in np.ndindex(lines.shape[:3]):
        along, across = direction, 1 - direction  # 0 is x
        parts = np.array([region % 3, region // 3]) + 0.5
        parts[across] += (line - 1) / 3
        middle = size * parts / 3 - 0.5
        reach = min(length, size[along] - 1) / 2
        middle[along] = np.clip(middle[along], reach, size[along] - 1 - reach)
        lines[region, direction, line] = middle
        lines[region, direction, line, :, along] += 2 * reach * steps
    return lines


class _Known(NamedTuple):
    """What the lines tell.

    Attributes:
        information, noise: sums of their squared derivatives, as eq. 13 weighs them and with its weights
            squared.
        variance: of the points, px^2.
        points, frames: how many count.
    """

    information: np.ndarray
    noise: np.ndarray
    variance: float
    points: float
    frames: int


def _known(lines, zoom, weights, counts) -> _Known:
    weighted, jacobian, *_ = (np.asarray(part, float) for part in by_parameters(lines, zoom))
    information = np.einsum("lri,lrj->lij", jacobian, jacobian)
    freedom = np.sum(weights * (counts - 2))
    counted = weights > 0
    return _Known(
        information.sum(axis=0),
        np.einsum("l,lij->ij", weights, information),
        np.sum(weighted**2) / (freedom if freedom > 0 else 1),
        counts[counted].sum(),
        np.unique(np.asarray(lines.frame)[counted]).size,
    )


def _bands(known, rows, squared, counts, digits):
    """The mean standard deviation of the displacement now, and with each candidate, of so many points.

    For independent points; `rows` are those of `_derivatives`, rounded by `digits`, and `squared` the means
    of the squares of the others. A frame more has the weight of one in eq. 13, and its lines and points
    equal shares. In float64: squares have twice as many digits as what they are squares of.
    """
    information, noise, variance, points_counted, frames = known
    eps, tiny = np.finfo(float).eps, np.finfo(float).tiny
    eye = np.eye(rows.shape[-1])

    def typical(information, noise):
        """Of the estimate with the prior: a variance of 1 for each parameter, weighed as a point is."""
        lost = 64 * max(eps, 64 * digits**2)
        rounding = lost * np.trace(information, axis1=-2, axis2=-1) + tiny
        ridge = np.maximum(variance / points_counted, rounding)  # lines without noise would leave nothing
        ridge = ridge[..., None, None] * eye
        inverse = np.linalg.inv(information + ridge)
        covariance = inverse @ (variance * noise + ridge**2) @ inverse.swapaxes(-1, -2)
        squares = np.einsum("ndp,...pq,ndq->...n", rows, covariance, rows, optimize=True)
        least = eps * np.max(squares, axis=-1, keepdims=True)  # or rounding is negative
        return _average(np.sqrt(np.maximum(squares, least)))

    old, new = frames / (frames + 1), 1 / (frames + 1)
    with_photo = typical(old * information + new * squared, old**2 * noise + new**2 / counts * squared)
    return typical(information, noise), with_photo


@light_program
def _derivatives(lens, candidates, focals):
    """Derivatives by the parameters of where points all over the image go, at all focal lengths: (n, 2, p).

    And for each focal length and candidate those of the residuals of its points: (..., n, p).
    """
    flat, unravel = ravel_pytree(lens.zoom.parameters)
    everywhere = _image_grid(lens.image_size).astype(flat.dtype)

    def corrected(flat, points, focal):
        zoom = with_parameters(lens.zoom, unravel(flat))
        return at_focal(eqx.tree_at(lambda lens: lens.zoom, lens, zoom), focal).undistort(points)

    def residuals(flat, points, focal):
        line = corrected(flat, points, focal)
        return line_residuals(line - jnp.mean(line, axis=0)[None])

    def of_candidate(lines, focal):
        each = jax.vmap(jax.jacfwd(residuals), (None, 0, None))(flat, lines, focal)
        return each.reshape(-1, flat.size)

    rows = jax.vmap(jax.jacfwd(corrected), (None, None, 0))(flat, everywhere, focals)
    over = jax.vmap(jax.vmap(jax.vmap(of_candidate, (0, None)), (0, None)), (None, 0))
    return rows.reshape(-1, 2, flat.size), over(candidates, focals)


def _average(stds):
    """The geometric mean, over the last axis.

    The largest, or the plain mean, is that of the worst focal length; a photo elsewhere then gains nothing,
    and one there as much wherever its lines are, for the next worst is left.
    """
    return np.exp(np.mean(np.log(stds), axis=-1))


def _image_grid(image_size):
    """Points all over the image, its corners among them, and not its centre, which is always certain."""
    x, y = (np.linspace(0, side - 1, 6) for side in image_size)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
