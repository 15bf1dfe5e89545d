"""Fits: the zoom model that minimises the global energy, and each frame by itself (eq. 13, 3 and 6).

The unknowns are the zoom model's parameters alone, the lines having dropped out (`energy`). Solvers are
optimistix', with Jacobians by automatic differentiation; a fitted model is differentiable with respect to
the points through the implicit function theorem. A frame by itself is a zoom polynomial of degree 0 on
the lines of that frame, so that one solver serves both, `vmap`\\ ped over the frames.

Compiled once for a shape of the lines; once per fit an algebraic start and, after it, the covariance;
per iteration one Jacobian of the residuals.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, PyTree

from ._solver import default_solver
from ._types import AnyArray, Point, traced
from .algebraic import algebraic_parameters, compressed
from .compression import CompressedLines
from .energy import frame_energy, line_weights, residuals
from .lens import ZoomLens, lens_of
from .lines import AbstractLines, Lines
from .radial import Distortion, monotone_radius
from .zoom import AbstractLinearZoom, AbstractZoom, PolynomialZoom

Solver = optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser


class RESULTS(optx.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
    """How a fit ended: optimistix' results, and two about the model that came out."""

    undetermined = (
        "The lines do not determine all coefficients: some can change without bending any line by more "
        "than the noise does, and their variance is reported as infinite. Add lines that pass far from the "
        "centre of distortion, at more focal lengths, or lower the degree or the number of terms."
    )
    folded = (
        "The fitted distortion is not invertible over the whole image at every fitted focal length: beyond "
        "its monotone radius the corrected image folds over. Add lines near the corners, remove lines that "
        "are not straight in the scene, or lower the degree or the number of terms."
    )


class ZoomFit(eqx.Module):
    """A fitted zoom lens.

    Attributes:
        lens: from a focal length to the distortion there.
        rms: root of the global energy (eq. 13), px of the corrected image.
        frame_rms: root of each frame's error (eq. 3), px.
        covariance: of the zoom model's parameters in normalised units, flattened row by row (for a
            polynomial: all terms of power 0, then of power 1, ...). Points are taken to have independent
            errors of one size, estimated from the residuals. An undetermined parameter has infinite
            variance and zero covariances.
        result: how the fit ended; ``RESULTS[fit.result]`` is a sentence.
        steps: number of steps the solver took.
    """

    lens: ZoomLens
    rms: Float[Array, ""]
    frame_rms: Float[Array, "frame"]
    covariance: Float[Array, "parameter parameter"]
    result: RESULTS
    steps: Int[Array, ""]


class FrameFits(eqx.Module):
    """Each frame fitted by itself (eq. 6).

    Attributes:
        coefficients: normalised (k1, ..., kN) of each frame.
        rms: root of the mean of the frames' errors, px: what a zoom model's `rms` is compared with.
        frame_rms: root of each frame's error (eq. 3), px.
        covariance: of each frame's coefficients; see `ZoomFit`.
        result: how each frame's fit ended.
        centre: centre of distortion, px.
        scale: the length in px that is radius 1.
    """

    coefficients: Float[Array, "frame terms"]
    rms: Float[Array, ""]
    frame_rms: Float[Array, "frame"]
    covariance: Float[Array, "frame terms terms"]
    result: RESULTS
    centre: Point
    scale: float = eqx.field(static=True)

    def distortion(self, frame: int) -> Distortion:
        """The distortion of one frame."""
        dtype = self.coefficients.dtype
        return Distortion(
            self.coefficients[frame],
            jnp.asarray(self.centre, dtype),
            jnp.asarray(self.scale, dtype),
        )


def fit_zoom(
    lines: AbstractLines,
    *,
    zoom: AbstractZoom | None = None,
    terms: int = 2,
    solver: Solver | None = None,
    max_steps: int = 256,
    throw: bool = True,
) -> ZoomFit:
    """The zoom model that minimises the global energy (eq. 13).

    Args:
        lines: the lines, or, much faster and with the same answer, ``compress(lines)``.
        zoom: the model; `PolynomialZoom` of degree 2 by default. One that has parameters already is where
            the solver starts, and brings its own number of terms; one without starts from the algebraic
            estimate, if it is linear.
        terms: the number N of distortion coefficients (eq. 2).
        solver: any optimistix least-squares solver or minimiser; Levenberg-Marquardt by default, with
            tolerances for the dtype of the lines.
        max_steps: the most steps the solver may take.
        throw: raise where the solver fails. Otherwise `ZoomFit.result` says so. Results about the model
            (undetermined, folded) never raise.

    Raises:
        ValueError: fewer distinct focal lengths than the zoom model needs, or lines compressed for fewer
            terms.
        RuntimeError: the solver failed (see `throw`).

    Example:
        >>> import jax.numpy as jnp, numpy as np
        >>> from zoomjax import Lines, compress
        >>> t = np.linspace(0.0, 479.0, 50)
        >>> bent = [np.stack([x + f * (t / 240 - 1) ** 2, t], axis=-1) for f in (1, 2) for x in (9, 599)]
        >>> lines = Lines.from_ragged(bent, [0, 0, 1, 1], [50, 100], image_size=(640, 480))
        >>> fit = fit_zoom(compress(lines), zoom=PolynomialZoom(degree=1), terms=1)
        >>> bool(fit.rms < 1)
        True
    """
    model = PolynomialZoom() if zoom is None else zoom
    if model.parameters is None:
        model = model.prepare(lines.focal, terms)
        start = compressed(lines, terms) if isinstance(model, AbstractLinearZoom) else None
    else:
        start = None
    solver = default_solver(lines) if solver is None else solver
    fit = _fit_zoom(lines, start, model, terms, solver, max_steps)
    return _thrown(fit, throw)


def fit_frames(
    lines: AbstractLines,
    *,
    terms: int = 2,
    solver: Solver | None = None,
    max_steps: int = 256,
    throw: bool = True,
) -> FrameFits:
    """The distortion of each frame by itself (eq. 3 and 6): what a zoom model is compared with.

    Args:
        lines, terms, solver, max_steps, throw: as for `fit_zoom`.

    Raises:
        RuntimeError: the solver failed on some frame, and `throw` is set.
    """
    chosen, present = lines.by_frame()
    solver = default_solver(lines) if solver is None else solver
    fits = _fit_frames(lines, compressed(lines, terms), chosen, present, terms, solver, max_steps)
    return _thrown(fits, throw)


def frame_rms(
    lines: AbstractLines, lens: ZoomLens | Float[AnyArray, "frame terms"] | None
) -> Float[Array, "frame"]:
    """Root of the error (eq. 3) of each frame, px, as corrected by a lens.

    Args:
        lines: the lines, or their compressed form.
        lens: a fitted lens, or the coefficients of each frame, or None for no correction. A lens brings
            its own centre of distortion.

    Raises:
        ValueError: the lens is for images of another size or focal lengths in another unit, there are not
            coefficients for every frame, or the lines were compressed about another centre.
    """
    if isinstance(lens, ZoomLens):
        if lens.image_size != lines.image_size:
            raise ValueError(
                f"The lens is for images of size {lens.image_size}, but the lines are from images of size "
                f"{lines.image_size}."
            )
        if lens.focal_unit != lines.focal_unit:
            raise ValueError(
                f"The lens takes focal lengths in {lens.focal_unit}, but those of the lines are in "
                f"{lines.focal_unit}."
            )
        lines = _about(lines, lens.centre)
    return _frame_rms(lines, lens)


def _about(lines, centre):
    if isinstance(lines, Lines):
        return eqx.tree_at(lambda data: data.centre, lines, centre)
    if not traced((lines.centre, centre)) and not jnp.allclose(lines.centre, centre, rtol=0, atol=1e-3):
        raise ValueError(
            "The lens and the compressed lines have different centres of distortion. Compress the lines "
            "about the lens's centre, or pass the lines themselves."
        )
    return lines


@eqx.filter_jit
def _frame_rms(lines, lens):
    focal = jnp.asarray(lines.focal)
    if lens is None:
        coefficients = jnp.zeros((focal.shape[0], 1), focal.dtype)
    elif isinstance(lens, ZoomLens):
        coefficients = jax.vmap(lens.zoom)(focal)
    else:
        coefficients = lens
    return jnp.sqrt(frame_energy(lines, jnp.asarray(coefficients)))


@eqx.filter_jit
def _fit_zoom(lines, start, zoom, terms, solver, max_steps):
    if start is not None:
        zoom = _with_parameters(zoom, algebraic_parameters(start, zoom, terms))
    zoom, result, steps = _minimise(lines, zoom, solver, max_steps)
    errors = frame_energy(lines, jax.vmap(zoom)(lines.focal))
    covariance, determined = _covariance(lines, zoom, jnp.mean(errors))
    return ZoomFit(
        lens=lens_of(lines, zoom),
        rms=jnp.sqrt(jnp.mean(errors)),
        frame_rms=jnp.sqrt(errors),
        covariance=covariance,
        result=_judge(lines, zoom, result, determined),
        steps=steps,
    )


@eqx.filter_jit
def _fit_frames(lines, start, chosen, present, terms, solver, max_steps):
    def fit(chosen, present):
        frame = lines.take(chosen, present)
        constant = PolynomialZoom(degree=0).prepare(frame.focal, terms)
        return _fit_zoom(frame, start.take(chosen, present), constant, terms, solver, max_steps)

    # Small compressed frames are solved side by side; the points themselves one frame at a time, for
    # side by side they would all be in memory at once, padded to the fullest frame.
    batch = chosen.shape[0] if isinstance(lines, CompressedLines) else 1
    fits = jax.lax.map(lambda frame: fit(*frame), (chosen, present), batch_size=batch)
    return FrameFits(
        coefficients=fits.lens.zoom.parameters[:, 0],
        rms=jnp.sqrt(jnp.mean(fits.rms**2)),
        frame_rms=fits.rms,
        covariance=fits.covariance,
        result=fits.result,
        centre=jnp.asarray(lines.centre),
        scale=lines.scale,
    )


def _with_parameters(zoom: AbstractZoom, parameters: PyTree) -> Any:
    return eqx.tree_at(lambda model: model.parameters, zoom, parameters)


def _minimise(lines, zoom, solver, max_steps):
    """The model at the minimum of the global energy, from its own parameters as the start."""

    def function(parameters, args):
        lines, zoom = args
        return residuals(lines, jax.vmap(_with_parameters(zoom, parameters))(lines.focal))

    start = jax.tree.map(jax.lax.stop_gradient, zoom.parameters)
    solution = optx.least_squares(
        function, solver, start, args=(lines, zoom), max_steps=max_steps, throw=False
    )
    return _with_parameters(zoom, solution.value), solution.result, solution.stats["num_steps"]


def _covariance(lines, zoom, energy):
    """Covariance of the flattened parameters, and whether the lines determine them all.

    For the weights w of eq. 13, which are not the inverse variances, the covariance is the sandwich
    ``sigma^2 (J^T W J)^-1 (J^T W^2 J) (J^T W J)^-1``.

    A parameter is *undetermined* where moving it changes the residuals by less than twice what noise in
    the points alone would feign: each point's error appears in the derivative by k_j, times r^(2j). (Lines
    through the centre have nothing else there, and would otherwise seem to determine k from their noise.)
    """
    flat, unravel = ravel_pytree(zoom.parameters)

    def coefficients_at(flat):
        return jax.vmap(_with_parameters(zoom, unravel(flat)))(lines.focal)

    jacobian = jax.jacfwd(lambda flat: residuals(lines, coefficients_at(flat)))(flat)
    information = jnp.einsum("lri,lrj->ij", jacobian, jacobian)
    weights = line_weights(lines)
    outer = jnp.einsum("l,lri,lrj->ij", weights, jacobian, jacobian)

    # The noise of the points themselves: residuals are shrunk by L, so divide by its mean square.
    k = coefficients_at(flat)
    terms = k.shape[1]
    order = jnp.arange(terms + 1)
    moments = lines.radial_moments(2 * terms)[:, order[:, None] + order[None]] * weights[:, None, None]
    kappa = jnp.concatenate([jnp.ones_like(k[:, :1]), k], axis=1)[lines.frame]
    variance_in_image = energy / jnp.einsum("li,lij,lj->", kappa, moments, kappa)
    by_parameter = jax.jacfwd(coefficients_at)(flat)[lines.frame]  # (line, terms, parameter)
    feigned = variance_in_image * jnp.einsum(
        "lip,lij,ljq->pq", by_parameter, moments[:, 1:, 1:], by_parameter
    )

    # Unit diagonal, so that one threshold serves parameters of any size.
    size = jnp.sqrt(jnp.diagonal(information))
    size = jnp.where(size > 0, size, 1)
    scaled = information / size[:, None] / size[None]
    excess = scaled - 4 * feigned / size[:, None] / size[None]
    eps = jnp.finfo(flat.dtype).eps
    (excesses, values), (directions, vectors) = jnp.linalg.eigh(jnp.stack([excess, scaled]))
    undetermined = jnp.any((excesses <= 4 * eps)[None] & (jnp.abs(directions) > 0.05), axis=1)
    good = values > 4 * eps
    inverse = (vectors * jnp.where(good, 1 / jnp.where(good, values, 1), 0)[None]) @ vectors.T
    inverse = inverse / size[:, None] / size[None]
    freedom = jnp.sum(weights * (lines.counts - 2)) - jnp.sum(inverse * outer)
    undetermined = undetermined | (freedom <= 0)  # nothing is left over to tell the noise by
    variance = energy / jnp.where(freedom > 0, freedom, 1)
    covariance = variance * inverse @ outer @ inverse
    either = undetermined[:, None] | undetermined[None]
    infinite = jnp.where(jnp.eye(flat.size, dtype=bool), jnp.inf, 0)
    return jnp.where(either, infinite, covariance), ~jnp.any(undetermined)


def _judge(lines, zoom, result, determined):
    """The worst of what the solver says and of what the model looks like."""
    width, height = lines.image_size
    corners = jnp.asarray([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]])
    offset = (corners - lines.centre[None]) / lines.scale
    farthest = jnp.sqrt(jnp.max(jnp.sum(offset**2, axis=1)))
    monotone = jax.vmap(monotone_radius)(jax.vmap(zoom)(lines.focal)) > farthest
    finite = jnp.all(jnp.isfinite(ravel_pytree(zoom.parameters)[0]))
    successful = RESULTS.promote(optx.RESULTS.successful)
    about_model = RESULTS.where(jnp.all(monotone), successful, RESULTS.folded)
    about_model = RESULTS.where(determined, about_model, RESULTS.undetermined)
    solved = RESULTS.promote(result)
    return RESULTS.where(
        solved != RESULTS.successful,
        solved,
        RESULTS.where(finite, about_model, RESULTS.promote(optx.RESULTS.nonfinite)),
    )


def _thrown(fit, throw):
    """The fit, raising where its solver failed; what is said of the model itself never raises."""
    if not throw:
        return fit
    result = fit.result
    about_model = (result == RESULTS.undetermined) | (result == RESULTS.folded)
    failed = jnp.atleast_1d((result != RESULTS.successful) & ~about_model)
    first = jax.tree.map(lambda value: jnp.atleast_1d(value)[jnp.argmax(failed)], result)
    if traced(failed):
        return first.error_if(fit, jnp.any(failed))
    if failed.any():
        where = f"Frame {int(jnp.argmax(failed))}: " if failed.size > 1 else ""
        raise RuntimeError(f"The fit failed. {where}{RESULTS[first]}")
    return fit
