"""The lenses of the database, straight lines seen through them, and each frame's energy.

Its models map corrected to distorted radii, in units of half the shorter side:
``Rd = a Ru^4 + b Ru^3 + c Ru^2 + (1 - a - b - c) Ru`` (ptlens), ``k1 Ru^3 + (1 - k1) Ru`` (poly3) or
``Ru (1 + k1 Ru^2 + k2 Ru^4)`` (poly5). (lensfunpy does not tell the aspect ratio of the images
calibrated: all are taken to be 3:2.)
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import zoomjax as zj
from zoomjax.lines.best_line import line_residuals

SIZE = (4288, 2848)
SCALE = float(np.hypot(*SIZE)) / 2
UPRIGHT, LEVEL, POINTS = 15, 10, 81
QUANTILES = (0.25, 0.5, 0.75, 0.9)
"""Of the lenses, in all tables."""


class Lens(NamedTuple):
    """A zoom of the database, by frame: focal length, model and its terms."""

    name: str
    crop: float
    frames: list[tuple[float, str, tuple[float, ...]]]


class Frames(NamedTuple):
    """A lens by frames: the energy of each, px^2, is ``energy + (k' - k)^T second (k' - k)``.

    Also a batch of lenses, with one more axis. Frames that only pad have zero second derivatives.
    """

    focal: Any  # (frame,), increasing; arrays of NumPy for one lens, of JAX for a batch
    k: Any  # (frame, 2), the optimum
    energy: Any  # (frame,)
    second: Any  # (frame, 2, 2)


def read_lenses() -> list[Lens]:
    """All rectilinear zooms with five or more calibrated focal lengths."""
    import lensfunpy

    lenses = []
    for lens in lensfunpy.Database().lenses:  # pyright: ignore[reportAttributeAccessIssue]
        frames = {c.focal: (c.focal, c.model.name, tuple(c.terms)) for c in lens.calib_distortion}
        if len(frames) >= 5 and lens.type.name == "RECTILINEAR":
            lenses.append(Lens(lens.model, lens.crop_factor, sorted(frames.values())))
    return lenses


def stretch(model: str, terms: tuple[float, ...], radius: np.ndarray) -> np.ndarray:
    """Distorted over corrected radius, at corrected radii in half the shorter side."""
    if model == "PTLENS":
        a, b, c = terms[:3]
        return ((a * radius + b) * radius + c) * radius + 1 - a - b - c
    if model == "POLY3":
        return terms[0] * radius**2 + 1 - terms[0]
    if model == "POLY5":
        return 1 + terms[0] * radius**2 + terms[1] * radius**4
    raise ValueError(f"The distortion model {model} is unknown.")


def see_lines(model: str, terms: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Straight lines through the lens: points, px, (line, point, 2), and which are in the image.

    They cross the image's axes at even distances, and are sampled evenly in the scene.
    """
    radius = np.linspace(0, 4, 1601)
    distorted = radius * stretch(model, terms, radius)
    falls = np.flatnonzero(np.diff(distorted) <= 0)
    end = falls[0] + 1 if falls.size else radius.size  # beyond this the lens folds
    half = (np.array(SIZE) - 1) / 2
    unit = SIZE[1] / 2
    corner = np.interp(np.hypot(*half) / unit, distorted[:end], radius[:end])
    points = []
    for axis, number in enumerate((UPRIGHT, LEVEL)):
        place = ((np.arange(number) + 0.5) / number * 2 - 1) * half[axis] / unit
        across = np.sign(place) * np.interp(np.abs(place), distorted[:end], radius[:end])
        grid = np.stack(np.meshgrid(across, np.linspace(-corner, corner, POINTS), indexing="ij"), -1)
        points.append(grid if axis == 0 else grid[..., ::-1])
    corrected = np.concatenate(points)
    distance = np.linalg.norm(corrected, axis=-1)
    seen = unit * corrected * stretch(model, terms, distance)[..., None]
    return seen + half, (np.abs(seen) <= half).all(-1) & (distance <= corner)


def make_lines(lenses: list[Lens]) -> zj.Lines:
    """The lines of all frames of all lenses."""
    frames = [frame for lens in lenses for frame in lens.frames]
    points, mask = (
        np.concatenate(a) for a in zip(*(see_lines(*frame[1:]) for frame in frames), strict=True)
    )
    return zj.Lines(
        points=jnp.asarray(np.where(mask[..., None], points, 0)),
        mask=jnp.asarray(mask),
        frame=jnp.asarray(np.repeat(np.arange(len(frames)), UPRIGHT + LEVEL)),
        focal=jnp.asarray([frame[0] for frame in frames]),
        centre=jnp.asarray((np.array(SIZE) - 1) / 2),
        image_size=SIZE,
        focal_unit="mm",
    )


def frames_of(lines, frames):
    """Triangles (frame, line, 7, 7) and focal lengths of some frames of compressed lines."""
    whole = lines.triangle.reshape(-1, UPRIGHT + LEVEL, 7, 7)
    return whole[frames], lines.focal[frames]


@jax.jit
def frame_energies(triangle, k):
    """The true energy (eq. 3), px^2, of frames of compressed lines, for coefficients k (frame, 2)."""

    def one(triangle, k):
        return jnp.sum(frame_residuals(triangle, k) ** 2)

    return jax.lax.map(lambda a: one(*a), (triangle, k), batch_size=512)


def frame_residuals(triangle, k):
    """Residuals whose sum of squares is eq. 3, from the triangles (line, 7, 7) of a frame."""
    kappa = jnp.concatenate([jnp.ones(1), k])
    columns = triangle[:, 1:, 1:].reshape(triangle.shape[0], 6, 3, 2)
    rows = SCALE * jnp.einsum("lrjc,j->lrc", columns, kappa)
    distances = jax.vmap(line_residuals)(rows) / triangle[:, :1, 0]
    return distances / jnp.sqrt(triangle.shape[0])


@jax.jit
def second_derivatives(triangle, k):
    """Half of the Gauss-Newton matrices of the frames' energies."""

    def one(triangle, k):
        jacobian = jax.jacfwd(lambda k: frame_residuals(triangle, k))(k).reshape(-1, 2)
        return jacobian.T @ jacobian

    return jax.lax.map(lambda a: one(*a), (triangle, k), batch_size=512)


def read() -> tuple[list[Lens], zj.lines.CompressedLines, list[Frames]]:
    """The lenses, their lines compressed, and each frame by itself."""
    lenses = read_lenses()
    lines = zj.compress(make_lines(lenses))
    each = zj.fit_frames(lines, throw=False)
    second = second_derivatives(frames_of(lines, ...)[0], each.coefficients)
    cuts = np.cumsum([len(lens.frames) for lens in lenses])[:-1]
    values = (lines.focal, each.coefficients, each.frame_rms**2, second)
    parts = zip(*(np.split(np.asarray(value), cuts) for value in values), strict=True)
    return lenses, lines, [Frames(*part) for part in parts]


def families(lenses: list[Lens]) -> np.ndarray:
    """For each lens the first one with the same table or the same name, directly or through others."""
    first = np.arange(len(lenses))
    for key in ([lens.name for lens in lenses], [str(lens.frames) for lens in lenses]):
        for value in set(key):
            same = [i for i, other in enumerate(key) if other == value]
            joined = np.isin(first, first[same])
            first[joined] = first[joined].min()
    return first


def halves(family: np.ndarray, seed: int = 0) -> np.ndarray:
    """0 or 1 for each lens, a family together."""
    names = np.unique(family)
    side = np.random.default_rng(seed).permutation(len(names)) % 2
    return side[np.searchsorted(names, family)]
