"""Whether `SmoothZoom` should take its `error` from the data: marginal likelihood against the fixed one.

    python -m benchmarks.real.prior_error [--output FILE]

The error sets the weight of the prior. *Estimated*, it is the one under which the coefficients that the
frames have by themselves are most likely, the parameters integrated out (empirical Bayes): of a normal
distribution about the model, with variances of ``error^2`` by each frame's energy. *Held near*, its
logarithm has a normal prior besides, of deviation `NEAR` about the fixed one, which few frames keep.

*lensfun*: the zooms of lensfun/, each with the prior that the other half of the lenses gives it; focal
lengths left out, one of all, or all but a few. *Broadcast*: the clips of study_broadcast.py with the centre
known, 55 frames each, in several draws; error over the image in frames not fitted, in either metric.

Results go to benchmarks/results/prior_error.md and prior_error.json.
"""

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import zoomjax as zj
from zoomjax.models.zoom import with_parameters
from zoomjax.trust._linearised import frame_normal_equations

from .coverage import clip_lines
from .lensfun.data import QUANTILES, Frames, families, halves, read
from .lensfun.data import SCALE as LENSFUN_SCALE
from .lensfun.few import learn_both
from .lensfun.models import FEW, inner, some_of
from .study import main, table
from .study_broadcast import SCALE, Clip, misplaced, read_clip

DRAWS, UNSEEN = 8, 60
NEAR = 0.15
FACTORS = np.exp(np.linspace(-np.log(32), np.log(32), 121))
"""What the fixed error is multiplied by."""

WAYS = {"fixed": 0.0, "held near": NEAR, "estimated": np.inf}
"""Deviation of the logarithm of the error about that of the fixed one."""

DIRECTIONS = len(zj.SmoothZoom().quadratic) + 2 * (zj.SmoothZoom().degree - 2)
"""Numbers of the model: those of the prior."""


def basis_of(shortest: float, focal: np.ndarray) -> np.ndarray:
    """Legendre's polynomials: (frame, basis)."""
    return np.polynomial.legendre.legvander(2 * shortest / focal - 1, zj.SmoothZoom().degree)


def precision_of(zoom: zj.SmoothZoom) -> np.ndarray:
    """The matrix of the prior's quadratic form in the parameters."""
    zero = zoom.prepare(jnp.array([1.0]), 2)
    assert zero.parameters is not None
    shape = zero.parameters.shape
    rows = jax.jacfwd(lambda flat: with_parameters(zero, flat.reshape(shape)).standardised())(
        jnp.zeros(DIRECTIONS)
    )
    return np.asarray(rows.T @ rows)


def fits_of(basis, k, second, precision, variance) -> tuple[np.ndarray, np.ndarray]:
    """For each of `FACTORS` the parameters, and -2 log of the marginal likelihood, up to a constant."""
    matrix = np.einsum("fa,fij,fb->aibj", basis, second, basis).reshape(DIRECTIONS, DIRECTIONS)
    right = np.einsum("fa,fij,fj->ai", basis, second, k).reshape(DIRECTIONS)
    variances = variance * FACTORS**2
    whole = matrix + variances[:, None, None] * precision
    parameters = np.linalg.solve(whole, np.broadcast_to(right[:, None], (len(FACTORS), DIRECTIONS, 1)))[
        ..., 0
    ]
    squares = np.einsum("fi,fij,fj->", k, second, k) - parameters @ right
    numbers = k.size - DIRECTIONS
    unlikely = numbers * np.log(variances) + np.linalg.slogdet(whole)[1] + squares / variances
    return parameters.reshape(len(FACTORS), -1, 2), unlikely


def chosen(unlikely: np.ndarray, deviation: float) -> int:
    """The place of the error among `FACTORS`."""
    away = np.log(FACTORS)
    if deviation == 0:
        return int(np.argmin(np.abs(away)))
    return int(np.argmin(unlikely + (away / deviation) ** 2))


def lensfun() -> dict:
    """Quantiles over the lenses of the RMS error, px, by prior, way and what is fitted."""
    lenses, _, data = read()
    side = halves(families(lenses))
    found: dict[str, Any] = {}
    for name, learned in learn_both(lenses, data, side).items():
        errors: dict[str, dict[str, list[float]]] = {way: {} for way in WAYS}
        for i, lens in enumerate(data):
            for way, of in lens_errors(lens, learned.of_lens(i, side)).items():
                for fitted, error in of.items():
                    errors[way].setdefault(fitted, []).append(error)
        fixed = errors["fixed"]
        found[name] = {
            way: {
                fitted: {
                    "rms": np.nanquantile(values, QUANTILES).tolist(),
                    "ratio": float(np.exp(np.nanmean(np.log(np.array(values) / fixed[fitted])))),
                }
                for fitted, values in of.items()
            }
            for way, of in errors.items()
        }
    return found


def lens_errors(lens: Frames, zoom: zj.SmoothZoom) -> dict[str, dict[str, float]]:
    """RMS error, px, of the focal lengths left out, by way and by what was fitted."""
    number = len(lens.focal)
    basis, precision = basis_of(lens.focal[0], lens.focal), precision_of(zoom)
    mean = 0 if zoom.mean is None else basis[:, :3] @ np.asarray(zoom.mean)
    k, variance = lens.k - mean, (LENSFUN_SCALE * float(zoom.error)) ** 2
    there = Frames(*map(jnp.asarray, lens))
    every, interior = np.arange(number), np.asarray(inner(there))
    kept = {"one left out": [(every != m, every == m) for m in np.flatnonzero(interior)]}
    for few in FEW:
        seen = np.asarray(some_of(there, few))
        kept[f"{few} fitted"] = [(seen, interior & ~seen)]
    errors: dict[str, dict[str, float]] = {way: {} for way in WAYS}
    for fitted, parts in kept.items():
        squares: dict[str, list[float]] = {way: [] for way in WAYS}
        for seen, tested in parts:
            if not tested.any():
                continue
            parameters, unlikely = fits_of(basis[seen], k[seen], lens.second[seen], precision, variance)
            for way, deviation in WAYS.items():
                off = (basis @ parameters[chosen(unlikely, deviation)] - k)[tested]
                energy = lens.energy[tested] + np.einsum("fi,fij,fj->f", off, lens.second[tested], off)
                squares[way].append(float(np.mean(energy)))
        for way, of in squares.items():
            errors[way][fitted] = float(np.sqrt(np.mean(of))) if of else np.nan
    return errors


def clip_errors(clip: Clip, draw: int) -> dict[str, dict[str, list[float]]]:
    """RMS error over the image in frames not fitted, px, and the error's factor, by metric and way."""
    made, learnt = clip_lines(clip, draw)
    centre = clip.principal[learnt].mean(axis=0)
    small = zj.compress(made.about(centre))
    unseen = np.setdiff1d(np.arange(len(clip.focal)), learnt)
    inside = (clip.focal[unseen] >= clip.focal[learnt].min()) & (
        clip.focal[unseen] <= clip.focal[learnt].max()
    )
    unseen = unseen[inside]
    unseen = unseen[np.linspace(0, len(unseen) - 1, UNSEEN).round().astype(int)]
    tested = dataclasses.replace(
        clip, focal=clip.focal[unseen], principal=clip.principal[unseen], k=clip.k[unseen]
    )
    focal, own = np.asarray(small.focal), zj.SmoothZoom()
    found: dict[str, dict[str, list[float]]] = {}
    for metric, lines in {"corrected": small, "distorted": zj.fit.in_image(small)}.items():
        start = jax.vmap(zj.fit_zoom(lines).lens.zoom)(jnp.asarray(focal))
        score, second = frame_normal_equations(lines, np.asarray(start))
        k = np.asarray(start) - np.linalg.solve(second, score[..., None])[..., 0]
        variance = (SCALE * float(own.error)) ** 2
        basis = basis_of(focal.min(), focal)
        parameters, unlikely = fits_of(basis, k, second, precision_of(own), variance)
        at = basis_of(focal.min(), tested.focal)
        for way, deviation in WAYS.items():
            place = chosen(unlikely, deviation)
            image, _ = misplaced(tested, at @ parameters[place], centre)
            rms = float(np.sqrt(np.mean(image**2)))
            found.setdefault(metric, {})[way] = [rms, float(FACTORS[place])]
    return found


def broadcast(folder: Path) -> dict:
    """By metric and way: mean over clips of the RMS over their draws, px, and the median factor."""
    clips = [read_clip(path) for path in sorted(folder.glob("*.npz"))]
    each = [[clip_errors(clip, draw) for draw in range(DRAWS)] for clip in clips]
    found: dict[str, Any] = {}
    for metric, way in itertools.product(each[0][0], WAYS):
        values = np.array([[draw[metric][way] for draw in draws] for draws in each])
        by_clip = np.sqrt(np.mean(values[..., 0] ** 2, axis=1))
        found.setdefault(metric, {})[way] = {
            "image_px": float(np.mean(by_clip)),
            "clips_px": by_clip.tolist(),
            "factor": float(np.median(values[..., 1])),
        }
    return found


def run(data: Path) -> dict:
    """All measurements."""
    return {"broadcast": broadcast(data / "broadcast_cameras"), "lensfun": lensfun()}


def page(r: dict) -> list[str]:
    """The results as a page."""
    return [
        "# The error of SmoothZoom, fixed and estimated",
        "",
        "`error` sets the weight of the prior. *Estimated* is the one of greatest marginal likelihood "
        f"(empirical Bayes); *held near* has a normal prior on its logarithm, of deviation {NEAR}, about "
        "the *fixed* one, that of the package.",
        "",
        "## Zooms of lensfun, focal lengths left out",
        "",
        "Each with the prior that the other half of the lenses gives it. RMS distance to straightness, px, "
        "quantiles over the lenses; the ratio to the fixed one is the geometric mean over lenses.",
        "",
        *table(
            ["prior", "fitted", "error", "25 %", "median", "75 %", "90 %", "ratio"],
            (
                [name, fitted, way, *(f"{q:.3f}" for q in x["rms"]), f"{x['ratio']:.3f}"]
                for name, ways in r["lensfun"].items()
                for fitted in ways["fixed"]
                for way, x in ((way, ways[way][fitted]) for way in ways)
            ),
        ),
        "",
        "## Broadcast clips, truth",
        "",
        f"Five clips, {DRAWS} draws each, centre known: error over the image in frames not fitted, px, the "
        "mean over clips of the RMS over draws; and the median of what the fixed error is multiplied by.",
        "",
        *table(
            ["distances measured in the", "error", "image, px", "factor"],
            (
                [f"{metric} image", way, f"{x['image_px']:.4f}", f"{x['factor']:.2f}"]
                for metric, ways in r["broadcast"].items()
                for way, x in ways.items()
            ),
        ),
    ]


if __name__ == "__main__":
    main(__doc__, "prior_error", run, page)
