"""The interface of line sets for energies and fits.

For any distortion coefficients, `AbstractLines` gives the corrected points of each line about their mean,
or rows that are exactly equivalent.
"""

import abc
import math
from typing import Any, Literal, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from .._core.checks import (
    checked_size,
    checked_unit,
)
from .._core.fields import (
    check_finite,
    check_focal,
    check_indices,
    check_not_negative,
    check_shapes,
    refuse_masked,
)
from .._core.types import (
    AnyArray,
    Centres,
    Focal,
    Focus,
    FrameIndex,
    LineWeight,
    Point,
    traced,
)
from ..models.distortion_model import AbstractDistortionModel
from ..models.polynomial import RadialPolynomial
from .stretch import radial_stretch

SomeLines = TypeVar("SomeLines", bound="AbstractLines")

Metric = Literal["corrected", "distorted"]
"""The image in which distances of points to their lines are measured."""


class AbstractLines(eqx.Module):
    """Lines seen in frames of known focal length, as the energies of eq. 3 and 13 need them."""

    frame: eqx.AbstractVar[FrameIndex]
    focal: eqx.AbstractVar[Focal]
    focus: eqx.AbstractVar[Focus | None]
    centre: eqx.AbstractVar[Point]
    image_size: eqx.AbstractVar[tuple[int, int]]
    focal_unit: eqx.AbstractVar[str]
    weight: eqx.AbstractVar[LineWeight | None]

    def __check_init__(self):
        """Check what all kinds of lines have."""
        checked_size(self.image_size)
        checked_unit(self.focal_unit)
        check_shapes(
            {
                "frame": (self.frame, ("line",)),
                "weight": (self.weight, ("line",)),
                "focal": (self.focal, ("frame",)),
                "focus": (self.focus, ("frame",)),
                "centre": (self.centre, (2,)),
            }
        )
        check_focal("focal", self.focal)
        check_finite("focus", self.focus)
        check_finite("centre", self.centre)
        check_not_negative("weight", self.weight)
        if hasattr(self.focal, "shape"):
            check_indices("frame", self.frame, self.focal.shape[-1], "one focal length each")

    @property
    def scale(self) -> float:
        """The length in px that is radius 1: half the image diagonal."""
        return math.hypot(*self.image_size) / 2

    @property
    def distortion_model(self) -> AbstractDistortionModel:
        """The distortion model of the coefficients: the radial polynomial, unless a problem has another."""
        return RadialPolynomial()

    @property
    def metric(self) -> Metric:
        """The image in which distances are measured: the corrected one, unless a problem says otherwise."""
        return "corrected"

    def in_powers(
        self, coefficients: Float[Array, "some size"]
    ) -> tuple[Float[Array, "some power"], Float[Array, "some tangential"]]:
        """The coefficients as those of powers, in which corrected points are linear, up to the corners."""
        far = jnp.maximum(self.centre, jnp.asarray(self.image_size) - 1 - self.centre) / self.scale
        expand = jax.vmap(lambda k: self.distortion_model.expansion(k, far @ far))
        powers, tangential = expand(coefficients)
        return jnp.asarray(powers), jnp.asarray(tangential)

    @property
    @abc.abstractmethod
    def counts(self) -> Float[Array, "line"]:
        """Number of points of each line, Np(l, m); 0 marks a line that is not there."""

    @abc.abstractmethod
    def corrected(self, coefficients: Float[Array, "frame size"]) -> Float[Array, "line rows 2"]:
        """Corrected points of each line about their mean, px, or rows with the same scatter.

        `coefficients` are those of each frame. Rows beyond a line's end are zero.
        """

    @abc.abstractmethod
    def second_moments(self, order: int) -> Float[Array, "line moment 2 2"]:
        """``sum_p r_p^(2i) z_p z_p^T`` for i = 0 ... order - 1, over each line's points, normalised."""

    def radial_moments(self, order: int) -> Float[Array, "line moment"]:
        """``sum_p r_p^(2i)`` for i = 0 ... order, over the points of each line, normalised."""
        traces = jnp.trace(self.second_moments(order), axis1=2, axis2=3)
        return jnp.concatenate([self.counts[:, None].astype(traces.dtype), traces], axis=1)

    def squared_stretch(
        self, coefficients: Float[Array, "frame size"], normals: Float[Array, "line 2"]
    ) -> Float[Array, "line"]:
        """The mean of ``|J^T n|^2`` over each line's points: see `zoomjax.fit.in_image`.

        J is the derivative of the correction by the frame's coefficients. By moments: for radial models.
        """
        powers, _ = self.in_powers(coefficients)
        moments = self.second_moments(2 * powers.shape[1])
        return jax.vmap(radial_stretch)(powers[self.frame], normals, moments, self.counts)

    @abc.abstractmethod
    def about(self, centre: Centres) -> "AbstractLines":
        """The same lines about another centre of distortion, px: that of all frames, or of each frame.

        Raises:
            ValueError: the lines were compressed for another centre.
        """

    @abc.abstractmethod
    def take(self, lines: Int[Array, "some"], present: Bool[Array, "some"]) -> "AbstractLines":
        """The chosen lines as a data set of one frame; those not `present` count as empty."""

    def weighted(self: SomeLines, weight: ArrayLike) -> SomeLines:
        """The same lines with a weight each, relative to the other lines of the frame.

        Raises:
            ValueError: `weight` does not hold one finite number of at least 0 for each line.
        """
        refuse_masked("weight", weight)
        dtype = jax.dtypes.canonicalize_dtype(self.focal.dtype)
        if isinstance(weight, jax.Array) or traced(weight):
            values = jnp.asarray(weight, dtype)
        else:
            given = np.asarray(weight)
            if given.dtype.kind not in "biuf":
                raise ValueError(f"Argument weight must hold real numbers, but its dtype is {given.dtype}.")
            given = self._in_range_of(given, dtype)
            values = jax.device_put(given.astype(dtype))  # unlike jnp.asarray this compiles nothing
        if values.shape != self.frame.shape:
            raise ValueError(
                f"Argument weight must hold one number for each of the {self.frame.shape[0]} lines, but "
                f"its shape is {values.shape}."
            )
        if not traced(values) and not (np.isfinite(values) & (np.asarray(values) >= 0)).all():
            raise ValueError("Argument weight must hold finite numbers of at least 0, but it does not.")
        return eqx.tree_at(lambda lines: lines.weight, self, values, is_leaf=lambda leaf: leaf is None)

    def _in_range_of(self, weight, dtype):
        """Weights divided by the largest of their frame where they are beyond the numbers of a dtype."""
        limits, size = jnp.finfo(dtype), np.abs(weight.astype(float))
        beyond = (size > float(limits.max)) | ((size < float(limits.tiny)) & (size > 0))
        if not beyond.any() or weight.shape != self.frame.shape or traced(self.frame):
            return weight
        frame, largest = np.asarray(self.frame), np.zeros(self.focal.shape[0])
        np.maximum.at(largest, frame, np.where(np.isfinite(size), size, 0))
        return weight / np.where(largest > 0, largest, 1)[frame]

    def by_frame(self) -> tuple[Int[AnyArray, "frame some"], Bool[AnyArray, "frame some"]]:
        """For each frame the indices of its lines, padded to the largest frame, and a mask of real entries.

        Computed in NumPy, because the padding is a shape. Under ``jit``, where `frame` is not known, every
        frame gets all lines and selects by the mask.
        """
        frames, number = self.focal.shape[0], self.frame.shape[0]
        if traced(self.frame):
            chosen = jnp.broadcast_to(jnp.arange(number), (frames, number))
            return chosen, self.frame[None] == jnp.arange(frames)[:, None]
        frame = np.asarray(self.frame)
        order = np.argsort(frame, kind="stable")
        size = np.bincount(frame, minlength=frames)
        start = np.cumsum(size) - size
        slot = np.arange(size.max())
        chosen = order[np.minimum(start[:, None] + slot, number - 1)]
        return chosen, slot < size[:, None]


def check_rows(coefficients: Float[Array, "..."], focal: Focal) -> None:
    """Refuse coefficients that are not of all frames: JAX takes the last row for those that are missing."""
    if coefficients.ndim != 2 or coefficients.shape[0] != focal.shape[0]:
        raise ValueError(
            f"Argument coefficients must have a row for each of the {focal.shape[0]} frames, but its "
            f"shape is {coefficients.shape}."
        )


def header_of(lines: AbstractLines) -> dict[str, Any]:
    """All that lines are beside their points: what another form of the same lines takes over."""
    names = ("frame", "focal", "centre", "image_size", "focal_unit", "number", "weight", "focus")
    return {name: getattr(lines, name) for name in names}


def one_frame(
    lines: AbstractLines, chosen: Int[Array, "some"], present: Bool[Array, "some"]
) -> dict[str, Any]:
    """The header of the chosen lines as a data set of one frame."""
    header, frame = header_of(lines), lines.frame[chosen[jnp.argmax(present)]]
    of_lines = {name: None if (of := header[name]) is None else of[chosen] for name in ("number", "weight")}
    of_frame = {
        name: None if (of := header[name]) is None else jnp.asarray(of)[frame][None]
        for name in ("focal", "focus")
    }
    return header | of_lines | of_frame | {"frame": jnp.zeros_like(chosen, jnp.int32)}
