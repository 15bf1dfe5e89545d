"""Lines spread over devices, of one process or of many: each device holds some of the lines.

What is computed from them (`compress`, energies, `fit_zoom`) is computed where they are. `compress`
exchanges nothing, an energy a number a frame, a step of a fit the sums that make its small triangle.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from .._core.arguments import check_kind
from .base import AbstractLines
from .compressed import CompressedLines
from .lines import Lines

SomeLines = TypeVar("SomeLines", Lines, CompressedLines)

_OF_LINES = ("points", "mask", "triangle", "frame", "weight")


def shard(lines: SomeLines, devices: Sequence[Any] | None = None) -> SomeLines:
    """Spread lines over devices, each with as many lines as the others.

    Lines without points, which count as none, fill up where the numbers do not divide. With several
    processes (`jax.distributed`) each process gives its own lines, of frames that all of them number in
    the same way: `focal` and all else that is not of a line must be the same in all of them.

    Args:
        lines: the lines, or their compressed form; with several processes, those of this process.
        devices: the devices, as many of each process; by default all that there are.

    Returns:
        One data set, whose arrays are spread line by line. Its `number` is not known.

    Raises:
        ValueError: the frames or the centre differ between processes, or this one has none of the devices.

    Example:
        >>> import jax, numpy as np
        >>> row = np.stack([np.arange(500.0), np.full(500, 20.0)], axis=-1)
        >>> lines = Lines.from_ragged([row, row + 1], [0, 1], [24, 70], image_size=(640, 480))
        >>> tuple(shard(lines, jax.devices()[:1]).points.sharding.spec)
        ('line',)
    """
    check_kind("lines", lines, (Lines, CompressedLines))
    every = list(jax.devices() if devices is None else devices)
    here = [device for device in every if device.process_index == jax.process_index()]
    number = lines.frame.shape[0]
    longest = lines.points.shape[1] if isinstance(lines, Lines) else 0
    if jax.process_count() > 1:
        number, longest = _agreed(lines, number, longest)
    if not here:
        raise ValueError("Argument devices must hold some of this process, but they are all of others.")
    size = -(-number // len(here)) * len(here)
    over = NamedSharding(Mesh(np.array(every), ("line",)), PartitionSpec("line"))

    def spread(name: str) -> Any:
        own = np.asarray(_of_all(lines, name))
        room = (size, longest) if name in ("points", "mask") else (size,)
        padded = np.zeros((*room, *own.shape[len(room) :]), own.dtype)
        padded[tuple(map(slice, own.shape))] = own
        return jax.make_array_from_process_local_data(over, padded)

    names = [name for name in _OF_LINES if hasattr(lines, name)]
    everywhere = NamedSharding(over.mesh, PartitionSpec())
    common = {name: _everywhere(getattr(lines, name), everywhere) for name in ("focal", "focus", "centre")}
    return dataclasses.replace(lines, **{name: spread(name) for name in names}, **common, number=None)


def _of_all(lines: AbstractLines, name: str) -> Any:
    """An array of a line each; weights are written out, for another process may have some."""
    value = getattr(lines, name)
    if name == "weight" and value is None:
        return np.ones(lines.frame.shape, np.asarray(lines.focal).dtype)
    return value


def _everywhere(value: Any, everywhere: NamedSharding) -> Any:
    if value is None:
        return None
    own = np.asarray(value)
    return jax.make_array_from_callback(own.shape, everywhere, lambda index: own[index])


def _agreed(lines: AbstractLines, number: int, longest: int) -> tuple[int, int]:
    """The most lines and points of a process, and that all have the same frames."""
    from jax.experimental import multihost_utils

    focus = np.zeros(0) if lines.focus is None else np.asarray(lines.focus)
    sizes = np.array([number, longest, lines.focal.shape[0], focus.size])
    every = np.asarray(multihost_utils.process_allgather(sizes)).reshape(-1, sizes.size)
    if (every[:, 2:] != every[0, 2:]).any():
        raise ValueError(
            "Argument lines must be of the same frames in all processes, but the numbers of their focal "
            f"lengths are {every[:, 2].tolist()}: number the frames of all processes alike."
        )
    common = np.concatenate([np.asarray(lines.focal), np.asarray(lines.centre), focus]).astype(np.float64)
    seen = np.asarray(multihost_utils.process_allgather(common)).reshape(len(every), -1)
    if (seen != seen[0]).any():
        raise ValueError(
            "Argument lines must have the same focal lengths, focus and centre in all processes, but they "
            "differ: give each process those of all frames."
        )
    return int(every[:, 0].max()), int(every[:, 1].max())
