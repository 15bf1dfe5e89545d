"""Focal tracks: interpolation in 1/f, their ends, and files that are none."""

import warnings

import numpy as np
import pytest

import zoomjax as zj


def written(path, text):
    path.write_text(text)
    return path


def test_interpolates_in_the_inverse(tmp_path):
    track = zj.io.read_focal_track(written(tmp_path / "t.csv", "time,focal\n0,20\n2.5,40\n5,100\n"))
    assert track.at(999, 0.0) == 20
    assert track.at(0, 1.25) == pytest.approx(2 / (1 / 20 + 1 / 40))
    assert track.at(0, 5.0) == 100


@pytest.mark.parametrize(
    ("header", "rows", "by_time"),
    [
        ("frame,focal", "0,20\n10,40\n", False),
        ("time_or_frame,focal", "0,20\n10,40\n", False),
        ("time_or_frame,focal", "0,20\n9.5,40\n", True),
        ("Time , Focal", "0,20\n10,40\n", True),
    ],
)
def test_positions_are_frames_or_seconds(tmp_path, header, rows, by_time):
    track = zj.io.read_focal_track(written(tmp_path / "t.csv", f"{header}\n{rows}"))
    assert track.by_time is by_time
    assert track.at(5, 5.0) == pytest.approx(1 / np.interp(5, track.position, 1 / track.focal))
    assert track.at(2, 4.0) != track.at(4, 2.0)


def test_ends_are_errors_unless_held():
    samples = (np.array([1.0, 2.0]), np.array([20.0, 40.0]))
    for time in (0.5, 2.5):
        with pytest.raises(ValueError, match=r"goes from 1 to 2 s, and frame 7, at .* s, is outside"):
            zj.io.FocalTrack(*samples).at(7, time)
    assert zj.io.FocalTrack(*samples, hold=True).at(7, 0.5) == 20
    assert zj.io.FocalTrack(*samples, hold=True).at(7, 2.5) == 40


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r'first line must name the columns "time,focal" or "frame,focal"'),
        ("f,t\n1,2\n", r"first line must name .* but it is .f,t."),
        ("time,focal\n", "there are no rows"),
        ("time,focal\n0,wide\n", "focal in row 2 is .wide., which is no number"),
        ("time,focal\n0,20\n1,-3\n", "focal in row 3 must be a positive number"),
        ("time,focal\n0,20,5\n", "row 2 has 3 fields, .* decimal commas"),
        ("frame,focal\n0,20\n0.04,30\n", "frame in row 3 must be a whole number"),
        ("frame,time,focal\n0,0,20\n", "columns time and frame: keep one of them"),
        ("time,focal\n1,20\n0,30\n", "time in row 3 must be greater than in the row before: sort"),
        ("time,focal\n0,20\n0,30\n", "time in row 3 must be greater than in the row before: sort"),
    ],
)
def test_bad_files_are_named(tmp_path, text, message):
    path = written(tmp_path / "bad.csv", text)
    with pytest.raises(ValueError, match=f"bad.csv.*{message}"):
        zj.io.read_focal_track(path)


def test_no_file_and_no_text(tmp_path):
    with pytest.raises(FileNotFoundError):
        zj.io.read_focal_track(tmp_path / "none.csv")
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="not text"):
        zj.io.read_focal_track(tmp_path / "bytes.csv")


@pytest.mark.parametrize("hold", [False, True])
def test_frames_without_times_have_no_place_in_seconds(hold):
    samples = (np.array([0.0, 2.0]), np.array([20.0, 40.0]))
    with pytest.raises(ValueError, match="frames of the video have no times"):
        zj.io.FocalTrack(*samples, hold=hold).at(1, np.nan)
    assert zj.io.FocalTrack(*samples, by_time=False, hold=hold).at(2, np.nan) == 40


def test_one_focal_length_that_is_held_needs_no_times():
    """As of a video without time stamps, corrected at one number."""
    assert zj.io.FocalTrack(np.zeros(1), np.array([25.0]), hold=True).at(7, np.nan) == 25


@pytest.mark.parametrize(
    ("by_time", "position", "focal", "warns"),
    [
        (False, (0, 23), (20, 80), False),
        (False, (1, 24), (20, 80), True),  # counted from 1
        (False, (0, 99), (20, 80), True),
        (False, (0, 99), (30, 30), False),
        (True, (0, 0.8), (20, 80), False),
        (True, (0, 1.7), (20, 80), False),
        (True, (0, 23), (20, 80), True),  # frames, called seconds
    ],
)
def test_a_track_of_a_longer_video_warns(by_time, position, focal, warns):
    track = zj.io.FocalTrack(np.array(position, float), np.array(focal, float), by_time=by_time, hold=True)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        track.warn_if_longer(23, 0.767)
    assert [f"goes on to {position[1]}" in str(each.message) for each in caught] == [True] * warns


@pytest.mark.usefixtures("unchecked")
def test_samples_may_be_lists_and_must_be_numbers():
    assert zj.io.FocalTrack([0, 1], [20, 30], by_time=False).at(1, 0.0) == pytest.approx(30)
    for samples in ((["0", "1"], [20, 30]), ([0, 1], "track.csv"), (None, [20, 30])):
        with pytest.raises(ValueError, match=r"Arguments? (position|focal)"):
            zj.io.FocalTrack(*samples)


def record(*missing, focal=lambda n: 20 + 0.2 * n):
    frames = [n for n in range(200) if not any(first <= n < last for first, last in missing)]
    return "frame,focal\n" + "".join(f"{n},{focal(n)}\n" for n in frames)


def test_a_record_with_a_gap_in_which_the_lens_zooms_is_said(tmp_path):
    with pytest.warns(
        UserWarning, match="no samples from 49 to 100 frames, .* from 29.8 to 40, and one oth"
    ):
        zj.io.read_focal_track(written(tmp_path / "t.csv", record((50, 100), (150, 170))))


@pytest.mark.parametrize(
    "text",
    [
        record((50, 55)),  # a few frames
        record((50, 100), focal=lambda n: 20 if n < 120 else 21),  # the lens rests
        "frame,focal\n" + "".join(f"{n * n},{20 + n}\n" for n in range(30)),  # keys
        "frame,focal\n0,20\n1,21\n2,22\n90,60\n",
    ],
)
def test_keys_and_short_gaps_are_tracks_as_they_are(tmp_path, text):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        zj.io.read_focal_track(written(tmp_path / "t.csv", text))


@pytest.mark.parametrize("name", ["by_time", "hold"])
@pytest.mark.parametrize("value", ["frame", None, 0])
@pytest.mark.usefixtures("unchecked")
def test_what_positions_are_is_said_by_truth_values(name, value):
    """Any word was true: of by_time="frame" frame numbers were seconds."""
    with pytest.raises(TypeError, match=f"Argument {name} must be True or False"):
        zj.io.FocalTrack(np.array([0.0, 9.0]), np.array([20.0, 80.0]), **{name: value})
