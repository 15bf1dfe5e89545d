"""What is kept of photos whose lines determine no lens: the lines, drawn, and the verdict.

Without it nobody could see what was taken for straight.
"""

import contextlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import cv2

from ..detect.batch import Detection
from .image_job import ImageJob, overlay_name
from .meanwhile import image_of
from .overlay import draw_lines
from .results_folder import OF_A_LENS, results_folder

_MOST = 24
"""Photos drawn, unless all are asked for."""

_SENTENCE = (
    "The lines found in the images do not determine a lens: they are too few, or not straight in the scene."
    " Photograph a scene with long straight lines."
)


class Undetermined(ValueError):
    """No lens can be fitted to the lines of photos.

    Attributes:
        job: the settings of the calibration.
        images: the names of all photos; pictures are numbered by their place in it, from 1.
        used: the photos, with what was found in each.
        unused: for each photo that was not used, the reason.
    """

    def __init__(
        self, job: ImageJob, images: Sequence[str], used: Sequence[Detection], unused: dict[str, str]
    ):
        super().__init__(_SENTENCE)
        self.job, self.images, self.used, self.unused = job, images, used, unused

    def keep(self, folder: Path, *, overwrite: bool) -> str:
        """Write the photos with their lines, and summary.json, unless a lens is there; say where."""
        if (folder / "lens.json").exists():
            return f"What is in {folder} was left as it is."
        names = self._pictures()
        files = ["summary.json", *(f"lines/{name}" for name in names.values())]
        with results_folder(folder, files, clears=OF_A_LENS, overwrite=overwrite) as part:
            if names:
                (part / "lines").mkdir()
                self._draw(part / "lines", names)
            (part / "summary.json").write_text(json.dumps(self._summary(), indent=2) + "\n")
        if not names:
            return f"How many were found in each is in {folder / 'summary.json'}."
        return f"They are drawn in {folder / 'lines'}: look whether they follow straight things."

    def _pictures(self) -> dict[str, str]:
        """For each photo that is to be drawn, the name of its picture."""
        numbers = {name: number for number, name in enumerate(self.images, start=1)}
        most = {"some": _MOST, "all": len(self.used), "none": 0}[self.job.overlays]
        return {of.name: overlay_name(numbers[of.name], of.name) for of in self.used[:most]}

    def _summary(self):
        images = [
            {"name": of.name, "lines": len(of.lines), "unexplained": of.unexplained} for of in self.used
        ]
        return {
            "verdict": "not determined",
            "verdict_sentence": str(self),
            "detector": self.job.detector,
            "images": images,
            "unused": self.unused,
        }

    def _draw(self, folder: Path, names: Mapping[str, str]) -> None:
        found = {of.name: of for of in self.used if of.name in names}
        for source in self.job.again(found.values()):
            of, name = found[source.name], names[source.name]
            lines = of.lines
            labels = {line: str(line) for line in range(len(lines))}
            picture = draw_lines(
                image_of(source, of.image_size), lines, [False] * len(lines), labels=labels
            )
            done, content = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 88])
            assert done
            (folder / name).write_bytes(content.tobytes())


@contextlib.contextmanager
def told_undetermined(
    job: ImageJob, images: Sequence[str], used: Sequence[Detection], unused: dict[str, str]
) -> Iterator[None]:
    """Say of an error that no model can be compared what it means of photos: too few straight lines.

    Raises:
        Undetermined: that error.
    """
    try:
        yield
    except ValueError as error:
        if not str(error).startswith("No candidate can be compared"):
            raise
        raise Undetermined(job, images, used, unused) from error
