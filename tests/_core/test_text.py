"""Names that somebody else chose, and messages of errors."""

import unicodedata

import cv2
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zoomjax._core.text import listed, numbered_name, percentages, plain, reason, span, with_std

names = st.text(max_size=300) | st.text(
    st.sampled_from("./\\:*?<>|\"' -=~a\x1b\n\udcff\u202e"), max_size=300
)


@given(names)
def test_plain_text_gives_no_orders(text):
    shown = plain(text)
    assert not {unicodedata.category(c) for c in shown} & {"Cc", "Cs", "Zl", "Zp"}
    assert not set(shown) & set("\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069\ufeff")
    shown.encode()
    assert plain(shown) == shown
    if text.isprintable() and text.isascii():
        assert shown == text


def test_orders_are_shown():
    assert plain("a\x1b[31m\n\x9b\u202eé\udcff") == r"a\x1b[31m\n\x9b\u202eé\udcff"


@given(st.integers(1, 10**6), names)
def test_made_names_are_files_names_everywhere(number, name):
    made = numbered_name(number, name, ".jpg")
    assert made.startswith(f"{number:04d}-")
    assert made.endswith(".jpg")
    assert len(made.encode()) <= 100
    assert not set(made) & set("/\\:*?<>|\"'= ~\0")
    assert all(unicodedata.category(c)[0] in "LMN" or c in "._+-" for c in made)


@pytest.mark.parametrize(
    ("name", "made"),
    [
        ("board-050mm.jpg", "0003-board-050mm.jpg"),
        ("../../board.jpg", "0003-board.jpg"),
        ("/etc/passwd", "0003-passwd.jpg"),
        ("C:\\photos\\CON.png", "0003-CON.jpg"),
        ("C:x.png", "0003-C_x.jpg"),
        ("..", "0003-image.jpg"),
        (".jpg", "0003-jpg.jpg"),
        ("", "0003-image.jpg"),
        ("Stadion Süd (2).JPG", "0003-Stadion_Süd_2.jpg"),
        ("गेंद.png", "0003-गेंद.jpg"),
        ("=cmd().jpg", "0003-cmd.jpg"),
        ("a" * 300 + "-end.jpg", "0003-" + "a" * 76 + "-end.jpg"),
    ],
)
def test_made_names_can_be_read(name, made):
    assert numbered_name(3, name, ".jpg") == made


def test_percentages_of_one_value_are_that_value():
    assert percentages([0.0043, 0.00431]) == "0.43%"
    assert percentages([0.02, 0.0043, 0.0117]) == "0.43% to 2.00%"


def test_a_span_of_one_value_is_that_value():
    assert span(20.56, 127.36, "mm") == "20.56 to 127.36 mm"
    assert span(28.0, 28.0, "mm") == "28 mm"
    assert span(1000.01, 1000.02, "px") == "1000 px"


@pytest.mark.parametrize(
    ("value", "std", "shown"),
    [
        (4191.46, 307.1, "+4191 \u00b1 307 px"),
        (-24.36, 20.39, "-24 \u00b1 20 px"),
        (103.381, 0.1234, "+103.38 \u00b1 0.12 px"),
        (0.5, 0.0, "+0.50 \u00b1 0.00 px"),
        (1.0, 1e-12, "+1.000000 \u00b1 0.000000 px"),
        (9.87, float("inf"), "+9.87 px (uncertainty unknown)"),
        (9.87, float("nan"), "+9.87 px (uncertainty unknown)"),
    ],
)
def test_values_are_shown_as_far_as_they_are_known(value, std, shown):
    assert with_std(value, std, "px") == shown


def test_lists_end_by_how_much_is_left_out():
    assert listed("abc", 3) == "a, b, c"
    assert listed(iter("abcde"), 3, "; ") == "a; b; c and 2 more"
    assert listed([], 2) == ""


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (FileNotFoundError(2, "No such file or directory", "a.png"), "No such file or directory"),
        (MemoryError("Unable to allocate"), "there is not enough memory for it"),
        (ValueError("It is\n  two lines."), "It is two lines."),
        (OSError("without a number"), "without a number"),
    ],
)
def test_the_reason_of_an_error_is_one_line(error, told):
    assert reason(error) == told


def test_opencv_without_memory_is_an_error_of_memory():
    error = cv2.error("Failed to allocate")
    error.code = cv2.Error.StsNoMem
    assert reason(error) == reason(MemoryError())
