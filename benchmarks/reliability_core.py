"""Directed and random searches for silent wrong answers: compression, certificates and fits.

Each search draws inputs, ugly ones included, and compares every answer with one found in another way:
80-bit floats for compression, exact fractions for certificates, plain NumPy for fits. It returns how many
inputs were tried, and how many answers were wrong without a word, or raised what they should not. float64
must be enabled. Tests run them with small counts, `reliability.py` with large ones.
"""

from collections.abc import Callable
from fractions import Fraction
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import zoomjax as zj
from zoomjax.fit.energy import line_rms, residuals

Counts = dict[str, int]

FLOOR = {np.float64: 2e-14, np.float32: 2e-6}
"""What `compress` says of itself: the error of a line's RMS, in half image diagonals."""

LINES, POINTS = 48, 128  # of a batch: one shape, compiled once
COEFFICIENTS = ((0.0, 0.0), (0.1, -0.05), (-0.3, 0.2), (-0.33, 0.03), (3.0, -2.0))


# Compression


def _segment(first, last, number=POINTS):
    return np.array(first) + np.linspace(0, 1, number)[:, None] * np.subtract(last, first)


def _bent(rng, size):
    first, last = rng.uniform(0, size, (2, 2))
    line = _segment(first, last, rng.integers(3, POINTS + 1))
    t = np.linspace(-1, 1, len(line))[:, None]
    return line + rng.uniform(0, 0.02) * size * (1 - t**2) * rng.choice([-1, 1], 2)


KINDS: dict[str, Callable[[np.random.Generator, np.ndarray], np.ndarray]] = {
    "bent": _bent,
    "noisy": lambda rng, size: (line := _bent(rng, size)) + rng.normal(0, 2, line.shape),
    "straight": lambda rng, size: _segment(*rng.uniform(0, size, (2, 2))),
    "vertical": lambda rng, size: _segment((x := rng.uniform(0, size[0]), 0), (x, size[1])),
    "horizontal": lambda rng, size: _segment((0, y := rng.uniform(0, size[1])), (size[0], y)),
    "diagonal": lambda rng, size: _segment((0, 0), (min(size), min(size))),
    "through the centre": lambda rng, size: (
        (size - 1) / 2 + np.linspace(-0.4, 0.4, 65)[:, None] * size[1] * _direction(rng)
    ),
    "at the centre": lambda rng, size: (size - 1) / 2 + 1e-7 * rng.standard_normal((40, 2)),
    "nearly coincident": lambda rng, size: rng.uniform(0, size) + 1e-9 * rng.standard_normal((40, 2)),
    "coincident": lambda rng, size: np.repeat(rng.uniform(0, size, (1, 2)), 30, axis=0),
    "three in a pixel": lambda rng, size: rng.uniform(0, size) + np.array([[0, 0], [0.5, 0.01], [1, 0]]),
    "1e-9 px apart": lambda rng, size: _segment(p := rng.uniform(0, size), p + 4e-9 * _direction(rng), 5),
    "each point thrice": lambda rng, size: np.repeat(_bent(rng, size)[:40], 3, axis=0),
    "two places": lambda rng, size: np.repeat(rng.uniform(0, size, (2, 2)), 60, axis=0),
    "square": lambda rng, size: rng.uniform(0, size) + 50 * np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]),
}


def _direction(rng):
    angle = rng.uniform(0, np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


def _lines(points, size, dtype, garbage=0.0) -> zj.Lines:
    padded = np.full((len(points), POINTS, 2), garbage)
    mask = np.zeros(padded.shape[:2], bool)
    for row, there, line in zip(padded, mask, points, strict=True):
        row[: len(line)], there[: len(line)] = line, True
    return zj.Lines(
        points=jnp.asarray(padded.astype(dtype)),
        mask=jnp.asarray(mask),
        frame=jnp.zeros(len(points), jnp.int32),
        focal=jnp.ones(1, dtype),
        centre=jnp.asarray((np.array(size) - 1) / 2, dtype),
        image_size=size,
    )


def _exact_rms(line, k, centre, scale):
    """RMS distance of a corrected line to its best line in 80-bit floats, and how far points are moved."""
    z = (line.astype(np.longdouble) - centre) / np.longdouble(scale)
    t = np.sum(z**2, axis=1, keepdims=True)
    corrected = scale * z * (1 + sum(np.longdouble(ki) * t ** (i + 1) for i, ki in enumerate(k)))
    x, y = (corrected - corrected.mean(axis=0)).T
    angle = np.arctan2(2 * (x @ y), x @ x - y @ y) / 2
    grown = np.max(np.sqrt(t) * (1 + sum(abs(ki) * t ** (i + 1) for i, ki in enumerate(k))))
    return float(np.sqrt(np.mean((y * np.cos(angle) - x * np.sin(angle)) ** 2))), float(max(grown, 1))


@eqx.filter_jit
def _normal_equations(lines, k):
    rows, by_k = jax.jvp(lambda k: residuals(lines, k), (k,), (jnp.ones_like(k),))
    return jnp.sum(rows * by_k, axis=1), jnp.sum(by_k**2, axis=1)


def compression(count: int, seed: int = 0) -> Counts:
    """Lines of all kinds: RMS, normal equations, garbage behind the mask, other orders, chunks."""
    rng = np.random.default_rng(seed)
    tried = wrong = crashed = 0
    turn = 0
    while tried < count:
        size = ((640, 480), (100_000, 100_000))[turn // 2 % 2]
        dtype = (np.float64, np.float32)[turn % 2]
        k = np.array([COEFFICIENTS[turn % len(COEFFICIENTS)]])
        turn += 1
        kinds = [*KINDS, *rng.choice(list(KINDS), LINES - len(KINDS))]
        points = [KINDS[kind](rng, np.array(size, float)).astype(dtype) for kind in kinds]
        try:
            lines = _lines(points, size, dtype)
            bad = _wrong_lines(rng, lines, points, k.astype(dtype), dtype)
        except Exception as error:
            print(f"compression: {type(error).__name__}: {error}")
            crashed, bad = crashed + 1, np.zeros(LINES, bool)
        for index in np.flatnonzero(bad):
            print(f"compression: wrong: {kinds[index]}, {dtype.__name__}, size {size}, k {k[0]}")
        tried, wrong = tried + LINES, wrong + int(bad.sum())
    return {"tried": tried, "wrong": wrong, "lost": 0, "crashed": crashed, "hung": 0}


def _wrong_lines(rng, lines, points, k, dtype):
    small = zj.compress(lines)
    exact, grown = np.transpose(
        [_exact_rms(line, k[0].astype(float), np.asarray(lines.centre), lines.scale) for line in points]
    )
    allowed = FLOOR[dtype] * lines.scale * grown
    bad = ~(np.abs(np.asarray(line_rms(small, jnp.asarray(k)), float) - exact) <= allowed)
    bad |= np.asarray(small.counts) != [len(line) for line in points]
    # What is behind the mask is not looked at: the same bits.
    for garbage in (np.nan, np.inf, 1e30):
        spoiled = zj.compress(_lines(points, lines.image_size, dtype, garbage))
        bad |= (np.asarray(spoiled.triangle) != np.asarray(small.triangle)).any(axis=(1, 2))
    # Chunks of the points, in any order of lines.
    first = np.asarray(lines.mask) & (rng.uniform(size=lines.mask.shape) < rng.uniform())
    order = rng.permutation(LINES)

    def chunk(mask):
        return zj.compress(
            eqx.tree_at(
                lambda data: (data.points, data.mask),
                lines,
                (lines.points[order], jnp.asarray(mask[order])),
            )
        )

    merged = zj.lines.merge(chunk(first), chunk(np.asarray(lines.mask) & ~first))
    again = np.empty(LINES)
    again[order] = np.asarray(line_rms(merged, jnp.asarray(k)), float)
    bad |= ~(np.abs(again - exact) <= 2 * allowed)
    # The gradient and the Gauss-Newton matrix, where the line has a direction of its own.
    directed = np.array([_directed(line, k[0], lines) for line in points])
    for of_all, of_small in zip(
        *(_normal_equations(data, jnp.asarray(k)) for data in (lines, small)), strict=True
    ):
        of_all, of_small = (np.asarray(values, float) for values in (of_all, of_small))
        share = 1e3 * np.finfo(dtype).eps * grown**2 * (lines.scale**2 / LINES)
        bad |= directed & ~(np.abs(of_all - of_small) <= share)
    return bad


def _directed(line, k, lines):
    """Whether one direction stands out among the points, also after rounding."""
    z = (line.astype(float) - np.asarray(lines.centre, float)) / lines.scale
    t = np.sum(z**2, axis=1, keepdims=True)
    corrected = z * (1 + k[0] * t + k[1] * t**2)
    long, short = np.linalg.svd(corrected - corrected.mean(axis=0), compute_uv=False)
    return long > 1.1 * short and long > 1e-3


# Certificates


def certificates(count: int, seed: int = 0) -> Counts:
    """Zoom polynomials next to a fold, on both sides of it: none that folds may be certified.

    Slopes are evaluated in exact fractions where a dense search finds them least. "undecided" counts the
    lenses that are invertible, by that search, and were not certified: allowed next to a fold.
    """
    rng = np.random.default_rng(seed)
    tried = wrong = undecided = 0
    batch = 100
    while tried < count:
        degree, terms = int(rng.integers(0, 7)), int(rng.integers(1, 4))
        dtype = (np.float64, np.float32)[int(rng.integers(0, 4)) == 0]
        low = 20.0
        high = low * (1 + rng.choice([0.0, 1e-9, 1e-3, 0.5, 9.0]))
        parameters = rng.standard_normal((batch, degree + 1, terms)) * rng.choice([0.1, 0.3, 1, 1e3])
        margin = rng.choice([0.0, 1e-15, 1e-12, 1e-9, 1e-6, 1e-2], batch) * rng.choice([-1, 1], batch)
        for index, one in enumerate(parameters):
            least = _least(one, low / high)[0]
            one *= (1 - margin[index]) / (1 - least) if least < 0.99 else 1.0
        parameters = parameters.astype(dtype)
        focal = np.array([low, high], dtype)
        ours = _certified(jnp.asarray(parameters), jnp.asarray(focal))
        certified, bound = (np.asarray(values, float) for values in ours)
        for one, proved, least in zip(parameters.astype(float), certified, bound, strict=True):
            _, u, t = _least(one, float(focal[0]) / float(focal[1]))
            exact = _exact_slope(one, u, t)
            bad = (proved and exact <= 0) or least > exact
            if bad:
                print(f"certificates: wrong: {one.tolist()}, {focal}, {dtype.__name__}, at u {u}, t {t}")
            wrong += bad
            undecided += exact > 0 and not proved
        tried += batch
    return {"tried": tried, "wrong": wrong, "lost": 0, "crashed": 0, "hung": 0, "undecided": int(undecided)}


@eqx.filter_jit
def _certified(parameters, focal):
    def one(parameters):
        zoom = zj.PolynomialZoom(parameters.shape[0] - 1, parameters, focal[0])
        centre = jnp.asarray([319.5, 239.5], focal.dtype)
        found = zj.models.certify(zj.ZoomLens(zoom, centre, focal, (640, 480)))
        return found.certified, found.least

    return jax.vmap(one)(parameters)


def _least(parameters, lowest, number=41):
    """The least slope of a model by a grid that closes in on it, and where: u = f_ref / f, and t."""
    degree, terms = parameters.shape[0] - 1, parameters.shape[1]
    order = 2 * np.arange(1, terms + 1) + 1
    low, high = np.array([lowest, 0.0]), np.ones(2)
    first, last = low, high
    best = (np.inf, 1.0, 0.0)
    for _ in range(6):
        u, t = (np.linspace(first[axis], last[axis], number) for axis in (0, 1))
        values = 1 + (u[:, None] ** np.arange(degree + 1)) @ (parameters * order) @ (
            t[None] ** np.arange(1, terms + 1)[:, None]
        )
        i, j = np.unravel_index(values.argmin(), values.shape)
        best = min(best, (float(values[i, j]), float(u[i]), float(t[j])))
        here, step = np.array([u[i], t[j]]), (last - first) / (number - 1)
        first, last = np.maximum(here - 2 * step, low), np.minimum(here + 2 * step, high)
    return best


def _exact_slope(parameters, u, t):
    u, t = Fraction(u), Fraction(t)
    k = [sum(Fraction(float(a)) * u**j for j, a in enumerate(column)) for column in parameters.T]
    return 1 + sum((2 * i + 3) * ki * t ** (i + 1) for i, ki in enumerate(k))


# Fits

FRAMES, PER_FRAME, OF_LINE = 4, 5, 12
_SIZE, _CENTRE, _SCALE = (640, 480), np.array([319.5, 239.5]), 400.0
SCENES = (
    *("usual", "one frame without weight", "two frames without weight", "no weight at all"),
    *("NaN", "through the centre", "all the same", "coincident", "straight", "huge noise"),
    *("focal lengths nearly equal", "folding"),
)


def fits(count: int, seed: int = 0) -> Counts:
    """Scenes of all kinds: figures agree with plain NumPy, and what is not determined is said to be so."""
    rng = np.random.default_rng(seed)
    tried = wrong = crashed = 0
    while tried < count:
        kind = SCENES[tried % len(SCENES)]
        lines, must_not = _scene(rng, kind)
        tried += 1
        try:
            fit = _fitted(lines)
            complaint = _complaint(lines, fit, must_not)
        except Exception as error:
            print(f"fits: {kind}: {type(error).__name__}: {error}")
            crashed += 1
            continue
        if complaint:
            print(f"fits: wrong: {kind}: {complaint}")
            wrong += 1
    return {"tried": tried, "wrong": wrong, "lost": 0, "crashed": crashed, "hung": 0}


@eqx.filter_jit
def _fitted(lines):
    return zj.fit_zoom(zj.compress(lines), throw=False)


def _scene(rng, kind) -> tuple[zj.Lines, bool]:
    """Lines of a kind, and whether they determine nothing, so that the fit must not say that they do."""
    number = FRAMES * PER_FRAME
    along = np.stack([_direction(rng) for _ in range(number)])
    foot = rng.uniform((40, 40), (600, 440), (number, 2))
    reach = rng.uniform(60, 250, number)
    focal = 24 + np.array([0.0, 8, 24, 60]) * (1e-6 if kind == "focal lengths nearly equal" else 1)
    frame = np.repeat(np.arange(FRAMES), PER_FRAME)
    if kind == "through the centre":
        foot[:] = _CENTRE
    if kind == "all the same":
        foot[:], along[:], reach[:] = foot[0], along[0], reach[0]
    if kind == "coincident":
        reach[:] = 0
    t = np.linspace(-1, 1, OF_LINE)
    points = foot[:, None] + (reach[:, None] * t)[..., None] * along[:, None]
    z = (points - _CENTRE) / _SCALE
    bend = {"straight": 0.0, "folding": -0.6}.get(kind, rng.uniform(-0.15, 0.15))
    share = (24 / focal[frame])[:, None, None]
    points = points - _SCALE * z * bend * share * np.sum(z**2, axis=-1, keepdims=True)
    noise = {"straight": 0.0, "coincident": 0.0, "huge noise": 50.0}.get(kind, 0.2)
    points = points + noise * rng.standard_normal(points.shape)
    left = {"one frame without weight": 3, "two frames without weight": 2, "no weight at all": 0}
    lines = zj.Lines(
        points=jnp.asarray(points),
        mask=jnp.ones(points.shape[:2], bool),
        frame=jnp.asarray(frame, jnp.int32),
        focal=jnp.asarray(focal),
        centre=jnp.asarray(_CENTRE),
        image_size=_SIZE,
    ).weighted((frame < left.get(kind, FRAMES)).astype(float))
    if kind == "NaN":  # which the constructor refuses where it can see them
        points[rng.integers(number), rng.integers(OF_LINE), 0] = rng.choice([np.nan, np.inf, -np.inf])
        lines = eqx.tree_at(lambda lines: lines.points, lines, jnp.asarray(points))
    nothing = ("two frames without weight", "no weight at all", "NaN", "through the centre", "coincident")
    return lines, kind in nothing


def _complaint(lines, fit, must_not) -> str:
    """What is wrong with a fit, or nothing."""
    result = zj.RESULTS[fit.result]
    determined = result == zj.RESULTS[zj.RESULTS.successful]
    if must_not and (determined or np.isfinite(np.diagonal(fit.covariance)).all()):
        return "determined, it says, by lines that say nothing"
    if not np.isfinite(np.asarray(lines.points)).all():
        return "a finite RMS of points that are not" if np.isfinite(fit.rms) else ""
    k = np.asarray(jax.vmap(fit.lens.zoom)(lines.focal))
    own = np.asarray(lines.weight) > 0
    frame = np.asarray(lines.frame)
    squares = [
        _exact_rms(line, k[m], _CENTRE, _SCALE)[0] ** 2
        for line, m in zip(np.asarray(lines.points), frame, strict=True)
    ]
    expected = np.full(FRAMES, np.nan)
    for m in np.unique(frame[own]):
        expected[m] = np.mean(np.array(squares)[own & (frame == m)])
    # Focal lengths that are nearly the same have parameters of 1e8 and more, whose sum has fewer digits.
    basis = np.abs(np.asarray(jax.vmap(fit.lens.zoom.basis)(lines.focal)))
    size = float(np.max(basis @ np.abs(np.asarray(fit.lens.zoom.parameters))))
    rounding = 8 * np.finfo(float).eps * size * _SCALE
    agree = partial(np.allclose, rtol=1e-6, atol=1e-10 + rounding, equal_nan=True)
    if not agree(np.sqrt(expected), fit.frame_rms):
        return f"frame_rms {fit.frame_rms}, but plainly {np.sqrt(expected)}"
    if not agree(np.sqrt(np.nanmean(expected)) if own.any() else np.nan, fit.rms):
        return f"rms {fit.rms}, but plainly {np.sqrt(np.nanmean(expected))}"
    none = np.asarray(zj.frame_rms(lines, None))
    if own.any() and fit.rms**2 > np.nanmean(none**2) * (1 + 1e-9) + 1e-18:
        return f"rms {fit.rms}, worse than no correction, {np.sqrt(np.nanmean(none**2))}"
    if determined and bool(fit.certificate.certified):
        corners = zj.displacement_std(fit, np.zeros((1, 2)), focal=np.asarray(lines.focal))
        if not (np.asarray(corners) > 0).all():
            return f"a standard deviation of {corners} px at the corner"
    return ""
