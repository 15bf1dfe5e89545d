"""``zoomjax undistort --lens`` and ``zoomjax lens``: photos with EXIF data, corrected by the library."""

import shlex
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

import zoomjax as zj
from zoomjax.app.commands_lens import app
from zoomjax.app.library_lens import rows, undistort_by_library, write_lens
from zoomjax.app.results_folder import results_folder
from zoomjax.app.undistort_files import Job
from zoomjax.interop.database import one_named
from zoomjax.io import read_photo

from .._commands import one_after_another
from ..io.test_equipment import block

SIZE = (300, 200)
NIKKOR = "Nikon AF-S DX VR Zoom-Nikkor 18-200mm f/3.5-5.6G IF-ED"
D300 = {"Make": "NIKON CORPORATION", "Model": "NIKON D300"}


def photo(path, body=D300, lens=NIKKOR, focal=18):
    axes = np.arange(SIZE[1])[:, None], np.arange(SIZE[0])[None]
    image = np.stack([127 + 100 * np.sin(axes[0] / 9) * np.cos(axes[1] / 9)] * 3, -1).astype(np.uint8)
    named = {"LensModel": lens} if lens else {}
    Image.fromarray(image).save(path, exif=block(of=body, FocalLength=IFDRational(focal, 1), **named))
    return path


def job(folder, *photos, output="out", **more):
    return Job(folder, photos, folder / output, **more)


def test_photos_of_two_lenses_are_corrected_each_by_its_own(tmp_path):
    canon = {"Make": "Canon", "Model": "Canon EOS 600D"}
    first = photo(tmp_path / "a.png")
    second = photo(tmp_path / "b.png", canon, "EF-S18-55mm f/3.5-5.6 IS II")
    unknown = photo(tmp_path / "c.png", lens="")
    done = undistort_by_library(job(tmp_path, first, second, unknown), "auto")
    assert f"{NIKKOR}, crop factor 1.523, within" in done.sentence
    assert "Canon EF-S 18-55mm f/3.5-5.6 IS II, crop factor 1.613, within" in done.sentence
    assert list(done.skipped) == [str(unknown)]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a.png", "b.png"]
    lens = zj.interop.library_lens(NIKKOR, image_size=SIZE, crop=1.523)
    expected = zj.undistort_image(read_photo(first)[0], lens, focal=18.0)
    np.testing.assert_array_equal(read_photo(tmp_path / "out" / "a.png")[0], expected)
    assert np.abs(expected.astype(float) - read_photo(first)[0]).max() > 20


def test_one_photo_that_several_lenses_fit_is_a_question_that_a_name_answers(tmp_path):
    path = photo(tmp_path / "a.png", lens="18.0-200.0 mm f/3.5-5.6")
    with pytest.raises(ValueError, match=r"2 lenses .*: choose argument lens, .* or .*"):
        undistort_by_library(job(tmp_path, path, output="b.png"), "auto")
    done = undistort_by_library(job(tmp_path, path, output="b.png"), NIKKOR)
    assert done.sentence.startswith(NIKKOR)
    assert (tmp_path / "b.png").exists()


def test_photos_of_one_name_keep_their_folders(tmp_path):
    (tmp_path / "more").mkdir()
    both = photo(tmp_path / "a.png"), photo(tmp_path / "more" / "a.png")
    done = undistort_by_library(job(tmp_path, *both), "auto")
    assert done.written == 2
    assert {
        path.relative_to(tmp_path / "out").as_posix() for path in (tmp_path / "out").rglob("*.png")
    } == {
        "a.png",
        "more/a.png",
    }


def test_a_lens_of_ones_own_is_not_taken_for_a_video(tmp_path):
    first = photo(tmp_path / "a.png")
    (tmp_path / "lens.json").write_text("{}")
    done = undistort_by_library(job(tmp_path, tmp_path / "lens.json", first), NIKKOR)
    assert done.written == 1
    assert "without argument lens" in done.skipped[str(tmp_path / "lens.json")]


def test_photos_of_two_lenses_do_not_share_a_row_of_focal_lengths(tmp_path):
    canon = {"Make": "Canon", "Model": "Canon EOS 600D"}
    (tmp_path / "more").mkdir()
    first = photo(tmp_path / "a.png")
    second = photo(tmp_path / "more" / "a.png", canon, "EF-S18-55mm f/3.5-5.6 IS II")
    (tmp_path / "focal.csv").write_text("image,focal\na.png,24\n")
    with pytest.raises(ValueError, match=r"one row a\.png for two images"):
        undistort_by_library(job(tmp_path, first, second, focal=str(tmp_path / "focal.csv")), "auto")
    assert not (tmp_path / "out").exists()
    (tmp_path / "focal.csv").write_text("image,focal\na.png,24\nmore/a.png,30\n")
    done = undistort_by_library(job(tmp_path, first, second, focal=str(tmp_path / "focal.csv")), "auto")
    assert done.written == 2


def test_targets_that_exist_are_refused_before_any_work(tmp_path):
    both = photo(tmp_path / "a.png"), photo(tmp_path / "b.png")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "b.png").write_text("the user's own")
    with pytest.raises(FileExistsError):
        undistort_by_library(job(tmp_path, *both), "auto")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["b.png"]


def test_a_search_shows_what_lenses_become_and_writes_the_one(tmp_path):
    found, more = rows("nikkor 18-200", SIZE)
    assert [row.name for row in found] == [NIKKOR, f"{NIKKOR} II"]
    assert more < 0
    assert all(float(row.error) < 1 for row in found)
    write_lens(NIKKOR, tmp_path / "lens", size=SIZE, crop=None, overwrite=False)
    assert zj.load_lens(tmp_path / "lens" / "lens.json").about["lens"] == NIKKOR
    with pytest.raises(FileExistsError, match="would be replaced"):
        write_lens(NIKKOR, tmp_path / "lens", size=SIZE, crop=None, overwrite=False)


def test_what_an_earlier_run_wrote_about_another_lens_is_removed(tmp_path):
    with results_folder(tmp_path) as made:
        for name in ("lens.json", "report.html", "summary.json", "lines.npz"):
            (made / name).write_text("of another lens")
    (tmp_path / "model.png").write_text("the user's own")
    write_lens(NIKKOR, tmp_path, size=SIZE, crop=None, overwrite=True)
    kept = {path.name for path in tmp_path.iterdir() if not path.name.startswith(".")}
    assert kept == {"lens.json", "lines.npz", "model.png"}
    assert zj.load_lens(tmp_path / "lens.json").about["lens"] == NIKKOR


@pytest.mark.slow
def test_the_commands_list_write_and_say_what_to_give(tmp_path):
    jobs = [
        ["lens", "nikkor 18-200"],
        ["lens", NIKKOR, "-o", "lens.json", "--image-size", "300x200"],
        ["lens", "nikkor 18-200", "-o", "other.json"],
        ["undistort", "a.jpg", "-o", "out"],
        ["lens", NIKKOR, "-o", "new/../mine.json"],
        ["undistort", "--lens", "auto", "nikon.png", "canon.png", "-o", "corrected"],
    ]
    photo(tmp_path / "nikon.png")
    photo(
        tmp_path / "canon.png", {"Make": "Canon", "Model": "Canon EOS 600D"}, "EF-S18-55mm f/3.5-5.6 IS II"
    )
    (tmp_path / "mine.json").write_text("mine")
    (listed, table), (made, said), (asked, question), (refused, hint), (kept, exists), (both, each) = (
        one_after_another(tmp_path, jobs)
    )
    assert both == 0
    assert [line.split(",")[0] for line in each.splitlines() if "its table" in line] == [
        NIKKOR,
        "Canon EF-S 18-55mm f/3.5-5.6 IS II",
    ]
    assert (listed, made, asked, refused, kept) == (0, 0, 2, 2, 2)
    assert "mine.json already exists" in exists
    assert (tmp_path / "mine.json").read_text() == "mine"
    assert not (tmp_path / "new").exists()
    assert table.count("AF-S") == 2
    assert said.startswith(NIKKOR)
    assert zj.load_lens(tmp_path / "lens.json").image_size == SIZE
    assert question.startswith("Error: 2 lenses fit 'nikkor 18-200': choose ")
    assert "--lens auto" in hint


@pytest.mark.parametrize("there", [True, False])
def test_a_lens_of_ones_own_is_no_lens_of_the_library(there, tmp_path):
    """Said before the library is looked for, which may not be installed."""
    if there:
        (tmp_path / "lens.json").write_text("{}")
    job = Job(None, (tmp_path / "photo.jpg",), tmp_path / "out")
    with pytest.raises(ValueError, match="names a file or folder: give it first"):
        undistort_by_library(job, str(tmp_path / "lens.json"))


def test_without_lensfunpy_the_command_says_what_to_install():
    blocked = "import sys; sys.modules['lensfunpy'] = None; from zoomjax.app.cli import main; main()"
    done = subprocess.run([sys.executable, "-c", blocked, "lens", "nikkor"], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == (
        'Error: The library of lenses needs the extra "lensfun": pip install "zoomjax[lensfun]"\n'
    )


def test_the_example_of_the_help_finds_one_lens():
    [command] = [c for c in app.registered_commands if c.callback and c.callback.__name__ == "lens"]
    example = shlex.split(command.epilog.split("`")[1])
    assert example[:2] == ["zoomjax", "lens"]
    assert one_named(example[2])[0].name == f"{NIKKOR} II"


@pytest.mark.parametrize("resume", [False, True])
def test_no_input_of_another_lens_is_replaced(resume, tmp_path):
    """Each size is a group of its own: the target of one was the input of another."""
    (tmp_path / "in").mkdir()
    (tmp_path / "out" / "in").mkdir(parents=True)
    first = photo(tmp_path / "in" / "x.png")
    second = tmp_path / "out" / "in" / "x.png"
    Image.fromarray(np.zeros((300, 200, 3), np.uint8)).save(
        second, exif=block(of=D300, FocalLength=IFDRational(18, 1), LensModel=NIKKOR)
    )
    before = second.read_bytes()
    with pytest.raises(ValueError, match="is the input"):
        undistort_by_library(job(tmp_path, first, second, overwrite=True, resume=resume), NIKKOR)
    assert second.read_bytes() == before
