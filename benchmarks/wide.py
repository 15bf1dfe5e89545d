"""Lines in strongly bent photographs: a facade, an action camera's board, and rendered scenes with clutter.

    python -m benchmarks.wide [--sections NAMES] [--scenes N] [--program FILE] [--output FILE]

The facade and the board are read from the folder that the environment variable ZOOMJAX_DATA names. The
facade's reference is the robust fit of the line points that the program of the paper's authors found in it
(primitives.txt). That program itself (IPOL 2016, 10.5201/ipol.2016.130), built from its public source, is
run where `--program` names it. Rendered scenes have exact truth; they are kept as they come, so that a run
that was ended goes on. Results go to benchmarks/results/wide.md and wide.json after each section.
"""

import argparse
import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np

import zoomjax as zj
from zoomjax.app.calibrating import calibrate
from zoomjax.detect.edges import EdgeDetector
from zoomjax.detect.grid import GridDetector
from zoomjax.fit.centre import fit_centre

from .shared import RESULTS, machine, machine_line, real_data, table, write
from .wide_bands import bands, bands_page
from .wide_facade import RADII, as_lines, facade, fitted
from .wide_folder import folders_page, tied_and_apart
from .wide_scenes import Scene, hard_scene, render, scene

WITHIN = 0.5
"""px: a rendered scene's lens is found if its RMS distance from the truth, in the image, is less."""

NUMBERS = (16, 24, 32, 48, 64)
"""Of each scene's lines so many, the longest, are fitted: each number is a program to compile."""

POINTS = 64
"""Points of each of them."""

TOGETHER = 60
"""Scenes after which compiled programs are forgotten: a process can hold so many of them."""

SIZE = (1280, 720)

LINES_OF = ("automatic", "their points")
"""The facade's lines: found by us, and by the authors' program."""


def board(folder: Path) -> dict:
    """A board before an action camera: lenses from edges, from grids seen in part, and from whole ones."""
    edges: list[np.ndarray] = []
    rows: list[np.ndarray] = []
    whole: list[np.ndarray] = []
    seen = []
    for path in sorted(folder.glob("*.jpg")):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        if image.shape[::-1] != SIZE:
            continue
        edges += EdgeDetector()(image)
        grid = GridDetector().find(image)
        assert grid is not None
        rows += GridDetector.lines(grid)
        seen.append(int(np.isfinite(grid[..., 0]).sum()))
        found, corners = cv2.findChessboardCornersSB(image, (9, 6), flags=cv2.CALIB_CB_ACCURACY)
        if found:
            whole.append(corners.reshape(-1, 1, 2).astype(np.float32))
    flat = np.stack(np.meshgrid(np.arange(9), np.arange(6)), axis=-1).reshape(-1, 2)
    objects = np.column_stack([flat, np.zeros(54)]).astype(np.float32)
    _, camera, coefficients, *_ = cv2.calibrateCamera(
        [objects] * len(whole), whole, SIZE, None, None, flags=cv2.CALIB_ZERO_TANGENT_DIST
    )
    points = np.concatenate([line.astype(float) for line in rows])
    truth = cv2.undistortPoints(points[:, None], camera, coefficients, P=camera)[:, 0]
    robust = {"edges": centred(edges, SIZE), "grids": centred(rows, SIZE)}
    corrected = {who: np.asarray(fit.lens(1.0).undistort(points)) for who, (fit, _) in robust.items()}
    corrected["whole boards"] = truth
    on_whole = np.concatenate(whole)[:, 0].astype(float)
    certain = {who: np.asarray(fit.lens(1.0).undistort(on_whole)) for who, (fit, _) in robust.items()}
    certain["whole boards"] = cv2.undistortPoints(on_whole[:, None], camera, coefficients, P=camera)[:, 0]
    return {
        "photos": len(seen),
        "whole": len(whole),
        "corners": seen,
        "lines": {"edges": len(edges), "grids": len(rows)},
        "rejected": {who: number for who, (_, number) in robust.items()},
        "rms_px": {who: float(fit.rms) for who, (fit, _) in robust.items()},
        "centre_px": {who: np.asarray(fit.lens.centre).tolist() for who, (fit, _) in robust.items()},
        "camera_centre_px": camera[:2, 2].tolist(),
        "apart_px": {
            f"{one}, {other}": alike(corrected[one], corrected[other])
            | {"whole_rms": alike(certain[one], certain[other])["rms"]}
            for one, other in itertools.combinations(corrected, 2)
        },
    }


def centred(lines: Sequence[np.ndarray], size: tuple[int, int]) -> tuple[Any, int]:
    """The fit to the straight ones of the lines with its centre, and how many are not straight."""
    robust = fitted(lines, size)
    kept = as_lines(lines, size).weighted(np.asarray(robust.weight))
    return fit_centre(kept, zoom=zj.PolynomialZoom(degree=0), terms=2).fit, len(robust.rejected)


def alike(ours: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """px between two corrections of points, up to the homography that straightness cannot tell."""
    homography, _ = cv2.findHomography(ours, truth, 0)
    mapped = cv2.perspectiveTransform(ours[:, None], homography)[:, 0]
    far = np.linalg.norm(mapped - truth, axis=1)
    return {"rms": float(np.sqrt(np.mean(far**2))), "most": float(far.max())}


def rendered(seed: int) -> dict[str, Any]:
    """One rendered scene, calibrated as by `zoomjax calibrate`: how far the lens is from the true one."""
    made = scene(seed)
    edges = EdgeDetector().find(render(made))
    row: dict[str, Any] = {"seed": seed, "corner": made.corner, "unexplained": edges.unexplained}
    row |= {"lines": len(edges.lines), "error_px": None, "verdict": "not determined"}
    number = max((n for n in NUMBERS if n <= len(edges.lines)), default=0)
    if not number:
        return row
    try:
        done = calibrate(_lines(edges.lines[:number], made.size), centre="fit", robust=True)
    except (ValueError, RuntimeError) as error:
        return row | {"problem": str(error)}
    lens = done.fit.lens
    return row | {
        "error_px": apart(lens(1.0), made),
        "verdict": done.assessment.verdict,
        "distortion_model": type(lens.distortion_model).__name__,
        "rms_px": float(done.fit.rms),
        "std_px": float(done.assessment.evidence.std),
        "rejected": int(done.rejected.sum()),
        "centre_off_px": float(np.hypot(*(np.asarray(lens.centre) - made.centre))),
        "findings": [finding.about for finding in done.assessment.findings],
    }


def _lines(lines: Sequence[np.ndarray], size: tuple[int, int]) -> zj.Lines:
    """Lines of `POINTS` points each, of one photograph."""
    every = [line[np.linspace(0, len(line) - 1, POINTS).round().astype(int)] for line in lines]
    return zj.Lines.from_ragged(every, [0] * len(every), [1.0], image_size=size, focal_unit="px")


def apart(lens: zj.Distortion, made: Scene) -> float:
    """RMS px of the image, over the image, between the fitted correction and the true one.

    Straight lines cannot tell a homography of the corrected image, which is therefore taken out.
    """
    x, y = np.meshgrid(np.linspace(0.02, 0.98, 15), np.linspace(0.02, 0.98, 11))
    points = np.stack([x, y], axis=-1).reshape(-1, 2) * np.subtract(made.size, 1)
    truth = made.undistort(points)
    ours = np.asarray(lens.undistort(points))
    if not np.isfinite(ours).all():
        return float("inf")
    half = np.array([0.5, 0.0])
    stretch = np.linalg.norm(made.undistort(points + half) - made.undistort(points - half), axis=1)
    homography, _ = cv2.findHomography(ours, truth, 0)
    mapped = cv2.perspectiveTransform(ours[:, None], homography)[:, 0]
    return float(np.sqrt(np.mean(np.sum((mapped - truth) ** 2, axis=1) / stretch**2)))


def judged(rows: Sequence[dict]) -> dict[str, Any]:
    """How many scenes succeed, in how many of the rest the verdict says so, and how often it is wrong."""
    error = np.array([np.inf if row["error_px"] is None else row["error_px"] for row in rows])
    good = np.array([row["verdict"] == "good" for row in rows])
    found = error < WITHIN
    return {
        "scenes": len(rows),
        "within": int(found.sum()),
        "median_px": float(np.median(error)),
        "failed": int((~found).sum()),
        "failed_and_said": int((~found & ~good).sum()),
        "alarms": int((found & ~good).sum()),
    }


def markdown(results: dict) -> str:
    """The page of results, of the sections that were measured."""
    lines = ["# Lines in strongly bent photographs", "", "`python -m benchmarks.wide`", ""]
    for name, page in PAGES.items():
        if name == "bands" and name in results:
            lines += [*bands_page(results[name], results.get("facade")), ""]
        elif name in results:
            lines += [*page(results[name]), ""]
    return "\n".join([*lines, machine_line(results["machine"]), ""])


def _facade_page(house: dict) -> list[str]:
    fits = [
        [name, f"{fit['rms_px']:.2f}", str(fit["rejected"]), *_row(fit)]
        for name, fit in house["fits"].items()
    ]
    found, best = (np.array(house["fits"][f"by default, {of}"]["displacement_px"]) for of in LINES_OF)
    fits.append(
        [
            "the same, less that of their points, %",
            "",
            "",
            "",
            *(f"{x:+.1f}" for x in 100 * (found / best - 1)),
        ]
    )
    names = {"pol": "their program, polynomial", "div": "their program, division"}
    program = house.get("program", {})
    fits += [[names[model], "", "", *_row(of)] for model, of in program.items()]
    marks = house["labelled"]
    told = [
        "## A facade through a fisheye",
        "",
        f"{house['lines']} lines, found in {house['cpu_s']:.2f} s of one core's time; "
        f"{house['unexplained']:.0%} of the strong long edges are on none. By hand-made labels "
        f"{marks['right']} of them follow one edge each, {marks['doubtful']} follow the foot of the wall, "
        f"where stains are as long as the edge, and {marks['wrong']} join different things. They reach to "
        f"{house['reach']:.2f} of the way to the corner, the points of the authors' program to "
        f"{house['their_reach']:.2f}: beyond, the models extrapolate. Displacements, px, at shares of the "
        "way to the corner; straightness is that of the authors' points, px of the image, over the better "
        "nine tenths of their lines. The first four rows are about the image's centre; by default the "
        "division model takes over, and the centre is fitted.",
        "",
        *table(["", "RMS", "rejected", "straightness", *map(str, RADII)], fits),
    ]
    if not program:
        return [*told, "", "The authors' program was not at hand in this run."]
    runs = " and ".join(
        f"{of['lines']} lines in {of['cpu_s']:.1f} s with the {names[model].rpartition(' ')[2]}"
        for model, of in program.items()
    )
    when = "in an earlier run " if house.get("program_earlier") else ""
    return [
        *told,
        "",
        f"The authors' program, built from its public source, {when}finds {runs}, of all cores' time, "
        "pictures included. Its points of lines are not quite those of primitives.txt, which another build "
        "wrote.",
    ]


def _row(of: dict) -> list[str]:
    """Straightness and displacements."""
    return [f"{of['straightness_px']:.3f}", *(f"{value:.1f}" for value in of["displacement_px"])]


def _board_page(plate: dict) -> list[str]:
    rows = [
        [name, *(f"{far[key]:.2f}" for key in ("whole_rms", "rms", "most"))]
        for name, far in plate["apart_px"].items()
    ]
    middle = {who: f"({x:.1f}, {y:.1f})" for who, (x, y) in plate["centre_px"].items()}
    x, y = plate["camera_centre_px"]
    return [
        "## An action camera's board",
        "",
        f"{plate['photos']} photos, {plate['whole']} of them with all 54 corners; the grids that are seen "
        f"have {', '.join(map(str, plate['corners']))} corners. {plate['lines']['edges']} lines from edges "
        f"and {plate['lines']['grids']} rows and columns from grids, of which {plate['rejected']['edges']} "
        f"and {plate['rejected']['grids']} are rejected; RMS {plate['rms_px']['edges']:.2f} and "
        f"{plate['rms_px']['grids']:.2f} px. The centre is fitted: {middle['edges']} and {middle['grids']} "
        f"px, that of `cv2.calibrateCamera` on the whole boards is ({x:.1f}, {y:.1f}) px. Between the "
        "corrections are, px, up to a homography, on the corners of the whole boards and on all that are "
        "seen:",
        "",
        *table(["", "whole boards, RMS", "all seen, RMS", "all seen, largest"], rows),
    ]


def _rendered_page(rows: list[dict]) -> list[str]:
    of, groups = judged(rows), []
    for low, high in itertools.pairwise((-0.3, 0.0, 0.3, 0.6, 0.9, 1.2)):
        some = [row for row in rows if low <= row["corner"] < high]
        if some:
            part = judged(some)
            numbers = [part[name] for name in ("scenes", "within", "failed_and_said", "alarms")]
            groups.append([f"{low:+.0%} to {high:+.0%}", *map(str, numbers), f"{part['median_px']:.2f}"])
    said = "None of them fails, so that how often the verdict would say so is not measured."
    if of["failed"]:
        said = f"The verdict is not good in {of['failed_and_said']} of the other {of['failed']}."
    return [
        "## Rendered scenes",
        "",
        f"{of['scenes']} facades and halls with clutter, noise of 3 grey levels, JPEG, centre off by up to "
        f"5 %, calibrated as by `zoomjax calibrate` without options: the lens is within {WITHIN} px RMS of "
        f"the image of the true one, up to a homography, in {of['within']} of {of['scenes']} "
        f"({of['within'] / of['scenes']:.1%}); median {of['median_px']:.2f} px. {said} False alarms: "
        f"{of['alarms']} of {of['within']}. The true lens is of the "
        "division model with one term, which is one of those that are compared; real lenses are of none "
        "exactly. Of each scene's lines the longest "
        f"{', '.join(map(str, NUMBERS[:-1]))} or {NUMBERS[-1]} are fitted.",
        "",
        *table(
            ["corner displacement", "scenes", "within", "failed and said", "alarms", "median, px"], groups
        ),
    ]


def hard(seed: int) -> dict[str, Any]:
    """One hard scene, as `rendered`, with all of up to `NUMBERS[-1]` lines."""
    made = hard_scene(seed)
    edges = EdgeDetector().find(render(made))
    row: dict[str, Any] = {"seed": seed, "hard": made.hard, "lines": len(edges.lines)}
    row |= {"error_px": None, "verdict": "not determined"}
    if len(edges.lines) < 3:
        return row
    try:
        done = calibrate(_lines(edges.lines[: NUMBERS[-1]], made.size), centre="fit", robust=True)
    except (ValueError, RuntimeError):
        return row
    error = apart(done.fit.lens(1.0), made)
    evidence = done.assessment.summary()["evidence"]  # None for what is not finite
    return row | {
        "error_px": error if np.isfinite(error) else None,
        "verdict": done.assessment.verdict,
        "std_px": evidence["std"],
        "bent_std_px": evidence["bent_std"],
        "findings": [finding.about for finding in done.assessment.findings],
    }


def _hard_page(rows: list[dict]) -> list[str]:
    of, groups = judged(rows), []
    for kind in dict.fromkeys(row["hard"] for row in rows):
        part = judged([row for row in rows if row["hard"] == kind])
        numbers = [part[name] for name in ("scenes", "within", "failed", "failed_and_said", "alarms")]
        groups.append([kind, *map(str, numbers)])
    return [
        "## Hard scenes",
        "",
        "The same with two to five boards instead of a facade, a blur of 2.5 to 8 px, noise of 12 to 20 "
        f"grey levels, 40 to 160 more blobs, or images 120 to 240 px wide. {of['failed']} of "
        f"{of['scenes']} lenses are not within {WITHIN} px, and of {of['failed_and_said']} of these "
        f"({of['failed_and_said'] / max(of['failed'], 1):.0%}) the verdict is not good; the aim is 90 %. "
        f"False alarms: {of['alarms']} of {of['within']} ({of['alarms'] / max(of['within'], 1):.0%}); the "
        "aim is 5 %. "
        "A lens is good by the verdict if the lines determine it beyond a homography: to 0.4 px, or, of a "
        "strong lens, to 3 % of what it straightens.",
        "",
        *table(["", "scenes", "within", "failed", "failed and said", "alarms"], groups),
    ]


PAGES = {
    "facade": _facade_page,
    "bands": lambda told: bands_page(told, None),
    "board": _board_page,
    "rendered": _rendered_page,
    "hard": _hard_page,
    "folders": folders_page,
}
"""By section."""

EACH = {"rendered": rendered, "hard": hard, "folders": lambda seed: tied_and_apart(seed, 4)}
"""What measures one of the scenes of a section."""


def measure(name: str, given: argparse.Namespace, data: Path, measured: dict) -> None:
    """Measure a section, and write all that is known after each step."""

    def keep(of: Any) -> None:
        measured[name] = of
        write(given.output, markdown(measured), measured, quiet=True)

    if name not in EACH:
        whole = {"facade": lambda: facade(data, given.program), "bands": lambda: bands(data)}
        found = whole.get(name, lambda: board(data / "board"))()
        if "program" not in found and "program" in measured.get(name, {}):
            found |= {"program": measured[name]["program"], "program_earlier": True}
        keep(found)
        return
    rows = {row["seed"]: row for row in measured.get(name, [])}
    for seed in range(given.folders if name == "folders" else given.scenes):
        if seed not in rows:
            rows[seed] = EACH[name](seed)
            print(rows[seed], flush=True)
            keep(sorted(rows.values(), key=lambda row: row["seed"]))
            if seed % TOGETHER == TOGETHER - 1:
                jax.clear_caches()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sections", default=",".join(PAGES), help="which to measure; others stay")
    parser.add_argument("--scenes", type=int, default=200, help="number of rendered scenes")
    parser.add_argument("--folders", type=int, default=3, help="number of rendered folders")
    parser.add_argument("--program", type=Path, help="the authors' program, built")
    parser.add_argument("--output", type=Path, default=RESULTS / "wide.md")
    options = parser.parse_args()
    folder = real_data(parser) / "wide"
    jax.config.update("jax_enable_x64", True)
    kept = options.output.with_suffix(".json")
    results = json.loads(kept.read_text()) if kept.exists() else {}
    results["machine"] = machine()
    for section in options.sections.split(","):
        measure(section, options, folder, results)
    print(markdown(results))
