"""Whether near points move otherwise than far ones: the entrance pupil off the axis of rotation.

A pupil at e before the axis sees a point at the distance D as if the camera were nearer by e: the point is
``e/D / cos`` of its distance from the centre farther out. Of that, what is the same for all points looks
like a lens, and no track tells it. The rest differs from track to track. So the slope of each track's
residuals along that pattern is taken, freed of the track's own ray and of what depends smoothly on where
in the image and in the zoom the track lies, as a wrong lens would. Its variance beyond that of noise is
that of e/D. The same pattern turned by 90 degrees is of no pupil: things that move and points that drift
give both alike, and what it has is subtracted.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ._columns import Unknowns
from ._motion_model import Data, Model, Noise, moved, units_of
from ._motion_rows import residuals_of
from ._views import FAR

_WILD = 5.0  # standard deviations, of a slope that is no chance: of a thing that moves
_FEWEST = 20  # tracks
_ROUNDS = 8
_SKEWNESS = 0.8  # of one over distances, where these are spread evenly over some range
_TAIL = 3.0  # standard deviations: beyond, a slope counts no more for which side the tail is on

SURE = 3.0
"""Standard deviations of chance from which a parallax is seen."""

NEARLY_NONE = 1e-4
"""e/D, the standard deviation over tracks below which nothing comes of a parallax."""

MOST = 0.1
"""e/D, the standard deviation over tracks from which it is none, as points would be as near as the pupil.
Tracks of a camera that does not turn tell no parallax, and what is off in them makes one of any size."""


def is_seen(parallax: float | Array, score: float | Array) -> bool:
    """Whether the tracks tell a parallax that is worth a word."""
    return bool((score > SURE) & (parallax > NEARLY_NONE))


class _Slopes(NamedTuple):
    """Of each track."""

    value: Float[Array, "track"]  # in its standard deviations by noise
    weight: Float[Array, "track"]  # 1 over that standard deviation


class Spread(NamedTuple):
    """Of e/D, over the tracks."""

    std: Float[Array, ""]
    side: Float[Array, ""]  # how likely e is above 0, less how likely below it


def parallax_of(
    data: Data, model: Model, noise: Noise, inlier: Bool[Array, "view"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Variance over the tracks of e/D, and the standard deviation of that; NaN with few tracks.

    Args:
        data: the tracks.
        model: fitted to them.
        noise: of the residuals.
        inlier: views that count.
    """
    views, turned = _patterns(data, model, noise, inlier)
    basis = _smooth(data, model, inlier)

    def variance(views):
        slopes = _rough(_slopes(views, noise, data.structure), basis)
        usual = (slopes.weight > 0) & (slopes.value**2 < _WILD**2)
        weight = jnp.where(usual, slopes.weight**2, 0)
        total, more = jnp.sum(weight**2), jnp.where(usual, slopes.value**2 - 1, 0)
        excess = jnp.sum(weight * more) / total
        scatter = jnp.sum((weight * (more - excess * weight)) ** 2) / total**2
        return excess, scatter, jnp.sum(usual)

    (along, one, count), (across, two, _) = variance(views), variance(turned)
    few = count < _FEWEST
    found, std = along - jnp.maximum(across, 0), jnp.sqrt(one + two)
    return jnp.where(few, jnp.nan, found), jnp.where(few, jnp.nan, std)


@eqx.filter_jit
def spread_of(
    data: Data, model: Model, noise: Noise, missed: Float[Array, "view"], least: Float[Array, ""]
) -> Spread:
    """How e/D varies over the tracks where that is seen; at least as much as the test says.

    The test weighs tracks, and drops wild ones, as if there were no parallax. Here both are by how much
    slopes vary with noise and parallax, from round to round.

    Near points have a long tail of large e/D. The third Hermite polynomial of slopes tells on which side
    it is: its mean is their skewness, and its variance is 6.

    Args:
        data: the tracks.
        model: fitted to them without levers.
        noise: of the residuals.
        missed: sizes of the residuals, px, times the roots of their weights.
        least: the test's standard deviation.
    """
    inlier = data.there & (missed < FAR * noise.points)
    views, turned = _patterns(data, model, noise, inlier)
    both = [_slopes(of, noise, data.structure) for of in (views, turned)]
    basis = _smooth(data, model, inlier)

    def scaled(slopes, variance):
        total = 1 + variance * slopes.weight**2
        value, weight = _rough(_Slopes(*(of / jnp.sqrt(total) for of in slopes)), basis)
        return value, jnp.where(value**2 < _WILD**2, weight**2, 0), total

    def excess(slopes, variance):
        value, weight, total = scaled(slopes, variance)
        return jnp.sum(weight * (value**2 - 1 / total)) / jnp.sum(weight**2)

    def again(variance, _):
        along, across = (excess(slopes, variance) for slopes in both)
        return jnp.maximum(along - jnp.maximum(across, 0), least**2), None

    variance, _ = jax.lax.scan(again, least**2, None, length=_ROUNDS)
    value, weight, _ = scaled(both[0], variance)
    value = jnp.clip(value, -_TAIL, _TAIL)
    skewness = _SKEWNESS * (variance * weight) ** 1.5
    return Spread(jnp.sqrt(variance), jnp.tanh(jnp.sum(skewness * (value**3 - 3 * value)) / 6))


def _patterns(data, model, noise, inlier):
    """Residuals, how they change with levers, and with the numbers of rays; and the same turned."""
    none = jnp.zeros(data.structure.tracks)
    missed, pattern = jax.jvp(lambda lever: residuals_of(data, model, lever), (none,), (none + 1,))
    turned = jnp.stack([-pattern[:, 1], pattern[:, 0]], axis=1)
    own = _by_rays(data, model, noise)
    there = inlier[:, None]
    return [[jnp.where(there, of, 0) for of in (missed, to, *own)] for to in (pattern, turned)]


def _by_rays(data, model, noise):
    """How views move with the two numbers of their rays."""
    units = units_of(data, model, noise)
    still = jax.tree.map(jnp.zeros_like, units)

    def seen(rays):
        return residuals_of(data, moved(model, Unknowns(still.frames, rays, still.lens)))

    along = [jnp.zeros_like(units.rays).at[:, axis].set(units.rays[:, axis]) for axis in (0, 1)]
    return [jax.jvp(seen, (still.rays,), (direction,))[1] for direction in along]


def _slopes(views, noise, structure):
    """Of residuals along a pattern, where rays are free: a Gauss-Newton step of each track."""
    missed, pattern, first, second = views
    tracks, track = structure.tracks, structure.track

    def dot(one, other):
        return jax.ops.segment_sum(jnp.sum(one * other, axis=1), track, tracks)

    def without(of, length, ray):
        factor = jnp.where(length > 0, dot(of, ray) / jnp.where(length > 0, length, 1), 0)
        return of - factor[track][:, None] * ray

    second = without(second, dot(first, first), first)
    for ray in (first, second):
        pattern = without(pattern, dot(ray, ray), ray)
        missed = without(missed, dot(ray, ray), ray)
    weight = jnp.sqrt(dot(pattern, pattern)) / noise.points
    value = -dot(pattern, missed) / jnp.where(weight > 0, weight, 1) / noise.points**2
    return _Slopes(jnp.where(weight > 0, value, 0), weight)


def _smooth(data, model, inlier):
    """Functions of where in the image and in the zoom a track lies, (track, function)."""
    track, tracks = data.structure.track, data.structure.tracks

    def mean(of):
        count = jax.ops.segment_sum(1.0 * inlier, track, tracks)
        return jax.ops.segment_sum(jnp.where(inlier, of, 0), track, tracks) / jnp.maximum(count, 1)

    radius = mean(jnp.sum((data.points / data.scale) ** 2, axis=1))
    focal = jnp.exp(model.path.log_focal)[data.structure.frame]
    u = mean(jnp.min(focal, where=inlier, initial=jnp.inf) / focal)
    return jnp.stack([radius**i * u**j for i in range(3) for j in range(3)], axis=1)


def _rough(slopes, basis):
    """Slopes without what the functions explain."""
    usual = jnp.where(slopes.value**2 < _WILD**2, slopes.weight, 0)
    rows = usual[:, None] * basis
    normal = rows.T @ rows
    right = rows.T @ jnp.where(usual > 0, slopes.value, 0)
    found = jnp.linalg.solve(normal + 1e-9 * jnp.trace(normal) * jnp.eye(len(normal)), right)
    return slopes._replace(value=slopes.value - slopes.weight * (basis @ found))
