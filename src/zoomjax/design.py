"""Where to photograph next: the focal length and part of the image that would narrow the bands most.

A further photo changes the covariance ``H^-1 D H^-1`` of the fit (`uncertainty`) by what its lines add to
H and D, which depends on where they are and not on what will be measured there. So every candidate's band
is known beforehand: focal lengths over the range, nine parts of the image, lines level or upright,
as many and as long as in the photos there are. The noise, whatever its size, is taken to stay as it is.

Directions that no line determines get a prior, normalised coefficients of about 1, so that candidates can
be compared there too. One small Jacobian a candidate; nothing is fitted.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from .bands import displacement_std
from .energy import line_residuals, line_weights
from .fit import ZoomFit, linearised
from .lines import AbstractLines
from .zoom import with_parameters

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
    """The photo that would help most, and what each candidate would leave.

    Attributes:
        focal: the focal length to photograph at.
        direction: "horizontal" or "vertical": of the lines.
        region: the part of the image that they should run through, in words.
        before, after: the largest standard deviation, px, of the displacement over image and focal range,
            as it is and as it would be. Infinite where the lines do not determine the lens.
        focals: the candidates' focal lengths.
        regions: their parts of the image, in words.
        table: `after` of each candidate: of each focal length, region and direction.
        focal_unit: "mm" or "px".
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
        """What to do next, in words."""
        photo = (
            f"Next, photograph {self.direction} lines through {self.region} of the image at f = "
            f"{self.focal:.4g} {self.focal_unit}"
        )
        if not np.isfinite(self.before):
            return f"{photo}: of all there is to add, that would determine the lens best."
        return (
            f"{photo}: the largest standard deviation of the displacement would fall from "
            f"{self.before:.2g} to {self.after:.2g} px."
        )


def suggest_next(
    fit: ZoomFit, lines: AbstractLines, *, focal_range: tuple[float, float] | None = None
) -> Suggestion:
    """The further photo that would shrink the displacement's band most.

    Args:
        fit: the fit.
        lines: what it was fitted to, compressed or not.
        focal_range: from the shortest to the longest focal length that matters, in the lens's unit; by
            default those fitted.

    Returns:
        The best of the candidates, and all of them.

    Raises:
        ValueError: `focal_range` is not two positive numbers in order.

    Example:
        >>> from zoomjax import compress, fit_zoom, synthetic
        >>> focal = synthetic.focal_sweep(4)
        >>> lines = compress(synthetic.board_lines(synthetic.nikkor_18_200(), focal, spacing=99, noise=1))
        >>> suggest_next(fit_zoom(lines), lines).sentence
        'Next, photograph ...
    """
    low, high = (float(f) for f in (fit.lens.focal_range if focal_range is None else focal_range))
    if not 0 < low <= high < np.inf:
        raise ValueError(
            "Argument focal_range must be two positive numbers, the shorter first, but it is "
            f"{focal_range!r}."
        )
    focals = np.unique(1 / np.linspace(1 / low, 1 / high, _FOCALS))
    typical = _typical(lines)
    now, table = _bands(fit, lines, jnp.asarray(focals, fit.covariance.dtype), typical)
    points, grid = _image_grid(fit.lens.image_size), jnp.asarray(focals, fit.covariance.dtype)
    before = float(jnp.max(displacement_std(fit, points[:, None], focal=grid)))
    # What was measured of the noise is in `before`; how a photo changes it is the ratio.
    table = before * (np.asarray(table) / float(now)) if np.isfinite(before) else np.asarray(table)
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


def _typical(lines):
    """Of the lines there are: how many a frame, how long (px) and of how many points, the medians."""
    there = np.asarray(line_weights(lines)) > 0
    counts = np.asarray(lines.counts)[there]
    zero = jnp.zeros((lines.frame.shape[0], 1), lines.focal.dtype)
    squares = np.asarray(jnp.sum(lines.corrected(zero) ** 2, axis=(1, 2)))[there]
    per_frame = np.bincount(np.asarray(lines.frame)[there])
    length = np.sqrt(12 * squares / counts)  # of points spread evenly
    return tuple(
        jnp.asarray(np.median(values), lines.focal.dtype) for values in (per_frame, length, counts)
    )


def candidate_lines(
    fit: ZoomFit, focal: Float[Array, ""], length: Float[Array, ""]
) -> Float[Array, "region direction line point 2"]:
    """Lines of the scene through each part of the image, level and upright, as the lens would show them.

    Three lines across each part, 25 points each, `length` px where the image is as wide; NaN where a point
    would fall outside of it.
    """
    size = jnp.asarray(fit.lens.image_size, length.dtype)
    distortion = fit.lens(focal)
    along = jnp.linspace(-0.5, 0.5, 25, dtype=length.dtype) * length

    def seen(region, direction, line):
        column_row = jnp.stack([region % 3, region // 3])
        across = jnp.arange(2) != direction
        middle = size * (2 * column_row + 1 + jnp.where(across, line, 0)) / 6 - 0.5
        reach = jnp.where(across, 0, jnp.minimum(length, size) / 2)
        middle = jnp.clip(middle, reach, size - 1 - reach)
        step = along[:, None] * jnp.where(across, 0, 1)[None]
        points = distortion.distort(distortion.undistort(middle)[None] + step)
        inside = jnp.all((points >= 0) & (points <= size[None] - 1), axis=1)
        return jnp.where(inside[:, None], points, jnp.nan)

    lines = jnp.asarray([-0.67, 0.0, 0.67], length.dtype)
    over = jax.vmap(jax.vmap(jax.vmap(seen, (None, None, 0)), (None, 0, None)), (0, None, None))
    return over(jnp.arange(9), jnp.arange(2), lines)


@eqx.filter_jit
def _bands(fit, lines, focals, typical):
    """The largest standard deviation of the displacement now, and with each candidate.

    For independent points; of `typical` the number of lines a frame, their length and number of points.
    """
    number, length, counts = typical
    zoom = fit.lens.zoom
    flat, unravel = ravel_pytree(zoom.parameters)
    weights, frames = line_weights(lines), lines.focal.shape[0]
    weighted, jacobian = linearised(lines, zoom)
    information = jnp.einsum("lri,lrj->ij", jacobian, jacobian)
    noise = jnp.einsum("l,lri,lrj->ij", weights, jacobian, jacobian)
    variance = jnp.sum(weighted**2) / _positive(jnp.sum(weights * (lines.counts - 2)))
    rows = _displacement_rows(fit, flat, unravel, focals)

    def largest(information, noise):
        """Of the estimate with the prior: a variance of 1 for each parameter, weighed as a point is."""
        ridge = variance / jnp.sum(jnp.where(weights > 0, lines.counts, 0))
        eye = jnp.eye(flat.size, dtype=flat.dtype)
        inverse = jnp.linalg.inv(information + ridge * eye)
        covariance = inverse @ (variance * noise + ridge**2 * eye) @ inverse
        return jnp.sqrt(jnp.max(jnp.einsum("ndp,pq,ndq->n", rows, covariance, rows)))

    def of_line(points, focal):
        """Mean over a line's points of the squared derivatives of their residuals."""
        inside = jnp.isfinite(points[:, 0])
        share = inside / jnp.maximum(jnp.sum(inside), 1)
        points = jnp.where(inside[:, None], points, 0)

        def residuals(flat):
            lens = eqx.tree_at(lambda lens: lens.zoom, fit.lens, with_parameters(zoom, unravel(flat)))
            corrected = lens(focal).undistort(points)
            centred = corrected - (share @ corrected)[None]
            return line_residuals(jnp.where(inside[:, None], centred, 0))

        derivative = jax.jacfwd(residuals)(flat)
        return derivative.T @ derivative / jnp.maximum(jnp.sum(inside), 1), jnp.mean(inside)

    def with_photo(points, focal):
        """A frame more: eq. 13 gives it the weight of one, and its lines and points equal shares."""
        squared, inside = jax.vmap(of_line, (0, None))(points, focal)
        of_points = squared / jnp.where(inside > 0, inside, 1)[:, None, None]
        old = frames / (frames + 1)
        more = jnp.mean(squared, axis=0) / (frames + 1)
        more_noise = jnp.mean(of_points, axis=0) / ((frames + 1) ** 2 * number * counts)
        return largest(old * information + more, old**2 * noise + more_noise)

    def at_focal(focal):
        candidates = candidate_lines(fit, focal, length)
        shape = candidates.shape
        return jax.lax.map(lambda photo: with_photo(photo, focal), candidates.reshape(-1, *shape[2:]))

    table = jax.lax.map(at_focal, focals)
    return largest(information, noise), table.reshape(focals.shape[0], len(_REGIONS), len(_DIRECTIONS))


def _displacement_rows(fit, flat, unravel, focals):
    """Derivatives by the parameters of where points all over the image go, at all focal lengths."""
    points = _image_grid(fit.lens.image_size).astype(flat.dtype)

    def corrected(flat, focal):
        zoom = with_parameters(fit.lens.zoom, unravel(flat))
        return eqx.tree_at(lambda lens: lens.zoom, fit.lens, zoom)(focal).undistort(points)

    rows = jax.vmap(jax.jacfwd(corrected), (None, 0))(flat, focals)
    return rows.reshape(-1, 2, flat.size)


def _image_grid(image_size):
    """Points all over the image, its corners among them."""
    x, y = (jnp.linspace(0, side - 1, 5) for side in image_size)
    return jnp.stack(jnp.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _positive(value):
    return jnp.where(value > 0, value, 1)
