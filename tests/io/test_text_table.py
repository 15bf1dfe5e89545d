"""Tables in every dialect: the same numbers, or a sentence; never other numbers."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zoomjax.io.text_table import _fast, plain_number, read_text_table

TABLE = "image,focal\na.jpg,20.5\nb.jpg,40\n"
EXPECTED = {"a.jpg": 20.5, "b.jpg": 40.0}


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return tmp_path_factory.mktemp("tables") / "table.csv"


def focals(path, content):
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    table = read_text_table(path, "focal lengths", texts=("image",), numbers=("focal",))
    return dict(zip(table.texts["image"], table.numbers["focal"].tolist(), strict=True))


SAME = {
    "as it is": TABLE,
    "semicolons": TABLE.replace(",", ";"),
    "semicolons and decimal commas": TABLE.replace(",", ";").replace("20.5", "20,5"),
    "tabs": TABLE.replace(",", "\t"),
    "tabs and decimal commas": TABLE.replace(",", "\t").replace("20.5", "20,5"),
    "Excel's first line": "sep=;\n" + TABLE.replace(",", ";"),
    "quoted": "\n".join(",".join(f'"{c}"' for c in row.split(",")) for row in TABLE.split()),
    "quoted number": TABLE.replace("20.5", '"20.5"'),
    "spaces": TABLE.replace(",", " , "),
    "upper case": TABLE.replace("image,focal", "IMAGE,Focal"),
    "mark of UTF-8": TABLE.encode("utf-8-sig"),
    "UTF-16": TABLE.encode("utf-16"),
    "UTF-16, other order": b"\xfe\xff" + TABLE.encode("utf-16-be"),
    "UTF-32": TABLE.encode("utf-32"),
    "CRLF": TABLE.replace("\n", "\r\n"),
    "CR": TABLE.replace("\n", "\r"),
    "no end of line": TABLE.rstrip(),
    "empty lines": "\n" + TABLE.replace("\n", "\n\n") + "\n\n",
    "rows of nothing": TABLE + ",\n , \n",
    "separators at the end": TABLE.replace("\n", ",,\n"),
    "separators at the end of rows": TABLE.replace("5\n", "5,\n"),
    "comments": "# measured\n" + TABLE + "# the end, 1, 2\n",
    "other columns": "note,image,focal\nwide,a.jpg,20.5\n3,b.jpg,40\n",
    "exponents and signs": TABLE.replace("20.5", "+2.05e1").replace("40", "4E+1"),
}


@pytest.mark.parametrize("dialect", SAME)
def test_the_same_table_in_any_dialect(dialect, path):
    assert focals(path, SAME[dialect]) == EXPECTED


REFUSED = {
    "decimal commas between commas": (
        TABLE.replace("20.5", "20,5"),
        r"row 2 has 3 fields, .* decimal commas",
    ),
    "the same with a column to spare": (
        "image,focal,\na.jpg,20,5\n",
        "row 2 has 3 fields, and .* 2 columns",
    ),
    "quoted decimal comma": (TABLE.replace("20.5", '"20,5"'), "focal in row 2 is '20,5', .* decimal point"),
    "commas and points": (
        TABLE.replace(",", ";").replace("40", "1,040"),
        "row 3 is '1,040', and other numbers",
    ),
    "thousands or decimals": ("image\tfocal\na.jpg\t1,234\n", r"is '1,234', which may be 1\.234 or 1234"),
    "grouped twice": ("image;focal\na.jpg;1.234,5\n", "and other numbers have a decimal point"),
    "many fields": ("image,focal\na,b.jpg,20\n", "row 2 has 3 fields"),
    "few fields": ("image,focal,note\na.jpg,20\n", "row 2 has 2 fields, and the first line has 3 columns"),
    "empty cell": ("image,focal\na.jpg,\n", "focal in row 2 is empty"),
    "underscore": (TABLE.replace("40", "1_000"), "focal in row 3 is '1_000', which is no number"),
    "nan": (TABLE.replace("40", "nan"), "'nan', which is no number"),
    "infinite": (TABLE.replace("40", "inf"), "'inf', which is no number"),
    "too large": (TABLE.replace("40", "1e999"), "'1e999', which is no number"),
    "hexadecimal": (TABLE.replace("40", "0x28"), "'0x28', which is no number"),
    "full width": (TABLE.replace("40", "４０"), "'４０', which is no number"),
    "Arabic digits": (TABLE.replace("40", "٤٠"), "which is no number"),
    "unit": (TABLE.replace("40", "40 mm"), "'40 mm', which is no number"),
    "grouped by a space": (TABLE.replace("40", "1 040"), "'1 040', which is no number"),
    "formula": (TABLE.replace("40", "=40"), "'=40', which is no number"),
    "row after comments": ("# a\n\n" + TABLE.replace("40", "wide"), "focal in row 5 is 'wide'"),
    "column twice": ("image,focal,Focal\na.jpg,20,30\n", "names the column focal twice"),
    "spaces between": (TABLE.replace(",", " "), "separated by commas, semicolons or tabs"),
    "no names": ("a.jpg,20\n", 'must name the columns "image,focal".* but it is .a.jpg,20.'),
    "no rows": ("image,focal\n# none\n,\n", "there are no rows"),
    "nothing": ("", "must name the columns"),
    "open quote": (TABLE + '"c.jpg,20\n', "quotes or fields are damaged"),
    "Latin-1": (
        TABLE.replace("b.jpg", "bär.jpg").encode("latin-1"),
        "byte 0xe4 in row 3 .* save it as UTF-8",
    ),
    "UTF-16 without its mark": (TABLE.encode("utf-16-le"), "it holds zero bytes.*UTF-16"),
    "UTF-16 cut off": (TABLE.encode("utf-16")[:-1], "it is not text in UTF-16"),
    "spreadsheet": (b"PK\x03\x04" + bytes(20), "Export it as CSV"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_not_certain_is_refused_in_a_sentence(case, path):
    content, reason = REFUSED[case]
    with pytest.raises(ValueError, match=rf"Cannot read focal lengths from .*table\.csv: .*{reason}"):
        focals(path, content)


def outcome(path):
    """The table, or why there is none."""
    try:
        return read_text_table(path, "points", numbers=("x", "y")), ""
    except ValueError as error:
        return None, str(error)


numbers = st.one_of(
    st.integers(-(10**6), 10**6).map(str),
    st.decimals(-9999, 9999, places=3).map(str),
    st.floats(allow_nan=False, allow_infinity=False).map(repr),
)
odd = st.sampled_from(
    ["nan", "inf", "1_0", "0x1p3", "٣", "", " ", "1,5", "1.5,5", '"', "#1", "-", "1e", "\xa07"]
)


@settings(max_examples=300)
@given(
    rows=st.lists(st.tuples(numbers, numbers, numbers), min_size=1, max_size=6),
    oddity=st.none()
    | st.tuples(st.integers(0, 5), st.integers(0, 2), odd | st.text(',;."# 0123\t٣x', max_size=6)),
    separator=st.sampled_from(",;\t|"),
    decimal=st.sampled_from(".,"),
    quote=st.sampled_from(["", '"', "'"]),
    order=st.permutations(["x", "y", "note"]),
    end=st.sampled_from(["\n", "\r\n", "\r"]),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "utf-32", "latin-1", "utf-16-le"]),
    extra=st.sampled_from(["", "{s}", "{s} {s}", "{s}7"]),
    between=st.sampled_from(["", "{e}", "# 1{s}2{e}", "{s}{s}{e}"]),
)
def test_never_other_numbers(
    rows, oddity, separator, decimal, quote, order, end, encoding, extra, between, path
):
    """Any table, written in any dialect, with any one cell odd: the same numbers are read, or none."""
    cells = [[c.replace(".", decimal) for c in row] for row in rows]
    if oddity is not None and oddity[0] < len(rows):
        cells[oddity[0]][oddity[1]] = oddity[2]
    tail = extra.format(s=separator)
    between = between.format(s=separator, e=end)
    lines = [separator.join(quote + c + quote for c in row) + tail for row in [order, *cells]]
    try:
        path.write_bytes((between + (end + between).join(lines) + end).encode(encoding))
    except UnicodeEncodeError:
        return
    table, reason = outcome(path)
    if table is None:
        assert reason.startswith("Cannot read points from")
        return
    for name in ("x", "y"):
        written = [row[order.index(name)].strip().strip('"').strip().replace(decimal, ".") for row in cells]
        kept = [i for i, row in enumerate(cells) if not row[0].lstrip().startswith("#") or quote == '"']
        assert table.numbers[name].tolist() == [float(written[i]) for i in kept]
        assert all(plain_number(written[i]) is not None for i in kept)


@settings(max_examples=300)
@given(
    rows=st.lists(st.tuples(numbers | odd, numbers), min_size=1, max_size=5),
    separator=st.sampled_from(",;\t"),
    note=st.booleans(),
)
def test_the_fast_way_reads_what_the_thorough_one_does(rows, separator, note, path):
    """A comment at the end sends the file the thorough way."""
    found = []
    for end in ("", "\n#"):
        lines = [separator.join([*row, *["z"] * note]) for row in [("x", "y"), *rows]]
        path.write_text("\n".join(lines) + end, encoding="utf-8")
        table, reason = outcome(path)
        columns = [] if table is None else [*table.numbers.values(), table.rows]
        found.append((reason, [column.tolist() for column in columns]))
    assert found[0] == found[1]


def test_large_files_go_the_fast_way(path, rng):
    values = rng.uniform(0, 4000, (1000, 4))
    for separator, decimal in ((",", "."), (";", "."), (";", ","), ("\t", ".")):
        rows = [separator.join(map(repr, row)).replace(".", decimal) for row in values.tolist()]
        found = _fast("\n".join(rows), separator, list("abcd"), ["d", "a"], 1)
        assert found is not None
        np.testing.assert_array_equal(found[0]["a"], values[:, 0])
        np.testing.assert_array_equal(found[0]["d"], values[:, 3])
        np.testing.assert_array_equal(found[1], np.arange(2, 1002))


@pytest.mark.parametrize("name", ["weights", "Weight_of_view", "weightt"])
def test_a_column_that_is_called_nearly_as_an_optional_one_is_refused(path, name):
    path.write_text(f"a,{name}\n1,2\n")
    with pytest.raises(ValueError, match=r"its column .* would not count: weight is what it is called"):
        read_text_table(path, "numbers", numbers=("a",), optional=("weight",))


@pytest.mark.parametrize("header", ["a,height,width", "a,weight,weights"])
def test_other_columns_are_ignored_all_the_same(path, header):
    path.write_text(f"{header}\n1,2,3\n")
    found = read_text_table(path, "numbers", numbers=("a",), optional=("weight",)).numbers
    assert set(found) == {"a", "weight"} & set(header.split(","))


def test_a_folder_is_no_table(tmp_path):
    with pytest.raises(IsADirectoryError, match="cannot read focal lengths where there is a folder"):
        read_text_table(tmp_path, "focal lengths", numbers=("focal",))
