"""Known focal lengths that tracks contradict, one by one or all together."""

import warnings

import numpy as np

from ._motion_model import Model, Noise
from ._motion_problem import Given
from .motion_fit import MotionFit

CONTRADICTED = "Known focal lengths have another scale than the tracks"
"""How the warning of all together begins."""

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
