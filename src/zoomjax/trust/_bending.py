"""How far a correction may bend what is straight: the part of its error that straightness has a say in.

Lines cannot tell a homography of the corrected image, and nobody sees one as distortion: an error that is
one is left out. What remains is in px of the image, RMS over it, so that a strong lens, which stretches the
corners of the corrected image, is judged like a weak one.

Of one photo of a strong lens another distortion model may follow the lines as well: see `_rival`.

Two estimates are made, and the larger one counts. That of the bands: the covariance of the fit, with all
that was added to it, as the model's misfit or the shape of a board. And one of lines that are independent,
in which the centre of distortion is free in any case, within what is usual of cameras: where lines do not
determine it, it was kept where it was assumed, and a lens about a wrong one is right along the lines and
wrong beside them. Where they do, and are straighter about another one, the Gauss-Newton step there counts.

In NumPy, without a program to compile: 24 points of at most 2000 lines, once per fit.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .._core.programs import light_program
from ..fit.energy import settings
from ..fit.result import ZoomFit
from ..lines.buckets import padded_frames
from ..lines.lines import Lines
from ..models.lens import ZoomLens
from ..models.polynomial import RadialPolynomial
from ..models.zoom import with_parameters
from ._in_image import beyond, derivatives, over_image, residuals
from ._rival import apart_from_division

_CENTRE = 0.02
"""Standard deviation of the centre of a camera about where it is assumed, in half diagonals."""

_STRONG = 0.01
"""Of the diagonal: the least that a strong lens bends. The series of models of weaker ones are alike."""

_MOST_LINES, _POINTS = 2000, 24
_SURE = 2.0  # standard deviations, by which a step exceeds what noise makes of it
_SINGULAR = 1e-12  # eigenvalues, of the largest
_TURNS = 3


@dataclasses.dataclass(frozen=True)
class Bending:
    """How far a correction moves points beyond a homography, where it is most uncertain.

    Attributes:
        moved: px of the image, RMS over it.
        std: its standard deviation, likewise.
        to_centre: how far off the centre of distortion is, px, if it is that which makes `std` what it is;
            else 0.
    """

    moved: float
    std: float
    to_centre: float = 0.0


def bending(lines: Lines, fit: ZoomFit, weight: np.ndarray, prior: np.ndarray) -> Bending:
    """What lines of a fit tell of the part of a lens that is no homography.

    Args:
        lines: the lines.
        fit: to them, with all that its bands include.
        weight: of each line in the fit; 0 for those that do not count.
        prior: (p, p), the normal matrix of the zoom model's prior, in the units of the energy.
    """
    lens, frame = fit.lens, np.asarray(lines.frame)
    distortion_model = lens.distortion_model
    k, by_parameter, centre, by_centre = _at_frames(lines, lens)
    share = weight / np.bincount(frame, weight, len(k))[frame].clip(1e-300)
    counted = np.flatnonzero(weight > 0)
    chosen = counted[np.unique(np.linspace(0, len(counted) - 1, _MOST_LINES).astype(int))]
    share = share[chosen] / share[chosen].sum() / _POINTS
    points, mask = np.asarray(lines.points, float)[chosen], np.asarray(lines.mask)[chosen]
    z = np.stack([_some(p[m]) for p, m in zip(points, mask, strict=True)])
    z = (z - centre[frame[chosen], None]) / lens.scale
    error, slope = residuals(distortion_model, z, k[frame[chosen]], by_parameter[frame[chosen]])
    sound = np.isfinite(error).all(axis=1)
    if not sound.any():
        return Bending(np.nan, np.inf)
    chosen, z, error, slope, share = chosen[sound], z[sound], error[sound], slope[sound], share[sound]
    wanted = np.zeros((slope.shape[-1],) * 2)
    wanted[:-2, :-2] = prior / lens.scale**2
    root, step = _root(error, slope, share, wanted)
    there = np.unique(frame[chosen])
    there = there[np.argsort(np.asarray(lines.focal)[there], kind="stable")]
    found, to_centre = [], float(np.linalg.norm(step[-2:])) * lens.scale
    for at in np.unique(there[[0, len(there) // 2, -1]]):
        moved, rows = _over_image(lens, centre[at], k[at], by_parameter[at])
        by_lines, off = (np.sqrt(np.sum((rows @ of) ** 2) / max(len(rows), 1)) for of in (root, step))
        by_bands = _std_beyond(lens, centre[at], k[at], _of_bands(fit, by_parameter[at], by_centre[at]))
        std = max(by_lines, by_bands) if len(rows) else np.inf
        elsewhere = off > max(_SURE * by_lines, std)
        std = float(off if elsewhere else std) * lens.scale
        found.append(Bending(moved * lens.scale, std, to_centre if elsewhere else 0.0))
    worst = max(found, key=lambda of: of.std)
    strong = worst.moved > _STRONG * 2 * lens.scale
    if len(there) > 1 or not strong or not isinstance(distortion_model, RadialPolynomial):
        return worst
    other = apart_from_division(z, k[there[0]], centre[there[0]], lens.image_size)
    return dataclasses.replace(worst, std=float(np.hypot(worst.std, other)))


def _at_frames(lines: Lines, lens: ZoomLens) -> list[np.ndarray]:
    """Each frame's coefficients, their derivatives by the parameters, its centre, and the derivatives of
    that, in half diagonals, by the numbers that say where the centre is."""
    given = [padded_frames(of) for of in (lines.focal, *settings(lens.zoom, lines))]
    return [np.asarray(of, float)[: len(lines.focal)] for of in _coefficients(given, lens)]


@light_program
def _coefficients(given, lens):
    flat, unravel = ravel_pytree(lens.zoom.parameters)

    def at(flat):
        return jax.vmap(with_parameters(lens.zoom, unravel(flat)))(*given[1:])

    focal = given[0]
    if lens.shift is None:
        by_centre = jnp.broadcast_to(jnp.eye(2), (*focal.shape, 2, 2))
    else:
        place, again = ravel_pytree(lens.shift.parameters)
        by_centre = jax.vmap(jax.jacfwd(lambda q, f: with_parameters(lens.shift, again(q))(f)), (None, 0))(
            place, focal
        )
    return at(flat), jax.jacfwd(at)(flat), jax.vmap(lens.centre_at)(focal), by_centre


def _some(points: np.ndarray) -> np.ndarray:
    return points[np.linspace(0, len(points) - 1, _POINTS).round().astype(int)]


def _root(
    error: np.ndarray, slope: np.ndarray, share: np.ndarray, prior: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A root of the covariance of the parameters: lines err each by itself, and the centre is as usual.

    Of two estimates the mean: the sandwich of the lines' scores, which of few lines knows its shape badly,
    and that of independent points, of which as many count as one as the size of the sandwich says. How
    surely the centre is where it is assumed, beside what the lines say, follows from that number, too.

    Also the Gauss-Newton step to a centre about which lines are straighter, less that of a given centre,
    which is none but for what the fit measured or weighed in another way.
    """
    own = np.einsum("l,lsp,lsq->pq", share, slope, slope)
    lost = float(share @ np.einsum("ls,ls->l", error, error))
    noise = lost / (1 - 2 / error.shape[1])  # of a point, squared
    each = noise * float(np.sum(share**2) / np.sum(share))
    centre = np.zeros(len(prior))
    centre[-2:] = 1 / _CENTRE

    def estimated(together):
        """A root of the inverse normal matrix, and by it the lines' scores, and independent points."""
        total = own + prior + np.diag(together * each * centre**2)
        size = np.sqrt(np.diagonal(total)).clip(1e-150)
        values, vectors = np.linalg.eigh(total / size / size[:, None])
        back = vectors / np.sqrt(values.clip(_SINGULAR * values[-1])) / size[:, None]
        rows = slope @ back
        score = share[:, None] * np.einsum("lsp,ls->lp", rows, error)
        alone = noise * np.einsum("l,lsp,lsq->pq", share**2, rows, rows)
        return back, score, alone, max(float(np.sum(score**2) / max(np.trace(alone), 1e-300)), 1.0)

    back, score, alone, together = estimated(1.0)
    for _ in range(_TURNS - 1):
        back, score, alone, together = estimated(together)
    values, vectors = np.linalg.eigh(together * alone)
    shape = vectors * np.sqrt(values.clip(0))
    assumed = back @ back.T[:, -2:] * (together * each * centre[-1])
    root = np.concatenate([back @ score.T / np.sqrt(2), back @ shape / np.sqrt(2), assumed], axis=1)
    gradient = np.einsum("l,lsp,ls->p", share, slope, error)
    step = -back @ (back.T @ gradient)
    step[:-2] += np.linalg.lstsq((own + prior)[:-2, :-2], gradient[:-2], rcond=_SINGULAR)[0]
    return root, step


def _of_bands(fit: ZoomFit, by_parameter: np.ndarray, by_centre: np.ndarray) -> np.ndarray:
    """The covariance of a frame's coefficients, and maybe the next one, and of the centre, by the bands.

    Args:
        fit: the fit.
        by_parameter: (n, p), derivatives of the coefficients.
        by_centre: (2, q), those of the centre by the numbers that say where it is.
    """
    own = np.asarray(fit.covariance if fit.joint is None else fit.joint, float)
    terms, parameters = by_parameter.shape
    misfit, elsewhere = (np.zeros((0, 0)) if of is None else of for of in (fit.misfit, fit.off_centre))
    numbers = max(terms, len(misfit), len(elsewhere) - 2)
    slope = np.zeros((numbers + 2, len(own)))
    slope[:terms, :parameters] = by_parameter
    slope[numbers:, parameters:] = by_centre[:, : len(own) - parameters]
    unknown = np.isinf(np.diagonal(own))
    total = slope @ np.where(np.isinf(own), 0, own) @ slope.T
    total[np.diag_indices_from(total)] += np.where(slope[:, unknown].any(axis=1), np.inf, 0)
    total[: len(misfit), : len(misfit)] += misfit
    if len(elsewhere):
        at = np.r_[: len(elsewhere) - 2, numbers, numbers + 1]
        total[np.ix_(at, at)] += elsewhere
    return total


def _std_beyond(lens: ZoomLens, centre: np.ndarray, k: np.ndarray, covariance: np.ndarray) -> float:
    """The standard deviation beyond a homography, half diagonals of the image, RMS over it."""
    numbers = len(covariance) - 2
    _, rows = _over_image(lens, centre, np.pad(k, (0, numbers - len(k))), np.eye(numbers))
    if not len(rows) or np.isinf(np.diagonal(covariance)).any():
        return np.inf
    return float(np.sqrt(np.einsum("scp,pq,scq->", rows, covariance, rows).clip(0) / len(rows)))


def _over_image(
    lens: ZoomLens, centre: np.ndarray, k: np.ndarray, by_parameter: np.ndarray
) -> tuple[float, np.ndarray]:
    """How far points are moved beyond a homography, and by each parameter, (n, 2, p + 2), in the image."""
    z = (over_image(lens.image_size) - centre) / lens.scale
    at, by_point, by_all = derivatives(lens.distortion_model, z, k, by_parameter)
    rows = beyond(at, by_point, np.concatenate([(at - z)[..., None], by_all], axis=-1))
    return float(np.sqrt(np.sum(rows[..., 0] ** 2) / max(len(rows), 1))), rows[..., 1:]
