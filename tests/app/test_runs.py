"""What the report says of what was run."""

import types
from pathlib import Path

import pytest
from PIL import ExifTags, Image

from zoomjax.app.runs import title_of, what_is_run


@pytest.fixture
def photos(tmp_path, monkeypatch):
    """Photos of two cameras in two folders, the working folder above them."""
    monkeypatch.chdir(tmp_path)
    for number, body in enumerate(["D90", "D90", "D300", None]):
        path = tmp_path / f"shots{number % 2}" / f"{number}.jpg"
        path.parent.mkdir(exist_ok=True)
        exif = Image.Exif()
        if body:
            exif[ExifTags.Base.Model] = body
        Image.new("L", (8, 8)).save(path, exif=exif)
    return sorted(tmp_path.rglob("*.jpg"))


def run_of(photos):
    used = tuple(types.SimpleNamespace(file=str(photo)) for photo in photos)
    images = types.SimpleNamespace(used=used, job=types.SimpleNamespace(video=None))
    return dict(what_is_run("title", images).rows)


def test_the_title_names_what_was_given(photos):
    assert title_of(["shots0"]) == "shots0"
    assert title_of(["shots0/0.jpg"]) == "0.jpg"
    assert title_of(["shots0", "shots1"]) == "shots0, shots1"
    assert title_of([str(photo) for photo in photos]) == "shots0, shots1"
    assert title_of(["shots0/*.jpg"]) == "shots0"
    assert title_of(["."]) == Path.cwd().name
    assert title_of([f"s{n}/a.jpg" for n in range(6)]) == "s0, s1, s2, s3 and 2 more"


def test_all_cameras_are_named(photos):
    assert run_of(photos)["Cameras"] == "D90 (2); D300 (1)"
    assert run_of([p for p in photos if p.stem in "013"])["Camera"] == "D90"
    assert not {"Camera", "Cameras"} & set(run_of([p for p in photos if p.stem == "3"]))
