"""The reader of all CSV files: tables of numbers in text files from any program.

The first line names the columns. The expected names are known, so the separator (comma, semicolon or tab)
is the one that yields them: nothing is guessed from the numbers. A row must have as many fields as the
first line, so that a decimal comma in comma-separated files is an error. Numbers must be in plain decimal
notation: no ``nan``, ``0x10``, ``1_000`` or digits of other scripts.

Files of numbers alone, without quotes and comments, are read by `numpy.loadtxt` after a count of the
separators in each line, which is some five times faster. All others, and those where that fails, are read
row by row by `csv.reader`, which defines the result and the error messages.
"""

import codecs
import csv
import dataclasses
import difflib
import errno
import io
import itertools
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

_ALIKE = 0.85
"""Of two names, from 0 to 1: from here on one is meant for the other; of weight and height it is less."""

_SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs"}

_ENCODINGS = (  # UTF-32's mark begins with that of UTF-16
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
"""Of files that begin with a byte-order mark."""

_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_GROUPED = re.compile(r"[+-]?[1-9][0-9]{0,2},[0-9]{3}")
"""What may be 1.234 or 1234."""


def plain_number(text: str) -> float | None:
    """The finite number in a text in plain decimal notation, or None.

    Unlike `float`, it does not accept ``nan``, ``inf``, ``1_000`` and digits of other scripts.

    Example:
        >>> plain_number(" 2.5e1 "), plain_number("1_000"), plain_number("20,5")
        (25.0, None, None)
    """
    text = text.strip()
    value = float(text) if _NUMBER.fullmatch(text) else np.inf
    return value if np.isfinite(value) else None


@dataclasses.dataclass(frozen=True)
class TextTable:
    """Columns of a text file.

    Attributes:
        path: of the file.
        what: what it holds, for errors.
        numbers: the columns of numbers, float64; NaN where a cell that may be empty is.
        texts: the columns of texts.
        rows: for each row the line of the file that it is in, from 1.
    """

    path: str
    what: str
    numbers: dict[str, np.ndarray]
    texts: dict[str, list[str]]
    rows: np.ndarray

    def error(self, reason: str) -> ValueError:
        """An error that names the file."""
        return _error(self.path, self.what, reason)

    def check(self, name: str, good: np.ndarray, must: str) -> None:
        """Refuse the file unless all of a column is good.

        Raises:
            ValueError: some is not; the message names the first row, and what it must be.
        """
        if not good.all():
            bad = int(np.argmin(good))
            raise self.error(
                f"{name} in row {self.rows[bad]} must be {must}, but it is {self.numbers[name][bad]:.17g}"
            )

    def integers(self, name: str) -> np.ndarray:
        """A column of integers, int64.

        Raises:
            ValueError: a number is none; the message names the row.
        """
        values = self.numbers[name]
        self.check(name, values == np.floor(values), "an integer")
        self.check(name, abs(values) < 2**53, "below 2^53 (number from 0 what has time stamps as names)")
        return values.astype(np.int64)


def read_text_table(
    path: str | os.PathLike[str],
    what: str,
    *,
    numbers: Sequence[str],
    texts: Sequence[str] = (),
    one_of: Sequence[str] = (),
    optional: Sequence[str] = (),
    gaps: Sequence[str] = (),
) -> TextTable:
    """Read the named columns of a text file, in any order and case; others are ignored.

    But one that is called nearly as an optional column that is not there is refused.

    Text is UTF-8, or UTF-16 or UTF-32 with a byte-order mark. Columns are separated by commas, semicolons
    or tabs; cells may be quoted. Between semicolons numbers may have decimal commas, and between tabs where
    that is certain. Empty lines, and lines that begin with ``#``, do not count.

    Args:
        path: the file.
        what: what it holds, for errors.
        numbers, texts: required columns.
        one_of: columns of numbers of which exactly one is required.
        optional: optional columns of numbers.
        gaps: columns of numbers whose cells may be empty.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is not such a table, or is ambiguous; the message names file and row.
    """
    source = os.fspath(path)
    if os.path.isdir(source):
        raise IsADirectoryError(errno.EISDIR, f"cannot read {what} where there is a folder", source)
    try:
        text = _decoded(Path(path).read_bytes())
        line, first, body = _split_header(text)
        separator, names = _header(first, (*texts, *numbers), one_of)
        wanted = [n for n in (*texts, *numbers, *one_of, *optional) if n in names]
        for name in wanted:
            if names.count(name) > 1:
                raise ValueError(f"its first line names the column {name} twice")
        _refuse_misspelled(names, wanted, optional)
        if len(chosen := [n for n in one_of if n in names]) > 1:
            raise ValueError(f"it has the columns {' and '.join(chosen)}: keep one of them")
        fast = None if texts else _fast(body, separator, names, wanted, line)
        if fast is None:
            fast = _row_by_row(body, separator, names, wanted, texts, gaps, line)
        columns, rows = fast
        if not len(rows):
            raise ValueError("there are no rows after the first line")
    except csv.Error as error:
        raise _error(source, what, f"its quotes or fields are damaged ({error})") from error
    except ValueError as error:
        raise _error(source, what, str(error)) from error
    return TextTable(
        source,
        what,
        {name: np.asarray(columns[name]) for name in wanted if name not in texts},
        {name: list(columns[name]) for name in texts},
        rows,
    )


def has_columns(path: str | os.PathLike[str], names: Sequence[str]) -> bool:
    """Whether a file names all of these columns, as `read_text_table` reads it.

    Raises:
        OSError: the file cannot be read.
    """
    try:
        _header(_split_header(_decoded(Path(path).read_bytes()))[1], names, ())
    except ValueError:
        return False
    return True


def _error(path: str, what: str, reason: str) -> ValueError:
    return ValueError(f"Cannot read {what} from {path}: {reason.rstrip('.')}.")


def _decoded(content: bytes) -> str:
    """The text, with lines that end in a line feed."""
    if content.startswith(b"PK\3\4"):
        raise ValueError("it is not text but an archive or a spreadsheet. Export it as CSV")
    encoding = next((name for mark, name in _ENCODINGS if content.startswith(mark)), "utf-8")
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError as error:
        row = content.count(b"\n", 0, error.start) + 1
        name, byte = encoding.removesuffix("-sig").upper(), content[error.start]
        raise ValueError(
            f"it is not text in {name}: the byte 0x{byte:02x} in row {row} is none of its characters. It "
            "may be in Latin-1 or another encoding: save it as UTF-8"
        ) from error
    if "\0" in text:
        raise ValueError(
            "it is not text: it holds zero bytes. If it is in UTF-16, save it as UTF-8, or with its mark"
        )
    if "\r" in text:
        text = text.replace("\r\n", "\n").replace("\r", "\n")
    return text


def _split_header(text: str) -> tuple[int, str, str]:
    """The number of the line that names the columns, the line, and the text after it."""
    number, start = 0, 0
    while start < len(text):
        end = text.find("\n", start)
        end = len(text) if end < 0 else end
        number, line, start = number + 1, text[start:end], end + 1
        plain = line.strip().strip('"')
        # Excel's own first line, sep=; tells what the second shows.
        if plain.strip(",;\t ") and plain[0] != "#" and not plain.lower().startswith("sep="):
            return number, line, text[start:]
    return number, "", ""


def _refuse_misspelled(names, wanted, optional):
    """ValueError for a column whose name is nearly that of an optional one: it would not count."""
    for name, meant in itertools.product(set(names) - set(wanted), set(optional) - set(names)):
        if name.startswith(meant) or difflib.SequenceMatcher(None, name, meant).ratio() > _ALIKE:
            raise ValueError(f"its column {name} would not count: {meant} is what it is called")


def _header(line: str, required: Sequence[str], one_of: Sequence[str]) -> tuple[str, list[str]]:
    """The separator that yields the columns, and their names."""
    for separator in _SEPARATORS:
        try:
            cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True, strict=True), [])
        except csv.Error:
            continue
        names = [cell.strip().lower() for cell in cells]
        if set(required) <= set(names) and (not one_of or set(one_of) & set(names)):
            return separator, names
    columns = ",".join(required)
    choice = [",".join((name, *required)) for name in one_of] or [columns]
    wanted = " or ".join(f'"{each}"' for each in choice)
    shown = line.strip() if len(line) <= 80 else f"{line.strip()[:77]}..."
    raise ValueError(
        f"its first line must name the columns {wanted}, separated by commas, semicolons or tabs, but it "
        f"is {shown!r}"
    )


def _fast(
    body: str, separator: str, names: list[str], wanted: list[str], line: int
) -> tuple[dict[str, np.ndarray], np.ndarray] | None:
    """The columns, if the file is plain enough for `numpy.loadtxt`, else None."""
    if '"' in body or "#" in body or not all(names):
        return None
    if separator != "," and "," in body:
        if separator == "\t" or "." in body:
            return None  # whether it is a decimal comma is a question of its own
        body = body.replace(",", ".")
    content = np.frombuffer(body.encode(), np.uint8)
    ends = np.flatnonzero(content == ord("\n"))
    ends = ends if body.endswith("\n") or not body else np.append(ends, len(content))
    starts = np.append(0, ends[:-1] + 1)[: len(ends)]
    present = ends > starts
    places = np.flatnonzero(content == ord(separator))
    counts = np.searchsorted(places, ends) - np.searchsorted(places, starts)
    if not present.any() or (counts[present] != len(names) - 1).any():
        return None
    try:
        used = [names.index(name) for name in wanted]
        table = np.loadtxt(io.StringIO(body), delimiter=separator, usecols=used, ndmin=2, comments=None)
    except (ValueError, IndexError):
        return None
    if len(table) != present.sum() or not np.isfinite(table).all():
        return None
    return dict(zip(wanted, table.T, strict=True)), line + 1 + np.flatnonzero(present)


def _row_by_row(
    body: str,
    separator: str,
    names: list[str],
    wanted: list[str],
    texts: Sequence[str],
    gaps: Sequence[str],
    line: int,
) -> tuple[dict[str, np.ndarray | list[str]], np.ndarray]:
    cells: dict[str, list[str]] = {name: [] for name in wanted}
    rows = []
    index = {name: names.index(name) for name in wanted}
    nameless = [i for i, name in enumerate(names) if not name]
    for row, fields in _fields(body, separator, line):
        if not any(fields):
            continue
        extra = [*fields[len(names) :], *(fields[i] for i in nameless if i < len(fields))]
        if len(fields) < len(names) or any(extra):
            raise ValueError(_wrong_number(row, fields, names, separator))
        for name, column in cells.items():
            column.append(fields[index[name]])
        rows.append(row)
    decimal = _decimal_comma({n: c for n, c in cells.items() if n not in texts}, rows, separator)
    columns: dict[str, np.ndarray | list[str]] = {}
    for name, column in cells.items():
        if name in texts:
            columns[name] = column
            continue
        values = np.empty(len(column))
        for i, cell in enumerate(column):
            value = plain_number(cell.replace(",", ".") if decimal else cell)
            if value is None and not (name in gaps and not cell):
                raise ValueError(_no_number(name, rows[i], cell))
            values[i] = np.nan if value is None else value
        columns[name] = values
    return columns, np.array(rows, int)


def _fields(body: str, separator: str, line: int) -> Iterator[tuple[int, list[str]]]:
    """Each row's line in the file, and its fields."""
    number = line

    def lines() -> Iterator[str]:
        nonlocal number
        for text in io.StringIO(body):
            number += 1
            if not text.lstrip().startswith("#"):
                yield text

    for fields in csv.reader(lines(), delimiter=separator, skipinitialspace=True, strict=True):
        yield number, [field.strip() for field in fields]


def _wrong_number(row: int, fields: list[str], names: list[str], separator: str) -> str:
    more = len([*fields]) > len(names) or not all(names)
    message = f"row {row} has {len(fields)} fields, and the first line has {sum(map(bool, names))} columns"
    if more and separator == "," and any(field.isdecimal() for field in fields[1:]):
        message += (
            ". If its numbers have decimal commas, write decimal points, or separate the columns by "
            "semicolons"
        )
    elif more:
        message += ". Quote what holds the separator"
    return message


def _no_number(name: str, row: int, cell: str) -> str:
    shown = cell if len(cell) <= 40 else f"{cell[:37]}..."
    if not cell:
        return f"{name} in row {row} is empty"
    hint = ": write a decimal point" if "," in cell else ""
    return f"{name} in row {row} is {shown!r}, which is no number{hint}"


def _decimal_comma(columns: dict[str, list[str]], rows: list[int], separator: str) -> bool:
    """Whether commas in numbers are decimal commas.

    Raises:
        ValueError: that is not certain.
    """
    if separator == ",":
        return False
    with_comma = [(name, i) for name, cells in columns.items() for i, c in enumerate(cells) if "," in c]
    if not with_comma:
        return False
    name, i = with_comma[0]
    cell = columns[name][i]
    if any("." in c for cells in columns.values() for c in cells):
        raise ValueError(
            f"{name} in row {rows[i]} is {cell!r}, and other numbers have a decimal point. Write all with "
            "one, and none with commas"
        )
    if separator == "\t" and all(_GROUPED.fullmatch(columns[n][j]) for n, j in with_comma):
        whole = cell.replace(",", "")
        raise ValueError(
            f"{name} in row {rows[i]} is {cell!r}, which may be {cell.replace(',', '.')} or {whole}. Write "
            "numbers with a decimal point"
        )
    return True
