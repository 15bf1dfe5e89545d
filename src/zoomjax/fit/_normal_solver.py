"""Linear solvers of steps by normal equations of a known structure, for optimistix."""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, PyTree, Scalar

from ._least_squares import FIRST_DAMPING, ROUNDING


class AbstractNormalSolver(lx.AbstractLinearSolver):
    """Steps of a damped Gauss-Newton method.

    The unknowns are a tree whose first leaf is damped as all others are.
    """

    @abc.abstractmethod
    def step(self, jacobian: Any, rows: Any, like: Any, damping: Array) -> Any:
        """The unknowns of least squares of ``jacobian x = rows``, with `damping` added to the diagonal."""

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> Any:
        """The operator itself."""
        del options
        return operator

    def compute(
        self, state: Any, vector: PyTree[Array], options: dict[str, Any]
    ) -> tuple[PyTree[Array], lx.RESULTS, dict[str, Any]]:
        """The unknowns: of rows, and of as many equations that damp each unknown."""
        del options
        rows, _ = vector
        like = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), state.in_structure())
        leaves, shape = jax.tree.flatten(like)
        _, damped = state.mv(jax.tree.unflatten(shape, [jnp.ones_like(leaves[0]), *leaves[1:]]))
        damping = jax.tree.leaves(damped)[0].ravel()[0] ** 2
        result: Any = lx.RESULTS.successful
        return self.step(lambda x: state.mv(x)[0], rows, like, damping), result, {}

    def transpose(self, state: Any, options: dict[str, Any]) -> Any:
        """Not needed: steps of a solver are not differentiated."""
        raise NotImplementedError("The steps of this solver have no transpose: pass another solver.")

    def conj(self, state: Any, options: dict[str, Any]) -> Any:
        """Real numbers stay what they are."""
        return state, options

    def assume_full_rank(self) -> bool:
        """The damping of each step sees to it."""
        return True


class RoundingTrustRegion(optx.AbstractSearch):
    """`optimistix.ClassicalTrustRegion` with the two changes that `_least_squares` tells of."""

    classical: optx.ClassicalTrustRegion = optx.ClassicalTrustRegion()
    first_damping: float | Array = FIRST_DAMPING

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
        rounding = ROUNDING * jnp.finfo(before.dtype).eps * before
        still = ~first_step & (jnp.abs(after - before) <= rounding)
        step_size = jnp.where(still, state.step_size, step_size)
        new_state = eqx.tree_at(lambda s: s.step_size, new_state, step_size)
        return step_size, accept | still, result, new_state


def damped_solver(
    steps: AbstractNormalSolver, unknowns: type, change: Any, damping: Any
) -> optx.LevenbergMarquardt:
    """Levenberg-Marquardt with these steps, which ends with a step that moves the residuals by less.

    Args:
        steps: the linear solver.
        unknowns: the class of the unknowns, whose own changes are not asked: along weak directions they say
            little.
        change: of the residuals, in all.
        damping: of the first step.
    """

    def of_residuals(moved):
        return jnp.zeros(()) if isinstance(moved, unknowns) else optx.two_norm(moved)

    solver = optx.LevenbergMarquardt(rtol=0.0, atol=change, norm=of_residuals, linear_solver=steps)
    return eqx.tree_at(lambda s: s.search, solver, RoundingTrustRegion(first_damping=damping))
