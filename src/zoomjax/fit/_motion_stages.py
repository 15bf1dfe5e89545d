"""The stages of `fit_motion`: from a start to the fit, and what is known about it."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from .._core.memory import give_back
from ._columns import Unknowns
from ._motion_estimate import AS_GOOD, described
from ._motion_levers import guessed_levers
from ._motion_model import Model, Noise, Speed, Stage, moved, pinned, speed_of, units_of
from ._motion_parallax import MOST, is_seen, spread_of
from ._motion_repeated import groups_of, repeated
from ._motion_rows import (
    averaged,
    columns_of,
    line_residuals_of,
    line_squares_of,
    residuals_of,
    rows_of,
)
from ._motion_start import disagreement
from ._normal_solver import damped_solver
from ._schur import Schur
from ._views import EXACT, FAR, MEDIAN_OF_SIZE, core_median
from .losses import CAUCHY
from .result import RESULTS

STAGES = (
    Stage(0.3, 0.01, 0.05, 4.0, change=1.0, damping=1e-3, own=0.05, fresh=1.0),
    Stage(1.0, 0.05, 1.0, 1.0, change=3.0, damping=1e-4, own=0.05),
    Stage(1.0, 0.05, 1.0, 1.0, change=0.01, damping=1e-7, own=0.05),
)
"""They widen the prior of the lens and narrow the loss; the last is repeated until it changes nothing."""

_GLANCE = 0.1
"""Of the noise: a step that moves views by less, in the mean, does not make a bad try the best."""

_HOPELESS = 2.0
"""Times the noise of the best try, and after a glance: what has more will not become the best."""

_MOST_REPEATS = 12

_SAME = 0.99  # of the noise before a stage: one that leaves less was not the last

_PART = 150
"""Frames of a part of a long clip. More of them make no change larger, nor an error."""

_EVEN = 0.25
"""Power by which changes of a frame's views are averaged: the less it is, the less do single ones count."""

_SETTLED = 3.0
"""Change of the residuals over a whole stage, in all and in units of the noise, that is as good as none."""

_STILL = 1.0
"""Such a change over a stage that was the last: as much as a standard deviation of the estimate."""

_MOST_STEPS = 30  # of a stage

_MOST_COUNTS = 4

_FREE = 10.0  # standard deviation of a frame's log f, beside the common factor, of which nothing is said


def begun(data, paths, spreads, zoom, shift, distortion_model, terms):
    """A model near the best and its noise, after stages whose program is the same.

    The first stage goes from all starts, from the first one to its end, and from others as long as there
    is hope. The one that most views follow best goes on.

    Args:
        data: tracks and lines.
        paths, spreads: starts, and the medians of their residuals, px.
        zoom, shift, distortion_model, terms: as for `fit_motion`.
    """
    tried: list[Any] = []
    glance = STAGES[0]._replace(change=_GLANCE * np.sqrt(np.sum(data.there) / _parts(data)))
    for path, spread in zip(_each(paths, len(spreads)), spreads, strict=True):
        focal = np.exp(np.asarray(path.log_focal))
        prepared = None if shift is None else shift.prepare(focal, 2)
        nothing = Speed(*2 * (jnp.zeros((len(focal), 4)),))
        prepared_zoom = zoom.prepare(focal, distortion_model.num_coefficients(terms))
        model = Model(path, prepared_zoom, prepared, data.readout[0], nothing, distortion_model)
        noise = Noise(spread / MEDIAN_OF_SIZE, jnp.asarray(jnp.nan)).wider(STAGES[0].wider)
        if not tried:
            tried.append(_solved(data, *_arrays((model, noise, STAGES[0]))))
            continue
        found = _solved(data, *_arrays((model, noise, glance)))
        if found[1].points < _HOPELESS * min(noise.points for _, noise, *_ in tried):
            found = _solved(data, *_arrays((found[0], noise, STAGES[0]._replace(fresh=0.0))))
        tried.append(found)
    model, noise, *_ = _best(tried, data)
    model, noise, *_ = _solved(data, *_arrays((model, noise.wider(STAGES[1].wider), STAGES[1])))
    return model, noise


_averaged = eqx.filter_jit(averaged)


def with_all(few, data, model, noise):
    """A model fitted to some of the tracks, and its noise, with rays of all of them."""
    model, noise, *_ = settled(few, model, noise)
    give_back()  # here and below: what compiling took is not there beside what a long clip takes
    rays = jnp.zeros((data.structure.tracks, 3))
    model = eqx.tree_at(lambda m: m.path.rays, model, rays)
    return eqx.tree_at(lambda m: m.path.rays, model, _averaged(data, model)), noise


def continued(data, path, lens, readout, noise):
    """A model near the best and its noise, from the path and the lens of an earlier fit.

    Where shots have been joined since, their views disagree by more than noise: the loss is wide at first.

    Args:
        data: tracks and lines.
        path: that of the earlier fit, of any rays.
        lens: its zoom model, its distortion model, and the zoom model of its centre's offset.
        readout, noise: those of the earlier fit.
    """
    zoom, distortion_model, shift = lens
    still = Speed(*2 * (jnp.zeros((len(path.log_focal), 4)),))
    model = Model(path, zoom, shift, readout, still, distortion_model)
    wide = noise.wider(STAGES[0].wider)
    model, noise, *_ = _solved(data, *_arrays((model, wide, STAGES[1]._replace(fresh=1.0))))
    return model, noise


def refitted(data, model, noise):
    """The model of least energy of a part of the data, by the programs of all of it.

    Args:
        data: of which fewer views are there.
        model, noise: fitted to all.
    """
    wide = _arrays((model, noise.wider(STAGES[0].wider), STAGES[1]))
    model, noise, *_ = _solved(data, *wide)
    return settled(data, model, noise)[0]


def in_stages(data, model, noise, scene, linked):
    """The last stage, until nothing changes, and what is known about the fit.

    Args:
        data: tracks and lines.
        model, noise: of `begun`.
        scene: number of each frame's scene.
        linked: of each frame, the number of what tracks link; -1 for those without views.

    Returns:
        The parts of a `MotionFit` by name, the sizes of the residuals of all views, times the roots of
        their weights, how groups pull at the lens, the model, and the noise that residuals were weighted
        by last.
    """
    model, noise, weighted_by, result, steps = settled(data, model, noise)
    for _ in range(_MOST_COUNTS if data.lines is not None else 0):
        group = groups_of(data, model, scene)
        more = repeated(data, model, *_arrays((noise, STAGES[-1])), group=jnp.asarray(group))
        if 1 / AS_GOOD < more < AS_GOOD or (more <= 1 and noise.repeated == 1):
            break
        noise = noise._replace(repeated=jnp.maximum(noise.repeated * more, 1.0))
        model, noise, weighted_by, result, steps = settled(data, model, noise)
    free = _arrays(STAGES[-1]._replace(own=_FREE))
    linked = jnp.asarray(np.pad(np.maximum(linked, 0), (0, len(data.log_focal) - len(linked))))
    give_back()
    parts, missed, pulls = described(data, model, noise, free, result, steps, linked)
    open_scale = bool(parts["fit"].result == RESULTS.undetermined)  # then the lens is, and looks like one
    seen = not open_scale and is_seen(parts["parallax"], parts["parallax_score"])
    spread = spread_of(data, model, _arrays(noise), missed, parts["parallax"]) if seen else None
    if spread is not None and spread.std < MOST:
        model = dataclasses.replace(model, levers=guessed_levers(spread, data.structure.tracks))
        model, noise, weighted_by, result, steps = settled(data, model, noise)
        again, missed, pulls = described(data, model, noise, free, result, steps, linked)
        parts = parts | again
    return parts, missed, pulls, *_arrays((model, weighted_by))


def _best(tried, data):
    """The one of `_solved`'s that most views follow best: what has the least noise may be of few views."""
    noises = [np.nan_to_num(noise.points, nan=np.inf) for _, noise, *_ in tried]
    sizes = [jnp.where(data.there, size, jnp.nan) for *_, size in tried]
    weight = None if data.root is None else data.root**2
    costs = [float(disagreement(size, CAUCHY * min(noises), weight)) for size in sizes]
    return tried[int(np.argmin(np.nan_to_num(costs, nan=np.inf)))]


def settled(data, model, noise):
    """The last stage until it changes nothing: the model, its noise, that before, the status, the steps.

    Where little tells the scale of f, the way to the minimum is long and bent, and each step short.
    """
    turns = 0
    while True:
        weighted_by = noise.wider(STAGES[-1].wider)
        model, noise, result, steps, change, _ = _solved(data, *_arrays((model, weighted_by, STAGES[-1])))
        same = noise.points > _SAME * weighted_by.points
        successful = result == RESULTS.successful
        turns += 1
        if turns == _MOST_REPEATS and successful and not change < _SETTLED:
            result = RESULTS.nonlinear_max_steps_reached
        if turns == _MOST_REPEATS or (successful and same and change < _STILL):
            return model, noise, weighted_by, result, steps


def _each(paths, number):
    """The first paths in a stack."""
    return [jax.tree.map(lambda leaf, place=place: leaf[place], paths) for place in range(number)]


def _arrays(tree):
    """Numbers that the compiled program takes, and is not compiled for, whatever they come from."""
    return jax.tree.map(
        lambda leaf: jnp.asarray(leaf, jnp.float64) if eqx.is_inexact_array_like(leaf) else leaf, tree
    )


@eqx.filter_jit
def _solved(data, model, noise, stage):
    """The path and the lens of least energy, the noise, the solver's status, its steps, and two more.

    They are the change of the residuals, in all and in units of the noise, and the size of each, px, times
    the root of its weight.

    A stage whose steps are spent is successful if all of them moved the residuals by less than their noise
    does: with heavy tails the last steps are many and small.
    """
    model = eqx.tree_at(lambda m: m.speed, model, speed_of(model.path, data.neighbours))
    rays = jnp.where(stage.fresh > 0, averaged(data, model), model.path.rays)
    model = eqx.tree_at(lambda m: m.path.rays, model, rays)
    of_lines = stage.wider * _line_noise(data, model)
    noise = noise._replace(lines=jnp.where(jnp.isnan(noise.lines), of_lines, noise.lines))
    first = residuals_of(data, model)
    data = pinned(data, first, noise)
    units, args = units_of(data, model, noise), (data, model, noise, stage)
    steps = Schur(data.structure, eqx.Partial(columns_of, args), eqx.Partial(rows_of, args=args))
    solution = optx.least_squares(
        jax.checkpoint(rows_of),  # what derivatives need is made again: it is much
        damped_solver(steps, Unknowns, stage.change, stage.damping, eqx.Partial(_size_of_change, data)),
        jax.tree.map(jnp.zeros_like, units),
        args=args,
        max_steps=_MOST_STEPS,
        throw=False,
    )
    model = moved(model, jax.tree.map(jnp.multiply, solution.value, units))
    views = residuals_of(data, model)
    size = jnp.linalg.norm(views, axis=-1)
    near = (size < FAR * noise.points)[:, None]
    change = _size_of_views(data, jnp.where(near, views - first, 0)) / noise.points
    change = change / jnp.sqrt(_parts(data))
    if data.root is None or data.redundant is None:
        points = core_median(size, data.there) / MEDIAN_OF_SIZE
    else:
        counted = data.root**2 * data.redundant
        points = core_median(size / jnp.sqrt(data.redundant), data.there, counted) / MEDIAN_OF_SIZE
    rays = model.path.rays / jnp.linalg.norm(model.path.rays, axis=1, keepdims=True)
    model = eqx.tree_at(lambda m: m.path.rays, model, rays)
    noise = Noise(jnp.maximum(points, EXACT), _line_noise(data, model), noise.repeated)
    spent = solution.result == optx.RESULTS.nonlinear_max_steps_reached
    good: Any = RESULTS.successful
    result = RESULTS.where((change < _SETTLED) & spent, good, RESULTS.promote(solution.result))
    return model, noise, result, solution.stats["num_steps"], change, size


def _size_of_change(data, rows):
    """How much residuals change in all: the root of the sum of squares, but for `_size_of_views`.

    In a long clip it is that of a part in the mean: the way to the minimum ends where each part's would.
    """
    others = optx.two_norm(rows._replace(views=jnp.zeros(0)))
    return jnp.hypot(_size_of_views(data, rows.views), others) / jnp.sqrt(_parts(data))


def _parts(data):
    """How many clips of a common length a clip is as long as; at least 1."""
    return max(len(data.log_focal) / _PART, 1.0)


def _size_of_views(data, change):
    """The root of the sum of squares that changes of views have, if those of each frame are alike.

    What moves all views of a frame counts as it is. A ray moves one view of each, and counts nothing: where
    its views disagree, the loss has it wander for dozens of steps, and nothing else moves.
    """
    squared = jnp.where(data.there, jnp.sum(change**2, axis=-1), 0)
    both = jnp.stack([squared ** (_EVEN / 2), 1.0 * data.there], axis=1)
    total, count = jax.ops.segment_sum(both, data.structure.frame, len(data.log_focal)).T
    mean = (total / jnp.maximum(count, 1)) ** (1 / _EVEN)
    return jnp.sqrt(jnp.sum(count * mean**2))


def _line_noise(data, model):
    """The median of the RMS distances of lines, px; 1 where there are none."""
    squares = line_squares_of(data, line_residuals_of(data, model))
    return jnp.maximum(jnp.sqrt(jnp.nanmedian(squares)), EXACT) if len(squares) else jnp.ones(())
