"""The compressed form of lines, whatever their distortion model and the metric of their distances."""

from ..lines.base import AbstractLines
from ..lines.compressed import CompressedLines, compress
from ..lines.lines import Lines
from .image_metric import in_corrected, measured_as
from .problem import Problem, about_own_centre


def compressed(lines: AbstractLines, terms: int) -> CompressedLines:
    """The lines, compressed unless they are already.

    For lines measured in the image (`in_image`), the lines underneath.
    """
    lines = about_own_centre(in_corrected(lines))
    if isinstance(lines, CompressedLines):
        lines.check_terms(terms)
        return lines
    if isinstance(lines, Lines):
        return compress(lines, terms)
    raise TypeError(
        f"Lines of type {type(lines).__name__} cannot be used here: pass Lines or compress(lines)."
    )


def small_of(lines: AbstractLines, terms: int) -> AbstractLines:
    """The lines compressed, under their own distortion model; the metric is the paper's."""
    plain = in_corrected(lines)
    return plain.compressed(terms) if isinstance(plain, Problem) else compressed(plain, terms)


def compressed_as_measured(lines: AbstractLines, terms: int) -> AbstractLines:
    """The lines compressed, measured as they were."""
    return measured_as(small_of(lines, terms), lines)
