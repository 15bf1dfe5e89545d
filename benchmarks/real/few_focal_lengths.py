"""What `zoomjax calibrate` gives for zoom lenses of which two or three focal lengths are photographed.

    python -m benchmarks.real.few_focal_lengths [--output FILE]

Lenses of the lensfun database (see lensfun/data.py), every so many of its rectilinear zooms with five or
more focal lengths: lines seen through their models at both ends of the zoom and, of three, at the focal
length nearest to the middle in 1/f, with a noise of 0.5 px, centre of distortion not given. Each is
calibrated as by `zoomjax calibrate lines.npz`, and with `--degree 1` or `2`, the polynomial through the
focal lengths. At all others the lens is compared with a fit of the frame alone, free of noise, over the
image; bands of 95 % of the displacement outward hold it or do not.

The database's own calibrations are uncertain: those of one lens on two sensors are apart (lensfun.json,
`twice`). So bands are also counted with that uncertainty added, of the frame left out and of one fitted.

Results go to benchmarks/results/few_focal_lengths.md and few_focal_lengths.json.
"""

import json
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import zoomjax as zj
from zoomjax.app.calibrating import calibrate
from zoomjax.app.model_choice import WantedModel

from ..shared import RESULTS
from .coverage import along, directions, held
from .lensfun.data import SCALE, SIZE, Lens, frames_of, make_lines, read_lenses, second_derivatives
from .study import main, table

LENSES = 40
FEW = (2, 3)
NOISE = 0.5
OF_CALIBRATIONS = json.loads((RESULTS / "lensfun.json").read_text())["twice"]["rms"][1]
"""By how much a calibration of the database is off, px off straight, in the median."""
VERDICTS = ("good", "doubtful", "not determined")


def drawn_lenses() -> list[Lens]:
    """Lenses spread evenly over the database, in the order of their names."""
    lenses = sorted(read_lenses(), key=lambda lens: (lens.name, lens.crop))
    return [lenses[i] for i in np.linspace(0, len(lenses) - 1, LENSES).round().astype(int)]


def photographed(focal: np.ndarray, number: int) -> np.ndarray:
    """The frames nearest to so many focal lengths, spread evenly in 1/f from one end to the other."""
    wanted = np.linspace(1 / focal[0], 1 / focal[-1], number)
    return np.unique(np.argmin(abs(1 / focal[:, None] - wanted), axis=0))


def seen(lens: Lens, frames: np.ndarray, noise: float, seed: int) -> zj.Lines:
    """The lines of some frames."""
    lines = make_lines([lens._replace(frames=[lens.frames[i] for i in frames])])
    points = np.asarray(lines.points)
    error = noise * np.random.default_rng(seed).standard_normal(points.shape)
    return eqx.tree_at(
        lambda lines: lines.points, lines, points + error * np.asarray(lines.mask)[..., None]
    )


def measured(lens: Lens, number: int, setting: str, seed: int) -> dict:
    """Errors at the other focal lengths, whether bands hold them, and the verdict."""
    focal = np.array([frame[0] for frame in lens.frames])
    chosen = photographed(focal, number)
    others = np.setdiff1d(np.arange(len(focal)), chosen)
    model = WantedModel() if setting == "default" else WantedModel(degree=len(chosen) - 1)
    done = calibrate(seen(lens, chosen, NOISE, seed), model=model)
    exact = zj.compress(seen(lens, others, 0.0, seed))
    alone = zj.fit_frames(exact)
    places, outward = directions(SIZE)
    moved, variance = map(np.asarray, along(done.fit, *map(jnp.asarray, (places, outward, focal[others]))))
    truth = np.array(
        [np.einsum("pi,pi->p", alone.distortion(i).undistort(places), outward) for i in range(len(others))]
    )
    error = moved - truth
    return {
        "lens": lens.name,
        "focal": focal[chosen].tolist(),
        "model": type(done.fit.lens.zoom).__name__,
        "image_px": float(np.sqrt(np.mean(error[:, :-4] ** 2))),
        "held": held(error, variance),
        "held_by_both": held(error, variance + 2 * of_calibrations(exact, alone, places)),
        "verdict": done.assessment.verdict,
        "why": [finding.about for finding in done.assessment.findings if finding.verdict != "good"],
    }


def of_calibrations(
    lines: zj.lines.CompressedLines, alone: zj.fit.FrameFits, places: np.ndarray
) -> np.ndarray:
    """The variance of the displacement outward by a calibration of each frame, px^2: (frame, place).

    To first order in the coefficients, of which it errs in both alike as lines tell them.
    """
    triangle, _ = frames_of(lines, np.arange(len(lines.focal)))
    second = np.asarray(second_derivatives(triangle, alone.coefficients))
    covariance = OF_CALIBRATIONS**2 / 2 * np.linalg.inv(second)
    radius = np.linalg.norm(places - (np.array(SIZE) - 1) / 2, axis=1) / SCALE
    moved = SCALE * np.stack([radius**3, radius**5], axis=1)
    return np.einsum("pi,fij,pj->fp", moved, covariance, moved)


def run(data: Path) -> dict:
    """All lenses, numbers of focal lengths and settings."""
    found: dict[str, dict[str, list]] = {}
    for number in FEW:
        for setting in ("default", "polynomial"):
            rows = [measured(lens, number, setting, seed) for seed, lens in enumerate(drawn_lenses())]
            found.setdefault(str(number), {})[setting] = rows
            print(number, setting, summary(rows), flush=True)
    return found


def summary(rows: list[dict]) -> dict:
    """Quantiles of the lenses' errors, the bands, and what was said of those that are far off."""
    error = np.array([row["image_px"] for row in rows])
    good = np.array([row["verdict"] == "good" for row in rows])
    return {
        "px": np.quantile(error, (0.5, 0.75, 0.9)).tolist(),
        **{
            kind: {at: float(np.mean([row[kind][at] for row in rows])) for at in ("corner", "image")}
            for kind in ("held", "held_by_both")
        },
        "verdicts": {verdict: sum(row["verdict"] == verdict for row in rows) for verdict in VERDICTS},
        "worst_good_px": float(error[good].max()) if good.any() else None,
    }


def page(found: dict) -> list[str]:
    """The results as a page."""
    return [
        "# Two or three focal lengths, by default",
        "",
        f"`zoomjax calibrate` without options, of {LENSES} zoom lenses of the lensfun database: lines at "
        f"two or three focal lengths, a noise of {NOISE} px, the centre not given. Beside it with "
        "`--degree 1` or `2`, the polynomial through them. At all other focal lengths the lens is compared "
        f"with a fit of each frame by itself, px of {SIZE[0]} x {SIZE[1]}, RMS over the image, quantiles "
        "over the lenses. Bands of 95 %: per cent that hold; and per cent that hold with the uncertainty "
        f"of the database's own calibrations added, {OF_CALIBRATIONS:.2f} px off straight, for the frame "
        "and for those fitted. Verdicts: how many lenses, and the largest error of one called good.",
        "",
        *table(
            [
                *("focal lengths", "setting", "median", "75 %", "90 %", "bands: corner", "image"),
                *("with calibrations: corner", "image", *VERDICTS, "worst good, px"),
            ],
            (
                [str(number), setting, *figures(summary(rows))]
                for number in FEW
                for setting, rows in found[str(number)].items()
            ),
        ),
    ]


def figures(of: dict) -> list[str]:
    """A row of the table."""
    worst = of["worst_good_px"]
    return [
        *(f"{x:.2f}" for x in of["px"]),
        *(f"{100 * x:.1f}" for kind in ("held", "held_by_both") for x in of[kind].values()),
        *(str(number) for number in of["verdicts"].values()),
        "" if worst is None else f"{worst:.2f}",
    ]


if __name__ == "__main__":
    main(__doc__, "few_focal_lengths", run, page)
