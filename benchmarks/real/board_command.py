"""What `zoomjax calibrate --detector grid --focal plane` makes of photos of a bent board.

    python -m benchmarks.real.board_command [--output FILE]

The 30 photos of the zoom camera (see zoomcam.py), six a zoom, each zoom in a folder, as a user would give
them: with a focal length a photo, and with one a folder. Beside it the same by homographies alone, as if
the board were flat. The truth is the bundle adjustment of all 116 photos of that camera, of which these are
a part: focal lengths and where all corners of a zoom are corrected to, at the focal length of each photo.

Results go to benchmarks/results/board_command.md and board_command.json.
"""

from pathlib import Path

import numpy as np

import zoomjax as zj
from zoomjax.app.calibrating import calibrate
from zoomjax.app.calibration import Calibration, rms_over_frames
from zoomjax.app.focal_sources import lines_of
from zoomjax.app.image_calibration import calibrate_images
from zoomjax.app.image_job import ImageJob
from zoomjax.app.plane_focals import MOST_UNCERTAIN
from zoomjax.fit import BoardFit, fit_boards

from .boards import SIZE, fitted, rms
from .study import main, table
from .zoomcam import read_corners

DRAWS = 5

ROWS = {
    "flat": "homographies, a flat board",
    "alone": "bundle adjustment, a focal length a photo (the default)",
    "folder": "bundle adjustment, `--shared-focal folder`",
}


def judged(
    done: Calibration, zooms: np.ndarray, truth: BoardFit, corners: np.ndarray, zoom: np.ndarray
) -> dict:
    """How far a calibration is off the truth."""
    labels = np.asarray(truth.label)
    true = np.asarray(truth.focal)[np.searchsorted(labels, zooms)]
    focal = np.asarray(done.lines.focal)
    missed = []
    for own, there, label in zip(focal, true, zooms, strict=True):
        seen = corners[zoom == label].reshape(-1, 2)
        both = [np.asarray(lens(float(f)).undistort(seen)) for lens, f in _lenses(done, truth, own, there)]
        missed.append(rms(np.linalg.norm(both[0] - both[1], axis=-1)))
    off = focal / true - 1
    with np.errstate(divide="ignore"):
        deviations = np.abs(off) / (done.focal_sigma / true)
    return {
        "photos": len(focal),
        "focal": rms(off),
        "focal_median": float(np.median(np.abs(off))),
        "in_deviations": float(np.median(deviations)),
        "held_out": rms_over_frames(done.rms_held_out),
        "lens": rms(np.array(missed)),
    }


def draws(corners: np.ndarray, zoom: np.ndarray, truth: BoardFit) -> dict:
    """`fit_boards` with a focal length a photo, of other draws of six photos a zoom."""
    rng, labels = np.random.default_rng(0), np.asarray(truth.label)
    off, std = [], []
    for _ in range(DRAWS):
        of = [rng.permutation(np.flatnonzero(zoom == label))[:6] for label in labels]
        photos = np.concatenate(of)
        true = np.asarray(truth.focal)[np.searchsorted(labels, zoom[photos])]
        label = true * (1 + 0.02 * rng.standard_normal(len(true)))
        fit = fit_boards(corners[photos], label, image_size=SIZE, throw=False)
        of_photo = np.searchsorted(np.asarray(fit.label), label)
        off.append(np.asarray(fit.focal)[of_photo] / true - 1)
        std.append(np.asarray(fit.focal_std)[of_photo] / true)
    off, std = np.concatenate(off), np.concatenate(std)
    good = std < MOST_UNCERTAIN * (1 + off)
    deviations = np.abs(off / std)[good]
    return {
        "photos": int(good.sum()),
        "focal": rms(off[good]),
        "focal_median": float(np.median(np.abs(off[good]))),
        "in_deviations": float(np.median(deviations)),
        "within": float(np.mean(deviations < 1.96)),
    }


def _lenses(done: Calibration, truth: BoardFit, own: float, true: float) -> list[tuple[zj.ZoomLens, float]]:
    return [(done.fit.lens, own), (truth.lens, true)]


def run(data: Path) -> dict:
    """All measurements."""
    corners, zoom, _ = read_corners(data / "zoomcam")
    corners = corners.astype(float)
    truth = fitted(corners, zoom, flat=False)
    photos = tuple(str(folder) for folder in sorted((data / "zoomcam").glob("zoom_*x")))
    out: dict = {"draws": draws(corners, zoom, truth)}
    for way, shared in (("alone", None), ("folder", "folder")):
        done = calibrate_images(
            ImageJob(photos, detector="grid", focal="plane", shared_focal=shared, workers=2)
        )
        zooms = np.array(
            [float(Path(d.file).parent.name.removeprefix("zoom_").removesuffix("x")) for d in done.used]
        )
        out[way] = judged(done.calibration, zooms, truth, corners, zoom)
        if way == "alone":
            assert done.bundle is not None  # there are 27 photos
            by_name = dict(
                zip(done.bundle.names, np.asarray(done.bundle.fit.label)[done.bundle.number], strict=True)
            )
            used = [d for d in done.used if d.name in by_name]
            lines = lines_of(used, np.array([by_name[d.name] for d in used]), "px")
            plain = calibrate(lines, robust=True)
            out["flat"] = judged(plain, zooms[[d.name in by_name for d in done.used]], truth, corners, zoom)
    return out


def page(r: dict) -> list[str]:
    """The results as a page."""
    of = r["draws"]
    return [
        "# A board on the command line",
        "",
        "30 photos of a zoom camera, by `zoomjax calibrate zoom_*x/ --detector grid --focal plane`. Truth "
        "is the bundle adjustment of all 116 photos of that camera. *f*: relative error of the focal "
        "lengths, RMS and median, %, and the median in standard deviations that are told (0.67 is right). "
        "*Left out*: RMS distance of lines of photos left out from straight lines. *Lens*: RMS distance of "
        "corrected corners of a zoom from where the truth has them.",
        "",
        *table(
            ["focal lengths", "photos", "f, %", "median, %", "in deviations", "left out, px", "lens, px"],
            (
                [
                    name,
                    f"{of['photos']}",
                    f"{100 * of['focal']:.1f}",
                    f"{100 * of['focal_median']:.1f}",
                    f"{of['in_deviations']:.1f}" if np.isfinite(of["in_deviations"]) else "",
                    f"{of['held_out']:.3f}",
                    f"{of['lens']:.2f}",
                ]
                for name, of in ((ROWS[key], r[key]) for key in ROWS)
            ),
        ),
        "",
        f"The bundle adjustment with a focal length a photo, for {DRAWS} other draws of six photos a zoom: "
        f"of {of['photos']} photos that tell one, f is {100 * of['focal']:.1f} % off (RMS, median "
        f"{100 * of['focal_median']:.1f} %), the median is {of['in_deviations']:.2f} of the standard "
        f"deviations that are told, and {100 * of['within']:.0f} % are within 1.96 of them.",
        "",
    ]


if __name__ == "__main__":
    main(__doc__, "board_command", run, page)
