"""Focal lengths of some frames that the user knows, for a calibration from motion."""

import dataclasses

import numpy as np
import pytest

from zoomjax import scenes
from zoomjax.app.focal_sources import choose_focals
from zoomjax.app.known_focals import USUAL_STD, known_focals, measured_focals
from zoomjax.app.relative import NOTE, is_relative_track
from zoomjax.detect import Detection, GridDetector


def test_a_focal_length_and_its_frame():
    known = known_focals(["70@149", " 24 @ 0"], pitch=0.005)
    assert known.frame.tolist() == [0, 149]
    np.testing.assert_allclose(known.focal, [4800, 14000])
    np.testing.assert_allclose(known.std, USUAL_STD * known.focal)


def test_a_track_of_another_run(tmp_path):
    (tmp_path / "track.csv").write_text(
        "# a comment\nframe,seconds,focal,sigma\n3,0.12,900,2\n7,0.28,950,\n"
    )
    known = known_focals([str(tmp_path / "track.csv"), "800@1"], unit="px")
    assert known.rows() == [
        {"frame": 1, "focal": 800.0, "sigma": 8.0},
        {"frame": 3, "focal": 900.0, "sigma": 2.0},
        {"frame": 7, "focal": 950.0, "sigma": 9.5},
    ]


@pytest.mark.parametrize(("sigma", "std"), [("0.5%", 24.0), ("0.1", 20.0)])
def test_a_standard_deviation_for_all(tmp_path, sigma, std):
    (tmp_path / "f.csv").write_text("frame,focal,sigma\n0,24,3\n")
    known = known_focals([str(tmp_path / "f.csv")], sigma=sigma, pitch=0.005)
    np.testing.assert_allclose(known.std, std)


def test_frames_are_found_by_their_numbers_in_the_file():
    known = known_focals(["800@1", "900@4"], unit="px", sigma="5")
    focal, std = known.of_frames(np.array([0.0, 1.0, 3.0, 4.0]))  # frame 2 cannot be decoded
    np.testing.assert_array_equal(focal, [np.nan, 800, np.nan, 900])
    np.testing.assert_array_equal(std, [np.inf, 5, np.inf, 5])
    for other in ([0.0, 1.0, 3.0], [0.0, 1.0], [2.0, 4.0]):
        with pytest.raises(
            ValueError, match=r"--known-focal is of frame [14], which the clip does not have"
        ):
            known.of_frames(np.array(other))


@pytest.mark.parametrize(
    ("given", "options", "message"),
    [
        (["24@0"], {}, "--known-focal is in mm, .* give --pixel-pitch"),
        (["24@0"], {"unit": "mm"}, "give --pixel-pitch"),
        (["24@0"], {"unit": "px", "pitch": 0.005}, "--pixel-pitch has no effect with --focal-unit px"),
        (["24@0"], {"pitch": 0.0}, "--pixel-pitch must be a positive number of mm, but it is 0"),
        (["24"], {"unit": "px"}, "--known-focal is '24'. Give a focal length and the number of its frame"),
        (["24@-1"], {"unit": "px"}, "--known-focal is '24@-1'"),
        (["24@1.5"], {"unit": "px"}, "--known-focal is '24@1.5'"),
        (["24mm@0"], {"unit": "px"}, "--known-focal is '24mm@0'"),
        (["24@99999999999999999999"], {"unit": "px"}, "--known-focal is '24@9"),
        (["0@3"], {"unit": "px"}, "--known-focal must be a positive focal length, but it is 0@3"),
        (["8@3", "9@3"], {"unit": "px"}, "--known-focal is given twice for frame 3"),
        (["8@3"], {"unit": "px", "sigma": "0"}, "--focal-sigma of known focal lengths must be above 0"),
        (["8@3"], {"unit": "px", "sigma": "-1%"}, "Argument focal_sigma must be a number such as 0.3"),
        (["f.csv"], {"unit": "px"}, "sigma in row 2 must be a positive number, but it is 0"),
    ],
)
def test_mistakes_are_told(tmp_path, monkeypatch, given, options, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "f.csv").write_text("frame,focal,sigma\n0,24,0\n")
    with pytest.raises(ValueError, match=message):
        known_focals(given, **options)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_relative_focal_lengths_are_none_that_are_known(tmp_path, encoding):
    (tmp_path / "track.csv").write_text(f"{NOTE}\nframe,focal,sigma\n0,900,2\n", encoding=encoding)
    with pytest.raises(ValueError, match=r"track\.csv are relative: only their ratios are known"):
        known_focals([str(tmp_path / "track.csv")], unit="px")
    assert is_relative_track(tmp_path)
    (tmp_path / "track.csv").write_text("frame,focal,sigma\n0,900,2\n", encoding=encoding)
    assert not is_relative_track(tmp_path)


def view(number, focal, tilt):
    """A grid seen obliquely, without distortion, in a frame of this number."""
    row, column = np.mgrid[:8, :12].astype(float)
    x, y = (column - 5.5) / 12, (row - 3.5) / 12
    depth = 1.3 * focal / 1000 + np.sin(tilt) * x
    seen = np.array([535.5, 355.5]) + focal * np.stack([np.cos(tilt) * x, y], -1) / depth[..., None]
    name = f"a-clip-{number:06d}.jpg"
    return Detection(name, name, (1072, 712), tuple(GridDetector.lines(seen)), None, seen)


@pytest.mark.slow
def test_frames_of_a_board_count_as_one_measurement():
    rng = np.random.default_rng(0)
    seen = [view(n, f, tilt) for n, f, tilt in ((30, 1500.0, -0.6), (4, 1000.0, 0.5), (12, 1200.0, 0.6))]
    noisy = [dataclasses.replace(of, nodes=of.nodes + rng.normal(0, 0.3, of.nodes.shape)) for of in seen]
    empty = Detection("a-clip-000020.jpg", "a-clip-000020.jpg", (1072, 712), ())
    known = measured_focals([*noisy, empty], "plane")
    np.testing.assert_array_equal(known.frame, [4, 12, 30])
    np.testing.assert_allclose(known.focal, [1000, 1200, 1500], rtol=0.03)
    single = choose_focals(noisy, "plane").deviation
    own = [single[f"a-clip-{number:06d}.jpg"] for number in (4, 12, 30)]
    np.testing.assert_allclose(known.std, np.sqrt(3) * np.hypot(own, 0.01 * known.focal), rtol=1e-9)
    with pytest.raises(ValueError, match="No frame tells its focal length by the plane"):
        measured_focals([view(1, 1000.0, 0.0)], "plane")


@pytest.mark.slow
def test_the_scale_that_a_pitch_tells_is_as_far_off_as_said():
    lens, focal = scenes.broadcast_zoom(), np.geomspace(47, 110, 12)
    lines = scenes.broadcast_lines(lens, focal, spacing=12, noise=0.3)
    points, frame = lines.to_ragged(), np.asarray(lines.frame)
    seen = [tuple(points[line] for line in np.flatnonzero(frame == number)) for number in range(12)]
    found = [Detection(f"a-{n:06d}.jpg", "", lens.image_size, of) for n, of in enumerate(seen)]
    known = measured_focals(found, "pitch")
    off = np.log(known.focal / (focal[known.frame] / 36 * lens.image_size[0]))
    std = known.std / known.focal
    assert len(off) > 6
    assert abs(off).max() < 2 * std.min()
    assert abs(np.average(off, weights=std**-2)) < 1.5 * np.sum(std**-2) ** -0.5
    assert abs(off).max() > 0.01  # so that nobody takes away what was added without a look
