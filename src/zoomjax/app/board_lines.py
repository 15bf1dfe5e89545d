"""Rows and columns of a board that is bent, as a flat one would show them.

A bent board bends its rows and columns, whatever the lens: a lens that makes them straight is wrong. Where
the bundle adjustment finds them bent, they are moved to where a flat board in the same place would have
them, and the lens is fitted to these. What is uncertain of the board's shape is then uncertain of the lens.
"""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .._core.arrays import as_jax
from .._core.programs import light_program
from .._core.types import AnyArray
from ..detect.batch import Detection
from ..detect.grid import GridDetector
from ..fit.boards import BoardFit
from ..fit.energy import line_squares
from ..fit.result import RESULTS, ZoomFit, failed, is_status
from ..fit.zoom import CentreArgument, fit_zoom
from ..lines.free_centre import compress_any_centre
from ..lines.lines import Lines
from ..models.distortion_model import AbstractDistortionModel
from ..models.lens import ZoomLens
from ..models.zoom import PolynomialZoom, number_of_coefficients, with_parameters

_STRAIGHTER = 0.9
"""Deviation of lines of the flat board, in those of the bent one, below which they are taken."""

_OF_A_PHOTO = 18
"""Numbers that `fit_boards` fits to each photo: its pose, and how the board bends in it."""

_RADII = 16
"""Places from the centre to the corner where displacements are compared."""


@dataclasses.dataclass(frozen=True)
class Straightness:
    """How straight rows and columns are, each under the lens that fits them best.

    Attributes:
        seen: the lens of those that are seen.
        rms_seen, rms_flat: their deviation, median over lines, px, and that of those of a flat board, as it
            is expected without the numbers that were fitted to the board's shape.
    """

    seen: ZoomLens
    rms_seen: float
    rms_flat: float

    @property
    def bent(self) -> bool:
        """Whether the board bends the lines by more than can be left to the lens."""
        return self.rms_flat < _STRAIGHTER * self.rms_seen


def flat_detections(
    fit: BoardFit, detections: Sequence[Detection], turns: Sequence[int]
) -> list[Detection]:
    """The detections that were fitted, in their order, with the lines of a flat board.

    Of each, `turns` says by how many quarters its grid was turned for the fit (`np.rot90`).
    """
    flat = []
    for detection, moved, turn in zip(detections, fit.flattening(), turns, strict=True):
        assert detection.nodes is not None  # it has been fitted
        nodes = detection.nodes + np.nan_to_num(np.rot90(moved, -turn))
        flat.append(dataclasses.replace(detection, nodes=nodes, lines=tuple(GridDetector.lines(nodes))))
    return flat


def straightness(
    fit: BoardFit, seen: Lines, flat: Lines, centre: CentreArgument | None
) -> Straightness | None:
    """How straight lines are, and those of a flat board; None if no lens can be fitted to them.

    Only fits that determine the board's shape count.
    """
    if bool(failed(fit.fit.result)) or is_status(fit.fit.result, RESULTS.undetermined):
        return None
    degree = min(2, np.unique(np.asarray(seen.focal)).size - 1)
    lenses, deviations = [], []
    for lines in (seen, flat):
        held = compress_any_centre(lines)
        one = fit_zoom(held, zoom=PolynomialZoom(degree=degree), centre=centre, throw=False)
        if bool(failed(one.result)):
            return None
        lenses.append(one.lens)
        placed = held.about(one.lens.centre)
        deviations.append(float(np.sqrt(np.median(line_squares(placed, one.lens.zoom)))))
    return Straightness(lenses[0], deviations[0], deviations[1] * _of_freedom(fit))


def _of_freedom(fit: BoardFit) -> float:
    """By how much residuals are smaller for the numbers that were fitted."""
    count = 2 * int(np.isfinite(np.asarray(fit.poses.residual)).sum())
    fitted = _OF_A_PHOTO * len(fit.frame_focal) + fit.coefficients.size
    return float(np.sqrt(count / max(count - fitted, count / 4)))


def widened(fit: ZoomFit, board: BoardFit) -> ZoomFit:
    """A fit to lines of the flat board with what is uncertain of the board's shape in its bands."""
    misfit = coefficient_covariance(board, fit.lens.distortion_model, fit)
    if fit.misfit is not None:
        misfit = _added(fit.misfit, np.s_[: len(misfit), : len(misfit)], misfit)
    fit = eqx.tree_at(lambda f: f.misfit, fit, as_jax(misfit), is_leaf=lambda leaf: leaf is None)
    own = board.fit.joint
    if fit.joint is None or own is None:
        return fit
    # Of a centre that moves, of the two numbers that are the same at all focal lengths: they come first.
    first = -2 if fit.lens.shift is None else -np.size(fit.lens.shift.parameters)
    centre = slice(first, first + 2 or None)
    joint = _added(fit.joint, (centre, centre), np.asarray(own)[-2:, -2:])
    return eqx.tree_at(lambda f: f.joint, fit, as_jax(joint))


def _added(whole: AnyArray, where: tuple[slice, ...], part: np.ndarray) -> np.ndarray:
    """A matrix with a part added to it in a place."""
    out = np.array(whole)
    out[where] += part
    return out


def coefficient_covariance(
    board: BoardFit, distortion_model: AbstractDistortionModel, fit: ZoomFit
) -> np.ndarray:
    """Covariance of a distortion model's coefficients that displaces as that of the bundle's lens.

    In the mean over the zooms.
    """
    numbers = number_of_coefficients(fit.lens.zoom)
    low, high = (float(f) for f in fit.lens.focal_range)
    label = np.asarray(board.label)
    share = (label - label.min()) / max(float(np.ptp(label)), 1e-9)
    total = np.zeros((numbers, numbers))
    for focal, at in zip(np.asarray(board.focal), low + (high - low) * share, strict=True):
        moved = np.asarray(_moved(board.lens.zoom, board.lens.distortion_model, focal))
        own = np.asarray(_columns_at(fit.lens.zoom, distortion_model, np.asarray(at)))
        gain = np.linalg.pinv(own) @ moved
        total += gain @ np.asarray(board.fit.covariance) @ gain.T / len(board.focal)
    return total


@light_program
def _moved(zoom, distortion_model, focal):
    """How each parameter of a zoom model moves points at some radii."""
    flat, unravel = ravel_pytree(zoom.parameters)
    by_parameter = jax.jacfwd(lambda flat: with_parameters(zoom, unravel(flat))(focal))(flat)
    return _columns_at(zoom, distortion_model, focal) @ by_parameter


@light_program
def _columns_at(zoom, distortion_model, focal):
    return _columns(distortion_model, zoom(focal), jnp.linspace(0, 1, _RADII))


@light_program
def _columns(distortion_model, k, radii):
    """How each coefficient moves points at some radii along the image's x axis."""

    def moved(k):
        return jax.vmap(lambda r: distortion_model.correct((r, 0 * r), r * r, k)[0])(radii)

    return jax.jacfwd(moved)(k)
