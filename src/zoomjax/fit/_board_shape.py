"""The shape of a board that is not flat: smooth displacements of its grid in and out of its plane.

Corner (column, row) of the grid is at ``(x, y, 0) + sum_j b_j(x, y) c_j``, x and y about the middle of the
board in units of half its longer side. The functions are products of Legendre polynomials of the two
directions, up to a total degree (`OUT_OF_PLANE`, `IN_PLANE`), and to no more than corners can tell. A
coefficient c_j is a priori normal, with a standard deviation that falls with the square of the degree;
`SHAPE_STD` scales it.

What poses can do is left out: the plane out of which the board bends (3 functions), and translation,
rotation and scale in the plane (4). What is left in the plane to first order is another ratio of width to
height, and a skew.
"""

import itertools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

OUT_OF_PLANE, IN_PLANE = 12, 10
"""Largest total degrees."""

SHAPE_STD = (0.1, 0.03)
"""Standard deviation of a function of degree 2 out of the plane, and in it, half longer sides."""


def grid_places(rows: int, columns: int) -> tuple[Float[np.ndarray, "corner 2"], float]:
    """Corners of a grid about its middle, row by row, and how many steps of the grid the unit is."""
    y, x = (axis.ravel().astype(float) for axis in np.indices((rows, columns)))
    middle = np.array([(columns - 1) / 2, (rows - 1) / 2])
    unit = float(middle.max())
    return (np.stack([x, y], axis=1) - middle[None]) / unit, unit


def shape_basis(places: Float[np.ndarray, "corner 2"]) -> Float[np.ndarray, "corner 3 function"]:
    """Displacements of each corner, each function times its standard deviation."""
    reach = np.maximum(np.abs(places).max(axis=0), 1e-9)
    u, v = (places / reach[None]).T
    degree = max(OUT_OF_PLANE, IN_PLANE)
    along, down = (np.polynomial.legendre.legvander(axis, degree) for axis in (u, v))
    most = [min(np.unique(axis).size, degree + 1) for axis in (u, v)]
    powers = list(itertools.product(range(most[0]), range(most[1])))
    columns = []
    for axis, (std, highest) in enumerate(
        ((SHAPE_STD[1], IN_PLANE), (SHAPE_STD[1], IN_PLANE), (SHAPE_STD[0], OUT_OF_PLANE))
    ):
        for a, b in powers:
            if 2 <= a + b <= highest:
                displaced = np.zeros((len(places), 3))
                displaced[:, axis] = std * (2 / (a + b)) ** 2 * along[:, a] * down[:, b]
                columns.append(displaced)
    x, y = places.T
    for pair in ((x, -y), (y, x)):  # ratio of width to height, and skew
        columns.append(SHAPE_STD[1] * np.stack([*pair, 0 * x], axis=1))
    return np.stack(columns, axis=2)


def shape_of(
    places: Float[Array, "corner 2"],
    basis: Float[Array, "corner 3 function"],
    coefficients: Float[Array, "function"],
) -> Float[Array, "corner 3"]:
    """Where the corners are, half longer sides."""
    flat = jnp.concatenate([places, jnp.zeros_like(places[:, :1])], axis=1)
    return flat + basis @ coefficients
