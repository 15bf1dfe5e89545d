"""Points of a scene, followed from frame to frame of a clip."""

import math
import os
import warnings
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from .._core.arguments import check_kind
from .._core.arrays import held_as_given
from .._core.checks import checked_integer, checked_size, real_numbers, warn_of_points_outside
from .._core.fields import (
    booleans,
    check_indices,
    check_shapes,
    integers,
    known,
    numbers,
    refuse_masked,
)
from .._core.files import whole_file
from .._core.types import AnyArray

FORMAT, VERSION = "zoomjax.tracks", 2


class Tracks(eqx.Module):
    """Points of a scene as a clip shows them, as padded tensors; `Tracks.from_arrays` makes them.

    As in `Lines`, points that JAX cannot hold in their dtype (float64 while x64 is off) stay NumPy arrays.

    Attributes:
        points: ``(x, y)`` px of each view of each track; (0, 0) is the centre of the top-left pixel.
        frame: the frame of each view, from 0, increasing along a track.
        mask: which entries are views rather than padding.
        image_size: (width, height) px.
        frames: number of frames of the clip. A frame without views is allowed.
        number: the name that each track was given, an integer.
        weight: weight of each view relative to all others, at least 0; None for equal weights. The variance
            of a view's noise is that of a view of weight 1, over its weight. A view of weight 0 is there
            and counts for nothing.
    """

    points: Float[AnyArray, "track view 2"] = eqx.field(converter=numbers("points"))
    frame: Int[AnyArray, "track view"] = eqx.field(converter=integers("frame"))
    mask: Bool[AnyArray, "track view"] = eqx.field(converter=booleans("mask"))
    image_size: tuple[int, int] = eqx.field(static=True, converter=checked_size)
    frames: int = eqx.field(static=True, converter=lambda frames: checked_integer("frames", frames, 1))
    number: Int[AnyArray, "track"] = eqx.field(converter=integers("number"))
    weight: Float[AnyArray, "track view"] | None = eqx.field(default=None, converter=numbers("weight"))

    def __check_init__(self):
        """Check that the shapes agree, that frames exist, and that views are numbers."""
        check_shapes(
            {
                "points": (self.points, ("track", "view", 2)),
                "frame": (self.frame, ("track", "view")),
                "mask": (self.mask, ("track", "view")),
                "number": (self.number, ("track",)),
                "weight": (self.weight, ("track", "view")),
            }
        )
        check_indices("frame", self.frame, self.frames, "the frames of the clip")
        points, mask = known(self.points), known(self.mask)
        if points is not None and mask is not None and not np.isfinite(points[mask]).all():
            raise ValueError("Argument points must be finite where mask is set: clear the mask there.")
        weight = known(self.weight)
        if weight is not None and mask is not None:
            _check_weights(weight[mask])
        frame = known(self.frame)
        if frame is not None and mask is not None and frame.ndim == 2:
            before = np.maximum.accumulate(np.where(mask, frame, -1), axis=1)[:, :-1]
            falls = mask[:, 1:] & (frame[:, 1:] <= before)
            if falls.any():
                place = int(np.argmax(falls.any(axis=1)))
                raise ValueError(
                    f"Argument frame must increase along a track, but frame[{place}] does not: "
                    "Tracks.from_arrays puts views in order."
                )

    @classmethod
    def from_arrays(
        cls,
        track: ArrayLike,
        frame: ArrayLike,
        points: ArrayLike,
        *,
        image_size: Sequence[int],
        frames: int | None = None,
        weight: ArrayLike | None = None,
    ) -> "Tracks":
        """Make tracks from one entry per view, in any order.

        Args:
            track: for each view an integer that names its track.
            frame: for each view the index of its frame, from 0.
            points: for each view ``(x, y)``, px.
            image_size: (width, height) px.
            frames: number of frames of the clip; by default one more than the last frame with a view.
            weight: for each view its weight relative to the others, at least 0; None for equal weights.

        Raises:
            ValueError: shapes do not agree, a frame does not exist, a point is not finite, a weight is not
                finite or below 0, or all are 0, a track has two views in one frame, or no track has two
                views, or none of these a weight above 0.

        Warns:
            UserWarning: tracks of one view are dropped, or with the views of another one, of which that
                with the greatest weights stays; the message counts them. Or points lie outside of the
                image.

        Example:
            >>> tracks = Tracks.from_arrays(
            ...     [0, 0, 1, 1], [0, 1, 0, 1], [[1, 2], [2, 2], [5, 2], [6, 2]], image_size=(8, 6)
            ... )
            >>> tracks.points.shape, tracks.frames
            ((2, 2, 2), 2)
        """
        size = checked_size(image_size)
        names, moments, places = _views(track, frame, points)
        weights = None if weight is None else _weights(weight, places)
        frames = int(moments.max()) + 1 if frames is None else checked_integer("frames", frames, 1)
        if moments.max() >= frames:
            raise ValueError(
                f"Argument frame must hold indices from 0 to {frames - 1}, but it has {moments.max()}."
            )
        order = np.lexsort((moments, names))
        names, moments, places = names[order], moments[order], places[order]
        twice = (np.diff(names) == 0) & (np.diff(moments) == 0)
        if twice.any():
            place = int(np.argmax(twice))
            raise ValueError(f"Track {names[place]} has two views in frame {moments[place]}: keep one.")
        number, count = np.unique(names, return_counts=True)
        first = np.cumsum(count) - count
        if (single := count < 2).any():
            if single.all():
                raise ValueError("No track has two views: a track says something where it is seen again.")
            warnings.warn(
                f"Dropped {single.sum()} of {len(count)} tracks: they have one view.", stacklevel=2
            )
            number, count, first = number[~single], count[~single], first[~single]
        weights = None if weights is None else weights[order]
        if (copies := _copies(moments, places, weights, first, count)).any():
            warnings.warn(
                f"Dropped {copies.sum()} of {len(count)} tracks: they are copies of others, with the same "
                f"views, as {number[copies][0]} is, and would count twice.",
                stacklevel=2,
            )
            number, count, first = number[~copies], count[~copies], first[~copies]
        view = np.arange(count.max())
        mask = view < count[:, None]
        entry = np.where(mask, first[:, None] + view, first[:, None])  # padding repeats the first view
        if weights is not None and not weights[entry].any():
            raise ValueError(
                "No track of two views has a weight above 0: give some of them one, or leave weight out "
                "for equal weights."
            )
        warn_of_points_outside(places[entry], mask, size)
        return cls(
            points=held_as_given(places[entry]),
            frame=jnp.asarray(moments[entry], jnp.int32),
            mask=jnp.asarray(mask),
            image_size=size,
            frames=frames,
            number=jnp.asarray(number, jnp.int32),
            weight=None if weights is None else held_as_given(weights[entry]),
        )

    def views(
        self,
    ) -> tuple[Int[np.ndarray, "entry"], Int[np.ndarray, "entry"], Float[np.ndarray, "entry 2"]]:
        """Each view's track, as `number` calls it, its frame and its point, as `from_arrays` takes them."""
        mask = np.asarray(self.mask)
        names = np.repeat(np.asarray(self.number), mask.sum(axis=1))
        return names, np.asarray(self.frame)[mask], np.asarray(self.points)[mask]

    def view_weights(self) -> Float[np.ndarray, "entry"] | None:
        """Each view's weight, in the order of `views`; None for equal weights."""
        return None if self.weight is None else np.asarray(self.weight)[np.asarray(self.mask)]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all fields, in their dtypes, to a ``.npz`` file that `load_tracks` reads.

        Raises:
            ValueError: tracks have one number, by which the file tells them apart.
        """
        check_kind("path", path, (str, os.PathLike))
        names, count = np.unique(np.asarray(self.number), return_counts=True)
        if (count > 1).any():
            raise ValueError(
                f"{count.max()} tracks have the number {names[count.argmax()]}, by which a file tells them "
                "apart: give each its own before they are saved."
            )
        _, frame, points = self.views()
        weight = self.view_weights()
        optional: dict[str, Any] = {} if weight is None else {"weight": weight}
        with whole_file(path) as part, part.open("wb") as file:
            np.savez(
                file,
                **optional,
                format=FORMAT,
                version=1 if weight is None else VERSION,  # older readers take all weights as equal
                points=points,
                frame=frame,
                counts=np.asarray(self.mask).sum(axis=1),
                number=np.asarray(self.number),
                image_size=np.array(self.image_size),
                frames=self.frames,
            )

    @property
    def scale(self) -> float:
        """The length in px that is radius 1: half the image diagonal."""
        return math.hypot(*self.image_size) / 2


def _check_weights(weight):
    """Raise ValueError where weights of views are no weights."""
    if (bad := ~(np.isfinite(weight) & (weight >= 0))).any():
        raise ValueError(
            "Argument weight must be finite and at least 0 where there is a view, but it has "
            f"{weight[bad][0]}: give views that must not count weight 0."
        )
    if weight.size and not weight.any():
        raise ValueError(
            "Argument weight must be above 0 for some views, but it is 0 for all: leave it out for equal "
            "weights."
        )


def _copies(moments, places, weights, first, count):
    """Which tracks have the very views of another one that stays: the heaviest, the first of equals."""
    views = [slice(at, at + n) for at, n in zip(first.tolist(), count.tolist(), strict=True)]
    keys = [(moments[of].tobytes(), places[of].tobytes()) for of in views]
    weight = np.array([0 if weights is None else (weights[of] / weights.max()).sum() for of in views])
    stays = {keys[place]: place for place in np.lexsort((-np.arange(len(keys)), weight))}  # the last counts
    return np.array([stays[key] != place for place, key in enumerate(keys)])


def _views(track, frame, points):
    """Each view's track, frame and point as arrays, checked."""
    for name, values in {"track": track, "frame": frame, "points": points}.items():
        refuse_masked(name, values)
    names, moments = (np.asarray(values) for values in (track, frame))
    places = real_numbers(points)
    if places is None:
        raise ValueError(f"Argument points must hold real numbers, (x, y) a view, but it is {points!r}.")
    for name, values in {"track": names, "frame": moments}.items():
        if values.ndim != 1 or not values.size or not np.issubdtype(values.dtype, np.integer):
            raise ValueError(f"Argument {name} must hold one integer a view, but it is {values!r}.")
        if values.max() >= 2**31 or values.min() < -(2**31):
            raise ValueError(f"Argument {name} must hold integers of 32 bits, but it has {values.max()}.")
    if not len(names) == len(moments) == len(places) or places.shape[1:] != (2,):
        raise ValueError(
            f"Arguments track, frame and points must have one entry a view, but their shapes are "
            f"{names.shape}, {moments.shape} and {places.shape}."
        )
    if moments.min() < 0:
        raise ValueError(f"Argument frame must hold indices from 0, but it has {moments.min()}.")
    if not np.isfinite(places).all():
        bad = int(np.argmin(np.isfinite(places).all(axis=1)))
        raise ValueError(f"Argument points must be finite, but points[{bad}] is {places[bad]}.")
    return names, moments, places


def _weights(weight, places):
    """Each view's weight as an array, checked; in the dtype of the points unless it has its own."""
    refuse_masked("weight", weight)
    values = real_numbers(weight)
    if values is None or values.shape != (len(places),):
        raise ValueError(
            f"Argument weight must hold one real number for each of the {len(places)} views, but "
            + (f"it is {weight!r}." if values is None else f"its shape is {values.shape}.")
        )
    _check_weights(values)
    return values if np.asarray(weight).dtype.kind == "f" else values.astype(places.dtype)
