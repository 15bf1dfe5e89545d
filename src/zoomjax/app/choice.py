"""Which photos of a calibration are drawn, and the scale of their lines' colours."""

import numpy as np

from .calibration import Calibration


def chosen_frames(calibration: Calibration, most: int) -> list[int]:
    """At most so many frames, by focal length: those fitted worst, and others over the zoom."""
    focal = np.asarray(calibration.lines.focal)
    order = np.argsort(focal, kind="stable")
    if len(order) <= most:
        return order.tolist()
    worst = np.argsort(-np.nan_to_num(np.asarray(calibration.fit.frame_rms)))[: most // 3]
    others = order[~np.isin(order, worst)]
    spread = others[np.linspace(0, len(others) - 1, most - len(worst)).round().astype(int)]
    chosen = set(worst.tolist()) | set(spread.tolist())
    return [frame for frame in order.tolist() if frame in chosen]


def colour_limit(calibration: Calibration) -> float:
    """The RMS, px, from which on lines have the last colour: four times the median line's."""
    return 4 * float(np.median(calibration.line_rms[~calibration.rejected]))
