"""Focal lengths of images: a CSV file ``image,focal``, perhaps with their deviations, ``sigma``."""

import csv
import math
import os
from collections.abc import Iterable
from pathlib import Path, PurePath


class FocalTable:
    """Focal lengths by the names of images.

    An image is looked up by its name with as many of its folders as the table gives: ``3x/board.png`` or,
    where that is enough to tell it from others, ``board.png``.
    """

    def __init__(
        self,
        focals: dict[str, float],
        path: str | os.PathLike[str] = "the table",
        sigmas: dict[str, float] | None = None,
    ):
        self._focals, self._sigmas = focals, sigmas or {}
        self._path = os.fspath(path)

    def row(self, image: str | os.PathLike[str]) -> str | None:
        """The name by which the table knows an image, or None if it does not."""
        parts = PurePath(image).parts
        names = ("/".join(parts[start:]) for start in range(len(parts)))
        return next((name for name in names if name in self._focals), None)

    def need(self, image: str | os.PathLike[str]) -> float:
        """The focal length of an image.

        Raises:
            ValueError: the table has none.
        """
        row = self.row(image)
        if row is None:
            raise ValueError(
                f"Cannot read focal lengths from {self._path}: it has no number for {PurePath(image).name}."
            )
        return self._focals[row]

    def sigma(self, image: str | os.PathLike[str]) -> float | None:
        """The standard deviation of an image's focal length, or None if the table tells none."""
        return self._sigmas.get(self.row(image) or "")

    def of(self, images: Iterable[str]) -> dict[str, float]:
        """The focal lengths of those images that the table knows.

        Raises:
            ValueError: one row is the only one for two images.
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
    """Read a CSV file whose first line names the columns ``image`` and ``focal``, and perhaps ``sigma``.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is something else, a focal length is no positive number, or an image comes twice
            with different ones; the message names the row.
    """
    try:
        with Path(path).open(newline="", encoding="utf-8-sig") as file:
            rows = [[cell.strip() for cell in row] for row in csv.reader(file) if row]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"Cannot read focal lengths from {os.fspath(path)}: it is not text.") from error
    header = [name.lower() for name in rows[0]] if rows else []
    if not {"image", "focal"} <= set(header):
        raise ValueError(
            f'Cannot read focal lengths from {os.fspath(path)}: its columns must be "image,focal", but '
            f"they are {','.join(header)!r}."
        )
    image, focal = header.index("image"), header.index("focal")
    column = header.index("sigma") if "sigma" in header else None
    table: dict[str, float] = {}
    sigmas: dict[str, float] = {}
    for number, row in enumerate(rows[1:], start=2):
        name = "/".join(PurePath(row[image].replace("\\", "/")).parts) if image < len(row) else ""
        value = _number(row[focal]) if focal < len(row) else None
        if not name or value is None or value <= 0:
            raise ValueError(
                f"Cannot read focal lengths from {os.fspath(path)}: row {number} must hold an image and a "
                f"positive number, but it is {','.join(row)!r}."
            )
        if table.setdefault(name, value) != value:
            raise ValueError(
                f"Cannot read focal lengths from {os.fspath(path)}: {name} comes twice, with "
                f"{table[name]:g} and, in row {number}, {value:g}."
            )
        if column is None or not (text := row[column] if column < len(row) else ""):
            continue
        sigma = _number(text)
        if sigma is None or sigma < 0:
            raise ValueError(
                f"Cannot read focal lengths from {os.fspath(path)}: sigma in row {number} must be a number "
                f"of at least 0, but it is {text!r}."
            )
        sigmas[name] = sigma
    return FocalTable(table, path, sigmas)


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
