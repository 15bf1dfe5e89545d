"""Choosing the model: how long cross-validation takes, and how often it finds the truth.

    python -m benchmarks.selection [--draws N] [--output FILE]

Twelve polynomials in 1/f (degree 0 to 3, 1 to 3 coefficients) are compared by `select_model`'s rule: on the
paper's scene for its time, in a process whose JAX has compiled nothing of it (cold) and again (warm); on
scenes whose truth is of degree 1, 2 or 3, new noise in every draw; and, where the environment variable
ZOOMJAX_DATA names the folder of real data, on the corners of a real zoom camera (real/zoomcam.py). float64.
Results go to benchmarks/results/selection.md and selection.json.
"""

import argparse
import dataclasses
import os
import time
from collections import Counter
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import zoomjax as zj
from zoomjax import scenes
from zoomjax.trust.comparison import compare
from zoomjax.trust.cross_validation import cross_validate_frames, cross_validate_zoom
from zoomjax.trust.folds import HoldOut, folds_of
from zoomjax.trust.selection import default_candidates

from .shared import RESULTS, machine, machine_line, table, write

SIZE = (1072, 712)
CANDIDATES = default_candidates()[:12]
QUADRATIC = next(c for c in CANDIDATES if c.name == "degree 2, 2 terms")
CUBIC = np.array([[-0.004, 0.002], [0.02, -0.006], [-0.035, 0.0], [0.03, 0.0]])
"""Added in powers of u = f_ref/f to the paper's lens: some px at the corner from each power."""


def seconds(function) -> dict[str, float]:
    """Time on the clock and of the processor, s."""
    clock, cpu = time.perf_counter(), time.process_time()
    function()
    return {"clock": time.perf_counter() - clock, "cpu": time.process_time() - cpu}


def times() -> dict:
    """Of the paper's scene: 50 frames, each left out by itself."""
    lines = scenes.board_lines(scenes.nikkor_18_200(), scenes.focal_sweep(), spacing=40, noise=0.5)
    small = zj.compress(lines, terms=3)
    parts = folds_of(small, "frame", None, 0)
    runs = [seconds(lambda: compare(small, CANDIDATES, parts)) for _ in range(3)]
    return {
        "lines": len(small.frame),
        "fits": len(CANDIDATES) * (parts.number + 1),
        "cold": runs[0],
        "warm": min(runs[1:], key=lambda run: run["cpu"]),
        "cross_validate_zoom": seconds(lambda: cross_validate_zoom(small)),
        "cross_validate_frames": seconds(lambda: cross_validate_frames(small)),
    }


def truth(degree: int) -> zj.ZoomLens:
    """A lens of that degree: the paper's published one for 2."""
    lens = scenes.nikkor_18_200(SIZE)
    own = np.zeros((4, 2))
    own[:3] = lens.zoom.parameters
    own = {1: own * [[1], [1], [0], [0]], 2: own, 3: own + CUBIC}[degree]
    zoom = zj.PolynomialZoom(
        degree=degree, parameters=jnp.asarray(own[: degree + 1]), focal_ref=lens.focal_range[0]
    )
    return dataclasses.replace(lens, zoom=zoom)


def choices(degree: int, hold_out: HoldOut, draws: int) -> dict:
    """What is chosen, and how straight it makes what was left out, over new noise."""
    scene = scenes.board_lines(truth(degree), scenes.focal_sweep(10), spacing=24)
    chosen, best, ratio = Counter(), Counter(), []
    for draw in range(draws):
        noisy = scenes.with_noise(scene, jax.random.key(draw), std=0.2)
        small = zj.compress(noisy, terms=3)
        compared, first, choice = compare(small, CANDIDATES, folds_of(small, hold_out, None, 0))
        chosen[choice.name] += 1
        best[first.name] += 1
        error = {v.candidate.name: v.held_out for v in compared}
        ratio.append(error[choice.name] / error[QUADRATIC.name])
    return {
        "chosen": dict(chosen.most_common()),
        "best": dict(best.most_common()),
        "over_quadratic": float(np.mean(ratio)),
    }


def real(folder: Path) -> dict:
    """What is chosen for the real zoom camera, by what is left out."""
    from .real.zoomcam import read_zoomcam

    small = zj.compress(read_zoomcam(folder / "zoomcam"), terms=3)
    found = {}
    for hold_out in ("focal", "frame", "line"):
        candidates = default_candidates()
        compared, best, chosen = compare(small, candidates, folds_of(small, hold_out, None, 0))
        found[hold_out] = {"best": best.name, "chosen": chosen.name} | {
            v.candidate.name: [v.rms, v.held_out, v.difference, v.difference_std] for v in compared
        }
    return found


def counted(counts: dict[str, int], draws: int) -> str:
    return ", ".join(f"{name}: {100 * n / draws:.0f} %" for name, n in counts.items())


def markdown(results: dict) -> str:
    """The results as a page."""
    t = results["times"]
    speed = t["fits"] / t["warm"]["cpu"]
    rows = [
        [name, f"{t[key]['clock']:.2f} s", f"{t[key]['cpu']:.2f} s"]
        for name, key in (
            ("12 candidates, each frame left out, cold", "cold"),
            ("the same, warm", "warm"),
            ("cross_validate_zoom", "cross_validate_zoom"),
            ("cross_validate_frames", "cross_validate_frames"),
        )
    ]
    draws = results["draws"]
    found = [
        [
            f"degree {r['degree']}, {r['hold_out']}",
            f"{100 * r['chosen'].get(r['truth'], 0) / draws:.0f} %",
            f"{100 * r['best'].get(r['truth'], 0) / draws:.0f} %",
            f"{r['over_quadratic']:.4f}",
            counted(r["chosen"], draws),
        ]
        for r in results["choices"]
    ]
    lines = [
        "# Choosing the model",
        "",
        f"`python -m benchmarks.selection --draws {draws}`. {machine_line(results['machine'])} "
        f"Load average {results['load']:.0f}, mostly of other work, which the clock counts and the "
        "processor time does not.",
        "",
        f"The paper's scene, 50 frames, {t['lines']:,} lines; {speed:.0f} fits a second of processor time.",
        "",
        *table(["", "clock", "processor"], rows),
        "",
        f"Scenes of 10 focal lengths at {SIZE[0]} x {SIZE[1]} px, noise 0.2 px, {draws} draws. How often "
        "the truth (2 terms) is chosen by the one-standard-error rule, and is the best; the held-out RMS "
        "of the chosen over that of degree 2 with 2 terms, in the mean.",
        "",
        *table(["truth, held out", "chosen", "best", "over degree 2", "all that were chosen"], found),
        "",
    ]
    if results["real"]:
        real_rows = [
            [how, r["chosen"], r["best"], f"{r[r['chosen']][1]:.4f}", f"{r[QUADRATIC.name][1]:.4f}"]
            for how, r in results["real"].items()
        ]
        lines += [
            "The real zoom camera, five zooms, 4,292 lines:",
            "",
            *table(["held out", "chosen", "best", "RMS of the chosen", "of degree 2, 2 terms"], real_rows),
            "",
        ]
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--output", type=Path, default=RESULTS / "selection.md")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    folder = os.environ.get("ZOOMJAX_DATA")
    measured = {"machine": machine(), "draws": options.draws, "times": times()}
    measured["choices"] = [
        {"degree": degree, "truth": f"degree {degree}, 2 terms", "hold_out": hold_out}
        | choices(degree, hold_out, options.draws)
        for degree in (1, 2, 3)
        for hold_out in ("focal", "line")
    ]
    measured["real"] = real(Path(folder)) if folder else {}
    measured["load"] = os.getloadavg()[0]
    write(options.output, markdown(measured), measured)
