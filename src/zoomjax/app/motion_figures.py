"""Figures of a calibration from motion: focal lengths of all frames, and distances of views and lines."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ..fit.energy import line_squares
from ..fit.image_metric import in_image
from ..fit.motion import MotionFit
from ..fit.same_camera import placed_as
from ..lines.lines import Lines
from ..tracks.tracks import Tracks
from ..trust.bands import std_of
from .coefficients import finite


def all_focals(fit: MotionFit) -> tuple[Float[np.ndarray, "frame"], Float[np.ndarray, "frame"]]:
    """Focal lengths of all frames and their standard deviations, px.

    Between frames of which f is known 1/f is interpolated. The farther from these, the less is that known:
    f may have changed as fast as in the fastest tenth of the frames.
    """
    focal, std = (np.asarray(values) for values in (fit.focal, fit.focal_std))
    known = np.flatnonzero(np.isfinite(focal))
    every = np.arange(len(focal))
    place = np.searchsorted(known, every)
    beside = known[np.clip([place - 1, place], 0, len(known) - 1)]
    far = np.min(np.abs(beside - every), axis=0)
    changes = np.abs(np.diff(focal))
    changes = changes[np.isfinite(changes)]
    fast = np.quantile(changes, 0.9) if len(changes) else 0.0
    return 1 / np.interp(every, known, 1 / focal[known]), np.hypot(
        np.interp(every, known, std[known]), far * fast
    )


def turned(fit: MotionFit) -> tuple[float, float]:
    """How far the camera panned and tilted, degrees, in the scene that most frames show."""
    known = np.isfinite(np.asarray(fit.focal)) & (np.asarray(fit.scene) >= 0)
    if not known.any():
        return 0.0, 0.0
    scene = np.asarray(fit.scene)[known]
    angles = np.asarray(fit.pan_and_tilt)[known][scene == np.argmax(np.bincount(scene))]
    pan, tilt = np.ptp(np.unwrap(angles, period=360, axis=0), axis=0).tolist()
    return pan, tilt


def rms_uncorrected(fit: MotionFit, tracks: Tracks, follows: Bool[np.ndarray, "view"]) -> float:
    """RMS distance, px, of views from where the path alone puts their tracks, without a correction.

    Args:
        fit: the lens and the path.
        tracks: the tracks.
        follows: which of their views follow the model, and count, by their weights.
    """
    mask = np.asarray(tracks.mask)
    track, moment = np.nonzero(mask)[0], np.asarray(tracks.frame)[mask]
    focal = np.asarray(fit.focal)[moment]
    counts = follows & np.isfinite(focal)
    track, moment, focal = track[counts], moment[counts], focal[counts]
    points = np.asarray(tracks.points, float)[mask][counts]
    lens, turn = fit.lens, np.asarray(fit.rotation)[moment]
    centre = np.broadcast_to(jax.vmap(lens.centre_at)(jnp.asarray(focal)), points.shape)
    ahead = np.column_stack([(points - centre) / focal[:, None], np.ones(len(points))])
    rays = np.einsum("vij,vi->vj", turn, ahead / np.linalg.norm(ahead, axis=1, keepdims=True))
    total = np.zeros((len(mask), 3))
    np.add.at(total, track, rays)
    seen = np.einsum("vij,vj->vi", turn, total[track])
    missed = centre + focal[:, None] * seen[:, :2] / seen[:, 2:] - points
    weight = tracks.view_weights()
    weight = None if weight is None else weight[counts]
    return float(np.sqrt(np.average(np.sum(missed**2, axis=1), weights=weight)))


def line_rms(fit: MotionFit, lines: Lines) -> Float[np.ndarray, "line"]:
    """RMS distance of each line's points from straight under the lens, px of the image."""
    placed = placed_as(fit.lens, in_image(lines))
    return np.sqrt(np.asarray(line_squares(placed, fit.lens.zoom)))


def centre_summary(fit: MotionFit) -> dict[str, Any]:
    """The centre of distortion in the middle of the zoom, and at both of its ends, px."""
    lens = fit.lens
    low, high = (float(f) for f in lens.focal_range)
    middle = float(np.sqrt(low * high))
    places = [np.asarray(lens.centre_at(f)).tolist() for f in (low, middle, high)]
    x, y = places[1]
    if lens.shift is None:
        sentence = (
            f"The centre of distortion is taken as given: the middle of the image, ({x:.1f}, {y:.1f}) px."
        )
        return {"x": x, "y": y, "std": None, "how": "image", "sentence": sentence}
    std = finite(np.asarray(std_of(fit.fit, lambda lens: lens.centre_at(middle))))
    sentence = (
        f"The centre of distortion was fitted, and moves along the zoom: from ({places[0][0]:.1f}, "
        f"{places[0][1]:.1f}) px at f = {low:.0f} px to ({places[2][0]:.1f}, {places[2][1]:.1f}) px at f = "
        f"{high:.0f} px."
    )
    return {"x": x, "y": y, "std": std, "how": "fitted", "sentence": sentence}


def frame_rows(fit: MotionFit, tracks: Tracks, times: np.ndarray) -> list[dict[str, Any]]:
    """Each frame: its number in the file, time, focal length, direction, and how well its views follow.

    Focal lengths are px, angles degrees. None stands for what is not known, as of frames without views.
    """
    angles = np.asarray(fit.pan_and_tilt)
    seen = np.isfinite(np.asarray(fit.focal))
    moment = np.asarray(tracks.frame)[np.asarray(tracks.mask)]
    columns = {
        "frame": times[:, 0].astype(int).tolist(),
        "seconds": finite(times[:, 1]),
        "focal": finite(np.asarray(fit.focal)),
        "focal_sigma": finite(np.asarray(fit.focal_std)),
        "pan": finite(np.where(seen, angles[:, 0], np.nan)),
        "tilt": finite(np.where(seen, angles[:, 1], np.nan)),
        "shot": np.asarray(fit.shot).tolist(),
        "views": np.bincount(moment, minlength=tracks.frames).tolist(),
        "rms_zoom": finite(np.asarray(fit.fit.frame_rms)),
    }
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
