"""The result of `fit_motion`: the lens and the path of a camera that turns and zooms."""

from typing import Any, NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._core.types import AnyArray
from ..models.lens import ZoomLens
from .result import RESULTS, ZoomFit, failed

_FAILED = "The fit failed: turn and zoom farther, or fit fewer coefficients about the image's centre."

_UNSETTLED = "It did not settle within its steps."

_FEW_POINTS = 512
"""That are carried at a time, at least: others pad, so that programs are compiled for few numbers."""


class MotionFit(eqx.Module):
    """The lens and the path of a camera that turns and zooms.

    Attributes:
        fit: the lens, with focal lengths in px, and its uncertainty. `ZoomFit.rms` is of the distances
            between views and where the model puts them, px of the image, without those that it takes for
            mistakes, and weighted as the views are; `ZoomFit.joint` includes the centre. Its result
            `undetermined` says that the tracks do not determine the scale of the focal lengths, as where
            the camera zooms and does not turn: only their ratios are known then, and of the distortion only
            what lines tell.
        focal: focal length of each frame, px; NaN for a frame without tracks.
        focal_std: its standard deviation, px. Nearly all of it is a factor common to all frames.
        covariance: of the zoom model's parameters, of those of the centre's offset, of the readout, and of
            the logarithm of that factor: that of the frame whose views follow best, or, where all focal
            lengths are known beforehand, whose f is known best.
        rotation: of each frame, from the scene to the camera, whose axes are x right, y down and z
            forward. That of the first frame of each scene is the identity.
        shot: number of the shot that each frame belongs to, from 0: a new one begins with each cut; -1 for
            a frame without tracks.
        scene: number of the scene of each frame, from 0; -1 for a frame without tracks. Shots are of one
            scene if tracks go from one to the other, or if `begin` of `fit_motion` has them in one. How
            the camera turned between scenes is not known.
        rays: direction of each track in the scene, of length 1; NaN where no two of its views have a weight
            above 0.
        residual: distance between each view and where the model puts it, px; NaN for padding and for views
            that do not count, of weight 0 or the only ones of their tracks that are not.
        noise: standard deviation of a coordinate of a point, px, from the median of the residuals; where
            views have weights, of one of weight 1.
        line_noise: standard deviation of points of lines from these, px of the image; NaN without lines.
        readout: time that a rolling shutter takes from the first row to the last, in frames.
        readout_std: its standard deviation. A large one says that nothing is known: the camera was too slow
            to determine it, and it does no harm.
        parallax: distance of the entrance pupil before the axis of rotation, over that of a point of the
            scene: its standard deviation from point to point, by a test of a fit without it, and at least.
            What all points have in common looks like a lens, and cannot be determined; it is likely a few
            times as large, and so is the relative error of f that it makes. 0 if none is seen, NaN with
            few tracks.
        parallax_score: its square in standard deviations of chance: above 3 or so it is seen.
        lever: that of each track, less what all have in common, where a parallax is seen; 0 elsewhere.
        lever_std: its standard deviation from track to track, to which levers are held; 0 if none is seen.
        lever_mean: what all are taken to have in common, which no track determines: 2.5 of these standard
            deviations, less where it is not sure whether the pupil is before the axis or behind it.
            `focal_std` and `covariance` have in them by how much that may be off.
    """

    fit: ZoomFit
    focal: Float[Array, "frame"]
    focal_std: Float[Array, "frame"]
    covariance: Float[Array, "all all"]
    rotation: Float[Array, "frame 3 3"]
    shot: Int[Array, "frame"]
    scene: Int[Array, "frame"]
    rays: Float[Array, "track 3"]
    residual: Float[Array, "track view"]
    noise: Float[Array, ""]
    line_noise: Float[Array, ""]
    readout: Float[Array, ""]
    readout_std: Float[Array, ""]
    parallax: Float[Array, ""]
    parallax_score: Float[Array, ""]
    lever: Float[Array, "track"]
    lever_std: Float[Array, ""]
    lever_mean: Float[Array, ""]

    @property
    def lens(self) -> ZoomLens:
        """The zoom lens."""
        return self.fit.lens

    @property
    def pan_and_tilt(self) -> Float[Array, "frame 2"]:
        """Angles of each frame to the right and up, degrees, from where the first of its scene looks."""
        x, y, z = self.rotation[:, 2].T
        return jnp.degrees(jnp.stack([jnp.arctan2(x, z), -jnp.arcsin(jnp.clip(y, -1, 1))], axis=1))

    def carried(
        self, frame: Int[AnyArray, "point"], points: Float[AnyArray, "point 2"], other: int
    ) -> Float[np.ndarray, "point 2"]:
        """Where a frame shows what others show, px; NaN behind the camera, and in another scene.

        Args:
            frame: for each point the number of the frame that it is in.
            points: the points, px.
            other: the number of the frame in which they are looked for.
        """
        known = np.nan_to_num(np.asarray(self.focal), nan=float(self.lens.focal_range[0]))
        turn, scene = np.asarray(self.rotation), np.asarray(self.scene)
        frame, points = np.asarray(frame), np.asarray(points, float)
        size = max(1 << max(len(frame) - 1, 0).bit_length(), _FEW_POINTS)
        more = (0, size - len(frame))
        wide = np.pad(frame, more), np.pad(points, (more, (0, 0)))
        seen = _carried(self.lens, known[wide[0]], turn[wide[0]], wide[1], known[other], turn[other])
        same = (scene[frame] == scene[other]) & (scene[other] >= 0)
        return np.where(same[:, None], np.asarray(seen)[: len(frame)], np.nan)

    def __call__(self, *_: Any, **__: Any) -> NoReturn:
        """Raise TypeError: call the lens of the fit instead."""
        raise TypeError("A MotionFit is not a lens: use fit.lens, as in fit.lens(2400.0).")


@eqx.filter_jit
def _carried(lens, focal, rotation, points, other_focal, other_rotation):
    """Points of frames in another one, px, without what a rolling shutter does to them."""

    def one(f, turn, point):
        flat = (lens(f).undistort(point) - lens.centre_at(f)) / f
        ahead = other_rotation @ (turn.T @ jnp.append(flat, 1))
        straight = lens.centre_at(other_focal) + other_focal * ahead[:2] / jnp.maximum(ahead[2], 1e-3)
        return jnp.where(ahead[2] > 1e-3, lens(other_focal).distort(straight), jnp.nan)

    return jax.vmap(one)(focal, rotation, points)


def thrown_motion(fit: MotionFit) -> MotionFit:
    """The fit, raising RuntimeError where its solver failed."""
    if bool(failed(fit.fit.result)):
        spent = fit.fit.result == RESULTS.nonlinear_max_steps_reached
        raise RuntimeError(f"{_FAILED} {_UNSETTLED if spent else RESULTS[fit.fit.result]}")
    return fit
