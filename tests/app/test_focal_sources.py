"""Focal lengths from every source, on rendered boards with exact truth."""

import dataclasses
from fractions import Fraction

import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.app.board_focals import Board
from zoomjax.app.focal_sources import check_source, choose_focals
from zoomjax.app.image_job import ImageJob
from zoomjax.app.relative import NOTE
from zoomjax.detect.batch import Detection, detect
from zoomjax.detect.sources import Source

SIZE = (1072, 712)
PRINCIPAL = (np.array(SIZE) - 1) / 2
SENSOR = 36.0  # mm, the width of that of scenes.broadcast_zoom


def of(name, focal=None):
    line = np.stack([np.full(9, 30.0), np.arange(10.0, 100, 10)], axis=-1)
    return Detection(name, name, SIZE, (line,), focal)


def test_exif_data_come_first():
    found = choose_focals([of("a.jpg", 24.0), of("b.jpg", 70.0), of("c.jpg")])
    assert found.focal == {"a.jpg": 24.0, "b.jpg": 70.0}
    assert (found.unit, found.origin, found.deviation) == ("mm", "EXIF data", {})
    assert "EXIF" in found.absent


def test_focal_lengths_that_differ_by_rounding_are_one():
    """A camera's own fraction, its digits as float32, as editors write them, and the fraction of these."""
    digits = float(np.float32(6.765))
    again = float(Fraction(digits).limit_denominator(2**20))
    given = {"a.jpg": 6765 / 1000, "b.jpg": digits, "c.jpg": again, "d.jpg": 6.77}
    assert len(set(given.values())) == 4
    found = choose_focals([of(*one) for one in given.items()])
    assert len(set(found.focal.values())) == 2
    np.testing.assert_allclose([*found.focal.values()], [*given.values()], rtol=1e-7)


def test_deviations_of_a_table_are_read(tmp_path):
    (tmp_path / "f.csv").write_text("image,focal,sigma\na.jpg,1200,9\nb.jpg,4000,\n")
    found = choose_focals([of("a.jpg"), of("b.jpg")], str(tmp_path / "f.csv"), unit="px")
    assert found.deviation == {"a.jpg": 9.0}


def test_a_table_is_read(tmp_path):
    (tmp_path / "f.csv").write_text("image,focal\na.jpg,1200\nb.jpg,4000\n")
    found = choose_focals([of("a.jpg", 24.0), of("b.jpg"), of("c.jpg")], str(tmp_path / "f.csv"), unit="px")
    assert (found.focal, found.unit) == ({"a.jpg": 1200.0, "b.jpg": 4000.0}, "px")
    assert found.absent == "f.csv has no row for it"


def test_one_zoom_of_photos_need_not_be_known():
    found = choose_focals([of("a.jpg", 24.0), of("b.jpg")], "same")
    assert found.focal == {"a.jpg": 1.0, "b.jpg": 1.0}
    assert (found.known, found.unit) == (False, "mm")
    assert "photos of one zoom" in found.origin
    check_source("same", None, video=False)
    with pytest.raises(ValueError, match="--focal same is for photos"):
        check_source("same", None, video=True)


def test_one_number_is_that_of_all():
    assert choose_focals([of("a.jpg", 24.0), of("b.jpg")], "35").focal == {"a.jpg": 35.0, "b.jpg": 35.0}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "message"),
    [
        (None, "no flat grid.*image,focal.*EXIF.*parallel.*oblique"),
        ("exif", "EXIF data.*image,focal.*EXIF.*parallel.*oblique"),
        ("plane", "homographies"),
        ("board", "--spacing and --distance"),
    ],
)
def test_without_a_focal_length_the_ways_are_named(source, message):
    with pytest.raises(ValueError, match=message):
        choose_focals([of("a.jpg"), of("b.jpg")], source)


@pytest.mark.parametrize("video", [False, True])
@pytest.mark.parametrize(
    ("source", "error", "message"),
    [
        ("board", ValueError, "--spacing and --distance"),
        ("zoom", ValueError, "'zoom', which is not a source"),
        ("focal.txt", ValueError, "which is not a source"),
        ("-3", ValueError, "positive number"),
        ("0", ValueError, "positive number"),
        ("nan", ValueError, "which is not a source"),
        ("1_000", ValueError, "which is not a source"),
        ("20,5", ValueError, "which is not a source"),
        ("nothing.csv", FileNotFoundError, r"nothing\.csv"),
    ],
)
def test_what_is_no_way_is_told_before_any_work(source, video, error, message):
    with pytest.raises(error, match=message):
        check_source(source, None, video=video)


def test_the_ways_that_there_are(tmp_path):
    (tmp_path / "f.csv").write_text("image,focal\na.jpg,1200\n")
    (tmp_path / "t.csv").write_text("frame,focal\n0,1200\n")
    board = Board((20.0, 20.0), 1000.0, 0.005)
    for source in (None, "exif", "plane", "35", str(tmp_path / "f.csv")):
        check_source(source, None, video=False)
    for source in ("plane", "35", str(tmp_path / "t.csv")):
        check_source(source, None, video=True)
    for source in (None, "board"):
        check_source(source, board, video=True)
    for source in (None, "exif"):
        with pytest.raises(ValueError, match=r"A video needs --focal.*time,focal"):
            check_source(source, None, video=True)


@pytest.fixture(scope="module")
def striped():
    """What the detector finds on the paper's board at four focal lengths."""
    lens = scenes.nikkor_18_200(SIZE)
    focal = np.array([24.0, 35.0, 60.0, 100.0])
    photos = [
        Source(f"{f:g}.jpg", image=scenes.board_photo(lens, float(f), blur=0.8, noise=2)) for f in focal
    ]
    return focal, list(detect(photos, zj.EdgeDetector()))


BOARD = scenes.StripedBoard.before(scenes.nikkor_18_200(SIZE))
PITCHES = tuple(BOARD.size[axis] / BOARD.stripes[axis] / 2 for axis in (0, 1))  # 21.45 and 21.96 mm


@pytest.mark.slow
def test_the_pitch_of_a_board_gives_the_focal_length_within_a_thousandth(striped):
    focal, detections = striped
    found = choose_focals(detections, board=Board(PITCHES, BOARD.distance, BOARD.pixel_pitch))
    assert (found.unit, found.origin) == ("mm", "the board's pitch (eq. 14)")
    for d, f in zip(detections, focal, strict=True):
        assert found.focal[d.name] == pytest.approx(f, rel=1e-3)
        assert 0 < found.deviation[d.name] < 1e-3 * f


@pytest.mark.slow
def test_a_board_whose_directions_disagree_is_refused(striped):
    """As the paper's board does, taken for one of square fields."""
    _, detections = striped  # of the first, only borders across are found evenly spaced
    with pytest.raises(ValueError, match=r"not spaced alike in both directions.*ACROSSxDOWN"):
        choose_focals(detections[1:], board=Board((PITCHES[0],) * 2, BOARD.distance, BOARD.pixel_pitch))


def upright(*positions):
    y = np.arange(10.0, 700, 10)
    lines = tuple(np.stack([np.full_like(y, x), y], axis=-1) for x in positions)
    return Detection("a.png", "a.png", SIZE, lines)


@pytest.mark.slow
def test_lines_that_are_no_boards_tell_nothing():
    board = Board((20.0, 20.0), 1000.0, 0.01)
    with pytest.raises(ValueError, match="no evenly spaced lines of a board"):
        choose_focals([upright(30, 77, 190, 260, 500, 900)], board=board)
    with pytest.raises(ValueError, match="no evenly spaced lines of a board"):
        choose_focals([upright(30, 30, 30)], board=board)


@pytest.mark.slow
def test_missing_lines_and_lines_in_pieces_do_not_matter():
    board = Board((20.0, 20.0), 1000.0, 0.01)
    [even] = choose_focals([upright(100, 200, 300, 400, 500, 600, 700)], board=board).focal.values()
    [gaps] = choose_focals([upright(100, 200, 200.01, 400, 500, 600, 700)], board=board).focal.values()
    assert even == pytest.approx(1000 * 1 / 21)  # a step of 100 px, 1 mm, is 20 mm on the board
    assert gaps == pytest.approx(even, rel=1e-3)


@pytest.mark.parametrize("board", [((20.0, 20.0), 1.0), ((0.02, 0.02), 1000.0), ((0.02, 0.02), 1.0)])
def test_lengths_of_a_board_in_m_are_refused(board):
    even = upright(100, 200, 300, 400, 500, 600, 700)
    with pytest.raises(ValueError, match=r"which cannot be\. Check --spacing, --distance"):
        choose_focals([even], board=Board(*board, 0.01))
    assert choose_focals([even], board=Board((2.0, 2.0), 100.0, 0.01)).focal  # all in cm is near enough


def oblique(focal, tilts, k=(0.05, -0.02)):
    """A grid of 12 x 8 nodes seen obliquely through a lens, a detection each view."""
    lens = zj.Distortion(jnp.array(k), jnp.array(PRINCIPAL), jnp.array(np.hypot(*SIZE) / 2))
    row, column = np.mgrid[:8, :12].astype(float)
    for index, (a, b) in enumerate(tilts):
        x, y = (column - 5.5) / 12, (row - 3.5) / 12
        depth = 1.3 * focal / 1000 + np.sin(a) * x + np.sin(b) * y
        corrected = PRINCIPAL + focal * np.stack([np.cos(a) * x, np.cos(b) * y], -1) / depth[..., None]
        seen = np.asarray(lens.distort(jnp.asarray(corrected)))
        name = f"{focal:g}-{index}.png"
        yield Detection(name, name, SIZE, tuple(zj.detect.GridDetector.lines(seen)), None, seen)


@pytest.mark.slow
def test_oblique_views_of_a_grid_give_focal_lengths():
    """Their distortion is not known: it is found first. Tilts about one axis are plane rotations."""
    tilts = ((0.5, 0.0), (0.0, 0.6), (-0.6, 0.0))
    detections = [d for focal in (1000.0, 1500.0, 2200.0) for d in oblique(focal, tilts)]
    found = choose_focals(detections, "plane")
    assert (found.unit, found.origin) == ("px", "homographies of the grid")
    for name, focal in found.focal.items():
        assert focal == pytest.approx(float(name.split("-")[0]), rel=2e-3)
    assert len(found.focal) == len(detections)
    supposed = choose_focals(detections)  # to be of one zoom, until a calibration finds otherwise
    assert supposed.one_zoom
    assert len(set(supposed.focal.values())) == 1


@pytest.mark.slow
def test_a_square_view_tells_nothing():
    detections = [*oblique(1000.0, [(0.5, 0.0), (0.0, 0.5), (0.0, 0.0)])]
    found = choose_focals(detections, "plane")
    assert set(found.focal) == {"1000-0.png", "1000-1.png"}
    assert "too squarely" in found.absence(detections[2])
    assert "no flat grid" in found.absence(of("without.png"))


@pytest.mark.slow
def test_markings_of_a_pitch_tell_the_focal_lengths_of_frames():
    lens, focal = scenes.broadcast_zoom(), np.array([47.0, 60.0, 80.0, 110.0])
    lines = scenes.broadcast_lines(lens, focal, spacing=12, noise=0.3)
    ragged, frame = lines.to_ragged(), np.asarray(lines.frame)
    detections = [
        Detection(
            f"{m}.jpg",
            image_size=lens.image_size,
            lines=tuple(ragged[n] for n in np.flatnonzero(frame == m)),
        )
        for m in range(len(focal))
    ]
    found = choose_focals(detections, "pitch")
    assert found.unit == "px"
    assert found.origin == "the markings of the pitch"
    assert len(found.focal) >= 3
    for name, value in found.focal.items():
        true = focal[int(name[0])] / SENSOR * lens.image_size[0]
        assert abs(value / true - 1) < max(0.03, 4 * found.deviation[name] / value)
    with pytest.raises(ValueError, match="its lines cannot be identified as the markings of a"):
        choose_focals([dataclasses.replace(detections[0], lines=detections[0].lines[:2])], "pitch")


@pytest.mark.parametrize("video", [False, True])
def test_a_pitch_is_a_source_that_needs_its_detector(video):
    check_source("pitch", None, video=video)
    with pytest.raises(ValueError, match='needs the markings of a pitch: give argument detector "pitch"'):
        ImageJob(("a.mp4" if video else "a.jpg",), detector="edges", focal="pitch")
    job = ImageJob(("a.mp4" if video else "a.jpg",), detector="pitch", focal="pitch" if video else None)
    assert job.grid == "none"


@pytest.mark.parametrize("video", [False, True])
def test_a_track_of_relative_focal_lengths_is_refused(tmp_path, video):
    (tmp_path / "track.csv").write_text(f"{NOTE}\nframe,seconds,focal,sigma\n0,0,900,2\n")
    with pytest.raises(ValueError, match=r"track\.csv are relative: .* --lines, or give it a known focal"):
        check_source(str(tmp_path / "track.csv"), None, video=video)
