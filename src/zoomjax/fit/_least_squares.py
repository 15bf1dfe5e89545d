"""The default solver of fits: Levenberg-Marquardt for many residuals and few unknowns.

It is a solver of optimistix, with the trust region of its `LevenbergMarquardt`. It takes the same steps but
for three things.

* Of a Jacobian with thousands of rows and the residuals beside it, it keeps the small triangle of their QR
  alone: a step, what it promises and whether it moves anything follow from that. The program is half as
  large, and is compiled in half of the time. By Gram-Schmidt there are no calls of LAPACK in it, for which
  `jax.export` has no guarantee.
* It starts with next to no damping: the usual first damping, 1, is as large as the least eigenvalue of the
  Gauss-Newton matrix of the paper's scene, in px, and costs 8 steps instead of 4.
* It accepts a step that leaves the sum of squares as it was, up to rounding. At the minimum the actual and
  the predicted reduction are both rounding errors; comparing them rejects every step to the last one
  allowed, in float32 often. The next step is damped more, lest such steps go on for ever.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from ..lines.base import AbstractLines
from ._linear import triangle_of

Solver = optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser

ROUNDING = 128  # of a sum of squares, in units of its last digit: float32 sums of 20,000 squares vary so
FIRST_DAMPING = 1e-6
_TRUSTED = optx.ClassicalTrustRegion()  # its constants


class _State(eqx.Module):
    """What is known where the solver stands, and where it looks next.

    Attributes:
        proposed: the unknowns to be tried.
        damping: that led there.
        triangle: R of the Jacobian and, as the last column, the residuals.
        squares: the sum of the squared residuals; infinite before the first step.
        done: whether the last step moved nothing.
        lost: whether the residuals at the start are not finite.
    """

    proposed: Float[Array, "unknown"]
    damping: Float[Array, ""]
    triangle: Float[Array, "column column"]
    squares: Float[Array, ""]
    done: Bool[Array, ""]
    lost: Bool[Array, ""]


class TriangularLevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    """Levenberg-Marquardt as described above.

    Attributes:
        rtol: the change of unknowns and residuals, relative to them, below which it ends.
        atol: the same, in their units: both are added.
        norm: not used; solvers of optimistix have one.
    """

    rtol: float
    atol: float
    norm: Callable[[PyTree], Any] = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        """The state before the first step, which tries the start itself."""
        start, _ = ravel_pytree(y)
        return _State(
            proposed=start,
            damping=jnp.array(FIRST_DAMPING, start.dtype),
            triangle=jnp.zeros((start.size + 1, start.size + 1), start.dtype),
            squares=jnp.array(jnp.inf, start.dtype),
            done=jnp.array(False),
            lost=jnp.array(False),
        )

    def step(self, fn, y, args, options, state: _State, tags) -> tuple[PyTree, _State, Any]:
        """Try the unknowns proposed, go there if they are better, and propose the next.

        What the function returns besides is that of the unknowns tried.
        """
        here, unravel = ravel_pytree(y)
        triangle, aux = _triangle_at(lambda flat: fn(unravel(flat), args), state.proposed)
        squares = jnp.sum(triangle[:, -1] ** 2)

        moved = state.proposed - here
        change = state.triangle[:, :-1] @ moved
        promised = jnp.sum((state.triangle[:, -1] + change) ** 2) - state.squares
        gained = squares - state.squares
        first = jnp.isinf(state.squares)
        numbers = jnp.finfo(gained.dtype)
        still = ~first & (jnp.abs(gained) <= ROUNDING * numbers.eps * state.squares)
        accepted = (gained <= _TRUSTED.low_cutoff * promised) | still
        as_promised = (gained < _TRUSTED.high_cutoff * promised) & (promised < 0)
        weaker = jnp.where(as_promised, 1 / _TRUSTED.high_constant, 1)
        damping = state.damping * jnp.where(accepted & ~still, weaker, 1 / _TRUSTED.low_constant)
        damping = jnp.maximum(damping, numbers.tiny)

        little = jnp.all(jnp.abs(moved) <= self.atol + self.rtol * jnp.abs(state.proposed))
        little &= jnp.linalg.norm(change) <= self.atol + self.rtol * jnp.sqrt(squares)
        here = jnp.where(accepted, state.proposed, here)
        triangle = jnp.where(accepted, triangle, state.triangle)
        new = _State(
            proposed=here - _damped_step(triangle, damping),
            damping=damping,
            triangle=triangle,
            squares=jnp.where(accepted, squares, state.squares),
            done=accepted & little & ~first,
            lost=first & ~accepted,
        )
        return unravel(here), new, aux

    def terminate(self, fn, y, args, options, state: _State, tags) -> tuple[Bool[Array, ""], optx.RESULTS]:
        """Whether the last step moved nothing, or there is no start."""
        good: Any = optx.RESULTS.successful
        nonfinite: Any = optx.RESULTS.nonfinite
        return state.done, optx.RESULTS.where(state.lost, nonfinite, good)

    def postprocess(self, fn, y, aux, args, options, state, tags, result) -> tuple[PyTree, Any, dict]:
        """The unknowns as they are."""
        return y, aux, {}


def _triangle_at(function, flat):
    """R of the Jacobian of the residuals with the residuals as its last column; and what else is returned.

    Not of one matrix: the rows of lines on several devices, and those of a prior, stay apart.
    """
    residuals, along, aux = jax.linearize(function, flat, has_aux=True)
    jacobian = jax.vmap(along, out_axes=-1)(jnp.eye(flat.size, dtype=flat.dtype))
    beside = jax.tree.map(
        lambda columns, column: jnp.concatenate([columns, column[..., None]], axis=-1), jacobian, residuals
    )
    return triangle_of(beside), aux


def _damped_step(triangle, damping):
    """The x of least ``|J x - r|^2 + damping |x|^2``, from the triangle of J and r."""
    unknowns = triangle.shape[0] - 1
    rows = jnp.sqrt(damping) * jnp.eye(unknowns, unknowns + 1, dtype=triangle.dtype)
    damped = triangle_of([triangle, rows])
    return jax.scipy.linalg.solve_triangular(damped[:-1, :-1], damped[:-1, -1])


def default_solver(lines: AbstractLines) -> TriangularLevenbergMarquardt:
    """The default solver with tolerances near the rounding of the lines' dtype."""
    double = jax.dtypes.canonicalize_dtype(lines.focal.dtype) == jnp.float64
    tolerance = 1e-9 if double else 1e-4
    return TriangularLevenbergMarquardt(rtol=tolerance, atol=tolerance)
