"""Safe display and use of file names that others chose."""

import math
import re
import unicodedata
from collections.abc import Iterable

_LONGEST = 80

_OPENCV_NO_MEMORY = -4
"""``cv2.Error.StsNoMem``."""


def plain(text: str) -> str:
    """Text on one line without control characters for a terminal or a browser.

    Control characters (escape sequences, line breaks), those that turn the direction of writing, and
    bytes that are no text are shown as in Python: ``\\x1b``.
    """
    if text.isascii() and text.isprintable():  # at once: pictures in a page are millions of characters
        return text
    return "".join(c if _is_harmless(c) else c.encode("unicode_escape").decode() for c in text)


def reason(error: Exception) -> str:
    """The message of an error about one file, on one line, without the operating system's error numbers."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    if isinstance(error, MemoryError) or getattr(error, "code", 0) == _OPENCV_NO_MEMORY:
        return "there is not enough memory for it"
    return " ".join(str(error).split())


def _is_harmless(character: str) -> bool:
    # Cc control, Cf direction, joiners and marks, Cs halves of pairs, Zl and Zp breaks of lines
    return (
        unicodedata.category(character) not in {"Cc", "Cf", "Cs", "Zl", "Zp"} or character in "\u200c\u200d"
    )


def span(low: float, high: float, unit: str) -> str:
    """Two ends in their unit, or the one value that both are."""
    ends = [f"{value:.5g}" for value in (low, high)]
    return f"{' to '.join(dict.fromkeys(ends))} {unit}"


def percentages(shares: Iterable[float]) -> str:
    """The ends of some shares, or the one value that all are, as percentages."""
    every = [float(share) for share in shares]
    return " to ".join(dict.fromkeys(f"{end:.2%}" for end in (min(every), max(every))))


def with_std(value: float, std: float, unit: str) -> str:
    """A signed value and its standard deviation, to the second figure of the latter."""
    if not math.isfinite(std):
        return f"{value:+.4g} {unit} (uncertainty unknown)"
    decimals = 2 if std <= 0 else min(max(1 - math.floor(math.log10(std)), 0), 6)
    return f"{value:+.{decimals}f} ± {std:.{decimals}f} {unit}"


def listed(names: Iterable[str], most: int, between: str = ", ") -> str:
    """The first names, and how many more there are."""
    first = list(names)
    rest = len(first) - most
    return between.join(first[:most]) + (f" and {rest} more" if rest > 0 else "")


def numbered_name(number: int, name: str, suffix: str) -> str:
    """A file's name for what is made of the image `name`: with its number, so that no two are the same.

    Of the image's name remain letters, digits and ``._+-``, the last 80 at most; no folder. It is good on
    every system: the number keeps it from being a device's.
    """
    last = re.split(r"[/\\]", name)[-1].rpartition(".")
    text = unicodedata.normalize("NFC", last[0] or last[2])
    kept = "".join(c if c in "._+-" or unicodedata.category(c)[0] in "LMN" else "_" for c in text)
    readable = re.sub("_+", "_", kept).strip("._-")
    while len(readable.encode()) > _LONGEST:
        readable = readable[1:]
    return f"{number:04d}-{readable or 'image'}{suffix}"
