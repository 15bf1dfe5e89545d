"""Results of fits, and their status."""

import functools
import operator
from typing import Any, NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from .._core.arrays import as_jax
from .._core.types import Centres, traced
from ..lines.base import AbstractLines
from ..lines.buckets import of_frames
from ..models.distortion import Distortion
from ..models.distortion_model import AbstractDistortionModel
from ..models.invertibility import Certificate, certificate_of
from ..models.lens import ZoomLens
from ..models.polynomial import RadialPolynomial
from ..models.zoom import AbstractFocusZoom, AbstractZoom
from .covariance import by_numpy, covariance_terms, parameter_covariance
from .energy import counted_frames, energy_by_frame, linearised


def lens_of(lines: AbstractLines, zoom: AbstractZoom) -> ZoomLens:
    """The lens that a zoom model fitted to these lines makes, for the range of the frames that count."""
    counted = counted_frames(lines)
    fitted = counted | ~jnp.any(counted)
    focus = lines.focus if isinstance(zoom, AbstractFocusZoom) else None
    return ZoomLens(
        zoom=zoom,
        centre=jnp.asarray(lines.centre),
        focal_range=_range(jnp.asarray(lines.focal), fitted),
        image_size=lines.image_size,
        focal_unit=lines.focal_unit,
        focus_range=None if focus is None else _range(jnp.asarray(focus), fitted),
        distortion_model=lines.distortion_model,
    )


def _range(values, fitted):
    """The least and the greatest of the values fitted."""
    return jnp.stack(
        [jnp.min(jnp.where(fitted, values, jnp.inf)), jnp.max(jnp.where(fitted, values, -jnp.inf))]
    )


class RESULTS(optx.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
    """Status of a fit: the results of optimistix, and three about the fitted model."""

    undetermined = (
        "The points do not determine all parameters: some can change without missing any point by more "
        "than the noise. Their variance is reported as infinite. Add lines far from the centre of "
        "distortion or at more focal lengths (in a clip, turn the camera further), or lower the degree or "
        "the number of terms."
    )
    folded = (
        "The fitted distortion is not invertible over the whole image and the range of focal lengths: see "
        "`certificate` for where the corrected image folds over. Add lines near the corners, remove lines "
        "that are not straight in the scene, or lower the degree or the number of terms."
    )
    constrained = (
        "The best-fitting distortion is not invertible over the whole image and the range of focal "
        "lengths. The model was refitted to be invertible; `rms_unconstrained` is the RMS without this "
        "constraint. Add lines near the corners, remove lines that are not straight in the scene, or lower "
        "the degree or the number of terms."
    )


class ZoomFit(eqx.Module):
    """A fitted zoom lens.

    Attributes:
        lens: from a focal length to the distortion there.
        rms: root of the global energy (eq. 13), px of the image in which lines are measured: the corrected
            one, or with `in_image` the distorted one.
        frame_rms: root of each frame's error (eq. 3), px; NaN for a frame whose lines all weigh nothing.
        covariance: of the zoom model's parameters in normalised units, flattened row by row (for a
            polynomial: all terms of power 0, then of power 1, ...). Errors are assumed independent between
            lines, not between points of a line: this is the cluster-robust (sandwich) estimate with a line
            as a cluster, shrunk towards the one for independent points by an amount given by its own
            scatter. With too few lines for that, points are assumed independent. An undetermined parameter
            has infinite variance and zero covariances. With a prior (`AbstractPriorZoom`), it is the mean
            squared error from both the noise and the prior. The constraint of invertibility is not taken
            into account.
        result: how the fit ended; ``RESULTS[fit.result]`` is a sentence.
        steps: number of steps the solver took.
        certificate: whether the lens is invertible over its image and focal range.
        rms_unconstrained: `rms` of the fit without the constraint of invertibility: the same, unless the
            model was refitted. The result is then `constrained`, unless there is a worse one.
        joint: covariance of the zoom model's parameters and, after them, of the fitted centre (x, y, in
            half diagonals; for a centre that moves, the parameters of its model); None where the centre
            was given.
        misfit: covariance of what the lens's coefficients, and maybe the next one, are off the model at any
            focal length: see `zoomjax.trust.with_misfit`; None where it was not estimated.
        off_centre: covariance of what else the coefficients, and after them the centre (x, y, in half
            diagonals), are off, since the centre may be elsewhere; None where it was not estimated.
    """

    lens: ZoomLens
    rms: Float[Array, ""]
    frame_rms: Float[Array, "frame"]
    covariance: Float[Array, "parameter parameter"]
    result: RESULTS
    steps: Int[Array, ""]
    certificate: Certificate
    rms_unconstrained: Float[Array, ""]
    joint: Float[Array, "both both"] | None = None
    misfit: Float[Array, "coefficients coefficients"] | None = None
    off_centre: Float[Array, "both_at_f both_at_f"] | None = None

    def __call__(self, *_: Any, **__: Any) -> NoReturn:
        """Raise TypeError: call the lens of the fit instead."""
        raise TypeError("A ZoomFit is not a lens: use fit.lens, as in fit.lens(35.0).")


class FrameFits(eqx.Module):
    """Separate fits of each frame (eq. 6).

    Attributes:
        coefficients: of each frame, normalised: (k1, ..., kN), or those of another distortion model.
        rms: root of the mean of the frames' errors, px, comparable with the `rms` of a zoom model.
        frame_rms: root of each frame's error (eq. 3), px; NaN for a frame whose lines all weigh nothing.
        covariance: of each frame's coefficients; see `ZoomFit`.
        result: how each frame's fit ended.
        certificate: of each frame, whether it is invertible over the image.
        rms_unconstrained: `rms` of the fits without the constraint of invertibility.
        centre: centre of distortion, px: of all frames, or of each.
        scale: the length in px that is radius 1.
        distortion_model: what the coefficients mean.
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
    distortion_model: AbstractDistortionModel = RadialPolynomial()

    def __call__(self, *_: Any, **__: Any) -> NoReturn:
        """Raise TypeError: each frame has its own distortion, and there is no lens."""
        raise TypeError(
            "FrameFits are not a lens: use each.distortion(frame) for one frame's distortion, or fit_zoom "
            "for a lens at any focal length."
        )

    def messages(self) -> list[str]:
        """For each frame a sentence on its fit's problem; empty if there is none."""
        (value,) = jax.tree.leaves(jax.tree.map(np.asarray, self.result))
        each = (jax.tree.map(lambda _, one=one: np.asarray(one), self.result) for one in value)
        return [RESULTS[result] for result in each]

    def distortion(self, frame: int) -> Distortion:
        """The distortion of one frame.

        Raises:
            IndexError: there is no such frame.
        """
        frames = self.coefficients.shape[0]
        if not -frames <= frame < frames:
            raise IndexError(f"There is no frame {frame}: the frames fitted are 0 to {frames - 1}.")
        dtype = self.coefficients.dtype
        xp: Any = jnp if traced(self) else np  # known ones compile nothing
        centre = xp.broadcast_to(xp.asarray(self.centre, dtype), (frames, 2))[frame]
        coefficients, scale = xp.asarray(self.coefficients)[frame], xp.asarray(self.scale, dtype)
        return Distortion(as_jax(coefficients), as_jax(centre), as_jax(scale), self.distortion_model)


def described_fit(lines, zoom, result, steps):
    """A fitted zoom model with its errors, covariance, certificate and status."""
    linear = linearised(lines, zoom)
    covariance, determined = parameter_covariance(lines, zoom, linear)
    return _ended(lines, zoom, result, steps, linear.weighted, covariance)(determined)


def fit_without_covariance(lines, zoom, result, steps):
    """The same without its covariance, beside the terms that it is made of: see `with_covariance`.

    Twice, as if its parameters were determined and as if they were not; each with its outcome.
    """
    linear = linearised(lines, zoom)
    none = jnp.zeros((0, 0), linear.weighted.dtype)
    of = _ended(lines, zoom, result, steps, linear.weighted, none)
    fits = [of(jnp.asarray(determined)) for determined in (True, False)]
    return covariance_terms(lines, zoom, linear), *((fit, outcome_of(fit)) for fit in fits)


def with_covariance(known, determined, undetermined):
    """`fit_without_covariance` with a covariance by NumPy, and its outcome; None where there is none."""
    if (found := by_numpy(known)) is None:
        return None
    fit, outcome = determined if found[1] else undetermined
    return eqx.tree_at(lambda fit: fit.covariance, fit, found[0]), outcome


def _ended(lines, zoom, result, steps, weighted, covariance):
    """The fit, by whether its parameters are determined."""
    errors, lens = energy_by_frame(lines, weighted), lens_of(lines, zoom)
    rms = jnp.sqrt(jnp.nanmean(errors))
    certificate = certificate_of(
        zoom, lens.centre, lens.focal_range, lens.image_size, distortion_model=lens.distortion_model
    )
    return lambda determined: ZoomFit(
        lens=lens,
        rms=rms,
        frame_rms=jnp.sqrt(errors),
        covariance=covariance,
        result=judged(zoom, result, determined, certificate),
        steps=steps,
        certificate=certificate,
        rms_unconstrained=rms,
    )


def of_given(fit: ZoomFit, lines: AbstractLines) -> ZoomFit:
    """A fit of padded lines as one of the lines themselves."""
    return eqx.tree_at(lambda fit: fit.frame_rms, fit, of_frames(fit.frame_rms, lines))


def each_of_given(fits: FrameFits, lines: AbstractLines) -> FrameFits:
    """Fits of padded frames as those of the frames that there are."""
    own_centres = fits.centre.ndim == 2

    def by_frame(fits):
        each = (fits.coefficients, fits.frame_rms, fits.covariance, fits.result, fits.certificate)
        return jax.tree.leaves((each, fits.centre if own_centres else None))

    return eqx.tree_at(by_frame, fits, [of_frames(leaf, lines) for leaf in by_frame(fits)])


def collected(lines, fits, there=True):
    """Fits of one frame each, stacked, as one; about the centre of the lines.

    Frames that are not `there` are left out of the means.
    """
    squares, free = (jnp.where(there, rms, jnp.nan) ** 2 for rms in (fits.rms, fits.rms_unconstrained))
    return FrameFits(
        coefficients=fits.lens.zoom.parameters[:, 0],
        rms=jnp.sqrt(jnp.nanmean(squares)),
        frame_rms=fits.rms,
        covariance=fits.covariance,
        result=fits.result,
        certificate=fits.certificate,
        rms_unconstrained=jnp.sqrt(jnp.nanmean(free)),
        centre=jnp.asarray(lines.centre),
        scale=lines.scale,
        distortion_model=lines.distortion_model,
    )


def judged(zoom, result, determined, certificate):
    """The worst status, of the solver and of the model."""
    finite = jnp.all(jnp.isfinite(ravel_pytree(zoom.parameters)[0]))
    good: Any = RESULTS.successful  # inherited members, which pyright takes for another class's
    nonfinite: Any = RESULTS.nonfinite
    about_model = RESULTS.where(certificate.folded, RESULTS.folded, good)
    about_model = RESULTS.where(determined, about_model, RESULTS.undetermined)
    about_model = RESULTS.where(finite, about_model, nonfinite)
    solved = result if isinstance(result, RESULTS) else RESULTS.promote(result)
    # A solver may wander to its last step along what the lines do not determine: that is then the reason.
    wandered = (solved == RESULTS.nonlinear_max_steps_reached) & ~determined & finite
    return RESULTS.where((solved == good) | wandered, about_model, solved)


def is_invertible(fit):
    """Whether no refit is needed: the model is invertible, or the fit failed, or it has no certificate."""
    proved = fit.certificate.certified | (not fit.certificate.stated)
    return proved | failed(fit.result)


def failed(result):
    """Whether a solver failed. A status about the model is not a failure."""
    fitted = (RESULTS.successful, RESULTS.undetermined, RESULTS.folded, RESULTS.constrained)
    return ~functools.reduce(operator.or_, (is_status(result, of) for of in fitted))


def is_status(result, other):
    """Whether both are the same, by NumPy where they are known, which compiles nothing."""
    one, another = (jax.tree.leaves(of)[0] for of in (result, other))
    return (one if traced(one) else np.asarray(one)) == another


def outcome_of(fit):
    """Whether the fit is invertible; whether a solver failed, in which frame first, and its status."""
    bad = jnp.atleast_1d(failed(fit.result))
    frame = jnp.argmax(bad)
    result = jax.tree.map(lambda value: jnp.atleast_1d(value)[frame], fit.result)
    return jnp.all(is_invertible(fit)), (jnp.any(bad), frame, result)


def thrown(fit, outcome, throw):
    """The fit, raising where its solver failed."""
    _, (bad, frame, result) = outcome
    if not throw:
        return fit
    if traced(bad):
        return result.error_if(fit, bad)
    if bad:
        where = f"Frame {int(frame)}: " if isinstance(fit, FrameFits) else ""
        raise RuntimeError(f"The fit failed. {where}{RESULTS[result]}")
    return fit
