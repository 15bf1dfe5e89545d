"""How far a fitted lens can be trusted: what its error bands say beside what repeated noise does.

    python -m benchmarks.trust [--draws N] [--tables NAME ...] [--output FILE]

Scenes have exact truth; each is drawn with new noise N times, compressed, fitted, and compared with the
truth. Figures that are counted over draws have their Monte-Carlo error (one standard deviation) beside
them. float64. A table is a function of the number of draws in `TABLES`. Results go to
benchmarks/results/trust.md and trust.json; tables that are not run again are kept as they are there.
"""

import argparse
import importlib.metadata
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import psutil
from jax.flatten_util import ravel_pytree

import zoomjax as zj
from zoomjax import scenes
from zoomjax.fit.covariance import parameter_covariance
from zoomjax.fit.energy import line_weights, linearised
from zoomjax.models.sizes import at_focal

RESULTS = Path(__file__).parent / "results"
SIZE = (1072, 712)
LEVELS = {68: 1.0, 95: 1.96}
"""Per cent of a normal distribution, and the standard deviations that hold them."""


class Table(NamedTuple):
    """A table of the page: what it says, its column heads, and its rows of text; `data` is for the JSON."""

    title: str
    about: str
    heads: list[str]
    rows: list[list[str]]
    data: dict


class Noise(NamedTuple):
    """How a scene is disturbed: all in px."""

    std: float = 0.1
    correlation: float = 0.0
    spread: float = 0.0  # of the logarithm of each line's own std
    bend: float = 0.0  # standard deviation of each line's sagitta

    def draw(self, scene: zj.Lines, key) -> zj.Lines:
        """The scene with noise."""
        for_points, for_std, for_bend = jax.random.split(key, 3)
        number = scene.frame.shape
        own = self.std * jnp.exp(self.spread * jax.random.normal(for_std, number) - self.spread**2)
        noisy = scenes.with_noise(scene, for_points, std=own, correlation=self.correlation)
        t, across = along_and_across(scene)
        bent = (self.bend * jax.random.normal(for_bend, number)[:, None] * t**2)[..., None] * across
        points = noisy.points + jnp.where(scene.mask[..., None], bent, 0)
        return eqx.tree_at(lambda lines: lines.points, noisy, points)


def along_and_across(scene: zj.Lines):
    """For each line its points' places, from -1 to 1, (line, point), and its normal, (line, 1, 2)."""
    last = jnp.sum(scene.mask, axis=1) - 1
    t = 2 * jnp.arange(scene.points.shape[1])[None] / last[:, None] - 1
    ends = scene.points[:, 0], jnp.take_along_axis(scene.points, last[:, None, None], 1)[:, 0]
    along = (ends[1] - ends[0]) / jnp.linalg.norm(ends[1] - ends[0], axis=1, keepdims=True)
    return t, jnp.stack([-along[:, 1], along[:, 0]], axis=1)[:, None]


NOISES = {
    "independent, 0.1 px": Noise(),
    "correlated 0.8 from point to point": Noise(correlation=0.8),
    "each line has its own size": Noise(spread=0.7),
    "each line is bent, 0.2 px": Noise(bend=0.2),
    "independent, 0.5 px": Noise(std=0.5),
}
METRICS: dict[str, Callable[[zj.lines.AbstractLines], zj.lines.AbstractLines]] = {
    "paper's metric": lambda lines: lines,
    "`in_image`": zj.fit.in_image,
    "`in_image`, points alike": lambda lines: zj.fit.in_image(lines.weighted(lines.counts)),
}


def board(stripes: tuple[int, int], frames: int, spacing: float = 12) -> tuple[zj.ZoomLens, zj.Lines]:
    """The paper's lens, and its board with fewer stripes, without noise."""
    truth = scenes.nikkor_18_200(SIZE)
    whole = scenes.StripedBoard.before(truth)
    fewer = scenes.StripedBoard(stripes=stripes, pixel_pitch=whole.pixel_pitch)
    return truth, scenes.board_lines(truth, scenes.focal_sweep(frames), board=fewer, spacing=spacing)


SCENES = {"5 photos": ((15, 11), 5), "4 photos, few lines": ((4, 3), 4)}


def independent_covariance(small: zj.lines.CompressedLines, fit: zj.ZoomFit):
    """What the covariance would be were points independent."""
    weighted, jacobian, *_ = linearised(small, fit.lens.zoom)
    weights = line_weights(small)
    inverse = jnp.linalg.inv(jnp.einsum("lri,lrj->ij", jacobian, jacobian))
    noise = jnp.einsum("l,lri,lrj->ij", weights, jacobian, jacobian)
    freedom = jnp.sum(weights * (small.counts - 2)) - jnp.trace(inverse @ noise)
    return jnp.sum(weighted**2) / freedom * inverse @ noise @ inverse


def plain_sandwich(small: zj.lines.CompressedLines, fit: zj.ZoomFit):
    """The textbook's line-by-line sandwich, with its correction L / (L - p)."""
    weighted, jacobian, *_ = linearised(small, fit.lens.zoom)
    inverse = jnp.linalg.inv(jnp.einsum("lri,lrj->ij", jacobian, jacobian))
    pull = jnp.einsum("lri,lr->li", jacobian, weighted) @ inverse
    lines, parameters = pull.shape
    return lines / (lines - parameters) * pull.T @ pull


COVARIANCES = {
    "`fit.covariance`": lambda small, fit: fit.covariance,
    "points independent": independent_covariance,
    "plain sandwich": plain_sandwich,
}


def corner_errors(truth: zj.ZoomLens, scene: zj.Lines, noise: Noise, draws: int, *, metric=None):
    """Errors of the corner's displacement over draws, px, at the two ends and the middle of the range.

    By one of `METRICS`, the paper's if none is named.

    Returns:
        The errors, (draw, 3), and by each of `COVARIANCES` their standard deviations, (draw, 3).
    """
    keys = jax.random.split(jax.random.key(0), draws)
    metric = METRICS[metric or "paper's metric"]
    run = _corner_errors(truth, scene, jax.tree.map(jnp.asarray, noise), metric, keys)
    return jax.tree.map(np.asarray, run)


@eqx.filter_jit
def _corner_errors(truth, scene, noise, metric, keys):
    def one(key):
        small = metric(zj.compress(noise.draw(scene, key)))
        fit = zj.fit_zoom(small, throw=False)
        fits = {
            name: eqx.tree_at(lambda fit: fit.covariance, fit, covariance(small, fit))
            for name, covariance in COVARIANCES.items()
        }
        corner, focal = jnp.zeros(2), corner_focals(truth)
        stds = {name: zj.displacement_std(fit, corner, focal=focal) for name, fit in fits.items()}
        return corner_displacement(fit.lens) - corner_displacement(truth), stds

    # One draw after the other: batched factorisations are no faster on the CPU.
    return jax.lax.map(one, keys)


def corner_focals(lens: zj.ZoomLens):
    """The two ends and the middle of the range."""
    low, high = lens.focal_range
    return jnp.stack([low, jnp.sqrt(low * high), high])


def corner_displacement(lens: zj.ZoomLens):
    """How far from the centre the corner is corrected to, px, at `corner_focals`."""
    corrected = jax.vmap(lambda f: lens(f).undistort(jnp.zeros(2)))(corner_focals(lens))
    return jnp.linalg.norm(corrected - lens.centre[None], axis=1)


def coverage(draws: int) -> Table:
    """How often the truth lies within one and 1.96 standard deviations of the corner's displacement."""
    rows, data = [], {}
    for scene_name, arguments in SCENES.items():
        truth, scene = board(*arguments)
        in_image = {"independent, 0.5 px, `in_image`": NOISES["independent, 0.5 px"]}
        for noise_name, noise in {**NOISES, **in_image}.items():
            metric = "`in_image`" if noise_name in in_image else None
            errors, stds = corner_errors(truth, scene, noise, draws, metric=metric)
            found = {}
            for name in COVARIANCES:
                std = stds[name]
                inside = {level: np.abs(errors) <= z * std for level, z in LEVELS.items()}
                found[name] = {
                    "std over true": float(np.mean(np.sqrt(np.mean(std**2, axis=0)) / errors.std(0))),
                    **{str(level): (100 * within.mean(0)).tolist() for level, within in inside.items()},
                    # the three focal lengths of a draw are not independent
                    **{f"{k}_error": 100 * w.mean(1).std() / draws**0.5 for k, w in inside.items()},
                }
            cells = [
                ", ".join(f"{np.mean(f[str(k)]):.1f} ± {f[f'{k}_error']:.1f}" for k in LEVELS)
                for f in found.values()
            ]
            lines = len(scene.frame)
            bias = errors.mean(0) / errors.std(0)
            worst = f"{bias[np.argmax(np.abs(bias))]:+.2f}"
            rows.append([f"{scene_name}, {lines} lines", noise_name, *cells, worst])
            print(*rows[-1], sep=" | ", flush=True)
            data[f"{scene_name}: {noise_name}"] = {
                "lines": lines,
                "bias over std": bias.tolist(),
                "std": errors.std(0).tolist(),
                "covered": found,
            }
    return Table(
        "Coverage of the corner's displacement",
        f"{draws} draws. Per cent of them in which the truth is within 1 and within 1.96 standard "
        "deviations (68.3 and 95 are right), mean over the two ends and the middle of the focal range, "
        "with its Monte-Carlo error: by `fit.covariance`, and by two that were not chosen. Bias is the "
        f"mean error, in standard deviations, where it is largest (known to {draws**-0.5:.2f}): the "
        "shrinkage of the paper's metric, which no covariance knows of, and `in_image` does not have.",
        ["scene", "noise", *COVARIANCES, "bias"],
        rows,
        data,
    )


class Scene(NamedTuple):
    """A scene for `metrics`: at most so many pairs of draws, at these sizes of the noise, px."""

    truth: zj.ZoomLens
    lines: zj.Lines
    pairs: int
    stds: tuple[float, ...] = (0.3, 1.0, 2.0)


def paper_scene(frames: int = 50, spacing: float = 12) -> tuple[zj.ZoomLens, zj.Lines]:
    """The paper's board and camera, as many of its photos, without noise."""
    truth = scenes.nikkor_18_200()
    return truth, scenes.board_lines(truth, scenes.focal_sweep(frames), spacing=spacing)


def metric_scenes() -> dict[str, Scene]:
    """From few lines to all of the paper's: the scatter falls with their number, the bias does not."""
    scenes = {name: Scene(*board(*arguments), 500) for name, arguments in SCENES.items()}
    scenes["the paper's board, 12 photos"] = Scene(*paper_scene(12), 60)
    return scenes | {"the paper's scene, 50 photos": Scene(*paper_scene(), 10, (2.0,))}


@eqx.filter_jit
def _metric_errors(truth, scene, std, keys):
    """Errors of the corner's displacement, (draw, 2, metric, 3), and RMS errors of the field, px."""

    def one(key, std):
        small = zj.compress(scenes.with_noise(scene, key, std=std))
        kinds = [metric(small) for metric in METRICS.values()]
        lenses = [zj.fit_zoom(lines, invertible=False, throw=False).lens for lines in kinds]
        errors = [corner_displacement(lens) - corner_displacement(truth) for lens in lenses]
        return jnp.stack(errors), jnp.stack([zj.trust.displacement_rms(truth, lens) for lens in lenses])

    signs = jnp.array([1.0, -1.0])
    return jax.lax.map(lambda key: jax.lax.map(lambda sign: one(key, sign * std), signs), keys)


def metrics(draws: int) -> Table:
    """Bias and efficiency of both metrics."""
    rows, data = [], {}
    for name, (truth, scene, most, stds) in metric_scenes().items():
        pairs = min(draws // 2, most)
        keys = jax.random.split(jax.random.key(1), pairs)
        for std in stds:
            errors, fields = map(np.asarray, _metric_errors(truth, scene, jnp.asarray(std), keys))
            bound = float(zj.trust.displacement_bound(truth, scene, std=std))
            spread = errors.reshape(-1, *errors.shape[2:]).std(axis=0)
            means, squares = errors.mean(axis=1), np.mean(fields**2, axis=1)
            bias, bias_error = means.mean(0) / spread, means.std(0) / pairs**0.5 / spread
            worst = np.argmax(np.abs(bias), axis=1)[:, None]
            bias, bias_error = (np.take_along_axis(b, worst, 1)[:, 0] for b in (bias, bias_error))
            mean_square = squares.mean(axis=0)
            ratio = np.sqrt(mean_square) / bound
            ratio_error = ratio / 2 * squares.std(axis=0) / pairs**0.5 / mean_square
            cells = zip(bias, bias_error, ratio, ratio_error, strict=True)
            points = int(scene.mask.sum())
            shown = [f"{b:+.3f} ± {e:.3f}, {r:.2f} ± {q:.2f}" for b, e, r, q in cells]
            about = f"{name}: {len(scene.frame):,} lines, {points:,} points"
            rows.append([about, str(pairs), f"{std} px", f"{bound:.3f} px", *shown])
            print(*rows[-1], sep=" | ", flush=True)
            data[f"{name}, {std} px"] = {
                "lines": len(scene.frame),
                "points": points,
                "pairs": pairs,
                "bound": bound,
                "bias over std": dict(zip(METRICS, bias.tolist(), strict=True)),
                "error over bound": dict(zip(METRICS, ratio.tolist(), strict=True)),
                "its Monte-Carlo error": dict(zip(METRICS, ratio_error.tolist(), strict=True)),
            }
    return Table(
        "Bias and efficiency of both metrics",
        "Under each metric: the bias of the corner's displacement in its own standard deviations, where it "
        "is largest of the two ends and the middle of the range (asked of `in_image`: below 0.1), and the "
        "RMS error of the displacements over image and range, by its Cramer-Rao bound (asked: 1.10). Noise "
        "is independent. Draws come in pairs of opposite noise, in whose mean all but the bias nearly "
        "cancels: as many pairs as are said. The last column gives all points of a frame the same weight "
        "instead of all its lines.",
        ["scene", "pairs", "noise", "bound", *METRICS],
        rows,
        data,
    )


ARCS = {
    "none": (0.0, (0.0, 0.0), False),
    "30 %, 5 to 50 px": (0.3, (5.0, 50.0), False),
    "30 %, 20 to 200 px": (0.3, (20.0, 200.0), False),
    "30 %, 5 to 50 px, all away from the centre": (0.3, (5.0, 50.0), True),
}
"""The share of lines that are replaced by arcs, their sagitta, and whether all are bent the same way."""


def with_arcs(lines: zj.Lines, key, share, sagitta, outward):
    """Some of the lines bent to arcs, and which."""
    for_which, for_size, for_side = jax.random.split(key, 3)
    number = lines.frame.shape
    t, across = along_and_across(lines)
    bent = jax.random.uniform(for_which, number) < share
    size = jax.random.uniform(for_size, number, minval=sagitta[0], maxval=sagitta[1])
    inside = (lines.points[:, 0] - lines.centre[None])[:, None]
    side = jnp.where(outward, jnp.sign(jnp.sum(across * inside, axis=(1, 2))), jnp.ones(number))
    side = jnp.where(outward, side, jax.random.rademacher(for_side, number))
    bend = (bent * side * size)[:, None, None] * (1 - t**2)[..., None] * across
    points = lines.points + jnp.where(lines.mask[..., None], bend, 0)
    return eqx.tree_at(lambda lines: lines.points, lines, points), bent


@eqx.filter_jit
def _robust_errors(truth, scene, std, arcs, keys):
    """RMS of displacements, px: robust and plain to the truth, and robust to plain without arcs.

    And how many arcs were believed, and how many lines rejected that are straight.
    """

    def one(key):
        for_noise, for_arcs = jax.random.split(key)
        noisy = scenes.with_noise(scene, for_noise, std=std)
        spoiled, bent = with_arcs(noisy, for_arcs, *arcs)
        plain = zj.fit_zoom(zj.compress(noisy), invertible=False, throw=False).lens
        robust = zj.fit_robust(zj.compress(spoiled), invertible=False, throw=False)
        ours = robust.fit.lens
        apart = [zj.trust.displacement_rms(a, b) for a, b in ((truth, ours), (truth, plain), (plain, ours))]
        believed = jnp.sum(bent & (robust.weight > 0)), jnp.sum(~bent & (robust.weight == 0))
        return jnp.stack(apart), jnp.stack(believed)

    return jax.lax.map(one, keys)


def outliers(draws: int) -> Table:
    """What arcs instead of lines do to the robust fit, and what it costs where there are none."""
    draws = min(draws, 500)
    truth, scene = paper_scene(6, spacing=20)
    rows, data = [], {}
    for name, arcs in ARCS.items():
        keys = jax.random.split(jax.random.key(2), draws)
        arcs = jax.tree.map(jnp.asarray, arcs)
        errors, counts = map(np.asarray, _robust_errors(truth, scene, jnp.asarray(0.5), arcs, keys))
        apart = errors[:, 2]
        ours, plain = np.mean(errors[:, :2] ** 2, axis=0)
        cost = ours / plain - 1
        residual = errors[:, 0] ** 2 - (1 + cost) * errors[:, 1] ** 2
        cost_error = residual.std() / draws**0.5 / plain
        shown = f"{100 * cost:+.1f} ± {100 * cost_error:.1f} %"
        quantiles = [f"{x:.3f}" for x in np.quantile(apart, [0.5, 0.95, 1])]
        within = f"{100 * np.mean(apart <= 0.05):.1f} %"
        rows.append([name, *quantiles, within, shown, *(f"{n:.2f}" for n in counts.mean(0))])
        print(*rows[-1], sep=" | ", flush=True)
        data[name] = {
            "draws": draws,
            "quantiles of the difference": np.quantile(apart, [0.05, 0.25, 0.5, 0.75, 0.95, 1]).tolist(),
            "more variance": cost,
            "its Monte-Carlo error": cost_error,
            "arcs believed": float(counts[:, 0].mean()),
            "lines rejected": float(counts[:, 1].mean()),
        }
    return Table(
        "Arcs in the place of lines",
        f"{draws} draws: the paper's board in 6 photos, {len(scene.frame)} lines of "
        f"{int(scene.mask.sum()):,} points, noise of 0.5 px. The RMS difference of displacements, px, over "
        "image and range, of `fit_robust` with the arcs and `fit_zoom` without (asked: at most 0.05); how "
        "much larger the variance is than that of `fit_zoom` without arcs (asked where there are none: at "
        "most 5 %; with arcs, three lines in ten are missing); and how many arcs were believed, and good "
        "lines given no weight, in the mean over draws.",
        ["arcs", "median", "95 %", "largest", "within 0.05", "more variance", "believed", "rejected"],
        rows,
        data,
    )


def certificates(draws: int) -> Table:
    """The certificate beside dense sampling."""
    del draws
    low, high, side = 20.0, 120.0, 41
    number = 100_000
    parameters = 0.3 * np.random.default_rng(2).standard_normal((number, 3, 2))

    def one(parameters):
        zoom = zj.PolynomialZoom(degree=2, parameters=parameters, focal_ref=jnp.asarray(low))
        lens = zj.ZoomLens(zoom, jnp.array([319.5, 239.5]), jnp.array([low, high]), (640, 480))
        return zj.models.certify(lens)

    ours = jax.jit(lambda every: jax.lax.map(one, every, batch_size=500))(jnp.asarray(parameters))
    u, t = np.linspace(low / high, 1, side), np.linspace(0, 1, side)
    k = np.einsum("mjt,uj->mut", parameters, u[:, None] ** np.arange(3))
    least = np.min(1 + 3 * k[..., :1] * t + 5 * k[..., 1:] * t**2, axis=(1, 2))
    certified, folded = np.asarray(ours.certified), np.asarray(ours.slope) <= 0
    found = {
        "models": number,
        "that fold, by sampling": int(np.sum(least <= 0)),
        "certified, but fold": int(np.sum(certified & (least <= 0))),
        "bound above the sampled slope": int(np.sum(np.asarray(ours.least) > least)),
        "refused, but no sample folds": int(np.sum(~certified & (least > 0))),
        "undecided: neither certified nor a fold found": int(np.sum(~certified & ~folded)),
    }
    return Table(
        "The certificate of invertibility",
        f"Random zoom models of degree 2 with 2 terms, sampled at {side} focal lengths and {side} radii. "
        "Those refused of which no sample folds do so between the samples, where the certificate's own "
        "search found the fold, unless they are undecided.",
        ["", ""],
        [[name, f"{count:,}"] for name, count in found.items()],
        found,
    )


def cost(draws: int) -> Table:
    """What covariance and certificate take of a warm compressed fit, and the robust fit beside it."""
    del draws
    truth = scenes.nikkor_18_200()
    small = zj.compress(scenes.board_lines(truth, scenes.focal_sweep(), noise=0.5))
    fit = zj.fit_zoom(small)
    linear = eqx.filter_jit(linearised)(small, fit.lens.zoom)
    alone = eqx.filter_jit(parameter_covariance)
    flat, _ = ravel_pytree(fit.lens.zoom.parameters)
    parts: dict[str, tuple] = {
        "`fit_zoom`": (zj.fit_zoom, small),
        "covariance": (alone, small, fit.lens.zoom, linear),
        "certificate": (zj.models.certify, fit.lens),
        "`fit_robust`": (zj.fit_robust, small),
        "`fit_zoom(in_image(...))`": (zj.fit_zoom, zj.fit.in_image(small)),
    }
    times: dict[str, list[float]] = {name: [] for name in parts}
    for _ in range(15):  # in turns, so that whatever else the machine does falls on all
        for name, call in parts.items():
            times[name].append(seconds(*call))
    least = {name: min(t) for name, t in times.items()}
    middle = {name: statistics.median(t) for name, t in times.items()}
    lines = len(small.frame)
    rows = [
        [name, *(f"{1e3 * t[name]:.1f} ms" for t in (least, middle))]
        + [f"{t[name] / t['`fit_zoom`']:.2f}" for t in (least, middle)]
        for name in parts
    ]
    return Table(
        "Cost of covariance, certificate and robust fit",
        f"The paper's scene, {lines:,} lines, {flat.size} parameters, compressed, warm; the least and the "
        "median of 15 medians of 5, in turns, and their ratio to `fit_zoom`, which makes both covariance "
        "and certificate (asked: together at most 0.20, and at most 5 for `fit_robust`).",
        ["", "least", "median", "ratio", "ratio of medians"],
        rows,
        {"least": least, "median": middle, "lines": lines},
    )


def rounded_focal(draws: int) -> Table:
    """Focal lengths rounded to whole mm, by bands that do and do not know of it, and the remedy."""
    truth, scene = board((15, 11), 12, 24)
    keys = jax.random.split(jax.random.key(1), draws)
    errors, stds, off = jax.tree.map(np.asarray, _rounded(truth, scene, keys))
    rows, data = [], {}
    for name in _ROUNDED:
        inside = {level: np.abs(errors[name]) <= z * stds[name] for level, z in LEVELS.items()}
        covered = [
            f"{100 * w.mean():.1f} ± {100 * w.mean(1).std() / draws**0.5:.1f}" for w in inside.values()
        ]
        rms = np.sqrt(np.mean(errors[name] ** 2, axis=0))
        focal = float(np.sqrt(np.mean(off[name] ** 2)))
        rows.append([name, ", ".join(covered), ", ".join(f"{value:.2f}" for value in rms), f"{focal:.3f}"])
        data[name] = {"covered": covered, "rms": rms.tolist(), "focal_rms": focal}
    return Table(
        "Focal lengths rounded to whole mm",
        f"{draws} draws of the board at 12 focal lengths, {len(scene.frame)} lines, noise of 0.1 px, every "
        "focal length off by up to 0.5 mm. Per cent of the draws in which the truth is within 1 and within "
        "1.96 standard deviations of the corner's displacement, mean over the two ends and the middle of "
        "the range; RMS error of that displacement there, px; RMS error of the focal lengths, mm.",
        ["fit", "covered", "corner, px", "f, mm"],
        rows,
        data,
    )


_ROUNDED = (
    "exact focal lengths",
    "rounded, taken as exact",
    "rounded, `with_focal_sigma`",
    "rounded, `fit_focal`",
)


@eqx.filter_jit
def _rounded(truth, scene, keys):
    low, high = truth.focal_range
    focal, corner = jnp.stack([low, jnp.sqrt(low * high), high]), jnp.zeros(2)
    sigma = 1 / np.sqrt(12)

    def displacement(lens):
        return jnp.linalg.norm(
            jax.vmap(lambda f: at_focal(lens, f).undistort(corner))(focal) - lens.centre[None], axis=1
        )

    def one(key):
        for_noise, for_focal = jax.random.split(key)
        small = zj.compress(Noise().draw(scene, for_noise))
        off = jax.random.uniform(for_focal, scene.focal.shape, minval=-0.5, maxval=0.5)
        given = eqx.tree_at(lambda lines: lines.focal, small, scene.focal + off)
        plain = zj.fit_zoom(given, throw=False)
        found = zj.fit.fit_focal(given, sigma, throw=False)
        widened = zj.fit.with_focal_sigma(plain, given, focal_sigma=sigma)
        all_fits = (zj.fit_zoom(small, throw=False), plain, widened, found.fit)
        fits = dict(zip(_ROUNDED, all_fits, strict=True))
        offs = dict(zip(_ROUNDED, (0 * off, off, off, found.focal - scene.focal), strict=True))
        errors = {name: displacement(fit.lens) - displacement(truth) for name, fit in fits.items()}
        stds = {name: zj.displacement_std(fit, corner, focal=focal) for name, fit in fits.items()}
        return errors, stds, offs

    return jax.lax.map(one, keys)


TABLES: dict[str, Callable[[int], Table]] = {
    "coverage": coverage,
    "metrics": metrics,
    "outliers": outliers,
    "rounded_focal": rounded_focal,
    "certificates": certificates,
    "cost": cost,
}


def seconds(function: Callable, *arguments) -> float:
    """Median time of five calls after one that compiles."""
    jax.block_until_ready(function(*arguments))
    times = []
    for _ in range(5):
        start = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def machine() -> dict:
    """What the figures were measured on."""
    model = platform.processor()
    if Path("/proc/cpuinfo").exists():
        names = [x for x in Path("/proc/cpuinfo").read_text().splitlines() if x.startswith("model name")]
        model = names[0].partition(":")[2].strip() if names else model
    packages = ("zoomjax", "jax", "jaxlib", "optimistix", "equinox", "numpy")
    return {
        "cpu": model,
        "cores": os.cpu_count(),
        "memory_GB": round(psutil.virtual_memory().total / 1e9),
        "load": round(os.getloadavg()[0], 1),
        "device": str(jax.devices()[0]),
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in packages},
    }


def kept(output: Path) -> dict[str, dict]:
    """The tables of an earlier run."""
    output = output.with_suffix(".json")
    return json.loads(output.read_text()).get("tables", {}) if output.exists() else {}


def markdown(tables: dict[str, dict]) -> str:
    """The results as a page."""
    page = ["# Trust", "", "`python -m benchmarks.trust`, float64."]
    for table in tables.values():
        m = table["machine"]
        page += ["", f"## {table['title']}", "", table["about"], "", f"| {' | '.join(table['heads'])} |"]
        page += ["|" + "---|" * len(table["heads"]), *(f"| {' | '.join(row)} |" for row in table["rows"])]
        page += [
            "",
            f"{m['cpu']}, {m['cores']} cores, {m['memory_GB']} GB, load {m['load']}; Python {m['python']}, "
            f"jax {m['jax']}, optimistix {m['optimistix']}, numpy {m['numpy']}; on {m['device']}.",
        ]
    return "\n".join([*page, ""])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=1000)
    parser.add_argument("--tables", nargs="*", choices=TABLES, default=list(TABLES))
    parser.add_argument("--output", type=Path, default=RESULTS / "trust.md")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    for name in options.tables:
        result = {**TABLES[name](options.draws)._asdict(), "machine": machine()}
        tables = kept(options.output) | {name: result}
        tables = {name: tables[name] for name in TABLES if name in tables}
        options.output.write_text(markdown(tables))
        options.output.with_suffix(".json").write_text(json.dumps({"tables": tables}, indent=2) + "\n")
    print(options.output.read_text())
