"""Which images a calibration uses: those in which there are lines, of one size, each image once."""

from collections import Counter
from collections.abc import Sequence

from ..detect.batch import Detection

OTHER_SIZE = "its size is"
"""How the reason begins of an image that is of another size than most."""


def usable_of(detections: Sequence[Detection]) -> tuple[list[Detection], dict[str, str]]:
    """The images that can be used, and why others in which there are lines are not."""
    same_size, others = _of_one_size([d for d in detections if not d.problem])
    usable, copies = _each_once(same_size)
    return usable, others | copies


def _each_once(detections: Sequence[Detection]) -> tuple[list[Detection], dict[str, str]]:
    """Images with other lines than those before them. The same to the last digit are of the same image.

    A copy has the same errors: as another image it would make the lens look better known than it is, and
    predict the lines of the first when those are left out.
    """
    first: dict[tuple[bytes, ...], str] = {}
    copies = {}
    for detection in sorted(detections, key=lambda detection: detection.focal is None):
        same = first.setdefault(tuple(line.tobytes() for line in detection.lines), detection.name)
        if same != detection.name:
            copies[detection.name] = f"it shows the same lines as {same}, being a copy: each counts once"
    return [detection for detection in detections if detection.name not in copies], copies


def _of_one_size(detections: Sequence[Detection]) -> tuple[list[Detection], dict[str, str]]:
    """The images of the most frequent size, and why the others are not used."""
    if not detections:
        return [], {}
    (width, height), _ = Counter(d.image_size for d in detections).most_common(1)[0]
    others = {}
    for detection in detections:
        if detection.image_size == (width, height):
            continue
        own = "x".join(map(str, detection.image_size))
        here = f"{OTHER_SIZE} {own} px, but most images have {width}x{height}"
        turned = detection.image_size == (height, width)
        others[detection.name] = here + (
            ": it was rotated, so rotate it back"
            if turned
            else ": use images as stored by the camera, neither resized nor cropped"
        )
    return [d for d in detections if d.image_size == (width, height)], others
