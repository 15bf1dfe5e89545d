"""Evidence about a fit, in px: what it explains, what it leaves, and whether its parts agree.

- *Noise* is how far points scatter about a smooth curve through their own line, once corrected. A line
  that is bent as a whole is smooth, so the noise is that of the edges alone, and an RMS far above it says
  that lines are not straight or that the model is too simple.
- *Displacement and its standard deviation* are averaged over the image at several focal lengths.
- *Bending* is the part of both that is no homography, in px of the image: see `_bending`.
- *Halves*: the model is fitted to one half of the lines and to the other, by a Gauss-Newton step from the
  fit of all. Noise makes the two lenses differ by what the bands predict; whatever else bends lines (a
  curved board, two lenses in one data set) makes them differ by more. The lines are parted in three ways:
  evenly, by direction, by frame.
- *Vanishing points* of corrected lines, which no fit asks for: see `vanishing_points`.

Once per fit: a pass over the points of some lines, and a Jacobian of the compressed ones.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from .._core.arguments import kinds_checked
from .._core.fields import check_finite
from .._core.programs import light_program
from .._core.types import of_known_values
from ..fit.distortion_models import compress_for
from ..fit.energy import (
    coefficients_by,
    frame_energy,
    line_squares,
    prior_of,
    size_of_prior,
)
from ..fit.image_metric import measured_as
from ..fit.own_weights import counts_of, own_weights
from ..fit.problem import data_of
from ..fit.result import ZoomFit
from ..fit.same_camera import check_lines_of, placed_as
from ..lines.base import AbstractLines
from ..lines.buckets import bucketed_jit, of_lines
from ..lines.free_centre import AnyCentreLines
from ..lines.lines import Lines
from ..models.lens import ZoomLens
from ..models.sizes import at_focal
from ..models.zoom import AbstractZoom, number_of_coefficients, with_parameters
from ._bending import bending
from ._linearised import by_parameters
from ._noise import noise
from .bands import displacement_std
from .vanishing import VanishingPoints, vanishing_points

NEGLIGIBLE, UNSEEN_PX = 2.5e-4, 0.25
"""Errors that do no harm: as a part of the image's diagonal, and, of small images, px."""

_FOCALS = 3  # over the range, evenly in 1/f
_GRID = 9  # points a side of the image
_LEAST_SHARE = 0.2  # of the lines, that each direction needs
_SCATTER = 2.7  # noises, by which lines that are not straight exceed it
_STRAIGHT = 0.01  # px: no line of a photo is straighter
_SINGULAR = 1e-10  # eigenvalues, of the largest
_ALIKE, _SAME_CENTRE = 1e-5, 1e-2  # weights, of each; px


@dataclasses.dataclass(frozen=True)
class Halves:
    """Two lenses, each fitted to a half of the lines.

    Attributes:
        parting: how the lines were parted: "lines", "directions" or "frames".
        apart: px between points corrected by the one and by the other, RMS over the image, at the focal
            length where it is largest.
        expected: the same by the bands of both, at that focal length.
    """

    parting: str
    apart: float
    expected: float

    @property
    def excess(self) -> float:
        """How many times farther apart they are than their bands predict."""
        return self.apart / self.expected if self.expected > 0 else np.inf * bool(self.apart)


@dataclasses.dataclass(frozen=True)
class Evidence:
    """What `assess` judges by. Lengths are in px.

    Attributes:
        lines, frames, focals: how many lines, frames and distinct focal lengths count.
        rejected: how many lines of three points or more have a weight of 0.
        astray: how many of these are off straight by more than does no harm (RMS).
        rms, rms_uncorrected: RMS distance to straight lines, with and without the correction.
        noise: RMS distance of points to smooth curves through their lines; NaN where they have few points.
        displacement: how far the correction moves points, RMS over the image, where that is largest.
        std: standard deviation of the displacement, as in the bands, averaged likewise, where that is
            largest.
        raster_displacement, raster_std: the same over points up to the image's border, which count alike,
            and so those at the border more than by their area: what errors are judged by.
        bent: how far the correction moves points beyond a homography of the corrected image, px of the
            image, RMS over it, at the frame's focal length where `bent_std` is largest.
        bent_std: the standard deviation of that, or what the centre of distortion would change about which
            lines are straighter, if that is more.
        to_centre: how far away this centre is, px; 0 if there is none.
        halves: the agreement of halves of the lines, as far as halves determine a lens.
        diagonal: of the image.
        vanishing: whether lines that are parallel in the scene meet.
    """

    lines: int
    rejected: int
    astray: int
    frames: int
    focals: int
    rms: float
    rms_uncorrected: float
    noise: float
    displacement: float
    std: float
    raster_displacement: float
    raster_std: float
    bent: float
    bent_std: float
    to_centre: float
    halves: tuple[Halves, ...]
    diagonal: float
    vanishing: VanishingPoints

    @property
    def crooked(self) -> bool:
        """Whether lines deviate from straight ones by far more than the noise of their points."""
        return bool(self.rms > max(_SCATTER * self.noise, _STRAIGHT))


@kinds_checked
@of_known_values
def evidence(lines: Lines, fit: ZoomFit, *, compressed: AbstractLines | None = None) -> Evidence:
    """Collect the evidence about a fit.

    Args:
        lines: the lines of the fit, with their points and weights.
        fit: the fit.
        compressed: the same lines compressed for the fit's distortion model, if they are at hand.

    Raises:
        ValueError: no line is usable; the lens has parameters that are not finite, as of a fit that failed;
            the lines are not those of the fit, being of another image size, unit or number of frames; or
            `compressed` are others, of other weights, about another centre or for another distortion model.

    Example:
        >>> from zoomjax import compress, fit_zoom, scenes
        >>> focal = scenes.focal_sweep(4)
        >>> lines = scenes.board_lines(scenes.nikkor_18_200(), focal, spacing=99, noise=0.5)
        >>> bool(0.4 < evidence(lines, fit_zoom(compress(lines))).noise < 0.6)
        True
    """
    check_lines_of(fit, lines)
    lens = fit.lens
    for values in jax.tree.leaves(lens.zoom.parameters):
        check_finite("fit.lens.zoom.parameters", values)
    placed: Any = placed_as(lens, lines)
    if compressed is None:
        terms = number_of_coefficients(lens.zoom)
        points = data_of(placed)
        compressed = compress_for(points, lens.distortion_model, terms=terms)
    compressed = _same_lines(lines, compressed, lens, placed)
    weight = own_weights(compressed)
    if not weight.any():
        raise ValueError(
            "Argument lines must have a usable line, but all have a weight of 0 or too few points."
        )
    frames = np.unique(np.asarray(lines.frame)[weight > 0])
    dtype = fit.covariance.dtype
    low, high = (float(f) for f in lens.focal_range)
    focals = 1 / np.linspace(1 / low, 1 / high, _FOCALS)
    raster = jnp.asarray(_raster(lens), dtype)
    moved, rows = map(np.asarray, _derivatives(lens, raster, jnp.asarray(focals, dtype)))
    displaced = np.linalg.norm(moved, axis=-1)
    std = np.asarray(displacement_std(fit, _raster(lens)[None], focal=focals[:, None]))
    std = np.where(np.isnan(std) & ~np.isnan(displaced), np.inf, std)  # of a covariance that is not known
    pulled = _normal_terms(compressed, lens.zoom)
    bent = bending(lines, fit, weight, pulled[0])
    zero = jax.device_put(np.zeros((len(lines.focal), number_of_coefficients(lens.zoom)), dtype))
    before = np.asarray(frame_energy(compressed, zero))
    rejected = (counts_of(lines) > 2) & (weight == 0)
    harmless = max(UNSEEN_PX, NEGLIGIBLE * 2 * lens.scale)
    seen = np.asarray(line_squares(compressed, lens.zoom)) > harmless**2
    return Evidence(
        lines=int((weight > 0).sum()),
        rejected=int(rejected.sum()),
        astray=int((rejected & seen).sum()),
        frames=len(frames),
        focals=np.unique(np.asarray(lines.focal)[frames]).size,
        rms=float(fit.rms),
        rms_uncorrected=float(np.sqrt(np.nanmean(before))),
        noise=noise(measured_as(placed, compressed), lens, np.flatnonzero(weight)),
        displacement=float(np.max(_over_image(displaced, _areas()))),
        std=float(np.max(_over_image(std, _areas()))),
        raster_displacement=float(np.max(_over_image(displaced))),
        raster_std=float(np.max(_over_image(std))),
        bent=bent.moved,
        bent_std=bent.std,
        to_centre=bent.to_centre,
        halves=tuple(_halves(compressed, fit, weight, rows, *pulled)),
        diagonal=2 * lens.scale,
        vanishing=vanishing_points(lines, lens),
    )


def _same_lines(
    lines: Lines, compressed: AbstractLines, lens: ZoomLens, placed: AbstractLines
) -> AbstractLines:
    """The compressed lines about the centre of the fit, where `placed`, not compressed, are.

    Raises:
        ValueError: they are not the lines, or compressed about another centre or for another model.
    """
    own, others = (
        own_weights(of) / max(own_weights(of).max(initial=0), 1e-300) for of in (lines, compressed)
    )
    same = (
        compressed.image_size == lines.image_size
        and compressed.focal_unit == lines.focal_unit
        and np.array_equal(compressed.frame, lines.frame)
        and np.array_equal(counts_of(compressed), counts_of(lines))
        and np.allclose(own, others, rtol=_ALIKE, atol=0)
    )
    if not same:
        raise ValueError(
            "Argument compressed must be the same lines, compressed, but images, frames, numbers of points "
            "or weights differ: leave it out."
        )
    model, wanted = (type(of.distortion_model).__name__ for of in (compressed, placed))
    if model != wanted:
        raise ValueError(
            f"Argument compressed must be lines for the distortion model of the fit, {wanted}, but they "
            f"are for {model}: leave it out, or give compress_for(lines, fit.lens.distortion_model)."
        )
    if isinstance(data_of(compressed), AnyCentreLines):
        return placed_as(lens, compressed)
    if not np.allclose(compressed.centre, placed.centre, rtol=0, atol=_SAME_CENTRE):
        raise ValueError(
            "Argument compressed must be lines about the centre of distortion of the fit, "
            f"{_place(placed)} px, but they are about {_place(compressed)} px: leave it out."
        )
    return compressed


def _place(lines: AbstractLines) -> str:
    return "({:.6g}, {:.6g})".format(*np.asarray(lines.centre))


def _halves(
    lines: AbstractLines,
    fit: ZoomFit,
    weight: np.ndarray,
    rows: np.ndarray,
    prior: np.ndarray,
    terms: tuple[np.ndarray, np.ndarray],
) -> Iterator[Halves]:
    """The agreement of halves, in the partings that determine lenses; the last two as `_normal_terms`.

    A prior draws both halves to its mean, but the one that sees less of the zoom by more: by how much, in
    the mean over what it expects, they are apart without noise.
    """
    own = prior_of(fit.lens.zoom)
    pulled = np.zeros_like(prior) if own is None else float(size_of_prior(lines, own)) ** 2 * prior
    for name, first in _partings(lines, fit, weight).items():
        one, other = (
            _half(prior, *(values[half & (weight > 0)] for values in terms)) for half in (first, ~first)
        )
        if one is None or other is None:
            continue
        apart = _over_image(np.linalg.norm(rows @ (one.step - other.step), axis=-1))
        unequal = one.inverse - other.inverse
        expected = _spread(rows, one.covariance + other.covariance + unequal @ pulled @ unequal)
        at = int(np.argmax(apart))
        yield Halves(name, float(apart[at]), float(expected[at]))


class _Half(NamedTuple):
    """The fit to some of the lines: its step from that to all, its covariance without what a prior expects,
    and the inverse of its normal matrix."""

    step: Float[np.ndarray, "parameter"]
    covariance: Float[np.ndarray, "parameter parameter"]
    inverse: Float[np.ndarray, "parameter parameter"]


def _half(prior: np.ndarray, gram: np.ndarray, gradient: np.ndarray) -> _Half | None:
    """The fit to some lines; None if they do not determine it.

    Args:
        prior: the normal matrix of the model's prior.
        gram, gradient: of each line.
    """
    total = prior + gram.sum(axis=0)
    size = np.sqrt(np.diagonal(total))
    if not size.all():
        return None
    scaled = total / size / size[:, None]
    values, vectors = np.linalg.eigh(scaled)
    if values[0] < _SINGULAR * values[-1]:
        return None
    inverse = (vectors / values) @ vectors.T / size / size[:, None]
    scatter = gradient - gradient.mean(axis=0)
    return _Half(-inverse @ gradient.sum(axis=0), inverse @ (scatter.T @ scatter) @ inverse, inverse)


def _normal_terms(
    lines: AbstractLines, zoom: AbstractZoom
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """The normal matrix of the prior; that of each line, and its gradient with a share of the prior's.

    In float64: squares have twice as many digits as what they are squares of.
    """
    residuals, jacobian, prior, prior_gradient = (np.asarray(p, float) for p in by_parameters(lines, zoom))
    gram = np.einsum("lrp,lrq->lpq", jacobian, jacobian)
    gradient = np.einsum("lrp,lr->lp", jacobian, residuals) + 2 * prior_gradient / len(residuals)
    return prior.T @ prior, (gram, gradient)


def _partings(lines: AbstractLines, fit: ZoomFit, weight: np.ndarray) -> dict[str, np.ndarray]:
    """Which lines are in the first half, by the name of the parting."""
    frame, focal = np.asarray(lines.frame), np.asarray(lines.focal)
    counted = np.flatnonzero(weight)
    rng = np.random.default_rng(0)
    order = counted[np.lexsort([rng.random(len(counted)), frame[counted]])]
    evenly = np.zeros(len(frame), bool)
    evenly[order[::2]] = True
    there = np.unique(frame[counted])
    rank = np.zeros(len(focal), int)
    rank[there[np.argsort(focal[there], kind="stable")]] = np.arange(len(there))
    parted = {"lines": evenly, "frames": rank[frame] % 2 == 0}
    across, down = np.asarray(_extent(lines, fit.lens.zoom)).T
    steep = down > across
    if _LEAST_SHARE <= steep[counted].mean() <= 1 - _LEAST_SHARE:
        parted["directions"] = steep
    return parted


@bucketed_jit(returns=of_lines)
def _extent(lines, zoom):
    """How far each corrected line reaches, squared: across the image and down."""
    rows = lines.corrected(coefficients_by(zoom, lines))
    return jnp.sum(rows**2, axis=1)


def _raster(lens: ZoomLens) -> np.ndarray:
    """Points over the image: (point, 2) px."""
    sides = (np.linspace(0, side - 1, _GRID) for side in lens.image_size)
    return np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)


@light_program
def _derivatives(lens, points, focals):
    """Displacements of points at focal lengths, and their derivatives by the parameters."""
    flat, unravel = ravel_pytree(lens.zoom.parameters)

    def moved(flat):
        zoom = with_parameters(lens.zoom, unravel(flat))
        other = eqx.tree_at(lambda lens: lens.zoom, lens, zoom)
        return jax.vmap(lambda f: at_focal(other, f).undistort(points) - points)(focals)

    return moved(flat), jax.jacfwd(moved)(flat)


def _spread(rows: np.ndarray, covariance: np.ndarray) -> Float[np.ndarray, "focal"]:
    """Standard deviation of corrected points, px, RMS over the image, at each focal length."""
    unknown = np.isinf(np.diagonal(covariance))
    if (unknown & (np.nan_to_num(rows) != 0).any(axis=(0, 1, 2))).any():
        return np.full(len(rows), np.inf)
    variance = np.einsum("fpcq,qs,fpcs->fp", rows, np.where(np.isinf(covariance), 0, covariance), rows)
    return _over_image(np.sqrt(np.maximum(variance, 0)))


def _over_image(lengths: np.ndarray, weight: np.ndarray | float = 1.0) -> Float[np.ndarray, "focal"]:
    """RMS over the image, of points of equal or of these weights; points beyond a fold have no length and
    are left out."""
    there = ~np.isnan(lengths)
    squares = np.where(there, lengths, 0) ** 2
    return np.sqrt((squares * weight).sum(axis=1) / np.maximum((there * weight).sum(axis=1), 1))


def _areas() -> np.ndarray:
    """Weights of the raster's points for a mean over the image's area: Simpson's rule."""
    side = np.resize([2.0, 4.0], _GRID)
    side[[0, -1]] = 1
    return np.outer(side, side).ravel()
