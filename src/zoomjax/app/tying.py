"""One lens for all photos: those that were taken for bent otherwise are searched again under it.

Detectors look at each photo by itself. Where it shows few lines or much clutter, the search for its
distortion may be wrong, and with it what is joined to lines. The other photos know better: once the zoom
lens is fitted to all of them, a photo whose own model bends the lens's straight lines is searched again
under the lens at its focal length. What explains more of its long edges is kept, in doubt what all photos
say. Photos that agree with the lens are not read again.
"""

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from ..detect.batch import Detection
from ..detect.bend import Bend, bend_of, bends_apart, straight_length
from ..models.lens import ZoomLens

APART = 1.5e-3
"""In diagonals, RMS: by how much a photo's own model may bend straight lines of the lens. Twice of what is
tolerated when pieces of lines are joined."""

_LEAST_KEPT = 0.25
"""Share of what the search of a photo alone explains that the lens of all must explain. Photos of
arcs, which a wrong model joins to lines, have more; photos by a very different lens less."""

_STRAIGHT = 1.0
"""px, RMS: lines that the lens of all makes as straight count for it."""

_ROUND = 6
"""Decimals of a model that is searched under: cached detections are found again by them."""

_LEAST_PHOTOS = 3
"""Photos by which the lens is determined before it judges one of them."""


def bend_at(lens: ZoomLens, focal: float) -> Bend:
    """How bent the lens makes images at a focal length."""
    distortion = lens(float(focal))

    def undistort(points: np.ndarray) -> np.ndarray:
        return np.asarray(distortion.undistort(points))

    k1, k2, x, y = bend_of(lens.image_size, np.asarray(distortion.centre, float), undistort)
    return round(k1, _ROUND), round(k2, _ROUND), round(x, _ROUND), round(y, _ROUND)


def to_search_again(
    detections: Iterable[Detection], focal: dict[str, float], lens: ZoomLens
) -> dict[str, Bend]:
    """The photos that disagree with the lens, or show no lines, and how bent it makes them.

    Args:
        detections: of photos of the lens.
        focal: their focal lengths by name; photos without are left alone.
        lens: fitted to all photos.
    """
    asked, known = [d for d in detections if d.name in focal], {}
    if sum(bool(d.lines) for d in asked) < _LEAST_PHOTOS:
        return {}
    limit = APART * float(np.hypot(*lens.image_size))
    for detection in asked:
        if detection.bend is not None:
            by_all = bend_at(lens, focal[detection.name])
            if not detection.lines or bends_apart(lens.image_size, by_all, detection.bend) > limit:
                known[detection.name] = by_all
    return known


def better(own: Detection, tied: Detection, known: Bend) -> bool:
    """Whether lines found under the lens of all photos are to replace those of a photo's own search.

    They are if more length of them is straight by the lens, which was fitted to other photos' lines, too,
    unless they are but little of what the photo's own search explains: the lens is not that photo's.
    """
    if tied.problem or not tied.lines:
        return False
    if own.problem or own.unexplained is None or tied.unexplained is None:
        return True
    size = own.image_size
    length = [straight_length(size, known, of.lines, _STRAIGHT) for of in (own, tied)]
    return length[1] > length[0] and 1 - tied.unexplained >= _LEAST_KEPT * (1 - own.unexplained)


def tied(
    detections: Sequence[Detection],
    known: dict[str, Bend],
    search: Callable[[dict[str, Bend]], Iterable[Detection]],
) -> tuple[list[Detection], list[str]]:
    """The detections with those searched again that are better, and their names.

    Args:
        detections: of all photos.
        known: what `to_search_again` gives.
        search: searches photos again, each under its own model.
    """
    again = {detection.name: detection for detection in search(known)}
    replaced = [d.name for d in detections if d.name in again and better(d, again[d.name], known[d.name])]
    chosen = set(replaced)
    return [again[d.name] if d.name in chosen else d for d in detections], replaced
