"""A whole calibration: from lines to the fits and the key figures. The command line runs this."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from .._core.arguments import kinds_checked
from ..fit.energy import line_squares
from ..fit.focal_lengths import of_equal_focal, with_focal_sigma
from ..fit.image_metric import in_image
from ..fit.result import ZoomFit
from ..fit.straightness import frame_rms
from ..lines.lines import Lines
from ..trust.assessment import assess
from ..trust.cross_validation import cross_validate_frames
from ..trust.misfit import with_misfit
from ..trust.next_photo import suggest_next
from ..trust.own_centres import own_centres
from .calibration import Calibration
from .fitting import Fitted, Metric, algebraic_rms, fitted, left_out
from .model_choice import WantedCentre, WantedModel


@kinds_checked
def calibrate(
    lines: Lines,
    *,
    model: WantedModel = WantedModel(),  # noqa: B008, it is frozen
    centre: WantedCentre | None = "fit",
    robust: bool = False,
    metric: Metric = in_image,
    focal_sigma: float | Float[np.ndarray, "frame"] = 0.0,
    shared: Int[np.ndarray, "frame"] | None = None,
    widened: Callable[[ZoomFit], ZoomFit] = lambda fit: fit,
    stage: Callable[[str], None] = lambda _: None,
) -> Calibration:
    """Fit the zoom model, and the models it is compared with.

    Args:
        lines: the lines; computed in float64 if that is enabled, whatever their dtype.
        model: the zoom model; by default the one of least cross-validation error.
        centre: the centre of distortion: "fit", "image", its coordinates, px, or None for that of the
            lines. With "fit" it is that of the lines where they do not determine another, or where lines
            that were not fitted are not straighter about it. "moving": it may move along the zoom.
        robust: whether to reject lines that are not straight in the scene. All figures are then computed
            from the remaining lines.
        metric: where distances are measured: `in_image`, or `in_corrected` as in the paper.
        focal_sigma: standard deviation of the focal lengths: a number, or one per frame; 0 where exact.
        shared: for each frame a number: frames of one number share the error of f, as those of one f do.
        widened: adds to the uncertainty of a fit what the lines do not show of it.
        stage: called with a description before each step that takes time.

    Raises:
        ValueError: an argument is not one of these, or there are too few focal lengths for the model.
        RuntimeError: the solver failed.
    """
    used = fitted(lines, model, centre, robust=robust, metric=metric, stage=stage)
    stage("Checking the fit on lines left out")
    return judged(lines, used, robust=robust, focal_sigma=focal_sigma, shared=shared, widened=widened)


def judged(
    lines: Lines,
    used: Fitted,
    *,
    robust: bool,
    focal_sigma: float | Float[np.ndarray, "frame"],
    shared: Int[np.ndarray, "frame"] | None,
    widened: Callable[[ZoomFit], ZoomFit] = lambda fit: fit,
) -> Calibration:
    """The calibration that fits make, with all that tells how good they are; see `calibrate`."""
    exact, small, terms = used.fit, used.lines, used.model.terms
    sigma, shared = np.broadcast_to(focal_sigma, lines.focal.shape), of_equal_focal(lines.focal, shared)
    placed = small if exact.lens.shift is None else used.held
    zoom = with_focal_sigma(exact, placed, focal_sigma=sigma, shared=shared) if sigma.any() else exact
    zoom = widened(with_misfit(zoom, used.held, focal_sigma=sigma, shared=shared))
    held_out: dict[str, Any] = {"rms_held_out": left_out(small, used.model)}
    held_out["rms_frames_held_out"] = cross_validate_frames(small, terms=terms)
    lines = (lines.weighted(np.asarray(small.weight)) if robust else lines).about(np.asarray(small.centre))
    return Calibration(
        lines=lines,
        fit=zoom,
        frames=used.each,
        rms_uncorrected=np.asarray(frame_rms(small, np.zeros(used.each.coefficients.shape))),
        rms_algebraic=algebraic_rms(small, used.model),
        rejected=(np.ones(len(lines.frame)) if lines.weight is None else np.asarray(lines.weight)) == 0,
        line_rms=np.sqrt(line_squares(small, zoom.lens.zoom)),
        next_photo=suggest_next(*used.one),  # from the noise alone, without focal_sigma
        focal_sigma=sigma,
        **held_out,
        centre=used.centre.as_uncertain_as(zoom),
        assessment=assess(lines, zoom, compressed=small, **held_out).joined_by(used.centre.findings()),
        selection=used.selection,
        own_centres=own_centres(used.one[0], used.held),
        in_image=small.metric == "distorted",
    )
