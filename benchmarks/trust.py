"""How far a fitted lens can be trusted: what its error bands say beside what repeated noise does.

    python benchmarks/trust.py [--draws N] [--tables NAME ...] [--output FILE]

Scenes have exact truth; each is drawn with new noise N times, compressed, fitted, and compared with the
truth at the image's corner. Figures that are counted over draws have their Monte-Carlo error (one
standard deviation) beside them. float64. A table is a function of the number of draws in `TABLES`. Results
go to benchmarks/results/trust.md and trust.json.
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
from zoomjax import synthetic
from zoomjax.energy import line_weights
from zoomjax.fit import linearised
from zoomjax.uncertainty import parameter_covariance

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
        noisy = synthetic.with_noise(scene, for_points, std=own, correlation=self.correlation)
        last = jnp.sum(scene.mask, axis=1) - 1
        t = 2 * jnp.arange(scene.points.shape[1])[None] / last[:, None] - 1
        ends = scene.points[:, 0], jnp.take_along_axis(scene.points, last[:, None, None], 1)[:, 0]
        along = (ends[1] - ends[0]) / jnp.linalg.norm(ends[1] - ends[0], axis=1, keepdims=True)
        across = jnp.stack([-along[:, 1], along[:, 0]], axis=1)
        sagitta = self.bend * jax.random.normal(for_bend, number)
        bent = (sagitta[:, None] * (t * t))[..., None] * across[:, None]
        points = noisy.points + jnp.where(scene.mask[..., None], bent, 0)
        return eqx.tree_at(lambda lines: lines.points, noisy, points)


NOISES = {
    "independent, 0.1 px": Noise(),
    "correlated 0.8 from point to point": Noise(correlation=0.8),
    "each line has its own size": Noise(spread=0.7),
    "each line is bent, 0.2 px": Noise(bend=0.2),
    "independent, 0.5 px": Noise(std=0.5),
}


def board(stripes: tuple[int, int], frames: int, spacing: float = 12) -> tuple[zj.ZoomLens, zj.Lines]:
    """The paper's lens, and its board with fewer stripes, without noise."""
    truth = synthetic.nikkor_18_200(SIZE)
    whole = synthetic.StripedBoard.before(truth)
    fewer = synthetic.StripedBoard(stripes=stripes, pixel=whole.pixel)
    return truth, synthetic.board_lines(truth, synthetic.focal_sweep(frames), board=fewer, spacing=spacing)


SCENES = {"5 photos": ((15, 11), 5), "4 photos, few lines": ((4, 3), 4)}


def independent_covariance(small: zj.CompressedLines, fit: zj.ZoomFit):
    """What the covariance would be were points independent."""
    weighted, jacobian = linearised(small, fit.lens.zoom)
    weights = line_weights(small)
    inverse = jnp.linalg.inv(jnp.einsum("lri,lrj->ij", jacobian, jacobian))
    noise = jnp.einsum("l,lri,lrj->ij", weights, jacobian, jacobian)
    freedom = jnp.sum(weights * (small.counts - 2)) - jnp.trace(inverse @ noise)
    return jnp.sum(weighted**2) / freedom * inverse @ noise @ inverse


def plain_sandwich(small: zj.CompressedLines, fit: zj.ZoomFit):
    """The textbook's line-by-line sandwich, with its correction L / (L - p)."""
    weighted, jacobian = linearised(small, fit.lens.zoom)
    inverse = jnp.linalg.inv(jnp.einsum("lri,lrj->ij", jacobian, jacobian))
    pull = jnp.einsum("lri,lr->li", jacobian, weighted) @ inverse
    lines, parameters = pull.shape
    return lines / (lines - parameters) * pull.T @ pull


COVARIANCES = {
    "`fit.covariance`": lambda small, fit: fit.covariance,
    "points independent": independent_covariance,
    "plain sandwich": plain_sandwich,
}


def corner_errors(truth: zj.ZoomLens, scene: zj.Lines, noise: Noise, draws: int, *, seed: int = 0):
    """Errors of the corner's displacement over draws, px, at the two ends and the middle of the range.

    Returns:
        The errors, (draw, 3), and by each of `COVARIANCES` their standard deviations, (draw, 3).
    """
    keys = jax.random.split(jax.random.key(seed), draws)
    run = _corner_errors(truth, scene, jax.tree.map(jnp.asarray, noise), keys)
    return jax.tree.map(np.asarray, run)


@eqx.filter_jit
def _corner_errors(truth, scene, noise, keys):
    low, high = truth.focal_range
    focal, corner = jnp.stack([low, jnp.sqrt(low * high), high]), jnp.zeros(2)

    def displacement(lens):
        corrected = jax.vmap(lambda f: lens(f).undistort(corner))(focal)
        return jnp.linalg.norm(corrected - lens.centre[None], axis=1)

    def one(key):
        small = zj.compress(noise.draw(scene, key))
        fit = zj.fit_zoom(small, throw=False)
        fits = {
            name: eqx.tree_at(lambda fit: fit.covariance, fit, covariance(small, fit))
            for name, covariance in COVARIANCES.items()
        }
        stds = {name: zj.displacement_std(fit, corner, focal=focal) for name, fit in fits.items()}
        return displacement(fit.lens) - displacement(truth), stds

    # One draw after the other: batched factorisations are no faster on the CPU.
    return jax.lax.map(one, keys)


def coverage(draws: int) -> Table:
    """How often the truth lies within one and 1.96 standard deviations of the corner's displacement."""
    rows, data = [], {}
    for scene_name, arguments in SCENES.items():
        truth, scene = board(*arguments)
        for noise_name, noise in NOISES.items():
            errors, stds = corner_errors(truth, scene, noise, draws)
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
        "shrinkage of the paper's metric, which no covariance knows of.",
        ["scene", "noise", *COVARIANCES, "bias"],
        rows,
        data,
    )


def cost(draws: int) -> Table:
    """What the covariance takes of a warm compressed fit, on the paper's scene."""
    del draws
    truth = synthetic.nikkor_18_200()
    small = zj.compress(synthetic.board_lines(truth, synthetic.focal_sweep(), noise=0.5))
    fit = zj.fit_zoom(small)
    weighted, jacobian = eqx.filter_jit(linearised)(small, fit.lens.zoom)
    alone = eqx.filter_jit(parameter_covariance)
    flat, _ = ravel_pytree(fit.lens.zoom.parameters)
    times: dict[str, list[float]] = {"fit": [], "covariance": []}
    for _ in range(15):  # in turns, so that whatever else the machine does falls on both
        times["fit"].append(seconds(zj.fit_zoom, small))
        times["covariance"].append(seconds(alone, small, fit.lens.zoom, weighted, jacobian))
    least = {name: min(t) for name, t in times.items()}
    middle = {name: statistics.median(t) for name, t in times.items()}
    lines = len(small.frame)
    rows = [
        [name, f"{1e3 * least[name]:.1f} ms", f"{1e3 * middle[name]:.1f} ms"]
        for name in ("fit", "covariance")
    ]
    rows.append(["share", *(f"{t['covariance'] / t['fit']:.0%}" for t in (least, middle))])
    return Table(
        "Cost of the covariance",
        f"The paper's scene, {lines:,} lines, {flat.size} parameters, compressed, warm.",
        ["", "least", "median"],
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
            jax.vmap(lambda f: lens(f).undistort(corner))(focal) - lens.centre[None], axis=1
        )

    def one(key):
        for_noise, for_focal = jax.random.split(key)
        small = zj.compress(Noise().draw(scene, for_noise))
        off = jax.random.uniform(for_focal, scene.focal.shape, minval=-0.5, maxval=0.5)
        given = eqx.tree_at(lambda lines: lines.focal, small, scene.focal + off)
        plain = zj.fit_zoom(given, throw=False)
        found = zj.fit_focal(given, sigma, throw=False)
        widened = zj.with_focal_sigma(plain, given, focal_sigma=sigma)
        all_fits = (zj.fit_zoom(small, throw=False), plain, widened, found.fit)
        fits = dict(zip(_ROUNDED, all_fits, strict=True))
        offs = dict(zip(_ROUNDED, (0 * off, off, off, found.focal - scene.focal), strict=True))
        errors = {name: displacement(fit.lens) - displacement(truth) for name, fit in fits.items()}
        stds = {name: zj.displacement_std(fit, corner, focal=focal) for name, fit in fits.items()}
        return errors, stds, offs

    return jax.lax.map(one, keys)


TABLES: dict[str, Callable[[int], Table]] = {
    "coverage": coverage,
    "cost": cost,
    "rounded_focal": rounded_focal,
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


def markdown(m: dict, tables: list[Table]) -> str:
    """The results as a page."""
    page = [
        "# Trust",
        "",
        "`python benchmarks/trust.py`, float64.",
        "",
        f"{m['cpu']}, {m['cores']} cores, {m['memory_GB']} GB, load {m['load']}; Python {m['python']}, jax "
        f"{m['jax']}, optimistix {m['optimistix']}, numpy {m['numpy']}; on {m['device']}.",
    ]
    for table in tables:
        page += ["", f"## {table.title}", "", table.about, "", f"| {' | '.join(table.heads)} |"]
        page += ["|" + "---|" * len(table.heads), *(f"| {' | '.join(row)} |" for row in table.rows)]
    return "\n".join([*page, ""])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=2000)
    parser.add_argument("--tables", nargs="*", choices=TABLES, default=list(TABLES))
    parser.add_argument("--output", type=Path, default=RESULTS / "trust.md")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    tables = [TABLES[name](options.draws) for name in options.tables]
    about = machine()
    options.output.write_text(markdown(about, tables))
    content = {"machine": about, **{table.title: table.data for table in tables}}
    options.output.with_suffix(".json").write_text(json.dumps(content, indent=2) + "\n")
    print(options.output.read_text())
