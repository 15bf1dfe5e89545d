"""Focal lengths from the pitch lines of real broadcasts, and from a real zoom camera's checkerboards.

    python -m benchmarks.real.pitch

reads the data folder that the environment variable ZOOMJAX_DATA names, and prints five tables.

``pitch_lines/wc14_half.json``: 93 frames of football, 1280 x 720 px, with points on named lines, and
a camera without distortion that another program predicts. The first table is of the points as they are, the
second of the points corrected by one coefficient for all frames, fitted by `fit_zoom` to the straightness
of the lines of 3 points or more. The rows are numbers of straight lines in view. ``ratio`` is to the other
program's focal length, which is no truth: how far its camera is from the points is printed below. In the
third table it is, because the points are moved to where that camera sees their lines, and then randomly.
The fourth table is of the corrected lines without their names: how many frames get them all again from
`name_pitch_lines`, some, none, or a wrong one. Its limits were set on these frames.

``zoomcam``: 116 photos of a board, at five zooms whose focal lengths come from another calibration.
"""

import argparse
import json
import os
from pathlib import Path

import jax
import numpy as np

from zoomjax import Distortion, Lines, PolynomialZoom, fit_zoom, frame_rms
from zoomjax.focal import FocalEstimate, focal_from_pitch, focal_from_planes, name_pitch_lines
from zoomjax.focal.pitch import PITCH_LINES

from .zoomcam import read_zoomcam

SIZE = (1280, 720)
NOISE = 0.6
PRINCIPAL = (np.array(SIZE) - 1) / 2
ROWS = {"2-3": (2, 3), "4": (4, 4), "5-6": (5, 6), "7": (7, 7), "8-9": (8, 9), "all": (0, 99)}


def straight_lines(frame: dict) -> dict[str, np.ndarray]:
    """The points on straight lines of the ground, by name."""
    return {name: np.array(points) for name, points in frame["lines"].items() if name in PITCH_LINES}


def read_pitch(folder: Path) -> list[dict]:
    """The annotated frames, as the file has them."""
    return list(json.loads((folder / "wc14_half.json").read_text()).values())


def annotated_lines(frames: list[dict]) -> Lines:
    """The straight lines of 3 points or more, with the focal lengths of the predicted cameras."""
    lines = [[points for points in straight_lines(frame).values() if len(points) > 2] for frame in frames]
    predicted = np.array([frame["camera_pred"]["f_px"] for frame in frames])
    used = [number for number, points in enumerate(lines) if points]
    return Lines.from_ragged(
        [points for number in used for points in lines[number]],
        np.repeat(np.arange(len(used)), [len(lines[number]) for number in used]),
        predicted[used],
        image_size=SIZE,
        focal_unit="px",
    )


def fitted_distortion(frames: list[dict]) -> tuple[Distortion, np.ndarray]:
    """One coefficient for all frames, and the RMS distances from straightness, px, without and with it."""
    primitives = annotated_lines(frames)
    fit = fit_zoom(primitives, zoom=PolynomialZoom(degree=0), terms=1)
    rms = [np.sqrt(np.mean(frame_rms(primitives, lens) ** 2)) for lens in (None, fit.lens)]
    return fit.lens(float(primitives.focal[0])), np.array(rms)


def predicted_feet(frame: dict) -> dict[str, np.ndarray]:
    """The places nearest to the points on the lines as the predicted camera sees them, px."""
    camera = frame["camera_pred"]
    pan, tilt, roll = np.deg2rad([camera[name] for name in ("pan", "tilt", "roll")])
    upright = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    turn = (_turn(pan) @ upright @ _turn(roll)).T
    feet = {}
    for name, points in straight_lines(frame).items():
        ends = (np.c_[np.array(PITCH_LINES[name]), np.zeros(2)] - camera["pos"]) @ turn.T
        line = np.cross(*(ends * [camera["f_px"], camera["f_px"], 1]))
        line = line / np.hypot(*line[:2])
        feet[name] = points - np.outer((points - PRINCIPAL) @ line[:2] + line[2], line[:2])
    return feet


def _rms_distance(points: dict[str, np.ndarray], feet: dict[str, np.ndarray]) -> float:
    squares = [np.sum((points[name] - feet[name]) ** 2, axis=1) for name in points]
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def _turn(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])


def print_frames(title: str, estimates: list[FocalEstimate], frames: list[dict]) -> None:
    """One row for each number of lines."""
    number = np.array([len(straight_lines(frame)) for frame in frames])
    focal, std, rms = np.array([[each.focal, each.std, each.rms] for each in estimates]).T
    predicted = np.array([frame["camera_pred"]["f_px"] for frame in frames])
    print(f"\n{title}")
    print(" lines frames  with f   ratio: median  quartiles     MAD  within 2 std   std/f  rms, px")
    for name, (least, most) in ROWS.items():
        row = (number >= least) & (number <= most)
        known = row & np.isfinite(focal)
        print(f"{name:>6} {row.sum():6} {known.sum():7}", end="")
        if known.any():
            ratio = focal[known] / predicted[known]
            within = np.mean(abs(focal - predicted)[known] < 2 * std[known])
            lower, median, upper = np.percentile(ratio, [25, 50, 75])
            print(
                f"{median:16.3f}  {lower:.3f}-{upper:.3f}  {np.median(abs(ratio - median)):.3f}"
                f"{within:12.0%} {np.median((std / focal)[known]):9.1%} {np.median(rms[known]):8.2f}",
                end="",
            )
        print()


def pitch(folder: Path) -> None:
    """The two tables of broadcasts."""
    frames = read_pitch(folder / "pitch_lines")
    distortion, rms = fitted_distortion(frames)
    seen = [straight_lines(frame) for frame in frames]
    corrected = [
        {name: np.asarray(distortion.undistort(points)) for name, points in lines.items()} for lines in seen
    ]
    feet = [predicted_feet(frame) for frame in frames]
    rng = np.random.default_rng(0)
    simulated = [
        {name: points + NOISE * rng.standard_normal(points.shape) for name, points in lines.items()}
        for lines in feet
    ]
    for title, annotations in (
        ("Points as annotated", seen),
        ("Points corrected", corrected),
        (f"Simulated: the other program's camera as truth, noise of {NOISE} px", simulated),
    ):
        estimates = [focal_from_pitch(lines, principal=PRINCIPAL) for lines in annotations]
        print_frames(title, estimates, frames)
    print_names(corrected)
    missed = np.array([_rms_distance(*pair) for pair in zip(seen, feet, strict=True)])
    k1 = float(distortion.coefficients[0])
    print(f"\nk1 = {k1:.4f}; straightness {rms[0]:.2f} px, with it {rms[1]:.2f}")
    print(
        f"The other program's camera: {np.median(missed):.2f} px from the points in the median frame, more "
        f"than 50 px in {np.sum(missed > 50)}"
    )


def print_names(annotations: list[dict[str, np.ndarray]]) -> None:
    """How many frames get the names of their lines again."""
    print("\nNames found\n lines frames   all  some  none wrong")
    found = [
        name_pitch_lines(list(lines.values()), principal=PRINCIPAL, image_size=SIZE)
        for lines in annotations
    ]
    right = [
        all(name in lines and np.array_equal(lines[name], points) for name, points in names.items())
        for names, lines in zip(found, annotations, strict=True)
    ]
    share = np.array([len(names) / len(lines) for names, lines in zip(found, annotations, strict=True)])
    number = np.array([len(lines) for lines in annotations])
    for name, (least, most) in ROWS.items():
        row = (number >= least) & (number <= most)
        kinds = (share == 1, (share > 0) & (share < 1), share == 0)
        columns = [row & np.array(right) & kind for kind in kinds]
        counts = [np.sum(row), *map(np.sum, columns), np.sum(row & ~np.array(right))]
        print(f"{name:>6}", "".join(f"{count:6}" for count in counts))


def zoomcam(folder: Path) -> None:
    """The table of the board."""
    lens = fit_zoom(read_zoomcam(folder / "zoomcam")).lens
    with np.load(folder / "zoomcam" / "corners_22x15.npz") as stored:
        zoom, corners = stored["zoom"], stored["corners"].astype(float).reshape(-1, 330, 2)
    plane = np.stack(np.meshgrid(np.arange(22.0), np.arange(15.0)), axis=-1).reshape(-1, 2)
    print("\nBoard\n  zoom photos with f  theirs, px  median of photos    all together    std")
    for number, focal in np.loadtxt(folder / "zoomcam" / "focal_px.csv", delimiter=",", skiprows=1):
        corrected = np.asarray(lens(focal).undistort(corners[zoom == number]))
        together, each = focal_from_planes(corrected, plane, principal=np.asarray(lens.centre))
        median = np.nanmedian(each.focal)
        print(
            f"{number:6.0f} {len(corrected):6} {np.isfinite(each.focal).sum():6} {focal:11.0f}"
            f"{median:9.0f} ({median / focal - 1:+.1%})"
            f"{together.focal:9.0f} ({together.focal / focal - 1:+.1%}){together.std:7.0f}"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.parse_args()
    if "ZOOMJAX_DATA" not in os.environ:
        parser.error("set the environment variable ZOOMJAX_DATA to the folder that holds pitch_lines/")
    jax.config.update("jax_enable_x64", True)
    pitch(Path(os.environ["ZOOMJAX_DATA"]))
    zoomcam(Path(os.environ["ZOOMJAX_DATA"]))
