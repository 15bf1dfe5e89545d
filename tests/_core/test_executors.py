"""Workers of an executor that see other files than the machine that the work comes from."""

import dataclasses
import itertools
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest

import zoomjax as zj
from zoomjax._core import executors
from zoomjax.app.undistort_files import Job, undistort_files
from zoomjax.detect import detect, find_photos
from zoomjax.io import local_copies
from zoomjax.scenes import nikkor_18_200

SIZE = (300, 200)


@pytest.fixture
def away(monkeypatch):
    """Each task takes itself for one on another machine."""
    machines = itertools.count()
    monkeypatch.setattr(executors, "_here", lambda: (f"machine {next(machines)}", 0))


class Elsewhere(ThreadPoolExecutor):
    """An executor with something done before each task there, and after it."""

    def __init__(self, before=lambda item: None, after=lambda item: None):
        super().__init__(1)
        self.before, self.after = before, after

    def submit(self, function, /, item):
        def run(item):
            self.before(item)
            done = function(item)
            self.after(item)
            return done

        future = super().submit(run, item)
        future.exception()  # one after the other
        return future


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for name in ("a", "b"):
        image = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
        image[60:140, 80:220] = 200
        cv2.imwrite(str(folder / f"{name}.png"), image)
    return folder


def is_b(item):
    return Path(getattr(item, "source", None) or getattr(item, "path", item)).stem == "b"


def grow(item):
    """The file b, as another machine might have it."""
    if is_b(item):
        path = Path(getattr(item, "source", None) or getattr(item, "path", item))
        path.write_bytes(path.read_bytes() + b"0")


def change(item):
    """The file b, of the same size, with one byte near its end that is another one."""
    if is_b(item):
        path = Path(getattr(item, "source", None) or getattr(item, "path", item))
        content = bytearray(path.read_bytes())
        content[-20] ^= 1
        path.write_bytes(content)


@pytest.mark.parametrize("before", [grow, change])
def test_a_file_that_is_another_there_is_told_and_no_result(photos, away, before):
    with Elsewhere(before=before) as executor:
        found = list(detect(find_photos([photos]), zj.EdgeDetector(), executor=executor))
    assert [bool(d.problem) for d in found] == [False, True]
    assert "sees another file" in found[1].problem
    assert "workers must see the same files" in found[1].problem


def lens():
    small = nikkor_18_200()
    return zj.ZoomLens(small.zoom, (np.array(SIZE) - 1) / 2, small.focal_range, SIZE)


@pytest.fixture
def job(photos, tmp_path):
    lens().save(tmp_path / "lens.json")
    return Job(tmp_path / "lens.json", (photos,), tmp_path / "out", focal="24", overwrite=True)


def remove(item):
    """What a worker wrote, which is on its own disk."""
    if is_b(item):
        item.target.unlink()


@pytest.mark.parametrize("hook", [{"before": grow}, {"after": remove}], ids=["another", "own disk"])
def test_photos_that_are_not_corrected_here_are_said(hook, job, away, tmp_path):
    with Elsewhere(**hook) as executor:
        done = undistort_files(job, executor=executor)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a.png"]
    assert "1 of 2 photos corrected" in done.sentence
    [problem] = done.skipped.values()
    assert "workers must see the same files" in problem or "must be one that workers share" in problem


def test_what_is_there_of_an_earlier_run_is_no_result(job, away, tmp_path):
    undistort_files(job)
    old = tmp_path / "out" / "b.png"
    content, kept = old.read_bytes(), tmp_path / "kept"

    def keep(item):
        if is_b(item):
            old.rename(kept)

    def restore(item):
        if is_b(item):
            old.unlink()
            kept.rename(old)

    with Elsewhere(before=keep, after=restore) as executor:
        done = undistort_files(job, executor=executor)
    assert old.read_bytes() == content
    assert "must be one that workers share" in next(iter(done.skipped.values()))


def lose(item):
    """A copy, which is on the disk of the machine that the work comes from alone."""
    Path(getattr(item, "source", None) or getattr(item, "path", item)).unlink()


def test_a_worker_that_does_not_see_a_copy_makes_its_own(photos, away):
    pytest.importorskip("fsspec")
    expected = list(detect(find_photos([photos]), zj.EdgeDetector()))
    with local_copies([f"file://{photos.as_posix()}"]) as copies:
        sources = find_photos(copies)
        with Elsewhere(before=lose) as executor:
            found = list(detect(sources, zj.EdgeDetector(), executor=executor))
        assert not sources[0].path.exists()  # which the worker has removed for the next one
    assert [d.problem for d in found] == [d.problem for d in expected]
    for one, other in zip(found, expected, strict=True):
        assert len(one.lines) == len(other.lines) > 0
        np.testing.assert_array_equal(np.concatenate(one.lines), np.concatenate(other.lines))
    assert len(list(photos.iterdir())) == 2


def test_a_worker_corrects_a_copy_of_its_own(photos, job, away, tmp_path):
    pytest.importorskip("fsspec")
    here = undistort_files(dataclasses.replace(job, output=tmp_path / "here"))
    with (
        local_copies([f"file://{photos.as_posix()}"]) as copies,
        Elsewhere(before=lose) as executor,
    ):
        there = undistort_files(
            dataclasses.replace(job, inputs=tuple(map(Path, copies))), executor=executor
        )
    assert not there.skipped
    assert len(here.files) == len(there.files) == 2
    for (_, one), (_, other) in zip(here.files, there.files, strict=True):
        np.testing.assert_array_equal(cv2.imread(str(one)), cv2.imread(str(other)))
