"""What a file says of an image: its nodes, and points of the image by each."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np

from ..models.distortion import Distortion
from ._samples import Pairs, pairs_of
from .base import Contents, Node, Sampled


@dataclasses.dataclass(frozen=True)
class Seen:
    """A node, and points of the image by it.

    Attributes:
        node: the node, with its centre.
        distorted, corrected: the points, in half diagonals from the node's centre.
        whole: whether they reach the border of the image everywhere.
        any_scale: whether the tool scales corrected points as it likes.
    """

    node: Node | Sampled
    distorted: np.ndarray
    corrected: np.ndarray
    whole: bool
    any_scale: bool = False

    def about(self, centre: np.ndarray, scale: float) -> Pairs:
        """Distorted and corrected points from another centre."""
        assert self.node.centre is not None
        offset = (self.node.centre - centre) / scale
        return self.distorted + offset, self.corrected + offset

    def magnified(self, by: float, *, focal: bool) -> "Seen":
        """The same rays with corrected points of another scale; `focal` if they are of its focal length."""
        assert isinstance(self.node, Node)
        assert self.node.focal_px is not None
        node = dataclasses.replace(
            self.node, focal=self.node.focal * (by if focal else 1.0), focal_px=self.node.focal_px * by
        )
        return dataclasses.replace(self, node=node, corrected=self.corrected * by)

    @property
    def focal_px(self) -> float | None:
        """Focal length in px of the tool's rays, where that goes with the scale of corrected points."""
        return self.node.focal_px if isinstance(self.node, Node) else None

    @property
    def corrects(self) -> bool:
        """Whether the file maps distorted to corrected points."""
        return self.node.form.corrects if isinstance(self.node, Node) else self.node.corrects


def seen_of(node: Node | Sampled, size: tuple[int, int]) -> Seen:
    """A node, and points of the image by it."""
    if not isinstance(node, Sampled):
        return Seen(node, *pairs_of(node, size), node.form.any_scale)
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


def against(
    distortion: Distortion, seen: Seen, scale: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """A node's distorted and corrected points, the latter by the lens, and the scale of these in that."""
    centre = np.asarray(distortion.centre, float)
    distorted, corrected = seen.about(centre, scale)
    found = (np.asarray(distortion.undistort(distorted * scale + centre)) - centre) / scale
    by = float(np.sum(found * corrected) / np.sum(corrected * corrected))
    return distorted, corrected, found, by


def distance(distortion: Distortion, seen: Seen, scale: float) -> float:
    """The greatest distance from a node, px, in the image into which the file maps.

    Where the lens does not reach, it is that in the other image.
    """
    distorted, corrected, found, by = against(distortion, seen, scale)
    centre = np.asarray(distortion.centre, float)
    corrected = by * corrected if seen.any_scale else corrected
    far = np.hypot(*(found - corrected).T)
    if not seen.corrects:
        back = (np.asarray(distortion.distort(corrected * scale + centre)) - centre) / scale
        other = np.hypot(*(back - distorted).T)
        far = np.where(np.isfinite(other), other, far)
    return float(far.max() * scale) if np.isfinite(far).all() else np.inf


_NEAR = 0.02
"""Of the diagonal, by which a lens may be off maps that are of one."""


def check_near(at_nodes: float, contents: Contents) -> None:
    """Raise ValueError where maps are those of no lens, as of pictures that are no STMaps."""
    most = _NEAR * math.hypot(*contents.image_size)
    if at_nodes > most and any(isinstance(node, Sampled) for node in contents.nodes):
        raise ValueError(
            f"the lens that is nearest to it is {at_nodes:.3g} px off: red and green must be positions "
            "from 0 to 1, without a colour space applied, as they are in 32-bit floats"
        )


def once(nodes: tuple[Node | Sampled, ...]) -> tuple[list[Node | Sampled], list[Node | Sampled]]:
    """The first node of each focal length, in their order, and later ones that are not like it.

    Those of a track that stands still are alike.
    """
    first = {node.focal: node for node in reversed(nodes)}
    return [first[focal] for focal in sorted(first)], [n for n in nodes if not _alike(n, first[n.focal])]


def _alike(one: Node | Sampled, other: Node | Sampled) -> bool:
    """Whether they are the same distortion, up to rounding."""
    if isinstance(one, Node) and isinstance(other, Node):
        pairs = [(one.theta, other.theta), (one.centre, other.centre)]
        return one.form == other.form and all(np.allclose(*pair, rtol=1e-9) for pair in pairs)
    assert isinstance(one, Sampled)
    assert isinstance(other, Sampled)
    pairs = [(one.distorted, other.distorted), (one.corrected, other.corrected)]
    return all(np.array_equal(*pair) for pair in pairs)
