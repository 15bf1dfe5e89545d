"""The start of a fit from an earlier one of the same clip."""

import jax
import jax.numpy as jnp
import numpy as np

from ._motion_model import Model, Noise
from ._motion_problem import Asked, Given, Problem
from ._motion_stages import continued
from ._motion_start import Path

_NEAR = 0.05
"""Of log f: an earlier fit that is farther from known focal lengths is no start, as its lens is another."""

_FOLLOW, _LIKE, _WITHIN = 0.25, 0.3, 0.01
"""Share of the tracks that follow an earlier fit of their clip, at least; and how far off these may be,
over how far tracks move, or in half image diagonals."""


def begins_near(given: Given) -> bool:
    """Whether there is an earlier fit, and known focal lengths do not say that its scale is another."""
    if given.begin is None or given.focal is None or len(given.focal) != len(given.begin.focal):
        return given.begin is not None
    off = np.log(np.asarray(given.focal, float) / np.asarray(given.begin.focal))
    return bool(not np.isfinite(off).any() or abs(np.nanmedian(off)) < _NEAR)


def from_earlier(given: Given, asked: Asked, problem: Problem) -> tuple[Model, Noise]:
    """A model near the best and its noise, from an earlier fit."""
    earlier, data = given.begin, problem.data
    assert earlier is not None
    log_focal = np.log(np.asarray(earlier.focal))
    known = np.flatnonzero(np.isfinite(log_focal))
    alike = (len(log_focal), earlier.lens.image_size) == (given.tracks.frames, given.tracks.image_size)
    if not alike or not len(known):
        raise ValueError(
            "Argument begin must be an earlier fit of the same clip, but its frames are not as many or not "
            "as large as those of the tracks, or it has found no focal length."
        )
    _check_same_clip(given)
    log_focal = np.interp(np.arange(len(log_focal)), known, log_focal[known])
    size = asked.distortion_model.num_coefficients(asked.terms)
    wanted = asked.zoom.prepare(np.exp(log_focal), size), asked.distortion_model
    wanted += (None if asked.shift is None else asked.shift.prepare(np.exp(log_focal), 2),)
    lens = earlier.lens.zoom, earlier.lens.distortion_model, earlier.lens.shift
    if jax.tree.structure(lens) != jax.tree.structure(wanted) or [
        np.shape(leaf) for leaf in jax.tree.leaves(lens)
    ] != [np.shape(leaf) for leaf in jax.tree.leaves(wanted)]:
        raise ValueError(
            "Argument begin must be an earlier fit of the same models, but it has another zoom model, "
            "distortion model, shift, or number of terms."
        )
    more = (0, len(data.log_focal) - len(log_focal))
    path = Path(
        jnp.asarray(np.pad(log_focal, more, mode="edge")),
        jnp.asarray(np.pad(np.asarray(earlier.rotation), (more, (0, 0), (0, 0)), mode="edge")),
        jnp.zeros((data.structure.tracks, 3)),
    )
    return continued(
        data, path, lens, earlier.readout, Noise(earlier.noise / given.unit, jnp.asarray(jnp.nan))
    )


def _check_same_clip(given):
    """Refuse an earlier fit whose camera moves otherwise than the points of most tracks do."""
    mask, earlier = np.asarray(given.tracks.mask), given.begin
    track = np.flatnonzero(np.sum(mask, axis=1) > 1)
    ends = np.argmax(mask[track], axis=1), mask.shape[1] - 1 - np.argmax(mask[track, ::-1], axis=1)
    (first, last), (seen, there) = (
        [np.asarray(of)[track, end] for end in ends] for of in (given.tracks.frame, given.tracks.points)
    )
    focal, carried = np.asarray(earlier.focal), np.full(seen.shape, np.nan)
    for frame in np.unique(last[np.isfinite(focal[first]) & np.isfinite(focal[last])]).tolist():
        carried[last == frame] = earlier.carried(first[last == frame], seen[last == frame], frame)
    off, moved = (np.linalg.norm(of, axis=1) for of in (carried - there, there - seen))
    told = np.isfinite(off)
    if told.any():
        least, usual = np.quantile(off[told], _FOLLOW), np.median(moved[told])
        if least > max(_LIKE * usual, _WITHIN * given.tracks.scale):
            raise ValueError(
                "Argument begin must be an earlier fit of the same clip, but by it most points would be "
                f"{least:.3g} px or more from where the tracks have them, which move by {usual:.3g} px: "
                "leave it out, or give the fit of this clip."
            )
