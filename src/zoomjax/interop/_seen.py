"""What a file says of an image: its nodes, and points of the image by each."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np

from ._samples import Pairs, pairs_of
from .base import Node, Sampled


@dataclasses.dataclass(frozen=True)
class Seen:
    """A node, and points of the image by it.

    Attributes:
        node: the node, with its centre.
        distorted, corrected: the points, in half diagonals from the node's centre.
        whole: whether they reach the border of the image everywhere.
    """

    node: Node | Sampled
    distorted: np.ndarray
    corrected: np.ndarray
    whole: bool

    def about(self, centre: np.ndarray, scale: float) -> Pairs:
        """Distorted and corrected points from another centre."""
        assert self.node.centre is not None
        offset = (self.node.centre - centre) / scale
        return self.distorted + offset, self.corrected + offset

    @property
    def any_scale(self) -> bool:
        """Whether the tool scales corrected points as it likes."""
        return isinstance(self.node, Node) and self.node.form.any_scale

    @property
    def corrects(self) -> bool:
        """Whether the file maps distorted to corrected points."""
        return self.node.form.corrects if isinstance(self.node, Node) else self.node.corrects


def seen_of(node: Node | Sampled, size: tuple[int, int]) -> Seen:
    """A node, and points of the image by it."""
    if not isinstance(node, Sampled):
        return Seen(node, *pairs_of(node, size))
    assert node.centre is not None
    scale = math.hypot(*size) / 2
    distorted, corrected = ((points - node.centre) / scale for points in (node.distorted, node.corrected))
    return Seen(node, distorted, corrected, True)


def inside(
    between: Callable[[int, float], Node],
    nodes: Sequence[Node | Sampled],
    shares: tuple[float, ...],
    size: tuple[int, int],
) -> list[Seen]:
    """What the tool makes of each interval between nodes, at shares of the way in 1/f."""
    found = []
    for i, (low, high) in enumerate(itertools.pairwise(node.focal for node in nodes)):
        ways = [share * low / (high + share * (low - high)) for share in shares]
        found += [seen_of(between(i, way), size) for way in ways]
    return found
