"""The default solver: optimistix' Levenberg-Marquardt with a search made for this problem.

Two changes to its trust region. It starts with next to no damping: the usual first damping, 1, is as large
as the least eigenvalue of the Gauss-Newton matrix of the paper's scene, in px, and costs 8 steps instead of
4. And it accepts a step that leaves the sum of squares as it was, up to rounding. At the minimum the actual
and the predicted reduction are both rounding errors; comparing them rejects every step to the last one
allowed, in float32 often.

Its steps are solved by Gram-Schmidt, and not by the library's QR: for many rows and few columns it is much
faster, as accurate, and without calls of LAPACK for which `jax.export` has no guarantee.
"""

from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, PyTree, Scalar

from ..lines.base import AbstractLines
from ._linear import gram_schmidt, solved

Solver = optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser

_FIRST_DAMPING = 1e-6
_ROUNDING = 128  # of a sum of squares, in units of its last digit: float32 sums of 20,000 squares vary so


class RoundingTrustRegion(optx.AbstractSearch):
    """`optimistix.ClassicalTrustRegion` as described above."""

    classical: optx.ClassicalTrustRegion = optx.ClassicalTrustRegion()
    first_damping: float | Array = _FIRST_DAMPING

    def init(self, y: PyTree, f_info_struct: Any) -> Any:
        """The state before the first step."""
        state = self.classical.init(y, f_info_struct)
        dtype = jnp.result_type(*jax.tree.leaves(y))  # optimistix takes JAX's widest
        return eqx.tree_at(lambda s: s.step_size, state, jnp.array(1 / self.first_damping, dtype))

    def step(
        self,
        first_step: Bool[Array, ""],
        y: PyTree,
        y_eval: PyTree,
        f_info: Any,
        f_eval_info: Any,
        state: Any,
    ) -> tuple[Scalar, Bool[Array, ""], optx.RESULTS, Any]:
        """The next step size, and whether this step is accepted."""
        step_size, accept, result, new_state = self.classical.step(
            first_step, y, y_eval, f_info, f_eval_info, state
        )
        before, after = f_info.as_min(), f_eval_info.as_min()
        rounding = _ROUNDING * jnp.finfo(before.dtype).eps * before
        still = ~first_step & (jnp.abs(after - before) <= rounding)
        step_size = jnp.where(still, state.step_size, step_size)
        new_state = eqx.tree_at(lambda s: s.step_size, new_state, step_size)
        return step_size, accept | still, result, new_state


class GramSchmidt(lx.AbstractLinearSolver):
    """Linear least squares with more rows than columns, which are independent."""

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> Any:
        """The factors of the operator's matrix, and how to make its argument of the unknowns."""
        del options
        structure = operator.in_structure()
        leaves = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), structure)
        flat, unravel = ravel_pytree(leaves)
        unravel = jax.tree_util.Partial(unravel)
        # Not as one matrix: the rows of lines on several devices, and those of the damping, stay apart.
        along = jax.vmap(lambda direction: operator.mv(unravel(direction)), out_axes=-1)
        return *gram_schmidt(along(jnp.eye(flat.size, dtype=flat.dtype))), eqxi.Static(unravel.func)

    def compute(
        self, state: Any, vector: PyTree[Array], options: dict[str, Any]
    ) -> tuple[PyTree[Array], lx.RESULTS, dict[str, Any]]:
        """The unknowns."""
        del options
        orthogonal, triangle, unravel = state
        result: Any = lx.RESULTS.successful
        return unravel.value(solved(orthogonal, triangle, vector)), result, {}

    def transpose(self, state: Any, options: dict[str, Any]) -> Any:
        """Not needed: steps of a solver are not differentiated."""
        raise NotImplementedError("The steps of the default solver have no transpose: pass another solver.")

    def conj(self, state: Any, options: dict[str, Any]) -> Any:
        """Real numbers stay what they are."""
        return state, options

    def assume_full_rank(self) -> bool:
        """The damping of each step sees to it."""
        return True


def default_solver(lines: AbstractLines) -> optx.LevenbergMarquardt:
    """Levenberg-Marquardt with tolerances near the rounding of the lines' dtype."""
    double = jax.dtypes.canonicalize_dtype(lines.focal.dtype) == jnp.float64
    tolerance = 1e-9 if double else 1e-4
    classical = optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance, linear_solver=GramSchmidt())
    return eqx.tree_at(lambda solver: solver.search, classical, RoundingTrustRegion())
