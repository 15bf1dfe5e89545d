"""The study: every zoom model on every lens, a focal length left out."""

import itertools
import os
import time
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np

import zoomjax as zj

from .data import (
    LEVEL,
    QUANTILES,
    SCALE,
    SIZE,
    UPRIGHT,
    Frames,
    Lens,
    families,
    frame_energies,
    frames_of,
    halves,
    read,
)
from .few import Learned, few_focal_lengths, learn_both, part_of_the_range
from .models import (
    all_lenses,
    fit_chosen_degree,
    fit_polynomials,
    interpolate,
    one_by_one,
    power_law,
    two_regions,
)
from .page import OURS
from .prior import Prior, fit_smooth, no_facts

DRAWS = 2000


class Bootstrap:
    """Resampled lenses, whole families at a time."""

    def __init__(self, family: np.ndarray):
        names, index = np.unique(family, return_inverse=True)
        draws = np.random.default_rng(1).multinomial(len(names), np.full(len(names), 1 / len(names)), DRAWS)
        self.weight = draws[:, index]  # (draw, lens)

    def quantile(self, values: np.ndarray, q: float) -> np.ndarray:
        """Of each draw, lenses without a value left out."""
        known = np.flatnonzero(np.isfinite(values))
        order = known[np.argsort(values[known])]
        total = np.cumsum(self.weight[:, order], axis=1)
        place = np.argmax(total >= q * total[:, -1:], axis=1)
        return values[order][place]

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Of each draw, lenses without a value left out."""
        known = np.isfinite(values)
        return self.weight[:, known] @ values[known] / self.weight[:, known].sum(1)


def interval(draws: np.ndarray) -> list[float]:
    return np.quantile(draws, [0.025, 0.975]).tolist()


def twice_calibrated(lenses: list[Lens], data: list[Frames], triangles: list[np.ndarray]) -> np.ndarray:
    """What two calibrations of the same lens disagree by, px, over sqrt(2): one value a pair and lens.

    Pairs of tables under one name, for sensors of different sizes. The smaller sees the middle of what the
    larger does: the larger's coefficients, in its radius, correct the smaller's lines at focal lengths that
    both have within 2 %; what is beyond the smaller's own optimum is the disagreement.
    """
    by_name = defaultdict(list)
    for i, lens in enumerate(lenses):
        by_name[lens.name].append(i)
    values = []
    for group in by_name.values():
        for i in group:
            for j in group:
                ratio = lenses[i].crop / lenses[j].crop
                if i == j or ratio > 1 or str(lenses[i].frames) == str(lenses[j].frames):
                    continue
                apart = np.abs(np.log(data[i].focal[:, None] / data[j].focal[None]))
                a, b = np.nonzero(apart < 0.02)
                if a.size:
                    k = data[i].k[a] * ratio ** np.array([2, 4])
                    excess = np.asarray(frame_energies(triangles[j][b], k)) - data[j].energy[b]
                    values.append(np.sqrt(np.mean(np.maximum(excess, 0)) / 2))
    return np.array(values)


def check_against_package(lines, lenses, data, zooms, fits, every=16):
    """Fits by zoomjax.fit_zoom, one by one, without one interior frame: RMS px of theirs and ours there."""
    start = np.cumsum([0] + [len(d.focal) for d in data])
    table = []
    for name, zoom in zooms.items():
        pairs = []
        for i in range(0, len(data), every):
            number = len(data[i].focal)
            if number > 8:  # each number of frames is one more program to compile
                continue
            m = number // 2
            triangle, focal = frames_of(lines, start[i] + np.delete(np.arange(number), m))
            small = zj.lines.CompressedLines(
                triangle=triangle.reshape(-1, 7, 7),
                frame=jnp.repeat(jnp.arange(number - 1), UPRIGHT + LEVEL),
                focal=focal,
                centre=lines.centre,
                image_size=SIZE,
                focal_unit="mm",
            )
            fit = zj.fit_zoom(small, zoom=zoom(i))
            k = np.stack([fit.lens.zoom(jnp.asarray(data[i].focal[m])), fits[name][i][1][m]])
            test, _ = frames_of(lines, np.array([start[i] + m] * 2))
            pairs.append(np.sqrt(np.asarray(frame_energies(test, jnp.asarray(k)))))
        difference = np.abs(np.diff(np.array(pairs), axis=1))
        table.append((name, len(pairs), float(np.median(difference)), float(np.max(difference))))
    return table


def study() -> dict:
    """All measurements."""
    times, lap = stopwatch()
    lenses, lines, data = read()
    triangle = frames_of(lines, ...)[0]
    lap("lines, and each frame by itself")

    family = families(lenses)
    side = halves(family)
    learned = learn_both(lenses, data, side)
    lap("priors of both halves")

    fits = fit_all(data, side, learned)
    lap("fits")

    errors = Errors(data, triangle)
    bootstrap = Bootstrap(family)
    rows = {name: quantiles_of(fit, errors, bootstrap) for name, fit in fits.items()}
    left_out = {name: errors.left_out(fit) for name, fit in fits.items()}
    paired = {name: compared(left_out[OURS], error, bootstrap) for name, error in left_out.items()}
    few = few_focal_lengths(data, side, learned)
    part = part_of_the_range(lenses, data, side, learned)
    pairs = twice_calibrated(lenses, data, np.split(np.asarray(triangle), errors.start[1:-1]))
    lap("true energies and intervals")
    study_time, processor = sum(times.values()), time.process_time()
    zooms = {"degree 2": lambda i: zj.PolynomialZoom()}
    zooms |= {name: partial(one.of_lens, side=side) for name, one in learned.items()}
    check = check_against_package(lines, lenses, data, zooms, fits)
    lap("comparison with fit_zoom")
    return {
        "lenses": len(lenses),
        "families": len(np.unique(family)),
        "tables": len({str(lens.frames) for lens in lenses}),
        "frames": int(errors.start[-1]),
        "left_out": int(errors.interior.sum()),
        **{name: np.quantile(values, QUANTILES).tolist() for name, values in errors.references().items()},
        "models": rows,
        "paired": paired,
        "few": few,
        "part": part,
        "twice": {"pairs": len(pairs), "rms": np.quantile(pairs, QUANTILES).tolist()},
        "check": check,
        "seconds": study_time,
        "processor": processor,
        "load": os.getloadavg()[1],
        "times": times,
    }


def stopwatch() -> tuple[dict[str, float], Callable[[str], None]]:
    """Times by name, s, and a function that tells and keeps the time since it was last called."""
    clock, times = time.perf_counter(), {}

    def lap(name: str) -> None:
        nonlocal clock
        times[name] = time.perf_counter() - clock
        clock = time.perf_counter()
        print(f"{name}: {times[name]:.1f} s", flush=True)

    return times, lap


def fit_all(data: list[Frames], side: np.ndarray, learned: dict[str, Learned]) -> dict[str, list]:
    """Every model on every lens: coefficients fitted, and left out."""

    def cross_fitted(learned):
        smooth: list[Any] = [None] * len(data)
        for part, prior in enumerate(learned.priors):
            fit, chosen = partial(fit_smooth, prior=prior), np.flatnonzero(side == part)
            mine = all_lenses(data, fit, chosen, learned.facts)
            smooth = [new or old for new, old in zip(mine, smooth, strict=True)]
        return smooth

    kinds = ("nearest frame", "table in f", "table in 1/f", "spline in 1/f", "monotone cubic in 1/f")
    own_prior = partial(fit_smooth, prior=Prior(zj.SmoothZoom(), np.zeros((0, 7))))
    every_fit: dict[str, Callable[[], list]] = {
        **{f"degree {n}": partial(all_lenses, data, partial(fit_polynomials, degree=n)) for n in range(4)},
        "degree chosen inside": partial(all_lenses, data, partial(fit_chosen_degree, degrees=(1, 2, 3))),
        **{k: lambda k=k: [one_by_one(lens, partial(interpolate, kind=k)) for lens in data] for k in kinds},
        "power law": lambda: [one_by_one(lens, power_law) for lens in data],
        "two regions": lambda: [one_by_one(lens, two_regions) for lens in data],
        **{name: partial(cross_fitted, of) for name, of in learned.items()},
        "SmoothZoom, as in the package": partial(all_lenses, data, own_prior, facts=no_facts(data)),
    }
    with ThreadPoolExecutor(2) as pool:
        running = {name: pool.submit(fit) for name, fit in every_fit.items()}
    return {name: future.result() for name, future in running.items()}


class Errors:
    """True energies of the frames for coefficients that some model gives them, as RMS px of each lens.

    Attributes:
        start: the first frame of each lens, and the end.
        interior: which frames have a neighbour on both sides: those that are left out.
    """

    def __init__(self, data: list[Frames], triangle):
        self._data, self._triangle = data, triangle
        self._own = np.concatenate([lens.k for lens in data])
        self.start = np.cumsum([0] + [len(lens.focal) for lens in data])
        self.interior = np.concatenate([np.r_[False, np.ones(len(d.focal) - 2, bool), False] for d in data])
        self._every = np.ones(self.start[-1], bool)

    def of(self, fit: list, *, left_out: bool) -> tuple[np.ndarray, np.ndarray]:
        """RMS px, and how far the displacement of the corner is from that of the frame's own optimum.

        Of all frames as fitted, or of the interior ones as predicted by the others; NaN where a model
        cannot be fitted.
        """
        k = np.concatenate([pair[left_out] for pair in fit])
        chosen = self.interior if left_out else self._every
        error = self._by_lens(np.asarray(frame_energies(self._triangle, np.nan_to_num(k))), chosen)
        corner = self._by_lens((SCALE * np.sum(k - self._own, axis=1)) ** 2, chosen)
        return np.where(np.isfinite(corner), error, np.nan), corner

    def left_out(self, fit: list) -> np.ndarray:
        """RMS px of the interior frames."""
        return self.of(fit, left_out=True)[0]

    def references(self) -> dict[str, np.ndarray]:
        """RMS px without correction, and of each frame's own optimum: of all, and of the interior ones."""
        none = np.asarray(frame_energies(self._triangle, np.zeros_like(self._own)))
        alone = np.concatenate([lens.energy for lens in self._data])
        return {
            "none": self._by_lens(none, self._every),
            "frames_alone": self._by_lens(alone, self._every),
            "frames_alone_interior": self._by_lens(alone, self.interior),
        }

    def _by_lens(self, values: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        parts = itertools.pairwise(self.start)
        return np.array([np.sqrt(np.mean(values[a:b][chosen[a:b]])) for a, b in parts])


def quantiles_of(fit: list, errors: Errors, bootstrap: Bootstrap) -> dict[str, Any]:
    """A model's row: quantiles over the lenses, as fitted and left out."""
    row: dict[str, Any] = {}
    for label in ("in_sample", "left_out"):
        error, corner = errors.of(fit, left_out=label == "left_out")
        row["lenses"] = int(np.isfinite(error).sum())
        row[label] = {
            "rms": np.nanquantile(error, QUANTILES).tolist(),
            "median_interval": interval(bootstrap.quantile(error, 0.5)),
            "corner": np.nanquantile(corner, QUANTILES).tolist(),
        }
    return row


def compared(ours: np.ndarray, error: np.ndarray, bootstrap: Bootstrap) -> dict[str, Any]:
    """Our errors against a model's, lens by lens, on the lenses that it can be fitted to."""
    ratio, known = np.log(ours / error), np.isfinite(error)
    seen = np.where(known, ours, np.nan)
    return {
        "lenses": int(np.isfinite(ratio).sum()),
        "ratio": float(np.exp(np.nanmean(ratio))),
        "ratio_interval": np.exp(interval(bootstrap.mean(ratio))).tolist(),
        "better": float(np.mean(ratio[np.isfinite(ratio)] < 0)),
        "differences": [
            [
                float(np.quantile(ours[known], q) - np.quantile(error[known], q)),
                *interval(bootstrap.quantile(seen, q) - bootstrap.quantile(error, q)),
            ]
            for q in QUANTILES
        ],
    }
