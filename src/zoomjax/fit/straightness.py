"""Straightness of lines corrected by a lens: the error of eq. 3, px."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.arguments import check_kind, kinds_checked
from .._core.arrays import as_jax
from .._core.fields import real_argument
from .._core.types import AnyArray
from ..lines.base import AbstractLines
from ..lines.buckets import is_here
from ..models.lens import ZoomLens
from .energy import frame_coefficients, frame_energy
from .problem import about_own_centre
from .same_camera import check_camera, placed_as


@kinds_checked
def frame_rms(
    lines: AbstractLines, lens: ZoomLens | Float[AnyArray, "frame terms"] | None
) -> Float[Array, "frame"]:
    """RMS distance to straight lines (root of eq. 3) of each frame, px; NaN for a frame without usable
    lines.

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

    If the lens folds, points beyond the fold are corrected by the formula.
    """
    if isinstance(lens, ZoomLens):
        check_kind("lens", lens, (ZoomLens,))
        check_camera(lens, lines)
        lens.check_range(lines.focal)
        lines = placed_as(lens, lines)
    elif not (lens is None or eqx.is_array_like(lens)):
        raise TypeError(
            "Argument lens must be a ZoomLens (fit.lens, not the fit), coefficients of each frame or None, "
            f"but its type is {type(lens).__name__}."
        )
    lines = about_own_centre(lines)
    if isinstance(lens, ZoomLens):
        lens = frame_coefficients(lines, lens.zoom)
    elif lens is None:
        lens = np.zeros(
            (lines.focal.shape[0], lines.distortion_model.num_coefficients(1)), lines.focal.dtype
        )
    squares = frame_energy(lines, as_jax(real_argument("lens", lens)))
    return as_jax(np.sqrt(np.asarray(squares))) if is_here(squares) else jnp.sqrt(squares)
