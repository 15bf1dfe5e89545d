"""Damaged and hostile files: an error that names the file, or a sound result; never anything else.

Hundreds of mutations a format, derived by Hypothesis: bytes changed, cut, put in, doubled; and, as those
seldom get past a checksum or a parser, archives and JSON that are whole and hold something else.
"""

import copy
import io
import json
import math
import tracemalloc
import warnings
import zipfile

import jaxtyping
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import zoomjax as zj
from benchmarks.mutations import (
    CSV_LINES,
    READERS,
    Outcomes,
    damaged,
    every_model,
    read_lines_csv,
    sound_lines,
    sound_mapping,
    sound_table,
    sound_track,
)
from zoomjax.io.focal_table import read_focal_table

MANY = settings(max_examples=200)

UNPACKED = 200_000_000  # bytes; none of the files here holds more than a few thousand


@pytest.fixture(scope="module", autouse=True)
def _without_checked_types():
    """As users run the package."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


def survives(read, path, sound):
    """Whether a file is read; what is read must be sound, and what is not, an error that names the file."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        try:
            result = read(path)
        except (ValueError, OSError) as error:
            refused = str(error)
        else:
            sound(result)
            return True
    assert str(path) in refused
    return False


@st.composite
def mutations(draw):
    """A few changes of bytes, as functions of the bytes; positions are shares of the length."""
    place = st.floats(0, 1, allow_nan=False)
    steps = []
    for _ in range(draw(st.integers(1, 4))):
        kind = draw(st.sampled_from(["flip", "cut", "insert", "remove", "double", "swap"]))
        chunk = draw(st.binary(min_size=1, max_size=8) | st.sampled_from(TOKENS))
        steps.append((kind, draw(place), draw(place), chunk))
    return steps


TOKENS = [
    b",",
    b"\n",
    b'"',
    b"\x00",
    b"nan",
    b"inf",
    b"-1",
    b"1e400",
    b"9" * 400,
    b"[",
    b"{",
    b"null",
    b"\xff",
]


def mutated(content, steps):
    for kind, first, second, chunk in steps:
        at, to = (int(share * len(content)) for share in (first, second))
        low, high = min(at, to), max(at, to)
        if kind == "flip" and at < len(content):
            content = content[:at] + bytes([content[at] ^ chunk[0] or 1]) + content[at + 1 :]
        elif kind == "cut":
            content = content[:at]
        elif kind == "insert":
            content = content[:at] + chunk + content[at:]
        elif kind == "remove":
            content = content[:low] + content[low + (high - low) // 8 :]
        elif kind == "double":
            content = content[:high] + content[low:high] + content[high:]
        elif kind == "swap":
            content = content[:low] + chunk + content[low + len(chunk) :]
    return content


# lines.npz


@pytest.fixture(scope="module")
def fields(folder):
    """What a sound file of lines holds."""
    rng = np.random.default_rng(0)
    points = [rng.uniform(0, 60, (n, 2)) for n in (5, 3, 7, 4)]
    lines = zj.Lines.from_ragged(points, [0, 1, 1, 0], [20.0, 50.0], image_size=(64, 64)).weighted(
        np.ones(4)
    )
    lines.save(folder / "sound.npz")
    with np.load(folder / "sound.npz") as file:
        return {name: file[name] for name in file.files}


@MANY
@given(steps=mutations())
def test_bytes_of_lines(steps, fields, folder):
    path = folder / "lines.npz"
    path.write_bytes(mutated((folder / "sound.npz").read_bytes(), steps))
    survives(zj.load_lines, path, sound_lines)


DTYPES = ["<f8", ">f8", "<f4", "<f2", "<c16", "<i8", ">i4", "u1", "<u8", "?", "S3", "<U5", "<M8[s]", "V8"]


@st.composite
def arrays(draw):
    """Small arrays of any kind, with numbers at the limits."""
    dtype = np.dtype(draw(st.sampled_from(DTYPES)))
    shape = tuple(draw(st.lists(st.integers(0, 5), max_size=3)))
    size = math.prod(shape)
    if dtype.kind in "fc":
        values = draw(st.lists(st.floats(width=16), min_size=size, max_size=size))
        return np.array(values).astype(dtype).reshape(shape)
    raw = draw(st.binary(min_size=size * dtype.itemsize, max_size=size * dtype.itemsize))
    if dtype.kind == "?" or dtype.kind == "U":
        return np.zeros(shape, dtype)
    return np.frombuffer(raw, dtype).reshape(shape)


NAMES = (
    "format",
    "version",
    "points",
    "counts",
    "frame",
    "focal",
    "centre",
    "image_size",
    "focal_unit",
    "weight",
)


@MANY
@given(
    changes=st.dictionaries(
        st.sampled_from(NAMES), arrays() | st.sampled_from(NAMES), min_size=1, max_size=3
    )
)
@pytest.mark.filterwarnings("ignore::numpy.exceptions.ComplexWarning")
def test_arrays_of_lines(changes, fields, folder):
    """Whole archives with some arrays replaced by anything, or by another of its arrays."""
    path = folder / "arrays.npz"
    new = {name: fields[change] if isinstance(change, str) else change for name, change in changes.items()}
    np.savez(path, **fields | new)
    survives(zj.load_lines, path, sound_lines)


@MANY
@given(data=st.data())
def test_numbers_of_lines(data, fields, folder):
    """The right arrays with single numbers that are wrong."""
    path, new = folder / "numbers.npz", dict(fields)
    for _ in range(data.draw(st.integers(1, 3))):
        name = data.draw(
            st.sampled_from(["points", "counts", "frame", "focal", "centre", "image_size", "weight"])
        )
        array = new[name].copy()
        index = data.draw(st.integers(0, array.size - 1))
        if array.dtype.kind == "f":
            array.flat[index] = data.draw(st.floats())
        else:
            limits = np.iinfo(array.dtype)
            array.flat[index] = data.draw(st.integers(limits.min, limits.max) | st.integers(-2, 9))
        new[name] = array
    np.savez(path, **new)
    survives(zj.load_lines, path, sound_lines)


def with_member(path, fields, name, header, content):
    """An archive one of whose arrays has this header, as text, before its content."""
    np.savez(path, **{key: value for key, value in fields.items() if key != name})
    text = header.encode("latin1") + b"\n"
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(
            f"{name}.npy", b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + content
        )


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000, 2)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (-1, 2)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999999999999, 99999999999)}",
        "{'descr': '|S2000000000', 'fortran_order': False, 'shape': (3,)}",
        "{'descr': '|O', 'fortran_order': False, 'shape': (2, 2)}",
        "{'descr': [('a', '<f8', (100000, 100000))], 'fortran_order': False, 'shape': (3,)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (((((",
        "__import__('os').system('touch executed')",
    ],
)
def test_headers_that_lie_take_no_memory_and_run_nothing(header, fields, folder, monkeypatch):
    monkeypatch.chdir(folder)
    path = folder / "header.npz"
    with_member(path, fields, "points", header, b"\0" * 304)
    tracemalloc.start()
    try:
        assert not survives(zj.load_lines, path, sound_lines)
        assert tracemalloc.get_traced_memory()[1] < 10_000_000
    finally:
        tracemalloc.stop()
    assert not (folder / "executed").exists()


class Bomb:
    """What a pickle could do."""

    def __reduce__(self):
        return exec, ("open('executed', 'w').close()",)


@pytest.mark.parametrize("name", ["points", "version", "extra"])
def test_pickles_are_never_opened(name, fields, folder, monkeypatch):
    monkeypatch.chdir(folder)
    np.savez(folder / "pickled.npz", **fields | {name: np.array([Bomb(), None], object)})
    assert not survives(zj.load_lines, folder / "pickled.npz", sound_lines)
    np.save(folder / "pickled.npy", np.array([Bomb(), None], object))
    assert not survives(zj.load_lines, folder / "pickled.npy", sound_lines)
    assert not (folder / "executed").exists()


def test_an_archive_that_unpacks_to_far_more_than_itself_is_not_unpacked(fields, folder):
    path = folder / "bomb.npz"
    rows = UNPACKED // 16
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        buffer, {"descr": "<f8", "fortran_order": False, "shape": (rows, 2)}
    )
    np.savez(path, **{key: value for key, value in fields.items() if key != "points"})
    with (
        zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("points.npy", "w") as member,
    ):
        member.write(buffer.getvalue())
        for _ in range(rows // 1_000_000):
            member.write(bytes(16_000_000))
        member.write(bytes(16 * (rows % 1_000_000)))
    with pytest.raises(ValueError, match=r"bomb.npz.*0\.2 GB of memory, far more than its own size"):
        zj.load_lines(path)


def test_lines_whose_padding_would_fill_the_memory_are_refused(fields, folder):
    """A hundred thousand lines of three points, and one of as many as all of them."""
    path, lines = folder / "padding.npz", 100_000
    counts = np.append(np.full(lines, 3), 3 * lines)
    np.savez(
        path,
        **fields
        | {"counts": counts, "points": np.zeros((6 * lines, 2)), "frame": np.zeros(lines + 1, int)},
    )
    with pytest.raises(ValueError, match=r"padding.npz.*GB of memory"):
        zj.load_lines(path)


# lens.json


@pytest.fixture(scope="module")
def lenses(folder):
    contents = []
    for lens in every_model():
        lens.save(folder / "sound.json")
        contents.append((folder / "sound.json").read_bytes())
    return contents


def sound_lens(lens):
    assert np.isfinite(lens.focal_range).all()
    assert min(lens.image_size) >= 1
    assert lens.focal_unit in ("mm", "px")
    columns = lens.zoom.parameters.shape[1]
    for f in map(float, lens.focal_range):
        assert lens.zoom(f).shape == (columns,)


@pytest.mark.slow
@MANY
@given(steps=mutations(), which=st.integers(0, 6))
def test_bytes_of_a_lens(steps, which, lenses, folder):
    path = folder / "lens.json"
    path.write_bytes(mutated(lenses[which], steps))
    survives(zj.load_lens, path, sound_lens)


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.just(10**400) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=2),
    max_leaves=8,
)


def places(content, path=()):
    """Every place in nested JSON."""
    if path:
        yield path
    items = (
        content.items()
        if isinstance(content, dict)
        else enumerate(content)
        if isinstance(content, list)
        else ()
    )
    for key, value in items:
        yield from places(value, (*path, key))


@MANY
@given(data=st.data(), which=st.integers(0, 6))
def test_values_of_a_lens(data, which, lenses, folder):
    """Whole JSON in which something is anything else, or another of its values, or missing."""
    path, content = folder / "values.json", json.loads(lenses[which])
    for _ in range(data.draw(st.integers(1, 3))):
        *way, last = data.draw(st.sampled_from(list(places(content))))
        parent = content
        for key in way:
            parent = parent[key]
        change = data.draw(st.sampled_from(["anything", "another", "missing"]))
        if change == "anything":
            parent[last] = data.draw(ANYTHING)
        elif change == "another":
            other = content
            for key in data.draw(st.sampled_from(list(places(content)))):
                other = other[key]
            parent[last] = copy.deepcopy(other)
        else:
            del parent[last]
        if not list(places(content)):
            break
    path.write_text(json.dumps(content))
    survives(zj.load_lens, path, sound_lens)


@pytest.mark.parametrize("opening", ["[", '{"zoom":'])
def test_deep_nesting_is_an_error(opening, folder):
    path = folder / "deep.json"
    path.write_text(opening * 100_000)
    assert not survives(zj.load_lens, path, sound_lens)


# CSV


CSV = {
    "lines": (CSV_LINES, read_lines_csv, sound_lines),
    "focal": (b"frame,focal\n0,20\n1,35.5\n7,5e1\n", zj.lines.read_focal_csv, sound_mapping),
    "table": (b"image,focal,sigma\na.jpg,20,0.3\nb/c.jpg,35.5,\n", read_focal_table, sound_table),
    "track": (b"time,focal\n0,20\n0.5,30\n2,5e1\n", zj.io.read_focal_track, sound_track),
    "frames": (b"time_or_frame,focal\n0,20\n5,30\n", zj.io.read_focal_track, sound_track),
}


@pytest.mark.parametrize("kind", CSV)
@MANY
@given(steps=mutations())
def test_bytes_of_csv(kind, steps, folder):
    content, read, sound = CSV[kind]
    path = folder / f"{kind}.csv"
    path.write_bytes(mutated(content, steps))
    survives(read, path, sound)


@pytest.mark.parametrize("kind", CSV)
@pytest.mark.parametrize(
    "cell", ["1e308", "-1e308", "5e-324", "inf", "nan", "0x10", "1_0", "9" * 400, '"' + "x" * 200_000, "٣"]
)
def test_cells_of_csv(kind, cell, folder):
    """In every place of the second row."""
    content, read, sound = CSV[kind]
    rows = content.decode().splitlines()
    width = rows[0].count(",") + 1
    for column in range(width):
        cells = rows[1].split(",")
        cells[column] = cell
        path = folder / f"{kind}-cell.csv"
        path.write_text("\n".join([rows[0], ",".join(cells), *rows[2:]]), encoding="utf-8")
        survives(read, path, sound)


# Every reader, of photographs and video too, in another process: what decodes them is foreign code.


@pytest.fixture(scope="module")
def outcomes():
    with Outcomes() as started:
        yield started


@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_read_soundly_or_refused_by_name(name, outcomes, folder):
    """As many as a test has time for; the benchmark `reliability_fuzz` tries more of the same."""
    if name == "video":
        pytest.importorskip("av")
    corpus, rng = READERS[name].corpus(folder), np.random.default_rng(2012)
    assert [text for _, text in outcomes.of(name, corpus)] == ["read"] * len(corpus)
    number = 40 if name in ("lens.json", "lines.npz") else 300  # those are tried above
    number = number if READERS[name].share == 1 else 12
    files = [
        damaged(corpus[rng.integers(len(corpus))], rng, corpus[rng.integers(len(corpus))])
        for _ in range(number)
    ]
    bad = {text: content for content, text in outcomes.of(name, files) if text not in ("read", "refused")}
    assert bad == {}


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tif", ".bmp"])
def test_a_photograph_cut_off_anywhere_is_the_whole_one_or_none(suffix, folder):
    """Never one that is filled up with grey."""
    reader = next(reader for reader in READERS.values() if reader.suffix == suffix)
    for content in reader.corpus(folder):
        path = folder / f"cut{suffix}"
        path.write_bytes(content)
        _, whole = reader.read(path)
        for keep in np.linspace(0, len(content) - 1, 60).astype(int):
            path.write_bytes(content[:keep])
            try:
                _, found = reader.read(path)
            except ValueError:
                continue
            np.testing.assert_array_equal(found, whole)


def test_a_video_of_which_nothing_decodes_is_refused(folder):
    """Its header and its index are whole; its pictures are not."""
    pytest.importorskip("av")
    content = next(content for content in READERS["video"].corpus(folder) if content[:4] == b"RIFF")
    start = content.index(b"movi") + 4
    path = folder / "nothing.avi"
    path.write_bytes(content[:start] + bytes(len(content) - start))
    with pytest.raises(ValueError, match=r"nothing\.avi"):
        READERS["video"].read(path)
