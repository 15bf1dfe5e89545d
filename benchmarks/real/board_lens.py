"""Which lens of a bent board to keep: the bundle adjustment's, or one fitted to the lines of a flat board.

    python -m benchmarks.real.board_lens [--output FILE]

The photos and halves of boards.py. `fit_boards` is fitted to each half, with a shape for each zoom's
photos; its shape then moves rows and columns to where a flat board would show them, and `fit_zoom` is
fitted to these, at the focal lengths of the bundle adjustment, with the centre fitted: the lens that
`zoomjax calibrate --detector grid` writes. *Scatter*: RMS difference, over all corners of a zoom, of
where the lenses of both halves correct them to.

Results go to benchmarks/results/board_lens.md and board_lens.json.
"""

from pathlib import Path

import numpy as np

import zoomjax as zj
from zoomjax.app.board_lines import flat_detections
from zoomjax.app.focal_sources import lines_of
from zoomjax.detect import GridDetector
from zoomjax.detect.batch import Detection
from zoomjax.fit import BoardFit

from .boards import PAIRS, SIZE, corrected, fitted, halves, scatter
from .study import main, table
from .zoomcam import read_corners

ROWS = {"bundle": "bundle adjustment", "lines": "straightness of the lines of a flat board"}


def of_flat_lines(fit: BoardFit, corners: np.ndarray) -> zj.ZoomLens:
    """The lens of the lines that a flat board would show."""
    seen = [
        Detection(str(i), str(i), SIZE, tuple(GridDetector.lines(grid)), None, grid)
        for i, grid in enumerate(corners)
    ]
    lines = lines_of(flat_detections(fit, seen, [0] * len(seen)), np.asarray(fit.frame_focal), "px")
    held = zj.fit.in_image(zj.lines.compress_any_centre(lines))
    return zj.fit_zoom(held, centre="fit").lens


def run(data: Path) -> dict:
    """All measurements."""
    corners, zoom, _ = read_corners(data / "zoomcam")
    corners, rng = corners.astype(float), np.random.default_rng(0)
    by_zoom = [corners[zoom == label] for label in np.unique(zoom)]
    found: dict[str, list] = {name: [] for name in ROWS}
    for _ in range(PAIRS):
        first = halves(zoom, rng)
        both: dict[str, list] = {name: [] for name in ROWS}
        for mine in (first, ~first):
            fit = fitted(corners[mine], zoom[mine], flat=False)
            for name, lens in (("bundle", fit.lens), ("lines", of_flat_lines(fit, corners[mine]))):
                both[name].append(corrected(lens, np.asarray(fit.focal), by_zoom))
        for name, pair in both.items():
            found[name].append(scatter(pair))
    means = {name: np.sqrt(np.mean(np.square(of), axis=0)).tolist() for name, of in found.items()}
    return {"zooms": np.unique(zoom).tolist(), "scatter": means}


def page(r: dict) -> list[str]:
    """The results as a page."""
    return [
        "# Which lens of a bent board to keep",
        "",
        f"116 photos of a zoom camera, fitted half against half: {PAIRS} pairs of halves, a board's shape "
        "a zoom. RMS difference of corrected corners, px. The second lens is what `zoomjax calibrate` "
        "writes.",
        "",
        *table(
            ["lens", "mean", *(f"{zoom:g}x" for zoom in r["zooms"])],
            ([ROWS[name], *(f"{x:.3f}" for x in (np.mean(of), *of))] for name, of in r["scatter"].items()),
        ),
        "",
    ]


if __name__ == "__main__":
    main(__doc__, "board_lens", run, page)
