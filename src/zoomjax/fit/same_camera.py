"""Checks that lines are those of a lens or of a fit: of the same images, frames and unit."""

from ..lines.base import AbstractLines
from ..models.lens import ZoomLens
from .result import ZoomFit


def check_camera(lens: ZoomLens, lines: AbstractLines) -> None:
    """Refuse lines of another camera than the lens's.

    Raises:
        ValueError: the lens is for images of another size or focal lengths in another unit.
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
