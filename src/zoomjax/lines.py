"""Line primitives: sequences of image points that lie on straight lines of the scene.

`AbstractLines` is what the energies and the fits see: for any distortion coefficients it gives, line
by line, the corrected points about their mean, or rows that stand for them exactly. `Lines` holds the
points themselves, flat over lines (not nested in frames, which hold from 5 to 108 lines: nesting
would waste 27 times the memory on the paper's data). Compressed lines are in `compression`.
"""

import abc
import math
import os
import zipfile
from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from ._arguments import check_kind, kinds_checked
from ._checks import (
    checked_centre,
    checked_focal,
    checked_focus,
    checked_frames,
    checked_points,
    checked_size,
    checked_unit,
    usable_lines,
    warn_of_points_outside,
)
from ._fields import (
    booleans,
    check_finite,
    check_indices,
    check_not_negative,
    check_positive,
    check_shapes,
    integers,
    known,
    numbers,
)
from ._files import whole_file
from ._types import AnyArray, Centres, Focal, Focus, FrameIndex, LineNumber, LineWeight, Mask, Point, traced
from .families import AbstractFamily, RadialPolynomial

_FORMAT, _VERSION = "zoomjax.lines", 1

_MOST_UNPACKED = 100_000_000
"""Bytes that a file may always become in memory; beyond, at most `_MOST_TIMES` its size."""

_MOST_TIMES = 100

SomeLines = TypeVar("SomeLines", bound="AbstractLines")


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
        check_positive("focal", self.focal)
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
    def family(self) -> AbstractFamily:
        """What the coefficients mean: the radial polynomial, except for `FamilyLines`."""
        return RadialPolynomial()

    def expansion(
        self, coefficients: Float[Array, "some size"]
    ) -> tuple[Float[Array, "some power"], Float[Array, "some tangential"]]:
        """The family's coefficients as what corrected points are linear in, up to the image's corners."""
        far = jnp.maximum(self.centre, jnp.asarray(self.image_size) - 1 - self.centre) / self.scale
        expand = jax.vmap(lambda k: self.family.expansion(k, far @ far))
        powers, tangential = expand(coefficients)
        return jnp.asarray(powers), jnp.asarray(tangential)

    @property
    @abc.abstractmethod
    def counts(self) -> Float[Array, "line"]:
        """Number of points of each line, Np(l, m); 0 marks a line that is not there."""

    @abc.abstractmethod
    def corrected(self, coefficients: Float[Array, "line terms"]) -> Float[Array, "line rows 2"]:
        """Corrected points of each line about their mean, px, or rows with the same scatter.

        `coefficients` are those of each line's own frame. Rows beyond a line's end are zero.
        """

    @abc.abstractmethod
    def second_moments(self, order: int) -> Float[Array, "line moment 2 2"]:
        """``sum_p r_p^(2i) z_p z_p^T`` for i = 0 ... order - 1, over each line's points, normalised."""

    def radial_moments(self, order: int) -> Float[Array, "line moment"]:
        """``sum_p r_p^(2i)`` for i = 0 ... order, over the points of each line, normalised."""
        traces = jnp.trace(self.second_moments(order), axis1=2, axis2=3)
        return jnp.concatenate([self.counts[:, None].astype(traces.dtype), traces], axis=1)

    @abc.abstractmethod
    def about(self, centre: Centres) -> "AbstractLines":
        """The same lines about another centre of distortion, px: that of all frames, or of each frame.

        Raises:
            ValueError: they were compressed for one centre, and this is another.
        """

    @abc.abstractmethod
    def take(self, lines: Int[Array, "some"], present: Bool[Array, "some"]) -> "AbstractLines":
        """The chosen lines as a data set of one frame; those not `present` count as empty."""

    def weighted(self: SomeLines, weight: ArrayLike) -> SomeLines:
        """The same lines, each counting `weight` beside the others of its frame.

        Raises:
            ValueError: there is not one finite weight of at least 0 for each line.
        """
        weight = jnp.asarray(weight, jnp.asarray(self.focal).dtype)
        if weight.shape != self.frame.shape:
            raise ValueError(
                f"Argument weight must hold one number for each of the {self.frame.shape[0]} lines, but "
                f"its shape is {weight.shape}."
            )
        if not traced(weight) and not (np.isfinite(weight) & (np.asarray(weight) >= 0)).all():
            raise ValueError("Argument weight must hold finite numbers of at least 0, but it does not.")
        return eqx.tree_at(lambda lines: lines.weight, self, weight, is_leaf=lambda leaf: leaf is None)

    def by_frame(self) -> tuple[Int[AnyArray, "frame some"], Bool[AnyArray, "frame some"]]:
        """For each frame the indices of its lines, padded to the fullest frame, and which are real.

        Computed in NumPy: the padding is a shape. Under ``jit``, where `frame` is not known, every
        frame is given all lines and chooses by the mask.
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


class Lines(AbstractLines):
    """Line primitives as padded tensors; `Lines.from_ragged` makes them from sequences and checks them.

    Arrays are JAX arrays in the dtype given. Where JAX cannot hold it (float64 while x64 is off) they
    stay NumPy arrays, so that nothing is lost on saving, and computations run in float32.

    Attributes:
        points: ``(x, y)`` px; (0, 0) is the centre of the top-left pixel.
        mask: which entries of `points` are points rather than padding.
        frame: index of the image that each line was seen in, into `focal`.
        focal: focal length of each image, positive, in `focal_unit`.
        centre: centre of distortion, px; the image's centre ``((w-1)/2, (h-1)/2)`` by default.
        image_size: (width, height) px.
        focal_unit: "mm" or "px".
        number: position of each line among those that `from_ragged` was given; None if unknown.
        weight: how much each line counts beside the others of its frame, at least 0; None for all alike.
        focus: where the lens is focused in each image, for models that depend on it (`AbstractFocusZoom`):
            any number that grows or falls with it, such as the reciprocal of the distance; None if unknown.
    """

    points: Float[AnyArray, "line point 2"] = eqx.field(converter=numbers("points"))
    mask: Mask = eqx.field(converter=booleans("mask"))
    frame: FrameIndex = eqx.field(converter=integers("frame"))
    focal: Focal = eqx.field(converter=numbers("focal"))
    centre: Point = eqx.field(converter=numbers("centre"))
    image_size: tuple[int, int] = eqx.field(static=True, converter=checked_size)
    focal_unit: str = eqx.field(static=True, default="mm")
    number: LineNumber | None = eqx.field(default=None, converter=integers("number"))
    weight: LineWeight | None = eqx.field(default=None, converter=numbers("weight"))
    focus: Focus | None = eqx.field(default=None, converter=numbers("focus"))

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
        """Lines from one array of points a line.

        Args:
            points: for each line an (n, 2) array of ``(x, y)`` px, n >= 3.
            frame: for each line the index of its image, into `focal`.
            focal: for each image its focal length, > 0.
            image_size: (width, height) px.
            focal_unit: "mm" or "px", the unit of `focal`.
            centre: centre of distortion, px; default the centre of the image.
            focus: for each image where the lens is focused, a finite number, 1/distance say, or None.
            chunk: whether these are only some of the lines' points, to be compressed and merged with
                others: then every line is kept, whatever its number of points, even none.

        Raises:
            ValueError: a point or focal length is not finite, a focal length is not positive, a frame
                index is out of range, a frame has no line, or no usable line is left.

        Warns:
            UserWarning: lines with fewer than 3 distinct points are dropped; the message counts them. Or
                points lie outside of the image.

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
        return cls(
            points=_held_as_given(padded),
            mask=jnp.asarray(mask),
            frame=jnp.asarray(frames, jnp.int32),
            focal=_held_as_given(focals.astype(dtype)),
            centre=_held_as_given(checked_centre(centre, size).astype(dtype)),
            image_size=size,
            focal_unit=unit,
            number=jnp.asarray(number, jnp.int32),
            focus=None
            if focus is None
            else _held_as_given(checked_focus(focus, focals.size).astype(dtype)),
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
        """Every row and every column of flat grids (checkerboard corners, dots) as a line.

        Args:
            corners: positions of the grids' nodes, px.
            frame: for each grid the index of the frame that it counts in. Grids at the same focal
                length may share a frame: eq. 3 then averages over all their lines.
            focal, image_size, focal_unit: as for `from_ragged`, whose errors also apply.
        """
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
        """The points of each line as an (n, 2) array: what `from_ragged` took."""
        mask = np.asarray(self.mask)
        return [line[keep] for line, keep in zip(np.asarray(self.points), mask, strict=True)]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all fields, in their dtypes, to a ``.npz`` file that `load_lines` reads."""
        check_kind("path", path, (str, os.PathLike))
        optional: dict[str, Any] = {"weight": self.weight, "focus": self.focus}
        fields: dict[str, Any] = {
            name: np.asarray(value) for name, value in optional.items() if value is not None
        }
        with whole_file(path) as part, part.open("wb") as file:
            np.savez(
                file,
                **fields,
                format=_FORMAT,
                version=_VERSION,
                points=np.asarray(self.points)[np.asarray(self.mask)],
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

    def corrected(self, coefficients: Float[Array, "line terms"]) -> Float[Array, "line rows 2"]:
        """Corrected points of each line about their mean, px."""
        return corrected_points(self, self.family, coefficients)

    def second_moments(self, order: int) -> Float[Array, "line moment 2 2"]:
        """``sum_p r_p^(2i) z_p z_p^T`` for i = 0 ... order - 1."""
        z = jnp.where(self.mask[..., None], (self.points - self.centre[None, None]) / self.scale, 0)
        squared = jnp.sum(z * z, axis=-1, keepdims=True)
        return jnp.stack([jnp.einsum("lpc,lpd->lcd", squared**i * z, z) for i in range(order)], axis=1)

    def about(self, centre: Centres) -> "Lines":
        """The same lines about another centre of distortion, px: that of all frames, or of each frame.

        In the latter case points are moved, frame by frame, so that one centre, the mean, serves all.
        """
        centre = jnp.asarray(centre, jnp.asarray(self.centre).dtype)
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
            frame=jnp.zeros_like(lines, jnp.int32),
            focal=jnp.asarray(self.focal)[self.frame[lines[jnp.argmax(present)]]][None],
            centre=self.centre,
            image_size=self.image_size,
            focal_unit=self.focal_unit,
            number=None if self.number is None else self.number[lines],
            weight=None if self.weight is None else self.weight[lines],
            focus=focus_of(self, lines, present),
        )


def with_fields_of(lines: SomeLines, other: AbstractLines) -> SomeLines:
    """The lines with the focal lengths, focus and weights of a wrapper of them."""
    return eqx.tree_at(
        lambda lines: (lines.focal, lines.focus, lines.weight),
        lines,
        (other.focal, other.focus, other.weight),
        is_leaf=lambda leaf: leaf is None,
    )


def focus_of(
    lines: AbstractLines, chosen: Int[Array, "some"], present: Bool[Array, "some"]
) -> Float[Array, "1"] | None:
    """The focus of the one frame that the chosen lines are seen in."""
    if lines.focus is None:
        return None
    return jnp.asarray(lines.focus)[lines.frame[chosen[jnp.argmax(present)]]][None]


def corrected_points(
    lines: Lines, family: AbstractFamily, coefficients: Float[Array, "line size"]
) -> Float[Array, "line point 2"]:
    """Points of each line, corrected by a family's `coefficients` of each, about their mean, px."""
    return jax.vmap(_correct_line, in_axes=(0, 0, 0, None, None, None))(
        jnp.asarray(lines.points), jnp.asarray(lines.mask), coefficients, lines.centre, lines.scale, family
    )


def _correct_line(points, mask, k, centre, scale, family):
    """Corrected points of one line about their mean, px; zero where masked."""
    z = jnp.where(mask[:, None], (points - centre[None]) / scale, 0)
    corrected = jnp.stack(family.correct((z[:, 0], z[:, 1]), jnp.sum(z * z, axis=1), k), axis=1)
    mean = jnp.sum(corrected, axis=0) / jnp.maximum(jnp.sum(mask), 1)
    return jnp.where(mask[:, None], scale * (corrected - mean[None]), 0)


@kinds_checked
def load_lines(path: str | os.PathLike[str]) -> Lines:
    """Read lines that `Lines.save` wrote.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is truncated, or something else, or of a later version; the message
            names it.
    """
    stored = _read_archive(path)
    try:
        if str(stored.get("format")) != _FORMAT:
            raise ValueError("it holds no line primitives; Lines.save writes such a file")
        if (version := stored["version"].item()) != _VERSION:
            raise ValueError(
                f"its format version is {version!r} and this zoomjax reads {_VERSION}; update zoomjax"
            )
        points, counts = stored["points"], stored["counts"]
        if counts.ndim != 1 or not np.issubdtype(counts.dtype, np.integer) or points.ndim != 2:
            raise ValueError("its points and counts are no tables of numbers")
        largest = int(counts.max(initial=0))
        if counts.min(initial=0) < 0 or largest > len(points) or counts.sum() != len(points):
            raise ValueError("its points and counts disagree")
        _check_unpacked(counts.size * largest * 2 * points.itemsize, points.nbytes)
        lines = Lines.from_ragged(
            np.split(points, np.cumsum(counts)[:-1]),
            stored["frame"],
            stored["focal"],
            image_size=stored["image_size"].tolist(),
            focal_unit=str(stored["focal_unit"]),
            centre=stored["centre"],
            focus=stored.get("focus"),
        )
        if "weight" not in stored:
            return lines
        if stored["weight"].shape != counts.shape:
            raise ValueError("its weights and counts disagree")
        return lines.weighted(stored["weight"][lines.number])
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else str(error).rstrip(".")
        raise ValueError(f"Cannot read lines from {os.fspath(path)}: {reason}.") from error


def _read_archive(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """All arrays of an ``.npz`` file, nothing unpickled."""
    with open(path, "rb") as opened:
        try:
            if not zipfile.is_zipfile(opened):
                raise ValueError("it is not an .npz archive")
            with zipfile.ZipFile(opened) as members:
                size = sum(member.file_size for member in members.infolist())
                _check_unpacked(size, os.fstat(opened.fileno()).st_size)
                for member in members.infolist():
                    _check_header(members, member)
            opened.seek(0)
            archive = np.load(opened, allow_pickle=False)
            return {name: np.asarray(archive[name]) for name in archive.files}
        # Damaged archives raise whatever zipfile, zlib, struct or the tokenizer of headers stumbles over.
        except Exception as error:
            reason = str(error).rstrip(".") or type(error).__name__
            raise ValueError(f"Cannot read lines from {os.fspath(path)}: {reason}.") from error


def _check_unpacked(size: int, file_size: int) -> None:
    """Refuse what a small file would fill the memory with."""
    if size > max(_MOST_UNPACKED, _MOST_TIMES * file_size):
        raise ValueError(f"it would take {size / 1e9:.1f} GB of memory, far more than its own size")


def _check_header(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> None:
    """Refuse an array that claims to be larger than what is stored of it, before memory is taken for it."""
    if not member.filename.endswith(".npy"):
        return
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        old = version == (1, 0)
        read = np.lib.format.read_array_header_1_0 if old else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
        if not dtype.hasobject and math.prod(shape) * dtype.itemsize != member.file_size - file.tell():
            raise ValueError(f"the size of its {member.filename[:-4]} is not what it claims to be")


def _held_as_given(array: np.ndarray) -> AnyArray:
    """A JAX array, unless that would change the values' dtype."""
    if jax.dtypes.canonicalize_dtype(array.dtype) == array.dtype:
        return jnp.asarray(array)
    return array
