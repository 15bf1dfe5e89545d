"""What `zoomjax calibrate` gives without options, from lines of real cameras.

    python -m benchmarks.real.defaults [--output FILE]

*Broadcast*: five clips of known lenses (see study_broadcast.py), 55 frames each, noise 0.5 px; the focal
lengths are given, the centre of distortion is not. What the camera looks at is drawn at random, several
times for each clip. The lens found is compared with the true one in all frames not fitted.

*World Cup*: lines of pitches marked by hand (see pitch.py), five parts by frame, several partings. Lines of
the part left out are corrected by the lens of the others.

*Zoom camera*: 116 photos of a checkerboard at five zooms (see zoomcam.py), with the lines of a flat board:
each of the middle zooms is left out and predicted.

Each is calibrated as by `zoomjax calibrate lines.npz`, and beside it with `--degree 2`, and with that and
`--centre image`. Results go to benchmarks/results/defaults.md and defaults.json.
"""

import itertools
import time
from pathlib import Path
from typing import Literal

import numpy as np

import zoomjax as zj
from zoomjax.app.calibrating import calibrate
from zoomjax.app.calibration import Calibration
from zoomjax.app.model_choice import WantedModel
from zoomjax.models.registry import distortion_model_name

from .coverage import clip_lines, held
from .pitch import annotated_lines, read_pitch
from .study import main, root_mean, table
from .study_broadcast import SIZE, Clip, corrected, image_places, read_clip
from .zoomcam import read_corners

DRAWS = 2
PARTS, PARTINGS = 5, 1
SETTINGS: dict[str, tuple[WantedModel, Literal["fit", "image"]]] = {
    "default": (WantedModel(), "fit"),
    "degree 2": (WantedModel(degree=2), "fit"),
    "degree 2, centre of the image": (WantedModel(degree=2), "image"),
}


def calibrated(lines: zj.Lines, setting: str) -> tuple[Calibration, float]:
    """As by the command line, and the seconds of processor that it took."""
    model, centre = SETTINGS[setting]
    start = time.process_time()
    done = calibrate(lines, model=model, centre=centre)
    return done, time.process_time() - start


def of(done: Calibration) -> dict:
    """The model that was chosen, its centre, and the verdict."""
    lens = done.fit.lens
    number = np.asarray(lens(float(lens.focal_range[0])).coefficients).size
    return {
        "model": f"{type(lens.zoom).__name__}, {number} of {distortion_model_name(lens.distortion_model)}",
        "centre": np.asarray(lens.centre).tolist(),
        "verdict": done.assessment.verdict,
    }


def broadcast_clip(clip: Clip, draw: int, setting: str) -> dict:
    """The error of the lens in frames not fitted, and how often its bands of 95 % hold there."""
    lines, learnt = clip_lines(clip, draw)
    done, seconds = calibrated(lines, setting)
    lens = done.fit.lens
    unseen = np.setdiff1d(np.arange(len(clip.focal)), learnt)
    low, high = (float(f) for f in lens.focal_range)
    unseen = unseen[(clip.focal[unseen] >= low) & (clip.focal[unseen] <= high)]
    some = unseen[np.linspace(0, len(unseen) - 1, 60).round().astype(int)]
    places = image_places()
    outward = places - (np.array(SIZE) - 1) / 2
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    error, variance = [], []
    for frame in some:
        principal = clip.principal[[frame], None]
        truth = principal + corrected(places - principal, clip.focal[[frame]], clip.k[[frame]])
        error.append(np.asarray(lens(float(clip.focal[frame])).undistort(places)) - truth[0])
        covariance = np.asarray(
            zj.trust.displacement_covariance(
                done.fit, places, focal=np.full(len(places), clip.focal[frame])
            )
        )
        variance.append(np.einsum("pi,pij,pj->p", outward, covariance, outward))
    error, variance = np.array(error), np.array(variance)
    image = np.linalg.norm(error, axis=-1)
    bands = held(np.einsum("fpi,pi->fp", error, outward), variance)
    return of(done) | {
        "clip": clip.name,
        "image_px": float(np.sqrt(np.mean(image[:, :-4] ** 2))),
        "corner_px": float(np.median(image[:, -4:].max(axis=1))),
        "held": bands,
        "seconds": seconds,
    }


def world_cup(folder: Path, setting: str) -> dict:
    """Straightness of frames not fitted, px."""
    frames = [frame for frame in read_pitch(folder) if annotated(frame)]
    rng = np.random.default_rng(0)
    squares = np.zeros((PARTINGS, len(frames)))
    seconds, models = 0.0, []
    for parting in range(PARTINGS):
        part = rng.permutation(len(frames)) % PARTS
        for left in range(PARTS):
            kept = [frame for frame, mine in zip(frames, part, strict=True) if mine != left]
            tested = [frame for frame, mine in zip(frames, part, strict=True) if mine == left]
            done, more = calibrated(annotated_lines(kept), setting)
            seconds += more
            models.append(of(done)["model"])
            squares[parting, part == left] = straightness(annotated_lines(tested), done) ** 2
    return {
        "frames": len(frames),
        "rms_px": float(root_mean(squares.mean(axis=0))),
        "partings_px": root_mean(squares).tolist(),
        "models": {model: models.count(model) for model in sorted(set(models))},
        "seconds": seconds,
    }


def annotated(frame: dict) -> bool:
    """Whether the frame has a line to be straightened."""
    try:
        return len(annotated_lines([frame]).frame) > 0
    except ValueError:
        return False


def straightness(lines: zj.Lines, done: Calibration) -> np.ndarray:
    """RMS distance of corrected points from their lines in each frame, px."""
    lens = done.fit.lens
    return np.asarray(zj.frame_rms(lines.about(np.asarray(lens.centre)), lens))


def zoom_left_out(folder: Path, setting: str) -> dict:
    """Straightness at zooms of which no photo is fitted, px, as `zoomjax calibrate --detector grid` has it.

    Lines are those of a flat board: of the photos fitted by their own bundle adjustment, and of those left
    out, whose focal length is that of all photos, by the one of all.
    """
    corners, zoom, _ = read_corners(folder)
    whole = flat_lines(corners, zoom, np.ones(len(zoom), bool))
    rms, about = {}, []
    for left in np.unique(zoom)[1:-1]:
        done, _ = calibrated(flat_lines(corners, zoom, zoom != left), setting)
        tested = straightness(whole, done)[zoom == left]
        rms[f"{left:.0f}"] = float(root_mean(tested**2))
        about.append(of(done))
    return {"rms_px": rms, "all_px": float(root_mean(np.array(list(rms.values())) ** 2)), "of": about}


def flat_lines(corners: np.ndarray, zoom: np.ndarray, chosen: np.ndarray) -> zj.Lines:
    """The lines of some photos, as a flat board would show them; see coverage.py."""
    grids, label = corners[chosen].astype(float), zoom[chosen]
    board = np.unique(label, return_inverse=True)[1]
    fit = zj.fit.fit_boards(grids, label, image_size=(1280, 720), board=board)
    return zj.Lines.from_grids(
        grids + fit.flattening(),
        np.arange(len(label)),
        fit.frame_focal,
        image_size=(1280, 720),
        focal_unit="px",
    )


def run(data: Path) -> dict:
    """All measurements."""
    clips = [read_clip(path) for path in sorted((data / "broadcast_cameras").glob("*.npz"))]
    found: dict = {"broadcast": {}, "world_cup": {}, "zoomcam": {}}
    for setting in SETTINGS:
        found["broadcast"][setting] = [
            broadcast_clip(clip, draw, setting) for clip, draw in itertools.product(clips, range(DRAWS))
        ]
        rows = found["broadcast"][setting]
        print(setting, [(x["clip"], round(x["image_px"], 3), x["model"]) for x in rows], flush=True)
        print(summary(rows), flush=True)
        found["world_cup"][setting] = world_cup(data / "pitch_lines", setting)
        print(setting, found["world_cup"][setting], flush=True)
        found["zoomcam"][setting] = zoom_left_out(data / "zoomcam", setting)
        print(setting, found["zoomcam"][setting], flush=True)
    return found


def summary(rows: list[dict]) -> dict:
    """Figures of all clips: the mean over clips of the RMS over their draws."""
    clips = sorted({row["clip"] for row in rows})
    each = [
        float(np.sqrt(np.mean([row["image_px"] ** 2 for row in rows if row["clip"] == clip])))
        for clip in clips
    ]
    return {
        "image_px": float(np.mean(each)),
        "worst_px": max(row["image_px"] for row in rows),
        "corner_px": float(np.mean([row["corner_px"] for row in rows])),
        "held": {
            where: float(np.mean([row["held"][where] for row in rows])) for where in ("corner", "image")
        },
        "seconds": float(np.median([row["seconds"] for row in rows])),
        "good": sum(row["verdict"] == "good" for row in rows),
    }


def page(r: dict) -> list[str]:
    """The results as a page."""
    rows = {setting: summary(clips) for setting, clips in r["broadcast"].items()}
    number = len(r["broadcast"]["default"])
    return [
        "# What the command line gives by default",
        "",
        "`zoomjax calibrate` without options, from files of lines of real cameras, and with `--degree 2`. "
        f"Broadcast: five clips against their known lenses in frames not fitted, {DRAWS} draws each of "
        "what the camera looks at, centre of distortion unknown; the mean over clips of the RMS over the "
        "image; bands of 95 %, per cent that hold. World Cup: frames left out, straightness. Zoom camera: "
        "zooms left out, straightness, lines of a flat board.",
        "",
        "## Broadcast clips, truth",
        "",
        *table(
            ["setting", "image, px", "worst, px", "corner, px", "bands: corner", "image", "good"],
            (
                [
                    setting,
                    *(f"{x[of]:.3f}" for of in ("image_px", "worst_px", "corner_px")),
                    *(f"{100 * x['held'][where]:.1f}" for where in ("corner", "image")),
                    f"{x['good']} of {number}",
                ]
                for setting, x in rows.items()
            ),
        ),
        "",
        "## Frames and zooms left out, px off straight",
        "",
        *table(
            ["setting", "World Cup lines", *(f"zoom camera, zoom {f}" for f in middle(r)), "together"],
            (
                [
                    setting,
                    f"{r['world_cup'][setting]['rms_px']:.4f}",
                    *(f"{x:.4f}" for x in r["zoomcam"][setting]["rms_px"].values()),
                    f"{r['zoomcam'][setting]['all_px']:.4f}",
                ]
                for setting in SETTINGS
            ),
        ),
        "",
        "Models chosen for the World Cup lines: "
        + ", ".join(f"{model} ({n})" for model, n in r["world_cup"]["default"]["models"].items())
        + ".",
    ]


def middle(r: dict) -> list[str]:
    """The focal lengths left out."""
    return list(r["zoomcam"]["default"]["rms_px"])


if __name__ == "__main__":
    main(__doc__, "defaults", run, page)
