"""How well the lines determine the parameters of a zoom model.

Covariance of the parameters from the residuals and their Jacobian, and which of them the lines do not
determine at all; work of one or two iterations of the fit, once after it.

Errors of neighbouring points on an edge are correlated, and lines that are not quite straight bend as a
whole: points are not independent, but lines are assumed to be. A line pulls at the parameters with its
score ``J_l^T r_l``, the same from its compressed rows, and the squares of the scores make the line-by-line
sandwich ``H^-1 (sum_l g_l g_l^T) H^-1``. That estimate alone is too uncertain, since a few lines decide a
parameter. So it is shrunk towards the shape for independent points, by an amount given by its own scatter
(Ledoit and Wolf 2004). The same is then done for whole photos, whose lines may err together.
docs/trust.md has the measured coverage, and that of alternatives.

The formulas are NumPy's and JAX's alike: of few lines at hand NumPy makes it, which compiles nothing.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._core.arrays import as_jax, namespace
from .._core.programs import are_few, light_program
from .._core.types import AnyArray, traced
from ..lines.base import AbstractLines
from ..models.zoom import AbstractZoom
from ._linear import triangle_of
from .energy import (
    Linearised,
    counted_frames,
    line_weights,
    linearised,
    prior_error,
    prior_jacobian,
    prior_of,
)

_ROUNDING = 64
"""Error of the corrected points without noise, in units in the last place of their mean radius."""

_TELLS = 0.01
"""A photo tells how photos scatter where noise feigns less than this part of what it says of the model."""


class KnownErrors(NamedTuple):
    """Errors of single photos whose size is known, as of their focal lengths.

    Attributes:
        scores: for each photo, the mean of the squares of the scores that they leave after the fit.
        covariance: what they add to that of the parameters.
    """

    scores: Float[Array, "frame parameter parameter"]
    covariance: Float[Array, "parameter parameter"]


class CovarianceTerms(NamedTuple):
    """What lines tell of the flattened parameters: all that their covariance is made of.

    Attributes:
        weighted: the residuals, times the root of their weights.
        jacobian: their derivatives by the parameters.
        prior: those of what a prior adds to the residuals.
        prior_error: the size of one of these, px.
        weights: of the lines, for each of their points.
        spare: the number of points beyond two for each line, in weights.
        frame: of each line.
        counted: the frames that count.
        k: the coefficients of the frames.
        feigned: what noise contributes to ``J^T J``; see `_feigned`.
    """

    weighted: Float[AnyArray, "line rows"]
    jacobian: Float[AnyArray, "line rows parameter"]
    prior: Float[AnyArray, "row parameter"]
    prior_error: Float[AnyArray, ""]
    weights: Float[AnyArray, "line"]
    spare: Float[AnyArray, ""]
    frame: Int[AnyArray, "line"]
    counted: Bool[AnyArray, "frame"]
    k: Float[AnyArray, "frame coefficients"]
    feigned: tuple[tuple[Any, Any], ...]


def covariance_terms(
    lines: AbstractLines, zoom: AbstractZoom, linear: Linearised, extra: int = 0
) -> CovarianceTerms:
    """What lines tell of the parameters of a fitted model.

    Args:
        lines: what was fitted.
        zoom: the fitted model.
        linear: `linearised` of both.
        extra: how many numbers the model gives after the coefficients.
    """
    weights, own = line_weights(lines), prior_of(zoom)
    return CovarianceTerms(
        linear.weighted,
        linear.jacobian,
        prior_jacobian(lines, zoom),
        jnp.zeros(()) if own is None else prior_error(lines, own),
        weights,
        jnp.sum(weights * (lines.counts - 2)),
        jnp.asarray(lines.frame),
        counted_frames(lines),
        linear.k,
        _feigned(lines, linear, weights, extra),
    )


def parameter_covariance(
    lines: AbstractLines,
    zoom: AbstractZoom,
    linear: Linearised,
    extra: int = 0,
    photos: bool = True,
    errors: KnownErrors | None = None,
) -> tuple[Float[Array, "parameter parameter"], Bool[Array, ""]]:
    """`covariance_of` what lines tell."""
    return covariance_of(covariance_terms(lines, zoom, linear, extra), photos, errors)


def known_covariance(lines: AbstractLines, zoom: AbstractZoom, extra: int = 0) -> Any:
    """`parameter_covariance` without the residuals, and without what is determined."""
    if are_by_numpy(lines, zoom) and (found := by_numpy(_covariance_terms(lines, zoom, extra))) is not None:
        return found[0]
    return _covariance(lines, zoom, extra)


@light_program
def _covariance_terms(lines, zoom, extra):
    return covariance_terms(lines, zoom, linearised(lines, zoom), extra)


@light_program
def _covariance(lines, zoom, extra):
    return parameter_covariance(lines, zoom, linearised(lines, zoom), extra)[0]


_MOST_PARAMETERS = 24
"""Of a model whose covariance is NumPy's: products of three matrices take their cube."""


def are_by_numpy(lines: AbstractLines, zoom: AbstractZoom) -> bool:
    """Whether the covariance is NumPy's: values are known, on the device that results are on, and few.

    Decompositions and products of small matrices are half of what there would be to compile.
    """
    if traced((lines, zoom)) or not are_few((lines, zoom)):
        return False
    number = sum(np.size(leaf) for leaf in jax.tree.leaves(zoom.parameters))
    arrays = [leaf for leaf in jax.tree.leaves((lines, zoom)) if isinstance(leaf, jax.Array)]
    usual = {jax.devices()[0]}
    return number <= _MOST_PARAMETERS and all(leaf.devices() == usual for leaf in arrays)


def by_numpy(known: CovarianceTerms) -> tuple[Array, bool] | None:
    """`covariance_of` what lines tell, by NumPy; None where a number is none."""
    known = jax.tree.map(np.asarray, known)
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(known)):
        return None
    try:
        with np.errstate(all="ignore"):
            covariance, determined = covariance_of(known)
    except np.linalg.LinAlgError:
        return None
    return as_jax(covariance.astype(known.weighted.dtype)), bool(determined)


def covariance_of(
    known: CovarianceTerms, photos: bool = True, errors: KnownErrors | None = None
) -> tuple[Any, Any]:
    """Covariance of the flattened parameters, and whether the lines determine them all.

    Were points independent, with errors of one size, it would be the sandwich of the weights w of eq. 13,
    ``sigma^2 (J^T W J)^-1 (J^T W^2 J) (J^T W J)^-1``, with sigma from the residuals and their degrees of
    freedom; `of_clusters` puts lines for points. Both are made by way of the triangle of J: the
    normal equations would square the condition number, which float32 has no room for.

    A parameter is *undetermined* where moving it changes the residuals by less than twice what noise in
    the points alone would feign: each point's error appears in the derivative by k_j, times r^(2j). (Lines
    through the centre have nothing else there, and would otherwise seem to determine k from their noise.)

    Args:
        known: what lines tell, of JAX or all of NumPy, which compiles nothing.
        photos: whether lines of one photo may err together.
        errors: what photos are known to err by; in the covariance, too.
    """
    xp: Any = namespace(*jax.tree.leaves(known))
    weighted, jacobian, prior, weights = known.weighted, known.jacobian, known.prior, known.weights
    energy = xp.sum(weighted**2)
    triangle = _triangle(jacobian, prior)
    # Columns of unit length, so that one threshold serves parameters of any size.
    size = xp.linalg.norm(triangle, axis=0)
    size = xp.where(size > 0, size, 1)
    left, values, right = xp.linalg.svd(triangle / size[None])
    good = values > 64 * xp.finfo(values.dtype).eps
    reciprocal = xp.where(good, 1 / xp.where(good, values, 1), 0)
    back = right.T * reciprocal[None]  # to the parameters that change the residuals by one unit
    # Of the directions that change them so, those in which noise would feign more than half of it.
    feigned = sum(xp.einsum("mip,mij,mjq->pq", rows, noise, rows) for rows, noise in known.feigned)
    feigned = feigned / size[:, None] / size[None]
    shares, directions = xp.linalg.eigh(back.T @ feigned @ back)
    doubtful = xp.concatenate([back @ directions, right.T], axis=1)
    doubtful = doubtful / xp.maximum(xp.linalg.norm(doubtful, axis=0), xp.finfo(size.dtype).tiny)[None]
    unknown = xp.concatenate([shares >= 0.25, ~good])
    undetermined = xp.any(unknown[None] & (xp.abs(doubtful) > 0.05), axis=1)

    inverse = back @ left.T / size[:, None]
    jacobian = jacobian @ inverse  # by parameters in which J^T W J, with the prior, is the identity
    leverage = xp.swapaxes(jacobian, 1, 2) @ jacobian
    share = weights[:, None, None] * leverage
    freedom = known.spare - xp.trace(xp.sum(share, axis=0))
    undetermined = undetermined | (freedom <= 0)  # nothing is left over to tell the noise by
    share = energy / _positive(freedom) * share
    terms = known.k.shape[1]
    scores = terms * xp.sum(weights > 0) - xp.sum(good)
    score = xp.einsum("lri,lr->li", jacobian, weighted)
    covariance = of_clusters(score, leverage, share, scores)
    if photos:
        of_photos = [_by_photo(of, known) for of in (score, leverage, share)]
        own = [(rows @ inverse, noise) for rows, noise in known.feigned]
        own = sum(xp.einsum("mip,mij,mjp->m", rows, noise, rows) for rows, noise in own)
        tells = own < _TELLS * xp.trace(of_photos[1], axis1=1, axis2=2)
        free = terms * xp.sum(tells & known.counted) - xp.sum(good)
        of_photos = [xp.where(xp.expand_dims(tells, tuple(range(1, of.ndim))), of, 0) for of in of_photos]
        of_errors = 0, xp.zeros_like(covariance)
        if errors is not None:
            left = xp.trace(inverse.T @ errors.scores @ inverse, axis1=1, axis2=2)
            of_errors = xp.sum(xp.where(tells, left, 0)), triangle @ errors.covariance @ triangle.T
        covariance = _of_whole_photos(of_photos, covariance, of_errors, free, terms)
    covariance = inverse @ covariance @ inverse.T
    if len(prior):
        # The prior draws the parameters to its mean: by how much, in the mean over what it expects.
        half = known.prior_error * inverse @ (prior @ inverse).T
        covariance = covariance + half @ half.T
    either = undetermined[:, None] | undetermined[None]
    infinite = xp.where(xp.eye(size.shape[0], dtype=bool), xp.inf, 0)
    return xp.where(either, infinite, covariance), ~xp.any(undetermined)


def _triangle(*parts: Any) -> Any:
    """R of the QR of rows in several arrays.

    NumPy's in blocks, and then of their triangles: LAPACK starts threads for a long table, and waits for
    them where other processes are busy.
    """
    if namespace(*parts) is jnp:
        return triangle_of(list(parts))
    rows, columns = np.concatenate([part.reshape(-1, part.shape[-1]) for part in parts]), parts[0].shape[-1]
    while len(rows) != columns:
        block = min(max(4 * columns, 64), max(len(rows), columns))
        padded = np.pad(rows, ((0, -len(rows) % block), (0, 0)))
        triangles: Any = np.linalg.qr(padded.reshape(-1, block, columns), mode="r")
        rows = triangles.reshape(-1, columns)
    return rows


def _by_photo(values, known):
    """The sums over the lines of each photo."""
    frames = len(known.counted)
    if namespace(values) is jnp:
        return jax.ops.segment_sum(values, known.frame, frames)
    order = np.argsort(known.frame, kind="stable")
    frame = known.frame[order]
    starts = np.flatnonzero(np.diff(frame, prepend=-1))
    sums = np.zeros((frames, *values.shape[1:]), values.dtype)
    sums[frame[starts]] = np.add.reduceat(values.take(order, axis=0), starts, axis=0)
    return sums


def of_clusters(score, leverage, share, scores):
    """The covariance of parameters in which the fit's Gauss-Newton matrix is the identity.

    Clusters of points, here called lines, err each by itself. `share` is what each would contribute were
    its points independent. Their sum, A, is compared with the sum S of the squares of the scores. A line
    draws the fit to itself: its score is first divided by ``sqrt(1 - h)``, h its leverage along the score
    (Bell and McCaffrey 2002 have a matrix there). The size of S is kept, ``c = tr S / tr A``: n points of a
    line count as n/c independent ones. Its shape is shrunk to that of A by the part of their difference
    that the scatter of the scores explains.

    c has nu degrees of freedom, few where a few long lines at the border decide all, and at most `scores`,
    the number of independent scores less the parameters. Its own uncertainty is added, ``2 max(c, 1)/nu``,
    so that two standard deviations keep their meaning. With none left, A is all that is known.
    """
    xp = namespace(score)
    length = xp.sum(score**2, axis=1)
    along = xp.sum((leverage @ score[..., None])[..., 0] * score, axis=1) / _positive(length)
    kept = xp.maximum(1 - along, 0.01)  # a line that alone decides a parameter says nothing of its noise
    score, length = score / xp.sqrt(kept)[:, None], length / kept
    total, independent = score.T @ score, xp.sum(share, axis=0)
    c = xp.sum(length) / _positive(xp.trace(independent))
    apart = xp.sum((total - c * independent) ** 2)
    telling = xp.sum(length > xp.finfo(length.dtype).eps * xp.sum(length))  # scores beyond rounding
    by_chance = xp.sum(length**2) - xp.sum(total**2) / _positive(telling)
    shrink = xp.clip(by_chance / _positive(apart), 0, 1)
    shape = shrink * independent + (1 - shrink) * total / _positive(c)
    nu = xp.minimum(xp.trace(independent) ** 2 / _positive(xp.sum(share**2)), scores)
    size = c + 2 * xp.maximum(c, 1) / _positive(nu)
    return xp.where((nu > 0) & (c > 0), size * shape, independent)


def _of_whole_photos(of_photos, by_line, known_errors, free, terms):
    """The covariance where the lines of a photo may err together, in the parameters of `of_clusters`.

    A bent board bends all lines of a photo alike, and a wrong focal length or a model that does not follow
    the lens does the same. Were the lines independent, with the covariance C = `by_line`, split into A_m
    over the photos as `share` is, the scores g_m of the photos would have in the mean

        E sum_m |g_m|^2 = sum_m tr(A_m - 2 H_m A_m + H_m C H_m),    H_m = J_m^T J_m,

    since the fit takes ``H_m sum_k g_k`` from each. This is exact whatever the leverages, so that it serves
    few photos too. `known_errors` of single photos have their mean of these squares, and their covariance:
    both are added. The ratio phi of what is found to that enlarges C where it is above 1. It has `free`
    degrees of freedom, the coefficients that the photos would have by themselves, `terms` each, less the
    parameters; for these few, ``2 (phi - 1)/free`` is added. The shape is that of C, shrunk less towards it
    the more photos are left over, `free` by `terms`, as for lines.

    Photos whose lines all lie near the centre are not counted: noise makes most of what little they say of
    the model, of their derivatives as well as of their residuals, whose product is then no mean of zero.
    Where the others determine the model by themselves, all that is left over would be in those.
    """
    xp, (score, leverage, share) = namespace(*of_photos), of_photos
    length = xp.sum(score**2, axis=1)
    own = share * (xp.trace(by_line) / _positive(xp.trace(xp.sum(share, axis=0))))
    taken = xp.einsum("mij,mji->", leverage, own)
    left = xp.trace(xp.sum(own, axis=0)) - 2 * taken
    left = left + xp.sum(leverage @ by_line * xp.swapaxes(leverage, 1, 2)) + known_errors[0]
    ratio = xp.sum(length) / _positive(left)
    known = (free > 0) & (left > 0) & (ratio > 1)
    ratio = xp.where(known, ratio, 1)
    total = score.T @ score
    total = total * (ratio * xp.trace(by_line) / _positive(xp.trace(total)))
    apart = xp.sum((total - ratio * by_line) ** 2)
    by_chance = terms * (xp.sum(total**2) + xp.trace(total) ** 2) / _positive(free)
    shrink = xp.clip(by_chance / _positive(apart), 0, 1)
    shape = shrink * by_line + (1 - shrink) * total / ratio
    enlarged = (ratio + 2 * (ratio - 1) / _positive(free)) * (shape + known_errors[1])
    return xp.where(known, enlarged, by_line + known_errors[1])


def _positive(value):
    """A divisor: the value, or 1 where it is not positive."""
    return namespace(value).where(value > 0, value, 1)


def _feigned(lines, linear, weights, extra):
    """What the points' own noise contributes to ``J^T J`` in the mean, of each frame.

    In two parts, of radial and of tangential coefficients: their derivatives by the parameters, and noise.
    """
    own = linear.k.shape[1] - extra

    def along(by_one):
        return jax.jvp(lines.in_powers, (linear.k[:, :own],), (by_one[:, :own],))

    (k, _), (by_parameter, tangential) = jax.vmap(along, 2, ((None, None), (2, 2)))(linear.by_parameter)
    energy, terms = jnp.sum(linear.weighted**2), k.shape[1]
    order = jnp.arange(terms + 1)
    moments = lines.radial_moments(2 * terms)[:, order[:, None] + order[None]] * weights[:, None, None]
    moments = jax.ops.segment_sum(moments, lines.frame, lines.focal.shape[0])
    # The residuals have the noise of the corrected image, shrunk by L: divide by its mean square.
    kappa = jnp.concatenate([jnp.ones_like(k[:, :1]), k], axis=1)
    variance_in_image = energy / jnp.einsum("mi,mij,mj->", kappa, moments, kappa)
    # Points without noise have that of their rounding, which sums over a line multiply.
    mean = jnp.sum(moments, axis=0)
    radius = lines.scale * jnp.sqrt(mean[1, 1] / _positive(mean[0, 0]))
    rounding = _ROUNDING * jnp.finfo(moments.dtype).eps * radius
    variance_in_image = jnp.maximum(variance_in_image, rounding**2)
    # Decentering moves points by squares of x and y: noise enters its derivative by matrices whose mean
    # square over all directions is 12 r^2.
    decentred = 12 * moments[:, 0, 1, None, None] * jnp.eye(tangential.shape[1])[None]
    return (
        (by_parameter, variance_in_image * moments[:, 1:, 1:]),
        (tangential, variance_in_image * decentred),
    )
