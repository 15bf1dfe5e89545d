"""Exact compression for any centre of distortion, for fits of the centre.

About a centre o (normalised, from a reference) a corrected point is a polynomial in the point z,

    o + w L(w.w),  w = z - o,

of degree 2N + 1 whatever o and k are: linear in the (2N + 2)(2N + 3)/2 monomials ``x^a y^b``, 21 for N = 2.
So the triangle R of those monomials, made once as in `compressed`, stands for all of a line's points at
every centre. It takes about ten times the work of the seven columns of a fixed centre, once; a step of a
fit then costs 20 rows a line. `AnyCentreLines.about` makes the small triangles of a fixed centre from it,
without the points.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.arguments import kinds_checked
from .._core.arrays import as_jax
from .._core.checks import MOST_TERMS, checked_integer
from .._core.products import EXACT
from .._core.types import Centres, traced
from .base import check_rows, header_of
from .buckets import bucketed_jit, of_lines
from .compressed import CompressedLines, moments_of, triangles_of
from .lines import Lines
from .reduction import triangle
from .triangles import AbstractTriangles


class AnyCentreLines(AbstractTriangles):
    """Lines reduced to triangles that are valid for every centre of distortion and up to `terms`
    coefficients.

    Attributes:
        triangle: R of each line's monomials, about `centre`, in normalised lengths.
        frame, focal, centre, image_size, focal_unit, number, weight, focus: as in `Lines`.
    """

    def __check_init__(self):
        """Check that the triangles have the rows of some number of terms."""
        if hasattr(self.triangle, "shape"):
            terms = self.terms
            if terms < 1 or self.triangle.shape[-1] != (2 * terms + 2) * (2 * terms + 3) // 2:
                raise ValueError(
                    "Argument triangle must have (2 N + 2)(2 N + 3) / 2 rows for N terms, N >= 1, but its "
                    f"shape is {self.triangle.shape}."
                )

    @property
    def terms(self) -> int:
        """The largest number of coefficients N for which these triangles are valid."""
        return (round((8 * self.triangle.shape[-1] + 1) ** 0.5) - 5) // 4

    def for_terms(self, terms: int) -> "AnyCentreLines":
        """The same lines for no more coefficients than these, which takes less work."""
        size = (2 * terms + 2) * (2 * terms + 3) // 2  # monomials are ordered by degree: the first ones
        if size >= self.triangle.shape[-1]:
            return self
        return eqx.tree_at(lambda lines: lines.triangle, self, self.triangle[:, :size, :size])

    def corrected(self, coefficients: Float[Array, "frame size"]) -> Float[Array, "line rows 2"]:
        """Rows, px, with the scatter of the corrected points about their mean.

        The last two of the `coefficients`, after (k1, ..., kN), are the centre's offset from `centre`,
        normalised.
        """
        return self._rows(self._moved_points(coefficients))

    def decentred(
        self, k: Float[Array, "frame terms"], tangential: Float[Array, "frame 2"]
    ) -> Float[Array, "line rows 2"]:
        """Such rows about `centre`, of the radial polynomial and the coefficients (p1, p2) of frames."""
        return self._rows(self._decentred_points(k, tangential))

    def squared_stretch(
        self, coefficients: Float[Array, "frame size"], normals: Float[Array, "line 2"]
    ) -> Float[Array, "line"]:
        """The mean of ``|J^T n|^2`` over each line's points, of the corrections of `corrected`."""
        return self._stretches(self._moved_points(coefficients), normals)

    def decentred_stretch(
        self,
        k: Float[Array, "frame terms"],
        tangential: Float[Array, "frame 2"],
        normals: Float[Array, "line 2"],
    ) -> Float[Array, "line"]:
        """The same of the corrections of `decentred`."""
        return self._stretches(self._decentred_points(k, tangential), normals)

    def _moved_points(self, coefficients):
        """The corrected point by monomials, of each frame: its lines share it."""
        check_rows(coefficients, self.focal)
        return jax.vmap(lambda k: _corrected_point(self.terms, k[:-2], k[-2:]))(coefficients)

    def _decentred_points(self, k, tangential):
        check_rows(k, self.focal)
        return jax.vmap(lambda k, p: _decentred_point(self.terms, k, p))(k, tangential)

    def _rows(self, points):
        def combine(r, point):  # the rows of R after the first hold the points about their mean
            return jnp.matmul(r, point.T, precision=EXACT)[1:]

        return self.scale * jax.vmap(combine)(self.triangle, points[self.frame])

    def _stretches(self, points, normals):
        def of_line(r, point, normal):
            return _stretch(self.terms, r, normal @ point)

        return jax.vmap(of_line)(self.triangle, points[self.frame], normals)

    def second_moments(self, order: int) -> Float[Array, "line moment 2 2"]:
        """``sum_p r_p^(2i) z_p z_p^T`` for i = 0 ... order - 1, at most 2 N + 1, z from `centre`."""
        columns = _radial_columns(self.terms, jnp.zeros(2, self.triangle.dtype))
        return moments_of(jnp.matmul(self.triangle, columns.T, precision=EXACT), order)

    def about(self, centre: Centres) -> CompressedLines:
        """The lines compressed about a fixed centre, px: that of all frames, or of each frame.

        In the latter case the result's `centre` is the mean.
        """
        each, mean = self._centres(centre)
        return CompressedLines(triangle=_about(self, each), **header_of(self) | {"centre": mean})

    def moved(self, centre: Centres) -> "AnyCentreLines":
        """The same lines with their monomials about another centre, px: that of all frames, or of each.

        In the latter case the result's `centre` is the mean.
        """
        each, mean = self._centres(centre)
        new = (_moved(self, each), mean)
        return eqx.tree_at(lambda lines: (lines.triangle, lines.centre), self, new)

    def _centres(self, centre: Centres) -> tuple[Any, Any]:
        """The centre of each frame, and their mean; in NumPy where they are known."""
        xp: Any = jnp if traced(centre) else np
        centre = xp.asarray(centre, self.triangle.dtype)
        each = xp.broadcast_to(centre, (self.focal.shape[0], 2))
        return each, as_jax(centre if centre.ndim == 1 else xp.mean(each, axis=0))


@kinds_checked
def compress_any_centre(lines: Lines, terms: int = 2) -> AnyCentreLines:
    """Compress each line exactly for every centre of distortion, for `fit_centre`.

    Args:
        lines: the lines.
        terms: the largest number N of coefficients to be fitted. Fewer can be fitted, too.

    Example:
        >>> import numpy as np
        >>> row = np.stack([np.arange(500.0), np.full(500, 20.0)], axis=-1)
        >>> lines = Lines.from_ragged([row, row + 1], [0, 1], [24, 70], image_size=(640, 480))
        >>> small = compress_any_centre(lines)
        >>> small.triangle.shape, small.about(np.array([320.0, 250.0])).triangle.shape
        ((2, 21, 21), (2, 7, 7))
    """
    return AnyCentreLines(
        triangle=_triangles(lines, checked_integer("terms", terms, 1, MOST_TERMS)),
        **header_of(lines),
    )


_FEW_POINTS = 2_000_000
"""Up to so many points LAPACK reduces them, which needs no compiling; beyond, compiled code is faster."""


def _triangles(lines, terms):
    """R of each line's monomials."""
    here = not traced(lines) and jax.default_backend() == "cpu" and lines.points.size <= 2 * _FEW_POINTS
    if not here or len(getattr(lines.points, "devices", set)()) > 1:
        return triangles_of(lines, _monomials, terms)
    centre, mask = np.asarray(lines.centre, float), np.asarray(lines.mask)
    size = (2 * terms + 2) * (2 * terms + 3) // 2
    found = np.zeros((len(mask), size, size))
    for line, (points, there) in enumerate(zip(np.asarray(lines.points), mask, strict=True)):
        z = (points[there].astype(float) - centre).T / lines.scale
        rows = _monomials(z, np.ones(z.shape[1]), terms, np)
        r = np.linalg.qr(rows.T, mode="r")
        found[line, : len(r)] = r * np.where(np.diagonal(r) < 0, -1, 1)[:, None]
    return jnp.asarray(found, jnp.asarray(lines.points).dtype)


def _monomials(z, valid, terms, xp=jnp):
    """The rows ``x^a y^b`` of one line, by degree ``a + b``, then by b; zero where it has no point."""
    degree = [valid[None]]
    for _ in range(2 * terms + 1):
        degree.append(xp.concatenate([z[:1] * degree[-1], z[1:] * degree[-1][-1:]]))
    return xp.concatenate(degree)


def _powers(terms):
    """The powers (a, b) of the monomials, in the order of `_monomials`."""
    pairs = [(d - b, b) for d in range(2 * terms + 2) for b in range(d + 1)]
    return tuple(np.array(pairs).T)


def _products(terms):
    """The columns as sums of products ``w_x^p w_y^q``: the powers of all, and how often each is in each."""
    often = {(0, 0): (0, 1)}
    for j, m in zip(*map(np.ndarray.tolist, np.tril_indices(terms + 1)), strict=True):
        often[2 * m + 1, 2 * (j - m)] = (1 + 2 * j, math.comb(j, m))
        often[2 * m, 2 * (j - m) + 1] = (2 + 2 * j, math.comb(j, m))
    matrix = np.zeros((2 * terms + 3, len(often)))
    for place, (column, number) in enumerate(often.values()):
        matrix[column, place] = number
    return np.array(list(often)).T, matrix


def _expanded(terms, offset):
    """Those products with ``w = z - offset``, by monomials of z: the powers of both are by binomials."""
    powers = jnp.stack([(-offset) ** power for power in range(2 * terms + 2)], axis=1)
    parts = []
    for axis, upper, lower in zip((0, 1), _products(terms)[0], _powers(terms), strict=True):
        often = np.array([[math.comb(p, a) for a in lower.tolist()] for p in upper.tolist()])
        rest = np.maximum(upper[:, None] - lower[None], 0)
        parts.append(often.astype(offset.dtype) * powers[axis][rest])
    return parts[0] * parts[1]


def _radial_columns(terms, offset):
    """1, w, (w.w) w, ..., (w.w)^N w with ``w = z - offset``, by monomials of z."""
    matrix = _products(terms)[1].astype(offset.dtype)
    return jnp.matmul(matrix, _expanded(terms, offset), precision=EXACT)


def _corrected_point(terms, k, offset):
    """The corrected point of a line's points, x and y, by monomials."""
    matrix = _products(terms)[1][1:].reshape(terms + 1, 2, -1).astype(offset.dtype)
    kappa = jnp.concatenate([jnp.ones(1, k.dtype), k, jnp.zeros(terms - k.shape[0], k.dtype)])
    weights = jnp.einsum("j,jcn->cn", kappa, matrix, precision=EXACT)
    return jnp.matmul(weights, _expanded(terms, offset), precision=EXACT)


def _decentred_point(terms, k, p):
    """The same about the centre itself, with decentering; monomials 3 to 5 are x^2, xy and y^2."""
    squares = jnp.stack([jnp.stack([3 * p[1], 2 * p[0], p[1]]), jnp.stack([p[0], 2 * p[1], 3 * p[0]])])
    return _corrected_point(terms, k, jnp.zeros_like(p)).at[:, 3:6].add(squares)


def _stretch(terms, r, across):
    """The mean of ``|J^T n|^2``: J^T n is the gradient of n.x, the polynomial `across` in the monomials."""
    gradient = jnp.asarray(_derivatives(terms), across.dtype) @ across
    values = jnp.matmul(r, gradient.T, precision=EXACT)
    count = r[0, 0] ** 2
    return jnp.where(count > 0, jnp.sum(values**2) / jnp.maximum(count, 1), 1)


def _derivatives(terms):
    """What makes of a polynomial in the monomials its derivatives by x and y: (2, monomial, monomial)."""
    a, b = _powers(terms)
    place = {pair: index for index, pair in enumerate(zip(a.tolist(), b.tolist(), strict=True))}
    by_xy = np.zeros((2, len(a), len(a)))
    for (x, y), index in place.items():
        if x:
            by_xy[0, place[x - 1, y], index] = x
        if y:
            by_xy[1, place[x, y - 1], index] = y
    return by_xy


@bucketed_jit(frames=["centres"], returns=of_lines, light=False)
def _moved(lines, centres):
    """R of the monomials of ``z - offset``, which are sums of those of z: (x - a)^i is by binomials."""
    terms = lines.terms
    a, b = _powers(terms)
    binomials = np.array([[math.comb(i, j) for i in range(2 * terms + 2)] for j in range(2 * terms + 2)])

    def change(offset):
        powers = jnp.stack([(-offset) ** power for power in range(2 * terms + 2)], axis=1)

        def of(axis, lower, upper):  # what of lower^ there is in (x - offset)^upper
            rest = np.maximum(upper[None] - lower[:, None], 0)
            return jnp.asarray(binomials[lower[:, None], upper[None]], offset.dtype) * powers[axis][rest]

        return of(0, a, a) * of(1, b, b)

    def one(r, change):
        return triangle(jnp.matmul(r, change, precision=EXACT).T)

    return jax.vmap(one)(lines.triangle, jax.vmap(change)(_offsets(lines, centres))[lines.frame])


@bucketed_jit(frames=["centres"], returns=of_lines, light=False)
def _about(lines, centres):
    def one(r, columns):
        return triangle(jnp.matmul(r, columns.T, precision=EXACT).T)

    columns = jax.vmap(lambda offset: _radial_columns(lines.terms, offset))(_offsets(lines, centres))
    return jax.vmap(one)(lines.triangle, columns[lines.frame])


def _offsets(lines, centres):
    """Of each frame's centre from that of the monomials, normalised."""
    return (centres - lines.centre[None]) / lines.scale
