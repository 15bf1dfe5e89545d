"""Fits of zoom models: minimisation of the global energy (eq. 13).

The unknowns are the parameters of the zoom model alone, as the lines are eliminated (`energy`). Solvers are
those of optimistix, with Jacobians by automatic differentiation. A fitted model is differentiable with
respect to the points by the implicit function theorem. A model that is not certified to be invertible is
refitted under that constraint (`constrained`). The work is in `minimise` and, for a fitted centre, in
`centre`.
"""

import warnings
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from .._core.arguments import kinds_checked
from .._core.checks import LARGEST, centre_problem, real_numbers
from .._core.types import AnyArray
from ..lines.base import AbstractLines, SomeLines
from ..lines.buckets import bucketed
from ..lines.compressed import CompressedLines
from ..models.distortion_model import AbstractDistortionModel
from ..models.model import Model
from ..models.zoom import AbstractZoom
from ._least_squares import Solver
from .centre import fit_centre
from .minimise import fit_about
from .prepare import asked_for, ready_model
from .problem import about_own_centre
from .result import ZoomFit, of_given

CentreArgument = Literal["fit", "image"] | tuple[float, float] | Float[AnyArray, "2"]
"""The centre of distortion: fitted, the image's, or its coordinates, px."""


@kinds_checked
def fit_zoom(
    lines: AbstractLines,
    *,
    zoom: AbstractZoom | Model | None = None,
    distortion_model: AbstractDistortionModel | None = None,
    terms: int | None = None,
    centre: CentreArgument | None = None,
    solver: Solver | None = None,
    max_steps: int = 256,
    invertible: bool = True,
    throw: bool = True,
) -> ZoomFit:
    """Fit a zoom lens: the zoom model of least global energy (eq. 13), by default among invertible ones.

    Args:
        lines: the lines, or, much faster and with the same result, ``compress(lines)``.
        zoom: the zoom model; `PolynomialZoom` of degree 2 by default. Or a `Model`, which has
            `distortion_model` and `terms`, too. If it has parameters, the solver starts there. Otherwise it
            starts from the algebraic estimate if the model is linear and the distortion model is the radial
            polynomial, else from no distortion.
        distortion_model: by default that of the lines (see `compress_for`), else `RadialPolynomial` (eq.
            2). Others are `Division` and `BrownConrady`, which has two additional coefficients.
        terms: the number N of radial distortion coefficients (eq. 2): by default 2, or as many as a `zoom`
            with parameters has.
        centre: the centre of distortion: "fit" fits it too, one for all focal lengths, where the lines
            determine it (`fit_centre`); "image" is the middle of the image; two coordinates, px, are
            taken as they are. By default that of the lines.
        solver: any optimistix least-squares solver or minimiser; Levenberg-Marquardt by default, with
            tolerances for the dtype of the lines.
        max_steps: the maximum number of solver steps.
        invertible: whether a model that is not certified to be invertible over the whole image and the
            range of focal lengths is refitted under that constraint, with a slope of the radius (see
            `Certificate`) of at least 0.02. A certified model is returned unchanged, bit for bit. This has
            no effect on zoom models that do not state their `pieces`. For a `PowerZoom`, which is not
            linear, the refitted model is invertible but not necessarily the best, and with a distortion
            model other than the polynomial it has no proof. Under ``vmap`` the refit runs for the whole
            batch if one fit needs it, and not at all if none does.
        throw: whether to raise if the solver fails. Otherwise see `ZoomFit.result`. Results about the model
            (undetermined, folded, constrained) never raise.

    Raises:
        ValueError: there are fewer distinct focal lengths than the zoom model needs, the lines were
            compressed for fewer terms or about another centre, or the parameters of `zoom` are for another
            number of terms.
        TypeError: an argument has the wrong type, such as the class PolynomialZoom instead of an instance.
        RuntimeError: the solver failed (see `throw`).

    Warns:
        UserWarning: the centre given is outside of the image.

    Example:
        >>> import jax.numpy as jnp, numpy as np
        >>> from zoomjax import Lines, PolynomialZoom, compress
        >>> t = np.linspace(0.0, 479.0, 50)
        >>> bent = [np.stack([x + f * (t / 240 - 1) ** 2, t], axis=-1) for f in (1, 2) for x in (9, 599)]
        >>> lines = Lines.from_ragged(bent, [0, 0, 1, 1], [50, 100], image_size=(640, 480))
        >>> fit = fit_zoom(compress(lines), zoom=PolynomialZoom(degree=1), terms=1)
        >>> bool(fit.rms < 1)
        True
    """
    lines, model = asked_for(lines, zoom, terms, distortion_model)
    options: Any = {"solver": solver, "max_steps": max_steps, "throw": throw}
    if is_to_be_fitted(centre, invertible=invertible):
        return fit_centre(lines, zoom=model, **options).fit
    padded, unfitted = bucketed(lines), model.zoom.parameters is None
    placed, ready = about_centre(padded, centre), ready_model(lines, model)
    return of_given(fit_about(placed, ready, algebraic=unfitted, invertible=invertible, **options), lines)


def is_to_be_fitted(centre: CentreArgument | None, *, invertible: bool = True) -> bool:
    """Whether an argument asks for a centre of distortion that is fitted.

    Raises:
        ValueError: it does, and for a model that need not be `invertible`.
    """
    fitted = isinstance(centre, str) and centre == "fit"
    if fitted and not invertible:
        raise ValueError('Argument centre is "fit", which needs invertible=True.')
    return fitted


def about_centre(lines: SomeLines, centre: CentreArgument | None) -> SomeLines | CompressedLines:
    """The lines about the centre of distortion that an argument names; None: their own."""
    found: Any
    if centre is None:
        found = about_own_centre(lines)
        return found
    found = lines.about(given_centre(centre, lines.image_size, stacklevel=5))
    return found


def given_centre(
    centre: CentreArgument, image_size: tuple[int, int], *, stacklevel: int
) -> Float[np.ndarray, "2"]:
    """The centre of distortion, px, that an argument gives, other than "fit".

    Raises:
        ValueError: it is neither "image" nor two coordinates.
    """
    if isinstance(centre, str) and centre == "image":
        return (np.array(image_size) - 1) / 2
    told = real_numbers(centre)
    if told is None or told.shape != (2,) or not (np.abs(told) < LARGEST).all():
        raise ValueError(
            f'Argument centre must be "fit", "image" or two coordinates in px, but it is {centre!r}.'
        )
    if problem := centre_problem(told, image_size):
        warnings.warn(problem, stacklevel=stacklevel)
    return told.astype(float)
