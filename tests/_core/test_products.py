"""Products of matrices keep all digits of float32, where a GPU may multiply with 10 bits: in programs."""

import jax
import jax.numpy as jnp
import pytest

from zoomjax._core.products import EXACT

from .. import _embeddings


def products(jaxpr):
    """All products of matrices in a program, and in those that it calls."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            yield equation
        for inner in jax.tree.leaves(
            list(equation.params.values()),
            is_leaf=lambda leaf: hasattr(leaf, "eqns") or hasattr(leaf, "jaxpr"),
        ):
            inner = getattr(inner, "jaxpr", inner)
            if hasattr(inner, "eqns"):
                yield from products(inner)


def rounded(function, *arguments):
    """Those that are not exact."""
    return [
        equation
        for equation in products(jax.make_jaxpr(function)(*arguments).jaxpr)
        if equation.params["precision"] != (EXACT, EXACT)
        and jnp.issubdtype(equation.outvars[0].aval.dtype, jnp.floating)
    ]


def test_a_product_that_is_rounded_is_found():
    matrix = jnp.ones((3, 3))
    assert len(rounded(jax.jit(lambda a: a @ a), matrix)) == 1
    assert not rounded(lambda a: jnp.matmul(a, a, precision=EXACT), matrix)


@pytest.mark.parametrize("row", _embeddings.ROWS, ids=lambda row: row.name)
def test_products_are_exact(row):
    subject, x = row.subject(), row.x()
    assert not rounded(lambda x: row.function(subject, x), x)
