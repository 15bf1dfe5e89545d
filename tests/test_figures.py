"""Measured figures in README, docs and docstrings: each stands in a file of benchmarks/results."""

import re
import tomllib

import pytest

from docs.make import figures, tables

PAGES = {str(page.relative_to(tables.ROOT)): page for page in tables.pages()}
SOURCES = {str(path.relative_to(tables.ROOT)): path for path in sorted((tables.ROOT / "src").rglob("*.py"))}


@pytest.mark.parametrize("page", PAGES.values(), ids=PAGES)
def test_figures_of_a_page_are_those_of_the_results(page):
    wrong = figures.unsupported(page)
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("module", SOURCES.values(), ids=SOURCES)
def test_figures_of_docstrings_are_listed_by_what_holds_them(module):
    wrong = figures.unsupported(module)
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("page", PAGES.values(), ids=PAGES)
def test_tables_of_a_page_are_up_to_date(page):
    text = page.read_text()
    assert tables.filled(text) == text, "run python -m docs.make tables"


def test_all_tables_are_used_and_closed():
    text = "".join(page.read_text() for page in PAGES.values())
    found = [name for _, name, *_ in tables.BETWEEN.findall(text)]
    assert set(found) == set(tables.TABLES)
    assert text.count("<!-- table: ") - text.count("`<!-- table: ") == len(found)


def test_listed_figures_are_of_pages_and_tests_that_exist():
    listed = tomllib.loads(figures.GIVEN.read_text())
    assert set(listed) <= set(PAGES) | set(SOURCES)
    holders = {holder for held in listed.values() for holder in held} - {"given", "chosen"}
    assert not [holder for holder in holders if not (tables.ROOT / holder).exists()]


MEASURED = re.compile(r"\b\d+(?:\.\d+)? ?(?:ms|times (?:as|faster|slower|longer))\b|\b\d+(?:\.\d+)? s\b")


@pytest.mark.parametrize("name", SOURCES)
def test_code_states_no_times_that_nothing_measures(name):
    """Speeds belong to benchmarks/results, where they are measured again, and not to docstrings."""
    text = re.sub(r">>>.*|\.\.\. .*", "", SOURCES[name].read_text())
    assert not MEASURED.findall(text)


def wrong(text, allowed=()):
    return figures.unsupported_in(text, list(allowed))


def test_a_figure_without_a_source_is_found():
    assert wrong("It takes 99.7 ms.\n")
    assert wrong("It takes 99.7 ms, see `fit`.\n\nElsewhere.\n<!-- results: fit.md -->\n")
    assert wrong("- it takes 12 passes\n")
    assert wrong("| head |\n|---|\n| 0.123 |\n")


def test_a_figure_with_another_value_than_its_source_is_found():
    assert not wrong("25.1 passes\n<!-- results: fit.md -->\n")
    assert wrong("15.5 passes\n<!-- results: fit.md -->\n")
    assert not wrong("25 passes\n<!-- results: fit.json#compress_over_pass -->\n")
    assert wrong("26 passes\n<!-- results: fit.json#compress_over_pass -->\n")
    assert not wrong("18.9 ms, 10.2 million\n<!-- results: fit.json#fit, fit.json#points -->\n")
    assert wrong("3.05 px\n<!-- results: trust.md#Coverage of the corner's displacement -->\n")
    assert not wrong("3.05 px\n<!-- results: trust.md#Arcs in the place of lines -->\n")


def test_listed_figures_pass_and_must_be_there():
    assert not wrong("Edges of 32 px or more\n", ["of 32 px"])
    assert wrong("Edges of 33 px or more\n", ["of 32 px"])
    assert wrong("No figures here.\n", ["of 32 px"])


def test_figures_in_docstrings_are_found_and_examples_are_none(tmp_path):
    module = tmp_path / "module.py"
    module.write_text(
        'LEAST = 3\n"""Found by hand: 0.25 px."""\n\ndef f():\n    """One. Example:\n    >>> 1.5\n    """\n'
    )
    assert "0.25 px" in figures.docstrings(module)
    module.write_text('def f():\n    """One.\n\n    Example:\n        >>> 1.5\n    """\n')
    assert "1.5" not in figures.docstrings(module)


def test_code_and_formulas_are_no_figures():
    assert not wrong(
        "`0.5 px` and\n\n```python\nx = 0.5  # ms\n```\n\n    y = 3.5 px\n\n[1.5](docs/2.5.md)\n".replace(
            "[1.5]", "[it]"
        )
    )
    assert not wrong("eq. 13, 1/f², k1, 2 cores, 50 frames, 1072 by 712\n")


def test_a_table_follows_its_results():
    text = "<!-- table: fit -->\nold\n<!-- end -->\n"
    assert "| compression, once | 184 ms | 25.1 memory passes |" in tables.filled(text)
    assert tables.filled(tables.filled(text)) == tables.filled(text)


def test_all_arcs_outward_are_in_the_table_of_crooked_lines():
    assert "all away from the centre | 0.022 | 0.047 | 3.049 |" in PAGES["docs/trust.md"].read_text()
