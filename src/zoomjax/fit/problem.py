"""The problem that lines pose: their data, the distortion model that corrects them, and the metric.

A data set by itself is a problem, too: that of the paper, the radial polynomial with distances in the
corrected image. `with_distortion_model`, `in_image` and the fit of the centre make others of it. Energies,
fits and cross-validation take all of them alike, through `AbstractLines`.

Uncompressed points are corrected by the model's own formula. Compressed lines stand for powers, in which
corrected points are linear: so are they in the coefficients of `BrownConrady`, by the triangles for any
centre, which hold all monomials; those of `Division` become the 8 of a polynomial, as good as exact
(`Division.expansion`).
"""

from operator import attrgetter
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._core.types import Centres, traced
from ..lines.base import AbstractLines, Metric
from ..lines.best_line import line_normal
from ..lines.compressed import CompressedLines, compress
from ..lines.free_centre import AnyCentreLines, compress_any_centre
from ..lines.lines import Lines, corrected_points
from ..lines.stretch import stretch_of_points
from ..models.distortion_model import AbstractDistortionModel, AbstractRadial
from ..models.polynomial import RadialPolynomial

LEAST_STRETCH = 1e-4
"""Of the squared stretch. Beyond a fold, where it may vanish, nothing is to be gained either."""


def _of_data(name: str) -> Any:
    return property(attrgetter(f"lines.{name}"))


class Problem(AbstractLines):
    """Lines to be corrected by a distortion model, with distances in a metric: made by `posed`.

    Attributes:
        lines: the data set, compressed or not.
        corrected_by: the distortion model.
        measured_in: "corrected" or "distorted": the image in which distances are measured.
        any_centre: whether the last two coefficients are the offset of the centre, normalised.
    """

    lines: Any
    corrected_by: AbstractDistortionModel
    measured_in: Metric = eqx.field(static=True)
    any_centre: bool = eqx.field(static=True)

    frame = _of_data("frame")
    focal = _of_data("focal")
    focus = _of_data("focus")
    centre = _of_data("centre")
    image_size = _of_data("image_size")
    focal_unit = _of_data("focal_unit")
    number = _of_data("number")
    weight = _of_data("weight")

    @property
    def distortion_model(self) -> AbstractDistortionModel:
        """What the coefficients mean."""
        return self.corrected_by

    @property
    def metric(self) -> Metric:
        """The image in which distances are measured."""
        return self.measured_in

    @property
    def counts(self) -> Float[Array, "line"]:
        """Number of points of each line."""
        return self.lines.counts

    def second_moments(self, order: int) -> Float[Array, "line moment 2 2"]:
        """``sum_p r_p^(2i) z_p z_p^T`` of the points as they were seen."""
        return self.lines.second_moments(order)

    def corrected(self, coefficients: Float[Array, "frame size"]) -> Float[Array, "line rows 2"]:
        """Corrected points of each line about their mean, px, or rows with the same scatter.

        Measured in the distorted image, they are divided by the stretch across the line.

        Raises:
            ValueError: the lines were compressed for another distortion model, or for fewer terms.
        """
        rows = self._corrected(coefficients)
        if self.metric == "corrected":
            return rows
        squared = self.squared_stretch(coefficients, jax.vmap(line_normal)(rows))
        return rows / jnp.sqrt(jnp.maximum(squared, LEAST_STRETCH))[:, None, None]

    def _corrected(self, coefficients):
        if isinstance(self.lines, Lines):
            lines, k = self._moved(coefficients)
            return corrected_points(lines, self.distortion_model, k)
        if self.any_centre:
            return self.lines.corrected(self._powers_and_offset(coefficients))
        self._check(coefficients.shape[1])
        powers, tangential = self.in_powers(coefficients)
        if isinstance(self.lines, AnyCentreLines):
            return self.lines.decentred(powers, tangential)
        return self.lines.corrected(powers)

    def squared_stretch(
        self, coefficients: Float[Array, "frame size"], normals: Float[Array, "line 2"]
    ) -> Float[Array, "line"]:
        """The mean of ``|J^T n|^2`` over each line's points."""
        if isinstance(self.lines, AnyCentreLines):
            if self.any_centre:
                return self.lines.squared_stretch(self._powers_and_offset(coefficients), normals)
            self._check(coefficients.shape[1])
            return self.lines.decentred_stretch(*self.in_powers(coefficients), normals)
        if isinstance(self.distortion_model, AbstractRadial) and not self.any_centre:
            return super().squared_stretch(coefficients, normals)
        assert isinstance(self.lines, Lines)
        lines, k = self._moved(coefficients)
        z = (jnp.asarray(lines.points) - lines.centre[None, None]) / self.scale
        of_line = jax.vmap(stretch_of_points, in_axes=(0, 0, 0, 0, None))
        return of_line(z, jnp.asarray(lines.mask), k[lines.frame], normals, self.distortion_model)

    def _moved(self, coefficients):
        """Points as the centre of each frame sees them, and coefficients without the centre's offset."""
        if not self.any_centre:
            return self.lines, coefficients
        k, offset = coefficients[:, :-2], coefficients[:, -2:]
        assert isinstance(self.lines, Lines)
        moved = jnp.asarray(self.lines.points) - self.scale * offset[self.frame][:, None]
        return eqx.tree_at(lambda of: of.points, self.lines, moved), k

    def _powers_and_offset(self, coefficients):
        """The radial polynomial that is the model up to the corner farthest from each centre, and it."""
        assert isinstance(self.lines, AnyCentreLines)
        needed = self.distortion_model.expansion_terms(coefficients.shape[1] - 2)
        if self.lines.terms < needed:
            raise ValueError(
                f"{type(self.distortion_model).__name__} needs lines compressed for any centre and "
                f"{needed} terms, but they are for {self.lines.terms}: "
                f"compress_any_centre(lines, terms={needed}), or pass the lines themselves."
            )
        far = jnp.maximum(self.centre, jnp.asarray(self.image_size) - 1 - self.centre) / self.scale

        def of_frame(k):
            reach = far + jnp.abs(k[-2:])
            return jnp.concatenate(
                [jnp.asarray(self.distortion_model.expansion(k[:-2], reach @ reach)[0]), k[-2:]]
            )

        return jax.vmap(of_frame)(coefficients)

    def _check(self, size):
        """Refuse lines that were compressed for something else."""
        if isinstance(self.distortion_model, RadialPolynomial):
            return  # the lines say it themselves
        name = type(self.distortion_model).__name__
        needed = self.distortion_model.expansion_terms(size)
        enough = needed <= getattr(self.lines, "terms", 0)
        if isinstance(self.distortion_model, AbstractRadial):
            if not (isinstance(self.lines, CompressedLines) and enough):
                raise ValueError(
                    f"{name} needs lines compressed for {needed} terms about a fixed centre, but they are "
                    f"not: compress(lines, terms={needed}), or pass the lines themselves."
                )
        elif not (isinstance(self.lines, AnyCentreLines) and enough):
            raise ValueError(
                f"{name} is not radial, and needs lines compressed with all monomials for {needed} terms, "
                f"but are not: compress_any_centre(lines, terms={needed}), or pass the lines themselves."
            )

    def compressed(self, terms: int) -> AbstractLines:
        """The same problem of compressed lines, unless they are."""
        if not isinstance(self.lines, Lines):
            return self
        reduce = compress if isinstance(self.distortion_model, AbstractRadial) else compress_any_centre
        needed = self.distortion_model.expansion_terms(self.distortion_model.num_coefficients(terms))
        return self._of(reduce(self.lines, needed))

    def about(self, centre: Centres) -> AbstractLines:
        """The same about a fixed centre of distortion, px; see `AbstractLines.about`."""
        if isinstance(self.lines, AnyCentreLines) and not isinstance(self.distortion_model, AbstractRadial):
            same = not traced((self.centre, centre)) and np.array_equal(self.centre, centre)
            return self if same else self._of(self.lines.moved(centre))
        return self._of(self.lines.about(centre))

    def take(self, lines: Int[Array, "some"], present: Bool[Array, "some"]) -> AbstractLines:
        """The chosen lines as a data set of one frame."""
        return self._of(self.lines.take(lines, present), self.any_centre)

    def _of(self, lines: AbstractLines, any_centre: bool = False) -> AbstractLines:
        return posed(lines, self.distortion_model, self.metric, any_centre=any_centre)


def posed(
    lines: AbstractLines,
    distortion_model: AbstractDistortionModel | None = None,
    metric: Metric | None = None,
    *,
    any_centre: bool | None = None,
) -> AbstractLines:
    """The problem of lines, or another problem with what is given changed.

    The problem of the paper is the data set itself.

    Args:
        lines: a data set, or a problem.
        distortion_model: the distortion model.
        metric: the image in which distances are measured.
        any_centre: whether the last two coefficients are the offset of the centre. Under the radial
            polynomial, those of `AnyCentreLines` are, whatever is asked.
    """
    if distortion_model is None and any_centre is None and metric in (None, lines.metric):
        return lines
    data = data_of(lines)
    distortion_model = lines.distortion_model if distortion_model is None else distortion_model
    metric = lines.metric if metric is None else metric
    if any_centre is None:
        any_centre = isinstance(lines, Problem) and lines.any_centre
    polynomial = isinstance(distortion_model, RadialPolynomial)
    own = polynomial and isinstance(data, AnyCentreLines)
    if polynomial and metric == "corrected" and (own or not any_centre):
        return data
    make: Any = Problem  # whose other fields are properties
    return make(data, distortion_model, metric, any_centre or own)


def data_of(lines: AbstractLines) -> Any:
    """The data set of a problem: `Lines`, or compressed."""
    return lines.lines if isinstance(lines, Problem) else lines


def about_own_centre(lines: AbstractLines) -> AbstractLines:
    """The lines as functions of a distortion take them: about a fixed centre."""
    return lines.about(lines.centre) if isinstance(data_of(lines), AnyCentreLines) else lines
