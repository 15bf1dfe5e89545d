"""Points in a differentiable pipeline: what the exact correction and its inverse cost.

    python -m benchmarks.pipeline [--points N] [--repeats N]

Each figure is a ratio of times in one run on one machine, calls of both taken in turn and medians compared.
The bare formula is eq. 1-2 written out, compiled; plain Newton is four steps of it, without any check.
The rivals on the same points are OpenCV's and kornia's (where it is installed) fixed-point undistortPoints
and undistort_points. Beside the time the largest error, px. Smaller is better.
"""

import argparse
import importlib.util
import time
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from zoomjax import Distortion, scenes
from zoomjax._core.types import AnyArray

from .shared import RESULTS, machine, machine_line, table, write

_NEWTON_STEPS = 4


def bare(d: Distortion, points: AnyArray) -> AnyArray:
    """Eq. 1-2."""
    z = (points - d.centre) / d.scale
    t = z[..., 0] * z[..., 0] + z[..., 1] * z[..., 1]
    factor = 1 + t * (d.coefficients[..., 0] + t * d.coefficients[..., 1])
    return d.centre + d.scale * z * factor[..., None]


def newton(d: Distortion, points: AnyArray) -> AnyArray:
    """Four plain steps for r L(r²) = ρ from r = ρ, and the residual."""
    z = (points - d.centre) / d.scale
    rho = jnp.sqrt(z[..., 0] * z[..., 0] + z[..., 1] * z[..., 1])
    k1, k2 = d.coefficients[..., 0], d.coefficients[..., 1]
    r = rho
    for _ in range(_NEWTON_STEPS):
        t = r * r
        r = r - (r * (1 + t * (k1 + t * k2)) - rho) / (1 + t * (3 * k1 + 5 * t * k2))
    t = r * r
    arrived = jnp.abs(r * (1 + t * (k1 + t * k2)) - rho) <= 1e-4 * rho
    ratio = jnp.where(arrived, r / jnp.where(rho > 0, rho, 1), jnp.nan)
    return d.centre + d.scale * z * ratio[..., None]


def paired(functions: dict, repeats: int) -> dict[str, float]:
    """Median times, s, of functions called in turn."""
    for function in functions.values():
        jax.block_until_ready(function())
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(repeats):
        for name, function in functions.items():
            start = time.perf_counter()
            jax.block_until_ready(function())
            times[name].append(time.perf_counter() - start)
    return {name: float(np.median(values)) for name, values in times.items()}


def operands(dtype: type, number: int):
    """The paper's lens, its distortion midway, points all over the image, and a focal length for each."""
    rng = np.random.default_rng(0)
    lens = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), scenes.nikkor_18_200())
    size = np.array(lens.image_size) - 1
    points = jnp.asarray(rng.uniform(0, 1, (number, 2)) * size, dtype)
    low, high = (float(end) for end in lens.focal_range)
    focal = jnp.asarray(rng.uniform(low, high, number), dtype)
    d = lens(float(np.sqrt(low * high)))
    return lens, d, points, focal


def functions(lens: Any, d: Distortion, points: AnyArray, focal: AnyArray) -> dict[str, tuple]:
    """What is timed, compiled, with its arguments."""
    ones = jnp.ones_like(points)

    def coefficients(f):
        u = lens.zoom.focal_ref / f
        a = lens.zoom.parameters
        return a[0] + u[:, None] * (a[1] + u[:, None] * a[2])

    def bent(f):
        return Distortion(coefficients(f), d.centre, d.scale)

    def gradient(function, by):
        return jax.jit(jax.grad(lambda d, p: jnp.sum(function(d, p) * ones), by))

    undistort, distort = (lambda d, p: d.undistort(p)), (lambda d, p: d.distort(p))
    return {
        "bare formula": (jax.jit(bare), (d, points)),
        "undistort": (jax.jit(undistort), (d, points)),
        "plain Newton": (jax.jit(newton), (d, points)),
        "distort": (jax.jit(distort), (d, points)),
        **{
            f"{name}, gradient by {what}": (gradient(function, by), (d, points))
            for name, function in (("bare formula", bare), ("undistort", undistort), ("distort", distort))
            for what, by in (("points", 1), ("lens", 0))
        },
        "bare formula, f a point": (jax.jit(lambda f, p: bare(bent(f), p)), (focal, points)),
        "undistort, f a point": (jax.jit(lambda f, p: lens.undistort(p, f)), (focal, points)),
        "plain Newton, f a point": (jax.jit(lambda f, p: newton(bent(f), p)), (focal, points)),
        "distort, f a point": (jax.jit(lambda f, p: lens.distort(p, f)), (focal, points)),
    }


def measure(dtype: type, number: int, repeats: int) -> dict[str, float]:
    """Times, s, and errors, px."""
    lens, d, points, focal = operands(dtype, number)
    compiled = functions(lens, d, points, focal)
    calls: dict[str, Any] = {
        name: lambda function=function, arguments=arguments: function(*arguments)
        for name, (function, arguments) in compiled.items()
    }
    host = np.asarray(points)
    calls["NumPy undistort"] = lambda: d.undistort(host)
    calls["NumPy distort"] = lambda: d.distort(host)
    k = np.asarray(d.coefficients, float)
    camera = np.array(
        [[float(d.scale), 0, d.centre[0]], [0, float(d.scale), d.centre[1]], [0, 0, 1]], float
    )
    pixels = np.asarray(points, float)[:, None]
    opencv = np.array([*k, 0, 0])
    calls["OpenCV undistortPoints"] = lambda: cv2.undistortPoints(pixels, camera, opencv, P=camera)
    calls |= kornia_calls(np.asarray(points), camera, opencv)
    result = paired(calls, repeats)
    wide = Distortion(k, np.asarray(d.centre, float), np.asarray(d.scale, float))
    exact = wide.distort(np.asarray(points, float))

    def error(positions):
        return float(np.max(np.abs(np.asarray(positions, float).reshape(-1, 2) - exact)))

    result["distort, px"] = error(d.distort(points))
    result["plain Newton, px"] = error(newton(d, points))
    result["OpenCV, px"] = error(calls["OpenCV undistortPoints"]())
    if "kornia undistort_points" in calls:
        result["kornia, px"] = error(calls["kornia undistort_points"]().detach())
    # Of normalised points, as the rounding of a centre in px would hide it.
    unit = Distortion(d.coefficients, jnp.zeros(2, dtype), jnp.ones((), dtype))
    z = (points - d.centre) / d.scale
    found, z = (np.asarray(values).astype(np.longdouble) for values in (unit.distort(z), z))
    t = np.sum(found**2, axis=1)
    k = np.asarray(d.coefficients).astype(np.longdouble)
    missed = np.hypot(*(found * (1 + t * (k[0] + t * k[1]))[:, None] - z).T)
    ulp = np.spacing(np.hypot(*z.T).astype(dtype))
    result["residual, ulp of the radius"] = float(np.max(missed / ulp))
    return result


def kornia_calls(points: np.ndarray, camera: np.ndarray, coefficients: np.ndarray) -> dict[str, Any]:
    """kornia's functions of the same points; none if it is not installed."""
    if importlib.util.find_spec("kornia") is None:
        return {}
    import torch  # pyright: ignore[reportMissingImports]
    from kornia.geometry.calibration import (  # pyright: ignore[reportMissingImports]
        distort_points,
        undistort_points,
    )

    tensor = torch.from_numpy(points.copy())  # JAX's memory is not to be written to
    camera, coefficients = (torch.from_numpy(a).to(tensor.dtype)[None] for a in (camera, coefficients))

    def gradient():
        variable = tensor.clone().requires_grad_()
        undistort_points(variable[None], camera, coefficients, new_K=camera).sum().backward()
        return variable.grad

    return {
        "kornia distort_points": lambda: distort_points(
            tensor, camera[0], coefficients[0], new_K=camera[0]
        ),
        "kornia undistort_points": lambda: undistort_points(
            tensor[None], camera, coefficients, new_K=camera
        )[0],
        "kornia undistort_points, gradient by points": gradient,
    }


RATIOS = (
    ("undistort", "bare formula", 1.3),
    ("undistort, gradient by points", "undistort", 3),
    ("undistort, gradient by lens", "undistort", 3),
    ("bare formula, gradient by lens", "bare formula", None),
    ("distort", "plain Newton", 1.3),
    ("distort, gradient by points", "distort", 3),
    ("distort, gradient by lens", "distort", 3),
    ("undistort, f a point", "bare formula, f a point", 1.3),
    ("undistort, f a point", "undistort", 1.5),
    ("distort, f a point", "plain Newton, f a point", 1.3),
    ("distort, f a point", "distort", 1.5),
    ("distort", "OpenCV undistortPoints", None),
    ("undistort", "kornia distort_points", None),
    ("distort", "kornia undistort_points", None),
    ("distort, gradient by points", "kornia undistort_points, gradient by points", None),
)


def main() -> None:
    """Measure, print, and write the results page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=524_288)
    parser.add_argument("--repeats", type=int, default=31)
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    results = {
        np.dtype(dtype).name: measure(dtype, arguments.points, arguments.repeats)
        for dtype in (np.float32, np.float64)
    }
    rows = [
        [
            a.strip(),
            b,
            *(f"{results[kind][a] / results[kind][b]:.2f}" for kind in results),
            "" if asked is None else f"{asked:g}",
        ]
        for a, b, asked in RATIOS
        if a in results["float64"] and b in results["float64"]
    ]
    names = [name for name in results["float64"] if "px" not in name and "ulp" not in name]
    accuracy = [name for name in results["float64"] if "px" in name or "ulp" in name]
    about = machine()
    page = [
        "# Points in a pipeline",
        "",
        f"{arguments.points:,} points, medians of {arguments.repeats} calls in turn. {machine_line(about)}",
        "",
        *table(["time of", "over that of", *results, "asked"], rows),
        "",
        *table(
            ["", *(f"{kind}, ms" for kind in results)],
            [[name.strip(), *(f"{1e3 * results[kind][name]:.1f}" for kind in results)] for name in names],
        ),
        "",
        *table(
            ["largest error", *results],
            [[name, *(f"{results[kind][name]:.2g}" for kind in results)] for name in accuracy],
        ),
        "",
        "By `benchmarks/pipeline.py`. The bare formula is eq. 1-2; plain Newton is four steps with the "
        "residual looked at once, which is not enough for all lenses. OpenCV iterates the same polynomial "
        "a fixed number of times, in float64; kornia too, in the points' dtype. A gradient by the lens is "
        "five sums over all points in one pass, which XLA does not vectorise on a CPU.",
    ]
    write(RESULTS / "pipeline.md", "\n".join(page) + "\n", {"machine": about, "results": results})


if __name__ == "__main__":
    main()
