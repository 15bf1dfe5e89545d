"""The facade on which the paper's authors show their program: what is found by everything automatic.

The edges of the facade are labelled by hand in wide_labels.json, looked at one by one in an enlarged
picture: each has points along it, px, and some are doubtful (the foot of the wall, where stains and dirt
are as long as the edge). A line found is right if all of its points are near one labelled edge.
"""

import json
import re
import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import zoomjax as zj
from zoomjax.app.calibrating import calibrate
from zoomjax.detect.batch import detect
from zoomjax.detect.edges import EdgeDetector
from zoomjax.detect.sources import find_photos
from zoomjax.models.division import Division

RADII = np.array([0.2, 0.4, 0.6, 0.8, 0.9, 1.0])
"""Of the way to the corner."""

_LABELS = Path(__file__).with_name("wide_labels.json")
_SIZE = (1072, 712)
"""Of the photo, px."""

_NEAR = 3.0
"""px from a labelled edge."""

_SETTINGS = ("0.8", "0.0", "3.0", "3.0", "10.0")
"""Of the authors' program: Canny's high threshold, the range of distortion, and two tolerances."""


def facade(folder: Path, program: Path | None) -> dict:
    """The facade by itself, beside the fits to the authors' line points, and beside their program."""
    path = folder / "building.png"
    image = cv2.imread(str(path))
    assert image is not None
    size = (image.shape[1], image.shape[0])
    detector, times = EdgeDetector(), []
    edges = detector.find(image)
    for _ in range(5):
        start = time.process_time()
        edges = detector.find(image)
        times.append(time.process_time() - start)
    theirs = primitives(folder / "primitives.txt", size[1])
    own = list(next(detect(find_photos([path]), detector)).lines)
    best = {who: _by_default(lines, size) for who, lines in (("theirs", theirs), ("own", own))}
    result: dict[str, Any] = {
        "lines": len(edges.lines),
        "labelled": labelled(edges.lines),
        "unexplained": edges.unexplained,
        "cpu_s": float(np.median(times)),
        "reach": _reach(edges.lines, size),
        "their_reach": _reach(theirs, size),
        "fits": {},
    }
    for model, distortion_model in (("polynomial", None), ("division", Division())):
        for who, lines in (("their points", theirs), ("automatic", own)):
            robust = fitted(lines, size, distortion_model)
            found = _figures(robust.fit.lens(1.0), theirs)
            found |= {"rms_px": float(robust.fit.rms), "rejected": len(robust.rejected)}
            result["fits"][f"{model}, {who}"] = found
    for who, done in best.items():
        lens = done.fit.lens
        found = _figures(lens(1.0), theirs) | {
            "rms_px": float(done.fit.rms),
            "rejected": int(done.rejected.sum()),
            "distortion_model": type(lens.distortion_model).__name__,
            "centre_px": np.asarray(lens.centre).tolist(),
            "verdict": done.assessment.verdict,
        }
        result["fits"]["by default, " + {"theirs": "their points", "own": "automatic"}[who]] = found
    if program is not None:
        result["program"] = {model: run_program(program, path, model, theirs) for model in ("pol", "div")}
    return result


def fitted(
    lines: Sequence[np.ndarray], size: tuple[int, int], distortion_model: Any = None, terms: int = 2
) -> Any:
    """The robust fit to the lines of one photograph, about the image's centre."""
    return zj.fit_robust(
        as_lines(lines, size),
        zoom=zj.PolynomialZoom(degree=0),
        distortion_model=distortion_model,
        terms=terms,
        throw=False,
    )


def as_lines(lines: Sequence[np.ndarray], size: tuple[int, int]) -> zj.Lines:
    """The lines of one photograph of which no focal length is known."""
    every = [line[:: max(1, len(line) // 60)] for line in lines]
    return zj.Lines.from_ragged(every, [0] * len(every), [1.0], image_size=size, focal_unit="px")


def _by_default(lines: Sequence[np.ndarray], size: tuple[int, int]) -> Any:
    """As `zoomjax calibrate` without options."""
    return calibrate(as_lines(lines, size), centre="fit", robust=True)


def displacements(distortion: Any, size: tuple[int, int]) -> np.ndarray:
    """px by which points at the `RADII`, shares of half the diagonal, move outwards from the centre."""
    centre = np.asarray(distortion.centre)
    r = RADII * np.hypot(*size) / 2
    towards = -np.array(size) / np.hypot(*size)
    moved = np.asarray(distortion.undistort(centre + r[:, None] * towards))
    return np.hypot(*(moved - centre).T) - r


def straightness(lines: Sequence[np.ndarray], distortion: Any) -> float:
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


def _figures(distortion: Any, theirs: Sequence[np.ndarray]) -> dict[str, Any]:
    return {
        "displacement_px": displacements(distortion, _SIZE).tolist(),
        "straightness_px": straightness(theirs, distortion),
    }


def _reach(lines: Sequence[np.ndarray], size: tuple[int, int]) -> float:
    """The farthest point of lines, of the way from the middle to the corner."""
    centre = (np.array(size) - 1) / 2
    return float(max(np.hypot(*(line - centre).T).max() for line in lines) / np.hypot(*centre))


def labelled(lines: Sequence[np.ndarray]) -> dict[str, int]:
    """How many lines follow one labelled edge, how many a doubtful one, and how many none: wrong."""
    labels = json.loads(_LABELS.read_text())
    counts = {"right": 0, "doubtful": 0, "wrong": 0}
    for line in lines:
        far = [_distance(line, np.array(label["points"], float)).max() for label in labels]
        nearest = int(np.argmin(far))
        kind = "doubtful" if labels[nearest]["doubtful"] else "right"
        counts[kind if far[nearest] <= _NEAR else "wrong"] += 1
    return counts


def _distance(points: np.ndarray, polyline: np.ndarray) -> np.ndarray:
    """px from points (n, 2) to a polyline (m, 2)."""
    start, step = polyline[:-1], np.diff(polyline, axis=0)
    offset = points[:, None] - start
    share = np.clip(np.sum(offset * step, axis=-1) / np.sum(step * step, axis=-1), 0, 1)
    return np.linalg.norm(offset - share[..., None] * step, axis=-1).min(axis=1)


def primitives(path: Path, height: int) -> list[np.ndarray]:
    """The points of the lines in an output file of the authors' program, which counts rows from below."""
    lines = []
    for block in path.read_text().split("line points :")[1:]:
        values = block.split()
        number = int(values[0])
        points = np.array(values[1 : 1 + 2 * number], float).reshape(number, 2)
        lines.append(np.stack([points[:, 0], height - 1 - points[:, 1]], axis=-1))
    return lines


def run_program(program: Path, image: Path, model: str, theirs: Sequence[np.ndarray]) -> dict[str, Any]:
    """What the authors' program finds in an image, with the settings of their page, and its time."""
    with tempfile.TemporaryDirectory() as folder:
        (inputs := Path(folder, "in")).mkdir()
        (outputs := Path(folder, "out")).mkdir()
        (inputs / image.name).symlink_to(image)
        command = [str(program), f"{inputs}/", f"{outputs}/", *_SETTINGS, model, "True"]
        before = _child_time()
        subprocess.run(command, check=True, capture_output=True)
        spent = _child_time() - before
        text = (outputs / f"{image.stem}.calib").read_text()
    numbers = re.findall(r"= *\(?([-+.\deE]+)(?: +([-+.\deE]+)\))?", text.split("NUMBER OF LINES")[0])
    centre = np.array(numbers[0], float)
    k = np.array([first for first, _ in numbers[3:]], float)
    centre[1] = _SIZE[1] - 1 - centre[1]
    lens = _Theirs(centre, k, division=model == "div")
    lines = int(re.search(r"NUMBER OF LINES = (\d+)", text)[1])  # pyright: ignore[reportOptionalSubscript]
    return _figures(lens, theirs) | {"lines": lines, "cpu_s": spent, "centre_px": centre.tolist()}


def _child_time() -> float:
    """CPU seconds of all processes that were started and have ended."""
    import resource

    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


class _Theirs:
    """A lens as the authors' program writes it: k0 + k1 r^2 + k2 r^4, r in px, a factor or a divisor."""

    def __init__(self, centre: np.ndarray, k: np.ndarray, *, division: bool):
        self.centre, self.k, self.division = centre, k, division

    def undistort(self, points: np.ndarray) -> np.ndarray:
        """Corrected positions of points (n, 2), px."""
        offset = np.asarray(points) - self.centre
        factor = np.polyval([*self.k[::-1], 1.0], np.sum(offset**2, axis=-1))[..., None]
        return self.centre + (offset / factor if self.division else offset * factor)
