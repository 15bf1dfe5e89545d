"""Tables of focal lengths: CSV files ``image,focal``, optionally with standard deviations, ``sigma``."""

import math
import os
from collections.abc import Iterable
from pathlib import PurePath

import numpy as np

from .._core.checks import check_above
from .text_table import read_text_table


class FocalTable:
    """Focal lengths by the names of images.

    An image is looked up by its name with as many of its folders as the table gives: ``3x/board.png`` or,
    where that is unique, ``board.png``. If several rows fit, the one with most folders is used.

    Raises:
        ValueError: a focal length is not a positive number, or a standard deviation not one of at least 0.
    """

    def __init__(
        self,
        focals: dict[str, float],
        path: str | os.PathLike[str] = "the table",
        sigmas: dict[str, float] | None = None,
    ):
        for name, focal in focals.items():
            check_above(0, **{f"focals[{name!r}]": focal})
        for name, sigma in (sigmas or {}).items():
            if not sigma >= 0:
                raise ValueError(
                    f"Argument sigmas[{name!r}] must be a number of at least 0, but it is {sigma!r}."
                )
        self._focals, self._sigmas = focals, sigmas or {}
        self._path = os.fspath(path)

    def row(self, image: str | os.PathLike[str]) -> str | None:
        """The name of an image in the table, or None if it is not there."""
        parts = PurePath(image).parts
        names = (PurePath(*parts[start:]).as_posix() for start in range(len(parts)))
        return next((name for name in names if name in self._focals), None)

    def need(self, image: str | os.PathLike[str]) -> float:
        """The focal length of an image.

        Raises:
            ValueError: the table has none.
        """
        row = self.row(image)
        if row is None:
            raise ValueError(
                f"Cannot read focal lengths from {self._path}: it has no focal length for "
                f"{PurePath(image).name}."
            )
        return self._focals[row]

    def sigma(self, image: str | os.PathLike[str]) -> float | None:
        """The standard deviation of an image's focal length, or None if the table has none."""
        return self._sigmas.get(self.row(image) or "")

    def of(self, images: Iterable[str]) -> dict[str, float]:
        """The focal lengths of those images that are in the table.

        Raises:
            ValueError: two images have the same row.
        """
        found: dict[str, str] = {}
        for image in images:
            row = self.row(image)
            if row is None:
                continue
            if row in found:
                raise ValueError(
                    f"{self._path} has one row {row} for two images, {found[row]} and {image}: write the "
                    "folder before the name, in a row for each."
                )
            found[row] = image
        return {image: self._focals[row] for row, image in found.items()}


def read_focal_table(path: str | os.PathLike[str]) -> FocalTable:
    """Read a CSV file with the columns ``image``, ``focal`` and optionally ``sigma``.

    For the format see `zoomjax.io.text_table`. A name that begins with ``#`` must be quoted.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not such a table, a focal length is not a positive number, or an image is
            listed twice with different numbers; the message names the row.
    """
    table = read_text_table(
        path, "focal lengths", texts=("image",), numbers=("focal",), optional=("sigma",), gaps=("sigma",)
    )
    focal = table.numbers["focal"]
    sigma = table.numbers.get("sigma", np.full(focal.size, np.nan))
    table.check("focal", focal > 0, "a positive number")
    table.check("sigma", ~(sigma < 0), "a number of at least 0")
    found: dict[str, tuple[float, float | None]] = {}
    for row, text, value, std in zip(
        table.rows, table.texts["image"], focal.tolist(), sigma.tolist(), strict=True
    ):
        name = PurePath(text.replace("\\", "/")).as_posix()
        if name == ".":
            raise table.error(f"row {row} must name an image, but image is empty")
        told = (value, None if math.isnan(std) else std)
        if found.setdefault(name, told) != told:
            raise table.error(
                f"{name} is listed twice, with {_told(*found[name])} and, in row {row}, {_told(*told)}"
            )
    return FocalTable(
        {name: value for name, (value, _) in found.items()},
        path,
        {name: std for name, (_, std) in found.items() if std is not None},
    )


def _told(value: float, std: float | None) -> str:
    return f"{value:g}" if std is None else f"{value:g} ± {std:g}"
