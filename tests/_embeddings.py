"""What is differentiable, and what it can be put into: the rows and columns of the table of embeddings.

A row is a function of a subject (a lens, a distortion, lines, a fit: any pytree of this package's) and of
an array x, both small. A column, a way, embeds it. ``python tests/_embeddings.py`` writes the table into
docs/embedding.md; ``python tests/_embeddings.py float32`` runs the column of several devices, for which
JAX needs to be told how many there are before it starts.
"""

import functools
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

import zoomjax as zj

PAGE = Path(__file__).parents[1] / "docs" / "embedding.md"
SIZE, FOCAL = (60, 40), (20.0, 35.0, 80.0)
DEVICES = 4


class Row(NamedTuple):
    """A function of a subject and an array, and which of its columns are other than usual.

    `slow` rows compile for seconds. `constant` ones have no derivative. `solves` ones run a solver of
    optimistix, which does not say what differs from device to device: ``shard_map(..., check_vma=False)``.
    Those not `sharded` fail there. `step` is the share by which finite differences move arrays: small where
    a function bends soon. `doubles` refuse float32.
    """

    name: str
    function: Callable[[Any, Any], Any]
    subject: Callable[[], Any]
    x: Callable[[], Any]
    slow: bool = False
    constant: bool = False
    solves: bool = False
    sharded: bool = True
    step: float = 1e-4
    doubles: bool = False


def lens(terms=2):
    parameters = np.array([[-0.04, 0.006], [0.02, -0.004], [0.12, 0.01]])[:, :terms]
    zoom = zj.PolynomialZoom(2, jnp.asarray(parameters), jnp.asarray(FOCAL[0]))
    return zj.ZoomLens(zoom, jnp.array([29.0, 20.0]), jnp.array([FOCAL[0], FOCAL[-1]]), SIZE)


def distortion(distortion_model=None, k=(0.1, -0.02)):
    distortion_model = zj.models.RadialPolynomial() if distortion_model is None else distortion_model
    return zj.Distortion(jnp.array(k), jnp.array([29.0, 20.0]), jnp.array(36.0), distortion_model)


@functools.cache
def lines():
    """Three frames of six lines of nine points, bent by the lens of one term, with noise."""
    rng, t = np.random.default_rng(1), np.linspace(0, 1, 9)[:, None]
    points, frame = [], []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for index, f in enumerate(FOCAL):
            for _ in range(6):
                angle, foot = rng.uniform(0, np.pi), rng.uniform((8, 8), (52, 32))
                along = np.array([np.cos(angle), np.sin(angle)])
                straight = foot + 20 * (2 * t - 1) * along
                points.append(np.asarray(lens(1)(f).distort(straight)) + 0.02 * rng.standard_normal((9, 2)))
                frame.append(index)
        return zj.Lines.from_ragged(points, np.array(frame), np.array(FOCAL), image_size=SIZE)


def seen(x):
    """The lines with other points."""
    return eqx.tree_at(lambda data: data.points, lines(), x)


def with_points(function):
    """A function of lines as one of (the lines, their points)."""
    return lambda data, x: function(eqx.tree_at(lambda data: data.points, data, x))


def points():
    return jnp.array([[3.0, 4.0], [29.0, 20.0], [58.0, 37.0]])


def line_points():
    return jnp.asarray(lines().points)


def coefficients(size=1):
    return jnp.array([[0.08, 0.01], [0.02, -0.01], [-0.03, 0.01]])[:, :size]


@functools.cache
def fit():
    return zj.fit_zoom(zj.compress(lines(), 1), zoom=zj.PolynomialZoom(1), terms=1)


def squared(small):
    """R^T R: what is differentiable of compressed lines; R itself is one of many roots."""
    return jnp.einsum("lri,lrj->lij", small.triangle, small.triangle, precision="highest")


def numbers(fit):
    return fit.lens.zoom.parameters, fit.rms


def fitted(data):
    zoom = zj.PolynomialZoom(1)
    return numbers(zj.fit_zoom(data, zoom=zoom, terms=1, throw=False))


def robust(data):
    return numbers(zj.fit_robust(data, zoom=zj.PolynomialZoom(1), terms=1, throw=False).fit)


def apart(own, x):
    return zj.trust.displacement_rms(own, zoomed(own, 1.1 * x))


def zoomed(own, x):
    return eqx.tree_at(lambda lens: lens.zoom.parameters, own, x)


def sized(own, x):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return zj.models.lens_for_size(own, (120, 80))(30.0).undistort(2 * x)


def image():
    return jnp.asarray(np.random.default_rng(2).uniform(size=(5, 6)))


def small_distortion():
    return zj.Distortion(jnp.array([0.1, -0.02]), jnp.array([2.4, 2.1]), jnp.array(3.9))


EACH = np.array([21.0, 33.0, 70.0])
"""A focal length for each point; known, so that functions meet both known and traced arguments."""

PRINCIPAL = np.array([320.0, 240.0])

MODELS = (zj.models.TableZoom(), zj.models.SplineZoom(3))


def by_model(zoom):
    """A row of the algebraic estimate: every model made ready, and evaluated."""
    return Row(
        f"algebraic_zoom ({type(zoom).__name__})",
        with_points(lambda data: zj.fit.algebraic_zoom(data, zoom=zoom, terms=1)(33.0).coefficients),
        lines,
        line_points,
    )


def two_regions():
    """Lines in six frames, three on each side of the crossover, and the model that needs them."""
    data = lines()
    focal = jnp.array([20.0, 24.0, 30.0, 50.0, 60.0, 80.0])
    return eqx.tree_at(lambda d: (d.frame, d.focal), data, (jnp.arange(18, dtype=jnp.int32) // 3, focal))


def board():
    return jnp.array([[0.0, 0.0], [300.0, 0.0], [300.0, 200.0], [0.0, 200.0], [130.0, 90.0]])


def oblique():
    """The board as a camera of f = 900 px sees it from the side, px."""
    (a, b), (c, d) = ((np.cos(angle), np.sin(angle)) for angle in (0.5, -0.4))
    turned = np.array([[a, 0.0, b], [b * d, c, -a * d], [-b * c, d, a * c]])
    x, y, depth = (board() @ turned[:, :2].T + np.array([[0.0, 0.0, 1500.0]])).T
    return jnp.stack([320 + 900 * x / depth, 240 + 900 * y / depth], axis=-1) + 0.1 * jnp.sin(board())


def edges():
    corners = board()[:4]
    return jnp.stack([corners, jnp.roll(corners, -1, axis=0)], axis=1)


def on_edges():
    seen = oblique()[:4]
    share = jnp.array([0.1, 0.4, 0.9])[:, None]
    return jax.vmap(lambda a, b: a[None] + share * (b - a)[None])(seen, jnp.roll(seen, -1, axis=0))


def focal_numbers(estimate):
    return estimate.focal, estimate.std


def wider(own, x):
    return zj.fit.with_focal_sigma(
        own, zj.compress(lines().about(own.lens.centre), 1), focal_sigma=x
    ).covariance


def with_focals(data, x):
    found = zj.fit.fit_focal(seen_by(data, x), 0.5, zoom=zj.PolynomialZoom(1), terms=1, throw=False)
    return found.focal, found.fit.rms


def seen_by(data, x):
    return eqx.tree_at(lambda data: data.points, data, x)


def centred(data):
    fitted = zj.fit.fit_centre(data, zoom=zj.PolynomialZoom(1), terms=1, throw=False).fit
    return fitted.lens.centre, fitted.rms


ROWS = [
    Row("Distortion.undistort", lambda d, x: d.undistort(x), distortion, points),
    Row("Distortion.distort", lambda d, x: d.distort(x), distortion, points),
    Row(
        "Distortion.distort (Division)",
        lambda d, x: d.distort(x),
        lambda: distortion(zj.models.Division(), (-0.1,)),
        points,
    ),
    Row(
        "Distortion.distort (BrownConrady)",
        lambda d, x: d.distort(x),
        lambda: distortion(zj.models.BrownConrady(), (0.1, 0.01, -0.02)),
        points,
    ),
    Row("Distortion.has_inverse", lambda d, x: d.has_inverse(x), distortion, points, constant=True),
    Row(
        "Distortion.monotone_radius",
        lambda d, x: d.monotone_radius + 0 * jnp.sum(x),
        lambda: distortion(k=(-0.2,)),
        points,
        constant=True,
    ),
    Row("ZoomLens()", lambda own, f: own(f).coefficients, lens, lambda: jnp.array(33.0)),
    Row("ZoomLens() of several", lambda own, f: own(f).coefficients, lens, lambda: jnp.asarray(EACH)),
    Row("ZoomLens().undistort", lambda own, x: own(35.0).undistort(x), lens, points),
    Row("ZoomLens().distort", lambda own, x: own(35.0).distort(x), lens, points),
    Row("ZoomLens.undistort", lambda own, x: own.undistort(x, 35.0), lens, points),
    Row("ZoomLens.undistort, f of each point", lambda own, x: own.undistort(x, EACH), lens, points),
    Row("ZoomLens.distort", lambda own, x: own.distort(x, 35.0), lens, points),
    Row("ZoomLens.distort, f of each point", lambda own, x: own.distort(x, EACH), lens, points),
    Row("warp_image", lambda d, x: zj.warp_image(x, d), small_distortion, image),
    Row(
        "warp_image, cubic",
        lambda d, x: zj.warp_image(x, d, interpolation="cubic"),
        small_distortion,
        image,
    ),
    Row("lens_for_size", sized, lens, points),
    Row(
        "certify",
        lambda own, x: zj.models.certify(zoomed(own, x)).least,
        lens,
        lambda: lens().zoom.parameters,
        constant=True,
    ),
    Row("displacement_rms", apart, lens, lambda: lens().zoom.parameters),
    Row("compress", with_points(lambda data: squared(zj.compress(data, 1))), lines, line_points),
    Row(
        "merge",
        with_points(lambda data: squared(zj.lines.merge(zj.compress(data, 1), zj.compress(data, 1)))),
        lines,
        line_points,
    ),
    Row(
        "concatenate",
        with_points(lambda data: squared(zj.fit.concatenate([zj.compress(data, 1), zj.compress(data, 1)]))),
        lines,
        line_points,
    ),
    Row(
        "compress_any_centre",
        with_points(lambda data: squared(zj.lines.compress_any_centre(data, 1))),
        lines,
        line_points,
    ),
    Row(
        "compress_for",
        with_points(
            lambda data: zj.frame_rms(
                zj.fit.compress_for(data, zj.models.Division(), terms=1), coefficients()
            )
        ),
        lines,
        line_points,
        slow=True,
    ),
    Row(
        "with_distortion_model",
        with_points(
            lambda data: zj.frame_rms(
                zj.fit.with_distortion_model(data, zj.models.Division()), coefficients()
            )
        ),
        lines,
        line_points,
    ),
    Row(
        "in_image",
        with_points(lambda data: zj.frame_rms(zj.fit.in_image(data), coefficients())),
        lines,
        line_points,
    ),
    Row("residuals", zj.fit.residuals, lines, coefficients),
    Row("frame_energy", zj.fit.frame_energy, lines, coefficients),
    Row("global_energy", zj.fit.global_energy, lines, coefficients),
    Row("frame_rms", zj.frame_rms, lines, coefficients),
    Row("frame_rms of a lens", lambda own, x: zj.frame_rms(seen(x), own), lens, line_points),
    Row(
        "algebraic_zoom",
        with_points(
            lambda data: zj.fit.algebraic_zoom(data, zoom=zj.PolynomialZoom(1), terms=1).zoom.parameters
        ),
        lines,
        line_points,
    ),
    *map(by_model, MODELS),
    Row(
        "algebraic_zoom (SmoothZoom)",
        with_points(lambda data: zj.fit.algebraic_zoom(data, zoom=zj.SmoothZoom())(33.0).coefficients),
        lines,
        line_points,
    ),
    Row(
        "algebraic_zoom (TwoRegionZoom)",
        with_points(
            lambda data: (
                zj.fit.algebraic_zoom(data, zoom=zj.models.TwoRegionZoom(40.0), terms=1)(33.0).coefficients
            )
        ),
        two_regions,
        line_points,
    ),
    Row(
        "algebraic_frames",
        with_points(lambda data: zj.fit.algebraic_frames(data, terms=1)),
        lines,
        line_points,
    ),
    Row("fit_zoom", with_points(fitted), lines, line_points, slow=True, solves=True),
    Row(
        "fit_frames",
        with_points(lambda data: zj.fit_frames(data, terms=1, throw=False).coefficients),
        lines,
        line_points,
        slow=True,
        solves=True,
    ),
    Row("fit_robust", with_points(robust), lines, line_points, slow=True, solves=True, step=1e-6),
    Row("fit_centre", with_points(centred), lines, line_points, slow=True, solves=True, sharded=False),
    Row("fit_focal", with_focals, lines, line_points, slow=True, constant=True, solves=True, doubles=True),
    Row("with_focal_sigma", wider, fit, lambda: jnp.array([0.3, 0.2, 0.1])),
    Row("std_of", lambda own, x: zj.trust.std_of(own, lambda lens: lens(35.0).undistort(x)), fit, points),
    Row("coefficient_std", lambda own, x: zj.trust.coefficient_std(own, x), fit, lambda: jnp.asarray(EACH)),
    Row(
        "displacement_covariance",
        lambda own, x: zj.trust.displacement_covariance(own, x, focal=35.0),
        fit,
        points,
    ),
    Row("displacement_std", lambda own, x: zj.displacement_std(own, x, focal=35.0), fit, points),
    Row("displacement_band", lambda own, x: zj.displacement_band(own, x, focal=35.0), fit, points),
    Row(
        "cramer_rao",
        lambda own, x: zj.trust.cramer_rao(own, seen(x), std=0.1),
        lambda: lens(1).extended(15.0, 100.0),  # differences move its focal lengths, too
        line_points,
        slow=True,
    ),
    Row(
        "displacement_bound",
        lambda own, x: zj.trust.displacement_bound(own, seen(x), std=0.1),
        lambda: lens(1).extended(15.0, 100.0),
        line_points,
        slow=True,
    ),
    Row(
        "focal_from_board",
        lambda known, x: focal_numbers(
            zj.focal.focal_from_board(x, known, distance=1500.0, pixel_pitch=0.005)
        ),
        board,
        oblique,
    ),
    Row(
        "focal_from_planes",
        lambda known, x: focal_numbers(
            zj.focal.focal_from_planes(x, known, principal=np.array([320.0, 240.0]))[0]
        ),
        board,
        lambda: oblique()[None],
        slow=True,
        step=1e-6,
    ),
    Row(
        "focal_from_lines",
        lambda known, x: focal_numbers(zj.focal.focal_from_lines(x, known, principal=PRINCIPAL)),
        edges,
        on_edges,
        slow=True,
        step=1e-6,
    ),
]


BY_VALUES = "decides by values; refuses those that are traced"
OUTSIDE_OF_JIT = "differentiable, outside of jit and vmap alone"
FILES = "reads or writes files, images or videos"
LEFT_OUT = {
    **dict.fromkeys(
        (
            *("frame_output", "select_model", "cross_validate_zoom", "cross_validate_frames"),
            *("suggest_next", "reject_points", "barrel_crossover", "assess", "evidence", "with_misfit"),
            *("many", "select_many", "vanishing_points"),
        ),
        BY_VALUES,
    ),
    "fit_motion": OUTSIDE_OF_JIT,
    **dict.fromkeys(("shot_turns", "join_shots", "linked_well"), BY_VALUES),
    "fit_boards": BY_VALUES,
    **dict.fromkeys(
        (
            *("load_lens", "load_lines", "read_focal_csv", "read_focal_track", "read_lines_csv"),
            *(
                "load_tracks",
                "read_tracks_csv",
                "write_tracks_csv",
                "track_video",
                "track_frames",
                "find_again",
            ),
            *("write_lines_csv", "undistort_image", "undistort_photo", "undistort_video"),
            *("redistort_image", "redistort_photo", "redistort_video", "read", "write", "formats"),
            *("find_lenses", "lens_names", "library_lens", "match_lens", "stream", "local_copies"),
        ),
        FILES,
    ),
    "shard": "puts arrays on devices; what is computed from them is in the tests of sharding",
    "cache_compiled": "a setting",
    "fit_frame_centres": "fit_centre, frame by frame",
    "focal_from_pitch": "focal_from_lines, for names of lines",
    "name_pitch_lines": "a search, in NumPy",
    "register_model": "of classes",
    "trainable": "of arrays, whatever their values",
}
"""Public functions that are not in the table, and why."""


class Cell(NamedTuple):
    """What a way of embedding gives and what it should."""

    got: Any
    expected: Any


def at(row, dtype):
    """The row's subject and array in a dtype."""
    return cast((row.subject(), row.x()), dtype)


def cast(tree, dtype):
    def of(leaf):
        return jnp.asarray(leaf, dtype) if eqx.is_inexact_array_like(leaf) else leaf

    return jax.tree.map(of, tree)


def copies(x, number):
    """An array and others a little larger, along a new axis."""
    return jnp.stack([x * (1 + 1e-3 * index) for index in range(number)])


def stacked(tree, number):
    return jax.tree.map(lambda leaf: jnp.stack([jnp.asarray(leaf)] * number), tree)


def eager(row, subject, xs):
    """One after the other, without any embedding."""
    results = [row.function(subject, x) for x in xs]
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *results)


def number(row):
    """One number of all that a row's function gives, as a function of (subject, x)."""

    def function(pair):
        leaves = [leaf for leaf in jax.tree.leaves(row.function(*pair)) if eqx.is_inexact_array(leaf)]
        return sum(jnp.sum(jnp.cos(jnp.arange(leaf.size)).reshape(leaf.shape) * leaf) for leaf in leaves)

    return function


def by_shard_map(row, dtype):
    """Each of several devices has one x, and all have the subject: inside of ``jit``, and outside."""
    subject, x = at(row, dtype)
    xs = copies(x, DEVICES)
    mesh = Mesh(np.array(jax.devices()[:DEVICES]), ("device",))

    def local(xs):
        return jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], row.function(subject, xs[0]))

    sharded = jax.shard_map(
        local,
        mesh=mesh,
        in_specs=PartitionSpec("device"),
        out_specs=PartitionSpec("device"),
        check_vma=not row.solves,
    )
    expected = eager(row, subject, xs)
    return Cell(jax.jit(sharded)(xs), expected), Cell(sharded(xs), expected)


def tolerance(dtype):
    return {"float32": 5e-3, "float64": 1e-7}[dtype]


def far(cell, most):
    """Where a cell is not what it should be: the largest error, a share of the largest number; or None.

    The largest of each array, but at least so much that ten roundings of the largest of all are allowed.
    """
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(cell.expected)]
    largest = max((np.max(np.abs(leaf[np.isfinite(leaf)]), initial=0) for leaf in leaves), default=0)
    least = max(
        (
            max(1e4, 10 / most) * np.finfo(leaf.dtype).eps * largest
            for leaf in leaves
            if leaf.dtype.kind == "f"
        ),
        default=0,
    )
    for got, expected in zip(*map(jax.tree.leaves, cell), strict=True):
        got, expected = np.asarray(got), np.asarray(expected)
        if got.shape != expected.shape or got.dtype != expected.dtype:
            return f"{got.shape} {got.dtype}, not {expected.shape} {expected.dtype}"
        if not np.array_equal(np.isfinite(got), np.isfinite(expected)):
            return f"{got}, not {expected}"
        got, expected = (np.where(np.isfinite(expected), a, 0).astype(float) for a in (got, expected))
        error = np.max(np.abs(got - expected), initial=0) / max(
            np.max(np.abs(expected), initial=0), least, 1e-12
        )
        if error > most:
            return f"{error:.1e} of the largest number off: {got}, not {expected}"
    return None


def rows_over_devices(dtype, slow):
    return [row for row in ROWS if row.slow == slow and row.sharded and dtype in DTYPES[row.doubles :]]


DTYPES = ("float32", "float64")
WAYS = ("jit", "jit, closed over", "vmap", "grad", "jit(grad)", "scan", "checkpoint", "shard_map")
DERIVATIVES = ("grad", "jit(grad)", "checkpoint")


def table():
    """The table in Markdown."""
    head = ["function", "plain", *WAYS]
    rows = [["---"] * len(head)]
    for row in ROWS:
        marks = ["–" if row.constant and way in DERIVATIVES else "✓" for way in WAYS]
        if row.solves:
            marks[WAYS.index("shard_map")] = "✓ [^vma]" if row.sharded else "– [^centre]"
        name = f"`{row.name}`" + " [^doubles]" * row.doubles
        rows.append([name, "✓", *marks])
    return "\n".join("| " + " | ".join(cells) + " |" for cells in [head, *rows])


BEGIN, END = "<!-- made by tests/_embeddings.py: begin -->\n", "\n<!-- end -->"


def main():
    if len(sys.argv) == 1:
        text = PAGE.read_text()
        before, rest = text.split(BEGIN)
        PAGE.write_text(before + BEGIN + table() + END + rest.split(END, 1)[1])
        return
    dtype, slow = sys.argv[1], "slow" in sys.argv[2:]
    jax.config.update("jax_enable_x64", True)
    for row in rows_over_devices(dtype, slow):
        try:
            found = [far(cell, tolerance(dtype)) for cell in by_shard_map(row, dtype)]
            wrong = next((text for text in found if text is not None), None)
        except Exception as error:
            wrong = f"{type(error).__name__}: {error}"
        print(row.name, "ok" if wrong is None else wrong.replace("\n", " "), sep="\t", flush=True)


if __name__ == "__main__":
    main()
