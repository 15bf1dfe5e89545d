"""Photos whose lines determine no lens: what is kept for a person to look at."""

import dataclasses
import json

import cv2
import numpy as np
import pytest

from zoomjax.app.image_job import ImageJob
from zoomjax.app.undetermined import Undetermined, told_undetermined
from zoomjax.detect.batch import Detection

LINES = (np.stack([np.arange(10, 90.0), np.full(80, 30.0)], axis=1),)


@pytest.fixture
def photos(tmp_path):
    """Two grey photos, and what was found in them."""
    folder = tmp_path / "photos"
    folder.mkdir()
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(folder / name), np.full((60, 100), 90, np.uint8))
    job = ImageJob((str(folder),), detector="edges", focal="24")
    found = {"image_size": (100, 60), "lines": LINES, "unexplained": 0.9}
    return job, [Detection(source.name, source.file, **found) for source in job.sources()[0]]


def raised(photos, images=None):
    job, used = photos
    images = [of.name for of in used] if images is None else images
    with (
        pytest.raises(Undetermined, match="do not determine a lens") as error,
        told_undetermined(job, images, used, {"c.png": "it is cut off"}),
    ):
        raise ValueError("No candidate can be compared. 1 of 10 folds do not converge")
    assert "folds" not in str(error.value)
    return error.value


def test_lines_and_verdict_are_kept(photos, tmp_path):
    out = tmp_path / "out"
    told = raised(photos).keep(out, overwrite=False)
    assert str(out / "lines") in told
    drawn = sorted((out / "lines").iterdir())
    assert [path.name for path in drawn] == ["0001-a.jpg", "0002-b.jpg"]
    picture = cv2.imread(str(drawn[0]))
    assert picture is not None
    coloured = np.ptp(picture.astype(int), axis=-1) > 50  # the line, on grey
    assert coloured[30, 20:80].mean() > 0.7
    assert coloured[:20].mean() < 0.1
    summary = json.loads((out / "summary.json").read_text())
    assert summary["verdict"] == "not determined"
    assert [image["lines"] for image in summary["images"]] == [1, 1]
    assert summary["unused"] == {"c.png": "it is cut off"}
    assert not (out / "lens.json").exists()


def test_a_photo_that_is_gone_is_drawn_black(photos, tmp_path):
    job, used = photos
    (tmp_path / "photos" / "a.png").unlink()
    raised((job, used)).keep(tmp_path / "out", overwrite=False)
    first, second = (cv2.imread(str(path)) for path in sorted((tmp_path / "out" / "lines").iterdir()))
    assert first[:20].max() < 20 < second[:20].min()


def test_an_earlier_lens_and_what_belongs_to_it_stay(photos, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    for name in ("lens.json", "summary.json"):
        (out / name).write_text("mine")
    assert "left as it is" in raised(photos).keep(out, overwrite=False)
    assert {path.name: path.read_text() for path in out.iterdir()} == {
        "lens.json": "mine",
        "summary.json": "mine",
    }


def test_other_errors_pass(photos):
    with pytest.raises(ValueError, match=r"^Another"), told_undetermined(photos[0], [], photos[1], {}):
        raise ValueError("Another problem.")


def test_without_overlays_nothing_is_drawn(photos, tmp_path):
    job, used = photos
    out = tmp_path / "out"
    told = raised((dataclasses.replace(job, overlays="none"), used)).keep(out, overwrite=False)
    assert sorted(path.name for path in out.iterdir()) == [".zoomjax.json", "summary.json"]
    assert "drawn" not in told
    assert str(out / "summary.json") in told


@pytest.mark.parametrize(("overlays", "number"), [("some", 1), ("all", 2)])
def test_all_are_drawn_only_if_that_is_asked_for(photos, overlays, number, tmp_path, monkeypatch):
    monkeypatch.setattr("zoomjax.app.undetermined._MOST", 1)
    job, used = photos
    out = tmp_path / "out"
    raised((dataclasses.replace(job, overlays=overlays), used)).keep(out, overwrite=False)
    assert len(list((out / "lines").iterdir())) == number


def test_pictures_are_numbered_as_those_of_a_lens_by_all_photos(photos, tmp_path):
    job, used = photos
    out = tmp_path / "out"
    raised((job, used[1:]), images=[of.name for of in used]).keep(out, overwrite=False)
    assert [path.name for path in (out / "lines").iterdir()] == ["0002-b.jpg"]
