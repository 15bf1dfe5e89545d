"""Lines and tracks, and the lens or fit that they are those of: of the same images, frames and unit."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..lines.base import AbstractLines
from ..lines.buckets import bucketed_jit, of_frames
from ..models.about import WIDTH_OF_FOCALS
from ..models.camera import px_of_focal_px
from ..models.lens import ZoomLens
from ..models.zoom import number_of_coefficients
from ..tracks.tracks import Tracks
from .distortion_models import with_distortion_model
from .motion_fit import MotionFit
from .result import FrameFits, ZoomFit


def check_camera(lens: ZoomLens, lines: AbstractLines) -> None:
    """Refuse lines of another camera than the lens's.

    Raises:
        ValueError: the lens is for images of another size or focal lengths in another unit, or in px of
            images of another size.
    """
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
    if lens.focal_unit == "px" and px_of_focal_px(lens) != 1:
        raise ValueError(
            "The lens was scaled by lens_for_size, and takes focal lengths in px of the images before, "
            f"{lens.about[WIDTH_OF_FOCALS]:g} px wide, but those of the lines are of images "
            f"{lines.image_size[0]} px wide: give the lens as it was, and lines of such images."
        )


def check_lines_of(fit: ZoomFit, lines: AbstractLines) -> None:
    """Refuse other lines than those of a fit, as far as one can tell.

    Raises:
        ValueError: they are of another camera, or of another number of frames.
    """
    check_camera(fit.lens, lines)
    own, given = fit.frame_rms.shape[-1], lines.focal.shape[-1]
    if own != given:
        raise ValueError(
            f"The fit is of {own} frames, but the lines are of {given}: pass the lines that were fitted."
        )


def check_alike(fit: ZoomFit, each: FrameFits) -> None:
    """Refuse fits of frames that are no counterpart of a fit of all.

    Raises:
        ValueError: they are of other frames, or have other coefficients.
    """
    alike = {
        "number of frames": (each.coefficients.shape[0], fit.frame_rms.shape[-1]),
        "distortion model": tuple(type(of.distortion_model).__name__ for of in (each, fit.lens)),
        "number of coefficients": (each.coefficients.shape[1], number_of_coefficients(fit.lens.zoom)),
    }
    for what, (own, wanted) in alike.items():
        if own != wanted:
            raise ValueError(
                "The fits of frames must be of the same frames by the same model as the fit of all, but "
                f"their {what} is {own}, and its own {wanted}."
            )


def check_tracks_of(fit: MotionFit, tracks: Tracks) -> None:
    """Refuse other tracks than those of a fit, as far as one can tell: by which views there are.

    Raises:
        ValueError: they are of other images, of another number of frames, or have other views.
    """
    seen, mask = np.isfinite(np.asarray(fit.residual)), np.asarray(tracks.mask)
    alike = (fit.lens.image_size, len(fit.focal)) == (tracks.image_size, tracks.frames)
    if not alike or seen.shape != mask.shape or (seen & ~mask).any():
        raise ValueError(
            "Argument tracks must be those of the fit, but their images, frames or views are others: give "
            "the tracks that were fitted."
        )


def placed_as(lens: ZoomLens, lines: AbstractLines) -> AbstractLines:
    """The lines under the distortion model of a lens and about its centre, at each frame's focal length."""
    moved: Any = with_distortion_model(lines, lens.distortion_model)
    return moved.about(lens.centre if lens.shift is None else _centres(lines, lens))


@bucketed_jit(returns=of_frames)
def _centres(lines, lens):
    return jax.vmap(lens.centre_at)(jnp.asarray(lines.focal))
