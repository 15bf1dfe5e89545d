"""Inputs of the command line: folders of results, and what else is in them."""

import cv2
import numpy as np
import pytest

from zoomjax.app.arguments import with_lines_of_results


@pytest.fixture
def results(tmp_path):
    for name in ("lens.json", "lines.npz", "summary.json", "panorama.jpg"):
        (tmp_path / name).touch()
    (tmp_path / "lines").mkdir()
    (tmp_path / "lines" / "0001-a.jpg").touch()
    return tmp_path


@pytest.mark.parametrize("meant", [False, True])
def test_lines_stand_for_a_folder_of_results(results, meant):
    given = [str(results), "a.jpg"]
    assert with_lines_of_results(given, meant=meant) == [str(results / "lines.npz"), "a.jpg"]


@pytest.mark.parametrize("name", ["a.jpg", "50mm/b.tif"])
def test_photos_in_a_folder_of_results_may_be_meant(results, name):
    (results / name).parent.mkdir(exist_ok=True)
    cv2.imwrite(str(results / name), np.zeros((8, 8), np.uint8))
    with pytest.raises(ValueError, match=r"holds photos, .* give .*lines.npz to .* again, or .*\*\."):
        with_lines_of_results([str(results)], meant=False)
    lines = str(results / "lines.npz")
    assert with_lines_of_results([str(results)], meant=True) == [lines]
    assert with_lines_of_results([lines], meant=False) == [lines]
    assert with_lines_of_results([str(results / name)], meant=False) == [str(results / name)]
