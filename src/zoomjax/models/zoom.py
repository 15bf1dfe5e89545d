"""Zoom models: how the distortion coefficients depend on the focal length.

The paper's model is a polynomial in 1/f for each coefficient (eq. 9-10), ``k(f) = phi(f) . a`` with the
basis ``phi = (1, u, ..., u^n)`` of ``u = f_ref/f`` in (0, 1]. A new model is a final class of
`AbstractZoom`, or of `AbstractLinearZoom` if it is linear in its parameters. A linear model only defines
its basis, and the algebraic estimate applies to it.
"""

import abc
from collections.abc import Hashable
from typing import ClassVar, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree, ScalarLike

from .._core.arrays import as_jax, namespace
from .._core.checks import checked_integer
from .._core.fields import check_focal, check_positive, check_shapes, numbers
from .._core.types import AnyArray, Coefficients, Focal, Focus, Scalar, traced
from ._bernstein import Pieces, power_controls
from .distortion_model import AbstractDistortionModel, checked_terms

SomeZoom = TypeVar("SomeZoom", bound="AbstractZoom")


class AbstractZoom(eqx.Module):
    """A map from a focal length to the coefficients (k1, ..., kN) of the normalised radius.

    `parameters` are adjusted by a fit, and None in a model that is only specified, as in
    ``fit_zoom(lines, zoom=PolynomialZoom(degree=2))``. Other array fields are set by `prepare`. Lenses with
    a user-defined model can be saved once its class is registered (`register_model`), with a class
    attribute ``formula`` that describes its numbers.
    """

    formula: ClassVar[str]
    parameters: eqx.AbstractVar[PyTree]

    @abc.abstractmethod
    def prepare(self, focal: Focal, terms: int) -> "AbstractZoom":
        """Prepare the model for these focal lengths: set knots and references, and parameters to zero.

        Args:
            focal: of the frames, in any order.
            terms: the number of coefficients that it is to give at a focal length: all that the distortion
                model has, as k1, k2, p1 and p2.

        Raises:
            ValueError: the focal lengths cannot determine the parameters.
        """

    def prepared_by(self, *settings: Float[AnyArray, "frame"]) -> Hashable:
        """A key of what `prepare` uses of the frames' settings: equal keys, equal models.

        Cross-validation prepares a model once for each key. By default all of the settings are the key, and
        so they are for a class that defines `prepare` without this.

        Args:
            settings: as the first argument of `prepare`, and where it has one the focus. Values are known.
        """
        return tuple(np.asarray(values).tobytes() for values in settings)

    @abc.abstractmethod
    def __call__(self, focal: ScalarLike) -> Coefficients:
        """The coefficients at one focal length."""

    def pieces(self, focal_range: Float[AnyArray, "2"]) -> Pieces | None:
        """The coefficients from the shortest to the longest of these focal lengths, as polynomials.

        `certify` uses them to prove invertibility. None in a model that does not state them.
        """
        del focal_range
        return None


class AbstractLinearZoom(AbstractZoom):
    """A zoom model that is linear in its parameters: ``k(f) = basis(f) @ parameters``.

    Attributes:
        elementwise: whether `basis` also takes NumPy arrays of focal lengths, and returns one of NumPy,
            (basis, ...), if the model's arrays are NumPy's. Nothing is then compiled for cross-validation.
    """

    elementwise: ClassVar[bool] = False
    parameters: eqx.AbstractVar[Float[AnyArray, "basis terms"] | None]

    @abc.abstractmethod
    def basis(self, focal: ScalarLike) -> Float[AnyArray, "basis ..."]:
        """The values of the basis functions at one focal length."""

    def basis_pieces(self, focal_range: Float[AnyArray, "2"]) -> Pieces | None:
        """The basis functions over a range of focal lengths, as polynomials; see `AbstractZoom.pieces`."""
        del focal_range
        return None

    def __call__(self, focal: ScalarLike) -> Coefficients:
        """The coefficients at one focal length.

        Raises:
            ValueError: it is not one number, or known and not positive.
        """
        return _combined(self.basis(one_focal(focal)), _fitted(self))

    def pieces(self, focal_range: Float[AnyArray, "2"]) -> Pieces | None:
        """The coefficients over a range of focal lengths, as polynomials."""
        basis = self.basis_pieces(focal_range)
        if basis is None:
            return None
        parameters = jnp.asarray(_fitted(self))
        controls = jnp.einsum("pcb,bt->pct", basis.controls, parameters, precision="highest")
        size = jnp.matmul(1 + basis.size, jnp.abs(parameters), precision="highest")
        return Pieces(controls, basis.ends, basis.focal_of, size)


def one_focal(focal: ScalarLike) -> ScalarLike:
    """A focal length as it is, if it is one number, and positive where it is known.

    Of several a zoom model would mix the coefficients: `jax.vmap` calls it with each.
    """
    if isinstance(focal, list | tuple) or np.ndim(focal) != 0:
        raise ValueError(
            "Argument focal must be one focal length; jax.vmap(zoom)(focal) takes several, and so does a "
            f"lens, but its shape is {np.shape(focal)}."
        )
    check_focal("focal", focal if hasattr(focal, "dtype") else np.asarray(focal, float))
    return focal


def one_focus(focus: ScalarLike | None) -> ScalarLike | None:
    """A focus as it is, if it is one number, or None: of several a model would add up the coefficients."""
    if focus is not None and (isinstance(focus, list | tuple) or np.ndim(focus) != 0):
        raise ValueError(
            "Argument focus must be one number here, but its shape is "
            f"{np.shape(focus)}: lens(focal, focus) takes several, and so does jax.vmap."
        )
    return focus


def number_of_coefficients(zoom: AbstractZoom) -> int:
    """How many coefficients a fitted zoom model gives at one focal length; nothing is computed."""
    one = jax.ShapeDtypeStruct((), jnp.result_type(float))
    settings = (one, one) if isinstance(zoom, AbstractFocusZoom) else (one,)
    return jax.eval_shape(lambda *of: zoom(*of), *settings).shape[-1]


def _combined(basis, parameters):
    """``basis @ parameters``; few functions are written out, which XLA fuses with what uses them."""
    basis = as_jax(basis)
    if basis.shape[0] > _WRITTEN_OUT:
        return jnp.matmul(basis, parameters, precision="highest")
    coefficients = basis[0] * parameters[0]
    for value, row in zip(basis[1:], parameters[1:], strict=True):
        coefficients = coefficients + value * row
    return coefficients


_WRITTEN_OUT = 8
"""Basis functions up to which their sum is written out."""


class AbstractPriorZoom(AbstractLinearZoom):
    """A linear zoom model with a Gaussian prior on its parameters.

    A fit minimises the energy (eq. 13) plus ``error^2 / M`` times the sum of squares of the `standardised`
    parameters, for M frames: the mode of their posterior, if each frame has an RMS model error of `error`.
    So the prior loses weight as the number of frames grows, and with an error of 0 it has none.

    Attributes:
        error: RMS model error of a frame, in half image diagonals.
    """

    error: eqx.AbstractVar[Scalar]

    @abc.abstractmethod
    def standardised(self) -> Float[Array, "row"]:
        """The parameters as numbers that are independent a priori, of mean 0 and variance 1."""


class AbstractFocusZoom(AbstractLinearZoom):
    """A linear zoom model whose coefficients also depend on the focus: ``k(f, d)``.

    The focus d is any monotonic function of the focus distance, such as its reciprocal; lines have one per
    frame (``Lines.from_ragged(..., focus=...)``). `at_focus` gives the zoom model at one focus.
    """

    @abc.abstractmethod
    def prepare(self, focal: Focal, terms: int, focus: Focus | None = None) -> "AbstractFocusZoom":
        """This model made ready for these focal lengths and focuses, a pair a frame."""

    @abc.abstractmethod
    def basis(self, focal: ScalarLike, focus: ScalarLike | None = None) -> Float[Array, "basis"]:
        """The values of the basis functions at one focal length and focus."""

    @abc.abstractmethod
    def at_focus(self, focus: ScalarLike) -> AbstractLinearZoom:
        """The model of the focal length alone that this one is at one focus."""

    def __call__(self, focal: ScalarLike, focus: ScalarLike | None = None) -> Coefficients:
        """The coefficients at one focal length and focus.

        Raises:
            ValueError: the focus is missing or not one number, or the focal length is not one positive
                number.
        """
        return _combined(self.basis(one_focal(focal), one_focus(focus)), _fitted(self))


class PolynomialZoom(AbstractLinearZoom):
    """The paper's model: a polynomial of `degree` n in 1/f for each coefficient (eq. 9-10).

    Attributes:
        degree: n; 0 means the same distortion at all focal lengths; the paper uses 2.
        parameters: a, where ``k_i(f) = sum_j a[j, i] (focal_ref/f)^j``; None until fitted.
        focal_ref: the shortest focal length fitted.

    Example:
        >>> import jax.numpy as jnp
        >>> zoom = PolynomialZoom(1, jnp.array([[0.0], [0.1]]), jnp.array(20.0))
        >>> zoom(jnp.array(40.0)).tolist()
        [0.05000000074505806]
    """

    formula: ClassVar[str] = "k_i(f) = sum_j parameters[j][i-1] * (focal_ref / f)^j"
    elementwise: ClassVar[bool] = True
    degree: int = eqx.field(
        static=True, default=2, converter=lambda degree: checked_integer("degree", degree, 0)
    )
    parameters: Float[AnyArray, "basis terms"] | None = eqx.field(
        default=None, converter=numbers("parameters")
    )
    focal_ref: Scalar | None = eqx.field(default=None, converter=numbers("focal_ref"))

    def __check_init__(self):
        """Check the parameters' shape: a row for each power, 0 to the degree."""
        check_shapes(
            {"parameters": (self.parameters, (self.degree + 1, "terms")), "focal_ref": (self.focal_ref, ())}
        )
        check_positive("focal_ref", self.focal_ref)

    @classmethod
    def from_inverse_focal(
        cls, coefficients: Float[AnyArray, "basis terms"], focal_ref: ScalarLike
    ) -> "PolynomialZoom":
        """The model ``k_i(f) = sum_j coefficients[j, i] f^(-j)``, stated about `focal_ref`."""
        coefficients = jnp.asarray(numbers("coefficients")(coefficients))
        check_shapes({"coefficients": (coefficients, ("basis", "terms"))})
        focal_ref = jnp.asarray(focal_ref, coefficients.dtype)
        power = jnp.arange(coefficients.shape[0])
        return cls(
            degree=coefficients.shape[0] - 1,
            parameters=coefficients * focal_ref ** -power[:, None].astype(coefficients.dtype),
            focal_ref=focal_ref,
        )

    def in_inverse_focal(self) -> Float[Array, "basis terms"]:
        """The polynomials' coefficients of ``f^(-j)``, as the paper prints them (but normalised)."""
        parameters, reference = _fitted(self), self.focal_ref
        if not traced((parameters, reference)):  # by NumPy, which compiles nothing
            parameters, reference = np.asarray(parameters), np.asarray(reference)
        power = np.arange(self.degree + 1).astype(parameters.dtype)
        return as_jax(parameters * reference ** power[:, None])

    def prepare(self, focal: Focal, terms: int) -> "PolynomialZoom":
        """Zero polynomials about the shortest focal length."""
        if not traced(focal):
            check_distinct(f"A polynomial of degree {self.degree} in 1/f", focal, self.degree + 1)
            focal = np.asarray(focal)  # its minimum then compiles nothing
        return PolynomialZoom(
            degree=self.degree,
            parameters=as_jax(np.zeros((self.degree + 1, terms), focal.dtype)),
            focal_ref=as_jax(focal.min()),
        )

    def prepared_by(self, *settings: Float[AnyArray, "frame"]) -> Hashable:
        """The shortest focal length, and how many differ, as far as more are needed."""
        focal = np.asarray(settings[0])
        return focal.min(initial=np.inf), min(np.unique(focal).size, self.degree + 1)

    def basis(self, focal: ScalarLike | Focal) -> Float[AnyArray, "basis ..."]:
        """``(1, u, ..., u^n)`` with ``u = focal_ref/f``."""
        if self.focal_ref is None:
            raise ValueError(UNFITTED)
        u = self.focal_ref / focal
        return namespace(u).stack([u**j for j in range(self.degree + 1)])

    def basis_pieces(self, focal_range: Float[AnyArray, "2"]) -> Pieces:
        """One piece, in 1/f."""
        if self.focal_ref is None:
            raise ValueError(UNFITTED)
        return inverse_powers(self.focal_ref, focal_range, self.degree)


def inverse_powers(focal_ref: ScalarLike, focal_range: Float[AnyArray, "2"], degree: int) -> Pieces:
    """The powers of ``focal_ref / f`` over a range of focal lengths: one piece."""
    ends = 1 / jnp.asarray(focal_range)[::-1]
    controls = power_controls(focal_ref * ends[0], focal_ref * ends[1], degree)
    return Pieces(controls[None], ends[None], jnp.reciprocal, controls[-1])


def with_parameters(zoom: SomeZoom, parameters: PyTree) -> SomeZoom:
    """The same model with other parameters."""
    return eqx.tree_at(lambda model: model.parameters, zoom, parameters, is_leaf=lambda leaf: leaf is None)


def terms_of(zoom: AbstractZoom, terms: int | None, distortion_model: AbstractDistortionModel) -> int:
    """The number N of radial coefficients that is asked for; by default the model's own, or else 2.

    Raises:
        ValueError: it is none, or the parameters of the model are for another number.
    """
    own, besides = None, distortion_model.num_coefficients(0)
    if zoom.parameters is not None:
        given = (1.0, 1.0) if isinstance(zoom, AbstractFocusZoom) else (1.0,)
        own = jax.eval_shape(zoom, *given).shape[0] - besides
    terms = (2 if own is None else own) if terms is None else terms
    terms = checked_terms(terms, distortion_model.most_terms)
    if own not in (None, terms):
        raise ValueError(
            f"Argument terms is {terms}, but the parameters of zoom are for {own}: give that number, or "
            "start from a model without parameters."
        )
    return terms


def check_distinct(what: str, focal: Focal, least: int) -> None:
    """Raise ValueError where there are fewer distinct focal lengths than a model needs."""
    distinct = np.unique(np.asarray(focal)).size
    if distinct < least:
        raise ValueError(
            f"{what} needs {least} or more distinct focal lengths, but there are {distinct}. Choose a "
            "model with fewer parameters (a lower degree, say), or add images at other focal lengths."
        )


UNFITTED = (
    "This zoom model has been specified but not fitted: pass it to fit_zoom(lines, zoom=...), and "
    "use the model in the result, fit.lens.zoom."
)


def _fitted(zoom: AbstractZoom) -> PyTree:
    if zoom.parameters is None:
        raise ValueError(UNFITTED)
    return zoom.parameters
