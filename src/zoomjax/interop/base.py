"""What a file format is: small abstract classes, and what goes in and comes out.

A lens is written as *nodes*, one for each focal length: coefficients of the tool's formula (`_forms`). A
`NodeFormat` says which formulas its tool knows and what the file looks like, an `InterpolatedFormat` also
how the tool interpolates between focal lengths. Which focal lengths and coefficients to write is decided in
`_solve`; how a zoom lens is made from the nodes of a file, in `_lens`.
"""

import abc
import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from .._core.pixels import pitch_problem
from .._core.text import plain
from ..models.camera import px_of_focal_px
from ..models.lens import ZoomLens
from ._forms import AbstractForm
from .radial_table import RadialTable

TOLERANCE, CONVENTION = 0.1, "centres"
"""What is taken if it is not given."""

IN_PX = ", in mm, or in px with argument focal_unit"
"""What is said where focal lengths must be given."""

Theta = np.ndarray


@dataclasses.dataclass(frozen=True)
class Node:
    """The distortion at one focal length, in a tool's formula.

    Attributes:
        focal: focal length in the lens's unit.
        form: the formula.
        theta: its coefficients, for radii in half image diagonals.
        centre: centre of distortion, px, (0, 0) being the centre of the top-left pixel.
        frame: number of the frame in a track; None without one.
        stretch: by how much the tool's unit of x and of y is longer than `theta` has it: (1, 1) unless its
            pixels are not quite square.
        focal_px: focal length in px of the tool's rays through corrected points, where the formula leaves
            the scale of these free and a field of view tells it; None elsewhere.
    """

    focal: float
    form: AbstractForm
    theta: Theta
    centre: np.ndarray
    frame: int | None = None
    stretch: tuple[float, float] = (1.0, 1.0)
    focal_px: float | None = None

    def __call__(self, z: np.ndarray) -> np.ndarray:
        """What the tool makes of points, in half image diagonals from the centre."""
        return self.form(self.theta, z / np.array(self.stretch)) * np.array(self.stretch)


@dataclasses.dataclass(frozen=True)
class Sampled:
    """The distortion at one focal length as pairs of points, px.

    Attributes:
        focal: focal length in the lens's unit.
        distorted, corrected: the pairs, (point, 2).
        centre: centre of distortion, px; None if not known.
        corrects: whether the file maps distorted to corrected points.
    """

    focal: float
    distorted: np.ndarray
    corrected: np.ndarray
    centre: np.ndarray | None = None
    corrects: bool = True


@dataclasses.dataclass(frozen=True)
class Report:
    """How well a lens went into a file or came out of it.

    Attributes:
        format: name of the format.
        focal: focal lengths of the nodes, increasing or in the order of frames.
        at_nodes: the greatest error at the nodes, px, over the whole image. A file that maps corrected to
            distorted points is judged in the distorted image, others in the corrected one.
        between: the greatest error between the nodes, where the tool interpolates, px; None where it does
            not. Of a file that was read: against the tool's own interpolation.
        notes: what the user should know: how the file is to be used, and where the format cannot do better.
        files: the files written, or read.
    """

    format: str
    focal: tuple[float, ...]
    at_nodes: float
    between: float | None
    notes: tuple[str, ...] = ()
    files: tuple[Path, ...] = ()

    @property
    def worst(self) -> float:
        """The greatest error anywhere, px."""
        return max(self.at_nodes, self.between or 0.0)

    def __str__(self) -> str:
        number = len(self.focal)
        text = f"{self.format}: {number} focal length{'s' * (number > 1)}, error up to "
        text += f"{self.at_nodes:.2g} px at {'them' if number > 1 else 'it'}"
        if self.between is not None:
            text += f" and {self.between:.2g} px between"
        return "\n".join([f"{text}.", *self.notes])


@dataclasses.dataclass(frozen=True)
class Export:
    """What is to be written.

    Attributes:
        lens: the lens.
        focal: focal lengths to write, in the lens's unit; None to choose them.
        frames: the number of the frame of each; None without a track.
        pixel_pitch: mm from one pixel to the next; None if not known.
        tolerance: error between focal lengths that more of them must keep, px.
        convention: of pixel positions, for STMaps.
        suffix: of the file's name, for formats of several.
    """

    lens: ZoomLens
    focal: tuple[float, ...] | None = None
    frames: tuple[int, ...] | None = None
    pixel_pitch: float | None = None
    tolerance: float = TOLERANCE
    convention: str = CONVENTION
    suffix: str = ""

    @property
    def stems(self) -> list[str]:
        """A name for each focal length or frame."""
        if self.frames is not None:
            return [f"{frame:06d}" for frame in self.frames]
        return [f"{focal:.10g}" for focal in self.focal or ()]

    @property
    def pitch(self) -> float:
        """mm from one pixel to the next; ValueError if not known."""
        if self.pixel_pitch is None:
            raise ValueError(
                "Argument pixel_pitch, mm from one pixel to the next (the sensor's width over that of the "
                "image in px), must be given: this format needs the size of the sensor."
            )
        return self.pixel_pitch

    def focal_px(self, focal: Any) -> Any:
        """Focal lengths in px; ValueError if the pixel pitch is needed and not known."""
        return focal * px_of_focal_px(self.lens) if self.lens.focal_unit == "px" else focal / self.pitch

    def focal_mm(self, focal: Any) -> Any:
        """Focal lengths in mm; ValueError if the pixel pitch is needed and not known."""
        return focal if self.lens.focal_unit == "mm" else self.focal_px(focal) * self.pitch


@dataclasses.dataclass(frozen=True)
class Import:
    """What is to be read, and what the file may not say.

    Attributes:
        path: the file, or a folder of them.
        paths: the files.
        image_size: (width, height) px, for files that do not say it.
        focal: focal lengths of the files or entries, for those that do not say them.
        focal_unit: of these: "mm" or "px".
        crop: crop factor of the camera, for lensfun.
        name: of the lens, in files of several; a part of it will do.
        direction: of an STMap: "undistort" or "redistort".
        convention: of pixel positions, for STMaps; None if it is not given.
    """

    path: Path
    paths: tuple[Path, ...]
    image_size: tuple[int, int] | None = None
    focal: tuple[float, ...] | None = None
    focal_unit: str = "mm"
    crop: float | None = None
    name: str | None = None
    direction: str | None = None
    convention: str | None = None

    def size(self, told: tuple[Any, Any] | None = None) -> tuple[int, int]:
        """The image size, told in the file or given; ValueError if neither, or both and unlike.

        Told as numbers or words of them, which have to be whole and positive.
        """
        found = None if told is None else (_whole(told[0]), _whole(told[1]))
        if found is None and self.image_size is None:
            raise ValueError("it holds no image size: give argument image_size, (width, height) in px")
        if found is not None and self.image_size not in (None, found):
            here, given = ("x".join(map(str, size)) for size in (found, self.image_size or found))
            raise ValueError(f"its images are {here} px: leave out argument image_size, which is {given}")
        return found or self.image_size or (0, 0)


def _whole(side: Any) -> int:
    """A side of an image, px."""
    value = math.nan if isinstance(side, bool) else float(side)
    if not (value >= 1 and value == math.floor(value) < math.inf):
        raise ValueError(f"its images are {side} px wide or high, which is no whole number of them")
    return int(value)


@dataclasses.dataclass(frozen=True)
class Contents:
    """What a file holds.

    Attributes:
        nodes: by focal length.
        image_size: (width, height) px.
        focal_unit: "mm" or "px".
        notes: what the user should know.
        pixel_pitch: mm from one pixel to the next; None if the file does not say it.
        about: words and numbers for `ZoomLens.about`.
        between: where the tool interpolates, what it makes of the interval after the node of a number, in
            the order of focal lengths, at a share of the way; None where it does not.
        table: the nodes as the tool's table of radial polynomials, where it is one.
    """

    nodes: tuple[Node | Sampled, ...]
    image_size: tuple[int, int]
    focal_unit: str
    notes: tuple[str, ...] = ()
    pixel_pitch: float | None = None
    about: Mapping[str, str | float] = dataclasses.field(default_factory=dict)
    between: Callable[[int, float], Node] | None = None
    table: RadialTable | None = None


def possible(contents: Contents) -> Contents:
    """Without a width of pixels that no sensor has, of which a note tells instead."""
    problem = pitch_problem(contents.pixel_pitch, contents.image_size)
    if problem is None:
        return contents
    note = f"Its sensor, or focal lengths, are in another unit: {problem}. That of a pixel is left open."
    return dataclasses.replace(contents, pixel_pitch=None, notes=(*contents.notes, note))


def one_size(sizes: list[tuple[int, int]]) -> tuple[int, int]:
    """The image size that all entries share; ValueError if they do not."""
    if len(found := sorted(set(sizes))) != 1:
        names = ", ".join(f"{width}x{height}" for width, height in found[:3]) or "none"
        raise ValueError(
            f"a lens is for images of one size, and it has {len(found)} of them ({names}): put the entries "
            "of each size into a file or folder of their own, and read these one after the other"
        )
    return found[0]


def refuse_others(told: Mapping[str, Any], read: Mapping[str, Any]) -> None:
    """Raise ValueError where a file says what the reader has no model of.

    Args:
        told: what the file says by name, words or numbers; it need not say all.
        read: the word or number that alone is read, by name.
    """
    for name, only in read.items():
        value = told.get(name, only)
        if isinstance(only, str) or isinstance(value, str):
            same = value == only
        else:
            same = np.allclose(np.asarray(value, float), only, rtol=1e-6, atol=1e-12)
        if not same:
            raise ValueError(f"its {name} is {plain(str(value))}, and only {only} is read")


def not_alike(entries: Iterable[tuple[float, Any]]) -> tuple[str, ...]:
    """What is said of entries of one focal length, mm, that differ, where the first of each is read."""
    first: dict[float, Any] = {}
    for focal, values in entries:
        if first.setdefault(focal, values) != values:
            return (f"Entries of one focal length are not alike, as at {focal:g} mm: the first is read.",)
    return ()


_FAR = 0.2
"""Of half the diagonal, by which centres are off the middle in crops and by mistake alone."""


def off_middle(nodes: Iterable["Node | Sampled"], size: tuple[int, int]) -> tuple[str, ...]:
    """What is said of a centre so far from the middle that the size may be that of other images."""
    middle = (np.array(size) - 1) / 2
    off = max((math.dist(node.centre, middle) for node in nodes if node.centre is not None), default=0.0)
    if off < _FAR * math.hypot(*size) / 2:
        return ()
    return (
        f"Its centre is up to {off:.3g} px from the middle of images of {size[0]} x {size[1]} px: unless "
        "these were cropped, its numbers are of images of another size.",
    )


def read_text(path: Path) -> str:
    """The text of a file in UTF-8, without the mark that some programs put before it."""
    return path.read_text(encoding="utf-8-sig")


class Format(abc.ABC):
    """A file format of another tool, which is read at least.

    Attributes:
        name: in arguments and tables.
        tools: who reads it.
        suffixes: of its files; the first is that of files written.
        exact: whether the tool's formula is ours, so that radial polynomials lose nothing but digits.
        exact_for: a distortion model that is exact in a format that is not; None if there is none.
        zoom: what the format knows of zooming: "one" focal length a file, a "list" of independent ones, or
            "interpolated" between its nodes.
        writes: whether it is written, too.
        note: what a user of a file should know.
        options: those arguments of `write` and `read` that not every format uses, and this one does. All
            use ``focal`` for writing.
    """

    name: ClassVar[str]
    tools: ClassVar[str]
    suffixes: ClassVar[tuple[str, ...]]
    exact: ClassVar[bool] = False
    exact_for: ClassVar[str | None] = None
    zoom: ClassVar[str] = "one"
    writes: ClassVar[bool] = True
    note: ClassVar[str | None] = None
    options: ClassVar[tuple[str, ...]] = ()

    def recognises(self, head: str) -> bool:
        """Whether a file of one of the `suffixes` is of this format, by its first characters."""
        return True

    @abc.abstractmethod
    def read(self, job: Import) -> Contents:
        """What the file holds; ValueError, KeyError and the like where it is damaged."""

    def file_names(self, job: Export) -> list[str]:
        """The names of several files in a folder: each node's, by its focal length or frame."""
        return [f"{stem}{self.suffixes[0]}" for stem in job.stems]


class NodeFormat(Format):
    """A format of nodes: a formula's coefficients at each focal length, as text."""

    options = ("focal",)

    @abc.abstractmethod
    def forms(self, lens: ZoomLens) -> tuple[AbstractForm, ...]:
        """The tool's formulas that suit the lens, the preferred one first."""

    @abc.abstractmethod
    def text(self, nodes: list[Node], job: Export) -> str:
        """The file."""

    def notes(self, nodes: list[Node], job: Export) -> tuple[str, ...]:
        """What the user of this very file should know."""
        return () if self.note is None else (self.note,)


class InterpolatedFormat(NodeFormat):
    """A format whose tool interpolates between the nodes."""

    zoom = "interpolated"
    options = ("tolerance", "focal")

    @abc.abstractmethod
    def foreign(self, node: Node, job: Export) -> np.ndarray:
        """The numbers that the tool interpolates."""

    @abc.abstractmethod
    def native(self, numbers: np.ndarray, focal: float, like: Node, job: Export) -> Node:
        """The node at a focal length that interpolated numbers mean."""

    def kept(self, nodes: list[Node]) -> list[Node]:
        """The nodes with what the file holds once for all of them, by default nothing."""
        return nodes

    def interpolate(self, focal: np.ndarray, numbers: np.ndarray, at: float) -> np.ndarray:
        """The tool's own interpolation, by default linear: of numbers (node, n) at focal lengths."""
        return np.array([np.interp(at, focal, column) for column in numbers.T])

    def spread(self, low: float, high: float, number: int) -> np.ndarray:
        """That many focal lengths over a range, by default in geometric progression."""
        return np.geomspace(low, high, number)


class FolderFormat(Format):
    """A format that is always a folder of files, made of the lens itself and of no formula."""

    @abc.abstractmethod
    def write_all(self, job: Export, folder: Path) -> tuple[float, tuple[str, ...]]:
        """Write the files; return the greatest error that writing itself made, px, and notes."""
