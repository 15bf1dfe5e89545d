"""What ``zoomjax undistort`` makes of folders, patterns, links, marks and files of all kinds."""

import dataclasses
import re

import cv2
import equinox as eqx
import numpy as np
import pytest
from PIL import Image

import zoomjax as zj
from zoomjax.app.undistort_files import Job, undistort_files
from zoomjax.detect.sources import find_photos
from zoomjax.io.metadata import geometry_of
from zoomjax.io.photo import read_metadata, read_photo
from zoomjax.io.photo_writer import encoded_photo

from .._clips import FRAMES, SIZE, focal, lens, luma, picture, write_clip
from .._exif import exif
from ..correct import test_photo
from ..correct.test_video_streams import clip


@pytest.fixture
def folder(tmp_path):
    """A lens and a folder of photos in folders, with what else lies there."""
    lens().save(tmp_path / "lens.json")
    for name in ("in/a.jpg", "in/day/a.jpg", "in/day/b.png"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        test_photo.write(path, cv2.cvtColor(picture(0), cv2.COLOR_GRAY2BGR), exif((40, 1), orientation=1))
    (tmp_path / "in/notes.txt").write_text("straight")
    (tmp_path / "in/.hidden.jpg").write_bytes(b"not a photo")
    return tmp_path


def job(folder, *inputs, out="out", **settings):
    return Job(folder / "lens.json", tuple(folder / path for path in inputs), folder / out, **settings)


def files(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def test_a_folder_keeps_its_structure(folder):
    done = undistort_files(job(folder, "in"))
    assert done.sentence == f"3 photos corrected: {folder / 'out'}"
    assert files(folder / "out") == ["a.jpg", "day/a.jpg", "day/b.png"]
    before, after = (cv2.imread(str(folder / where / "day/b.png")) for where in ("in", "out"))
    np.testing.assert_array_equal(after, zj.undistort_image(before, lens()(40.0)))


def test_videos_beside_photos_are_said(folder):
    assert undistort_files(job(folder, "in", out="before")).notes == ()
    write_clip(folder / "in/zoom.mp4")
    done = undistort_files(job(folder, "in"))
    assert done.sentence == f"3 photos corrected: {folder / 'out'}"
    assert done.notes == (
        f"In the folder {folder / 'in'}, one file is left out: zoom.mp4. Give videos by name.",
    )
    (folder / "link").symlink_to("in")
    twice = undistort_files(job(folder, "in", "in", "link", out="twice")).notes
    assert [note.split(",")[0] for note in twice] == [
        f"{folder / 'in/a.jpg'} is given twice",
        f"In the folder {folder / 'in'}",
    ]


def test_what_is_not_there_is_said_so(folder):
    """And not taken for a video, which needs focal lengths."""
    for name in ("shoot", "shoot/day.v2"):
        with pytest.raises(FileNotFoundError, match=r"There is no file or folder .*shoot"):
            undistort_files(job(folder, "in", name))


@pytest.mark.parametrize("out", ["lens.json", "in/notes.txt", "in/a.jpg"])
@pytest.mark.parametrize("inputs", [["in/day/a.jpg"], ["in"]])
def test_an_output_that_is_another_file_is_refused_and_kept(inputs, out, folder):
    before = (folder / out).read_bytes()
    if (inputs, out) != (["in/day/a.jpg"], "in/a.jpg"):  # which would be replaced, as is asked for
        with pytest.raises(ValueError, match="must be a folder"):
            undistort_files(job(folder, *inputs, out=out, overwrite=True))
    assert (folder / out).read_bytes() == before


def test_a_pattern_keeps_the_structure_below_its_fixed_part(folder):
    undistort_files(job(folder, "in/**/*.jpg"))
    assert files(folder / "out") == ["a.jpg", "day/a.jpg"]


def test_files_of_one_name_keep_folders_that_tell_them_apart(folder):
    undistort_files(job(folder, "in/a.jpg", "in/day/a.jpg"))
    assert files(folder / "out") == ["a.jpg", "day/a.jpg"]


def test_results_in_the_folder_itself_are_no_inputs(folder):
    for _ in range(2):
        undistort_files(job(folder, "in", out="in/out", overwrite=True))
    assert files(folder / "in/out") == ["a.jpg", "day/a.jpg", "day/b.png"]


@pytest.mark.parametrize("out", ["in", "in/.", "."])
def test_a_folder_that_is_the_output_is_refused_by_name(out, folder):
    before = files(folder)
    with pytest.raises(ValueError, match=r"in are in the output folder .*: give another folder"):
        undistort_files(job(folder, "in", out=out))
    assert files(folder) == before


def test_a_new_suffix_does_not_make_two_results_one(folder):
    """The photo of a phone, which becomes a PNG file, beside a picture of that name."""
    heif = pytest.importorskip("pillow_heif")
    grey = Image.fromarray(cv2.cvtColor(picture(0), cv2.COLOR_GRAY2RGB))
    heif.from_pillow(grey).save(folder / "in/day/b.heic", exif=exif((40, 1)), quality=95)
    heif.from_pillow(grey).save(folder / "in/day/c.heic", exif=exif((40, 1)), quality=95)
    done = undistort_files(job(folder, "in"))
    assert not done.skipped
    assert files(folder / "out") == ["a.jpg", "day/a.jpg", "day/b.heic.png", "day/b.png", "day/c.png"]


def test_links_to_one_photo_are_corrected_once(folder):
    (folder / "in/z.jpg").symlink_to("a.jpg")
    done = undistort_files(job(folder, "in"))
    assert files(folder / "out") == ["a.jpg", "day/a.jpg", "day/b.png"]
    assert any("z.jpg is the same file as" in note for note in done.notes)


def test_corrected_photos_are_refused_and_corrected_again_if_that_is_said(folder):
    undistort_files(job(folder, "in"))
    (folder / "out/new.jpg").write_bytes((folder / "in/a.jpg").read_bytes())
    done = undistort_files(job(folder, "out", out="twice"))
    assert done.sentence.startswith("1 of 4 photos corrected")
    assert len(done.skipped) == 3
    assert all("is undistorted by zoomjax already" in why for why in done.skipped.values())
    assert files(folder / "twice") == ["new.jpg"]
    assert undistort_files(job(folder, "out", out="thrice", again=True)).written == 4


def test_a_run_is_resumed(folder):
    undistort_files(job(folder, "in/day"))
    undistort_files(job(folder, "in/a.jpg", out="out/extra.jpg"))
    times = {path: path.stat().st_mtime_ns for path in (folder / "out").glob("*.*")}
    (folder / "in/day/c.jpg").write_bytes((folder / "in/a.jpg").read_bytes())
    done = undistort_files(job(folder, "in/day", resume=True))
    assert done.sentence == f"1 of 3 photos corrected now, 2 earlier: {folder / 'out'}"
    assert done.written == 3
    assert times == {path: path.stat().st_mtime_ns for path in times}
    (folder / "out/b.png").write_bytes((folder / "in/day/b.png").read_bytes())  # of somebody else
    with pytest.raises(FileExistsError, match=r"b\.png already exists"):
        undistort_files(job(folder, "in/day", resume=True))


def _other_lens(folder):
    other = lens()
    eqx.tree_at(lambda of: of.zoom.parameters, other, 0.9 * other.zoom.parameters).save(
        folder / "lens.json"
    )
    return {}


def _other_photo(folder):
    image = cv2.cvtColor(picture(5), cv2.COLOR_GRAY2BGR)
    test_photo.write(folder / "in/day/b.png", image, exif((40, 1), orientation=1))
    return {}


def _photo_of_an_old_version(folder):
    image, metadata = read_photo(folder / "out/b.png")
    old = dataclasses.replace(metadata, xmp=re.sub(rb' zoomjax:Work="[^"]*"', b"", metadata.xmp))
    assert old != metadata
    (folder / "out/b.png").write_bytes(encoded_photo([(image, old)], ".png")[0])
    return {}


OTHER_WORK = {
    "lens": _other_lens,
    "focal length": lambda folder: {"focal": "41"},
    "photo": _other_photo,
    "old version": _photo_of_an_old_version,
    "interpolation": lambda folder: {"interpolation": "cubic"},
    "border": lambda folder: {"border": "reflect"},
    "keep": lambda folder: {"keep": "valid"},
}


@pytest.mark.parametrize("other", OTHER_WORK)
def test_a_resumed_run_leaves_results_of_the_same_work_alone(other, folder):
    """Or a folder would be half of one lens, half of another, without a word."""
    undistort_files(job(folder, "in/day"))
    before = {name: (folder / "out" / name).read_bytes() for name in ("a.jpg", "b.png")}
    same = undistort_files(job(folder, "in/day", resume=True))
    assert same.sentence.startswith("0 of 2 photos corrected now, 2 earlier")
    settings = OTHER_WORK[other](folder)
    made = {name: (folder / "out" / name).read_bytes() for name in before}
    with pytest.raises(FileExistsError, match=r"was not made from .* with this lens, focal length"):
        undistort_files(job(folder, "in/day", resume=True, **settings))
    assert {name: (folder / "out" / name).read_bytes() for name in before} == made
    done = undistort_files(job(folder, "in/day", resume=True, overwrite=True, **settings))
    assert done.written == 2
    assert (folder / "out/b.png").read_bytes() != made["b.png"]
    undistort_files(job(folder, "in/day", out="whole", **settings))
    for name in before:
        assert (folder / "out" / name).read_bytes() == (folder / "whole" / name).read_bytes()


def test_paths_may_be_texts(folder):
    zj.undistort_photo(str(folder / "in/a.jpg"), str(folder / "a.png"), lens=lens())
    assert geometry_of(read_metadata(folder / "a.png")) == "undistorted"


def test_a_framing_of_other_photos_is_other_work(folder):
    test_photo.write(
        folder / "in/wide.png", cv2.cvtColor(picture(0), cv2.COLOR_GRAY2BGR), exif((20, 1), orientation=1)
    )
    undistort_files(job(folder, "in/day", keep="valid"))
    assert undistort_files(job(folder, "in/day", keep="valid", resume=True)).written == 2
    with pytest.raises(FileExistsError, match="was not made from"):
        undistort_files(job(folder, "in/day/b.png", "in/wide.png", keep="valid", resume=True))


def test_bad_files_of_every_kind_are_named_and_skipped(folder):
    shown = Image.fromarray(picture(0))
    shown.save(folder / "in/b.gif")
    shown.save(folder / "in/b.jp2")
    shown.save(folder / "in/b.pdf")
    shown.convert("CMYK").save(folder / "in/b.jpg", exif=b"Exif\0\0" + exif((40, 1), orientation=1))
    (folder / "in/c.jpg").write_bytes((folder / "in/a.jpg").read_bytes()[:700])
    (folder / "in/d.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(40))
    (folder / "in/e.dng").write_bytes(b"II*\0" + bytes(40))
    bad = ("b.gif", "b.jp2", "b.pdf", "b.jpg", "c.jpg", "d.heic", "e.dng", "none.jpg", "notes.txt")
    done = undistort_files(job(folder, *(f"in/{name}" for name in (*bad, "a.jpg")), focal="30"))
    why = {path.rsplit("/", 1)[1]: reason for path, reason in done.skipped.items()}
    assert files(folder / "out") == ["a.jpg"]
    for name, reason in {
        "b.gif": "a GIF image",
        "b.jp2": "a JPEG 2000 image",
        "b.pdf": "a PDF document",
        "b.jpg": "CMYK",
        "c.jpg": "damaged or cut off",
        "d.heic": "damaged, or of an unknown format",
        "e.dng": "LibRaw does not know",
        "none.jpg": "no photograph",
        "notes.txt": "it is not a photo",
    }.items():
        assert reason in why.pop(name)
    assert not why


def test_what_a_format_does_not_hold_is_said_once(folder):
    block = b"8BIM\x04\x04\0\0\0\0\0\0"
    for number in range(3):
        Image.fromarray(picture(0)).save(folder / f"{number}.tif", tiffinfo={34377: block})
    [first, *_] = undistort_files(job(folder, "*.tif", focal="30")).notes or ("",)
    assert first == ""  # TIFF holds all
    done = undistort_files(job(folder, "0.tif", out="0.png", focal="30"))
    assert done.notes == ("Not kept in 1 .png file: IPTC data.",)


def test_redistorted_photos_are_those_of_the_beginning(folder):
    smooth = cv2.GaussianBlur(cv2.imread(str(folder / "in/day/b.png")), (0, 0), 2)
    cv2.imwrite(str(folder / "s.png"), smooth)
    settings = {"focal": "30", "keep": "grow", "interpolation": "cubic"}
    undistort_files(job(folder, "s.png", out="grown.png", **settings))
    assert cv2.imread(str(folder / "grown.png")).shape > smooth.shape
    done = undistort_files(job(folder, "grown.png", out="back.png", redistort=True, **settings))
    assert done.sentence == f"1 photo redistorted: {folder / 'back.png'}"
    back = cv2.imread(str(folder / "back.png"))
    assert np.abs(back.astype(int) - smooth)[2:-2, 2:-2].max() <= 4
    assert geometry_of(read_metadata(folder / "back.png")) == "distorted"
    with pytest.raises(ValueError, match="with which it was corrected"):
        undistort_files(
            job(folder, "grown.png", out="no.png", redistort=True, **settings | {"focal": "40"})
        )


def test_several_videos_each_with_its_own_track(folder):
    (folder / "tracks").mkdir()
    for name, text in (("a", f"0,20\n{FRAMES - 1},80\n"), ("b", "0,30\n99,30\n")):
        write_clip(folder / f"{name}.mp4", sound=name == "a")
        (folder / f"tracks/{name}.csv").write_text(f"frame,focal\n{text}")
    done = undistort_files(job(folder, "*.mp4", focal=str(folder / "tracks")))
    assert done.sentence == f"2 videos corrected: {folder / 'out'}, {2 * FRAMES} frames"
    assert done.notes == ("Kept of a.mp4: sound (aac).",)
    for name, last in (("a", 80.0), ("b", 30.0)):
        expected = zj.undistort_image(luma(folder / f"{name}.mp4")[0][-1], lens()(last))
        assert np.median(abs(luma(folder / f"out/{name}.mp4")[0][-1].astype(int) - expected)) <= 2
    assert float(focal(FRAMES - 1)) == pytest.approx(80)
    with pytest.raises(ValueError, match=r"a\.csv is for one video, and there are 2.* such as a\.csv"):
        undistort_files(job(folder, "*.mp4", focal=str(folder / "tracks/a.csv"), out="other"))
    again = undistort_files(job(folder, "*.mp4", focal=str(folder / "tracks"), resume=True))
    assert again.sentence.startswith("0 of 2 videos corrected now, 2 earlier")
    assert "a.mp4 and 1 more. Such files hold no mark" in again.notes[-1]
    (folder / "c.mp4").write_bytes(b"no video")
    (folder / "tracks/c.csv").write_text("frame,focal\n0,20\n")
    skipping = dataclasses.replace(job(folder, "b.mp4", "c.mp4", out="new"), focal=str(folder / "tracks"))
    done = undistort_files(skipping)
    assert list(done.skipped) == [str(folder / "c.mp4")]
    assert files(folder / "new") == ["b.mp4"]
    assert luma(folder / "new/b.mp4")[0].shape[:0:-1] == SIZE


def test_of_several_videos_warnings_name_theirs_and_videos_are_counted(folder):
    write_clip(folder / "a.mp4", 3)
    size = (SIZE[0] // 4 * 2, SIZE[1] // 4 * 2)
    ended = clip(folder / "b.mkv", size=size, stamps=range(3))
    clip(folder / "c.flv", stamps=range(3))
    told = []
    with pytest.warns(UserWarning, match=rf"^{re.escape(str(ended))}: The lens is for images of") as caught:
        done = undistort_files(
            job(folder, "a.mp4", "b.mkv", "c.flv", focal="40"), lambda *of: told.append(of)
        )
    assert len(caught) == 1
    assert told == [(0, 3)] * 3 + [(1, 3)] * 3 + [(2, 3)] * 3
    assert not done.skipped
    assert files(folder / "out") == ["a.mp4", "b.mkv", "c.mkv"]


def test_videos_of_one_name_do_not_share_a_track(folder):
    for place in ("one", "two"):
        (folder / "clips" / place).mkdir(parents=True)
        (folder / "tracks" / place).mkdir(parents=True)
        write_clip(folder / "clips" / place / "c.mp4", 2, sound=False)
    (folder / "tracks/c.csv").write_text("frame,focal\n0,20\n1,20\n")
    both = job(folder, "clips", focal=str(folder / "tracks"))
    with pytest.raises(ValueError, match=r"c\.csv is for one video, .*such as .*two/c\.csv"):
        undistort_files(both)
    (folder / "tracks/two/c.csv").write_text("frame,focal\n0,80\n1,80\n")
    undistort_files(both)
    for place, f in (("one", 20.0), ("two", 80.0)):
        expected = zj.undistort_image(luma(folder / "clips" / place / "c.mp4")[0][-1], lens()(f))
        assert np.median(abs(luma(folder / "out" / place / "c.mp4")[0][-1].astype(int) - expected)) <= 2
    (folder / "clips/one/c.mov").write_bytes((folder / "clips/one/c.mp4").read_bytes())
    with pytest.raises(ValueError, match="both have its name: correct one after the other"):
        undistort_files(job(folder, "clips/one", focal=str(folder / "tracks"), out="other"))


def test_a_folder_without_the_track_of_a_video_is_named(folder):
    (folder / "tracks").mkdir()
    (folder / "tracks/track.csv").write_text("frame,focal\n0,20\n")
    write_clip(folder / "c.mp4", 2, sound=False)
    with pytest.raises(
        FileNotFoundError, match=r"folder .*tracks has no c\.csv, the track of .*c\.mp4: name"
    ):
        undistort_files(job(folder, "c.mp4", focal=str(folder / "tracks")))


def test_again_is_for_photos(folder):
    write_clip(folder / "a.mp4", 2, sound=False)
    with pytest.raises(ValueError, match=r"Argument again is for photos, .*: leave it out"):
        undistort_files(job(folder, "a.mp4", focal="30", again=True))


def test_photos_of_one_name_do_not_share_a_row(folder):
    for place in ("one", "two"):
        (folder / "pictures" / place).mkdir(parents=True)
        cv2.imwrite(str(folder / "pictures" / place / "p.png"), np.zeros(SIZE[::-1], np.uint8))
    table = folder / "focal.csv"
    table.write_text("image,focal\np.png,30\n")
    with pytest.raises(ValueError, match=r"one row p\.png for two images.*write the folder before"):
        undistort_files(job(folder, "pictures", focal=str(table)))
    assert not (folder / "out").exists()
    table.write_text("image,focal\none/p.png,30\ntwo/p.png,60\n")
    assert undistort_files(job(folder, "pictures", focal=str(table))).written == 2


def test_nothing_is_written_through_a_link_in_the_output_folder(folder, tmp_path):
    (tmp_path / "outside").mkdir()
    (folder / "out").mkdir()
    (folder / "out" / "day").symlink_to(tmp_path / "outside", target_is_directory=True)
    with pytest.raises(ValueError, match="out/day is a link"):
        undistort_files(job(folder, "in", focal="24"))
    assert files(tmp_path / "outside") == []
    assert files(folder / "out") == []
    (tmp_path / "elsewhere").mkdir()  # the folder itself may be a link: it was chosen
    (folder / "linked").symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    undistort_files(job(folder, "in", out="linked", focal="24"))
    assert files(tmp_path / "elsewhere") == ["a.jpg", "day/a.jpg", "day/b.png"]


def test_a_dead_link_and_an_empty_folder_cost_themselves(folder):
    (folder / "dead.jpg").symlink_to(folder / "nowhere")
    (folder / "empty.jpg").mkdir()
    done = undistort_files(job(folder, "in/a.jpg", "dead.jpg", "empty.jpg", focal="24"))
    assert done.written == 1
    assert sorted(path.rsplit("/", 1)[1] for path in done.skipped) == ["dead.jpg", "empty.jpg"]
    assert "Is a directory" in done.skipped[str(folder / "empty.jpg")]
    photos = [
        source.name for source in find_photos([folder / name for name in ("in", "dead.jpg", "empty.jpg")])
    ]
    assert {"dead.jpg", "empty.jpg"} < {name.rsplit("/", 1)[-1] for name in photos}


def test_dots_in_a_pattern_lead_nowhere(folder):
    """Names below the fixed part of a pattern may begin with ``..``, and led out of the output folder."""
    before = (folder / "in/a.jpg").read_bytes()
    (folder / "far/deep").mkdir(parents=True)
    done = undistort_files(job(folder, "far/*/../../in/a*.jpg", out="new/out"))
    assert done.written == 1
    assert (folder / "in/a.jpg").read_bytes() == before
    assert files(folder / "new") == ["out/in/a.jpg"]


@pytest.mark.parametrize(
    ("out", "message"),
    [
        ("in/new/../a.jpg", r"is the input"),
        ("in/new/..", r"is the input"),
        ("in/new/../other.jpg", r"already exists"),
    ],
)
def test_dots_after_a_folder_that_is_not_there_hide_no_file(out, message, folder):
    (folder / "in/other.jpg").write_text("precious")
    before = {name: (folder / "in" / name).read_bytes() for name in files(folder / "in")}
    with pytest.raises((ValueError, FileExistsError), match=message):
        undistort_files(job(folder, "in/a.jpg", out=out))
    assert {name: (folder / "in" / name).read_bytes() for name in files(folder / "in")} == before


def test_what_is_no_result_is_not_counted_as_one(folder):
    Image.fromarray(picture(0)).save(folder / "in/b.bmp")
    Image.fromarray(picture(0)).save(folder / "in/c.bmp")
    (folder / "out").mkdir()
    (folder / "out/b.bmp").write_text("mine")
    with pytest.raises(FileExistsError, match=r"b\.bmp already exists"):
        undistort_files(job(folder, "in/b.bmp", "in/c.bmp", focal="24", resume=True))
    (folder / "out/b.bmp").unlink()
    undistort_files(job(folder, "in/b.bmp", focal="24", out="out/b.bmp"))
    done = undistort_files(job(folder, "in/b.bmp", "in/c.bmp", focal="24", resume=True))
    assert done.sentence.startswith("1 of 2 photos corrected now, 1 earlier")
    assert [note for note in done.notes if "out/b.bmp. Such files hold no mark" in note]
    write_clip(folder / "c.mp4")
    (folder / "out/c.mp4").write_text("mine")
    with pytest.raises(FileExistsError, match=r"c\.mp4 already exists"):
        undistort_files(job(folder, "c.mp4", focal="24", resume=True))
