"""The zoom model that minimises the global energy (eq. 13).

The unknowns are the zoom model's parameters alone, the lines having dropped out (`energy`). Solvers are
optimistix', with Jacobians by automatic differentiation; a fitted model is differentiable with respect to
the points through the implicit function theorem. One that is not certified to be invertible is replaced by
the best one that is (`constrained`).

Compiled once for a shape of the lines; once per fit an algebraic start and, after it, the covariance and
the certificate; per iteration one Jacobian of the residuals.
"""

import equinox as eqx
import jax
import optimistix as optx

from .._core.arguments import kinds_checked
from ..lines.base import AbstractLines
from ..models.family import AbstractFamily
from ..models.zoom import AbstractLinearZoom, AbstractZoom, PolynomialZoom, with_parameters
from ._least_squares import Solver, default_solver
from .algebraic import algebraic_parameters
from .constrained import or_else, refit_zoom
from .energy import coefficients_by, prior_residuals, residuals
from .family_lines import with_family
from .prepare import algebraic_start, compressed_as_measured, ready_model
from .result import ZoomFit, described_fit, outcome_of, thrown


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
    fit, outcome = fit_prepared(lines, start, model, terms, solver, max_steps)
    if invertible:
        fit, outcome = or_else(fit, outcome, lambda: refit_zoom(compressed_as_measured(lines, terms), fit))
    return thrown(fit, outcome, throw)


@eqx.filter_jit
def fit_prepared(lines, start, zoom, terms, solver, max_steps):
    """A fit of a model made ready, and its outcome."""
    if start is not None:
        zoom = with_parameters(zoom, algebraic_parameters(start, zoom, terms))
    zoom, result, steps = minimise(lines, zoom, solver, max_steps)
    fit = described_fit(lines, zoom, result, steps)
    return fit, outcome_of(fit)


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
