"""Steps of a damped Gauss-Newton method by normal equations of a known structure, for optimistix."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, PyTree, Scalar

from ._least_squares import FIRST_DAMPING, ROUNDING


class AbstractNormalSolver(eqx.Module):
    """How the normal equations of a problem are made and solved."""

    @abc.abstractmethod
    def step(self, at: Any, jacobian: Any, rows: Any, damping: Array) -> Any:
        """The unknowns of least squares of ``jacobian x = rows``, with `damping` added to the diagonal.

        Args:
            at: the unknowns where the rows are linearised.
            jacobian: maps a change of the unknowns to that of the rows.
            rows: the residuals there.
            damping: added to each unknown's diagonal entry.
        """


class _Linearised(eqx.Module):
    """Where the last step that was accepted has led."""

    at: PyTree
    rows: PyTree
    jacobian: Any


class NormalDescent(optx.AbstractDescent):
    """`optimistix.DampedNewtonDescent` by normal equations."""

    solver: AbstractNormalSolver

    def init(self, y: PyTree, f_info_struct: Any) -> _Linearised:
        """A state of the shapes of those that follow."""
        known = jax.tree.map(
            lambda leaf: (
                jnp.zeros(leaf.shape, leaf.dtype) if isinstance(leaf, jax.ShapeDtypeStruct) else leaf
            ),
            f_info_struct,
        )
        return _Linearised(y, known.residual, known.jac)

    def query(self, y: PyTree, f_info: Any, state: _Linearised) -> _Linearised:
        """What steps from here are made of."""
        del state
        return _Linearised(y, f_info.residual, f_info.jac)

    def step(self, step_size: Scalar, state: _Linearised) -> tuple[PyTree, optx.RESULTS]:
        """The damped step; the damping is the inverse of the step's size."""
        kind = jnp.finfo(step_size.dtype)
        damping = jnp.where(
            step_size > kind.eps, 1 / jnp.where(step_size > kind.eps, step_size, 1), kind.max
        )
        solved = self.solver.step(state.at, state.jacobian.mv, state.rows, damping)
        result: Any = optx.RESULTS.successful
        return jax.tree.map(jnp.negative, solved), result


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


class _OfResiduals(eqx.Module):
    """The size of a change of the residuals; none of a change of the unknowns."""

    size: Callable[[PyTree], Any]
    unknowns: type = eqx.field(static=True)

    def __call__(self, change: PyTree) -> Any:
        return jnp.zeros(()) if isinstance(change, self.unknowns) else self.size(change)


def damped_solver(
    steps: AbstractNormalSolver,
    unknowns: type,
    change: Any,
    damping: Any,
    size: Callable[[PyTree], Any] = optx.two_norm,
) -> optx.LevenbergMarquardt:
    """Levenberg-Marquardt with these steps, which ends with a step that moves the residuals by less.

    Args:
        steps: what makes and solves the normal equations.
        unknowns: the class of the unknowns, whose own changes are not asked: along weak directions they say
            little.
        change: of the residuals, in all.
        damping: of the first step.
        size: of changes of the residuals.
    """
    solver = optx.LevenbergMarquardt(rtol=0.0, atol=change, norm=_OfResiduals(size, unknowns))
    return eqx.tree_at(
        lambda s: (s.descent, s.search),
        solver,
        (NormalDescent(steps), RoundingTrustRegion(first_damping=damping)),
    )
