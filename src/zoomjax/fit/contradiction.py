"""What tracks contradict: known focal lengths, one by one or all together, and one lens of all shots."""

import warnings

import numpy as np
from jaxtyping import Int

from ._motion_apart import Apart
from ._motion_model import Model, Noise
from ._motion_problem import Given
from .motion_fit import MotionFit

CONTRADICTED = "Known focal lengths have another scale than the tracks"
"""How the warning of all together begins."""

OTHER_LENS = "Shots contradict one lens"
"""How the warning of shots with different lenses begins."""

_CLOSER, _OTHER = 1.1, 0.03
"""From where on it is given: noise over that without known focal lengths, and these apart in log f."""

_FAR_OFF = 5.0
"""Standard deviations from a known focal length to the one fitted that are no chance."""


def warn_of_contradiction(given: Given, fit: MotionFit) -> None:
    """Known focal lengths far from those fitted are not those of the tracks, or not that well known."""
    known, std = np.asarray(given.focal, float), np.asarray(given.focal_std, float)
    off = np.abs(np.log(np.asarray(fit.focal) / known)) / (std / known)
    far = np.flatnonzero(np.nan_to_num(off) > _FAR_OFF)
    if len(far):
        worst = far[np.argmax(off[far])]
        warnings.warn(
            f"{len(far)} of {np.sum(np.isfinite(known))} known focal lengths contradict the tracks: of "
            f"frame {worst} {known[worst]:.5g} px is given and {float(fit.focal[worst]):.5g} px is fitted, "
            f"{off[worst]:.2g} of its standard deviations away. Such errors take all focal lengths along: "
            "leave out those that are wrong, or give them a larger focal_std.",
            stacklevel=2,
        )


def warn_of_other_scale(given: Given, fit: MotionFit, noise: Noise, free: tuple[Model, Noise]) -> None:
    """Known focal lengths that a fit follows, far from those without which it follows the tracks closer.

    Args:
        given: with known focal lengths.
        fit, noise: what was fitted to all.
        free: a model and its noise without what is known.
    """
    model, without = free
    known = np.asarray(given.focal, float)
    std = np.broadcast_to(np.asarray(given.focal_std, float), known.shape)
    there = np.isfinite(known)
    focal = np.exp(np.asarray(model.path.log_focal))[: len(known)]
    off = np.abs(np.log(focal / known))
    far = np.median((off / np.maximum(std / known, _OTHER / _FAR_OFF))[there]) > _FAR_OFF
    lost = (there & np.isnan(np.asarray(fit.focal)) & (np.asarray(fit.shot) >= 0)).any()
    closer, now = (float(given.unit) * float(of.points) for of in (without, noise))
    if far and (lost or now > _CLOSER * closer):
        worst = int(np.nanargmax(off))
        warnings.warn(
            f"{CONTRADICTED}: points are followed within {now:.3g} px with them, within {closer:.3g} px "
            f"without. Of frame {worst} {known[worst]:.5g} px is given, and {focal[worst]:.5g} px is "
            "fitted without. Check whether they are in px, and of this clip: their scale is that of all "
            "results.",
            stacklevel=2,
        )


def warn_of_other_lens(apart: Apart, shot: Int[np.ndarray, "frame"]) -> None:
    """A shot that does not have the lens that all shots are fitted with.

    Args:
        apart: what it differs by.
        shot: of each frame that tracks link to it, the number of its shot; -1 for others.
    """
    frames = np.flatnonzero(shot == np.argmax(np.bincount(shot[shot >= 0])))
    longer = np.expm1(apart.longer)
    differs = f"focal lengths {abs(longer):.1%} {'longer' if longer > 0 else 'shorter'}"
    if np.isfinite(apart.corner):
        where = "outwards" if apart.corner > 0 else "inwards"
        differs += f", and a correction that moves the corners {abs(apart.corner):.3g} px farther {where},"
    warnings.warn(
        f"{OTHER_LENS}: by itself the shot of frames {frames[0]} to {frames[-1]} has {differs} than by the "
        "lens of all shots. Fit the tracks of each by themselves: they may be of two cameras or lenses, or "
        "the fit of all may have gone wrong.",
        stacklevel=2,
    )
