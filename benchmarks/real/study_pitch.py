"""Zoom models on frames they have not seen: lines of a football pitch, marked by hand.

    python -m benchmarks.real.study_pitch [--output FILE]

93 frames of broadcasts of the World Cup 2014, 1280 x 720 px (see pitch.py). Straight lines of the pitch
with 3 marks or more, most have 3, and the focal length of a camera that another program predicts, which is
no truth. The frames are parted into five at random; every model is fitted to four parts and tested on the
fifth, and so on for each, in `PARTINGS` partings. Figures are RMS distances of the corrected marks from
straight lines, px, every frame weighing the same (eq. 13), with 95 % intervals by bootstrap over frames;
differences from the zoom polynomial of degree 2 are of the same frames drawn.

A frame by itself cannot be tested on other frames: it is fitted to all of its lines but one, and tested on
that one, for each in turn.

Results go to benchmarks/results/pitch.md and pitch.json.
"""

import itertools
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import zoomjax as zj

from .pitch import annotated_lines, read_pitch
from .study import DEFAULT, NONE, TERMS, Candidate, choose, fitting, interval, main, root_mean, table

PARTS, PARTINGS = 5, 10
DRAWS = 4000
ENTRIES = 5
EACH = "each frame by itself"


def held_out(
    lines: zj.lines.CompressedLines, models: list[Candidate]
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Squared error of each frame under models that have not seen it, px^2: (partings, frames).

    And why some models cannot be fitted without some part.
    """
    frames, focal = len(lines.focal), np.asarray(lines.focal)
    found = {model.name: np.zeros((PARTINGS, frames)) for model in models}
    found[NONE] = np.tile(np.asarray(zj.frame_rms(lines, None)) ** 2, (PARTINGS, 1))
    unable = {}
    rng = np.random.default_rng(0)
    parts = [rng.permutation(frames) % PARTS for _ in range(PARTINGS)]
    for model, (parting, part), tested in itertools.product(models, enumerate(parts), range(PARTS)):
        if model.name in unable:
            continue
        # Weights of zero, not fewer lines: what is compiled once serves all. Tables have their entries
        # where frames are, those tested included.
        train = lines.weighted((part != tested)[np.asarray(lines.frame)])
        try:
            k = model.coefficients(train, focal)
        except ValueError as error:
            unable[model.name] = f"In some parting: {error}"
            del found[model.name]
            continue
        squares = np.asarray(zj.frame_rms(lines, k)) ** 2
        found[model.name][parting, part == tested] = squares[part == tested]
    return found, unable


def in_sample(lines: zj.lines.CompressedLines, models: list[Candidate]) -> dict[str, float]:
    """RMS of every model on the frames that it is fitted to, px."""
    focal = np.asarray(lines.focal)
    k = {NONE: np.zeros((len(focal), TERMS)), EACH: np.asarray(zj.fit_frames(lines).coefficients)}
    k[f"{EACH}, k1 alone"] = np.asarray(zj.fit_frames(lines, terms=1).coefficients)
    k |= {model.name: model.coefficients(lines, focal) for model in models}
    return {
        name: float(root_mean(np.asarray(zj.frame_rms(lines, values)) ** 2)) for name, values in k.items()
    }


def line_left_out(lines: zj.lines.CompressedLines, terms: int) -> np.ndarray:
    """Squared error of each frame's lines, px^2, each corrected as the frame's other lines ask for."""
    index, present = (np.asarray(array) for array in lines.by_frame())
    frame, line = np.nonzero(present)
    others = choose(lines, frame, index.shape[1])  # a copy of its frame for each line
    copies = np.arange(len(frame)) * index.shape[1] + line
    weight = np.ones(len(others.frame))
    weight[copies] = 0
    k = zj.fit_frames(others.weighted(weight), terms=terms, throw=False).coefficients
    squares = np.asarray(zj.frame_rms(others.weighted(1 - weight), k)) ** 2
    return np.bincount(frame, squares) / np.bincount(frame)


def run(data: Path) -> dict:
    """All measurements."""
    lines = zj.compress(annotated_lines(read_pitch(data / "pitch_lines")))
    lines = lines.weighted(np.ones(len(lines.frame)))
    models, unable = fitting(lines, ENTRIES)
    found, also_unable = held_out(lines, models)
    squares = {name: each.mean(axis=0) for name, each in found.items()}
    for terms, name in ((2, EACH), (1, f"{EACH}, k1 alone")):
        squares[name] = line_left_out(lines, terms)
    draws = np.random.default_rng(1).integers(len(lines.focal), size=(DRAWS, len(lines.focal)))
    drawn = {name: root_mean(each[draws]) for name, each in squares.items()}
    return {
        "frames": len(lines.focal),
        "lines": len(lines.frame),
        "points": float(jnp.sum(lines.counts)),
        "focal_px": [float(lines.focal.min()), float(lines.focal.max())],
        "not_fitted": unable | also_unable,
        "in_sample_px": in_sample(lines, models),
        "held_out": {
            name: {
                "rms_px": float(root_mean(each)),
                "interval_px": interval(drawn[name]),
                "difference_px": float(root_mean(each) - root_mean(squares[DEFAULT])),
                "difference_interval_px": interval(drawn[name] - drawn[DEFAULT]),
                "partings_px": root_mean(found[name]).tolist() if name in found else None,
            }
            for name, each in squares.items()
        },
    }


def page(r: dict) -> list[str]:
    """The results as a page."""
    low, high = r["focal_px"]
    default = r["held_out"][DEFAULT]
    better = [name for name, x in r["held_out"].items() if x["rms_px"] < default["rms_px"]]
    surely = [name for name in better if r["held_out"][name]["difference_interval_px"][1] < 0]
    return [
        "# Frames not seen: pitch lines marked by hand",
        "",
        f"{r['points']:.0f} marks on {r['lines']} straight lines in {r['frames']} frames of football "
        f"broadcasts, 1280 × 720 px, most lines with 3 marks. Focal lengths, {low:.0f} to {high:.0f} px, "
        f"are another program's guesses. Five parts by frame, {PARTINGS} random partings; RMS distances "
        "from straight lines, px, with 95 % intervals by bootstrap over frames, and paired differences "
        "from degree 2. *Each frame by itself* is tested on each of its lines, fitted to its others.",
        "",
        *table(
            ["model", "in sample", "held out", "95 %", "less degree 2", "95 %"],
            (
                [
                    name,
                    f"{r['in_sample_px'][name]:.3f}",
                    f"{x['rms_px']:.3f}",
                    span(x["interval_px"], "{:.3f}"),
                    f"{x['difference_px']:+.3f}",
                    span(x["difference_interval_px"], "{:+.3f}"),
                ]
                for name in r["in_sample_px"]
                if (x := r["held_out"].get(name))
            ),
        ),
        "",
        f"Better than degree 2 on frames not seen: {', '.join(better) or 'none'}; of these with an "
        f"interval that leaves out zero: {', '.join(surely) or 'none'}.",
        "",
        "Not fitted: "
        + ("; ".join(f"{name} (“{reason}”)" for name, reason in r["not_fitted"].items()) or "none")
        + ".",
    ]


def span(values: list[float], form: str) -> str:
    return " to ".join(form.format(value) for value in values)


if __name__ == "__main__":
    main(__doc__, "pitch", run, page)
