"""Focal lengths with errors: their effect on a lens.

A fit treats the focal lengths of the frames as exact. If they are wrong by t_m, in log f, its parameters
a change so that the gradient g of the energy stays zero (the implicit function theorem):

    da = R t,    R = -(dg/da)^-1 dg/dt,    and their covariance is larger by R diag(sigma^2 / f^2) R^T.

The photos of a fit that does not know of the errors scatter more than lines explain, and its covariance
allows for that: what the errors explain of it is not counted twice.

Frames meet in the energy only through their coefficients k_m = k(f_m): near the minimum it is a sum over
frames of quadratics in k_m, found by N + 1 gradients whatever the number of frames, and all derivatives
by a and t are those of that sum.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, Num, ScalarLike

from .._core.arguments import kinds_checked
from .._core.arrays import in_float64
from .._core.fields import integers, real_argument
from .._core.types import AnyArray, Focal, traced
from ..lines.base import AbstractLines
from ..lines.buckets import bucketed_jit
from ..models.zoom import with_parameters
from .covariance import KnownErrors, parameter_covariance
from .energy import coefficients_by, linearised, prior_residuals, residuals
from .result import ZoomFit
from .same_camera import check_lines_of, placed_as

Sigma = ScalarLike | Num[AnyArray, "frame"]
Shared = Int[AnyArray, "frame"] | None


@kinds_checked
def with_focal_sigma(
    fit: ZoomFit, lines: AbstractLines, *, focal_sigma: Sigma, shared: Shared = None
) -> ZoomFit:
    """Add the uncertainty of the focal lengths to a fit's covariance, and so to all bands.

    Args:
        fit: the fit.
        lines: the lines that it was fitted to, with their weights; measured in the image, if they were.
        focal_sigma: standard deviation of the focal lengths, in the lines' unit: a number, or one per
            frame; 0 where they are exact. For focal lengths rounded to whole mm it is 0.29, 1/sqrt(12).
            Errors of frames are assumed to be independent, unless they are `shared`.
        shared: for each frame a number: frames of the same one share an error, as photos at one setting of
            the zoom whose focal length was measured once.

    Returns:
        The fit whose `covariance` includes them, to first order, computed in float64; under ``jit`` in the
        lines' dtype, and float32 may lose what lines hardly tell. A fit that does not know of the errors
        allows for photos that scatter more than their lines: what the errors explain of that is taken out.
        A fitted centre is held where it is in each frame, also one that moves along the zoom.

    Raises:
        ValueError: `focal_sigma` does not hold finite numbers of at least 0, one or one a frame; `shared`
            is not one number a frame; or the lines are not those of the fit: of another image size, unit
            or number of frames.

    Example:
        >>> from zoomjax import compress, displacement_std, fit_zoom, scenes
        >>> focal = scenes.focal_sweep(4)
        >>> lines = compress(scenes.board_lines(scenes.nikkor_18_200(), focal, spacing=99, noise=1))
        >>> exact = fit_zoom(lines)
        >>> rounded = with_focal_sigma(exact, lines, focal_sigma=0.29)
        >>> wide = [displacement_std(fit, focal[:2], focal=21.0) for fit in (exact, rounded)]
        >>> bool(wide[0] < wide[1])
        True
    """
    sigma, together = _checked_errors(fit, lines, focal_sigma, shared)
    lines = placed_as(fit.lens, lines)
    own = (fit.lens.zoom, fit.covariance, fit.joint)
    return with_covariances(fit, *in_float64(_widened_by, lines, *own, sigma, together))


def effects_of_focal(
    fit: ZoomFit, lines: AbstractLines, focal_sigma: Sigma, shared: Shared
) -> Float[np.ndarray, "frame coefficients error"]:
    """What errors of the focal lengths make of the coefficients that a fit has for the frames.

    Of independent errors of one standard deviation each: by a frame's own, and by the fit from all.

    Args:
        fit, lines, focal_sigma, shared: see `with_focal_sigma`; the lines about the centre of the fit.
    """
    sigma, together = _checked_errors(fit, lines, focal_sigma, shared)
    moves = jax.tree.map(np.asarray, in_float64(_moves, lines, fit.lens.zoom))
    number, relative = len(sigma), np.asarray(sigma) / np.asarray(lines.focal)
    _, error = np.unique(np.asarray(together), return_inverse=True)
    by_fit = np.zeros((len(moves.response), error.max() + 1))
    np.add.at(by_fit.T, error, (relative * moves.response[:, :number]).T)
    effects = moves.rows[:number] @ by_fit
    effects[np.arange(number), :, error] += relative[:, None] * moves.slope[:number]
    return effects


def _checked_errors(fit, lines, focal_sigma, shared):
    """The standard deviation of each frame's focal length, and a number for the error that it has."""
    check_lines_of(fit, lines)
    sigma = checked_sigma(focal_sigma, lines.focal)
    if not traced(sigma) and not np.isfinite(sigma).all():
        raise ValueError(
            f"Argument focal_sigma must hold finite numbers, but it is {focal_sigma}. {UNKNOWN}"
        )
    number = lines.focal.shape[0]
    together: Any = np.arange(number) if shared is None else integers("shared")(shared)
    if np.shape(together) != (number,):
        raise ValueError(
            f"Argument shared must hold a number for each of the {number} frames, but its shape is "
            f"{np.shape(together)}."
        )
    return sigma, together


def of_equal_focal(focal: Focal, shared: Int[AnyArray, "frame"] | None = None) -> np.ndarray:
    """For each frame a number, the same for those `shared` and for those of one focal length.

    Equal focal lengths are one step of a camera's encoder, one mark of the ring or one measurement: what is
    wrong with them does not average out. Where frames were zoomed between, bands are too wide.
    """
    values = np.asarray(focal)
    _, first = np.unique(values, return_index=True)
    number = first[np.searchsorted(values[first], values)]
    if shared is not None:
        for group in np.unique(shared):  # also of frames whose focal lengths differ by rounding
            of = np.isin(number, number[np.asarray(shared) == group])
            number[of] = number[of].min()
    return number


def with_covariances(fit, covariance, joint):
    """A fit with other covariances: of the parameters, and of these with the centre."""
    return eqx.tree_at(
        lambda fit: (fit.covariance, fit.joint), fit, (covariance, joint), is_leaf=lambda leaf: leaf is None
    )


@bucketed_jit(frames=["sigma", "shared"], returns=[None, None])
def _widened_by(lines, zoom, own, joint, sigma, shared):
    """`widened_by_focal` by standard deviations of the focal lengths, of which some are wrong together."""
    relative = sigma / jnp.asarray(lines.focal)
    together = shared[:, None] == shared[None]
    return widened_by_focal(
        lines, zoom, own, joint, jnp.where(together, relative[:, None] * relative[None], 0)
    )


UNKNOWN = (
    "Straight lines alone do not determine focal lengths: after a change of all focal lengths by an "
    "increasing function, another zoom model makes every line as straight. Take them from EXIF data or a "
    "table, or measure them from a board (focal_from_board) or a plane (focal_from_planes, "
    "focal_from_lines)."
)


def checked_sigma(focal_sigma: Any, focal: Focal) -> Float[AnyArray, "frame"]:
    """The standard deviation of each frame's focal length."""
    focal = jnp.asarray(focal)
    if focal_sigma is None:
        raise ValueError(f"Argument focal_sigma must be a number or one a frame, but it is None. {UNKNOWN}")
    given = real_argument("focal_sigma", focal_sigma)
    if not traced(given):  # beyond any lens, and variances do not overflow
        most = float(jnp.finfo(focal.dtype).max) ** 0.25
        given = np.asarray(given, float)
        given = np.where(np.isinf(given), given, np.minimum(given, most))
    sigma = jnp.asarray(given, focal.dtype)
    if sigma.shape not in ((), focal.shape):
        raise ValueError(
            f"Argument focal_sigma must hold one number, or one for each of the {focal.shape[0]} frames, "
            f"but its shape is {sigma.shape}."
        )
    if not traced(sigma):
        if np.isnan(sigma).any():
            raise ValueError(f"Argument focal_sigma must hold numbers, but it is {focal_sigma}. {UNKNOWN}")
        if (np.asarray(sigma) < 0).any():
            raise ValueError(f"Argument focal_sigma must be at least 0, but it is {focal_sigma}.")
    return jnp.broadcast_to(sigma, focal.shape) if traced(sigma) else np.broadcast_to(sigma, focal.shape)


class NearEnergy(NamedTuple):
    """Half the energy, up to a constant, near some coefficients of the frames."""

    coefficients: Float[Array, "frame terms"]
    gradient: Float[Array, "frame terms"]
    hessian: Float[Array, "frame terms terms"]

    def __call__(self, coefficients):
        """Its value at other coefficients, beyond that at these."""
        d = coefficients - self.coefficients
        return jnp.sum(self.gradient * d) + jnp.einsum("mi,mij,mj->", d, self.hessian, d) / 2


def near_energy(lines, coefficients) -> NearEnergy:
    """A frame's energy depends on its own coefficients alone: a direction serves all frames at once."""
    gradient = jax.grad(lambda k: jnp.sum(residuals(lines, k) ** 2) / 2)

    def along(direction):
        return jax.jvp(gradient, (coefficients,), (jnp.broadcast_to(direction[None], coefficients.shape),))

    values, columns = jax.vmap(along)(jnp.eye(coefficients.shape[1], dtype=coefficients.dtype))
    return NearEnergy(coefficients, values[0], jnp.moveaxis(columns, 0, 1))


def _response(lines, zoom) -> Float[Array, "parameter frame"]:
    """By how much the fitted parameters move with the logarithm of each frame's focal length."""
    flat, unravel = ravel_pytree(zoom.parameters)
    focal = jnp.asarray(lines.focal)
    near = near_energy(lines, coefficients_by(zoom, lines))

    def half(flat, t):
        model = with_parameters(zoom, unravel(flat))
        prior = prior_residuals(lines, model)
        return near(coefficients_by(model, at_focal_lengths(lines, focal * jnp.exp(t)))) + (
            0 if prior is None else jnp.sum(prior**2) / 2
        )

    by_both = jax.jacfwd(jax.grad(half), argnums=(0, 1))
    hessian, mixed = by_both(flat, jnp.zeros_like(focal))
    return -inverse_of(hessian) @ mixed


def inverse_of(matrix):
    """Of a symmetric matrix, in units of its diagonal; what it does not determine stays as it is."""
    size = jnp.sqrt(jnp.maximum(jnp.diagonal(matrix), 0))
    size = jnp.where(size > 0, size, 1)
    return jnp.linalg.pinv(matrix / size[:, None] / size[None], hermitian=True) / size[:, None] / size[None]


def widened_by_focal(lines, zoom, covariance, joint, of_focal, refined=False):
    """The covariance, and that with the centre, enlarged by that of the logarithms of the focal lengths.

    What they explain of the scatter of the photos does not enlarge it again: nothing where they were
    `refined`, as then the scatter is what is left. A fitted centre is held where it is; its covariance had
    been enlarged by the same factor as that of the parameters.
    """
    linear = linearised(lines, zoom)
    errors = _errors_of_focal(lines, zoom, of_focal)
    # By nothing, by what they explain alone, and by all.
    scores, zeros = jnp.where(refined, 0, errors.scores), jax.tree.map(jnp.zeros_like, errors)
    several = (zeros, zeros._replace(scores=scores), errors._replace(scores=scores))
    several = jax.tree.map(lambda *leaves: jnp.stack(leaves), *several)
    before, told, after = jax.vmap(
        lambda known: parameter_covariance(lines, zoom, linear, errors=known)[0]
    )(several)
    infinite = jnp.isinf(jnp.diagonal(covariance)) | jnp.isinf(jnp.diagonal(before))
    known = ~(infinite[:, None] | infinite[None])
    own, before, told, after = (jnp.where(known, m, 0) for m in (covariance, before, told, after))
    if joint is None:
        return jnp.where(known, own + (after - before), covariance), None
    matrix, number = jnp.einsum("lri,lrj->ij", linear.jacobian, linear.jacobian), own.shape[0]
    enlarged = jnp.sum(matrix * before)
    part = jnp.minimum(jnp.sum(matrix * told) / jnp.where(enlarged > 0, enlarged, 1), 1)
    wider = jnp.where(known, part * own + after - told, covariance)
    return wider, (part * joint).at[:number, :number].set(wider)


class _Moves(NamedTuple):
    """The coefficients of frames, and how they move."""

    coefficients: Float[Array, "frame coefficients"]
    rows: Float[Array, "frame coefficients parameter"]
    """With the parameters."""
    slope: Float[Array, "frame coefficients"]
    """With the logarithm of the frame's own focal length."""
    response: Float[Array, "parameter frame"]
    """The parameters, with those of all."""


def _moves_of(lines, zoom) -> _Moves:
    flat, unravel = ravel_pytree(zoom.parameters)
    focal = jnp.asarray(lines.focal)

    def coefficients(flat, t):
        model = with_parameters(zoom, unravel(flat))
        return coefficients_by(model, at_focal_lengths(lines, focal * jnp.exp(t)))

    still = jnp.zeros_like(focal)
    rows = jax.jacfwd(coefficients)(flat, still)
    k, slope = jax.jvp(lambda t: coefficients(flat, t), (still,), (jnp.ones_like(focal),))
    return _Moves(k, rows, slope, _response(lines, zoom))


_moves = bucketed_jit()(_moves_of)


def _errors_of_focal(lines, zoom, of_focal):
    """Focal lengths with this covariance of their logarithms, as errors of photos."""
    k, rows, slope, response = _moves_of(lines, zoom)
    # Of the coefficients of a frame, from its own focal length and, by the fit, from all.
    by_fit, covariance = rows @ (response @ of_focal).T[..., None], response @ of_focal @ response.T
    both = by_fit * slope[:, None]
    moved = rows @ covariance @ jnp.swapaxes(rows, 1, 2) + both + jnp.swapaxes(both, 1, 2)
    moved = moved + jnp.diagonal(of_focal)[:, None, None] * slope[:, :, None] * slope[:, None]
    pull = near_energy(lines, k).hessian @ rows
    return KnownErrors(jnp.einsum("mip,mij,mjq->mpq", pull, moved, pull), covariance)


def at_focal_lengths(lines, focal):
    """The lines with other focal lengths of their frames."""
    return eqx.tree_at(lambda lines: lines.focal, lines, focal)
