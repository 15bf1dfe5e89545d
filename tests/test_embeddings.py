"""Every differentiable function inside every transformation of JAX; the table is in `_embeddings`."""

import functools
import inspect
import os
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj

from . import _embeddings as table
from ._embeddings import DTYPES, ROWS, Cell, at, copies, eager, far, number, stacked, tolerance
from ._public import FUNCTIONS


def jitted(row, dtype):
    subject, x = at(row, dtype)
    return Cell(jax.jit(row.function)(subject, x), row.function(subject, x))


def closed_over(row, dtype):
    subject, x = at(row, dtype)
    jax.eval_shape(lambda: row.function(subject, x))  # nothing is an argument
    return Cell(jax.jit(lambda x: row.function(subject, x))(x), row.function(subject, x))


def mapped(row, dtype):
    subject, x = at(row, dtype)
    xs = copies(x, 2)
    return Cell(jax.vmap(row.function)(stacked(subject, 2), xs), eager(row, subject, xs))


def scanned(row, dtype):
    subject, x = at(row, dtype)
    xs = copies(x, 2)
    _, results = jax.lax.scan(lambda carry, x: (carry, row.function(subject, x)), 0, xs)
    return Cell(results, eager(row, subject, xs))


@functools.lru_cache(maxsize=2)
def gradient(row, dtype):
    return eqx.filter_grad(number(row))(at(row, dtype))


def differentiated(row, dtype):
    """Against finite differences in one direction of all arrays; float32 against float64."""
    if dtype == "float32":
        return Cell(gradient(row, dtype), table.cast(gradient(row, "float64"), dtype))
    pair = at(row, dtype)
    rng = np.random.default_rng(0)
    arrays, rest = eqx.partition(pair, eqx.is_inexact_array)
    direction = jax.tree.map(lambda leaf: leaf * rng.uniform(-1, 1, leaf.shape), arrays)

    def value(step):
        moved = jax.tree.map(lambda leaf, by: leaf + step * by, arrays, direction)
        return number(row)(eqx.combine(moved, rest))

    def slope(step):
        return (value(step) - value(-step)) / (2 * step)

    expected = (4 * slope(row.step / 2) - slope(row.step)) / 3
    products = jax.tree.map(lambda g, by: jnp.sum(g * by), gradient(row, dtype), direction)
    return Cell(jnp.asarray(sum(jax.tree.leaves(products))), expected)


def jitted_gradient(row, dtype):
    function = jax.jit(lambda pair: eqx.filter_grad(number(row))(pair))
    return Cell(function(at(row, dtype)), gradient(row, dtype))


def checkpointed(row, dtype):
    subject, x = at(row, dtype)
    function = jax.checkpoint(lambda x: number(row)((subject, x)))
    return Cell(jax.jit(jax.grad(function))(x), gradient(row, dtype)[1])


HERE = dict(
    zip(
        (way for way in table.WAYS if way != "shard_map"),
        (jitted, closed_over, mapped, differentiated, jitted_gradient, scanned, checkpointed),
        strict=True,
    )
)
LOOSE = {"grad": {"float32": 5e-2, "float64": 1e-4}}
FEW = {("float32", False): ("jit, closed over", "grad"), ("float64", True): ("grad",)}
"""Ways tested always, of float32, and of rows that compile for long; all with ``-m exhaustive``."""


def cells():
    for row in ROWS:
        for way in HERE:
            for dtype in DTYPES[row.doubles :]:
                if row.constant and way in table.DERIVATIVES:
                    continue
                always = dtype == "float64" and not row.slow
                few = way in FEW.get((dtype, row.slow), ())
                marks = () if always else pytest.mark.slow if few else pytest.mark.exhaustive
                yield pytest.param(row, way, dtype, id=f"{row.name}-{way}-{dtype}", marks=marks)


@pytest.mark.filterwarnings("ignore:.*beyond it the distortion is extrapolated:UserWarning")
@pytest.mark.parametrize(("row", "way", "dtype"), list(cells()))
def test_cell(row, way, dtype):
    most = LOOSE.get(way, {}).get(dtype, tolerance(dtype))
    wrong = far(HERE[way](row, dtype), most)
    assert wrong is None, wrong


@pytest.mark.slow
@pytest.mark.parametrize("slow", [False, pytest.param(True, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize("dtype", [pytest.param("float32", marks=pytest.mark.exhaustive), "float64"])
def test_over_four_devices(dtype, slow):
    four = f"--xla_force_host_platform_device_count={table.DEVICES}"
    result = subprocess.run(
        [sys.executable, table.__file__, dtype, *(["slow"] if slow else [])],
        env={**os.environ, "XLA_FLAGS": f"{os.environ['XLA_FLAGS']} {four}"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    results = dict(line.split("\t", 1) for line in result.stdout.splitlines())
    assert set(results) == {row.name for row in table.rows_over_devices(dtype, slow)}
    assert {name: wrong for name, wrong in results.items() if wrong != "ok"} == {}


def test_every_public_function_is_in_the_table_or_left_out_for_a_reason():
    functions = {name for name, thing in FUNCTIONS.items() if inspect.isfunction(thing)}
    told = {row.name.split(",")[0].split(" ")[0].strip("()") for row in ROWS}
    assert not told & set(table.LEFT_OUT)
    assert functions - told - set(table.LEFT_OUT) == set()


KNOWN = {
    "frame_output": lambda x: zj.correct.frame_output(
        table.zoomed(table.lens(), x), table.SIZE, keep="all"
    ),
    "select_model": lambda x: zj.select_model(traced_lines(x)),
    "cross_validate_zoom": lambda x: zj.trust.cross_validate_zoom(traced_lines(x)),
    "cross_validate_frames": lambda x: zj.trust.cross_validate_frames(traced_lines(x)),
    "with_misfit": lambda x: zj.trust.with_misfit(table.fit(), traced_lines(x)),
    "reject_points": lambda x: zj.fit.reject_points(traced_lines(x)),
    "suggest_next": lambda x: zj.suggest_next(table.fit(), traced_lines(x)),
    "fit_motion": lambda x: zj.fit.fit_motion(traced_tracks(x)),
    "fit_boards": lambda x: zj.fit.fit_boards(x[None], [1.0], image_size=table.SIZE),
    "barrel_crossover": lambda x: zj.models.barrel_crossover(np.array([20.0, 30.0]), x[:2, 0]),
}


def traced_lines(x):
    lines = table.lines()
    return eqx.tree_at(lambda lines: lines.points, lines, lines.points * x[0, 0])


def traced_tracks(x):
    points = np.array([[1.0, 2.0], [3.0, 2.0]])
    tracks = zj.tracks.Tracks.from_arrays([0, 0], [0, 1], points, image_size=(8, 6))
    return eqx.tree_at(lambda tracks: tracks.points, tracks, tracks.points * x[0, 0])


@pytest.mark.parametrize("name", KNOWN)
def test_what_decides_by_values_says_so(name):
    table.fit()  # made of known values, before anything is traced
    with pytest.raises(ValueError, match=f"Arguments of {name} must have known values"):
        jax.jit(KNOWN[name])(table.lens().zoom.parameters)


@pytest.mark.parametrize("keep", ["all", "valid"])
def test_framing_of_what_is_known_inside_of_jit(keep):
    lens = table.lens()

    def corrected(image):
        framing = zj.correct.frame_output(lens(35.0), table.SIZE, keep=keep)
        return zj.warp_image(image, lens(35.0), framing=framing)

    image = jnp.ones(table.SIZE[::-1])
    np.testing.assert_allclose(jax.jit(corrected)(image), corrected(image), atol=1e-12)


def test_the_page_has_this_table():
    text = table.PAGE.read_text()
    shown = text.split(table.BEGIN)[1].split(table.END)[0]
    assert shown == table.table(), "run: python tests/_embeddings.py"
