"""Lines of many images: the same over processes and from the cache, and bad images in between."""

import functools
import importlib.util
import io
import multiprocessing
import os
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from PIL import Image

import zoomjax as zj
from zoomjax._core import executors
from zoomjax.detect import batch as module
from zoomjax.detect.batch import Detection, detect
from zoomjax.detect.sources import Source, find_photos


class Marker(zj.detect.AbstractDetector):
    """Finds a line in each row of bright pixels, and writes down that it has looked."""

    log: str

    def __call__(self, image):
        with open(self.log, "a") as file:
            file.write("looked\n")
        rows = np.flatnonzero(image.reshape(*image.shape[:2], -1)[..., 0].min(axis=1) > 200)
        return [
            np.stack([np.arange(image.shape[1]), np.full(image.shape[1], row)], -1) * 1.0 for row in rows
        ]


@pytest.fixture
def marker(tmp_path):
    return Marker(str(tmp_path / "log.txt"))


def looks(marker):
    try:
        with open(marker.log) as file:
            return len(file.readlines())
    except FileNotFoundError:
        return 0


@pytest.fixture
def photos(tmp_path):
    """Five images 120 px wide, with 1, 2, 3 lines, none, and one that cannot be read."""
    folder = tmp_path / "photos"
    folder.mkdir()
    for number, rows in enumerate(([7], [3, 30], [1, 2, 3], [])):
        image = np.zeros((40, 120), np.uint8)
        image[rows] = 255
        cv2.imwrite(str(folder / f"{number}.png"), image)
    (folder / "4.png").write_bytes(b"no image")
    return find_photos([folder])


def same(first: Detection, second: Detection):
    assert (first.name, first.image_size, first.problem) == (second.name, second.image_size, second.problem)
    for line, other in zip(first.lines, second.lines, strict=True):
        np.testing.assert_array_equal(line, other)


def test_each_image_is_looked_at_and_bad_ones_are_reported(photos, marker):
    found = list(detect(photos, marker))
    assert [d.name for d in found] == ["0.png", "1.png", "2.png", "3.png", "4.png"]
    assert [len(d.lines) for d in found] == [1, 2, 3, 0, 0]
    assert [d.image_size for d in found] == [(120, 40)] * 4 + [(0, 0)]
    assert [bool(d.problem) for d in found] == [False] * 3 + [True] * 2
    assert "no lines were found" in found[3].problem
    assert "4.png: it is damaged, or of an unknown format" in found[4].problem


def test_points_are_four_px_apart(photos, marker):
    [line] = next(detect(photos, marker)).lines
    np.testing.assert_array_equal(line[:, 0], np.arange(0, 120, 4))


def test_what_was_found_before_is_not_looked_for_again(photos, marker, tmp_path):
    first = list(detect(photos, marker, cache=tmp_path / "cache"))
    assert looks(marker) == 4
    for one, other in zip(first, detect(photos, marker, cache=tmp_path / "cache"), strict=True):
        same(one, other)
    assert looks(marker) == 4


def test_the_cache_knows_images_by_what_they_show(photos, marker, tmp_path):
    cache = tmp_path / "cache"
    list(detect(photos, marker, cache=cache))
    photos[0].path.rename(photos[0].path.with_name("renamed.png"))
    photos[1].path.write_bytes(photos[2].path.read_bytes())
    [renamed, changed] = detect(
        [Source("renamed.png", photos[0].path.with_name("renamed.png")), photos[1]], marker, cache=cache
    )
    assert (renamed.name, len(renamed.lines), len(changed.lines)) == ("renamed.png", 1, 3)
    assert looks(marker) == 4


def test_another_detector_or_program_looks_again(photos, marker, tmp_path, monkeypatch):
    cache = tmp_path / "cache"
    list(detect(photos[:1], marker, cache=cache))
    list(detect(photos[:1], Marker(str(tmp_path / "other.txt")), cache=cache))
    assert len(list(cache.iterdir())) == 2
    monkeypatch.setattr(module, "_code", lambda kind: b"changed")
    list(detect(photos[:1], marker, cache=cache))
    assert looks(marker) == 2


class Filled(zj.detect.AbstractDetector):
    """Finds one line, at the height that its setting says."""

    height: np.ndarray

    def __call__(self, image):
        return [np.stack([np.arange(20.0), np.full(20, float(self.height[0]))], -1)]


def test_images_of_other_shapes_and_detectors_of_other_arrays_are_others(tmp_path, marker):
    pixels = np.zeros(64 * 96, np.uint8)
    pixels[:96] = 255
    for shape in ((64, 96), (96, 64)):
        [found] = detect([Source("a", None, pixels.reshape(shape))], marker, cache=tmp_path / "cache")
        assert found.image_size == shape[::-1]
        assert len(found.lines) == 1
        assert np.ptp(found.lines[0][:, 0]) > shape[1] - 8
    for height in (1.0, 33.0):
        [found] = detect(
            [Source("a", None, pixels.reshape(64, 96))],
            Filled(np.array([height, 2.0])),
            cache=tmp_path / "cache",
        )
        assert found.lines[0][0, 1] == height


def test_a_detector_whose_file_has_changed_looks_again(tmp_path):
    image = np.zeros((64, 96), np.uint8)
    for height in (1, 5):
        file = tmp_path / "own_detector.py"
        file.write_text(OWN.format(height))
        spec = importlib.util.spec_from_file_location("own_detector", file)
        own = importlib.util.module_from_spec(spec)
        sys.modules["own_detector"] = own
        spec.loader.exec_module(own)
        [found] = detect([Source("a", None, image)], own.Own(), cache=tmp_path / "cache")
        assert found.lines[0][0, 1] == height


OWN = """
import numpy as np, zoomjax as zj
class Own(zj.detect.AbstractDetector):
    def __call__(self, image):
        return [np.stack([np.arange(20.0), np.full(20, {})], -1)]
"""


class Poor(zj.detect.AbstractDetector):
    """Finds nothing that is a line."""

    def __call__(self, image):
        return [np.array([[0.3, 0.3], [0.30001, 0.3], [0.30002, 0.3]]), np.zeros((0, 2))]


def test_points_of_one_place_and_none_are_no_lines():
    [found] = detect([Source("a", None, np.zeros((64, 96), np.uint8))], Poor())
    assert found.lines == ()
    assert "no lines" in found.problem


@pytest.mark.parametrize(
    "call", [zj.detect.find_checkerboard, zj.detect.find_dots, zj.detect.GridDetector()]
)
def test_a_list_is_no_image(call):
    with pytest.raises((ValueError, TypeError), match="image"):
        call([[0, 255], [255, 0]])


def test_a_source_is_a_file_or_pixels():
    for wrong in ({}, {"path": "a.jpg", "image": np.zeros((32, 32), np.uint8)}, {"image": [[0]]}):
        with pytest.raises((ValueError, TypeError), match="image"):
            Source("a", **wrong)


def _rezipped(content, **changed):
    stored = dict(np.load(io.BytesIO(content))) | changed
    np.savez(file := io.BytesIO(), **stored)
    return file.getvalue()


POISON = {
    "cut": lambda good: good[:100],
    "empty": lambda good: b"",
    "no archive": lambda good: b"PK\x03\x04" + bytes(200),
    "bytes flipped": lambda good: good[:150] + bytes(b ^ 255 for b in good[150:260]) + good[260:],
    "a pickle": lambda good: _rezipped(good, points=np.array([object()], dtype=object)),
    "other arrays": lambda good: _rezipped(good, points=np.zeros((3, 3))),
    "other counts": lambda good: _rezipped(good, counts=np.array([1000])),
    "negative counts": lambda good: _rezipped(good, counts=np.array([-1, 60, 41])),
    "no numbers": lambda good: _rezipped(
        good, points=np.full_like(np.load(io.BytesIO(good))["points"], np.nan)
    ),
    "a focal length below zero": lambda good: _rezipped(good, focal=np.array(-5.0)),
    "an infinite focal length": lambda good: _rezipped(good, focal=np.array(np.inf)),
    "no size": lambda good: _rezipped(good, image_size=np.array([0, 0])),
    "text": lambda good: _rezipped(good, focal=np.array("a lot")),
}


@pytest.mark.parametrize("kind", POISON)
def test_a_damaged_or_poisoned_cache_is_no_cache(kind, photos, marker, tmp_path):
    cache = tmp_path / "cache"
    [first] = detect(photos[:1], marker, cache=cache)
    [file] = cache.iterdir()
    file.write_bytes(POISON[kind](file.read_bytes()))
    [again] = detect(photos[:1], marker, cache=cache)
    for line, other in zip(again.lines, first.lines, strict=True):
        np.testing.assert_array_equal(line, other)
    assert looks(marker) == 2
    list(detect(photos[:1], marker, cache=cache))
    assert looks(marker) == 2  # it was mended


def test_lines_and_grids_are_kept_apart(photos, marker, tmp_path, monkeypatch):
    """So that another source of focal lengths looks for nothing twice."""
    cache, searched = tmp_path / "cache", []
    monkeypatch.setattr(zj.detect.GridDetector, "find", lambda *_: searched.append(1))
    [lines_alone] = detect(photos[:1], marker, cache=cache)
    assert (looks(marker), len(searched)) == (1, 0)
    for _ in range(2):
        [with_grid] = detect(photos[:1], marker, grid="all", cache=cache)
        same(with_grid, lines_alone)
        assert (looks(marker), len(searched)) == (1, 1)  # that there is no grid is kept, too
    [again] = detect(photos[:1], marker, grid="none", cache=cache)
    same(again, lines_alone)
    assert (looks(marker), len(searched)) == (1, 1)


@pytest.mark.parametrize("kind", ["cut", "empty", "odd"])
def test_a_damaged_grid_in_the_cache_is_searched_for_again(kind, photos, marker, tmp_path, monkeypatch):
    cache, found = tmp_path / "cache", np.arange(24.0).reshape(3, 4, 2)
    monkeypatch.setattr(zj.detect.GridDetector, "find", lambda *_: found)
    list(detect(photos[:1], marker, grid="all", cache=cache))
    [file] = (path for path in cache.iterdir() if "nodes" in np.load(path))
    good = file.read_bytes()
    file.write_bytes({"cut": good[:100], "empty": b"", "odd": _rezipped(good, nodes=np.zeros(7))}[kind])
    [again] = detect(photos[:1], marker, grid="all", cache=cache)
    np.testing.assert_array_equal(again.nodes, found)
    assert file.read_bytes() == good


def test_a_cache_that_cannot_be_written_does_no_harm(photos, marker, tmp_path):
    (tmp_path / "file").write_text("no folder")
    assert len(next(detect(photos[:1], marker, cache=tmp_path / "file" / "cache")).lines) == 1


def test_the_cache_does_not_keep_a_videos_track(marker, tmp_path):
    image = np.zeros((40, 120), np.uint8)
    image[7] = 255
    for focal in (20.0, 200.0):
        [found] = detect([Source("a", image=image, focal=focal)], marker, cache=tmp_path / "cache")
        assert found.focal == focal
    [found] = detect([Source("a", image=image)], marker, cache=tmp_path / "cache")
    assert found.focal is None
    assert looks(marker) == 1


@pytest.mark.parametrize("first", [None, 35.0, 50.0])
@pytest.mark.parametrize("second", [None, 35.0, 50.0])
def test_exif_data_come_before_a_focal_length_that_is_given_also_in_the_cache(
    first, second, marker, tmp_path
):
    image, photo = np.zeros((40, 120, 3), np.uint8), tmp_path / "photo.jpg"
    image[6:10] = 255
    exif = b"Exif\0\0" + zj.io.exif_with_focal(35.0)
    Image.fromarray(image).save(photo, exif=exif, quality=95)
    for focal in (first, second):
        [found] = detect([Source("a", photo, focal=focal)], marker, cache=tmp_path / "cache")
        assert found.focal == 35


def test_what_no_detector_can_do_with_an_image_is_told(tmp_path):
    grey, small = np.zeros((100, 100), np.uint8), np.zeros((20, 100, 3), np.uint8)
    [found] = detect([Source("a", image=grey)], zj.detect.PitchDetector())
    assert "grey" in found.problem
    assert "Try another detector, such as edges (argument detector)" in found.problem
    [found] = detect([Source("a", image=small)], zj.EdgeDetector())
    assert found.problem == "it is 100x20 px: at least 32 px a side are needed"


class Broken(zj.detect.AbstractDetector):
    def __call__(self, image):
        raise IndexError("out of bounds.")


def test_a_detector_that_fails_is_one_images_problem(photos):
    found = list(detect(photos, Broken()))
    assert [d.problem for d in found[:4]] == ["the detector failed: IndexError: out of bounds"] * 4


def test_a_file_that_may_not_be_read_is_told_in_words(photos, marker, monkeypatch):
    def denied(self):
        raise PermissionError(13, "Permission denied", str(self.path))

    monkeypatch.setattr(Source, "read", denied)
    assert next(detect(photos, marker)).problem == "Permission denied"


@pytest.mark.slow
def test_processes_find_what_one_does(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for number in range(5):
        image = np.full((200, 300), 40, np.uint8)
        image[:, 40 + 10 * number : 90] = 200
        image[:, 150 : 170 + 10 * number] = 200
        cv2.imwrite(str(folder / f"{number}.png"), cv2.GaussianBlur(image, (0, 0), 0.8))
    (folder / "broken.png").write_bytes(b"no image")
    photos = find_photos([folder])
    alone = list(detect(photos, zj.EdgeDetector()))
    assert [len(d.lines) for d in alone] == [4] * 5 + [0]
    for one, other in zip(alone, detect(photos, zj.EdgeDetector(), workers=2), strict=True):
        same(one, other)
    assert multiprocessing.active_children() == []


def test_processes_end_when_the_rest_is_not_wanted(photos):
    found = detect(photos, zj.EdgeDetector(), workers=2)
    next(found)
    found.close()
    assert multiprocessing.active_children() == []


def test_a_grid_is_looked_for_where_it_tells_the_focal_length(tmp_path):
    squares = np.kron(np.indices((8, 10)).sum(0) % 2, np.ones((20, 20)))
    board = np.pad((255 * squares).astype(np.uint8), 20, constant_values=255)
    sources = [Source("plain", image=board), Source("known", image=board, focal=35.0)]
    nodes = {grid: [d.nodes is not None for d in detect(sources, zj.EdgeDetector(), grid=grid)]
             for grid in ("all", "none", "without focal length")}  # fmt: skip
    assert nodes == {
        "all": [True, True],
        "none": [False, False],
        "without focal length": [True, False],
    }
    [of_grid] = detect(sources[:1], zj.detect.GridDetector(), cache=tmp_path)
    [again] = detect(sources[:1], zj.detect.GridDetector(), cache=tmp_path)
    np.testing.assert_array_equal(of_grid.nodes, again.nodes)
    assert of_grid.nodes.shape == (7, 9, 2)


@pytest.fixture(scope="module")
def pool():
    """Two processes, as of any executor."""
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield pool


@pytest.mark.slow
def test_an_executor_finds_the_same_in_its_processes(photos, marker, pool, tmp_path):
    """Bad images in between; workers look into the cache, and write to it."""
    sources = [*photos, Source("pixels", image=cv2.imread(str(photos[1].path)), focal=31.0)]
    cache = tmp_path / "cache"
    for _ in range(2):
        found = list(detect(sources, marker, executor=pool, cache=cache))
        for one, other in zip(found, detect(sources, marker), strict=True):
            same(one, other)
        assert found[-1].focal == 31.0
    assert looks(marker) == 5 + 5 + 5  # here twice, there once


def test_an_executor_of_threads_serves_too(photos, marker):
    with ThreadPoolExecutor(2) as pool:
        for one, other in zip(detect(photos, marker, executor=pool), detect(photos, marker), strict=True):
            same(one, other)


def test_pixels_of_a_clip_are_handed_over_a_few_at_a_time(marker, monkeypatch):
    image = np.zeros((40, 120), np.uint8)
    image[7] = 255
    taken = []

    def frames():
        for number in range(20):
            taken.append(number)
            yield Source(f"{number}", image=image)

    monkeypatch.setattr(executors, "_MOST_BYTES", 3 * image.nbytes)
    with ThreadPoolExecutor(1) as pool:
        for number, _ in enumerate(detect(frames(), marker, executor=pool)):
            assert len(taken) <= number + 4
    assert len(taken) == 20


@pytest.mark.slow
def test_workers_in_another_folder_find_what_is_named_from_here(photos, marker, pool, monkeypatch):
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as elsewhere:
        elsewhere.submit(os.chdir, "/").result()
        monkeypatch.chdir(photos[0].path.parent)
        found = list(detect(find_photos(["0.png", "1.png"]), marker, executor=elsewhere))
    assert [(d.file, len(d.lines)) for d in found] == [("0.png", 1), ("1.png", 2)]


class Deadly(zj.detect.AbstractDetector):
    """Ends the process that runs it."""

    def __call__(self, image):
        os._exit(1)


@pytest.mark.slow
def test_a_pool_that_breaks_is_said_to_be_broken(photos):
    with (
        ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as broken,
        pytest.raises(RuntimeError, match=r"The executor gave up \(BrokenProcessPool.*Begin again"),
    ):
        list(detect(photos, Deadly(), executor=broken))


def test_what_fails_in_an_executor_is_a_problem_of_its_image(photos, marker):
    class Failing(ThreadPoolExecutor):
        def submit(self, function, /, source):
            if source.name == "1.png":
                function = functools.partial(int, "no number")
            return super().submit(function, source)

    with Failing(1) as pool:
        found = list(detect(photos, marker, executor=pool))
    assert found[1].problem.startswith("its task failed: TypeError")
    assert [len(d.lines) for d in found] == [1, 0, 3, 0, 0]


def test_executors_that_are_none_are_refused(photos, marker):
    with pytest.raises(TypeError, match=r"client\.get_executor\(\), but its type is int"):
        executors.checked_executor(4)
    with (
        ThreadPoolExecutor(1) as pool,
        pytest.raises(ValueError, match="Argument workers is 2, and argument executor has its own"),
    ):
        next(detect(photos, marker, executor=pool, workers=2))


def test_an_executor_is_told_to_stop_when_nobody_asks_any_more(photos, marker):
    with ThreadPoolExecutor(1) as pool:
        found = detect(photos * 50, marker, executor=pool)
        next(found)
        found.close()
    assert looks(marker) < 50
