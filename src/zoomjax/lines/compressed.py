"""Exact compression: each line of thousands of points becomes one small triangle.

For a fixed centre the corrected points of a line are linear in ``kappa = (1, k1, ..., kN)``. With the
columns ``A = [1, z, r^2 z, ..., r^(2N) z]``, a row a point, its residuals are ``A`` times a vector made
of kappa and the line's normal and offset. So for ``A = Q R`` the D = 2N + 3 rows of R have the same sum
of squares, and the same Gauss-Newton matrix, for *every* kappa and every line: 49 numbers instead of
8,000 (N = 2). The first row carries the count and the mean, the rest the points about their mean.

Once per data set: the reduction, one pass over the points. Per iteration of a fit afterwards: D - 1
rows a line, whatever the number of points. Triangles of the same line `merge`, so that data larger than
memory can be compressed in chunks of points.

R is found by modified Gram-Schmidt, not by way of the Gram matrix ``R^T R``, although sums of monomials
would give that in one read of the points. Squaring the condition number would lose small residuals, in
float32 those of most lines, and would save no time (benchmarks/results/gram.md): on a CPU Gram-Schmidt
works on a run of a thousand points at a time, whose columns stay in the fastest cache, and on a GPU on
some hundred, in registers (`kernel`). Its floor is near
the dtype's own: 2e-14 of half the image diagonal in float64, 2e-6 in float32
(benchmarks/reliability_core.py searches for lines that break it).

Lines sharded over devices are reduced where they are: no point is exchanged.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec
from jaxtyping import Array, Float

from .._core.arguments import kinds_checked
from .._core.checks import MOST_TERMS, checked_integer
from .._core.products import EXACT
from .._core.programs import program
from .._core.types import Centres, traced
from .base import check_rows, header_of
from .buckets import bucketed
from .lines import Lines
from .reduction import triangle
from .triangles import AbstractTriangles

_AT_ONCE = 2**22
"""Points of lines that a GPU reduces side by side: their columns, some hundred MB, are in its memory."""

_COMPILED: set[tuple] = set()  # shapes that have been reduced in this process


class CompressedLines(AbstractTriangles):
    """Lines reduced to triangles, for a fixed centre of distortion and up to `terms` coefficients.

    Attributes:
        triangle: R of each line, in normalised lengths.
        frame, focal, centre, image_size, focal_unit, number, weight, focus: as in `Lines`.
    """

    def __check_init__(self):
        """Check that the triangles have the rows of some number of terms."""
        rows = self.triangle.shape[-1] if hasattr(self.triangle, "shape") else 5
        if rows < 5 or rows % 2 == 0:
            raise ValueError(
                "Argument triangle must have 2 N + 3 rows for N terms, N >= 1, but its shape is "
                f"{self.triangle.shape}."
            )

    @property
    def terms(self) -> int:
        """The largest number of coefficients N for which these triangles are valid."""
        return (self.triangle.shape[-1] - 3) // 2

    def check_terms(self, terms: int) -> None:
        """Raise ValueError if the lines were compressed for fewer coefficients."""
        if terms > self.terms:
            raise ValueError(
                f"These lines were compressed for {self.terms} terms, but {terms} are requested: "
                f"compress(lines, terms={terms})."
            )

    def corrected(self, coefficients: Float[Array, "frame terms"]) -> Float[Array, "line rows 2"]:
        """Rows, px, with the scatter of the corrected points about their mean.

        Raises:
            ValueError: there are more coefficients than the lines were compressed for.
        """
        check_rows(coefficients, self.focal)
        self.check_terms(coefficients.shape[1])
        return self.scale * jax.vmap(_combine)(self.triangle, coefficients[self.frame])

    def second_moments(self, order: int) -> Float[Array, "line moment 2 2"]:
        """``sum_p r_p^(2i) z_p z_p^T`` for i = 0 ... order - 1, with an order of at most 2 N + 1."""
        return moments_of(self.triangle, order)

    def about(self, centre: Centres) -> "CompressedLines":
        """These lines, if `centre` is their centre, px.

        Raises:
            ValueError: it is another centre, for which these triangles are not valid.
        """
        if not traced((self.centre, centre)) and not np.allclose(self.centre, centre, rtol=0, atol=1e-3):
            raise ValueError(
                "The compressed lines have another centre of distortion than the one requested. Compress "
                "the lines about that centre, or by compress_any_centre, or pass the lines themselves."
            )
        return self


def moments_of(rows: Float[Array, "line row column"], order: int) -> Float[Array, "line moment 2 2"]:
    """`second_moments`, of rows that stand for the columns A of each line."""
    columns = rows[..., 1:].reshape(*rows.shape[:2], -1, 2)
    halves = [(total // 2, total - total // 2) for total in range(order)]
    product = partial(jnp.einsum, "lrc,lrd->lcd", precision=EXACT)
    return jnp.stack([product(columns[:, :, i], columns[:, :, j]) for i, j in halves], axis=1)


def _combine(triangle, k):
    """The corrected points' rows from one line's triangle: linear in (1, k1, ..., kN)."""
    kappa = jnp.concatenate([jnp.ones(1, k.dtype), k])
    columns = triangle[1:, 1 : 1 + 2 * kappa.shape[0]].reshape(-1, kappa.shape[0], 2)
    return jnp.einsum("rjc,j->rc", columns, kappa, precision=EXACT)


@kinds_checked
def compress(lines: Lines, terms: int = 2) -> CompressedLines:
    """Compress each line exactly to a triangle; fits then take milliseconds and give the same result.

    Args:
        lines: the lines; their `centre` is the centre the result is for.
        terms: the largest number N of coefficients to be fitted. Fewer can be fitted, too.

    Returns:
        The compressed lines, differentiable with respect to points and centre: once, and more often unless
        a line is exactly straight. If `lines.points` is sharded over its line axis
        (`jax.sharding.NamedSharding`), so is the result, and no points are exchanged. (Inside ``jit`` the
        sharding is not known, and points are gathered: compress outside of it.)

    Example:
        >>> import numpy as np
        >>> row = np.stack([np.arange(500.0), np.full(500, 20.0)], axis=-1)
        >>> lines = Lines.from_ragged([row, row + 1], [0, 1], [24, 70], image_size=(640, 480))
        >>> compress(lines).triangle.shape
        (2, 7, 7)
    """
    return CompressedLines(
        triangle=triangles_of(lines, _columns, checked_integer("terms", terms, 1, MOST_TERMS)),
        **header_of(lines),
    )


@kinds_checked
def merge(first: CompressedLines, second: CompressedLines) -> CompressedLines:
    """Merge two chunks of points of the same lines, for data larger than memory.

    Make the chunks by ``Lines.from_ragged(..., chunk=True)``, which keeps lines with few or no points in a
    chunk, so that every chunk holds all lines in the same order. Use `concatenate` to add lines of other
    frames.

    Raises:
        ValueError: the two differ in their lines, terms, centre or image size.
    """
    if first.triangle.shape != second.triangle.shape:
        raise ValueError(
            "Only triangles of the same lines and terms merge, but their shapes are "
            f"{first.triangle.shape} and {second.triangle.shape}. Make chunks of points by "
            "Lines.from_ragged(..., chunk=True), which drops no line."
        )
    rest, other = (eqx.tree_at(lambda lines: lines.triangle, lines, None) for lines in (first, second))
    if not traced((rest, other)) and not _equal(rest, other):
        raise ValueError(
            "Only chunks of the same lines merge, but their lines, frames, focal lengths, centres, image "
            "sizes or units differ. Make chunks of points by Lines.from_ragged(..., chunk=True), which "
            "drops no line."
        )
    return eqx.tree_at(lambda lines: lines.triangle, first, _merge_all(first.triangle, second.triangle))


def _equal(first, second):
    """Whether two trees of known values are the same; by NumPy, so that it can be asked inside ``jit``."""
    leaves, other_leaves = jax.tree.leaves(first), jax.tree.leaves(second)
    same_kind = jax.tree.structure(first) == jax.tree.structure(second)
    return same_kind and all(map(np.array_equal, leaves, other_leaves))


@jax.jit
@jax.vmap
def _merge_all(first, second):
    return triangle(jnp.concatenate([first, second]).T)


def triangles_of(lines: Lines, columns: Callable[..., Array], terms: int) -> Float[Array, "line rows rows"]:
    """R of each line, for ``columns(z, valid, terms)``: what is made of its points, a row a column of A."""
    sharding = None if traced(lines) else _sharding_of_lines(lines)
    if sharding is not None:
        return _reduce_sharded(lines, sharding, columns, terms)
    if jax.default_backend() != "cpu":
        return _reduce_whole(lines, columns, terms)
    if traced(lines):
        return _reduce_run(lines, np.asarray(0), lines.points.shape[0], columns, terms)
    return jax.device_put(_reduce_in_threads(bucketed(lines), columns, terms)[: lines.points.shape[0]])


def _sharding_of_lines(lines):
    """How the points are spread over devices, line by line; None if they are not."""
    sharding = getattr(lines.points, "sharding", None)
    if not isinstance(sharding, NamedSharding) or not sharding.spec or sharding.spec[0] is None:
        return None
    return NamedSharding(sharding.mesh, PartitionSpec(sharding.spec[0]))


def _reduce_sharded(lines, sharding, columns, terms):
    """All triangles, each made and kept where the points of its line are: nothing is exchanged."""
    everywhere = NamedSharding(sharding.mesh, PartitionSpec())
    points, mask = (jax.device_put(array, sharding) for array in (lines.points, lines.mask))
    centre = jax.device_put(jnp.asarray(lines.centre), everywhere)
    return _reduce_shards(points, mask, centre, lines.scale, columns, terms, sharding)


@eqx.filter_jit
def _reduce_shards(points, mask, centre, scale, columns, terms, sharding):
    def own(points, mask, centre):
        return _reduce_lines(points, mask, centre, scale, columns, terms)

    over, whole = sharding.spec, PartitionSpec()
    # Of a kernel JAX does not know that its result varies as the points do, unless it need not check that.
    spread = jax.shard_map(
        own, mesh=sharding.mesh, in_specs=(over, over, whole), out_specs=over, check_vma=False
    )
    return spread(points, mask, centre)


@program
def _reduce_whole(lines, columns, terms):
    points, mask, centre = map(jnp.asarray, (lines.points, lines.mask, lines.centre))
    return _reduce_lines(points, mask, centre, lines.scale, columns, terms)


def _reduce_lines(points, mask, centre, scale, columns, terms):
    """Triangles of all lines, on the device where they are."""

    def reduce_one(line):
        points, mask = line
        return _reduce_line(points, mask, centre, scale, columns, terms)

    def by_xla(points, mask, centre):
        return jax.lax.map(reduce_one, (points, mask), batch_size=_lines_at_once(points.shape[1]))

    if jax.default_backend() == "gpu" and columns is _columns:
        from . import kernel

        if kernel.has_kernel(terms):
            by_kernel = partial(kernel.triangles, scale=scale, terms=terms)
            return jax.lax.platform_dependent(points, mask, centre, cuda=by_kernel, default=by_xla)
    return by_xla(points, mask, centre)


def _reduce_in_threads(lines, columns, terms):
    """All triangles, each core reducing a run of lines: XLA runs a loop on one.

    The last run is moved back to end with the lines, so that all have one shape and one compilation, and
    the first of a new shape goes alone, or every thread would compile.
    """
    number = lines.points.shape[0]
    widest = jnp.result_type(float)
    with ThreadPoolExecutor() as pool:
        # JAX's context managers, such as that for float64, hold in their own thread alone. So does `jit`:
        # lines that are known are reduced at once, inside of it, too.
        if not pool.submit(lambda: jnp.result_type(float) == widest).result():
            return _reduce_run(lines, np.asarray(0), number, columns, terms)
        parts = min(os.cpu_count() or 1, number)
        size = -(-number // parts)
        starts = [min(part * size, number - size) for part in range(parts)]

        def reduce_from(start):
            # An array, for a Python number would be a constant of the program: one compilation each.
            return jax.block_until_ready(_reduce_run(lines, np.asarray(start), size, columns, terms))

        signature = (lines.points.shape, str(lines.points.dtype), size, columns, terms, str(widest))
        alone = 0 if signature in _COMPILED else 1
        triangles = [pool.submit(reduce_from, start).result() for start in starts[:alone]]
        triangles += pool.map(reduce_from, starts[alone:])
        _COMPILED.add(signature)
    overlaps = [part * size - start for part, start in enumerate(starts)]
    runs = [np.asarray(run)[overlap:] for run, overlap in zip(triangles, overlaps, strict=True)]
    return np.concatenate(runs)


@program
def _reduce_run(lines, start, size, columns, terms):
    """Triangles of `size` consecutive lines, one after the other so that each stays in the cache."""

    def reduce_one(index):
        points, mask = (
            jax.lax.dynamic_index_in_dim(a, index, keepdims=False)
            for a in (jnp.asarray(lines.points), lines.mask)
        )
        return _reduce_line(points, mask, lines.centre, lines.scale, columns, terms)

    return jax.lax.map(reduce_one, start + jnp.arange(size))


def _lines_at_once(points):
    """How many lines are reduced side by side: one where they are to stay in the cache."""
    return None if jax.default_backend() == "cpu" else max(1, _AT_ONCE // points)


def _reduce_line(points, mask, centre, scale, columns, terms):
    offset = jnp.where(mask[:, None], points - centre[None], 0)
    if jax.default_backend() == "cpu":  # x and y apart by a product with the identity, exact: faster there
        z = jnp.einsum("pc,cd->dp", offset, jnp.eye(2, dtype=offset.dtype), precision=EXACT)
    else:
        z = offset.T
    return triangle(columns(z / scale, mask.astype(z.dtype), terms))


def _columns(z, valid, terms):
    """The rows [1, z, r^2 z, ..., r^(2N) z] of one line, a column a point; zero where it has none."""
    squared = jnp.sum(z * z, axis=0, keepdims=True)
    columns = [valid[None], z]
    for _ in range(terms):
        columns.append(columns[-1] * squared)
    return jnp.concatenate(columns)
