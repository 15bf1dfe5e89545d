"""Line primitives: sequences of image points that lie on straight lines of the scene.

`Lines` holds the points themselves, flat over lines (not nested in frames, which hold from 5 to 108 lines:
nesting would waste 27 times the memory on the paper's data). Compressed lines are in `compressed`.
"""

import os
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from .._core.arguments import check_kind, kinds_checked
from .._core.arrays import held_as_given
from .._core.checks import (
    checked_centre,
    checked_focal,
    checked_focus,
    checked_frames,
    checked_points,
    checked_size,
    checked_unit,
    has_three_distinct,
    usable_lines,
    warn_of_points_outside,
    warn_of_units,
)
from .._core.fields import (
    booleans,
    check_finite,
    check_present,
    check_shapes,
    integers,
    known,
    numbers,
    real_argument,
    refuse_masked,
    settings,
)
from .._core.files import whole_file
from .._core.products import EXACT
from .._core.steps import packed
from .._core.types import AnyArray, Centres, Focal, Focus, FrameIndex, LineNumber, LineWeight, Mask, Point
from ..models.distortion_model import AbstractDistortionModel
from .base import AbstractLines, check_rows, one_frame

FORMAT, VERSION = "zoomjax.lines", 2


class Lines(AbstractLines):
    """Line primitives as padded tensors; `Lines.from_ragged` makes them from sequences and checks them.

    Arrays are JAX arrays in the dtype given. Where JAX cannot hold it (float64 while x64 is off) they
    stay NumPy arrays, so that nothing is lost on saving, and computations run in float32.

    Attributes:
        points: ``(x, y)`` px; (0, 0) is the centre of the top-left pixel.
        mask: which entries of `points` are points rather than padding.
        frame: index of the image that each line was seen in, into `focal`.
        focal: focal length of each image, positive, in `focal_unit`. Those that differ by less than a
            millionth, as by rounding, are one: the least of them.
        centre: centre of distortion, px; the image's centre ``((w-1)/2, (h-1)/2)`` by default.
        image_size: (width, height) px.
        focal_unit: "mm" or "px".
        number: position of each line among those that `from_ragged` was given; None if unknown.
        weight: weight of each line relative to the others of its frame, at least 0; None for equal weights.
        focus: focus of the lens in each image, for models that depend on it (`AbstractFocusZoom`): any
            monotonic function of the focus distance, such as its reciprocal; None if unknown.
    """

    points: Float[AnyArray, "line point 2"] = eqx.field(converter=numbers("points"))
    mask: Mask = eqx.field(converter=booleans("mask"))
    frame: FrameIndex = eqx.field(converter=integers("frame"))
    focal: Focal = eqx.field(converter=settings("focal"))
    centre: Point = eqx.field(converter=numbers("centre"))
    image_size: tuple[int, int] = eqx.field(static=True, converter=checked_size)
    focal_unit: str = eqx.field(static=True, default="mm")
    number: LineNumber | None = eqx.field(default=None, converter=integers("number"))
    weight: LineWeight | None = eqx.field(default=None, converter=numbers("weight"))
    focus: Focus | None = eqx.field(default=None, converter=settings("focus"))

    def __check_init__(self):
        """Check that the shapes agree, and that points are numbers where they are few."""
        check_shapes(
            {
                "points": (self.points, ("line", "point", 2)),
                "mask": (self.mask, ("line", "point")),
                "frame": (self.frame, ("line",)),
                "number": (self.number, ("line",)),
            }
        )
        needed = ("points", "mask", "frame", "focal", "centre")
        check_present({name: getattr(self, name) for name in needed})
        points, mask = known(self.points), known(self.mask)
        if points is not None and mask is not None and not np.isfinite(points).all():
            bad = np.argwhere(mask & ~np.isfinite(points).all(axis=-1))
            if bad.size:
                where = ", ".join(map(str, bad[0]))
                raise ValueError(
                    f"Argument points must be finite where mask is set, but points[{where}] is "
                    f"{points[tuple(bad[0])]}: remove such points, or clear their mask."
                )

    @classmethod
    @kinds_checked
    def from_ragged(
        cls,
        points: Iterable[ArrayLike],
        frame: ArrayLike,
        focal: ArrayLike,
        *,
        image_size: Sequence[int],
        focal_unit: str = "mm",
        centre: ArrayLike | None = None,
        focus: ArrayLike | None = None,
        chunk: bool = False,
    ) -> "Lines":
        """Make lines from one array of points per line.

        Args:
            points: for each line an (n, 2) array of ``(x, y)`` px, n >= 3.
            frame: for each line the index of its image, into `focal`.
            focal: for each image its focal length, > 0.
            image_size: (width, height) px.
            focal_unit: "mm" or "px", the unit of `focal`.
            centre: centre of distortion, px; default the centre of the image.
            focus: for each image the focus of the lens, a finite number such as 1/distance, or None.
            chunk: whether these are only some of the lines' points, to be compressed and merged with
                others. Then every line is kept, even without points.

        Raises:
            ValueError: a point or focal length is not finite, a focal length is not positive, a frame
                index is out of range, a frame has no line, or no usable line is left.

        Warns:
            UserWarning: lines with fewer than 3 distinct points are dropped; the message counts them. Or
                points lie outside of the image, or all within two px of one another, as if they were not
                in px.

        Example:
            >>> import numpy as np
            >>> row = np.stack([np.arange(5.0), np.full(5, 2.0)], axis=-1)
            >>> lines = Lines.from_ragged([row, row + 1], [0, 1], [24, 70], image_size=(6, 4))
            >>> lines.points.shape, lines.centre.tolist()
            ((2, 5, 2), [2.5, 1.5])
        """
        size, unit = checked_size(image_size), checked_unit(focal_unit)
        arrays = [checked_points(line, index) for index, line in enumerate(points)]
        focals = checked_focal(focal)
        frames = checked_frames(frame, len(arrays), focals.size)
        number = np.arange(len(arrays))
        if not chunk:
            number = usable_lines(arrays, frames, focals.size)
            arrays, frames = [arrays[index] for index in number], frames[number]

        dtype = np.result_type(*arrays)
        counts = np.array([len(line) for line in arrays])
        padded = np.zeros((len(arrays), max(counts), 2), dtype)
        for row, line in zip(padded, arrays, strict=True):
            row[: len(line)] = line
        mask = np.arange(max(counts)) < counts[:, None]
        warn_of_points_outside(padded, mask, size)
        if not chunk:
            warn_of_units(padded, mask, size)
        return cls(
            points=held_as_given(padded),
            mask=held_as_given(mask),
            frame=held_as_given(frames.astype(np.int32)),
            focal=held_as_given(focals.astype(dtype)),
            centre=held_as_given(checked_centre(centre, size).astype(dtype)),
            image_size=size,
            focal_unit=unit,
            number=held_as_given(number.astype(np.int32)),
            focus=None if focus is None else held_as_given(checked_focus(focus, focals.size).astype(dtype)),
        )

    @classmethod
    def from_grids(
        cls,
        corners: Float[np.ndarray, "grid row column 2"],
        frame: ArrayLike,
        focal: ArrayLike,
        *,
        image_size: Sequence[int],
        focal_unit: str = "mm",
    ) -> "Lines":
        """Make a line of every row and every column of flat grids (checkerboard corners, dots).

        Args:
            corners: positions of the grids' nodes, px.
            frame: for each grid the index of the frame that it counts in. Grids at the same focal
                length may share a frame: eq. 3 then averages over all their lines.
            focal, image_size, focal_unit: as for `from_ragged`, whose errors also apply.
        """
        for name, values in {"corners": corners, "frame": frame}.items():
            refuse_masked(name, values)
        corners = np.asarray(corners)
        if corners.ndim != 4 or corners.shape[-1] != 2:
            raise ValueError(
                "Argument corners must have shape (grid, row, column, 2), but its shape is "
                f"{corners.shape}."
            )
        index = np.asarray(frame)
        if index.shape != corners.shape[:1]:
            raise ValueError(
                f"Argument frame must hold one index for each of the {len(corners)} grids, but its "
                f"shape is {index.shape}."
            )
        lines: list[ArrayLike] = []
        for grid in corners:
            lines += [*grid, *grid.swapaxes(0, 1)]
        return cls.from_ragged(
            lines,
            np.repeat(index, corners.shape[1] + corners.shape[2]),
            focal,
            image_size=image_size,
            focal_unit=focal_unit,
        )

    def to_ragged(self) -> list[np.ndarray]:
        """The points of each line as an (n, 2) array, as for `from_ragged`."""
        check_kind("lines", self, (Lines,))
        mask = np.asarray(self.mask)
        return [line[keep] for line, keep in zip(np.asarray(self.points), mask, strict=True)]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all fields, in their dtypes, to a ``.npz`` file that `load_lines` reads.

        Points that are whole steps of 1/1024 px, as detectors give them, take a tenth of the space.

        Raises:
            OSError: the file cannot be written; nothing is left of it.
            ValueError: a frame has no line of three distinct points, without which the file could not be
                read.
        """
        check_kind("path", path, (str, os.PathLike))
        there = np.zeros(len(self.focal), bool)
        there[np.asarray(self.frame)[[has_three_distinct(line) for line in self.to_ragged()]]] = True
        if not (there.size and there.all()):
            raise ValueError(
                f"{np.sum(~there)} of {there.size} frames have no line of three distinct points: leave "
                "them out before the lines are saved."
            )
        optional: dict[str, Any] = {"weight": self.weight, "focus": self.focus, "number": self.number}
        fields: dict[str, Any] = {
            name: np.asarray(value) for name, value in optional.items() if value is not None
        }
        points = np.asarray(self.points)[np.asarray(self.mask)]
        small = packed(points)
        stored: dict[str, Any] = {"points": points} if small is None else small
        with whole_file(path) as part, part.open("wb") as file:
            (np.savez if small is None else np.savez_compressed)(
                file,
                **fields,
                **stored,
                format=FORMAT,
                version=1 if small is None else VERSION,  # older readers know points alone
                counts=np.asarray(self.mask).sum(1),
                frame=np.asarray(self.frame),
                focal=np.asarray(self.focal),
                centre=np.asarray(self.centre),
                image_size=np.array(self.image_size),
                focal_unit=self.focal_unit,
            )

    @property
    def counts(self) -> Float[Array, "line"]:
        """Number of points of each line."""
        return jnp.sum(self.mask, axis=1).astype(jnp.asarray(self.points).dtype)

    def corrected(self, coefficients: Float[Array, "frame terms"]) -> Float[Array, "line rows 2"]:
        """Corrected points of each line about their mean, px."""
        return corrected_points(self, self.distortion_model, coefficients)

    def second_moments(self, order: int) -> Float[Array, "line moment 2 2"]:
        """``sum_p r_p^(2i) z_p z_p^T`` for i = 0 ... order - 1."""
        z = jnp.where(self.mask[..., None], (self.points - self.centre[None, None]) / self.scale, 0)
        squared = jnp.sum(z * z, axis=-1, keepdims=True)
        product = partial(jnp.einsum, "lpc,lpd->lcd", precision=EXACT)
        return jnp.stack([product(squared**i * z, z) for i in range(order)], axis=1)

    def about(self, centre: Centres) -> "Lines":
        """The same lines about another centre of distortion, px: that of all frames, or of each frame.

        In the latter case points are moved, frame by frame, so that one centre, the mean, serves all.

        Raises:
            ValueError: it is neither, or not finite.
        """
        centre = jnp.asarray(real_argument("centre", centre), jnp.asarray(self.centre).dtype)
        frames = self.focal.shape[0]
        if centre.shape not in ((2,), (frames, 2)):
            raise ValueError(
                f"Argument centre must have shape (2,), or ({frames}, 2) with one for each frame, but its "
                f"shape is {centre.shape}."
            )
        check_finite("centre", centre)
        if centre.ndim == 1:
            return eqx.tree_at(lambda lines: lines.centre, self, centre)
        mean = jnp.mean(centre, axis=0)
        points = jnp.asarray(self.points) - (centre - mean[None])[self.frame][:, None]
        return eqx.tree_at(lambda lines: (lines.points, lines.centre), self, (points, mean))

    def take(self, lines: Int[Array, "some"], present: Bool[Array, "some"]) -> "Lines":
        """The chosen lines as a data set of one frame."""
        return Lines(
            points=jnp.asarray(self.points)[lines],
            mask=jnp.asarray(self.mask)[lines] & present[:, None],
            **one_frame(self, lines, present),
        )


def corrected_points(
    lines: Lines, distortion_model: AbstractDistortionModel, coefficients: Float[Array, "frame size"]
) -> Float[Array, "line point 2"]:
    """Points of each line, corrected with the `coefficients` of its frame, about their mean, px."""
    check_rows(coefficients, lines.focal)
    points, mask, k = jnp.asarray(lines.points), jnp.asarray(lines.mask), coefficients[lines.frame]
    correct = jax.vmap(_correct_line, in_axes=(0, 0, 0, None, None, None))
    return correct(points, mask, k, lines.centre, lines.scale, distortion_model)


def _correct_line(points, mask, k, centre, scale, distortion_model):
    """Corrected points of one line about their mean, px; zero where masked."""
    z = jnp.where(mask[:, None], (points - centre[None]) / scale, 0)
    corrected = jnp.stack(distortion_model.correct((z[:, 0], z[:, 1]), jnp.sum(z * z, axis=1), k), axis=1)
    mean = jnp.sum(corrected, axis=0) / jnp.maximum(jnp.sum(mask), 1)
    return jnp.where(mask[:, None], scale * (corrected - mean[None]), 0)
