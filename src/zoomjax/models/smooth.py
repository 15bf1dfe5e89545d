"""A polynomial of high degree with a prior learned from six hundred real zoom lenses.

Degree 2 is too stiff for many lenses, and a sufficient degree has as many parameters as there are focal
lengths. `SmoothZoom` has degree 6 and a Gaussian prior instead: a Gaussian process in 1/f, joint over k1
and k2, in the finite basis of the Legendre polynomials of ``u = f_ref/f``. With few focal lengths the prior
gives a typical curve; many focal lengths outweigh it.

The numbers of the prior are learned by `benchmarks/real/lensfun` from zoom lenses of the lensfun database,
as those that best predict focal lengths that are left out, one of many and all but two, three or four.
"""

import math
from collections.abc import Hashable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, ScalarLike

from .._core.arrays import namespace
from .._core.checks import check_above, checked_integer
from .._core.fields import check_finite, check_not_negative, check_positive, check_shapes, numbers
from .._core.types import AnyArray, Focal, Scalar
from ._bernstein import Pieces
from ._prepared import shortest, zero_parameters
from .zoom import UNFITTED, AbstractPriorZoom, inverse_powers

_ERROR = 9.17e-5
_QUADRATIC = (
    (0.0493, 0, 0, 0, 0, 0),
    (-0.0001, 0.0147, 0, 0, 0, 0),
    (-0.0105, -0.0519, 0.0443, 0, 0, 0),
    (0.0081, 0.0269, -0.0076, 0.0068, 0, 0),
    (-0.0197, -0.0407, 0.0215, 0.0004, 0.0263, 0),
    (0.0038, 0.0165, -0.0031, 0.0027, -0.0071, 0.0089),
)
_BEYOND = ((0.0074, 0), (-0.0051, 0.0050))
"""What `python -m benchmarks.real.lensfun --prior` prints, learned from all 618 lenses."""

_ERROR_OF_LENS = 1.52e-4
_QUADRATIC_OF_LENS = (
    (0.0357, 0, 0, 0, 0, 0),
    (0.0026, 0.0155, 0, 0, 0, 0),
    (0.0017, -0.0326, 0.0271, 0, 0, 0),
    (0.0067, 0.0181, -0.0049, 0.0081, 0, 0),
    (-0.0018, -0.0139, 0.0071, 0.0002, 0.0145, 0),
    (0.0025, 0.0127, -0.0022, 0.0021, -0.0059, 0.0089),
)
_BEYOND_OF_LENS = ((0.0062, 0), (-0.0042, 0.0055))
_OF_LENS = (
    (0.0078, -0.0012, 0.0270, -0.0120, 0.0287, -0.0061, -0.6776),
    (-0.0018, 0.0027, 0.0056, 0.0083, -0.0143, 0.0071, 0.6933),
    (0.0116, -0.0165, 0.0034, -0.0158, 0.0241, -0.0193, 0.3095),
    (-0.0007, -0.0001, -0.0010, -0.0003, -0.0058, -0.0008, -0.1262),
)
"""The same where a lens is known. For each of `facts_of` six numbers of the mean and one of log(error)."""

_TYPICAL_LENS = (28.0, 3.5, 1.6)
_MOST_LENSES = ((16.0, 2.0, 1.0), (105.0, 15.0, 6.0))
"""Focal length of equal view, mm, zoom ratio and crop factor; most lenses are within these limits."""


class SmoothZoom(AbstractPriorZoom):
    """Polynomials of high degree in 1/f for the coefficients, with a joint prior.

    ``k_i(f) = sum_j parameters[j, i] P_j(2u - 1)`` with Legendre's P_j and ``u = focal_ref/f`` in (0, 1]. A
    priori the parameters for j = 0, 1, 2 have the mean `mean` and the covariance ``quadratic quadratic^T``
    (flattened row by row), and those for each j from 3 to the degree, independently, the mean 0 and the
    covariance ``(3/j)^4 beyond beyond^T``.
    `error` sets the weight of the prior: see `AbstractPriorZoom`.

    The defaults are learned from the 618 rectilinear zooms that the lensfun database (of lensfunpy 1.18)
    has at five or more focal lengths. Learned from half of the lenses and tested on the other half, and the
    other way round, it predicts a focal length that was left out better in the median than all other zoom
    models here (docs/zoom-models.md, with what was chosen on all lenses); from two or three, `for_lens`,
    which knows more of the lens, predicts better still. They are for two coefficients of the radial
    polynomial; to first order, and so for weak lenses, those of the division model are the same with the
    other sign. With other `terms` the prior has to be given.
    The default `error` is 0.24 px at 4288 x 2848, by which hand calibrations are predicted best; a smaller
    one trusts each frame more.

    Attributes:
        degree: of the polynomials, at least 3.
        parameters: Legendre coefficients; None until fitted.
        focal_ref: the focal length that polynomials and prior are about: the shortest fitted, or of a prior
            with a mean the one that it is given with.
        error: RMS model error of a frame, in half diagonals; 0 for no prior.
        quadratic: lower triangular factor of the covariance of the first three rows of the parameters.
        beyond: the same for the fourth row.
        mean: of the first three rows of the parameters; None for zeros.

    Example:
        >>> import jax.numpy as jnp
        >>> zoom = SmoothZoom().prepare(jnp.array([18.0, 35.0]), terms=2)  # fewer than it has parameters
        >>> zoom.parameters.shape
        (7, 2)
    """

    formula: ClassVar[str] = (
        "k_i(f) = sum_j parameters[j][i-1] P_j(2 focal_ref / f - 1), P_j Legendre's polynomials; "
        "the rest is the prior"
    )
    elementwise: ClassVar[bool] = True
    degree: int = eqx.field(
        static=True, default=6, converter=lambda degree: checked_integer("degree", degree, 3)
    )
    parameters: Float[AnyArray, "basis terms"] | None = eqx.field(
        default=None, converter=numbers("parameters")
    )
    focal_ref: Scalar | None = eqx.field(default=None, converter=numbers("focal_ref"))
    error: Scalar = eqx.field(default=_ERROR, converter=numbers("error"))
    quadratic: Float[AnyArray, "low low"] = eqx.field(default=_QUADRATIC, converter=numbers("quadratic"))
    beyond: Float[AnyArray, "terms terms"] = eqx.field(default=_BEYOND, converter=numbers("beyond"))
    mean: Float[AnyArray, "3 terms"] | None = eqx.field(default=None, converter=numbers("mean"))

    @classmethod
    def for_lens(cls, shortest: float, longest: float, *, crop: float) -> "SmoothZoom":
        """The prior for a lens of which the range and the crop factor are known.

        Its mean and its error depend on them; both are learned from the same lenses. Lines then have their
        focal lengths in mm. They may show a part of the range: the polynomials are about `shortest`.

        Args:
            shortest, longest: the ends of the lens's own range, mm.
            crop: the crop factor of the images: 43.3 mm over the diagonal of their part of the sensor.

        Raises:
            ValueError: a number is not positive, or the range is none.

        Example:
            >>> zoom = SmoothZoom.for_lens(16.0, 50.0, crop=1.5)
            >>> zoom.mean.shape
            (3, 2)
        """
        weights = np.asarray(_OF_LENS) * facts_of(shortest, longest, crop)[:, None]
        *mean, log_error = weights.sum(axis=0)
        return cls(
            focal_ref=float(shortest),
            error=math.exp(log_error) * _ERROR_OF_LENS,
            quadratic=_QUADRATIC_OF_LENS,
            beyond=_BEYOND_OF_LENS,
            mean=np.reshape(mean, (3, 2)).tolist(),
        )

    def __check_init__(self):
        """Check the shapes of the prior and the parameters, which `beyond` gives the number of terms."""
        terms = self.beyond.shape[-1] if getattr(self.beyond, "shape", ()) else "terms"
        low = 3 * terms if isinstance(terms, int) else "low"
        check_shapes(
            {
                "beyond": (self.beyond, (terms, terms)),
                "quadratic": (self.quadratic, (low, low)),
                "parameters": (self.parameters, (self.degree + 1, terms)),
                "mean": (self.mean, (3, terms)),
                "focal_ref": (self.focal_ref, ()),
                "error": (self.error, ()),
            }
        )
        check_positive("focal_ref", self.focal_ref)
        check_not_negative("error", self.error)
        check_finite("quadratic", self.quadratic)
        check_finite("beyond", self.beyond)
        check_finite("mean", self.mean)

    def prepare(self, focal: Focal, terms: int) -> "SmoothZoom":
        """Zero polynomials about the shortest focal length, or about that of the mean.

        Any number of focal lengths will do.
        """
        if terms != self.beyond.shape[0]:
            raise ValueError(
                f"The prior of this SmoothZoom is for {self.beyond.shape[0]} terms, but {terms} are asked "
                "for: give it the arguments quadratic and beyond for them, or choose a PolynomialZoom."
            )
        dtype = jax.dtypes.canonicalize_dtype(focal.dtype)
        reference = None if self.mean is None else self.focal_ref  # a mean is about its own
        return SmoothZoom(
            degree=self.degree,
            parameters=zero_parameters(self.degree + 1, terms, dtype),
            focal_ref=shortest(focal) if reference is None else jnp.asarray(reference, dtype),
            error=self.error.astype(dtype),
            quadratic=self.quadratic.astype(dtype),
            beyond=self.beyond.astype(dtype),
            mean=None if self.mean is None else self.mean.astype(dtype),
        )

    def prepared_by(self, *settings: Float[AnyArray, "frame"]) -> Hashable:
        """The shortest focal length."""
        return np.asarray(settings[0]).min(initial=np.inf)

    def basis(self, focal: ScalarLike | Focal) -> Float[AnyArray, "basis ..."]:
        """``P_0, ..., P_degree`` of ``2u - 1``, by Bonnet's recursion."""
        if self.focal_ref is None:
            raise ValueError(UNFITTED)
        x = 2 * self.focal_ref / focal - 1
        values = [x**0, x]
        for j in range(2, self.degree + 1):
            values.append(((2 * j - 1) * x * values[-1] - (j - 1) * values[-2]) / j)
        return namespace(x).stack(values)

    def basis_pieces(self, focal_range: Float[AnyArray, "2"]) -> Pieces:
        """One piece, in 1/f."""
        if self.focal_ref is None:
            raise ValueError(UNFITTED)
        powers = inverse_powers(self.focal_ref, focal_range, self.degree)
        legendre = jnp.asarray(_in_powers(self.degree), powers.controls.dtype)
        controls = jnp.einsum("pcj,bj->pcb", powers.controls, legendre, precision="highest")
        size = jnp.matmul(jnp.abs(legendre), powers.size, precision="highest")
        return Pieces(controls, powers.ends, powers.focal_of, size)

    def standardised(self) -> Float[Array, "row"]:
        """The parameters, whitened by their prior."""
        if self.parameters is None:
            raise ValueError(UNFITTED)
        low, high = self.parameters[:3], self.parameters[3:]
        low = low if self.mean is None else low - self.mean
        order = np.arange(3, self.degree + 1) / 3
        scaled = high * jnp.asarray(order**2, high.dtype)[:, None]
        return jnp.concatenate(
            [
                solve_triangular(self.quadratic, low.reshape(-1), lower=True),
                solve_triangular(self.beyond, scaled.T, lower=True).T.reshape(-1),
            ]
        )


def facts_of(shortest: float, longest: float, crop: float) -> Float[np.ndarray, "fact"]:
    """What `SmoothZoom.for_lens` is linear in: 1, and logarithms of three numbers.

    These are the focal length of equal view on film at the wide end, the zoom ratio, and the crop factor.
    Beyond the limits of most lenses those limits take their place.
    """
    check_above(0, shortest=shortest, crop=crop)
    check_above(shortest, longest=longest)
    facts = np.clip([shortest * crop, longest / shortest, crop], *_MOST_LENSES)
    return np.concatenate([[1.0], np.log(facts / _TYPICAL_LENS)])


def _in_powers(degree: int) -> Float[np.ndarray, "basis power"]:
    """``P_j(2u - 1)`` by powers of u; all are integers."""
    rows = np.zeros((degree + 1, degree + 1))
    for j in range(degree + 1):
        for power in range(j + 1):
            rows[j, power] = (-1) ** (j + power) * math.comb(j, power) * math.comb(j + power, power)
    return rows
