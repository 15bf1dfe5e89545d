"""discorpy's metadata: a radial polynomial of all powers, one focal length a file.

Its backward model, by which images are corrected: ``x_d = c + (x_u - c)(a0 + a1 r + a2 r² + ...)``, r the
distance of the corrected point from the centre in px, which counts from pixel centres. The file holds
neither the focal length nor the size of the image. A forward model, from distorted to corrected points, has
files that look the same: it is not read.
"""

import dataclasses
import math

import numpy as np
from jaxtyping import Float

from ._documents import lines_of
from ._forms import AbstractForm, minimax
from ._pinhole import contents
from .base import IN_PX, Contents, Export, Import, Node, NodeFormat

_TERMS = 6
"""Written: those of discorpy's own examples, and one more."""

_MOST = 12
"""Read."""


@dataclasses.dataclass(frozen=True)
class Powers(AbstractForm):
    """``z (a0 + a1 r + a2 r² + ...)``, ``r = |z|``, for radii in any unit.

    Attributes:
        terms: the number of coefficients.
    """

    terms: int
    corrects: bool = False

    @property
    def orders(self) -> Float[np.ndarray, "coefficient"]:
        """0, 1, 2, ...."""
        return np.arange(float(self.terms))

    def __call__(
        self, theta: Float[np.ndarray, "coefficient"], z: Float[np.ndarray, "point 2"]
    ) -> Float[np.ndarray, "point 2"]:
        """The mapped points."""
        return z * np.polynomial.polynomial.polyval(np.hypot(*z.T)[:, None], theta)

    def fit(
        self, start: Float[np.ndarray, "point 2"], end: Float[np.ndarray, "point 2"]
    ) -> Float[np.ndarray, "coefficient"]:
        """The coefficients that map points to others, with the least greatest distance."""
        r = np.hypot(*start.T)[:, None]
        matrix = np.stack([start * r**i for i in range(self.terms)], axis=-1)
        one = np.eye(self.terms)[0]
        change = minimax(lambda _: (matrix, end - start), lambda a: self(a + one, start) - end, self.terms)
        return change + one


class Discorpy(NodeFormat):
    """discorpy's coefficients of its backward model."""

    name, tools, suffixes = "discorpy", "discorpy, of X-ray tomography", (".txt",)
    note = "The coefficients are of discorpy's backward model, as unwarp_image_backward takes them."

    def forms(self, lens):
        """All powers of the radius."""
        return (Powers(_TERMS),)

    def text(self, nodes: list[Node], job: Export) -> str:
        """One number a line."""
        [node] = nodes
        values = [*node.centre, *node.form.rescaled(node.theta, 1 / job.lens.scale)]
        names = ["xcenter", "ycenter", *(f"factor{i}" for i in range(_TERMS))]
        return "".join(f"{name} = {float(value)!r}\n" for name, value in zip(names, values, strict=True))

    def recognises(self, head: str) -> bool:
        """By its first line."""
        return head.startswith("xcenter")

    def read(self, job: Import) -> Contents:
        """One camera a file; focal lengths are those of argument focal."""
        if job.focal is None or len(job.focal) != len(job.paths):
            raise ValueError(
                f"it holds no focal length: give argument focal, {len(job.paths)} of them{IN_PX}"
            )
        nodes, size, notes = [], job.size(), ()
        for path, focal in zip(job.paths, job.focal, strict=True):
            told, note = lines_of(path)
            lines, notes = [line for line in told if line.strip()], notes + note
            names, values = zip(*(line.split("=") for line in lines), strict=True)
            terms = len(lines) - 2
            if [n.strip() for n in names] != ["xcenter", "ycenter", *(f"factor{i}" for i in range(terms))]:
                raise ValueError("it must hold xcenter, ycenter, factor0, factor1, ..., one a line")
            numbers = np.array(values, float)
            if not 1 <= terms <= _MOST or not np.isfinite(numbers).all() or numbers[2] <= 0:
                raise ValueError(f"it must hold up to {_MOST} factors, finite numbers, the first positive")
            form = Powers(terms)
            theta = form.rescaled(numbers[2:], math.hypot(*size) / 2)
            nodes.append(Node(focal, form, theta, numbers[:2]))
        found = contents(nodes, size, job, mm=True)
        return dataclasses.replace(found, notes=(*found.notes, *notes))
