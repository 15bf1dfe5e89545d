"""The shape of a board that is not flat: smooth displacements of its grid in and out of its plane.

Corner (column, row) of the grid is at ``(x, y, 0) + sum_j b_j(x, y) c_j``, x and y about the middle of the
board in units of half its longer side. The functions are products of Legendre polynomials of the two
directions, up to a total degree (`OUT_OF_PLANE`, `IN_PLANE`), and to no more than corners can tell. A
coefficient c_j is a priori normal, with a standard deviation that falls with the square of the degree;
`SHAPE_STD` scales it.

What poses can do is left out: the plane out of which the board bends (3 functions), and translation,
rotation and scale in the plane (4). What is left in the plane to first order is another ratio of width to
height, and a skew.

Paper that is taken up and laid down between two photos bends otherwise: each photo has a few functions of
its own out of the plane (`OF_A_PHOTO`), beside the shape that all photos of the board have in common.
"""

import itertools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.arrays import as_jax

OUT_OF_PLANE, IN_PLANE, OF_A_PHOTO = 12, 10, 4
"""Largest total degrees."""

SHAPE_STD = (0.1, 0.03)
"""Standard deviation of a function of degree 2 out of the plane, and in it, half longer sides."""

_SHARED = 2
"""Functions that displace along both directions of the plane, last of x and first of y."""


class Basis(eqx.Module):
    """Functions of a board's shape, each times its standard deviation.

    All but two displace corners along one axis only: products with them are made axis by axis.

    Attributes:
        x, y, z: displacements along each axis. The last two functions of x are the first two of y.
        own: functions out of the plane that each photo has beside them, of deviation 1.
    """

    x: Float[Array, "corner x"]
    y: Float[Array, "corner y"]
    z: Float[Array, "corner z"]
    own: Float[Array, "corner own"]

    @property
    def size(self) -> int:
        """The number of functions of the shape."""
        return self.x.shape[1] + self.y.shape[1] - _SHARED + self.z.shape[1]

    @property
    def axes(self) -> tuple[tuple[slice, Float[Array, "corner some"]], ...]:
        """For each axis the places of its functions among all, and their displacements."""
        middle = self.x.shape[1]
        after = middle - _SHARED + self.y.shape[1]
        places = (slice(0, middle), slice(middle - _SHARED, after), slice(after, self.size))
        return tuple(zip(places, (self.x, self.y, self.z), strict=True))

    def scaled(self, unit: Float[Array, ""]) -> "Basis":
        """The same for coefficients of the shape in this unit."""
        return Basis(self.x * unit, self.y * unit, self.z * unit, self.own)

    def moved(self, coefficients: Float[Array, "function *some"]) -> Float[Array, "corner 3 *some"]:
        """By how much coefficients displace each corner."""
        return jnp.stack(
            [jnp.tensordot(values, coefficients[where], 1) for where, values in self.axes], axis=1
        )

    def summed(self, points: Float[Array, "*some corner 3 k"]) -> Float[Array, "*some function k"]:
        """Columns by the coefficients, from sums of products with columns by the coordinates of corners."""
        out = jnp.zeros((*points.shape[:-3], self.size, points.shape[-1]))
        for axis, (where, values) in enumerate(self.axes):
            own = jnp.einsum("nf,...nk->...fk", values, points[..., axis, :])
            out = out.at[..., where, :].add(own)
        return out

    def block(self, points: Float[Array, "corner 3 3"]) -> Float[Array, "function function"]:
        """Of normal equations by the coefficients, from those by the coordinates of each corner."""
        out = jnp.zeros((self.size, self.size))
        for i, (rows, left) in enumerate(self.axes):
            for j, (columns, right) in enumerate(self.axes):
                out = out.at[rows, columns].add((left * points[:, i, j, None]).T @ right)
        return out

    def variance(self, covariance: Float[Array, "function function"]) -> Float[Array, "corner 3"]:
        """Of each corner's coordinates, from the covariance of the coefficients."""
        of = [jnp.sum(values @ covariance[w, w] * values, axis=1) for w, values in self.axes]
        return jnp.stack(of, axis=1)


def grid_places(rows: int, columns: int) -> tuple[Float[np.ndarray, "corner 2"], float]:
    """Corners of a grid about its middle, row by row, and how many steps of the grid the unit is."""
    y, x = (axis.ravel().astype(float) for axis in np.indices((rows, columns)))
    middle = np.array([(columns - 1) / 2, (rows - 1) / 2])
    unit = float(middle.max())
    return (np.stack([x, y], axis=1) - middle[None]) / unit, unit


def shape_basis(places: Float[np.ndarray, "corner 2"], more: int = 0) -> Basis:
    """Displacements of each corner, and of so many more that pad."""
    reach = np.maximum(np.abs(places).max(axis=0), 1e-9)
    u, v = (places / reach[None]).T
    degree = max(OUT_OF_PLANE, IN_PLANE)
    along, down = (np.polynomial.legendre.legvander(axis, degree) for axis in (u, v))
    most = [min(np.unique(axis).size, degree + 1) for axis in (u, v)]
    powers = list(itertools.product(range(most[0]), range(most[1])))

    def functions(highest, std):
        """Products up to a degree, whose deviations fall with its square."""
        chosen = [(a, b) for a, b in powers if 2 <= a + b <= highest]
        return [std * (2 / (a + b)) ** 2 * along[:, a] * down[:, b] for a, b in chosen]

    x, y = places.T
    inside = functions(IN_PLANE, SHAPE_STD[1])
    both = SHAPE_STD[1] * np.array([[x, y], [-y, x]])  # ratio of width to height, and skew
    columns = (
        [*inside, *both[0]],
        [*both[1], *inside],
        functions(OUT_OF_PLANE, SHAPE_STD[0]),
        functions(OF_A_PHOTO, 1.0),
    )
    return Basis(*(as_jax(np.pad(np.stack(of, axis=1), ((0, more), (0, 0)))) for of in columns))


def shape_of(
    places: Float[Array, "corner 2"], basis: Basis, coefficients: Float[Array, "function"]
) -> Float[Array, "corner 3"]:
    """Where the corners are, half longer sides."""
    flat = jnp.concatenate([places, jnp.zeros_like(places[:, :1])], axis=1)
    return flat + basis.moved(coefficients)
