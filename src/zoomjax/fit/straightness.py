"""Straightness of lines corrected by a lens: the error of eq. 3, px."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core.arguments import kinds_checked
from .._core.types import AnyArray
from ..lines.base import AbstractLines
from ..models.lens import ZoomLens
from .energy import coefficients_by, frame_energy
from .family_lines import with_family
from .same_camera import check_camera
from .wrapper import about_own_centre


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
        check_camera(lens, lines)
        lens.check_range(lines.focal)
        lines = with_family(lines, lens.family)
        lines = lines.about(lens.centre if lens.shift is None else jax.vmap(lens)(lines.focal).centre)
    elif not (lens is None or eqx.is_array_like(lens)):
        raise TypeError(
            "Argument lens must be a ZoomLens (fit.lens, not the fit), coefficients of each frame or None, "
            f"but its type is {type(lens).__name__}."
        )
    return _frame_rms(about_own_centre(lines), lens)


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
