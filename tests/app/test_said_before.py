"""Another fit to lines of results: what was said against photos and clips stays."""

import dataclasses
import json

import numpy as np
import pytest

from zoomjax import scenes
from zoomjax.app.model_choice import WantedModel
from zoomjax.app.runs import calibrate_lines
from zoomjax.app.said_before import findings_before, findings_of_lenses

LENSES = {"about": "different lenses", "found": "by 2 lenses.", "cause": True}
BENT = {"about": "halves", "found": "halves differ.", "cause": False}
OUTSIDE = {"about": "points outside", "found": "points lie outside.", "cause": True}
SURE = {"about": "focal lengths", "found": "given as 0 mm.", "cause": True}
NOISE = {"about": "noise", "found": "points are off.", "cause": False}
TURN = {"about": "turning", "found": "hardly turns.", "cause": False}


def written(folder, *found, about=None, **more):
    """A folder of results whose summary has these findings."""
    folder.mkdir(exist_ok=True)
    lens = scenes.nikkor_18_200((1072, 712))
    dataclasses.replace(lens, about=about or {}).save(folder / "lens.json")
    lines = scenes.board_lines(lens, np.array([24.0, 40.0, 60.0]), spacing=24, noise=0.1)
    lines.save(folder / "lines.npz")
    images = [{"name": str(f), "focal": float(f), "focal_sigma": None} for f in lines.focal]
    findings = [{"verdict": "doubtful", "advice": "Do something."} | one for one in found]
    summary = {"centre": {"how": "image"}, "images": images, "findings": findings} | more
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder / "lines.npz", lines


def told(*files, given_sigma=False):
    return [one.about for one in findings_before(files, given_sigma=given_sigma)]


def test_what_speaks_against_the_photos_stays_and_what_speaks_against_the_fit_does_not(tmp_path):
    file, _ = written(tmp_path / "a", LENSES, BENT, OUTSIDE, SURE, LENSES | {"verdict": "good"})
    assert told(file) == told(file, file) == ["different lenses", "focal lengths"]
    assert told(file, given_sigma=True) == ["different lenses"]


def test_what_speaks_against_a_clip_stays(tmp_path):
    file, _ = written(tmp_path / "a", NOISE, TURN, OUTSIDE, clip="a.mp4", focal_scale="absolute")
    assert told(file) == ["noise", "turning"]
    file, _ = written(tmp_path / "b", NOISE, TURN, clip="a.mp4", focal_scale="relative")
    assert told(file) == ["noise"]  # lens.json says the other


def test_lines_of_different_lenses_cameras_and_parts_of_the_sensor_are_told(tmp_path):
    one = {"lens": "Nikkor", "camera": "D90", "crop_factor": 1.5}
    files = [
        written(tmp_path / name, about=about)[0]
        for name, about in {"a": one, "b": one, "c": {}, "d": {"lens": "Other", "crop_factor": 1.0}}.items()
    ]
    assert findings_of_lenses(files[:3]) == []
    found = findings_of_lenses(files)
    assert [each.about for each in found] == ["different lenses", "different crop factors"]
    assert "Nikkor (" in found[0].found
    assert "Other (" in found[0].found
    zoomed = written(tmp_path / "e", about={"digital_zoom": 2.0})[0]
    assert [each.about for each in findings_of_lenses([files[0], zoomed])] == ["different digital zooms"]


@pytest.mark.parametrize(
    "damaged", ["", "[1]", "{}", '{"findings": [1]}', '{"findings": [{"about": "x"}]}']
)
def test_a_summary_that_is_damaged_says_nothing(tmp_path, damaged):
    file, _ = written(tmp_path / "a", LENSES)
    file.with_name("summary.json").write_text(damaged)
    assert told(file) == []


@pytest.mark.slow
def test_another_fit_and_one_after_that_say_it(tmp_path):
    """In the folder itself, whose summary is written anew."""
    file, lines = written(tmp_path / "a", LENSES)
    for _ in range(2):
        done = calibrate_lines(
            lines,
            file.parent,
            lambda _: None,
            model=WantedModel("polynomial", degree=1),
            centre="image",
            focal_sigma=None,
            robust=False,
            files=[file],
            names=[],
        )
        assert done.assessment.verdict != "good"
        assert done.assessment.sentence.endswith(": by 2 lenses.")
        [told] = [one for one in done.assessment.findings if one.about == "different lenses"]
        assert told.advice == "Do something. Another fit to the same lines does not change that."
