"""The closed vocabulary of array types and axis names used in every signature.

Axes: ``line`` lines of the data set, ``point`` points of a line, ``frame`` images, ``terms``
distortion coefficients (N of eq. 2), ``rows`` rows of a line's (possibly compressed) design,
``basis`` functions of the focal length, ``parameter`` unknowns of a fit.
"""

import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Bool, Float, Int, Num, PyTree

AnyArray = jax.Array | np.ndarray
"""A JAX array, or a NumPy array where JAX cannot hold the values as given (float64, x64 off)."""

Scalar = Float[AnyArray, ""]
Point = Float[AnyArray, "2"]
Centres = Float[AnyArray, "2"] | Float[AnyArray, "frame 2"]
Points = Num[AnyArray, "*batch 2"]
Coefficients = Float[AnyArray, "terms"]
Mask = Bool[AnyArray, "line point"]
FrameIndex = Int[AnyArray, "line"]
LineNumber = Int[AnyArray, "line"]
LineWeight = Float[AnyArray, "line"]
Focal = Float[AnyArray, "frame"]
Focus = Float[AnyArray, "frame"]


def traced(tree: PyTree) -> bool:
    """Whether values in the tree are not known yet, being inside ``jit``, ``vmap`` or ``grad``."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))
