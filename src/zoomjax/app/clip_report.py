"""report.html of a clip: the lens and the camera's path, on one page.

Its text is in ``templates/clip.html``; this module computes the values.
"""

from pathlib import Path
from typing import Any

import numpy as np

from .._core.text import span
from ..io.video_reader import decode_video
from .motion_calibration import FILES, MotionCalibration
from .motion_figures import turned
from .motion_plot import plot_motion
from .page import Run, counted, data_url, embedded_data, embedded_plot, rendered, short
from .pictures import before_after
from .plot import plot_distortion
from .slider import slider

_SHOWN = 3
"""Frames before and after, evenly over the zoom in 1/f."""


def clip_report(done: MotionCalibration, panorama: Path, *, run: Run) -> str:
    """Render the report as HTML.

    Args:
        done: the calibration.
        panorama: the file of its panorama, which is embedded.
        run: what was run.
    """
    lens, moving = done.fit.lens, slider(done.fit.fit)
    low, high = (float(f) for f in lens.focal_range)
    views = int(np.sum(np.asarray(done.tracks.mask)))
    return rendered(
        "clip.html",
        title=run.title,
        about=[
            f"f = {span(low, high, lens.focal_unit)}{', relative' * done.is_relative()}",
            f"{lens.image_size[0]} × {lens.image_size[1]} px",
            counted(done.tracks.frames, "frame"),
            f"{counted(views, 'view')} of {counted(len(done.tracks.number), 'point')}",
        ],
        verdict=done,
        cards=_cards(done),
        warnings=done.warnings,
        panorama=data_url(panorama.read_bytes(), "jpeg"),
        path=embedded_plot(plot_motion(done.fit), "Focal length and direction of each frame"),
        slider=embedded_data(moving),
        slider_times=f"{moving['times']:g}" if moving and moving["times"] > 1 else None,
        photos=_frames(done),
        figures=[line.strip() for line in done.figures()],
        corner=[
            (f"{f:.4g} px", f"{moved:+.2f}".replace("-", "−"), f"{std:.2g}" if np.isfinite(std) else "–")
            for f, moved, std in done.corner()
        ],
        grid=embedded_plot(
            plot_distortion(done.fit.fit, focal=[low, high]),
            "A straight grid, distorted, and the displacement of pixels, at both ends of the zoom",
        ),
        run=run.rows,
        files=[*FILES, *["lines.npz"] * (done.lines is not None)],
        versions=", ".join(f"{name} {of}" for name, of in done.summary()["versions"].items()),
    )


def _cards(done: MotionCalibration) -> list[tuple[str, str]]:
    """The key figures at the top of the page."""
    pan, tilt = turned(done.fit)
    _, moved, std = done.corner()[0]
    scale = done.scale_std()
    return [
        (f"{done.following():.0%}", "of the points move as a camera that turns makes them"),
        (f"{short(float(done.fit.noise))} px", "distance of these from the model"),
        (f"{pan:.0f}° × {tilt:.0f}°", "how far the camera turned"),
        (
            "relative" if done.is_relative() else f"± {scale:.2%}",
            "only the ratios of focal lengths are known"
            if done.is_relative()
            else "uncertainty of all focal lengths together",
        ),
        (
            f"{moved:+.3g} ± {short(std)} px" if np.isfinite(std) else f"{moved:+.3g} px",
            "shift of a corner by the correction at the shortest focal length",
        ),
    ]


def _frames(done: MotionCalibration) -> list[dict[str, Any]]:
    """Some frames before and after."""
    focal = np.asarray(done.fit.focal)
    known = np.flatnonzero(np.isfinite(focal))
    wanted = np.linspace(1 / focal[known].min(), 1 / focal[known].max(), _SHOWN)
    chosen = {int(known[np.argmin(abs(1 / focal[known] - at))]) for at in wanted}
    shown = []
    with decode_video(done.clip) as (_, frames):
        for place, (number, _, image) in enumerate(frames):
            if place not in chosen:
                continue
            pair = before_after(image(), done.fit.lens(float(focal[place])))
            before, after = (data_url(picture, "jpeg") for picture in pair)
            shown.append(
                {"frame": number, "focal": f"{focal[place]:.5g}", "before": before, "after": after}
            )
    return sorted(shown, key=lambda one: float(one["focal"]))
