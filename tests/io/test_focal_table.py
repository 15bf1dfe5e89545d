"""CSV files with the focal lengths of images."""

import numpy as np
import pytest

import zoomjax as zj
from zoomjax.io.focal_table import read_focal_table


def table(tmp_path, text):
    (tmp_path / "focal.csv").write_text(text)
    return read_focal_table(tmp_path / "focal.csv")


def test_images_have_their_focal_lengths(tmp_path):
    read = table(tmp_path, "image,focal\na.jpg,24\nb.jpg, 70.5\n")
    assert read.of(["a.jpg", "shots/b.jpg", "c.jpg"]) == {"a.jpg": 24, "shots/b.jpg": 70.5}


def test_other_columns_and_orders_do_not_matter(tmp_path):
    read = table(tmp_path, "focal,note,image\n24,wide,a.jpg\n\n70,long,b.jpg\n")
    assert (read.need("a.jpg"), read.need("b.jpg")) == (24, 70)


def test_folders_tell_images_of_one_name_apart(tmp_path):
    read = table(tmp_path, "image,focal\n1x/board.png,24\n3x\\board.png,70\nother.png,35\n")
    assert (read.need("1x/board.png"), read.need("/data/3x/board.png")) == (24, 70)
    assert read.of(["board.png"]) == {}
    assert read.need("9x/other.png") == 35


@pytest.mark.parametrize("name", ["/c.jpg", "//c.jpg", "/a/./c.jpg", "../c.jpg"])
def test_an_absolute_name_is_that_image_alone(tmp_path, name):
    (tmp_path / "focal.csv").write_text(f"image,focal\n{name},35\n")
    table = read_focal_table(tmp_path / "focal.csv")
    assert table.need(name) == 35
    assert table.row(table.row(name)) == table.row(name)
    assert table.row("c.jpg") is None
    assert table.row("/elsewhere/c.jpg") is None


def test_one_row_for_two_images_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"one row a\.png for two images, 1x/a\.png and 3x/a\.png"):
        table(tmp_path, "image,focal\na.png,24\n").of(["1x/a.png", "3x/a.png"])


def test_a_needed_image_that_is_absent_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"focal.csv: it has no focal length for c\.jpg"):
        table(tmp_path, "image,focal\na.jpg,24\n").need("c.jpg")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r'must name the columns "image,focal"'),
        ("file,focal\na.jpg,24\n", r'columns "image,focal", .* but it is .file,focal.'),
        ("image,focal\na.jpg\n", "row 2 has 1 fields, and the first line has 2"),
        ("image,focal\na.jpg,24\nb.jpg,wide\n", "focal in row 3 is .wide., which is no number"),
        ("image,focal\na.jpg,-24\n", "positive number"),
        ("image,focal\na.jpg,nan\n", "focal in row 2 is .nan., which is no number"),
        ("image,focal\n,24\n", "row 2 must name an image"),
        ("image,focal\na.jpg,20,5\n", "row 2 has 3 fields, .* decimal commas"),
        (
            "image,focal,sigma\na.jpg,24,1\na.jpg,24,2\n",
            r"is listed twice, with 24 ± 1 and, in row 3, 24 ± 2",
        ),
        ("image,focal\na.jpg,24\n./a.jpg,25\n", r"a\.jpg is listed twice"),
        ("image,focal\na.jpg,24\na.jpg,25\n", r"a\.jpg is listed twice, with 24 and, in row 3, 25"),
    ],
)
def test_other_files_are_refused(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        table(tmp_path, text)


def test_what_is_no_text_is_refused(tmp_path):
    (tmp_path / "focal.csv").write_bytes(b"\xff\xfe\x00\x01\x80")
    with pytest.raises(ValueError, match="not text"):
        read_focal_table(tmp_path / "focal.csv")


def test_an_absent_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing\.csv"):
        read_focal_table(tmp_path / "nothing.csv")


def test_deviations_may_be_told(tmp_path):
    read = table(tmp_path, "image,focal,sigma\na.jpg,24,0.3\nb.jpg,70,\nc.jpg,90,0\n")
    assert [read.sigma(image) for image in ("shots/a.jpg", "b.jpg", "c.jpg", "d.jpg")] == [
        0.3,
        None,
        0,
        None,
    ]
    for sigma, reason in (
        ("-1", "must be a number of at least 0"),
        ("wide", "is .wide., which is no number"),
        ("nan", "is .nan., which is no number"),
    ):
        with pytest.raises(ValueError, match=rf"focal\.csv: sigma in row 2 {reason}"):
            table(tmp_path, f"image,focal,sigma\na.jpg,24,{sigma}\n")


def test_of_two_rows_that_fit_the_one_with_more_folders_counts(tmp_path):
    read = table(tmp_path, "image,focal\na.png,24\n3x/a.png,70\n")
    assert (read.need("/data/3x/a.png"), read.need("/data/1x/a.png")) == (70, 24)


def test_a_name_in_quotes_may_begin_with_a_hash_or_hold_separators(tmp_path):
    read = table(tmp_path, 'image,focal\n"#1.jpg",24\n#1.jpg,25\n"a, b.jpg",70\n')
    assert (read.need("#1.jpg"), read.need("a, b.jpg")) == (24, 70)


@pytest.mark.parametrize("focal", [-24.0, 0.0, np.nan, np.inf])
def test_a_table_made_by_hand_holds_focal_lengths(focal):
    with pytest.raises(ValueError, match=r"Argument focals\['a.png'\] must be a finite number above 0"):
        zj.io.FocalTable({"a.png": focal})


@pytest.mark.parametrize("sigma", [-0.3, np.nan])
def test_a_table_made_by_hand_holds_standard_deviations(sigma):
    with pytest.raises(ValueError, match=r"Argument sigmas\['a.png'\] must be a number of at least 0"):
        zj.io.FocalTable({"a.png": 24.0}, sigmas={"a.png": sigma})
