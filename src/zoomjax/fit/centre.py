"""Fits of the centre of distortion: one for all frames, one along the zoom, or one per frame.

The offset of the centre is a function of the focal length, as the coefficients are, and is described by any
zoom model: `PolynomialZoom` of degree 0 is one centre for all frames, of degree 1 one that moves along a
line, `TableZoom` one for each focal length. Coefficients and centre are fitted together, starting from the
fit about the image's centre, on lines compressed for any centre (`free_centre`). The paper does so frame by
frame (section 5.1, Figure 7), and finds almost no gain.

Without distortion there is no centre of distortion, and lines may determine it poorly in other cases too. A
centre that is too uncertain is kept fixed, and the result says so.
"""

import dataclasses
from typing import Any, NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree, ScalarLike

from .._core.arguments import kinds_checked
from .._core.arrays import as_jax
from .._core.programs import light_program, program
from .._core.types import Coefficients, Focal
from ..lines.base import AbstractLines
from ..lines.buckets import bucketed, bucketed_frames, of_frames
from ..lines.lines import Lines
from ..models.distortion_model import AbstractDistortionModel
from ..models.invertibility import certify
from ..models.lens import ZoomLens
from ..models.model import Model
from ..models.requirements import check
from ..models.zoom import AbstractZoom, PolynomialZoom, number_of_coefficients, with_parameters
from ._least_squares import Solver, default_solver
from .compression import compressed_as_measured
from .covariance import known_covariance
from .energy import AbstractJointZoom, counted_frames
from .minimise import fit_about, minimised
from .moved_centre import for_any_centre, for_terms
from .prepare import asked_for, prepared_for, ready_model
from .problem import data_of
from .result import RESULTS, FrameFits, ZoomFit, collected, each_of_given, of_given

_MOST_UNCERTAIN = 0.05
"""Largest standard deviation of a centre, in half diagonals, with which it is accepted."""

_FARTHEST = 0.5
"""Largest distance of a centre from the middle of the image, in half diagonals, that is accepted."""


class CentreFit(eqx.Module):
    """A zoom lens fitted together with its centre of distortion.

    Attributes:
        fit: the fit, whose lens has the centre. Its covariance includes the uncertainty of the centre.
        centre: centre of distortion of each frame, px.
        std: standard deviations of the frames' centres, px; infinite where the lines do not determine it.
        determined: whether the lines determine the centre. If not, it is kept at the centre of the lines,
            by default that of the image.
        rms_fixed: what `fit.rms` would be with the centre kept fixed, px.
        covariance: of all parameters, normalised: those of the zoom model, then those of the centre's.
    """

    fit: ZoomFit
    centre: Float[Array, "frame 2"]
    std: Float[Array, "frame 2"]
    determined: Bool[Array, ""]
    rms_fixed: Float[Array, ""]
    covariance: Float[Array, "parameter parameter"]

    def __call__(self, *_: Any, **__: Any) -> NoReturn:
        """Raise TypeError: call the lens of the fit instead."""
        raise TypeError("A CentreFit is not a lens: use found.fit.lens, as in found.fit.lens(35.0).")


class FrameCentres(eqx.Module):
    """Separate fits of each frame with its own centre of distortion.

    Attributes:
        each: the fits, about the centres found.
        std: standard deviations of the centres, px.
        determined: whether a frame's lines determine its centre. If not, it is that of the image.
        rms_fixed: what `each.frame_rms` would be with the centres kept fixed, px.
    """

    each: FrameFits
    std: Float[Array, "frame 2"]
    determined: Bool[Array, "frame"]
    rms_fixed: Float[Array, "frame"]

    def __call__(self, *_: Any, **__: Any) -> NoReturn:
        """Raise TypeError: each frame has its own distortion, and there is no lens."""
        raise TypeError("FrameCentres are not a lens: use found.each.distortion(frame).")


class _CentredZoom(AbstractJointZoom):
    """From a focal length to the coefficients and, after them, the offset of the centre, normalised."""

    zoom: AbstractZoom
    centre: AbstractZoom
    parameters: PyTree

    def prepare(self, focal: Focal, terms: int) -> "_CentredZoom":
        zoom, centre = self.zoom.prepare(focal, terms), self.centre.prepare(focal, 2)
        return _both(zoom, centre)

    def __call__(self, focal: ScalarLike) -> Coefficients:
        zoom, centre = self.parts()
        return jnp.concatenate([zoom(focal), centre(focal)])

    def first(self) -> AbstractZoom:
        return self.parts()[0]

    def parts(self) -> tuple[AbstractZoom, AbstractZoom]:
        """Both models, with the parameters of this one."""
        zoom, centre = self.parameters
        return with_parameters(self.zoom, zoom), with_parameters(self.centre, centre)


def _both(zoom: AbstractZoom, centre: AbstractZoom) -> _CentredZoom:
    return _CentredZoom(zoom=zoom, centre=centre, parameters=(zoom.parameters, centre.parameters))


@kinds_checked
def fit_centre(
    lines: AbstractLines,
    *,
    zoom: AbstractZoom | Model | None = None,
    distortion_model: AbstractDistortionModel | None = None,
    centre: AbstractZoom | None = None,
    terms: int | None = None,
    solver: Solver | None = None,
    max_steps: int = 256,
    throw: bool = True,
) -> CentreFit:
    """Fit the zoom model and the centre of distortion together: minimise the global energy (eq. 13).

    Args:
        lines: the lines, or, with the same result, ``compress_any_centre(lines)``, which can be reused for
            several fits. Their `centre` is the start, and is kept if the lines do not determine another.
        zoom, distortion_model, terms, solver, max_steps, throw: as for `fit_zoom`, whose errors also apply.
            The distortion model must be radial; under another one than the radial polynomial every step of
            the search goes over the points, unless the lines are compressed for any centre.
        centre: how the centre depends on the focal length, as any zoom model: by default
            ``PolynomialZoom(degree=0)``, one centre for all frames.

    Raises:
        ValueError: the distortion model is not radial, the zoom model depends on the focus, or the lines
            are compressed about one centre.

    Example:
        >>> import numpy as np
        >>> from zoomjax import Distortion, Lines, PolynomialZoom
        >>> t = np.linspace(0.0, 479.0, 50)
        >>> straight = [np.stack([np.full(50, x), t], -1) for x in (9.0, 320.0, 599.0)]
        >>> straight += [np.stack([t, np.full(50, y)], -1) for y in (9.0, 240.0, 470.0)]
        >>> bent = Distortion(np.array([0.1]), np.array([310.0, 250.0]), np.array(400.0)).distort(
        ...     np.stack(straight)
        ... )
        >>> lines = Lines.from_ragged(list(bent), [0] * 6, [50], image_size=(640, 480))
        >>> found = fit_centre(lines, zoom=PolynomialZoom(degree=0), terms=1)
        >>> found.fit.lens.centre.round(1).tolist()
        [310.0, 250.0]
    """
    lines, model = asked_for(lines, zoom, terms, distortion_model)
    check("fit_centre", zoom=model.zoom, distortion_model=model.distortion_model)
    ready, given = ready_model(lines, model), lines
    lines = for_any_centre(bucketed(lines), model.terms)
    unfitted = model.zoom.parameters is None
    options = {"solver": solver, "max_steps": max_steps, "throw": throw}
    fixed = fit_about(small_about(lines, lines.centre, model), ready, algebraic=unfitted, **options)
    offset = prepared_for(given, PolynomialZoom(degree=0) if centre is None else centre, 2)
    start = _both(fixed.lens.zoom, offset)
    found, each, covariance, std, determined = _search(
        for_terms(lines, model.terms), start, solver or default_solver(lines), max_steps
    )
    # Once more about these centres, for all else that is to know of a fit: the same compiled program.
    near = ready.with_zoom(found.first())
    fit = fit_about(small_about(lines, each, model), near, algebraic=False, **options)
    fit = _about_centres(lines, fit, found, each, covariance, determined)
    each, std = of_frames(each, given), of_frames(std, given)
    return CentreFit(of_given(fit, given), each, std, determined, fixed.rms, covariance)


def small_about(lines, centre, model):
    """The lines about a centre, compressed."""
    placed = lines.about(centre)
    points = isinstance(data_of(placed), Lines)
    return compressed_as_measured(placed, model.terms) if points else placed


def refit_centre(lines: AbstractLines, found: CentreFit) -> AbstractZoom:
    """Coefficients and centre of least energy for other weights of the lines, started from a fit.

    A model that gives the coefficients and, after them, the centre's offset, for `AnyCentreLines`.
    """
    lens, centre = found.fit.lens, found.fit.lens.shift
    if centre is None:
        offset = as_jax((np.asarray(lens.centre) - np.asarray(lines.centre))[None] / lens.scale)
        centre = with_parameters(PolynomialZoom(degree=0).prepare(lines.focal, 2), offset)
    lines = for_terms(bucketed(lines), number_of_coefficients(lens.zoom))
    joint, *_ = _search(lines, _both(lens.zoom, centre), default_solver(lines), 256)
    return joint


@kinds_checked
def fit_frame_centres(
    lines: AbstractLines,
    *,
    distortion_model: AbstractDistortionModel | None = None,
    terms: int = 2,
    solver: Solver | None = None,
    max_steps: int = 256,
) -> FrameCentres:
    """Fit distortion and centre of distortion of each frame separately (the paper's Figure 7).

    Args:
        lines, distortion_model, terms, solver, max_steps: as for `fit_centre`.
    """
    lines, model = asked_for(lines, PolynomialZoom(degree=0), terms, distortion_model)
    check("fit_centre", zoom=model.zoom, distortion_model=model.distortion_model)
    padded, frames = bucketed_frames(for_any_centre(lines, model.terms))
    found = _fit_frame_centres(padded, frames, model, solver, max_steps)
    each, std, determined, fixed = found.each, found.std, found.determined, found.rms_fixed
    std, determined, fixed = (of_frames(values, lines) for values in (std, determined, fixed))
    return FrameCentres(each_of_given(each, lines), std, determined, fixed)


@program
def _fit_frame_centres(lines, frames, model, solver, max_steps):
    options = {"terms": model.terms, "solver": solver, "max_steps": max_steps, "throw": False}

    def one(frame):
        return fit_centre(lines.take(*frame), zoom=model.zoom, **options)

    batch = 1 if isinstance(data_of(lines), Lines) else len(frames.chosen)  # as in `fit_frames`
    found = jax.lax.map(one, (frames.chosen, frames.present), batch_size=batch)
    each = collected(lines, found.fit, frames.there)
    each = eqx.tree_at(lambda fits: fits.centre, each, found.centre[:, 0])
    return FrameCentres(each, found.std[:, 0], found.determined, found.rms_fixed)


def _search(lines, start, solver, max_steps):
    """The joint minimum, or the start if the centre found is too uncertain."""
    found, _, _ = minimised(lines, start, solver, max_steps)
    return _accepted(lines, start, found)


def _accepted(lines, start, found):
    """The model found, if its centre is certain enough, or else the start; its centres; and what tells."""
    return _certain(lines, start, found, known_covariance(lines, found, extra=2))


@light_program
def _certain(lines, start, found, covariance):
    def offsets(parameters):
        centre = with_parameters(found, parameters).parts()[1]
        return jax.vmap(centre)(lines.focal)

    flat, unravel = ravel_pytree(found.parameters)
    by_parameter = jax.jacfwd(lambda flat: offsets(unravel(flat)))(flat)
    variance = jnp.einsum("mcp,pq,mcq->mc", by_parameter, covariance, by_parameter)
    std = jnp.sqrt(jnp.where(variance >= 0, variance, jnp.inf))
    distance = jnp.linalg.norm(offsets(found.parameters), axis=1)
    counted = counted_frames(lines)
    left_out = ~counted & jnp.any(counted)  # at whatever focal length, the centre there is of no account
    near = jnp.all(std <= _MOST_UNCERTAIN, axis=1) & (distance <= _FARTHEST)
    determined = jnp.all(near | left_out)
    parameters = jax.tree.map(
        lambda new, old: jnp.where(determined, new, old), found.parameters, start.parameters
    )
    each = lines.centre[None] + lines.scale * offsets(parameters)
    return with_parameters(found, parameters), each, covariance, lines.scale * std, determined


@light_program
def _about_centres(lines, fit, found, each, covariance, determined):
    """The fit about the centres found, with its lens and covariance, and those of both."""
    _, moved = found.parts()
    own = fit.covariance.shape[0]
    joint = jnp.where(determined, covariance, jnp.zeros_like(covariance).at[:own, :own].set(fit.covariance))
    lens = _lens(lines, fit.lens, moved, each)
    certificate = fit.certificate if lens.shift is None else certify(lens)
    good: Any = RESULTS.successful  # an inherited member, which pyright takes for another class's
    folded = certificate.folded & (fit.result == good)
    return eqx.tree_at(
        lambda fit: (fit.lens, fit.covariance, fit.joint, fit.certificate, fit.result),
        fit,
        (
            lens,
            jnp.where(determined & jnp.isfinite(fit.covariance), covariance[:own, :own], fit.covariance),
            joint,
            certificate,
            RESULTS.where(folded, RESULTS.folded, fit.result),
        ),
        is_leaf=lambda leaf: leaf is None,
    )


def _lens(
    lines: AbstractLines, lens: ZoomLens, centre: AbstractZoom, each: Float[Array, "frame 2"]
) -> ZoomLens:
    """The lens with its centre: a point if it is one for all focal lengths."""
    if isinstance(centre, PolynomialZoom) and centre.degree == 0:
        return eqx.tree_at(lambda lens: lens.centre, lens, each[0])
    return dataclasses.replace(lens, centre=jnp.asarray(lines.centre), shift=centre)
