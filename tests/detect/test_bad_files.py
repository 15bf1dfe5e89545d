"""A bad file never ends a run: it is reported, and the photographs around it are looked at."""

import os
import signal
import time
import warnings

import cv2
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.app.image_calibration import calibrate_images
from zoomjax.app.image_job import ImageJob
from zoomjax.detect import batch as module
from zoomjax.detect.batch import detect
from zoomjax.detect.sources import Source, find_photos
from zoomjax.io.photo import read_photo

from .._bad_files import png, whole_png, write_bad_files

pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")


class Rows(zj.detect.AbstractDetector):
    """Finds bright rows, and does what the first pixel tells: ends its process, hangs, takes memory."""

    def __call__(self, image):
        first = int(image.flat[0])
        if first == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        if first == 2:
            os.kill(os.getpid(), signal.SIGSEGV)
        if first == 3:
            time.sleep(1000)
        if first == 4:
            np.empty(1 << 60, np.uint8)
        if first == 5:
            cv2.resize(image, (1, 1), fx=0, fy=0, interpolation=99)
        rows = np.flatnonzero(image.reshape(*image.shape[:2], -1)[..., 0].min(axis=1) > 200)
        return [np.stack([np.arange(64), np.full(64, row)], -1) * 1.0 for row in rows]


@pytest.mark.parametrize("workers", [0, 2])
def test_files_of_every_bad_kind_are_reported_and_skipped(workers, tmp_path):
    paths = write_bad_files(tmp_path, good=4)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = list(
            detect(
                [Source(path.name, path) for path in paths],
                Rows(),
                workers=workers,
                cache=tmp_path / "cache",
            )
        )
    assert [d.name for d in found] == [path.name for path in paths]
    for detection in found:
        if detection.name.startswith("good"):
            assert (len(detection.lines), detection.problem) == (1, "")
        else:
            assert detection.problem
            assert "\n" not in detection.problem
            assert (detection.lines, detection.image_size) == ((), (0, 0))
    assert len(list((tmp_path / "cache").iterdir())) == 1  # the good ones, which are all alike


def test_what_is_wrong_is_said(tmp_path):
    paths = {path.name: path for path in write_bad_files(tmp_path, good=0)}
    for name, why in {
        "empty.jpg": "the file is empty",
        "real-bomb.png": "its header announces 30000x30000 px, more than 500,000,000 in all",
        "cut.jpg": "cut off",
        "text.png": "of an unknown format",
        "pipe.jpg": "not a regular file",
        "zero.jpg": "not a regular file",
        "hole.png": "it has 5.0 GB, more than 4",
    }.items():
        with pytest.raises(ValueError, match=rf"Cannot read a photograph from .*{name}: .*{why}"):
            read_photo(paths[name])
    with pytest.raises(FileNotFoundError, match=r"no photograph .*removed\.jpg"):
        read_photo(paths["removed.jpg"])


def test_a_bomb_takes_no_memory(tmp_path):
    """In a process that could not hold it."""
    resource = pytest.importorskip("resource")
    (tmp_path / "bomb.png").write_bytes(whole_png(30_000, 30_000))
    (tmp_path / "limit.png").write_bytes(png(25_000, 20_000))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match="announces 30000x30000"):
        read_photo(tmp_path / "bomb.png")
    with pytest.raises(ValueError, match="damaged"):  # as many as are allowed, and none there
        read_photo(tmp_path / "limit.png")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000


def test_given_by_name_or_in_a_folder_odd_files_do_not_hang(tmp_path):
    write_bad_files(tmp_path, good=1)
    with pytest.warns(UserWarning, match=r"left out: link\.jpg, pipe\.jpg, zero\.jpg, as links"):
        by_folder = {source.name for source in find_photos([tmp_path])}
    assert not by_folder & {"pipe.jpg", "zero.jpg", "link.jpg", "folder.jpg"}
    assert len(by_folder) == 30
    for name in ("pipe.jpg", "zero.jpg"):
        [source] = find_photos([tmp_path / name])
        [found] = detect([source], Rows(), cache=tmp_path / "cache")
        assert "not a regular file" in found.problem


@pytest.mark.slow
def test_a_detector_that_kills_hangs_or_starves_costs_one_image(monkeypatch, tmp_path):
    """And such failures are not remembered: it may have been somebody else who took all memory."""
    monkeypatch.setattr(module, "_SECONDS", 4.0)
    image = np.zeros((48, 64, 3), np.uint8)
    image[20] = 255
    sources = []
    for number, kind in enumerate([0, 1, 0, 2, 3, 0, 4, 5, 0, 0]):
        frame = image.copy()
        frame.flat[0] = kind
        sources.append(Source(f"{number}", image=frame))
    found = list(detect(sources, Rows(), workers=2, cache=tmp_path / "cache"))
    assert len(list((tmp_path / "cache").iterdir())) == 1
    assert [len(d.lines) for d in found] == [1, 0, 1, 0, 0, 1, 0, 0, 1, 1]
    problems = [d.problem for d in found if d.problem]
    for problem, text in zip(
        problems,
        ("SIGKILL", "SIGSEGV", "more than 4 s", "not enough memory", "detector failed"),
        strict=True,
    ):
        assert text in problem
        assert "\n" not in problem


def test_a_file_that_is_removed_or_replaced_while_others_are_read_is_told(tmp_path):
    image = np.zeros((48, 64, 3), np.uint8)
    image[20] = 255
    for number in range(4):
        cv2.imwrite(str(tmp_path / f"{number}.png"), image)
    sources = find_photos([tmp_path])
    found = []
    for detection in detect(sources, Rows()):
        found.append(detection)
        if len(found) == 1:
            (tmp_path / "1.png").unlink()
            (tmp_path / "2.png").write_bytes(b"")
    assert [len(d.lines) for d in found] == [1, 0, 0, 1]
    assert "no photograph" in found[1].problem
    assert "the file is empty" in found[2].problem


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may read everything")
def test_a_file_that_may_not_be_read_is_told(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((48, 64), np.uint8))
    (tmp_path / "a.png").chmod(0)
    [found] = detect(find_photos([tmp_path]), Rows(), cache=tmp_path / "cache")
    assert found.problem == "Permission denied"


@pytest.mark.filterwarnings("ignore:.*left out. link.jpg")
def test_only_bad_files_are_one_sentence(tmp_path):
    write_bad_files(tmp_path, good=0)
    with pytest.raises(ValueError, match="None of the images can be used"):
        calibrate_images(ImageJob((tmp_path,), workers=0))
