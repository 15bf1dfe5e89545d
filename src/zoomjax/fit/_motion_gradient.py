"""Derivatives of `fit_motion` by its data, by the implicit function theorem.

At the minimum the gradient g of the energy vanishes whatever the data, so that the unknowns change by
``dx = -H^-1 dg``. H is the whole Hessian, applied without being formed; the equations are solved by
conjugate gradients, which the Gauss-Newton matrix (`_schur`) preconditions so well that a few steps do.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.sparse.linalg import cg

from ._columns import Unknowns
from ._motion_model import Data, Model, Noise, Stage, moved, pinned, units_of
from ._motion_rows import columns_of, residuals_of, rows_of
from ._motion_stages import STAGES
from ._schur import reduced_of, solution_of

_TOLERANCE = 1e-10
_MOST_STEPS = 100
_LITTLE = 1e-9  # added to the diagonal of the preconditioner: unknowns that no view sees


@eqx.filter_jit
def sensitive(data: Data, model: Model, noise: Noise) -> Model:
    """The model of least energy, as a function of the data.

    Args:
        data: tracks and lines.
        model: that of least energy; a constant.
        noise: by which residuals are weighted; a constant.
    """
    stage = Stage(*(jnp.asarray(value, float) for value in STAGES[-1]))
    units = units_of(data, model, noise)
    zeros = jax.tree.map(jnp.zeros_like, units)
    here = jax.tree.map(jax.lax.stop_gradient, data)
    here = pinned(here, residuals_of(here, model), noise)
    data = eqx.tree_at(lambda data: data.pinned, data, here.pinned)

    def gradient(data: Data, unknowns: Unknowns) -> Unknowns:
        rows, back = jax.vjp(lambda x: rows_of(x, (data, model, noise, stage)), unknowns)
        return back(rows)[0]

    def times(vector: Unknowns) -> Unknowns:
        return jax.jvp(lambda x: gradient(here, x), (zeros,), (vector,))[1]

    args = here, model, noise, stage
    rows = rows_of(zeros, args)
    matrix = reduced_of(columns_of(args, zeros), rows, zeros, data.structure, jnp.asarray(_LITTLE))

    def nearly(vector: Unknowns) -> Unknowns:
        return solution_of(matrix, vector, data.structure)

    def solve(times, right):
        return cg(times, right, tol=_TOLERANCE, maxiter=_MOST_STEPS, M=nearly)[0]

    right = jax.tree.map(jnp.negative, gradient(data, zeros))
    steps = jax.lax.custom_linear_solve(times, right, solve, symmetric=True)
    return moved(model, jax.tree.map(jnp.multiply, steps, units))
