"""Lines in strongly bent photographs: a facade, an action camera's board, and rendered scenes with clutter.

    python -m benchmarks.wide [--scenes N] [--output FILE]

The facade and the board are read from the folder that the environment variable ZOOMJAX_DATA names. The
facade's reference is the robust fit of the line points that the program of the paper's authors found in it
(primitives.txt). Rendered scenes have exact truth. Results go to benchmarks/results/wide.md and wide.json.
"""

import argparse
import itertools
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np

import zoomjax as zj
from zoomjax.detect.edges import EdgeDetector
from zoomjax.models.division import Division

from .shared import RESULTS, machine, machine_line, real_data, table, write
from .wide_scenes import Scene, render, scene

RADII = np.array([0.2, 0.4, 0.6, 0.8, 0.9, 1.0])
"""Of the way to the corner."""

WITHIN = 0.5
"""px: a rendered scene's lens is found if its RMS distance from the truth, in the image, is less."""


def fitted(
    lines: Sequence[np.ndarray], size: tuple[int, int], terms: int = 2, *, division: bool = False
) -> Any:
    """The robust fit to the lines of one photograph."""
    every = [line[:: max(1, len(line) // 60)] for line in lines]
    data = zj.Lines.from_ragged(every, [0] * len(every), [1.0], image_size=size, focal_unit="px")
    family = Division() if division else None
    return zj.fit_robust(data, zoom=zj.PolynomialZoom(degree=0), family=family, terms=terms, throw=False)


def displacements(distortion: zj.Distortion) -> np.ndarray:
    """px by which points at the `RADII` of the diagonal move outwards."""
    centre = np.asarray(distortion.centre)
    points = centre - RADII[:, None] * centre
    moved = np.asarray(distortion.undistort(points))
    return np.hypot(*(moved - centre).T) - np.hypot(*(points - centre).T)


def straightness(lines: Sequence[np.ndarray], distortion: zj.Distortion) -> float:
    """RMS over the better 9 tenths of the lines of their RMS distances, px of the image.

    The distance of a corrected point to its line is divided by the stretch across the line there.
    """
    rms = []
    for line in lines:
        corrected = np.asarray(distortion.undistort(line))
        centred = corrected - corrected.mean(axis=0)
        normal = np.linalg.svd(centred, full_matrices=False)[2][1]
        steps = [np.asarray(distortion.undistort(line + step)) @ normal for step in (0.5 * np.eye(2))]
        back = [np.asarray(distortion.undistort(line - step)) @ normal for step in (0.5 * np.eye(2))]
        stretch = np.hypot(steps[0] - back[0], steps[1] - back[1])
        rms.append(np.sqrt(np.mean((centred @ normal / stretch) ** 2)))
    best = np.sort(rms)[: int(np.ceil(0.9 * len(rms)))]
    return float(np.sqrt(np.mean(best**2)))


def primitives(path: Path) -> list[np.ndarray]:
    """The points of the lines in an output file of the authors' program."""
    lines = []
    for block in path.read_text().split("line points :")[1:]:
        values = block.split()
        number = int(values[0])
        lines.append(np.array(values[1 : 1 + 2 * number], float).reshape(number, 2))
    return lines


def facade(folder: Path) -> dict:
    """The facade by itself, beside the fits to the authors' line points."""
    image = cv2.imread(str(folder / "building.png"))
    assert image is not None
    size = (image.shape[1], image.shape[0])
    detector, times = EdgeDetector(), []
    edges = detector.find(image)
    for _ in range(3):
        start = time.process_time()
        edges = detector.find(image)
        times.append(time.process_time() - start)
    theirs = primitives(folder / "primitives.txt")
    centre = (np.array(size) - 1) / 2
    result: dict[str, Any] = {
        "lines": len(edges.lines),
        "unexplained": edges.unexplained,
        "cpu_s": float(np.median(times)),
        "reach": float(max(np.hypot(*(line - centre).T).max() for line in edges.lines) / np.hypot(*centre)),
        "their_reach": float(
            max(np.hypot(*(line - centre).T).max() for line in theirs) / np.hypot(*centre)
        ),
        "fits": {},
    }
    for model, terms, division in (("polynomial, 2 terms", 2, False), ("division, 2 terms", 2, True)):
        for who, lines in (("their points", theirs), ("automatic", list(edges.lines))):
            robust = fitted(lines, size, terms, division=division)
            lens = robust.fit.lens(1.0)
            result["fits"][f"{model}, {who}"] = {
                "rms_px": float(robust.fit.rms),
                "rejected": len(robust.rejected),
                "displacement_px": displacements(lens).tolist(),
                "straightness_px": straightness(theirs, lens),
            }
    return result


def board(folder: Path) -> dict:
    """An action camera's checkerboard: the lens from edges beside that from the corners of whole boards."""
    edges: list[np.ndarray] = []
    corners: list[np.ndarray] = []
    flat = np.stack(np.meshgrid(np.arange(9), np.arange(6)), axis=-1).reshape(-1, 2)
    objects = np.column_stack([flat, np.zeros(54)]).astype(np.float32)
    size = (1280, 720)
    for path in sorted(folder.glob("*.jpg")):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        if image.shape[::-1] != size:
            continue
        edges += EdgeDetector()(image)
        found, grid = cv2.findChessboardCornersSB(image, (9, 6), flags=cv2.CALIB_CB_ACCURACY)
        if found:
            corners.append(grid.astype(np.float32))
    _, camera, coefficients, *_ = cv2.calibrateCamera(
        [objects] * len(corners), corners, size, None, None, flags=cv2.CALIB_ZERO_TANGENT_DIST
    )
    robust = fitted(edges, size)
    lens = robust.fit.lens(1.0)
    points = np.concatenate(corners)[:, 0].astype(float)
    truth = cv2.undistortPoints(points[:, None], camera, coefficients, P=camera)[:, 0]
    ours = np.asarray(lens.undistort(points))
    return {
        "photos": len(corners),
        "lines": len(edges),
        "rejected": len(robust.rejected),
        "rms_px": float(robust.fit.rms),
        "apart_px": alike(ours, truth),
    }


def alike(ours: np.ndarray, truth: np.ndarray) -> float:
    """RMS px between two corrections of points, up to the homography that straightness cannot tell."""
    homography, _ = cv2.findHomography(ours, truth, 0)
    mapped = cv2.perspectiveTransform(ours[:, None], homography)[:, 0]
    return float(np.sqrt(np.mean(np.sum((mapped - truth) ** 2, axis=1))))


def rendered(number: int) -> dict:
    """Rendered scenes: how far the fitted lens is from the true one."""
    rows = []
    for seed in range(number):
        made = scene(seed)
        edges = EdgeDetector().find(render(made))
        row: dict[str, Any] = {"seed": seed, "corner": made.corner, "unexplained": edges.unexplained}
        row["lines"] = len(edges.lines)
        row["error_px"] = apart(edges.lines, made) if len(edges.lines) >= 3 else float("inf")
        rows.append(row)
        print(row, flush=True)
    good = np.array([row["error_px"] < WITHIN for row in rows])
    median = float(np.median([row["error_px"] for row in rows]))
    return {"scenes": rows, "success": float(good.mean()), "median_px": median}


def apart(lines: Sequence[np.ndarray], made: Scene) -> float:
    """RMS px of the image, over the image, between the fitted correction and the true one.

    Straight lines cannot tell a homography of the corrected image, which is therefore taken out.
    """
    lens = fitted(lines, made.size).fit.lens(1.0)
    x, y = np.meshgrid(np.linspace(0.02, 0.98, 15), np.linspace(0.02, 0.98, 11))
    points = np.stack([x, y], axis=-1).reshape(-1, 2) * np.subtract(made.size, 1)
    truth = made.undistort(points)
    half = np.array([0.5, 0.0])
    stretch = np.linalg.norm(made.undistort(points + half) - made.undistort(points - half), axis=1)
    homography, _ = cv2.findHomography(np.asarray(lens.undistort(points)), truth, 0)
    mapped = cv2.perspectiveTransform(np.asarray(lens.undistort(points))[:, None], homography)[:, 0]
    return float(np.sqrt(np.mean(np.sum((mapped - truth) ** 2, axis=1) / stretch**2)))


def markdown(results: dict) -> str:
    """The page of results."""
    house, plate, scenes = results["facade"], results["board"], results["rendered"]
    fits = [
        [name, f"{fit['rms_px']:.2f}", str(fit["rejected"]), f"{fit['straightness_px']:.2f}"]
        + [f"{value:.1f}" for value in fit["displacement_px"]]
        for name, fit in house["fits"].items()
    ]
    edges = np.array([-0.3, 0.0, 0.3, 0.6, 0.9, 1.2])
    groups = []
    for low, high in itertools.pairwise(edges):
        errors = [row["error_px"] for row in scenes["scenes"] if low <= row["corner"] < high]
        if errors:
            share = f"{sum(e < WITHIN for e in errors)} of {len(errors)}"
            groups.append([f"{low:+.0%} to {high:+.0%}", share, f"{np.median(errors):.2f}"])
    return "\n".join(
        [
            "# Lines in strongly bent photographs",
            "",
            "`python -m benchmarks.wide`",
            "",
            "## A facade through a fisheye",
            "",
            f"{house['lines']} lines, found in {house['cpu_s']:.2f} s of one core's time; "
            f"{house['unexplained']:.0%} of the strong long edges are on none. They reach to "
            f"{house['reach']:.2f} of the way to the corner, the points of the authors' program to "
            f"{house['their_reach']:.2f}: beyond, the models extrapolate. Displacements, px, at shares "
            "of the way to the corner; straightness is that of the authors' points, px of the image, "
            "over the better nine tenths of their lines.",
            "",
            *table(["", "RMS", "rejected", "straightness", *map(str, RADII)], fits),
            "",
            "## An action camera's board",
            "",
            f"{plate['lines']} lines in all photos, {plate['rejected']} rejected; RMS "
            f"{plate['rms_px']:.2f} px. On the corners of the {plate['photos']} whole boards the "
            f"correction is {plate['apart_px']:.2f} px RMS from that of `cv2.calibrateCamera`, up to a "
            "homography.",
            "",
            "## Rendered scenes",
            "",
            f"{len(scenes['scenes'])} scenes, noise of 3 grey levels, JPEG, centre off by up to 5 %: "
            f"the lens is within {WITHIN} px RMS of the image of the true one, up to a homography, in "
            f"{scenes['success']:.0%}; median {scenes['median_px']:.2f} px.",
            "",
            *table(["corner displacement", "within", "median, px"], groups),
            "",
            machine_line(results["machine"]),
            "",
        ]
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", type=int, default=40, help="number of rendered scenes")
    parser.add_argument("--output", type=Path, default=RESULTS / "wide.md")
    given = parser.parse_args()
    data = real_data(parser) / "wide"
    jax.config.update("jax_enable_x64", True)
    measured: dict[str, Any] = {
        "machine": machine(),
        "facade": facade(data),
        "board": board(data / "board"),
    }
    measured["rendered"] = rendered(given.scenes)
    write(given.output, markdown(measured), measured)
