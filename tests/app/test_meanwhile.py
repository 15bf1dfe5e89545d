"""Photos that are removed or replaced while they are calibrated from."""

import json
import shutil

import cv2
import numpy as np
import pytest

from zoomjax.app import demo
from zoomjax.app.drawings import drawing
from zoomjax.app.image_calibration import calibrate_images
from zoomjax.app.image_job import ImageJob
from zoomjax.app.meanwhile import findings_of_changed, states_of
from zoomjax.app.model_choice import WantedModel
from zoomjax.detect.batch import Detection
from zoomjax.detect.sources import find_photos

SIZE = (1072, 712)


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    demo.write_photos(folder, number=4, image_size=SIZE)
    return folder


@pytest.mark.slow
def test_a_photo_that_is_gone_costs_its_picture_and_one_that_was_replaced_is_not_drawn_on(photos, tmp_path):
    folder = shutil.copytree(photos, tmp_path / "photos")
    first, second, *_ = names = sorted(path.name for path in folder.iterdir())

    def change(stage):
        if stage == "Finding the focal lengths":  # lines are found
            (folder / first).unlink(missing_ok=True)
            shutil.copy(photos / names[-1], folder / second)
            shutil.copytree(photos, folder / "more", dirs_exist_ok=True)  # names are not unique any more

    model = WantedModel("polynomial", degree=2)
    done = calibrate_images(ImageJob((folder,), model=model, centre="image"), stage=change)
    [found] = [f for f in done.calibration.assessment.findings if f.about == "photos changed meanwhile"]
    assert found.verdict == "doubtful"
    assert found.found.startswith(
        f"2 of 4 photos were changed or removed while the calibration ran ({first}"
    )
    assert done.calibration.assessment.verdict != "good"

    done.write(tmp_path / "results")
    content = json.loads((tmp_path / "results" / "summary.json").read_text())
    assert [image["name"] for image in content["images"]] == names
    drawn = sorted((tmp_path / "results" / "lines").iterdir())
    assert len(drawn) == 4
    pictures = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)[: SIZE[1]] for path in drawn]
    dark = [float(np.mean(picture < 3)) for picture in pictures]  # lines alone
    assert dark[0] > 0.5 < dark[1]
    assert dark[2] < 0.1 > dark[3]
    with drawing(done, tmp_path / "lines", most=4) as under:
        assert len(list(under.pictures())) == 4


def test_photos_that_stay_as_they_are_are_not_told_of(photos):
    sources = find_photos([photos])
    states = states_of(sources)
    used = [Detection(of.name, of.file) for of in sources]
    assert findings_of_changed(used, states) == []
    [found] = findings_of_changed(used[:1], states | {used[0].name: None})
    assert found.found.startswith("1 of 1 photo was changed or removed")
