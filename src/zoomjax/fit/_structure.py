"""Which track and which frame each view belongs to, in arrays of few sizes."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from .._core.arrays import places

NONE = np.iinfo(np.int32).max
"""The number of no view."""


class Structure(eqx.Module):
    """Which track and which frame each view belongs to; views are sorted by track, then by frame.

    Attributes:
        track, frame: of each view.
        place: of each view's track, among those that begin in the same block.
        begin: the block in which its track begins.
        members: the views of the tracks that begin in each block; `NONE` pads.
        starting: these tracks, by their places.
        line_frame: the frame of each line.
        tracks: their number.
        block: frames in a block: at least as many as a track is long, from its first to its last.
        blocks: how many there are.
        most: the largest number of tracks that begin in a block.
    """

    track: Int[Array, "view"]
    frame: Int[Array, "view"]
    place: Int[Array, "view"]
    begin: Int[Array, "view"]
    members: Int[Array, "block some"]
    starting: Int[Array, "block track"]
    line_frame: Int[Array, "line"]
    tracks: int = eqx.field(static=True)
    block: int = eqx.field(static=True)
    blocks: int = eqx.field(static=True)
    most: int = eqx.field(static=True)


def structure_of(
    track: Int[np.ndarray, "view"],
    frame: Int[np.ndarray, "view"],
    frames: int,
    block: int | None = None,
    line_frame: Int[np.ndarray, "line"] = np.zeros(0, int),  # noqa: B008, nothing to write to
) -> Structure:
    """The structure of views that are sorted by track, then by frame.

    A block is as long as the longest track unless it is given.
    """
    tracks, first = np.unique(track, return_index=True)
    last = np.append(first[1:], len(track)) - 1
    block = min(max(int(np.max(frame[last] - frame[first])) + 1, 8), frames) if block is None else block
    begin = frame[first] // block
    order = np.argsort(begin, kind="stable")
    count = np.bincount(begin, minlength=-(-frames // block))
    place = np.empty(len(tracks), int)
    place[order] = places(count)
    of_views = track, frame, place[track], begin[track]
    of_blocks = (_members(of, len(count)) for of in (begin[track], begin))
    return Structure(
        *(jnp.asarray(a, jnp.int32) for a in (*of_views, *of_blocks, line_frame)),
        tracks=len(tracks),
        block=block,
        blocks=len(count),
        most=int(count.max()),
    )


def _members(begin, blocks):
    """The numbers of the views, or of the tracks, of each block."""
    count = np.bincount(begin, minlength=blocks)
    order = np.argsort(begin, kind="stable")
    members = np.full((blocks, count.max()), NONE)
    members[begin[order], places(count)] = order
    return members


def bucket(size: int) -> int:
    """The least of 1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 14, 16, 20, 24, ... that is at least `size`.

    Programs are compiled for few sizes, and nothing is a quarter larger than it needs to be.
    """
    step = 2 ** max(int(size - 1).bit_length() - 3, 0)
    return -(-size // step) * step


def padded(structure: Structure) -> Structure:
    """The structure with more views, which belong to no block, and more tracks, to which these belong."""
    more = bucket(len(structure.track)) - len(structure.track)
    last = structure.tracks  # at least one more

    def wider(members):
        more = bucket(members.shape[1]) - members.shape[1]
        return jnp.asarray(np.pad(members, ((0, 0), (0, more)), constant_values=NONE))

    return Structure(
        *(
            jnp.asarray(np.pad(values, (0, more), constant_values=filling))
            for values, filling in (
                (structure.track, last),
                (structure.frame, 0),
                (structure.place, 0),
                (structure.begin, structure.blocks),
            )
        ),
        members=wider(structure.members),
        starting=wider(structure.starting),
        line_frame=structure.line_frame,
        tracks=bucket(structure.tracks + 1),
        block=structure.block,
        blocks=structure.blocks,
        most=bucket(structure.most),
    )
