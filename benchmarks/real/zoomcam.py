"""The corners of a real zoom camera as lines, for `zoomjax calibrate` and for measurements.

    python -m benchmarks.real.zoomcam [-o zoomcam.npz]

reads the folder ``zoomcam`` of the data folder that the environment variable ZOOMJAX_DATA names: 116 photos
of a checkerboard (22 x 15 inner corners) at five zooms of a surveillance camera, 1280 x 720 px. Every row
and every column of corners is a straight line of the board. All photos of a zoom share one frame.
"""

import argparse
import os
from pathlib import Path

import numpy as np

from zoomjax import Lines


def read_zoomcam(folder: Path) -> Lines:
    """The lines of all photos, one frame a zoom, with focal lengths in px.

    Args:
        folder: holds ``corners_22x15.npz`` and ``focal_px.csv``.
    """
    corners, zoom, focal = read_corners(folder)
    zooms, frame = np.unique(zoom, return_inverse=True)
    return Lines.from_grids(
        corners, frame, [focal[z] for z in zooms.tolist()], image_size=(1280, 720), focal_unit="px"
    )


def read_photos(folder: Path) -> Lines:
    """The same lines, one frame a photo, in double precision."""
    corners, zoom, focal = read_corners(folder)
    frames = np.arange(len(zoom))
    return Lines.from_grids(
        corners.astype(float),
        frames,
        [focal[z] for z in zoom.tolist()],
        image_size=(1280, 720),
        focal_unit="px",
    )


def read_corners(folder: Path) -> tuple[np.ndarray, np.ndarray, dict[float, float]]:
    """The corners of each photo, its zoom, and the focal length of each zoom."""
    with np.load(folder / "corners_22x15.npz") as stored:
        zoom, corners = stored["zoom"], stored["corners"]
    table = np.loadtxt(folder / "focal_px.csv", delimiter=",", skiprows=1)
    return corners, zoom, dict(table.tolist())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--output", type=Path, default=Path("zoomcam.npz"))
    output = parser.parse_args().output
    if "ZOOMJAX_DATA" not in os.environ:
        parser.error("set the environment variable ZOOMJAX_DATA to the folder that holds zoomcam/")
    lines = read_zoomcam(Path(os.environ["ZOOMJAX_DATA"]) / "zoomcam")
    lines.save(output)
    print(f"{len(lines.frame)} lines at {len(lines.focal)} zooms written to {output}")
