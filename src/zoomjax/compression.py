"""Exact compression: each line of thousands of points becomes one small triangle.

For a fixed centre the corrected points of a line are linear in ``kappa = (1, k1, ..., kN)``. With the
columns ``A = [1, z, r^2 z, ..., r^(2N) z]``, a row a point, its residuals are ``A`` times a vector made
of kappa and the line's normal and offset. So for ``A = Q R`` the D = 2N + 3 rows of R have the same sum
of squares, and the same Gauss-Newton matrix, for *every* kappa and every line: 49 numbers instead of
8,000 (N = 2). The first row carries the count and the mean, the rest the points about their mean.

Once per data set: the reduction, one pass over the points. Per iteration of a fit afterwards: D - 1
rows a line, whatever the number of points. Triangles of the same line `merge`, so that data larger than
memory can be compressed in chunks of points.

Two ways to R, with the same result up to rounding (`reduction` of `compress`):

* `moments`: 7N + 8 sums of monomials give ``R^T R``, factored afterwards. One read of the points. It
  squares the condition number: residuals below about 1e-4 px (float64) are lost. In float32 that floor
  is about 0.6 px, worthless.
* `orthogonal`: modified Gram-Schmidt on the columns, backward stable: the floor is the dtype's own,
  1e-12 px, or 1e-3 px in float32. Three to four times slower in float64.

By default float64 takes the first and float32 the second.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ._types import Focal, FrameIndex, Point
from .lines import AbstractLines, Lines

Reduction = Callable[[Float[Array, "2 point"], Float[Array, "point"], int], Float[Array, "rows rows"]]
"""From the normalised x and y of one line, 1 or 0 for points and padding, and the terms, to R."""


class CompressedLines(AbstractLines):
    """Lines reduced to triangles, for a fixed centre of distortion and up to `terms` coefficients.

    Attributes:
        triangle: R of each line, in normalised lengths.
        frame, focal, centre, image_size, focal_unit: as in `Lines`.
    """

    triangle: Float[Array, "line rows rows"]
    frame: FrameIndex
    focal: Focal
    centre: Point
    image_size: tuple[int, int] = eqx.field(static=True)
    focal_unit: str = eqx.field(static=True)

    @property
    def terms(self) -> int:
        """The largest number of coefficients N that these triangles serve."""
        return (self.triangle.shape[-1] - 3) // 2

    @property
    def counts(self) -> Float[Array, "line"]:
        """Number of points of each line."""
        return jnp.round(self.triangle[:, 0, 0] ** 2)

    def corrected(self, coefficients: Float[Array, "line terms"]) -> Float[Array, "line rows 2"]:
        """Rows, px, with the scatter of the corrected points about their mean.

        Raises:
            ValueError: there are more coefficients than the lines were compressed for.
        """
        terms = coefficients.shape[1]
        if terms > self.terms:
            raise ValueError(
                f"These lines were compressed for {self.terms} terms, but {terms} are asked for: "
                f"compress(lines, terms={terms})."
            )
        return self.scale * jax.vmap(_combine)(self.triangle, coefficients)

    def radial_moments(self, order: int) -> Float[Array, "line moment"]:
        """``sum_p r_p^(2i)`` for i = 0 ... order, at most 2 N + 1."""
        columns = self.triangle[..., 1:].reshape(*self.triangle.shape[:2], -1, 2)
        moments = [self.counts]
        for total in range(order):
            j = total // 2
            moments.append(jnp.sum(columns[:, :, j] * columns[:, :, total - j], axis=(1, 2)))
        return jnp.stack(moments, axis=1)

    def take(self, lines: Int[Array, "some"], present: Bool[Array, "some"]) -> "CompressedLines":
        """The chosen lines as a data set of one frame."""
        return CompressedLines(
            triangle=jnp.where(present[:, None, None], self.triangle[lines], 0),
            frame=jnp.zeros_like(lines, jnp.int32),
            focal=jnp.asarray(self.focal)[self.frame[lines[jnp.argmax(present)]]][None],
            centre=self.centre,
            image_size=self.image_size,
            focal_unit=self.focal_unit,
        )


def _combine(triangle, k):
    """The corrected points' rows from one line's triangle: linear in (1, k1, ..., kN)."""
    kappa = jnp.concatenate([jnp.ones(1, k.dtype), k])
    columns = triangle[1:, 1 : 1 + 2 * kappa.shape[0]].reshape(-1, kappa.shape[0], 2)
    return jnp.einsum("rjc,j->rc", columns, kappa, precision=_EXACT)


def compress(lines: Lines, terms: int = 2, *, reduction: Reduction | None = None) -> CompressedLines:
    """Reduce each line to its triangle; fits then take milliseconds and give the same answer.

    Args:
        lines: the lines; their `centre` is the centre the result is for.
        terms: the largest number N of coefficients that will be fitted. Fewer can be.
        reduction: `moments` or `orthogonal`; by default the first in float64, the second in float32.

    Returns:
        The compressed lines, differentiable with respect to points and centre.

    Example:
        >>> import numpy as np
        >>> row = np.stack([np.arange(500.0), np.full(500, 20.0)], axis=-1)
        >>> lines = Lines.from_ragged([row, row + 1], [0, 1], [24, 70], image_size=(640, 480))
        >>> compress(lines).triangle.shape
        (2, 7, 7)
    """
    if terms < 1:
        raise ValueError(f"Argument terms must be at least 1, but it is {terms}.")
    if reduction is None:
        double = jax.dtypes.canonicalize_dtype(lines.points.dtype) == jnp.float64
        reduction = moments if double else orthogonal
    number = lines.points.shape[0]
    # XLA runs a loop on one core. Outside of a trace, hand each core a run of lines; the last run is
    # moved back to end with the lines, so that all have one shape and one compilation.
    traced = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(lines))
    parts = 1 if traced or jax.default_backend() != "cpu" else min(os.cpu_count() or 1, number)
    size = -(-number // parts)
    starts = [min(part * size, number - size) for part in range(parts)]
    if parts == 1:
        triangles = [_reduce_run(lines, 0, size, terms, reduction)]
    else:
        with ThreadPoolExecutor(parts) as pool:
            run = lambda start: jax.block_until_ready(  # noqa: E731
                _reduce_run(lines, start, size, terms, reduction)
            )
            triangles = list(pool.map(run, starts))
        overlaps = [part * size - start for part, start in enumerate(starts)]
        triangles = [r[overlap:] for r, overlap in zip(triangles, overlaps, strict=True)]
    return CompressedLines(
        triangle=jnp.concatenate(triangles) if parts > 1 else triangles[0],
        frame=lines.frame,
        focal=lines.focal,
        centre=lines.centre,
        image_size=lines.image_size,
        focal_unit=lines.focal_unit,
    )


def merge(first: CompressedLines, second: CompressedLines) -> CompressedLines:
    """The same lines with the points of both: for chunks of points that do not fit in memory together.

    Raises:
        ValueError: the two do not hold the same number of lines and terms.
    """
    if first.triangle.shape != second.triangle.shape:
        raise ValueError(
            "Only triangles of the same lines and terms merge, but their shapes are "
            f"{first.triangle.shape} and {second.triangle.shape}."
        )
    return eqx.tree_at(lambda lines: lines.triangle, first, _merge_all(first.triangle, second.triangle))


@jax.jit
@jax.vmap
def _merge_all(first, second):
    return _factor(jnp.concatenate([first, second]).T)


@partial(eqx.filter_jit, donate="none")
def _reduce_run(lines, start, size, terms, reduction):
    """Triangles of `size` consecutive lines, one after the other so that each stays in the cache."""

    def reduce_one(index):
        points, mask = (
            jax.lax.dynamic_index_in_dim(a, index, keepdims=False)
            for a in (jnp.asarray(lines.points), lines.mask)
        )
        # x and y apart by a product with the identity, exact: 2 times faster than slicing on the CPU.
        offset = jnp.where(mask[:, None], points - lines.centre[None], 0)
        z = jnp.einsum("pc,cd->dp", offset, jnp.eye(2, dtype=offset.dtype), precision=_EXACT)
        return _triangle(reduction, terms, z / lines.scale, mask.astype(z.dtype))

    batch = None if jax.default_backend() == "cpu" else 256
    return jax.lax.map(reduce_one, start + jnp.arange(size), batch_size=batch)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _triangle(reduction, terms, z, valid):
    return reduction(z, valid, terms)


@_triangle.defjvp
def _triangle_jvp(reduction, terms, primals, tangents):
    triangle = reduction(*primals, terms)
    columns, columns_dot = jax.jvp(partial(_columns, terms=terms), primals, tangents)
    return triangle, _triangle_tangent(triangle, columns, columns_dot)


@jax.custom_jvp
def _factor(columns):
    return _orthogonalise(columns)


@_factor.defjvp
def _factor_jvp(primals, tangents):
    triangle = _orthogonalise(*primals)
    return triangle, _triangle_tangent(triangle, *primals, *tangents)


def _triangle_tangent(triangle, columns, columns_dot):
    """A tangent of R that is right for every function of ``R^T R``, which is all the fits use.

    R itself has no derivative at an exactly straight line, whose columns are dependent; ``R^T R`` has.
    With ``A = Q R``, ``dR = Q^T dA`` (Q held fixed) gives ``R^T dR + dR^T R = A^T dA + dA^T A`` exactly.
    """
    kept = jnp.diagonal(triangle) > 0
    regular = triangle + jnp.diag(jnp.where(kept, 0, 1).astype(triangle.dtype))
    q = jax.scipy.linalg.solve_triangular(regular, columns, trans="T")
    return jnp.matmul(jnp.where(kept[:, None], q, 0), columns_dot.T, precision=_EXACT)


def orthogonal(
    z: Float[Array, "2 point"], valid: Float[Array, "point"], terms: int
) -> Float[Array, "rows rows"]:
    """The triangle of one line by orthogonalising its columns: no loss of accuracy, any dtype."""
    return _orthogonalise(_columns(z, valid, terms))


def moments(
    z: Float[Array, "2 point"], valid: Float[Array, "point"], terms: int
) -> Float[Array, "rows rows"]:
    """The triangle of one line by way of its Gram matrix, from sums of monomials: for float64.

    The sums are ``r^(2j)`` times ``x^2, xy, y^2`` (j = 0 ... 2N) and times ``x, y`` (j = 0 ... N), and
    the count. Sums add up over points, which `merge` does on triangles with no loss of accuracy.
    """
    x, y = z
    squared = x * x + y * y
    powers = [jnp.ones_like(x)]
    for _ in range(2 * terms):
        powers.append(powers[-1] * squared)
    sums = _sum_of_products(jnp.stack(powers), jnp.stack([x * x, x * y, y * y, x, y]))

    order = jnp.arange(terms + 1)
    blocks = sums[:, jnp.asarray([[0, 1], [1, 2]])][order[:, None] + order[None]]  # j, k, 2, 2
    square = blocks.transpose(0, 2, 1, 3).reshape(2 * terms + 2, 2 * terms + 2)
    linear = sums[: terms + 1, 3:].reshape(1, -1)
    count = jnp.sum(valid)
    return _cholesky(jnp.block([[count[None, None], linear], [linear.T, square]]))


def _columns(z, valid, terms):
    """The rows [1, z, r^2 z, ..., r^(2N) z] of one line, a column a point; zero where masked."""
    squared = jnp.sum(z * z, axis=0, keepdims=True)
    columns = [valid[None], z]
    for _ in range(terms):
        columns.append(columns[-1] * squared)
    return jnp.concatenate(columns)


def _orthogonalise(columns):
    """R of the transposed argument, by modified Gram-Schmidt.

    Its R is as accurate as Householder's (Björck 1967), which is all that is kept, and it is made of
    products of a few long vectors. Batched `jnp.linalg.qr` took 4 times the time (2,987 lines).
    """
    size = columns.shape[0]
    rows = []
    for done in range(size):
        products = jnp.matmul(columns, columns[0], precision=_EXACT)
        norm = jnp.sqrt(products[0])
        inverse = jnp.where(norm > 0, 1 / jnp.where(norm > 0, norm, 1), 0)
        row = products * inverse
        rows.append(jnp.pad(row, (done, 0)))
        columns = columns[1:] - (row[1:] * inverse)[:, None] * columns[:1]
    return jnp.stack(rows)


def _cholesky(gram):
    """R of a Gram matrix that may be singular, as that of an exactly straight line is.

    A direction whose remaining square is at the level of rounding gets a zero row; plain Cholesky would
    take the root of a negative number, and a tiny positive pivot would blow rounding up.
    """
    floor = 16 * jnp.finfo(gram.dtype).eps * jnp.diagonal(gram)
    rows = []
    for i in range(gram.shape[0]):
        pivot = gram[i, i]
        keep = pivot > floor[i]
        row = jnp.where(keep, gram[i] / jnp.sqrt(jnp.where(keep, pivot, 1)), 0)
        row = jnp.where(jnp.arange(gram.shape[0]) < i, 0, row)
        rows.append(row)
        gram = gram - row[:, None] * row[None]
    return jnp.stack(rows)


def _sum_of_products(left, right, segments=16):
    """``left @ right.T`` for a few long rows, added up in a tree of contiguous segments.

    The compiler turns this into vector instructions, and neither a reduction (kept in order, one
    addition at a time) nor a matrix product with so few rows (Eigen): 0.12 s against 0.30 and 0.25 s
    for the 10 million points of the benchmark. Sums in a tree are also more accurate.
    """
    pad = -left.shape[1] % segments
    left = jnp.pad(left, ((0, 0), (0, pad))).reshape(left.shape[0], 1, segments, -1)
    right = jnp.pad(right, ((0, 0), (0, pad))).reshape(1, right.shape[0], segments, -1)
    total = left[:, :, 0] * right[:, :, 0]
    for i in range(1, segments):
        total = total + left[:, :, i] * right[:, :, i]
    return jnp.sum(total, axis=-1)


_EXACT = jax.lax.Precision.HIGHEST  # some accelerators otherwise multiply float32 with 10 bits
