"""Comparison of trees to the last bit."""

import equinox as eqx
import jax
import numpy as np


def equal(a, b):
    """Whether two trees are the same, to the last bit."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        if eqx.is_array(one):
            assert one.dtype == other.dtype
            np.testing.assert_array_equal(one, other)
        else:
            assert (type(one), one) == (type(other), other)
