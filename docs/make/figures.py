"""Which figures a page states, and whether the results bear them out: held by ``tests/test_figures.py``.

A *figure* is a number with a decimal point or a unit, outside of code, links and generated tables. Where it
was measured, a comment in its paragraph or list names the page or the file of results that holds it:

    <!-- results: fit.md, trust.md#Arcs in the place of lines, fit.json#full_over_ours -->

After ``#`` stands a heading of a page, or a key of a JSON file, with dots between its parts. The figure
must be there, up to the digits that it is stated with; of a JSON file also a hundredfold (per cent) or a
thousandfold (ms). All other figures are settings, definitions, the paper's, or held by a test:
docs/given.toml lists them, page by page, in the words around them.
"""

import ast
import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from .tables import BETWEEN, RESULTS, ROOT, sections

GIVEN = ROOT / "docs" / "given.toml"

NUMBER = r"\d+(?:,\d{3})+(?:\.\d+)?|\d+(?:\.\d+)?(?:e[+-]?\d+)?"
UNIT = r"million|px|ms|s|%|times|passes|GB|MB|MiB|tensors|mm|fold|frames/s|draws"
FIGURE = re.compile(
    rf"(?<![\w.,/^-])(?P<sign>[-+−]?)(?P<number>{NUMBER})(?![\w^]|\.\d)(?P<unit> ?(?:{UNIT})\b|\s?%)?"
)
COMMENT = re.compile(r"<!-- results: (.*?) -->", re.DOTALL)
BLOCK = re.compile(r"^ *```.*?^ *```$", re.DOTALL | re.MULTILINE)
INLINE = re.compile(r"`[^`]*`")
LINK = re.compile(r"\]\([^)]*\)|!\[[^\]]*\]|<[^>]+>|https?://\S+")


class Figure(NamedTuple):
    """A figure on a page: its number as stated, the value, and the text around it."""

    stated: str
    at: int
    value: float
    digits: int
    around: str


class Passage(NamedTuple):
    """A paragraph, list or table, and the sources that its comment names."""

    text: str
    sources: list[str]


def passages(text: str) -> Iterator[Passage]:
    """The passages of a page that may state figures: without code and generated tables."""
    text = BLOCK.sub("", BETWEEN.sub("", text))
    for part in re.split(r"\n\s*\n", text):
        if part.startswith("    ") and not re.match(r" +([-*\d]|<!--)", part):
            continue  # a formula, or what a program prints
        named = [
            one.strip() for found in COMMENT.findall(part) for one in " ".join(found.split()).split(", ")
        ]
        yield Passage(plain(part), named)


def plain(text: str) -> str:
    """The words of a text, on one line: without comments, inline code and addresses."""
    return " ".join(LINK.sub("", INLINE.sub("`", COMMENT.sub("", text))).split())


def figures(text: str) -> Iterator[Figure]:
    """The figures in a passage."""
    for found in FIGURE.finditer(text):
        number = found["number"]
        if "." in number or "e" in number or found["unit"]:
            bare = number.replace(",", "")
            mantissa, _, power = bare.partition("e")
            million = 6 if (found["unit"] or "").endswith("million") else 0
            digits = len(mantissa.partition(".")[2]) - int(power or 0) - million
            sign = -1 if found["sign"] in ("-", "−") else 1
            around = text[max(0, found.start() - 30) : found.end() + 20]
            value = sign * float(bare) * 10**million
            yield Figure(number, found.start("number"), value, digits, around)


def values(source: str) -> list[float]:
    """All numbers at a place in the results."""
    name, _, place = source.partition("#")
    if name.endswith(".md"):
        text = sections(name)[place].replace("−", "-")
        found = re.findall(rf"(-?)({NUMBER})", text)
        return [float(f"{sign}{number}".replace(",", "")) for sign, number in found]
    found = json.loads((RESULTS / name).read_text())
    for key in place.split("."):
        found = found[int(key) if isinstance(found, list) else key]
    return [factor * value for value in _leaves(found) for factor in (1, 100, 1000)]


def _leaves(thing: object) -> Iterator[float]:
    if isinstance(thing, dict):
        for value in thing.values():
            yield from _leaves(value)
    elif isinstance(thing, list):
        for value in thing:
            yield from _leaves(value)
    elif isinstance(thing, str):
        yield from (float(n.replace(",", "")) for n in re.findall(NUMBER, thing))
    elif not isinstance(thing, bool) and isinstance(thing, int | float):
        yield float(thing)


def borne_out(figure: Figure, known: list[float]) -> bool:
    """Whether one of the values is the figure, up to its digits; words may state its sign."""
    step = 10.0**-figure.digits
    return any(abs(abs(value) - abs(figure.value)) <= 0.5000001 * step for value in known)


def docstrings(module: Path) -> str:
    """The docstrings of a module, those of its constants included, without examples: as paragraphs."""
    texts = [
        node.value.value
        for node in ast.walk(ast.parse(module.read_text()))
        if isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    ]
    plain_text = [re.sub(r"^ *Example:\n.*", "", text, flags=re.DOTALL | re.MULTILINE) for text in texts]
    return "\n\n".join(re.sub(r"\n\s*\n|\n +", "\n", text.strip()) for text in plain_text)


def given(page: Path) -> dict[str, list[str]]:
    """The words around the figures of a page that no results hold, by what holds them."""
    return tomllib.loads(GIVEN.read_text()).get(str(page.relative_to(ROOT)), {})


def unsupported(page: Path) -> list[str]:
    """What is wrong on a page: figures that nothing bears out, and listed words that it lacks.

    Of a module its docstrings are looked at, and listed words may be gone.
    """
    allowed = [words for listed in given(page).values() for words in listed]
    if page.suffix == ".py":
        text = docstrings(page)
        return unsupported_in(text, [words for words in allowed if words in plain(text)])
    return unsupported_in(page.read_text(), allowed)


def unsupported_in(text: str, allowed: list[str]) -> list[str]:
    """The same of a text and the words that are listed for it."""
    wrong = []
    whole = plain(BLOCK.sub("", BETWEEN.sub("", text)))
    wrong += [
        f"docs/given.toml: not on the page any more: {words}" for words in allowed if words not in whole
    ]
    for passage in passages(text):
        listed = [
            (m.start(), m.end()) for words in allowed for m in re.finditer(re.escape(words), passage.text)
        ]
        known = [value for source in passage.sources for value in values(source)]
        open_ = [f for f in figures(passage.text) if not any(start <= f.at < end for start, end in listed)]
        bad = [figure for figure in open_ if not borne_out(figure, known)]
        where = ", ".join(passage.sources) or "no results named"
        wrong += [f"{figure.stated} in “{figure.around}” ({where})" for figure in bad]
    return wrong
