"""Rendered folders of one zoom lens in which some photos mislead, for `benchmarks.wide`.

Each folder has photos at several focal lengths. What one photo cannot tell about the lens by itself, the
others can: lines are found with every photo by itself, and with photos tied by the zoom lens.
"""

import csv
import dataclasses
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from zoomjax.app.image_calibration import ImageCalibration, calibrate_images
from zoomjax.app.image_job import ImageJob

from .shared import table
from .wide_scenes import Scene, render, scene

FOCALS = np.array([16.0, 18.0, 21.0, 25.0, 30.0, 38.0, 48.0, 60.0])
"""mm, of the photos of a folder."""

POOR = ("arcs", "few lines and clutter", "arcs", "blur and noise")
"""What ails a folder's poor photos, in turn."""

WRONG = 1.5
"""px, RMS: a line that is less straight under the true lens joins different things, or follows an arc."""


@dataclasses.dataclass(frozen=True)
class Folder:
    """The scenes of a folder, one for each of `FOCALS`, and which of them are poor."""

    scenes: tuple[Scene, ...]
    poor: frozenset[int]


def folder(seed: int, poor: int) -> Folder:
    """A zoom lens, barrel at the short end, of which `poor` photos at random focal lengths are poor."""
    rng = np.random.default_rng((90, seed))
    wide, long = rng.uniform(0.1, 0.7), rng.uniform(-0.1, 0.02)
    u = (FOCALS[0] / FOCALS - FOCALS[0] / FOCALS[-1]) / (1 - FOCALS[0] / FOCALS[-1])
    corner = long + (wide - long) * (0.7 * u + 0.3 * u**2)
    size = (960, 640)
    centre = (np.array(size) - 1) / 2 + rng.uniform(-0.01, 0.01, 2) * size[0]
    ails = dict(zip(rng.permutation(len(FOCALS))[:poor].tolist(), np.roll(POOR, -seed), strict=False))
    scenes = [
        Scene(size, float(moved), centre, scene(1000 + 50 * seed + n).seed, str(ails.get(n, "")))
        for n, moved in enumerate(corner)
    ]
    return Folder(tuple(scenes), frozenset(ails))


def tied_and_apart(seed: int, poor: int) -> dict[str, Any]:
    """One folder, calibrated with photos by themselves and tied by the lens."""
    made = folder(seed, poor)
    row: dict[str, Any] = {"seed": seed, "poor": sorted(made.poor), "ails": [s.hard for s in made.scenes]}
    with tempfile.TemporaryDirectory() as place:
        for n, one in enumerate(made.scenes):
            cv2.imwrite(str(Path(place, f"{n}.png")), render(one))
        with Path(place, "focal.csv").open("w", newline="") as file:
            csv.writer(file).writerows(
                [("image", "focal"), *((f"{n}.png", float(f)) for n, f in enumerate(FOCALS))]
            )
        job = ImageJob((place,), focal=str(Path(place, "focal.csv")), workers=0, overlays="none")
        for name, way in (("apart", False), ("tied", True)):
            start = time.process_time()
            done = calibrate_images(dataclasses.replace(job, tied=way))
            row[name] = {"cpu_s": time.process_time() - start, **_figures(done, made)}
    return row


def _figures(done: ImageCalibration, made: Folder) -> dict[str, Any]:
    """Lines found in the poor photos, right and wrong ones, and how far the lens is from the truth."""
    found = {int(Path(d.name).stem): d for d in done.used}
    photos = []
    for n, one in enumerate(made.scenes):
        lines = found[n].lines if n in found else ()
        rough = [bent(line, one) for line in lines]
        right = [line for line, px in zip(lines, rough, strict=True) if px <= WRONG]
        photos.append(
            {
                "right": len(right),
                "wrong": len(lines) - len(right),
                "length_px": float(sum(np.hypot(*(line[-1] - line[0])) for line in right)),
            }
        )
    lens = done.calibration.fit.lens
    return {
        "photos": photos,
        "again": [int(Path(name).stem) for name in done.tied],
        "rejected": int(done.calibration.rejected.sum()),
        "verdict": done.calibration.assessment.verdict,
        "error_px": [_apart(lens(float(f)), one) for f, one in zip(FOCALS, made.scenes, strict=True)],
    }


def _apart(lens: Any, one: Scene) -> float:
    from .wide import apart

    return apart(lens, one)


def bent(line: np.ndarray, made: Scene) -> float:
    """px of the image, RMS, by which a line is off straight under the true lens."""
    corrected = made.undistort(line)
    centred = corrected - corrected.mean(axis=0)
    normal = np.linalg.svd(centred, full_matrices=False)[2][1]
    slope = [
        (made.undistort(line + step) - made.undistort(line - step)) @ normal for step in 0.5 * np.eye(2)
    ]
    return float(np.sqrt(np.mean((centred @ normal / np.hypot(*slope)) ** 2)))


def folders_page(rows: list[dict]) -> list[str]:
    """What tying does, on the page of results."""
    lines = []
    for row in rows:
        for name, told in (("apart", "by themselves"), ("tied", "tied")):
            of = row[name]
            poor = [of["photos"][n] for n in row["poor"]]
            right, wrong = (sum(photo[key] for photo in poor) for key in ("right", "wrong"))
            far = f"{max(of['error_px']):.2f}"
            lines.append(
                [
                    f"{row['seed']}, {told}",
                    str(len(of["again"])),
                    str(right),
                    str(wrong),
                    far,
                    of["verdict"],
                ]
            )
    return [
        "## Photos tied by the zoom lens",
        "",
        f"Rendered folders with photos at {len(FOCALS)} focal lengths of a zoom lens. In each, four photos "
        "mislead: two of arcs with a few dashed lines, one with few lines and clutter, one blurred and "
        "noisy. Lines in these photos are right if they are straight under the true lens. The lens's error "
        "is "
        "the greatest of all photos, px RMS of the image.",
        "",
        *table(["folder, photos", "searched again", "right", "wrong", "error, px", "verdict"], lines),
    ]
