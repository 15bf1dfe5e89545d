"""Line primitives as CSV: what is read back, and what is refused with which words."""

import dataclasses

import numpy as np
import pytest

import zoomjax as zj
from zoomjax.lines.csv import read_focal_csv, read_lines_csv, write_lines_csv

SIZE = (640, 480)


def lines_of(dtype):
    rng = np.random.default_rng(3)
    points = [rng.uniform(0, 480, (n, 2)).astype(dtype) for n in (3, 7, 4)]
    return zj.Lines.from_ragged(points, [1, 0, 1], np.array([24.5, 1 / 0.03]), image_size=SIZE)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_what_is_written_is_read_back_to_the_last_digit(dtype, tmp_path):
    lines = lines_of(dtype)
    write_lines_csv(lines, tmp_path / "lines.csv")
    read = read_lines_csv(tmp_path / "lines.csv", image_size=SIZE)
    np.testing.assert_array_equal(np.asarray(read.focal, dtype), lines.focal)
    order = np.argsort(np.asarray(lines.frame), kind="stable")
    for got, index in zip(read.to_ragged(), order, strict=True):
        np.testing.assert_array_equal(got.astype(dtype), lines.to_ragged()[index])


def write(path, text):
    path.write_text(text)
    return path


def test_columns_in_any_order_rows_interleaved_frames_numbered_freely(tmp_path):
    text = (
        "x, y, note, line, frame\n1,1,a,5,30\n9,9,a,5,10\n2,2,b,5,30\n8,8,b,5,10\n3,4,c,5,30\n7,6,c,5,10\n"
    )
    path = write(tmp_path / "lines.csv", text)
    focal = read_focal_csv(write(tmp_path / "focal.csv", "frame,focal\n30,50\n10,24\n20,1\n"))
    lines = read_lines_csv(path, image_size=SIZE, focal=focal)
    np.testing.assert_array_equal(lines.focal, [24, 50])
    np.testing.assert_array_equal(lines.to_ragged()[0], [[9, 9], [8, 8], [7, 6]])
    np.testing.assert_array_equal(lines.to_ragged()[1], [[1, 1], [2, 2], [3, 4]])


def bent(y, first=0, last=600):
    x = np.arange(first, last, 10.0)
    return np.stack([x, y + 5e-5 * (x - 320) ** 2], axis=1)  # by 5 px


@pytest.mark.parametrize(
    ("parts", "two"),
    [
        ([(4, bent(50)), (5, bent(200)), (4, bent(100))], True),
        ([(4, bent(50)), (5, bent(200)), (4, bent(50)[:, ::-1] * 0.7)], True),
        ([(4, bent(50, 0, 300)), (5, bent(200)), (4, bent(50, 300))], False),
        ([(4, bent(50, 0, 100)), (5, bent(200)), (4, bent(50, 500))], False),
        (
            [(4 + i % 2, [p]) for pair in zip(bent(50), bent(90), strict=True) for i, p in enumerate(pair)],
            False,
        ),
        ([(4, bent(50, 0, 100)), (4, bent(50, 400))], False),  # a part is hidden
        ([(4, bent(50)), (4, bent(60)[::-1])], False),  # nothing tells that another one begins
    ],
)
def test_a_number_of_two_lines_is_told(parts, two, tmp_path, recwarn):
    """They were one line without a word."""
    rows = [f"7,{number},{x:.2f},{y:.2f}" for number, points in parts for x, y in points]
    path = write(tmp_path / "lines.csv", "\n".join(["frame,line,x,y", *rows]))
    read_lines_csv(path, image_size=SIZE, focal=35.0)
    told = "line 4 of frame 7, in parts from the rows 2 and 122 on, do not lie on one line. If"
    assert [told in str(one.message) for one in recwarn] == [True] * two


def test_a_number_of_two_lines_without_others_between_is_told(tmp_path):
    """The second one begins far from where the first one ends."""
    rows = [f"7,4,{x},{y}" for place in (50, 100) for x, y in bent(place)]
    path = write(tmp_path / "lines.csv", "\n".join(["frame,line,x,y", *rows]))
    with pytest.warns(
        UserWarning, match="line 4 of frame 7, in parts from the rows 2 and 62 on, do not lie"
    ):
        read_lines_csv(path, image_size=SIZE, focal=35.0)


def test_focal_lengths_as_a_sequence_count_frames_from_zero(tmp_path):
    rows = [f"{m},0,{i},{i * i}" for m in (0, 1) for i in range(4)]
    path = write(tmp_path / "lines.csv", "\n".join(["frame,line,x,y", *rows]))
    lines = read_lines_csv(path, image_size=SIZE, focal=[24.0, 50.0])
    np.testing.assert_array_equal(lines.focal, [24, 50])


def test_one_focal_length_is_that_of_all_frames(tmp_path):
    rows = [f"{m},0,{i},{i * i}" for m in (3, 9) for i in range(4)]
    path = write(tmp_path / "lines.csv", "\n".join(["frame,line,x,y", *rows]))
    for focal in (35, 35.0):
        lines = read_lines_csv(path, image_size=SIZE, focal=focal)
        assert np.asarray(lines.focal).tolist() == [35.0, 35.0]


REFUSED = {
    "empty": ("", "frame,line,x,y"),
    "column missing": (
        "frame,line,x\n0,0,1\n",
        r'must name the columns "frame,line,x,y", .* but it is .frame,line,x.',
    ),
    "no rows": ("frame,line,x,y,focal\n", "no rows"),
    "not a number": ("frame,line,x,y,focal\n0,0,1,2,20\n0,0,1,two,20\n", "y in row 3 is 'two'"),
    "short row": ("frame,line,x,y,focal\n0,0,1\n", "row 2 has 3 fields, and the first line has 5 columns"),
    "other separators": ("frame line x y focal\n0 0 1 1 20\n", "separated by commas, semicolons or tabs"),
    "decimal commas": (
        "frame,line,x,y,focal\n0,0,1,1,20,5\n",
        "row 2 has 6 .* decimal commas, write decimal",
    ),
    "negative focal": (
        "frame,line,x,y,focal\n0,0,1,1,20\n\n0,0,1,1,-2\n",
        "focal in row 4 must be positive",
    ),
    "frame not an integer": (
        "frame,line,x,y,focal\n0.5,0,1,1,20\n",
        "frame in row 2 must be an integer, but it is 0.5",
    ),
    "frame a time stamp": (
        "frame,line,x,y,focal\n1762000000000000001,0,1,1,20\n",
        r"frame in row 2 must be below 2\^53 \(number from 0",
    ),
    "focal changes": ("frame,line,x,y,focal\n0,0,1,1,20\n0,0,1,2,30\n", "two focal lengths"),
    "no focal": ("frame,line,x,y\n0,0,1,1\n", "no focal lengths"),
    "not finite": (
        "frame,line,x,y,focal\n0,0,1,nan,20\n0,0,2,2,20\n0,0,3,3,20\n",
        "y in row 2 is 'nan', which is no number",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_read_is_refused(case, tmp_path):
    text, reason = REFUSED[case]
    with pytest.raises(ValueError, match=reason):
        read_lines_csv(write(tmp_path / "lines.csv", text), image_size=SIZE)


def test_frames_without_focal_length_are_named(tmp_path):
    path = write(tmp_path / "lines.csv", "frame,line,x,y\n0,0,1,1\n7,0,2,2\n")
    with pytest.raises(ValueError, match=r"no focal length for 1 of its 2 frames .*7"):
        read_lines_csv(path, image_size=SIZE, focal={0: 20.0})


def test_more_focal_lengths_than_frames_are_refused(tmp_path):
    """Of frames 1 and 2, whose focal lengths may be meant."""
    path = write(tmp_path / "lines.csv", "frame,line,x,y\n1,0,1,1\n2,0,2,2\n")
    with pytest.raises(ValueError, match="its last frame is 2, and there are 4 focal lengths"):
        read_lines_csv(path, image_size=SIZE, focal=[20.0, 30.0, 40.0, 50.0])


def test_a_frame_given_twice_is_refused(tmp_path):
    with pytest.raises(ValueError, match="frame 1 comes twice, the second time in row 3"):
        read_focal_csv(write(tmp_path / "focal.csv", "frame,focal\n1,50\n1,24\n"))


def test_focal_lengths_in_the_file_and_beside_it_are_refused(tmp_path):
    rows = "".join(f"0,0,{i},{i * i},24\n" for i in range(4))
    path = write(tmp_path / "lines.csv", "frame,line,x,y,focal\n" + rows)
    with pytest.raises(
        ValueError, match=r"lines\.csv: it has a column focal, but .* Leave one of them out"
    ):
        read_lines_csv(path, image_size=SIZE, focal={0: 50.0})
    assert read_lines_csv(path, image_size=SIZE).focal.tolist() == [24]


@pytest.mark.parametrize(
    ("changed", "what"),
    [
        (lambda lines: lines.weighted(np.ones(len(lines.frame))), "weights"),
        (lambda lines: dataclasses.replace(lines, centre=np.array([5.0, 5.0])), "another centre"),
        (lambda lines: dataclasses.replace(lines, focus=np.zeros(len(lines.focal))), "a focus"),
    ],
)
def test_what_has_no_column_is_refused(changed, what, tmp_path):
    with pytest.raises(ValueError, match=rf"has {what}.*save the lines as \.npz"):
        write_lines_csv(changed(lines_of(np.float64)), tmp_path / "lines.csv")
    assert not (tmp_path / "lines.csv").exists()


class Column:
    """What of a column of pandas is needed: values, and labels of their own."""

    def __init__(self, values, index):
        self.values, self.index = values, index

    def __array__(self, dtype=None, copy=None):
        return np.asarray(self.values, dtype)

    def to_dict(self):
        return dict(zip(self.index, self.values, strict=True))


def test_focal_lengths_of_a_column_go_by_its_index(tmp_path, unchecked):
    """They went by their order, whatever frames the index named."""
    rows = "".join(f"{frame},0,{x},{x * x}\n" for frame in (0, 1, 2) for x in (1, 2, 3))
    path = write(tmp_path / "lines.csv", "frame,line,x,y\n" + rows)
    lines = read_lines_csv(path, image_size=SIZE, focal=Column([70.0, 24.0, 35.0], [2, 0, 1]))
    assert lines.focal.tolist() == [24, 35, 70]
    with pytest.raises(ValueError, match="no focal length for 1 of its 3 frames"):
        read_lines_csv(path, image_size=SIZE, focal=Column([70.0, 24.0, 35.0], [2, 0, 5]))
