"""Files named by URL: the right ones are copied, whole, and are gone after the block."""

import sys
import zipfile
from pathlib import Path

import pytest

from zoomjax._core.copies import by_url, origin_of
from zoomjax.io import local_copies

fsspec = pytest.importorskip("fsspec")

KINDS = (".jpg", ".png"), (".mp4",)
FILES = (
    "a.jpg",
    "b.PNG",
    "clip.mp4",
    "notes.txt",
    "lens.json",
    "sub/c.jpg",
    "sub/deep/d.jpg",
    "videos/e.mp4",
)


@pytest.fixture
def memory():
    """A file system elsewhere, with some files below memory://shots."""
    system = fsspec.filesystem("memory")
    for name in FILES:
        system.pipe(f"/shots/{name}", name.encode())
    yield system
    system.rm("/", recursive=True)


def copied(url, **options):
    """The names of the copies below what takes the place of a URL, and the last name of that."""
    with local_copies([url], kinds=KINDS, **options) as (given,):
        top = Path(given)
        files = sorted(path for path in top.rglob("*") if path.is_file())
        for path in files:
            assert path.read_bytes().decode() == origin_of(path).place.removeprefix("/shots/")
        found = [path.relative_to(top).as_posix() for path in files] if top.is_dir() else None
    assert not top.exists()
    assert not any(map(origin_of, files))
    return top.name, found


@pytest.mark.parametrize(
    ("url", "name", "found"),
    [
        ("memory://shots/a.jpg", "a.jpg", None),
        ("memory://shots/notes.txt", "notes.txt", None),  # whatever it is: what reads it will say
        ("memory://shots", "shots", ["a.jpg", "b.PNG", "sub/c.jpg", "sub/deep/d.jpg"]),
        ("memory://shots/", "shots", ["a.jpg", "b.PNG", "sub/c.jpg", "sub/deep/d.jpg"]),
        ("memory://shots/videos", "videos", ["e.mp4"]),
        ("memory://shots/*.jpg", "shots", ["a.jpg"]),
        ("memory://shots/*", "shots", ["a.jpg", "b.PNG"]),
        ("memory://shots/sub*", "shots", ["sub/c.jpg", "sub/deep/d.jpg"]),
        ("memory://shots/**/d.jpg", "shots", ["sub/deep/d.jpg"]),
        ("memory://shots/?ub/*.jpg", "shots", ["sub/c.jpg"]),
        ("memory://*/*.mp4", "all", ["shots/clip.mp4"]),
    ],
)
def test_what_a_url_stands_for(memory, url, name, found):
    assert copied(url) == (name, found)


def test_files_besides_are_copied_with_others_alone(memory):
    assert copied("memory://shots/videos", besides=("lens.json",)) == ("videos", ["e.mp4"])
    assert "lens.json" in copied("memory://shots", besides=("lens.json",))[1]
    memory.pipe("/results/lens.json", b"{}")
    with pytest.raises(FileNotFoundError), local_copies(["memory://results"], kinds=KINDS, besides=("n",)):
        pass


def test_paths_stay_and_urls_take_their_places(memory):
    with local_copies(["here.jpg", "memory://shots/a.jpg", Path("x")], kinds=KINDS) as (first, copy, last):
        assert (first, Path(copy).name, last) == ("here.jpg", "a.jpg", "x")
    with local_copies(["C:/a.jpg", "b"]) as same:
        assert same == ["C:/a.jpg", "b"]


def test_copies_are_told_by_their_urls(memory, tmp_path):
    with zipfile.ZipFile(tmp_path / "s.zip", "w") as archive:
        archive.writestr("in/f.jpg", b"f")
    there = tmp_path.as_posix()
    urls = {
        "memory://shots/a.jpg": "memory://shots/a.jpg",
        "memory://shots/s*": "memory://shots/sub/c.jpg",
        "memory://shots/sub/": "memory://shots/sub/c.jpg",
        f"zip://in/*.jpg::file://{there}/s.zip": f"file://{there}/s.zip/in/f.jpg",
        f"simplecache::zip://in/f.jpg::file://{there}/s.zip": f"file://{there}/s.zip/in/f.jpg",
    }
    for url, shown in urls.items():
        with local_copies([url], kinds=KINDS) as (given,):
            top = Path(given)
            first = min(path for path in top.rglob("*") if path.is_file()) if top.is_dir() else top
            assert by_url(str(first)) == shown


def test_a_name_leads_nowhere_else(memory, monkeypatch):
    monkeypatch.setattr(type(memory), "find", lambda *_, **__: ["/shots/../../../evil.jpg"])
    monkeypatch.setattr(type(memory), "get_file", lambda _, place, path: Path(path).write_bytes(b"evil"))
    with local_copies(["memory://shots"], kinds=KINDS) as (given,):
        [path] = (path for path in Path(given).rglob("*") if path.is_file())
        assert Path(given) in path.resolve().parents


@pytest.mark.parametrize(
    ("url", "error", "told"),
    [
        ("memory://shots/none.jpg", FileNotFoundError, "nothing to read at memory://shots/none.jpg"),
        ("memory://shots/*.tif", FileNotFoundError, "nothing to read"),
        ("memory://nowhere", FileNotFoundError, "nothing to read"),
        ("nobody://me:secret@x/a.jpg", OSError, "nobody://x/a.jpg cannot be read: Protocol not known"),
        ("zip://a.jpg::file:///nothing/there.zip", OSError, "cannot be read"),
    ],
)
def test_what_cannot_be_read_is_told(memory, url, error, told):
    with pytest.raises(error, match=told), local_copies([url], kinds=KINDS):
        pass


def failing(system, monkeypatch, names):
    whole = type(system).get_file

    def get_file(self, place, path, **more):
        if place.rpartition("/")[2] in names:
            raise PermissionError("Forbidden")
        return whole(self, place, path, **more)

    monkeypatch.setattr(type(system), "get_file", get_file)


def test_a_file_that_cannot_be_copied_costs_only_itself(memory, monkeypatch):
    failing(memory, monkeypatch, {"c.jpg"})
    with (
        pytest.warns(UserWarning, match="sub/c.jpg cannot be copied: Forbidden. It is left out"),
        local_copies(["memory://shots/sub"], kinds=KINDS) as (given,),
    ):
        assert [path.name for path in Path(given).rglob("*.jpg")] == ["d.jpg"]


def test_where_none_can_be_copied_that_is_an_error(memory, monkeypatch):
    failing(memory, monkeypatch, {"c.jpg", "d.jpg"})
    with pytest.raises(OSError, match="Forbidden"), local_copies(["memory://shots/sub"], kinds=KINDS):
        pass


def test_progress_is_told(memory):
    told = []
    with local_copies(["memory://shots", "memory://shots/a.jpg"], progress=lambda *of: told.append(of)):
        pass
    assert told == [(number, 9) for number in range(1, 10)]


def test_without_fsspec_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "fsspec", None)
    wanted = r'URLs need fsspec: pip install "zoomjax\[cluster\]"'
    with pytest.raises(ImportError, match=wanted), local_copies(["memory://shots"]):
        pass


def test_files_that_would_have_one_name_are_refused(tmp_path):
    """The last one was taken for both, without a word."""
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("b.jpg", "one")
        archive.writestr("../b.jpg", "another")
    with (
        pytest.raises(OSError, match=r"b\.jpg and .*b\.jpg would have one name here, b\.jpg: give the URL"),
        local_copies([f"zip://::{tmp_path}/a.zip"]),
    ):
        pass
