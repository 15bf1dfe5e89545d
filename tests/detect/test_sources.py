"""Photographs of every kind, folders, patterns, and the frames of a video."""

import contextlib
import os
import warnings

import av
import cv2
import numpy as np
import pytest

from zoomjax.app.results_folder import LIST
from zoomjax.detect.sources import Source, as_bytes, find_photos, video_frames
from zoomjax.io.focal_track import FocalTrack
from zoomjax.io.video_reader import decode_video

from .._clips import FRAMES, cut_off, focal, picture, write_clip, write_frames
from .._exif import exif


@pytest.fixture
def image(rng):
    soft = cv2.GaussianBlur(rng.integers(0, 256, (40, 60, 3)).astype(np.float32), (0, 0), 2)
    return np.rint(255 * (soft - soft.min()) / np.ptp(soft)).astype(np.uint8)


def names(sources):
    return [source.name for source in sources]


def test_a_folder_holds_its_photographs_in_order(tmp_path, image):
    for name in ("b.png", "a.JPG", "sub/c.tif", ".hidden/d.png", "._e.jpg", "notes.txt"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"") if name == "notes.txt" else cv2.imwrite(str(path), image)
    assert names(find_photos([tmp_path])) == ["a.JPG", "b.png", "c.tif"]


def test_videos_and_unread_pictures_of_a_folder_are_said(tmp_path, image):
    (tmp_path / "sub").mkdir()
    for name in ("a.png", "sub/b.png"):
        cv2.imwrite(str(tmp_path / name), image)
    for name in ("notes.txt", ".hidden.mp4"):
        (tmp_path / name).write_bytes(b"")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        find_photos([tmp_path])
    (tmp_path / "sub/c.GIF").write_bytes(b"")
    with pytest.warns(UserWarning, match=r"one file is left out: sub/c\.GIF\.$"):
        assert names(find_photos([tmp_path])) == ["a.png", "b.png"]
    (tmp_path / "\x1bd.mp4").write_bytes(b"")
    with pytest.warns(
        UserWarning, match=r"2 files are left out: \\x1bd\.mp4, sub/c\.GIF\. Give videos by name"
    ):
        find_photos([tmp_path])
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        find_photos(iter([tmp_path, str(tmp_path)]))
    assert ["is given twice" in str(one.message) for one in told] == [True, False]


def test_links_to_nowhere_and_to_other_folders_are_told_of(tmp_path, image):
    """As in a repository of git-annex of which not all is there."""
    for name in ("in/a.png", "in/day/b.png", "apart/c.png", "bare/notes.txt"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(tmp_path / name), image) if name.endswith("png") else (tmp_path / name).touch()
    found = ["a.png", "b.png"]
    for name, to in (("around", ".."), ("itself", "."), ("within", "day"), ("bare", "../bare")):
        (tmp_path / "in" / name).symlink_to(to)
    (tmp_path / "in" / "notes").symlink_to("nowhere")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert names(find_photos([tmp_path / "in"])) == found
    (tmp_path / "in" / "day" / "gone.jpg").symlink_to("nowhere.jpg")
    with pytest.warns(UserWarning, match=r"is left out: day/gone\.jpg, as links to nowhere"):
        assert names(find_photos([tmp_path / "in"])) == found
    (tmp_path / "in" / "more").symlink_to("../apart")
    with pytest.warns(UserWarning, match=r"left out: more, as links to other folders\. Give these, too\.$"):
        assert names(find_photos([tmp_path / "in"])) == found
    with pytest.warns(UserWarning, match="left out"):
        assert names(find_photos([tmp_path / "in", tmp_path / "in" / "more"])) == [*found, "c.png"]


def test_patterns_are_expanded(tmp_path, image):
    for name in ("a.png", "b.png", "c.jpg"):
        cv2.imwrite(str(tmp_path / name), image)
    assert names(find_photos([str(tmp_path / "*.png")])) == ["a.png", "b.png"]
    assert names(find_photos([str(tmp_path / "*.png"), tmp_path / "c.jpg"])) == ["a.png", "b.png", "c.jpg"]


def test_of_a_pattern_only_photographs_count(tmp_path, image):
    (tmp_path / "sub").mkdir()
    (tmp_path / "notes.txt").write_text("straight")
    (tmp_path / "gone.png").symlink_to(tmp_path / "nowhere.png")
    for name in ("a.png", "sub/b.png"):
        cv2.imwrite(str(tmp_path / name), image)
    assert names(find_photos([str(tmp_path / "*")])) == ["a.png"]
    assert names(find_photos([str(tmp_path / "**")])) == ["a.png", "b.png"]
    assert names(find_photos([str(tmp_path / "s*")])) == ["b.png"]


def test_results_of_a_calibration_are_no_photographs(tmp_path, image):
    for folder in (tmp_path, tmp_path / "out"):
        (folder / "lines").mkdir(parents=True)
        (folder / "lens.json").write_text("{}")
        for name in ("a.png", "model.png", "lines/a.png"):
            cv2.imwrite(str(folder / name), image)
    assert names(find_photos([tmp_path])) == [f"{tmp_path.name}/a.png", "out/a.png"]


def test_files_of_one_name_are_told_apart_by_their_folders(tmp_path, image):
    for folder in ("1x", "3x"):
        (tmp_path / folder).mkdir()
        cv2.imwrite(str(tmp_path / folder / "board.png"), image)
    assert names(find_photos([tmp_path])) == ["1x/board.png", "3x/board.png"]


def test_the_same_file_twice_is_used_once(tmp_path, image):
    cv2.imwrite(str(tmp_path / "a.png"), image)
    with pytest.warns(UserWarning, match=r"a\.png is given twice: it is used once"):
        assert names(find_photos([tmp_path, tmp_path / "a.png"])) == ["a.png"]
    (tmp_path / "b.png").symlink_to("a.png")
    with pytest.warns(UserWarning, match=r"b\.png is the same file as .*a\.png: it is used once"):
        assert names(find_photos([tmp_path])) == ["a.png"]


def test_of_a_raw_file_and_the_photo_made_from_it_the_photo_is_used(tmp_path, image):
    cv2.imwrite(str(tmp_path / "a.jpg"), image)
    for name in ("a.NEF", "b.NEF"):
        (tmp_path / name).write_bytes(b"as a camera writes it")
    told = r"one file is left out: a\.NEF, as a photo of that name counts for each\.$"
    with pytest.warns(UserWarning, match=told):
        assert names(find_photos([tmp_path])) == ["a.jpg", "b.NEF"]


@pytest.mark.parametrize("mark", ["lens.json", LIST])
def test_pictures_of_an_earlier_calibration_are_no_photos(tmp_path, image, mark):
    """Of one that found no lens, there is only the list of files that were written."""
    (tmp_path / "out" / "lines").mkdir(parents=True)
    for name in ("a.jpg", "out/lines/0001-a.jpg", "out/model.png"):
        cv2.imwrite(str(tmp_path / name), image)
    (tmp_path / "out" / mark).write_text("{}")
    assert names(find_photos([tmp_path])) == ["a.jpg"]
    with pytest.raises(ValueError, match="no photographs in the folder"):
        find_photos([tmp_path / "out"])


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        ("nothing.jpg", FileNotFoundError, r"no file or folder .*nothing\.jpg"),
        ("*.jpg", FileNotFoundError, "no photograph fits the pattern"),
        ("notes.txt", ValueError, r"notes\.txt is not a photo"),
        ("empty", ValueError, "no photographs in the folder"),
    ],
)
def test_what_is_not_there_is_named(tmp_path, given, error, message):
    (tmp_path / "notes.txt").write_text("straight")
    (tmp_path / "empty").mkdir()
    with pytest.raises(error, match=message):
        find_photos([str(tmp_path / given)])


@pytest.mark.parametrize("kind", ["grey", "colour", "alpha", "16 bit", "16 bit grey", "float"])
def test_images_of_any_depth_and_channels_become_bytes(tmp_path, image, kind):
    of = {
        "grey": image[..., 0],
        "colour": image,
        "alpha": np.dstack([image, np.full(image.shape[:2], 9, np.uint8)]),
        "16 bit": image.astype(np.uint16) * 16,  # 12 bits in 16
        "16 bit grey": image[..., 0].astype(np.uint16) * 16,
        "float": image.astype(np.float32) / 255,
    }[kind]
    path = tmp_path / ("a.tif" if kind == "float" else "a.png")
    assert cv2.imwrite(str(path), of)
    read, own = find_photos([path])[0].read()
    expected = image[..., 0] if kind.endswith("grey") else image
    assert read.dtype == np.uint8
    assert read.shape == expected.shape
    assert own is None
    np.testing.assert_allclose(read.astype(float), expected, atol=12)


def test_a_hot_pixel_does_not_darken_the_rest(image):
    deep = image.astype(np.uint16) * 16
    deep[3, 4] = 65535
    found, expected = as_bytes(deep).astype(float), image.astype(float)
    found[3, 4] = expected[3, 4] = 0
    np.testing.assert_allclose(found, expected, atol=12)


def test_values_that_are_no_numbers_are_dark():
    image = np.array([[np.nan, 1.0], [np.inf, 2.0]], np.float32)
    np.testing.assert_array_equal(as_bytes(image), [[0, 127], [0, 255]])


def test_the_orientation_tag_does_not_turn_the_pixels(tmp_path, image):
    """The lens saw them as they are stored."""
    block = np.frombuffer(exif((3500, 100), orientation=6), np.uint8)
    _, content = cv2.imencodeWithMetadata(".png", image, [cv2.IMAGE_METADATA_EXIF], [block])
    (tmp_path / "a.png").write_bytes(content.tobytes())
    read, own = find_photos([tmp_path / "a.png"])[0].read()
    np.testing.assert_array_equal(read, image)
    assert own == 35.0


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_a_file_that_is_cut_off_or_empty_or_something_else_is_refused(tmp_path, image, suffix):
    whole = cv2.imencode(suffix, image)[1].tobytes()
    for content in (whole[: len(whole) // 2], b"", b"straight lines" * 100):
        (tmp_path / f"a{suffix}").write_bytes(content)
        with pytest.raises(ValueError, match=r"Cannot read a photograph from .*a\."):
            find_photos([tmp_path / f"a{suffix}"])[0].read()


def test_what_follows_a_photograph_in_its_file_does_not_matter(tmp_path, image, rng):
    """As films do in phones' files; and a thumbnail within it is not its end."""
    whole = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    path = tmp_path / "a.jpg"
    for _ in range(5):
        path.write_bytes(whole + rng.bytes(20000))
        find_photos([path])[0].read()
    thumbnail = cv2.imencode(".jpg", image[:8, :8])[1].tobytes()
    segment = b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail
    path.write_bytes(whole[:2] + segment + whole[2:])
    find_photos([path])[0].read()
    path.write_bytes(whole[:2] + segment + whole[2 : len(whole) // 2])
    with pytest.raises(ValueError, match="cut off"):
        find_photos([path])[0].read()


# Video.


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return write_clip(tmp_path_factory.mktemp("clip") / "zoom.mp4")


def test_frames_of_a_video_are_spread_over_it_with_their_focal_lengths(clip):
    track = FocalTrack(
        np.arange(FRAMES, dtype=float), np.array([focal(n) for n in range(FRAMES)]), by_time=False
    )
    found = list(video_frames(clip, track, 6))
    numbers = [0, 5, 9, 14, 18, 23]
    assert names(found) == [f"zoom-{n:06d}.jpg" for n in numbers]
    for number, source in zip(numbers, found, strict=True):
        assert source.focal == pytest.approx(focal(number))
        image, own = source.read()
        assert own is None
        assert abs(image.astype(float) - picture(number)[..., None]).mean() < 3


def test_frames_are_spread_where_their_number_is_not_announced(clip, tmp_path):
    """As in Matroska files, which have a length."""
    with av.open(str(clip)) as given, av.open(str(tmp_path / "a.mkv"), "w") as out:
        stream = out.add_stream_from_template(given.streams.video[0])
        for packet in given.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                out.mux(packet)
    numbers = [int(source.name[-10:-4]) for source in video_frames(tmp_path / "a.mkv", 30.0, 6)]
    assert len(numbers) >= 5
    assert (numbers[0], numbers[-1] >= FRAMES - 3) == (0, True)


def test_more_frames_than_there_are_are_all_frames(clip):
    assert len(list(video_frames(clip, 30.0, 1000))) == FRAMES


@pytest.mark.parametrize(
    ("focal", "number", "told"),
    [
        *((focal, 3, "focal must be a finite number above 0") for focal in (0, -30.0, np.nan)),
        *((30.0, number, "number must be an integer of at least 1") for number in (0, -1)),
    ],
)
def test_frames_of_no_focal_length_or_number_are_refused(tmp_path, focal, number, told):
    """Focal lengths of -30 and NaN were those of the frames; of 0 frames the video was called cut off."""
    clip = write_frames(tmp_path / "a.mkv", np.zeros((2, 48, 64, 3), np.uint8))
    with pytest.raises(ValueError, match=f"Argument {told}"):
        list(video_frames(clip, focal, number))
    assert len(list(video_frames(clip, 30.0, 10**30))) == 2


@pytest.mark.parametrize("focal", [0.0, -30.0, np.nan])
def test_an_image_of_no_focal_length_is_refused(focal):
    with pytest.raises(ValueError, match="Argument focal must be a finite number above 0"):
        Source("a.jpg", None, np.zeros((4, 6), np.uint8), focal)


def test_a_video_that_ends_early_gives_the_frames_before_that(clip, tmp_path):
    """Its index announces them all, and the last third is not there."""
    cut = cut_off(clip, tmp_path / "cut.mp4")
    with pytest.warns(UserWarning, match=rf"ends early, after \d+ of {FRAMES} frames"):
        found = list(video_frames(cut, 30.0, FRAMES))
    assert 3 < len(found) < FRAMES


def test_a_video_of_which_no_wanted_frame_is_there_is_an_error(clip, monkeypatch):
    @contextlib.contextmanager
    def announced(path):
        with decode_video(path) as (_, frames):
            yield 10_000, (frame for frame in frames if frame[0] > 0)

    monkeypatch.setattr("zoomjax.io.video_reader.decode_video", announced)
    with pytest.raises(ValueError, match="of 10000 frames none of the 5 wanted can be decoded"):
        list(video_frames(clip, 30.0, 5))


def test_a_whole_video_gives_no_warning(clip):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        list(video_frames(clip, 30.0, 3))


def test_a_track_of_a_longer_video_is_said(tmp_path):
    clip = write_clip(tmp_path / "a.mp4", sound=False)
    longer = FocalTrack(np.array([0.0, 99.0]), np.array([20.0, 80.0]), by_time=False)
    with pytest.warns(UserWarning, match=r"goes on to 99 frames, and the video ends at 23"):
        assert len(list(video_frames(clip, longer, 6))) == 6


def test_results_of_a_clip_are_no_photographs(tmp_path):
    for name in ("lens.json", "motion.png", "panorama.jpg", "a.jpg"):
        (tmp_path / name).touch()
    assert [source.name for source in find_photos([str(tmp_path)])] == ["a.jpg"]


def test_folders_that_cannot_be_read_are_said(tmp_path, monkeypatch):
    """As those of another user, which patterns of names pass over."""
    for name in ("a.png", "closed/b.png", "closed too/c.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "link").symlink_to("closed")
    scandir = os.scandir

    def scanned(folder="."):
        if "closed" in os.path.realpath(folder):
            raise PermissionError(13, "Permission denied", str(folder))
        return scandir(folder)

    monkeypatch.setattr(os, "scandir", scanned)
    told = r"3 folders are left out: closed, closed too, link: what is in there cannot be read\.$"
    with pytest.warns(UserWarning, match=told):
        assert [source.name for source in find_photos([tmp_path])] == ["a.png"]
    with pytest.raises(PermissionError, match="closed"):
        find_photos([tmp_path / "closed"])
