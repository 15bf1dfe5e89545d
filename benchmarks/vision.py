"""How fast, exactly and completely lines are found in images, and what lens they give.

    python -m benchmarks.vision [--rounds N] [--output FILE]

Rendered photos of the paper's board have exact truth. Real photos are read from the folder that the
environment variable ZOOMJAX_DATA names; without it what needs them is left out, and the page says so.
Times are of one process, taking turns, so that all see the same disturbances: medians, and medians of the
ratios within a round. Results go to benchmarks/results/vision.md and vision.json.
"""

import argparse
import itertools
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

import zoomjax as zj
from zoomjax import scenes
from zoomjax.app.demo import IMAGE_SIZE, worst_error

from .correct import HD, in_turn, summary
from .shared import RESULTS, machine, write

SHARP, NOISY = "blur 0.7 px, no noise", "blur 1 px, noise 5"
CONDITIONS = {SHARP: (0.7, 0.0), NOISY: (1.0, 5.0)}

FRAMES_LABELLED = Path(__file__).parents[1] / "tests" / "detect" / "pitch_labels.json"
NEAR = 3.0
"""px: what is so near to a label agrees with it."""


def read_image(path: Path, flags: int = cv2.IMREAD_COLOR) -> Any:
    image = cv2.imread(str(path), flags)
    if image is None:
        raise FileNotFoundError(f"Cannot read the image {path}.")
    return image


def speed(data: Path | None, rounds: int) -> dict:
    """The detectors beside what OpenCV takes for edges of pixels, with all threads and with one."""
    photo = scenes.board_photo(scenes.nikkor_18_200(), 20.56, blur=1, noise=2)

    def with_threads(number: int, function: Callable) -> Callable:
        def run():
            cv2.setNumThreads(number)
            return function()

        return run

    def canny():
        return cv2.Canny(cv2.GaussianBlur(photo, (0, 0), 1), 50, 150)

    functions, ratios = {}, {}
    for name, number in (("all threads", -1), ("one thread", 1)):
        functions[f"12 MP: GaussianBlur and Canny, {name}"] = with_threads(number, canny)
        functions[f"12 MP: EdgeDetector, {name}"] = with_threads(number, lambda: zj.EdgeDetector()(photo))
        ratios[name] = (f"12 MP: EdgeDetector, {name}", f"12 MP: GaussianBlur and Canny, {name}")
    if data:
        frame = cv2.resize(read_image(data / "broadcast_frames" / "frame_000.jpg"), HD)
        board = read_image(data / "zoomcam" / "zoom_1x" / "1x_zoom_1.png")
        functions["1080p: PitchDetector, one thread"] = with_threads(
            1, lambda: zj.detect.PitchDetector()(frame)
        )
        functions["720p: GridDetector, all threads"] = with_threads(
            -1, lambda: zj.detect.GridDetector()(board)
        )
    times = in_turn(functions, rounds)
    cv2.setNumThreads(-1)
    return summary(times, ratios)


def rendered() -> dict:
    """Photos of the paper's board at 12 focal lengths: what is found, how exactly, and the lens from it."""
    lens, focals = scenes.nikkor_18_200(IMAGE_SIZE), scenes.focal_sweep(12)
    results = {}
    for name, (blur, noise) in CONDITIONS.items():
        points: list[np.ndarray] = []
        frame: list[int] = []
        errors, seen = [], []
        for index, focal in enumerate(focals):
            photo = scenes.board_photo(lens, focal, blur=blur, noise=noise, seed=index)
            found = zj.EdgeDetector()(photo)
            error, counts = against_truth(found, lens, float(focal))
            errors.append(error)
            seen.append(counts)
            points += found
            frame += [index] * len(found)
        lines = zj.Lines.from_ragged(points, frame, focals, image_size=IMAGE_SIZE)
        fitted = zj.fit_zoom(zj.compress(lines)).lens
        results[name] = {
            "rms_px": float(np.sqrt(np.mean(np.concatenate(errors) ** 2))),
            "worst_rms_px": max(float(np.sqrt(np.mean(error**2))) for error in errors),
            "mean_px": float(np.mean(np.concatenate(errors))),
            "lens_px": worst_error(fitted, lens, focals),
            "missed_within_px": max(counts.pop("missed_within_px") for counts in seen),
            **{key: sum(counts[key] for counts in seen) for key in seen[0]},
        }
        print(name, json.dumps(results[name]), flush=True)
    return results


def against_truth(
    found: Sequence[np.ndarray], lens: zj.ZoomLens, focal: float
) -> tuple[np.ndarray, dict[str, Any]]:
    """Distances of points to their true borders, px in the image, and which borders were found.

    To first order: the distance in the corrected image, where borders are straight, over how much the
    correction stretches the image across the border there.
    """
    board = scenes.StripedBoard.before(lens)
    edges = [board.magnification(focal) * board.edges(axis) for axis in (0, 1)]
    correct = lens(focal).undistort

    def border(line: np.ndarray) -> tuple[tuple[int, int], np.ndarray]:
        """Which border is nearest, as axis and number, and the distances to it."""
        corrected = np.asarray(correct(jnp.asarray(line)) - lens.centre)
        best = None
        for axis in (0, 1):
            number = int(np.argmin(abs(edges[axis] - corrected[:, axis].mean())))
            apart = corrected[:, axis] - edges[axis][number]
            if best is None or np.mean(apart**2) < np.mean(best[1] ** 2):
                best = (axis, number), apart
        assert best is not None
        axis = best[0][0]
        steps = [jnp.asarray(line + step) for step in ([0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5])]
        right, left, below, above = (np.asarray(correct(moved))[:, axis] for moved in steps)
        return best[0], best[1] / np.hypot(right - left, below - above)

    errors, longest = [np.zeros(0)], {}
    counts: dict[str, Any] = {"lines": len(found), "false": 0, "again": 0, "visible": 0, "found": 0}
    counts["missed_within_px"] = 0.0
    for line in found:
        which, error = border(line)
        if np.sqrt(np.mean(error**2)) > 1:
            counts["false"] += 1
            continue
        counts["again"] += which in longest
        longest[which] = max(longest.get(which, 0), extent(line))
        errors.append(error)
    for line in scenes.board_lines(lens, np.array([focal]), spacing=2.0).to_ragged():
        line = np.asarray(line)
        if extent(line) < min(lens.image_size) / 4:
            continue
        counts["visible"] += 1
        if longest.get(border(line)[0], 0) >= extent(line) / 2:
            counts["found"] += 1
        else:
            middle = line[len(line) // 2]
            to_edge = float(np.min([middle, np.subtract(lens.image_size, 1) - middle]))
            counts["missed_within_px"] = max(counts["missed_within_px"], to_edge)
    return np.concatenate(errors), counts


def extent(line: np.ndarray) -> float:
    """px from the first point to the last."""
    return float(np.hypot(*(line[-1] - line[0])))


def real_boards(folder: Path) -> dict:
    """Photos of a checkerboard at five zooms: grid and edges, and the lenses from both."""
    zooms, focal = np.loadtxt(folder / "focal_px.csv", delimiter=",", skiprows=1).T
    points: dict[str, list[np.ndarray]] = {"grid": [], "edges": []}
    frame: dict[str, list[int]] = {"grid": [], "edges": []}
    half: list[int] = []  # of the grid's lines: alternately one photo in this half, one in the other
    boards, covered = [], []
    for index, zoom in enumerate(zooms):
        for number, path in enumerate(sorted((folder / f"zoom_{zoom:g}x").glob("*.png"))):
            image = read_image(path)
            found = {"grid": zj.detect.GridDetector()(image), "edges": zj.EdgeDetector()(image)}
            boards.append(len(found["grid"]))
            half += [number % 2] * len(found["grid"])
            covered += [in_one_piece(line, found["edges"]) for line in found["grid"]]
            for name, lines in found.items():
                points[name] += lines
                frame[name] += [index] * len(lines)

    def compressed(name: str, chosen: Sequence[bool] | None = None) -> zj.lines.CompressedLines:
        keep = range(len(points[name])) if chosen is None else np.flatnonzero(chosen)
        lines = zj.Lines.from_ragged(
            [points[name][i] for i in keep],
            [frame[name][i] for i in keep],
            focal,
            image_size=(1280, 720),
            focal_unit="px",
        )
        return zj.compress(lines)

    lenses, results = {}, {}
    for name in points:
        small = compressed(name)
        weight = zj.fit_robust(small).weight
        for way, lines in (("plain", small), ("robust", small.weighted(weight))):
            fit, each = zj.fit_zoom(lines), zj.fit_frames(lines)
            lenses[name, way] = fit.lens
            results[f"{name}, {way}"] = {
                "rms_zoom_px": float(fit.rms),
                "rms_each_px": float(each.rms),
                "excess": float(fit.rms / each.rms) - 1,
                "lines": len(points[name]),
                "rejected": int(jnp.sum(weight == 0)) if way == "robust" else 0,
            }
    for way, fit in (("plain", zj.fit_zoom), ("robust", lambda lines: zj.fit_robust(lines).fit)):
        for part in (0, 1):
            lenses[f"half {part}", way] = fit(compressed("grid", np.array(half) == part)).lens
    reach = np.concatenate([np.hypot(*(line - [639.5, 359.5]).T) for line in points["grid"]])
    scale = float(np.hypot(1280, 720) / 2)
    return {
        "photos": len(boards),
        "boards": sum(n > 0 for n in boards),
        "whole_boards": sum(n == 22 + 15 for n in boards),
        "grid_lines": len(covered),
        "in_one_piece": float(np.mean(covered)),
        "reach": float(np.quantile(reach, 0.99)) / scale,
        "zooms": zooms.tolist(),
        "fits": results,
        "apart_px": {
            f"{place}, {way}": {
                pair: [apart(lenses[a, way], lenses[b, way], float(f), radius) for f in focal]
                for pair, (a, b) in (
                    ("edges and grid", ("edges", "grid")),
                    ("grid of half the photos and of the others", ("half 0", "half 1")),
                )
            }
            for place, radius in (("corner", 1.0), ("0.7 of it", 0.7))
            for way in ("plain", "robust")
        },
    }


def in_one_piece(line: np.ndarray, found: Sequence[np.ndarray]) -> bool:
    """Whether one of the lines found follows at least nine tenths of this one."""
    middle = line.mean(axis=0)
    way = (line[-1] - line[0]) / extent(line)
    aside = np.array([-way[1], way[0]])
    along = (line - middle) @ way
    bend = np.polyfit(along, (line - middle) @ aside, 3)
    for other in found:
        place = (other - middle) @ way
        within = (place > along[0]) & (place < along[-1])
        if not within.any() or np.ptp(place[within]) < 0.9 * np.ptp(along):
            continue
        if np.median(abs((other - middle) @ aside - np.polyval(bend, place))[within]) < 1.5:
            return True
    return False


def apart(one: zj.ZoomLens, other: zj.ZoomLens, focal: float, radius: float) -> float:
    """px between two corrections of a point on the diagonal, by its share of the way to the corner."""
    point = one.centre * (1 - radius)
    return float(jnp.linalg.norm(one(focal).undistort(point) - other(focal).undistort(point)))


def pattern(folder: Path) -> dict:
    """A printed grid of bars: borders found over the whole image, and changes of tone counted across."""
    image = read_image(folder / "line_pattern_01.jpg", cv2.IMREAD_GRAYSCALE)
    found = zj.EdgeDetector()(image)
    results = {}
    for name, axis in (("upright", 0), ("level", 1)):  # the axis that such lines are counted along
        side = image.shape[axis]  # px that they extend over
        full = [line for line in found if np.ptp(line[:, 1 - axis]) >= 0.95 * side]
        middles = np.sort([crossing(line, axis, side / 2) for line in full])
        results[name] = {
            "found": len(full),
            "counted": changes_of_tone(image if axis == 0 else image.T),
            "nearest_px": float(np.diff(middles).min()),
        }
    return results | {"lines": len(found)}


def crossing(line: np.ndarray, axis: int, position: float) -> float:
    """Where a line is on an axis when it is at a position on the other one."""
    order = np.argsort(line[:, 1 - axis])
    return float(np.interp(position, line[order, 1 - axis], line[order, axis]))


def changes_of_tone(image: np.ndarray) -> int:
    """How often dark and bright change along the brightest of the rows in the middle: between bars."""
    height = image.shape[0]
    rows = image[round(0.45 * height) : round(0.55 * height)]
    row = rows[np.argmax(np.median(rows, axis=1))].astype(float)
    bright = row > (row.min() + np.median(row)) / 2
    return int(np.sum(bright[1:] != bright[:-1]))


def broadcast(folder: Path) -> dict:
    """Labelled frames: markings found, what was found that is none, and arcs taken for lines."""
    labels = json.loads(FRAMES_LABELLED.read_text())
    recall, precision, on_arcs = [], [], 0
    for name, label in labels.items():
        found = zj.detect.PitchDetector()(read_image(folder / f"{name}.jpg"))
        lines, arcs = sampled(label["lines"]), sampled(label["arcs"])
        recall.append(np.mean(is_near(lines, np.concatenate(found))))
        steps = [np.hypot(*np.diff(line, axis=0, append=line[-1:]).T) for line in found]
        weights = np.minimum(np.concatenate(steps), NEAR)
        precision.append(np.average(is_near(np.concatenate(found), lines), weights=weights))
        on_arcs += sum(np.mean(is_near(line, arcs) & ~is_near(line, lines)) >= 0.05 for line in found)
    return {
        "frames": len(labels),
        **{
            name: {"mean": float(np.mean(values)), "least": float(np.min(values))}
            for name, values in (("recall", recall), ("precision", precision))
        },
        "lines_on_arcs": int(on_arcs),
    }


def sampled(lines: Sequence) -> np.ndarray:
    """Points along polylines, every half px."""
    parts = []
    for line in lines:
        for start, end in itertools.pairwise(np.array(line)):
            number = max(int(2 * np.hypot(*(end - start))), 1)
            parts.append(start + (end - start) * np.arange(number)[:, None] / number)
    return np.concatenate(parts)


def is_near(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    return KDTree(others).query(points)[0] <= NEAR


def verdict(value: float, aim: float, unit: str = "", *, least: bool = False) -> str:
    """What was measured, what was aimed at, and whether it is met."""
    met = value >= aim if least else value <= aim
    factor = 100 if unit == " %" else 1
    shown = f"{factor * value:.3g}" if abs(factor * value) < 100 else f"{factor * value:.0f}"
    sign = "≥ " if least else "≤ " if aim else ""
    return f"{shown}{unit} | {sign}{factor * aim:g}{unit} | {'yes' if met else 'no'}"


def aims(r: dict) -> list[tuple[str, str]]:
    """What is measured, and the verdict on it."""
    ms = r["speed"]["ms"]
    rows = [
        (f"12 MP: EdgeDetector / GaussianBlur and Canny, {name}", verdict(ratio, 10))
        for name, ratio in r["speed"]["ratio"].items()
    ]
    if (name := "1080p: PitchDetector, one thread") in ms:
        rows.append((f"{name}, frames/s", verdict(1e3 / ms[name], 10, least=True)))
    for name, aim in ((SHARP, 0.03), (NOISY, 0.10)):
        scene = r["rendered"][name]
        share = scene["found"] / scene["visible"]
        rows += [
            (f"rendered, {name}: distance to the true border, RMS", verdict(scene["rms_px"], aim, " px")),
            (f"rendered, {name}: borders found", verdict(share, 0.95, " %", least=True)),
            (f"rendered, {name}: false lines", verdict(scene["false"], 0)),
            (f"rendered, {name}: fitted lens, greatest distance", verdict(scene["lens_px"], 0.1, " px")),
        ]
    if boards := r["boards"]:
        for name, fit in boards["fits"].items():
            rows.append((f"real boards, {name}: RMS over that of each zoom", excess(fit["excess"])))
        for place, pairs in boards["apart_px"].items():
            if place.startswith("corner"):
                worst = max(pairs["edges and grid"])
                rows.append((f"real boards, edges and grid apart, {place}", verdict(worst, 1.5, " px")))
    if grid := r["pattern"]:
        for name in ("upright", "level"):
            counts = grid[name]
            met = "yes" if counts["found"] == counts["counted"] and counts["nearest_px"] >= 2 else "no"
            rows.append(
                (f"printed grid, {name} borders", f"{counts['found']} | {counts['counted']} | {met}")
            )
    if frames := r["broadcast"]:
        rows += [
            (
                f"broadcast, {name}, least of the frames",
                verdict(frames[name]["least"], aim, " %", least=True),
            )
            for name, aim in (("recall", 0.8), ("precision", 0.95))
        ]
        rows.append(("broadcast, arcs taken for lines", verdict(frames["lines_on_arcs"], 0)))
    return rows


def excess(value: float) -> str:
    return f"+{100 * value:.2f} % | ≤ +1.5 % | {'yes' if value <= 0.015 else 'no'}"


def markdown(r: dict) -> str:
    """The results as a page."""
    m = r["machine"]
    lines = [
        "# Finding lines",
        "",
        "`python -m benchmarks.vision`. Times are medians; ratios are medians of the ratios within a round "
        "of turns.",
        "",
        f"{m['cpu']}, {m['cores']} cores, {m['memory_GB']} GB; Python {m['python']}, "
        f"zoomjax {m['zoomjax']}, jax {m['jax']}, numpy {m['numpy']}, OpenCV {m['opencv']}.",
        "",
        "| what | measured | aim | met |",
        "|---|---:|---:|---|",
        *(f"| {name} | {text} |" for name, text in aims(r)),
        "",
        "## Speed",
        "",
        "| | ms |",
        "|---|---:|",
        *(f"| {name} | {ms:.0f} |" for name, ms in r["speed"]["ms"].items()),
        "",
        "The photo has 4288 × 2848 px, grey; Canny's thresholds are 50 and 150.",
        "",
        *rendered_part(r["rendered"]),
    ]
    if r["boards"] is None:
        return "\n".join(
            [
                *lines,
                "## Real photos",
                "",
                "Left out: the environment variable ZOOMJAX_DATA names no folder with them.",
                "",
            ]
        )
    grid, frames = r["pattern"], r["broadcast"]
    return "\n".join(
        [
            *lines,
            *boards_part(r["boards"]),
            "## A printed grid",
            "",
            f"2560 × 2160 px, dark bars on white, {grid['lines']} lines found. The aim is the number of "
            "changes between dark and bright along one row and one column between bars, counted without "
            "the detector. Those found extend over 95 % of the image or more; where they cross its middle "
            f"the nearest two are {grid['upright']['nearest_px']:.1f} px (upright) and "
            f"{grid['level']['nearest_px']:.1f} px (level) apart.",
            "",
            "## Broadcast football",
            "",
            f"{frames['frames']} frames of 1280 × 720 px, labelled by hand: how much of the length of the "
            f"labels is within {NEAR:g} px of a line found (recall), and of the lines within that of a "
            "label (precision).",
            "",
            "| | mean | least |",
            "|---|---:|---:|",
            *(
                f"| {name} | {100 * frames[name]['mean']:.1f} % | {100 * frames[name]['least']:.1f} % |"
                for name in ("recall", "precision")
            ),
            "",
        ]
    )


def rendered_part(results: dict) -> list[str]:
    rows = []
    for name, x in results.items():
        cells = [
            f"{x['lines']:,}",
            f"{x['found']:,} of {x['visible']:,}",
            f"{x['again']}",
            f"{x['rms_px']:.4f}",
            f"{x['worst_rms_px']:.4f}",
            f"{x['mean_px']:+.4f}",
            f"{x['lens_px']:.4f}",
        ]
        rows.append(f"| {name} | {' | '.join(cells)} |")
    return [
        "## Rendered photos",
        "",
        f"The paper's board through its published lens, {IMAGE_SIZE[0]} × {IMAGE_SIZE[1]} px, 12 focal "
        "lengths. Distances are px in the photo, to first order: those in the corrected image, over how "
        "much it is stretched there. A border counts as visible if as much of it as a quarter of the "
        "image's shorter side is; as found if one line follows half of that or more; a line is false if "
        "its RMS distance to the nearest border is above 1 px. The lens is that of `fit_zoom`, with the "
        "true focal lengths; its distance to the true one is the greatest on 20 × 20 points of all 12 "
        "images.",
        "",
        "The middles of the borders that are missed are within "
        f"{max(x['missed_within_px'] for x in results.values()):.1f} px of the image's edge.",
        "",
        "| | lines | borders found | in pieces | RMS, px | worst photo | mean | lens, px |",
        "|---|---:|---:|---:|---:|---:|---:|---:|",
        *rows,
        "",
    ]


def boards_part(r: dict) -> list[str]:
    zooms = [f"{zoom:g}×" for zoom in r["zooms"]]
    fits = [
        f"| {name} | {x['lines']:,} | {x['rejected']} | {x['rms_zoom_px']:.4f} | {x['rms_each_px']:.4f} | "
        f"{100 * x['excess']:+.2f} % |"
        for name, x in r["fits"].items()
    ]
    distances = [
        f"| {place}: {pair} | {' | '.join(f'{x:.2f}' for x in values)} |"
        for place, pairs in r["apart_px"].items()
        for pair, values in pairs.items()
    ]
    return [
        "## Real boards",
        "",
        f"{r['photos']} photos, 1280 × 720 px, of a checkerboard of 22 × 15 corners at five zooms of a "
        f"surveillance camera; all photos of a zoom are one frame. `GridDetector` finds {r['boards']} "
        f"boards, {r['whole_boards']} of them whole. `EdgeDetector` finds {100 * r['in_one_piece']:.1f} % "
        f"of their {r['grid_lines']:,} rows and columns in one piece (within 1.5 px of nine tenths of it). "
        "RMS, px, of the zoom model of degree 2 and of each zoom by itself:",
        "",
        "| | lines | rejected | zoom model | each zoom | excess |",
        "|---|---:|---:|---:|---:|---:|",
        *fits,
        "",
        "The board is paper on a wall and not flat: that is what is left, and it bends the lenses, too. "
        f"It also reaches only to {r['reach']:.2f} of the half diagonal, so that the corner is "
        "extrapolated. How far apart, px, two lenses correct a point on the diagonal: those from edges and "
        "from the grid, and, to judge these, those from the grids of alternate photos:",
        "",
        f"| | {' | '.join(zooms)} |",
        f"|---|{'---:|' * len(zooms)}",
        *distances,
        "",
    ]


def run(rounds: int) -> dict:
    """All measurements."""
    named = os.environ.get("ZOOMJAX_DATA")
    data = Path(named) if named else None
    results: dict[str, Any] = {"speed": speed(data, rounds)}
    print(json.dumps(results, indent=1), flush=True)
    results["rendered"] = rendered()
    results["boards"] = real_boards(data / "zoomcam") if data else None
    results["pattern"] = pattern(data / "line_patterns") if data else None
    results["broadcast"] = broadcast(data / "broadcast_frames") if data else None
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=9, help="turns of what is timed")
    parser.add_argument("--output", type=Path, default=RESULTS / "vision.md")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    measured = {"machine": machine() | {"opencv": cv2.__version__}, **run(given.rounds)}
    write(given.output, markdown(measured), measured)
