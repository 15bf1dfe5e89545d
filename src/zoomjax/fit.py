"""Fits: the zoom model that minimises the global energy, and each frame by itself (eq. 13, 3 and 6).

The unknowns are the zoom model's parameters alone, the lines having dropped out (`energy`). Solvers are
optimistix', with Jacobians by automatic differentiation; a fitted model is differentiable with respect to
the points through the implicit function theorem. A frame by itself is a zoom polynomial of degree 0 on
the lines of that frame, so that one solver serves both, `vmap`\\ ped over the frames.

A model that is not certified to be invertible is replaced by the best one that is: the same energy is
minimised again, the slope of the radius kept above `LEAST_SLOPE` all over the image and focal range, by an
interior-point method. For a linear zoom model the inequalities are linear, and hold without distortion.

Compiled once for a shape of the lines; once per fit an algebraic start and, after it, the covariance and
the certificate; per iteration one Jacobian of the residuals.
"""

from typing import Any, NoReturn

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from ._arguments import kinds_checked
from ._checks import checked_terms
from ._interior import implicit, least_squares_within
from ._solver import default_solver
from ._types import AnyArray, Centres, traced
from .algebraic import algebraic_parameters, compressed
from .any_centre import AnyCentreLines
from .certificate import Certificate, certificate_of, slope_controls, stated_pieces
from .compression import CompressedLines
from .energy import coefficients_by, energy_by_frame, frame_energy, prior_residuals, residuals, settings
from .families import AbstractFamily, RadialPolynomial
from .family_lines import FamilyLines, points_of, with_family
from .image_metric import ImageLines, in_image
from .lens import ZoomLens, lens_of
from .lines import AbstractLines, Lines
from .radial import Distortion
from .uncertainty import parameter_covariance
from .zoom import AbstractLinearZoom, AbstractZoom, PolynomialZoom, with_parameters

Solver = optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser

LEAST_SLOPE = 0.02
"""What the slope of the radius is kept above where a fit has to be made invertible: the inverse then
magnifies distances at most 50 times. Real lenses are far from it (the Nikkor 18-200 of the paper: 0.91)."""

_MOST_STEPS = 200
"""Of the interior-point method, which takes 10 to 20."""


class RESULTS(optx.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
    """How a fit ended: optimistix' results, and three about the model that came out."""

    undetermined = (
        "The lines do not determine all coefficients: some can change without bending any line by more "
        "than the noise does, and their variance is reported as infinite. Add lines that pass far from the "
        "centre of distortion, at more focal lengths, or lower the degree or the number of terms."
    )
    folded = (
        "The fitted distortion is not invertible over the whole image and the range of focal lengths: its "
        "`certificate` says where the corrected image folds over. Add lines near the corners, remove lines "
        "that are not straight in the scene, or lower the degree or the number of terms."
    )
    constrained = (
        "The lines fit best with a distortion that is not invertible over the whole image and the range of "
        "focal lengths; this is the best one that is, and `rms_unconstrained` tells what that cost. Add "
        "lines near the corners, remove lines that are not straight in the scene, or lower the degree or "
        "the number of terms."
    )


class ZoomFit(eqx.Module):
    """A fitted zoom lens.

    Attributes:
        lens: from a focal length to the distortion there.
        rms: root of the global energy (eq. 13), px of the corrected image.
        frame_rms: root of each frame's error (eq. 3), px; NaN for a frame whose lines all weigh nothing.
        covariance: of the zoom model's parameters in normalised units, flattened row by row (for a
            polynomial: all terms of power 0, then of power 1, ...). Lines are taken to have independent
            errors, points of a line are not: it is the line-by-line sandwich of the residuals, its shape
            shrunk to what independent points would give by as much as its own scatter demands. Where
            there are too few lines for that, points are taken to be independent. An undetermined
            parameter has infinite variance and zero covariances. With a prior (`AbstractPriorZoom`), the
            mean square of both what noise and what the prior does to the parameters. What invertibility
            forbids is not taken into account.
        result: how the fit ended; ``RESULTS[fit.result]`` is a sentence.
        steps: number of steps the solver took.
        certificate: whether the lens is invertible over its image and focal range.
        rms_unconstrained: what `rms` is without the demand that the lens be invertible: the same, unless
            the lens had to be made so. The result is then `constrained`, if there is nothing worse to say.
    """

    lens: ZoomLens
    rms: Float[Array, ""]
    frame_rms: Float[Array, "frame"]
    covariance: Float[Array, "parameter parameter"]
    result: RESULTS
    steps: Int[Array, ""]
    certificate: Certificate
    rms_unconstrained: Float[Array, ""]

    def __call__(self, *_: Any, **__: Any) -> NoReturn:
        """Raise TypeError: the lens of a fit is asked, not the fit."""
        raise TypeError("A ZoomFit is not a lens: use fit.lens, as in fit.lens(35.0).")


class FrameFits(eqx.Module):
    """Each frame fitted by itself (eq. 6).

    Attributes:
        coefficients: normalised (k1, ..., kN) of each frame.
        rms: root of the mean of the frames' errors, px: what a zoom model's `rms` is compared with.
        frame_rms: root of each frame's error (eq. 3), px; NaN for a frame whose lines all weigh nothing.
        covariance: of each frame's coefficients; see `ZoomFit`.
        result: how each frame's fit ended.
        certificate: of each frame, whether it is invertible over the image.
        rms_unconstrained: what `rms` is without the demand that every frame be invertible.
        centre: centre of distortion, px: of all frames, or of each.
        scale: the length in px that is radius 1.
        family: what the coefficients mean.
    """

    coefficients: Float[Array, "frame terms"]
    rms: Float[Array, ""]
    frame_rms: Float[Array, "frame"]
    covariance: Float[Array, "frame terms terms"]
    result: RESULTS
    certificate: Certificate
    rms_unconstrained: Float[Array, ""]
    centre: Centres
    scale: float = eqx.field(static=True)
    family: AbstractFamily = RadialPolynomial()

    def __call__(self, *_: Any, **__: Any) -> NoReturn:
        """Raise TypeError: there is a distortion of each frame, and none between them."""
        raise TypeError(
            "FrameFits are not a lens: use each.distortion(frame) for one frame's distortion, or fit_zoom "
            "for a lens at any focal length."
        )

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
            jnp.broadcast_to(jnp.asarray(self.centre, dtype), (frames, 2))[frame],
            jnp.asarray(self.scale, dtype),
            self.family,
        )


@kinds_checked
def fit_zoom(
    lines: AbstractLines,
    *,
    zoom: AbstractZoom | None = None,
    family: AbstractFamily | None = None,
    terms: int | None = None,
    solver: Solver | None = None,
    max_steps: int = 256,
    invertible: bool = True,
    throw: bool = True,
) -> ZoomFit:
    """The zoom model that minimises the global energy (eq. 13), among those that are invertible.

    Args:
        lines: the lines, or, much faster and with the same answer, ``compress(lines)``.
        zoom: the model; `PolynomialZoom` of degree 2 by default. One that has parameters already is where
            the solver starts; one without starts from the algebraic estimate, if it is linear and the
            family the radial polynomial, and otherwise from no distortion.
        family: what the coefficients mean, `RadialPolynomial` (eq. 2) unless lines have another already
            (`compress_family`): `Division` or `BrownConrady`, which has two coefficients besides.
        terms: the number N of radial distortion coefficients (eq. 2): by default 2, or as many as a `zoom`
            with parameters has.
        solver: any optimistix least-squares solver or minimiser; Levenberg-Marquardt by default, with
            tolerances for the dtype of the lines.
        max_steps: the most steps the solver may take.
        invertible: whether a model that is not certified to be invertible, over the whole image and the
            range of focal lengths, gives way to the best one that is, with a slope of the radius (see
            `Certificate`) of at least 0.02. A model that is certified stays as it is, to the last bit. For
            zoom models that do not state their `pieces` this does nothing; for a `PowerZoom`, which is not
            linear, it gives an invertible model that need not be the very best, and of another family than
            the polynomial nothing is proved of it. Under ``vmap`` the search for the best one that is runs
            for the whole batch if one fit of it needs it, and not at all if none does.
        throw: raise where the solver fails. Otherwise `ZoomFit.result` says so. Results about the model
            (undetermined, folded, constrained) never raise.

    Raises:
        ValueError: fewer distinct focal lengths than the zoom model needs, lines compressed for fewer
            terms, or a `zoom` whose parameters are for another number of terms.
        TypeError: an argument is of another kind, such as the class PolynomialZoom for an instance.
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
    lines = lines if family is None else with_family(lines, family)
    model, terms = ready_model(lines, PolynomialZoom() if zoom is None else zoom, terms)
    start = None
    if isinstance(model, AbstractLinearZoom) and (zoom is None or zoom.parameters is None):
        start = algebraic_start(lines, terms)
    solver = default_solver(lines) if solver is None else solver
    fit, outcome = _fit_zoom(lines, start, model, terms, solver, max_steps)
    if invertible:
        fit, outcome = _or_else(fit, outcome, lambda: _refit_zoom(_small(lines, terms), fit))
    return _thrown(fit, outcome, throw)


def ready_model(lines, zoom, terms):
    """The model ready to be fitted to these lines, in their dtype, and its number of radial terms."""
    own = None if zoom.parameters is None else jax.eval_shape(coefficients_by, zoom, lines).shape[1]
    besides = lines.family.size(0)
    terms = (2 if own is None else own - besides) if terms is None else terms
    terms = checked_terms(terms, lines.family.most_terms)
    if own not in (None, terms + besides):
        raise ValueError(
            f"Argument terms is {terms}, but the parameters of zoom are for {own - besides}: leave terms "
            "out, or start from a model without parameters."
        )
    focal, *focus = settings(zoom, lines)
    prepared = zoom.prepare(focal, terms + besides, *focus)  # complains of too few focal lengths
    if own is None:
        return prepared, terms
    dtype = jnp.asarray(lines.focal).dtype
    arrays, rest = eqx.partition(zoom, eqx.is_inexact_array)
    return eqx.combine(jax.tree.map(lambda array: array.astype(dtype), arrays), rest), terms


def _small(lines, terms):
    """The lines compressed, measured as they were."""
    plain = lines.as_weighted() if isinstance(lines, ImageLines) else lines
    small = plain.compressed(terms) if isinstance(plain, FamilyLines) else compressed(plain, terms)
    return in_image(small) if isinstance(lines, ImageLines) else small


def algebraic_start(lines: AbstractLines, terms: int) -> CompressedLines | None:
    """What the algebraic estimate is made from; None for a family that it does not know."""
    return compressed(lines, terms) if isinstance(lines.family, RadialPolynomial) else None


@kinds_checked
def fit_frames(
    lines: AbstractLines,
    *,
    family: AbstractFamily | None = None,
    terms: int = 2,
    solver: Solver | None = None,
    max_steps: int = 256,
    invertible: bool = True,
    throw: bool = True,
) -> FrameFits:
    """The distortion of each frame by itself (eq. 3 and 6): what a zoom model is compared with.

    Args:
        lines, family, terms, solver, max_steps, invertible, throw: as for `fit_zoom`, frame by frame.

    Raises:
        RuntimeError: the solver failed on some frame, and `throw` is set.
    """
    lines = lines if family is None else with_family(lines, family)
    terms = checked_terms(terms, lines.family.most_terms)
    chosen, present = lines.by_frame()
    solver = default_solver(lines) if solver is None else solver
    start = algebraic_start(lines, terms)
    fits, outcome = _fit_frames(lines, start, chosen, present, terms, solver, max_steps)
    if invertible:
        small = _small(lines, terms)
        fits, outcome = _or_else(fits, outcome, lambda: _refit_frames(small, chosen, present, terms, fits))
    return _thrown(fits, outcome, throw)


@kinds_checked
def frame_rms(
    lines: AbstractLines, lens: ZoomLens | Float[AnyArray, "frame terms"] | None
) -> Float[Array, "frame"]:
    """Root of the error (eq. 3) of each frame, px, as corrected by a lens; NaN where no line counts.

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

    Points beyond the fold of a lens that has one are corrected by formula.
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
        lens.check_range(lines.focal)
        lines = with_family(lines, lens.family)
        lines = lines.about(lens.centre if lens.shift is None else jax.vmap(lens)(lines.focal).centre)
    elif not (lens is None or eqx.is_array_like(lens)):
        raise TypeError(
            "Argument lens must be a ZoomLens (fit.lens, not the fit), coefficients of each frame or None, "
            f"but its type is {type(lens).__name__}."
        )
    elif isinstance(lines, AnyCentreLines):
        lines = lines.about(lines.centre)  # or the last two coefficients would be taken for a centre
    return _frame_rms(lines, lens)


@eqx.filter_jit
def _frame_rms(lines, lens):
    focal = jnp.asarray(lines.focal)
    if lens is None:
        coefficients = jnp.zeros((focal.shape[0], lines.family.size(1)), focal.dtype)
    elif isinstance(lens, ZoomLens):
        coefficients = coefficients_by(lens.zoom, lines)
    else:
        coefficients = lens
    return jnp.sqrt(frame_energy(lines, jnp.asarray(coefficients)))


@eqx.filter_jit
def _fit_zoom(lines, start, zoom, terms, solver, max_steps):
    if start is not None:
        zoom = with_parameters(zoom, algebraic_parameters(start, zoom, terms))
    zoom, result, steps = minimise(lines, zoom, solver, max_steps)
    fit = _described(lines, zoom, result, steps)
    return fit, _outcome(fit)


def _described(lines, zoom, result, steps):
    """A fitted zoom model with all that is to be said of it."""
    weighted, jacobian = linearised(lines, zoom)
    errors = energy_by_frame(lines, weighted)
    covariance, determined = parameter_covariance(lines, zoom, weighted, jacobian)
    lens, rms = lens_of(lines, zoom), jnp.sqrt(jnp.nanmean(errors))
    certificate = certificate_of(zoom, lens.centre, lens.focal_range, lens.image_size, family=lens.family)
    return ZoomFit(
        lens=lens,
        rms=rms,
        frame_rms=jnp.sqrt(errors),
        covariance=covariance,
        result=_judge(zoom, result, determined, certificate),
        steps=steps,
        certificate=certificate,
        rms_unconstrained=rms,
    )


@eqx.filter_jit
def _fit_frames(lines, start, chosen, present, terms, solver, max_steps):
    def fit(chosen, present):
        frame = lines.take(chosen, present)
        constant = PolynomialZoom(degree=0).prepare(frame.focal, lines.family.size(terms))
        own = None if start is None else start.take(chosen, present)
        return _fit_zoom(frame, own, constant, terms, solver, max_steps)[0]

    # Small compressed frames are solved side by side; the points themselves one frame at a time, for
    # side by side they would all be in memory at once, padded to the fullest frame.
    batch = 1 if isinstance(points_of(lines), Lines) else len(chosen)
    fits = jax.lax.map(lambda frame: fit(*frame), (chosen, present), batch_size=batch)
    each = collected(lines, fits)
    return each, _outcome(each)


def collected(lines, fits):
    """Fits of one frame each, stacked, as one; about the centre of the lines."""
    return FrameFits(
        coefficients=fits.lens.zoom.parameters[:, 0],
        rms=jnp.sqrt(jnp.nanmean(fits.rms**2)),
        frame_rms=fits.rms,
        covariance=fits.covariance,
        result=fits.result,
        certificate=fits.certificate,
        rms_unconstrained=jnp.sqrt(jnp.nanmean(fits.rms_unconstrained**2)),
        centre=jnp.asarray(lines.centre),
        scale=lines.scale,
        family=lines.family,
    )


@eqx.filter_jit
def _refit_zoom(lines, free):
    """The best invertible model in the place of one that is not."""
    zoom = free.lens.zoom
    if stated_pieces(zoom, free.lens.focal_range, lines.family) is None:  # there is nothing to demand
        return free, _outcome(free)
    nothing = jax.tree.map(jnp.zeros_like, zoom.parameters)
    if not isinstance(zoom, AbstractLinearZoom):
        terms = jax.eval_shape(coefficients_by, zoom, lines).shape[1]
        nothing = zoom.prepare(jnp.asarray(lines.focal), terms).parameters
    start, unravel = ravel_pytree(nothing)

    def functions(lines, zoom):
        def errors(flat):
            model = with_parameters(zoom, unravel(flat))
            distances = residuals(lines, coefficients_by(model, lines)).reshape(-1)
            prior = prior_residuals(lines, model)
            return distances if prior is None else jnp.concatenate([distances, prior])

        def slack(flat):
            lens = lens_of(lines, with_parameters(zoom, unravel(flat)))
            controls = slope_controls(
                lens.zoom, lens.centre, lens.focal_range, lens.image_size, lens.family
            )
            assert controls is not None
            return controls - LEAST_SLOPE

        return errors, slack

    constant = functions(*jax.lax.stop_gradient((lines, zoom)))
    flat, strength, reached, steps = least_squares_within(*constant, start, _MOST_STEPS)
    errors, slack = functions(lines, zoom)
    flat = implicit(lambda flat: jnp.sum(errors(flat) ** 2) / 2, slack, flat, strength)
    good: Any = RESULTS.successful  # inherited members, which pyright takes for another class's
    unfinished: Any = RESULTS.nonlinear_max_steps_reached
    # Curved inequalities, of models that are not linear, may keep it from the last digits.
    near_enough = reached | (not isinstance(zoom, AbstractLinearZoom))
    result = RESULTS.where(near_enough, good, unfinished)
    fit = _described(lines, with_parameters(zoom, unravel(flat)), result, free.steps + steps)
    result = RESULTS.where(fit.result == good, RESULTS.constrained, fit.result)
    fit = eqx.tree_at(lambda fit: (fit.result, fit.rms_unconstrained), fit, (result, free.rms))
    return fit, _outcome(fit)


@eqx.filter_jit
def _refit_frames(lines, chosen, present, terms, free):
    """All frames as they are, if they are invertible, and otherwise the best that is."""

    def fit(chosen, present, result, coefficients):
        frame = lines.take(chosen, present)
        constant = PolynomialZoom(degree=0).prepare(frame.focal, lines.family.size(terms))
        own = _described(frame, with_parameters(constant, coefficients[None]), result, jnp.asarray(0))
        other, _ = _refit_zoom(frame, own)
        keep = _invertible(own)
        return jax.tree.map(lambda own, other: jnp.where(keep, own, other), own, other)

    each = collected(lines, jax.vmap(fit)(chosen, present, free.result, free.coefficients))
    return each, _outcome(each)


def minimise(lines, zoom, solver, max_steps):
    """The model at the minimum of the global energy, from its own parameters as the start."""

    def function(parameters, args):
        lines, zoom = args
        zoom = with_parameters(zoom, parameters)
        return residuals(lines, coefficients_by(zoom, lines)), prior_residuals(lines, zoom)

    start = jax.tree.map(jax.lax.stop_gradient, zoom.parameters)
    solution = optx.least_squares(
        function, solver, start, args=(lines, zoom), max_steps=max_steps, throw=False
    )
    return with_parameters(zoom, solution.value), solution.result, solution.stats["num_steps"]


def linearised(lines, zoom):
    """The residuals and their derivatives by the flattened parameters, a row a residual."""
    flat, unravel = ravel_pytree(zoom.parameters)

    def function(flat):
        k = coefficients_by(with_parameters(zoom, unravel(flat)), lines)
        return (weighted := residuals(lines, k)), weighted

    jacobian, weighted = jax.jacfwd(function, has_aux=True)(flat)
    return weighted, jacobian


def _judge(zoom, result, determined, certificate):
    """The worst of what the solver says and of what the model looks like."""
    finite = jnp.all(jnp.isfinite(ravel_pytree(zoom.parameters)[0]))
    good: Any = RESULTS.successful  # inherited members, which pyright takes for another class's
    nonfinite: Any = RESULTS.nonfinite
    about_model = RESULTS.where(certificate.folded, RESULTS.folded, good)
    about_model = RESULTS.where(determined, about_model, RESULTS.undetermined)
    about_model = RESULTS.where(finite, about_model, nonfinite)
    solved = result if isinstance(result, RESULTS) else RESULTS.promote(result)
    return RESULTS.where(solved == good, about_model, solved)


def _invertible(fit):
    """Whether there is nothing to be made invertible: it is, or there is no model, or none that can be."""
    stated = ~jnp.isneginf(fit.certificate.least)
    return fit.certificate.certified | ~stated | _failed(fit.result)


def _or_else(fit, outcome, other):
    """The fit and its outcome where it is invertible, and otherwise another, not even begun where it is.

    Under `vmap` it is begun if one of the batch needs it, and then for all: a condition on the batch as a
    whole stays one, where a condition of each would make XLA compute both ways for all, always.
    """
    invertible, _ = outcome
    if not traced(invertible):
        return (fit, outcome) if invertible else other()

    def chosen():
        return jax.tree.map(lambda own, new: jnp.where(invertible, own, new), (fit, outcome), other())

    return jax.lax.cond(eqxi.unvmap_all(invertible), lambda: (fit, outcome), chosen)


def _failed(result):
    """Whether a solver failed; what is said of a model is no failure."""
    told = (result == RESULTS.undetermined) | (result == RESULTS.folded) | (result == RESULTS.constrained)
    return (result != RESULTS.successful) & ~told


def _outcome(fit):
    """Whether it is invertible, and whether a solver failed, in which frame first, and how."""
    failed = jnp.atleast_1d(_failed(fit.result))
    frame = jnp.argmax(failed)
    result = jax.tree.map(lambda value: jnp.atleast_1d(value)[frame], fit.result)
    return jnp.all(_invertible(fit)), (jnp.any(failed), frame, result)


def _thrown(fit, outcome, throw):
    """The fit, raising where its solver failed."""
    _, (failed, frame, result) = outcome
    if not throw:
        return fit
    if traced(failed):
        return result.error_if(fit, failed)
    if failed:
        where = f"Frame {int(frame)}: " if isinstance(fit, FrameFits) else ""
        raise RuntimeError(f"The fit failed. {where}{RESULTS[result]}")
    return fit
