"""Focal lengths from every source, on rendered boards with exact truth."""

import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import synthetic
from zoomjax.vision.detection import Detection, detect
from zoomjax.vision.focals import Board, choose_focals
from zoomjax.vision.images import Source

SIZE = (1072, 712)
PRINCIPAL = (np.array(SIZE) - 1) / 2


def of(name, focal=None):
    line = np.stack([np.full(9, 30.0), np.arange(10.0, 100, 10)], axis=-1)
    return Detection(name, SIZE, (line,), focal)


def test_exif_data_come_first():
    found = choose_focals([of("a.jpg", 24.0), of("b.jpg", 70.0), of("c.jpg")])
    assert found.focal == {"a.jpg": 24.0, "b.jpg": 70.0}
    assert (found.unit, found.origin, found.deviation) == ("mm", "EXIF data", {})
    assert "EXIF" in found.absent


def test_a_table_is_read(tmp_path):
    (tmp_path / "f.csv").write_text("image,focal\na.jpg,1200\nb.jpg,4000\n")
    found = choose_focals([of("a.jpg", 24.0), of("b.jpg"), of("c.jpg")], str(tmp_path / "f.csv"), unit="px")
    assert (found.focal, found.unit) == ({"a.jpg": 1200.0, "b.jpg": 4000.0}, "px")
    assert found.absent == "f.csv has no row for it"


def test_one_number_is_that_of_all():
    assert choose_focals([of("a.jpg", 24.0), of("b.jpg")], "35").focal == {"a.jpg": 35.0, "b.jpg": 35.0}


@pytest.mark.parametrize(
    ("way", "error", "message"),
    [
        (None, ValueError, "no flat grid.*image,focal.*EXIF.*parallel.*oblique"),
        ("exif", ValueError, "EXIF data.*image,focal.*EXIF.*parallel.*oblique"),
        ("plane", ValueError, "homographies"),
        ("board", ValueError, "--pitch and --distance"),
        ("zoom", ValueError, "'zoom', which is no way"),
        ("-3", ValueError, "positive number"),
        ("nan", ValueError, "positive number"),
        ("nothing.csv", FileNotFoundError, "nothing.csv"),
    ],
)
def test_without_a_focal_length_the_ways_are_named(way, error, message):
    with pytest.raises(error, match=message):
        choose_focals([of("a.jpg"), of("b.jpg")], way)


@pytest.fixture(scope="module")
def striped():
    """What the detector finds on the paper's board at four focal lengths."""
    lens = synthetic.nikkor_18_200(SIZE)
    focal = np.array([24.0, 35.0, 60.0, 100.0])
    photos = [
        Source(f"{f:g}.jpg", image=synthetic.board_photo(lens, float(f), blur=0.8, noise=2)) for f in focal
    ]
    return focal, list(detect(photos, zj.EdgeDetector()))


def test_the_pitch_of_a_board_gives_the_focal_length_within_a_thousandth(striped):
    focal, detections = striped
    board = synthetic.StripedBoard.before(synthetic.nikkor_18_200(SIZE))
    # The stripes of the paper's board are not quite as wide one way as the other: 21.45 and 21.96 mm.
    widths = [board.size[axis] / board.stripes[axis] / 2 for axis in (0, 1)]
    upright = [
        Detection(
            d.name, d.image_size, tuple(line for line in d.lines if np.diff(np.ptp(line, axis=0)) > 0)
        )
        for d in detections
    ]
    found = choose_focals(upright, board=Board(widths[0], board.distance, board.pixel))
    assert (found.unit, found.origin) == ("mm", "the board's pitch (eq. 14)")
    for d, f in zip(detections, focal, strict=True):
        assert found.focal[d.name] == pytest.approx(f, rel=1e-3)
        assert 0 < found.deviation[d.name] < 1e-3 * f


def oblique(focal, tilts, k=(0.05, -0.02)):
    """A grid of 12 x 8 nodes seen obliquely through a lens, a detection each view."""
    lens = zj.Distortion(jnp.array(k), jnp.array(PRINCIPAL), jnp.array(np.hypot(*SIZE) / 2))
    row, column = np.mgrid[:8, :12].astype(float)
    for index, (a, b) in enumerate(tilts):
        x, y = (column - 5.5) / 12, (row - 3.5) / 12
        depth = 1.3 * focal / 1000 + np.sin(a) * x + np.sin(b) * y
        corrected = PRINCIPAL + focal * np.stack([np.cos(a) * x, np.cos(b) * y], -1) / depth[..., None]
        seen = np.asarray(lens.distort(jnp.asarray(corrected)))
        yield Detection(f"{focal:g}-{index}.png", SIZE, tuple(zj.GridDetector.lines(seen)), None, seen)


def test_oblique_views_of_a_grid_give_focal_lengths():
    """Their distortion is not known: it is found first. Tilts about one axis are plane rotations."""
    tilts = ((0.5, 0.0), (0.0, 0.6), (-0.6, 0.0))
    detections = [d for focal in (1000.0, 1500.0, 2200.0) for d in oblique(focal, tilts)]
    found = choose_focals(detections)
    assert (found.unit, found.origin) == ("px", "homographies of the grid")
    for name, focal in found.focal.items():
        assert focal == pytest.approx(float(name.split("-")[0]), rel=2e-3)
    assert len(found.focal) == len(detections)


def test_a_square_view_tells_nothing():
    detections = [*oblique(1000.0, [(0.5, 0.0), (0.0, 0.5), (0.0, 0.0)])]
    found = choose_focals(detections, "plane")
    assert set(found.focal) == {"1000-0.png", "1000-1.png"}
    assert "too squarely" in found.absent
