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
from jaxtyping import Array, Float, Int

from ._checks import checked_terms
from ._solver import default_solver
from ._types import AnyArray, Point, traced
from .algebraic import algebraic_parameters, compressed
from .compression import CompressedLines
from .energy import energy_by_frame, frame_energy, prior_residuals, residuals
from .lens import ZoomLens, lens_of
from .lines import AbstractLines, Lines
from .radial import Distortion, monotone_radius
from .uncertainty import parameter_covariance
from .zoom import AbstractLinearZoom, AbstractZoom, PolynomialZoom, with_parameters

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
            variance and zero covariances. With a prior (`AbstractPriorZoom`), the mean square of both
            what noise and what the prior does to the parameters.
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

    def messages(self) -> list[str]:
        """For each frame a sentence about how its fit ended, empty where nothing is wrong."""
        return [
            RESULTS[jax.tree.map(lambda value, frame=frame: value[frame], self.result)]
            for frame in range(self.coefficients.shape[0])
        ]

    def distortion(self, frame: int) -> Distortion:
        """The distortion of one frame.

        Raises:
            IndexError: there is no such frame.
        """
        frames = self.coefficients.shape[0]
        if not -frames <= frame < frames:
            raise IndexError(f"There is no frame {frame}: the frames fitted are 0 to {frames - 1}.")
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
    terms: int | None = None,
    solver: Solver | None = None,
    max_steps: int = 256,
    throw: bool = True,
) -> ZoomFit:
    """The zoom model that minimises the global energy (eq. 13).

    Args:
        lines: the lines, or, much faster and with the same answer, ``compress(lines)``.
        zoom: the model; `PolynomialZoom` of degree 2 by default. One that has parameters already is where
            the solver starts; one without starts from the algebraic estimate, if it is linear.
        terms: the number N of distortion coefficients (eq. 2): by default 2, or as many as a `zoom` with
            parameters has.
        solver: any optimistix least-squares solver or minimiser; Levenberg-Marquardt by default, with
            tolerances for the dtype of the lines.
        max_steps: the most steps the solver may take.
        throw: raise where the solver fails. Otherwise `ZoomFit.result` says so. Results about the model
            (undetermined, folded) never raise.

    Raises:
        ValueError: fewer distinct focal lengths than the zoom model needs, lines compressed for fewer
            terms, or a `zoom` whose parameters are for another number of terms.
        TypeError: `lines` or `zoom` are something else.
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
    _check_lines(lines)
    model, terms = ready_model(lines, PolynomialZoom() if zoom is None else zoom, terms)
    start = None
    if isinstance(model, AbstractLinearZoom) and (zoom is None or zoom.parameters is None):
        start = compressed(lines, terms)
    solver = default_solver(lines) if solver is None else solver
    return _thrown(*_fit_zoom(lines, start, model, terms, solver, max_steps), throw)


def ready_model(lines, zoom, terms):
    """The model ready to be fitted to these lines, in their dtype, and its number of terms."""
    if not isinstance(zoom, AbstractZoom):
        raise TypeError(
            f"Argument zoom must be a zoom model such as PolynomialZoom(degree=2), but it is {zoom!r}."
        )
    own = None if zoom.parameters is None else jax.eval_shape(zoom, lines.focal[0]).shape[0]
    terms = checked_terms((own or 2) if terms is None else terms)
    if own not in (None, terms):
        raise ValueError(
            f"Argument terms is {terms}, but the parameters of zoom are for {own}: leave terms out, or "
            "start from a model without parameters."
        )
    prepared = zoom.prepare(lines.focal, terms)  # complains of too few focal lengths
    if own is None:
        return prepared, terms
    dtype = jnp.asarray(lines.focal).dtype
    arrays, rest = eqx.partition(zoom, eqx.is_inexact_array)
    return eqx.combine(jax.tree.map(lambda array: array.astype(dtype), arrays), rest), terms


def _check_lines(lines):
    if not isinstance(lines, AbstractLines):
        raise TypeError(
            "Argument lines must be Lines (see Lines.from_ragged) or compress(lines), but its type is "
            f"{type(lines).__name__}."
        )


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
    _check_lines(lines)
    terms = checked_terms(terms)
    chosen, present = lines.by_frame()
    solver = default_solver(lines) if solver is None else solver
    start = compressed(lines, terms)
    return _thrown(*_fit_frames(lines, start, chosen, present, terms, solver, max_steps), throw)


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
        TypeError: `lens` is something else, such as the fit that holds it.

    Warns:
        UserWarning: frames at focal lengths outside of the range that the lens was fitted on.
    """
    _check_lines(lines)
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
        lens.check_range(lines.focal)
        lines = _about(lines, lens.centre)
    elif not (lens is None or eqx.is_array_like(lens)):
        raise TypeError(
            "Argument lens must be a ZoomLens (fit.lens, not the fit), coefficients of each frame or None, "
            f"but its type is {type(lens).__name__}."
        )
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
        zoom = with_parameters(zoom, algebraic_parameters(start, zoom, terms))
    zoom, result, steps = _minimise(lines, zoom, solver, max_steps)
    weighted, jacobian = linearised(lines, zoom)
    errors = energy_by_frame(lines, weighted)
    covariance, determined = parameter_covariance(lines, zoom, jacobian, jnp.mean(errors))
    fit = ZoomFit(
        lens=lens_of(lines, zoom),
        rms=jnp.sqrt(jnp.mean(errors)),
        frame_rms=jnp.sqrt(errors),
        covariance=covariance,
        result=_judge(lines, zoom, result, determined),
        steps=steps,
    )
    return fit, _first_failure(fit.result)


@eqx.filter_jit
def _fit_frames(lines, start, chosen, present, terms, solver, max_steps):
    def fit(chosen, present):
        frame = lines.take(chosen, present)
        constant = PolynomialZoom(degree=0).prepare(frame.focal, terms)
        return _fit_zoom(frame, start.take(chosen, present), constant, terms, solver, max_steps)[0]

    # Small compressed frames are solved side by side; the points themselves one frame at a time, for
    # side by side they would all be in memory at once, padded to the fullest frame.
    batch = chosen.shape[0] if isinstance(lines, CompressedLines) else 1
    fits = jax.lax.map(lambda frame: fit(*frame), (chosen, present), batch_size=batch)
    each = FrameFits(
        coefficients=fits.lens.zoom.parameters[:, 0],
        rms=jnp.sqrt(jnp.mean(fits.rms**2)),
        frame_rms=fits.rms,
        covariance=fits.covariance,
        result=fits.result,
        centre=jnp.asarray(lines.centre),
        scale=lines.scale,
    )
    return each, _first_failure(each.result)


def _minimise(lines, zoom, solver, max_steps):
    """The model at the minimum of the global energy, from its own parameters as the start."""

    def function(parameters, args):
        lines, zoom = args
        zoom = with_parameters(zoom, parameters)
        return residuals(lines, jax.vmap(zoom)(lines.focal)), prior_residuals(lines, zoom)

    start = jax.tree.map(jax.lax.stop_gradient, zoom.parameters)
    solution = optx.least_squares(
        function, solver, start, args=(lines, zoom), max_steps=max_steps, throw=False
    )
    return with_parameters(zoom, solution.value), solution.result, solution.stats["num_steps"]


def linearised(lines, zoom):
    """The residuals and their derivatives by the flattened parameters, a row a residual."""
    flat, unravel = ravel_pytree(zoom.parameters)

    def function(flat):
        k = jax.vmap(with_parameters(zoom, unravel(flat)))(lines.focal)
        return (weighted := residuals(lines, k)), weighted

    jacobian, weighted = jax.jacfwd(function, has_aux=True)(flat)
    return weighted, jacobian


def _judge(lines, zoom, result, determined):
    """The worst of what the solver says and of what the model looks like."""
    width, height = lines.image_size
    corners = jnp.asarray([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]])
    offset = (corners - lines.centre[None]) / lines.scale
    farthest = jnp.sqrt(jnp.max(jnp.sum(offset**2, axis=1)))
    monotone = jax.vmap(monotone_radius)(jax.vmap(zoom)(lines.focal)) > farthest
    finite = jnp.all(jnp.isfinite(ravel_pytree(zoom.parameters)[0]))
    good: Any = RESULTS.successful  # inherited members, which pyright takes for another class's
    nonfinite: Any = RESULTS.nonfinite
    about_model = RESULTS.where(jnp.all(monotone), good, RESULTS.folded)
    about_model = RESULTS.where(determined, about_model, RESULTS.undetermined)
    about_model = RESULTS.where(finite, about_model, nonfinite)
    solved = RESULTS.promote(result)
    return RESULTS.where(solved == good, about_model, solved)


def _first_failure(result):
    """Whether a solver failed, in which frame first, and how; what is said of a model is no failure."""
    about_model = (result == RESULTS.undetermined) | (result == RESULTS.folded)
    failed = jnp.atleast_1d((result != RESULTS.successful) & ~about_model)
    frame = jnp.argmax(failed)
    return jnp.any(failed), frame, jax.tree.map(lambda value: jnp.atleast_1d(value)[frame], result)


def _thrown(fit, failure, throw):
    """The fit, raising where its solver failed."""
    failed, frame, result = failure
    if not throw:
        return fit
    if traced(failed):
        return result.error_if(fit, failed)
    if failed:
        where = f"Frame {int(frame)}: " if isinstance(fit, FrameFits) else ""
        raise RuntimeError(f"The fit failed. {where}{RESULTS[result]}")
    return fit
