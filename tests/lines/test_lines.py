import dataclasses
import warnings
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj

from .._reference import frame_energies
from ..conftest import RAGGED_COUNTS, RAGGED_FRAMES, RAGGED_SIZE

ROW = np.stack([np.arange(5.0), np.full(5, 2.0)], axis=-1)
BETWEEN = (0.9 * ROW, 0.9 * ROW + 1)
"""Lines of points that are no whole steps: those are stored in another way."""
SIZE = (6, 4)


def make(points=(ROW, ROW + 1), frame=(0, 1), focal=(24.0, 70.0), image_size=SIZE, **options):
    return zj.Lines.from_ragged(points, np.array(frame), np.array(focal), image_size=image_size, **options)


def assert_same(actual, expected):
    """The same lines to the last digit, in the same types."""
    for name in ("points", "mask", "frame", "focal", "centre"):
        got, want = getattr(actual, name), getattr(expected, name)
        assert got.dtype == want.dtype
        np.testing.assert_array_equal(got, want)
    assert actual.image_size == expected.image_size
    assert actual.focal_unit == expected.focal_unit


def test_tensors_are_padded_to_the_longest_line(ragged):
    assert ragged.points.shape == (9, max(RAGGED_COUNTS), 2)
    np.testing.assert_array_equal(ragged.mask.sum(axis=1), RAGGED_COUNTS)
    np.testing.assert_array_equal(ragged.counts, RAGGED_COUNTS)


def test_centre_of_distortion_is_that_of_the_image():
    np.testing.assert_array_equal(make().centre, [2.5, 1.5])
    assert make().scale == np.hypot(6, 4) / 2


def test_centre_of_distortion_may_be_given():
    np.testing.assert_array_equal(make(centre=np.array([3.0, 1.0])).centre, [3, 1])


def test_ragged_points_come_back(ragged):
    again = zj.Lines.from_ragged(
        ragged.to_ragged(), ragged.frame, ragged.focal, image_size=ragged.image_size
    )
    assert_same(again, ragged)


def test_plain_python_numbers_will_do():
    points = [[(0, 0), (1, 1), (2, 2)], [(0, 1), (1, 1), (2, 1)]]
    lines = zj.Lines.from_ragged(points, [0, 1], [24, 70], image_size=SIZE)
    assert lines.points.dtype == jnp.float64
    np.testing.assert_array_equal(lines.to_ragged(), points)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_dtype_follows_the_points(dtype):
    lines = make([ROW.astype(dtype), ROW.astype(dtype)])
    for field in (lines.points, lines.focal, lines.centre, lines.counts):
        assert field.dtype == dtype


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_file_keeps_every_digit(dtype, ragged, tmp_path):
    points = [line.astype(dtype) for line in ragged.to_ragged()]
    lines = zj.Lines.from_ragged(
        points,
        ragged.frame,
        ragged.focal,
        image_size=RAGGED_SIZE,
        focal_unit="px",
        centre=np.array([3.0, 0.1]),
    )
    lines.save(tmp_path / "lines.npz")
    assert_same(zj.load_lines(tmp_path / "lines.npz"), lines)


@pytest.mark.parametrize("points", [(ROW, ROW[:2], ROW + 1, 0.9 * ROW), (ROW, ROW[:2], ROW + 1, ROW)])
def test_file_keeps_numbers_of_lines(points, tmp_path):
    with pytest.warns(UserWarning, match="Dropped 1 of 4"):
        lines = make(points=points, frame=(0, 0, 1, 1))
    np.testing.assert_array_equal(lines.number, [0, 2, 3])
    lines.weighted(np.array([1.0, 2.0, 3.0])).save(tmp_path / "lines.npz")
    loaded = zj.load_lines(tmp_path / "lines.npz")
    np.testing.assert_array_equal(loaded.number, [0, 2, 3])
    np.testing.assert_array_equal(loaded.weight, [1, 2, 3])


def test_file_keeps_fields_of_other_dtypes(tmp_path):
    lines = make(points=(ROW.astype(np.float32), ROW.astype(np.float32) + 1))
    given = dataclasses.replace(lines, focal=np.array([24.1, 70.3]), centre=np.array([2.1, 1.7]))
    given.save(tmp_path / "lines.npz")
    assert_same(zj.load_lines(tmp_path / "lines.npz"), given)


def test_what_could_not_be_read_is_not_saved(tmp_path):
    lines = make()
    short = dataclasses.replace(
        lines, mask=np.asarray(lines.mask) & ([[True], [False]] | (np.arange(5) < 2))
    )
    coincident = dataclasses.replace(
        lines, points=np.where(np.array([True, False])[:, None, None], 7.0, np.asarray(lines.points))
    )
    for bad in (short, coincident):
        with pytest.raises(ValueError, match="1 of 2 frames have no line of three distinct points"):
            bad.save(tmp_path / "lines.npz")
    assert list(tmp_path.iterdir()) == []


def test_file_keeps_weights(tmp_path):
    make().weighted([0.5, 0.0]).save(tmp_path / "lines.npz")
    np.testing.assert_array_equal(zj.load_lines(tmp_path / "lines.npz").weight, [0.5, 0])


def test_grids_give_every_row_and_column():
    grid = np.stack(np.meshgrid(np.arange(4.0), 10 * np.arange(3.0)), axis=-1)  # 3 rows of 4 nodes
    lines = zj.Lines.from_grids(
        np.stack([grid, grid + 1, grid + 2]),
        np.array([0, 0, 1]),
        np.array([24.0, 70.0]),
        image_size=(50, 40),
    )
    np.testing.assert_array_equal(lines.frame, [0] * 14 + [1] * 7)
    np.testing.assert_array_equal(lines.counts, 3 * ([4] * 3 + [3] * 4))
    ragged = lines.to_ragged()
    np.testing.assert_array_equal(ragged[1], grid[1])
    np.testing.assert_array_equal(ragged[7 + 3], grid[:, 0] + 1)


def test_grids_of_another_shape_raise():
    with pytest.raises(ValueError, match="one index for each of the 2 grids"):
        zj.Lines.from_grids(np.zeros((2, 3, 4, 2)), np.array([0]), np.array([24.0]), image_size=SIZE)


@pytest.mark.parametrize("name", ["corners", "frame"])
@pytest.mark.usefixtures("unchecked")
def test_masks_of_grids_are_not_lost(name):
    given = {"corners": np.random.default_rng(0).uniform(0, 5, (1, 3, 3, 2)), "frame": np.array([0])}
    given[name] = np.ma.masked_array(given[name], given[name] > 1)
    with pytest.raises(ValueError, match=f"Argument {name} is a masked array"):
        zj.Lines.from_grids(given["corners"], given["frame"], np.array([24.0]), image_size=(6, 6))


def test_by_frame_lists_the_lines_of_each_frame(ragged):
    chosen, present = ragged.by_frame()
    assert chosen.shape == present.shape == (3, 4)
    for frame in range(3):
        np.testing.assert_array_equal(chosen[frame][present[frame]], np.flatnonzero(frame == RAGGED_FRAMES))


@pytest.mark.parametrize("compressed", [False, True])
def test_taken_lines_are_a_data_set_of_one_frame(compressed, ragged):
    k = np.array([[0.1, -0.02]])
    energies = frame_energies(ragged, np.repeat(k, 3, axis=0))
    lines = zj.compress(ragged) if compressed else ragged
    chosen, present = ragged.by_frame()
    for frame in range(3):
        one = lines.take(jnp.asarray(chosen[frame]), jnp.asarray(present[frame]))
        np.testing.assert_array_equal(one.focal, ragged.focal[frame : frame + 1])
        np.testing.assert_allclose(zj.fit.frame_energy(one, jnp.asarray(k)), energies[frame], rtol=1e-9)


def test_by_frame_under_jit_chooses_the_same_lines(ragged):
    chosen, present = jax.jit(lambda lines: lines.by_frame())(ragged)
    for frame in range(3):
        np.testing.assert_array_equal(chosen[frame][present[frame]], np.flatnonzero(frame == RAGGED_FRAMES))


def spoiled(value, position=(2, 1)):
    line = ROW.copy()
    line[position] = value
    return line


BAD = {
    "NaN point": ({"points": [ROW, spoiled(np.nan)]}, "line 1 has 1 NaN or infinite points"),
    "infinite point": ({"points": [spoiled(-np.inf), ROW]}, "line 0 has 1 NaN or infinite"),
    "three coordinates": ({"points": [ROW, np.zeros((5, 3))]}, r"line 1 has shape \(5, 3\)"),
    "one coordinate": ({"points": [ROW, np.zeros(5)]}, r"line 1 has shape \(5,\)"),
    "words": ({"points": [ROW, np.array([["a", "b"]] * 3)]}, "line 1 has shape"),
    "NaN focal length": ({"focal": [24, np.nan]}, r"focal\[1\] is nan"),
    "infinite focal length": ({"focal": [np.inf, 24]}, r"focal\[0\] is inf"),
    "zero focal length": ({"focal": [24, 0]}, r"focal\[1\] is 0"),
    "negative focal length": ({"focal": [-24, 70]}, r"focal\[0\] is -24"),
    "no focal length": ({"focal": []}, "one number a frame"),
    "frame too high": ({"frame": [0, 2]}, r"from 0 to 1.*frame\[1\] is 2"),
    "frame negative": ({"frame": [-1, 1]}, r"frame\[0\] is -1"),
    "frame not whole": ({"frame": [0.0, 1.0]}, "one integer for each of the 2 lines"),
    "too few frame indices": ({"frame": [0]}, "one integer for each of the 2 lines"),
    "frame without lines": ({"frame": [0, 0]}, "No line in 1 of 2 frames"),
    "no lines": ({"points": [], "frame": np.zeros(0, int)}, "No usable line"),
    "only short lines": ({"points": [ROW[:2], ROW[:0]]}, "none of the 2 lines has 3"),
    "unit": ({"focal_unit": "inch"}, "focal_unit must be"),
    "image without height": ({"image_size": (6, 0)}, "image_size must be two positive integers"),
    "text as image size": ({"image_size": b"64"}, "two positive integers"),
    "no image size": ({"image_size": None}, "two positive integers"),
    "one number as image size": ({"image_size": 640}, "two positive integers"),
    "image size that is not finite": ({"image_size": (6.0, np.nan)}, "two positive integers"),
    "centre": ({"centre": np.array([np.nan, 1.0])}, "centre must be two finite numbers"),
    "complex points": ({"points": [ROW, ROW + 1j]}, "real numbers, but line 1 .* complex"),
    "focal lengths as a word": ({"focal": "24"}, "one number a frame"),
}


@pytest.mark.parametrize("weight", [["1", "2"], [b"1", b"2"], [1j, 2], [None, 1.0], ["3", 1]])
def test_weights_that_are_no_numbers_are_refused(weight, unchecked):
    with pytest.raises(ValueError, match="weight must hold real numbers"):
        make().weighted(weight)


@pytest.mark.parametrize(("argument", "message"), BAD.values(), ids=BAD)
def test_bad_input_raises(argument, message, unchecked):
    with pytest.raises(ValueError, match=message):
        make(**argument)


SHORT = {
    "two points": ROW[:2],
    "no points": ROW[:0],
    "one point many times": ROW[[0, 0, 0, 0]],
    "two points many times": ROW[[0, 1, 0, 1, 1]],
}


@pytest.mark.parametrize("short", SHORT.values(), ids=SHORT)
def test_lines_without_three_distinct_points_are_dropped_and_counted(short):
    with pytest.warns(UserWarning, match="Dropped 2 of 4 lines"):
        lines = make([short, ROW, ROW + 1, short], frame=[0, 0, 1, 1])
    assert_same(lines, make())


def test_lines_know_which_of_those_given_they_are():
    with pytest.warns(UserWarning, match="Dropped"):
        lines = make([ROW[:2], ROW, ROW + 1, ROW[:1]], frame=[0, 0, 1, 1])
    np.testing.assert_array_equal(lines.number, [1, 2])
    chosen = lines.take(jnp.array([1, 0]), jnp.array([True, False]))
    np.testing.assert_array_equal(chosen.number, [2, 1])


def test_a_chunk_keeps_every_line_and_frame():
    lines = make([ROW[:2], ROW[:0], ROW], frame=[0, 0, 0], chunk=True)
    np.testing.assert_array_equal(lines.counts, [2, 0, 5])
    np.testing.assert_array_equal(lines.number, [0, 1, 2])
    with pytest.raises(ValueError, match="finite"):
        make([ROW[:2], spoiled(np.nan)], chunk=True)


@pytest.mark.parametrize("unit", [(640, 480), (400, 400)])
def test_coordinates_in_units_of_the_image_are_told(unit):
    t = np.linspace(0.0, 479.0, 20)
    lines = [np.stack([np.full(20, x), t], axis=-1) / unit for x in (9, 630)]
    with pytest.warns(UserWarning, match=r"All points lie within .* are these in units of its size"):
        zj.Lines.from_ragged(lines, [0, 0], [35.0], image_size=(640, 480))


@pytest.mark.parametrize("offset", [(-40, 0), (0, 40)])
def test_points_far_outside_of_the_image_are_told(offset):
    with pytest.warns(UserWarning, match=r"5 of 10 points lie outside of the image of 6 x 4 px, by up to"):
        make([ROW, ROW + np.array(offset)])


def test_half_precision_points_are_widened():
    assert make([ROW.astype(np.float16)] * 2).points.dtype == np.float32


def test_frame_whose_lines_are_all_dropped_raises():
    with (
        pytest.warns(UserWarning, match="Dropped 1 of 2"),
        pytest.raises(ValueError, match="No line in 1 of 2 frames"),
    ):
        make([ROW, ROW[:2]])


def test_shapes_that_disagree_raise():
    with pytest.raises(Exception, match=r"(?s)line"):
        zj.Lines(
            points=jnp.zeros((3, 5, 2)),
            mask=jnp.ones((2, 5), bool),
            frame=jnp.zeros(3, int),
            focal=jnp.ones(1),
            centre=jnp.zeros(2),
            image_size=SIZE,
        )


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "lines.npz"
    make(BETWEEN).save(path)
    return path


def rewrite(path, **changes):
    with np.load(path) as file:
        fields = {name: file[name] for name in file.files} | changes
    np.savez(path, **{name: value for name, value in fields.items() if value is not None})


def cut(path):
    path.write_bytes(path.read_bytes()[:-200])


def replace_by_zip(path):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("hello.txt", "hello")


def save_single_array(path):
    with path.open("wb") as file:
        np.save(file, ROW)


SPOILED = {
    "truncated": (cut, "Cannot read lines"),
    "empty": (lambda path: path.write_bytes(b""), "Cannot read lines"),
    "text": (lambda path: path.write_text("frame,line,x,y\n"), "Cannot read lines"),
    "other archive": (replace_by_zip, "Cannot read lines"),
    "single array": (save_single_array, "not an .npz archive"),
    "foreign arrays": (lambda path: np.savez(path, corners=ROW), "holds no lines; Lines.save"),
    "pickled": (lambda path: rewrite(path, points=np.array([ROW, None], object)), "allow_pickle"),
    "newer version": (lambda path: rewrite(path, version=99), "version is 99"),
    "older version": (lambda path: rewrite(path, version=0), "version is 0"),
    "version in words": (lambda path: rewrite(path, version="one"), "version is 'one'"),
    "several versions": (lambda path: rewrite(path, version=np.ones(2)), "Cannot read lines"),
    "no focal": (lambda path: rewrite(path, focal=None), "focal"),
    "no version": (lambda path: rewrite(path, version=None), "version"),
    "counts that disagree": (lambda path: rewrite(path, counts=np.array([5, 6])), "disagree"),
    "negative counts": (lambda path: rewrite(path, counts=np.array([-5, 15])), "Cannot read lines"),
    "NaN": (lambda path: rewrite(path, points=np.full((10, 2), np.nan)), "NaN"),
    "frame out of range": (lambda path: rewrite(path, frame=np.array([0, 7])), "frame"),
    "image size": (lambda path: rewrite(path, image_size=np.array([6])), "Cannot read lines"),
}


@pytest.mark.parametrize(("spoil", "message"), SPOILED.values(), ids=SPOILED)
def test_file_that_holds_no_lines_raises_and_is_named(spoil, message, saved):
    spoil(saved)
    with pytest.raises(ValueError, match=message) as caught:
        zj.load_lines(saved)
    assert str(saved) in str(caught.value)


def test_damage_anywhere_is_an_error_that_names_the_file_or_does_none(saved):
    """One byte changed, at places spread over the whole file."""
    whole = saved.read_bytes()
    told = []
    for position in range(0, len(whole), 7):
        saved.write_bytes(whole[:position] + bytes([whole[position] ^ 0x55]) + whole[position + 1 :])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                assert np.isfinite(zj.load_lines(saved).points).all()
            except ValueError as error:
                told.append(str(error))
    assert len(told) > 100
    assert all(str(saved) in message for message in told)


def test_missing_file_raises(tmp_path):
    with pytest.raises(FileNotFoundError):
        zj.load_lines(tmp_path / "lines.npz")


@pytest.mark.parametrize("folder", ["absent", "file"])
def test_folder_that_cannot_be_written_is_named(folder, tmp_path):
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(OSError, match=rf"cannot write in the folder .*{folder}"):
        make().save(tmp_path / folder / "lines.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_writing_that_fails_leaves_the_old_file_and_nothing_else(saved, monkeypatch):
    before = saved.read_bytes()

    def fill_the_disk(file, **_):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", fill_the_disk)
    with pytest.raises(OSError, match="No space left"):
        make(BETWEEN).save(saved)
    assert saved.read_bytes() == before
    assert list(saved.parent.iterdir()) == [saved]


def test_a_folder_is_not_replaced_by_a_file(tmp_path):
    with pytest.raises(IsADirectoryError, match="where there is a folder"):
        make().save(tmp_path)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", ["points", "mask", "frame", "focal", "centre"])
def test_nothing_may_be_missing(name):
    with pytest.raises(ValueError, match=f"Argument {name} must be given, but it is None"):
        dataclasses.replace(make(), **{name: None})


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_whole_steps_are_saved_small_and_whole(dtype, tmp_path):
    rng, t = np.random.default_rng(0), np.arange(0, 600, 4.0)[:, None]
    rows = [
        np.rint(1024 * (t * [0.9, 0.1] + [0, 10 * i] + 0.1 * rng.standard_normal((150, 2)))) / 1024
        for i in range(40)
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        lines = make([row.astype(dtype) for row in rows], [0, 1] * 20, image_size=(640, 480))
        lines.save(tmp_path / "small.npz")
        back = zj.load_lines(tmp_path / "small.npz")
        exact = make([row.astype(dtype) + dtype(1e-4) for row in rows], [0, 1] * 20, image_size=(640, 480))
        exact.save(tmp_path / "large.npz")
    assert_same(back, lines)
    share = (tmp_path / "small.npz").stat().st_size / (tmp_path / "large.npz").stat().st_size
    assert share < (0.25 if dtype is np.float64 else 0.5)


@pytest.mark.parametrize("form", ["points", "compressed", "any centre"])
@pytest.mark.usefixtures("unchecked")
def test_coefficients_of_some_of_the_frames_are_refused(noisy, form):
    """The last row was taken for the frames that were missing."""
    make = {"points": lambda x: x, "compressed": zj.compress, "any centre": zj.lines.compress_any_centre}
    lines, frames = make[form](noisy), len(noisy.focal)
    for rows in (np.zeros((frames - 1, 4)), np.zeros((frames + 1, 4)), np.zeros(frames)):
        with pytest.raises(ValueError, match=f"a row for each of the {frames} frames"):
            lines.corrected(jnp.asarray(rows))


@pytest.mark.parametrize("centre", [(1, 2), (1, 2, 3), (-1, 2), (0, 2)], ids=str)
@pytest.mark.usefixtures("unchecked")
def test_centres_of_some_of_the_frames_are_refused(noisy, centre):
    frames = len(noisy.focal)
    shape = (frames + centre[0], 2) if centre[0] < 1 else centre
    if centre == (0, 2):
        assert noisy.about(np.ones(shape)).centre.tolist() == [1, 1]
        return
    with pytest.raises(ValueError, match=f"Argument centre must have shape .*{frames}, 2"):
        noisy.about(np.ones(shape))


@pytest.mark.usefixtures("unchecked")
def test_a_centre_that_is_no_place_is_refused(noisy):
    for centre in (np.array([np.nan, 3.0]), None, np.ma.masked_array([1.0, 2.0], [0, 1])):
        with pytest.raises(ValueError, match="Argument centre"):
            noisy.about(centre)


@pytest.mark.parametrize("size", [1e-60, 1e60])
def test_weights_beyond_single_precision_count_beside_others_of_their_frame(size):
    """They became 0, and with them their frame counted nothing; or were refused as infinite."""
    row = ROW.astype(np.float32)
    lines = make(points=(row, row + 1, row + 2), frame=(0, 0, 1), image_size=(8, 6))
    weights = lines.weighted([size, size / 4, 1.0]).weight
    assert weights.dtype == np.float32
    np.testing.assert_allclose(weights, [1, 0.25, 1], rtol=1e-6)
    np.testing.assert_array_equal(lines.weighted([3.0, 0.5, 0.0]).weight, [3, 0.5, 0])
    with pytest.raises(ValueError, match="finite numbers of at least 0"):
        lines.weighted([size, np.inf, 1.0])
    with pytest.raises(ValueError, match="finite numbers of at least 0"):
        lines.weighted([size, -size, 1.0])
