"""A board as what it is, bent: bundle adjustment beside straightness and OpenCV, on a zoom camera.

    python -m benchmarks.real.boards [--output FILE]

116 photos of a checkerboard at five zooms (see zoomcam.py), split into random halves of each zoom's photos.
All is fitted to one half and judged by the other: `fit_boards` with a shape for each zoom's photos, which
are of one day, and a flat board; the straightness fit (`fit_zoom`, centre fitted); and, for the first pair
of halves, OpenCV's `calibrateCamera` zoom by zoom (k1, k2). What frees the board's shape in OpenCV and in
mrcal is in board_rivals.py.

*Photos not seen*: RMS distance of corners from where the model puts them, with the pose and, where the
board bends, the 12 numbers of how it bends in the photo beside its shape refitted; and the pose alone.
*Scatter*: RMS difference, over all corners of a zoom, of where the lenses of both halves correct them to.

Results go to benchmarks/results/boards.md and boards.json.
"""

import time
from collections.abc import Callable
from pathlib import Path

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import zoomjax as zj
from zoomjax.fit import BoardFit, fit_boards

from .study import main, table
from .zoomcam import read_corners, read_photos

SIZE = (1280, 720)
PAIRS = 3
TIMED = 120
"""Photos of the timing: all of them, and some again."""


def halves(zoom: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Which photos are in the first half."""
    first = np.zeros(len(zoom), bool)
    for label in np.unique(zoom):
        mine = rng.permutation(np.flatnonzero(zoom == label))
        first[mine[: len(mine) // 2]] = True
    return first


def rms(distance: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.nanmean(np.square(distance))))


def fitted(corners: np.ndarray, zoom: np.ndarray, *, flat: bool) -> BoardFit:
    """The bundle adjustment of some photos, one board for each zoom."""
    board = np.unique(zoom, return_inverse=True)[1]
    return fit_boards(corners, zoom, image_size=SIZE, board=board, flat=flat, throw=False)


def not_seen(fit: BoardFit, corners: np.ndarray, zoom: np.ndarray, *, rigid: bool = False) -> np.ndarray:
    """Distances of corners of other photos, in which the board may bend a little otherwise, or not."""
    board = np.unique(zoom, return_inverse=True)[1]
    if rigid:
        fit = eqx.tree_at(lambda f: f.bend_std, fit, jnp.asarray(1e-9))
    return np.asarray(fit.locate(corners, zoom, board=board).residual)


def opencv(corners: np.ndarray, others: np.ndarray) -> dict:
    """OpenCV's calibration of one zoom, and photos not seen."""
    rows, columns = corners.shape[1:3]
    y, x = np.indices((rows, columns)).reshape(2, -1)
    board = np.stack([x, y, 0 * x], axis=1).astype(np.float32)
    seen = [grid.reshape(-1, 1, 2).astype(np.float32) for grid in corners]
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_ASPECT_RATIO
    start = np.array([[4000.0, 0, (SIZE[0] - 1) / 2], [0, 4000.0, (SIZE[1] - 1) / 2], [0, 0, 1]])
    flags |= cv2.CALIB_USE_INTRINSIC_GUESS
    until = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 30, 1e-6)
    _, matrix, k, _, _ = cv2.calibrateCamera(
        [board] * len(seen), seen, SIZE, start, None, flags=flags, criteria=until
    )
    distances = []
    for grid in others:
        _, turn, shift = cv2.solvePnP(board, grid.reshape(-1, 1, 2), matrix, k)
        placed, _ = cv2.projectPoints(board.astype(float), turn, shift, matrix, k)
        distances.append(np.linalg.norm(placed.reshape(rows, columns, 2) - grid, axis=-1))
    return {
        "focal": float(matrix[0, 0]),
        "missed": np.array(distances),
        "at": (matrix, k),
    }


def corrected(lens: zj.ZoomLens, focal: np.ndarray, corners: list[np.ndarray]) -> list[np.ndarray]:
    """All corners of each zoom, corrected."""
    return [
        np.asarray(lens(float(f)).undistort(jnp.asarray(of.reshape(-1, 2))))
        for f, of in zip(focal, corners, strict=True)
    ]


def scatter(both: list[list[np.ndarray]]) -> list[float]:
    """RMS distance between the corrected corners of two lenses, at each zoom."""
    return [rms(np.linalg.norm(a - b, axis=-1)) for a, b in zip(*both, strict=True)]


def off_curve(label: np.ndarray, focal: np.ndarray) -> float:
    """Largest relative distance of focal lengths from a parabola in the logarithm of the label."""
    curve = np.polyval(np.polyfit(np.log(label), np.log(focal), 2), np.log(label))
    return float(np.abs(np.log(focal) - curve).max())


def of_pairs(corners: np.ndarray, zoom: np.ndarray, lines: zj.lines.AnyCentreLines) -> dict:
    """The bundle adjustments and the straightness fit of both halves, for some pairs of halves."""
    rng, labels = np.random.default_rng(0), np.unique(zoom)
    by_zoom = [corners[zoom == label] for label in labels]
    found: dict[str, list] = {"bent": [], "flat": [], "straight": []}
    frame, photo_focal = np.asarray(lines.frame), np.asarray(lines.focal)
    focal_of = np.array([photo_focal[zoom == label][0] for label in labels])
    for _ in range(PAIRS):
        first = halves(zoom, rng)
        lenses: dict[str, list] = {"bent": [], "flat": [], "straight": []}
        for mine in (first, ~first):
            for name in ("bent", "flat"):
                fit = fitted(corners[mine], zoom[mine], flat=name == "flat")
                missed = not_seen(fit, corners[~mine], zoom[~mine])
                by = [rms(missed[zoom[~mine] == label]) for label in labels]
                alone = not_seen(fit, corners[~mine], zoom[~mine], rigid=True)
                here = corrected(fit.lens, np.asarray(fit.focal), by_zoom)
                lenses[name].append((here, fit, missed, by, alone))
            part = lines.weighted(mine[frame].astype(float))
            fit = zj.fit_zoom(part, centre="fit")
            lenses["straight"].append((corrected(fit.lens, focal_of, by_zoom),))
        for name, both in lenses.items():
            pair: dict = {"scatter": scatter([one[0] for one in both])}
            if name != "straight":
                pair |= {
                    "not_seen": rms(np.concatenate([one[2] for one in both])),
                    "not_seen_by_zoom": np.mean([one[3] for one in both], axis=0).tolist(),
                    "not_seen_rigid": rms(np.concatenate([one[4] for one in both])),
                    "median": float(np.nanmedian(np.concatenate([one[2] for one in both]))),
                    "focal": [np.asarray(one[1].focal).tolist() for one in both],
                    "focal_std": [np.asarray(one[1].focal_std).tolist() for one in both],
                    "off_curve": max(off_curve(labels, np.asarray(one[1].focal)) for one in both),
                }
            found[name].append(pair)
    return {"zooms": labels.tolist()} | {name: summary(pairs) for name, pairs in found.items()}


def summary(pairs: list[dict]) -> dict:
    """Means over the pairs of halves."""
    out: dict = {"scatter": np.sqrt(np.mean(np.square([p["scatter"] for p in pairs]), axis=0)).tolist()}
    if "focal" in pairs[0]:
        focal = np.array([p["focal"] for p in pairs])
        std = np.array([p["focal_std"] for p in pairs])
        apart = focal[:, 0] - focal[:, 1]
        out |= {
            "not_seen": float(np.sqrt(np.mean([p["not_seen"] ** 2 for p in pairs]))),
            "not_seen_by_zoom": np.mean([p["not_seen_by_zoom"] for p in pairs], axis=0).tolist(),
            "not_seen_of_pairs": [p["not_seen"] for p in pairs],
            "not_seen_rigid": float(np.sqrt(np.mean([p["not_seen_rigid"] ** 2 for p in pairs]))),
            "median": float(np.mean([p["median"] for p in pairs])),
            "focal": focal.mean(axis=(0, 1)).tolist(),
            "repeats": np.abs(apart / focal.mean(axis=1)).max(axis=0).tolist(),
            "in_deviations": float(np.sqrt(np.mean(apart**2 / np.sum(std**2, axis=1)))),
            "off_curve": max(p["off_curve"] for p in pairs),
        }
    return out


def of_opencv(corners: np.ndarray, zoom: np.ndarray) -> dict:
    """OpenCV's `calibrateCamera` on the first pair of halves."""
    first, labels = halves(zoom, np.random.default_rng(0)), np.unique(zoom)
    both = [
        [opencv(corners[m & (zoom == q)], corners[~m & (zoom == q)]) for q in labels]
        for m in (first, ~first)
    ]
    missed = [np.concatenate([half[i]["missed"] for half in both]) for i in range(len(labels))]
    focal = np.array([[of["focal"] for of in half] for half in both])
    apart = []
    for i, label in enumerate(labels):
        seen = corners[zoom == label].reshape(-1, 1, 2)
        a, b = (
            cv2.undistortPoints(seen, *half[i]["at"], P=half[i]["at"][0]).reshape(-1, 2) for half in both
        )
        apart.append(rms(np.linalg.norm(a - b, axis=-1)))
    return {
        "scatter": apart,
        "not_seen": rms(np.concatenate(missed)),
        "not_seen_by_zoom": [rms(of) for of in missed],
        "focal": focal.mean(axis=0).tolist(),
        "repeats": np.abs((focal[0] - focal[1]) / focal.mean(axis=0)).tolist(),
        "off_curve": max(off_curve(labels, of) for of in focal),
    }


def timed(fit: Callable[[], object]) -> tuple[float, float]:
    """Seconds, and seconds of processors, of the faster of two calls: the first may compile."""
    taken = []
    for _ in range(2):
        start, own = time.perf_counter(), time.process_time()
        jax.block_until_ready(fit())
        taken.append((time.perf_counter() - start, time.process_time() - own))
    return min(taken)


def run(data: Path) -> dict:
    """All measurements."""
    corners, zoom, _ = read_corners(data / "zoomcam")
    corners = corners.astype(float)
    lines = zj.lines.compress_any_centre(read_photos(data / "zoomcam"))
    many = np.arange(TIMED) % len(zoom)
    whole = fitted(corners, zoom, flat=False)
    return {
        "ours": of_pairs(corners, zoom, lines),
        "opencv": of_opencv(corners, zoom),
        "whole": {
            "focal": np.asarray(whole.focal).tolist(),
            "focal_std": np.asarray(whole.focal_std).tolist(),
            "bend": whole.bend.tolist(),
            "off_curve": off_curve(np.unique(zoom), np.asarray(whole.focal)),
            "rms": float(whole.fit.rms),
            "bend_photo": rms(np.asarray(whole.poses.bend)),
        },
        "time_s": {
            "a board a zoom": timed(lambda: fitted(corners[many], zoom[many], flat=False)),
        },
    }


def page(r: dict) -> list[str]:
    """The results as a page."""
    ours, labels = r["ours"], [f"{zoom:g}x" for zoom in r["ours"]["zooms"]]
    fits = {
        "bundle adjustment, bent board": ours["bent"],
        "bundle adjustment, flat board": ours["flat"],
        "`cv2.calibrateCamera`, zoom by zoom": r["opencv"],
    }
    ratio = [a / b for a, b in zip(ours["bent"]["scatter"], ours["straight"]["scatter"], strict=True)]
    return [
        "# Boards as what they are",
        "",
        f"116 photos of a zoom camera, fitted half against half: {PAIRS} pairs of halves. "
        "Paper of the board was bent otherwise from day to day, so that each zoom has its own "
        "shape. Aims: 0.62 px for photos not seen, a scatter of 0.6 of that of straightness, focal lengths "
        "that repeat within 1 % and lie on a smooth curve within 1 %.",
        "",
        "## Photos not seen",
        "",
        "RMS distance of corners, px. What each photo has by itself is refitted: its pose, and how the "
        "board bends in it beside its shape, 12 numbers for 660.",
        "",
        *table(
            ["fit", "all", *labels],
            (
                [name, *(f"{x:.3f}" for x in (of["not_seen"], *of["not_seen_by_zoom"]))]
                for name, of in fits.items()
            ),
        ),
        "",
        f"By pairs of halves {', '.join(f'{x:.3f}' for x in ours['bent']['not_seen_of_pairs'])} px. "
        f"With the pose alone refitted {ours['bent']['not_seen_rigid']:.3f} px: the board was taken up "
        "between photos of one zoom, and bent otherwise then. The median distance is "
        f"{ours['bent']['median']:.3f} px with the shape and {ours['flat']['median']:.3f} px without.",
        "",
        "## Lens, half against half",
        "",
        "RMS difference of corrected corners, px.",
        "",
        *table(
            ["fit", "mean", *labels],
            (
                [name, *(f"{x:.3f}" for x in (np.mean(of["scatter"]), *of["scatter"]))]
                for name, of in {**fits, "straightness": ours["straight"]}.items()
            ),
        ),
        "",
        f"The bundle adjustment's over that of straightness: {np.mean(ratio):.2f} in the mean over zooms "
        f"({', '.join(f'{x:.2f}' for x in ratio)}).",
        "",
        "## Focal lengths",
        "",
        "Mean of both halves, px; how far halves are apart, at most; and how far from a parabola in the "
        "logarithm of the zoom's label.",
        "",
        *table(
            ["fit", *labels, "apart, %", "off a curve, %"],
            (
                [
                    name,
                    *(f"{x:.0f}" for x in of["focal"]),
                    f"{100 * max(of['repeats']):.2f}",
                    f"{100 * of['off_curve']:.2f}",
                ]
                for name, of in fits.items()
            ),
        ),
        "",
        f"Halves differ by {ours['bent']['in_deviations']:.2f} of their standard deviations (RMS) with the "
        f"shape, and by {ours['flat']['in_deviations']:.2f} with a flat board.",
        "",
        "All photos together: f = "
        + ", ".join(
            f"{f:.0f} ± {s:.0f}" for f, s in zip(r["whole"]["focal"], r["whole"]["focal_std"], strict=True)
        )
        + f" px, {100 * r['whole']['off_curve']:.2f} % off the curve at most; the boards bend by "
        + ", ".join(f"{bend:.2f}" for bend in r["whole"]["bend"])
        + f" steps of the grid, and by {r['whole']['bend_photo']:.3f} (RMS) from photo to photo; RMS "
        f"{r['whole']['rms']:.3f} px.",
        "",
        "## Time",
        "",
        f"{TIMED} photos of 330 corners, compiled (the last figure to be taken, on an idle machine): "
        + "; ".join(
            f"{name} {wall:.1f} s ({own:.1f} s of processors)" for name, (wall, own) in r["time_s"].items()
        )
        + ".",
        "",
    ]


if __name__ == "__main__":
    main(__doc__, "boards", run, page)
