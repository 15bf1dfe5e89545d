"""What photos say against one lens having taken them."""

import dataclasses

import numpy as np
import pytest
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from zoomjax import compress
from zoomjax.app.calibrating import calibrate
from zoomjax.app.focal_sources import Focals
from zoomjax.app.model_choice import WantedModel
from zoomjax.app.plane_focals import FocalGroup
from zoomjax.app.verdict import (
    findings_of_edges,
    findings_of_exif,
    findings_of_focals,
    findings_of_own_focals,
    findings_of_photos,
    findings_of_sizes,
    verdict_of_photo,
)
from zoomjax.detect.batch import Detection
from zoomjax.trust.assessment import Finding
from zoomjax.trust.comparison import compare_errors
from zoomjax.trust.folds import folds_of

from ..io.test_equipment import block

SIZE = (40, 40)


def photo(path, model=None, lens=None, written=None):
    exif = Image.Exif()
    if model is not None:
        exif[ExifTags.Base.Model] = model
    if lens is not None:
        exif[ExifTags.IFD.Exif] = {ExifTags.Base.LensModel: lens}
    if written is not None:
        width, height = written
        exif[ExifTags.IFD.Exif] = {
            ExifTags.Base.ExifImageWidth: width,
            ExifTags.Base.ExifImageHeight: height,
        }
    Image.new("L", SIZE).save(path, exif=exif)
    return path


def test_photos_of_one_lens_say_nothing(tmp_path):
    photos = [photo(tmp_path / f"{n}.jpg", "D90", "18-200") for n in range(3)]
    photos.append(photo(tmp_path / "unknown.jpg"))
    assert findings_of_photos(photos, SIZE) == []


def test_of_files_of_several_pages_it_is_said_that_the_first_is_used(tmp_path):
    """Of a stack of photos all but one were left out without a word; previews are none."""
    page = Image.new("L", SIZE)
    for name, size in (("stack.tif", SIZE), ("preview.tif", (SIZE[0] // 8, SIZE[1] // 8))):
        page.save(tmp_path / name, save_all=True, append_images=[Image.new("L", size)])
    page.save(tmp_path / "one.tif")
    names = ("stack.tif", "preview.tif", "one.tif", "missing.tif")
    (found,) = findings_of_photos([tmp_path / name for name in names], SIZE)
    assert (found.verdict, found.found) == ("good", "of the pages of stack.tif the first alone was used.")


def test_photos_that_were_changed_before_are_doubtful(tmp_path):
    xmp = b'<x:xmpmeta><a crs:LensProfileEnable="1" crs:AlreadyApplied="True"/></x:xmpmeta>'
    for number in range(3):
        Image.new("L", (40, 40)).save(tmp_path / f"{number}.png")
    Image.new("L", (40, 40)).save(tmp_path / "0.jpg", xmp=xmp)
    Image.new("L", (40, 40)).save(tmp_path / "2.png", dpi=(300, 200))
    photos = [tmp_path / name for name in ("0.jpg", "1.png", "2.png")]
    corrected, squeezed = findings_of_photos(photos, SIZE)
    assert (corrected.verdict, squeezed.verdict) == ("doubtful", "doubtful")
    assert corrected.found.startswith(
        "1 of 3 photos say that their distortion was corrected before, by Adobe's lens correction:"
    )
    assert squeezed.found.startswith("1 of 3 photos say that their pixels are not square, 300 on 200,")


def test_two_lenses_and_bodies_are_doubtful(tmp_path):
    photos = [photo(tmp_path / f"{n}.jpg", f"D{n // 3}", f"lens {n % 2}") for n in range(5)]
    lenses, cameras = findings_of_photos(photos, SIZE)
    assert (lenses.verdict, cameras.verdict) == ("doubtful", "doubtful")
    assert lenses.cause
    assert cameras.cause
    assert lenses.found == (
        "the photos were taken with 2 different lenses, by their EXIF data: lens 0 (3 photos), lens 1 "
        "(2 photos)."
    )
    assert "D0 (3 photos), D1 (2 photos)" in cameras.found


def test_photos_cropped_from_other_shapes_are_doubtful(tmp_path):
    """Not those made smaller, or taken upright."""
    sizes = [(6000, 4000), (4000, 6000), (3001, 2000), (6000, 4000)]
    photos = [photo(tmp_path / f"{n}.jpg", written=size) for n, size in enumerate(sizes)]
    assert findings_of_photos(photos, SIZE) == []
    photos.append(photo(tmp_path / "other.jpg", written=(6000, 3376)))
    (found,) = findings_of_photos(photos, SIZE)
    assert (found.verdict, found.cause) == ("doubtful", True)
    assert "6000 x 4000 px (3 photos), 3001 x 2000 px (1 photo)" in found.found
    assert "6000 x 3376 px (1 photo)" in found.found


def view(path, zoom=None, film=53):
    """A photo at 35 mm, with digital zoom, and the focal length of equal view on film."""
    told = {} if zoom is None else {"DigitalZoomRatio": IFDRational(round(zoom * 100), 100)}
    content = block(FocalLength=IFDRational(35, 1), FocalLengthIn35mmFilm=film, **told)
    Image.new("L", SIZE).save(path, exif=content)
    return path


def test_photos_that_show_parts_of_the_sensor_of_different_size_are_doubtful(tmp_path):
    """A camera's digital zoom and its smaller format write the same number of pixels, and the same f."""
    alike = [view(tmp_path / "a.jpg"), view(tmp_path / "b.jpg", 0), view(tmp_path / "c.jpg", 1, film=52)]
    assert findings_of_photos(alike, SIZE) == []
    zoomed = [view(tmp_path / "2.jpg", 2), view(tmp_path / "too.jpg", 2)]
    assert findings_of_photos(zoomed, SIZE) == []
    (found,) = findings_of_photos([*alike, *zoomed], SIZE)
    assert (found.verdict, found.cause) == ("doubtful", True)
    assert "taken with digital zoom, up to 2, for 2 of 5 photos." in found.found
    (found,) = findings_of_photos([*zoomed, view(tmp_path / "4.jpg", 4)], SIZE)
    assert "with digital zoom, up to 4, for 3 of 3 photos." in found.found
    (found,) = findings_of_photos([*alike, view(tmp_path / "full.jpg", film=35)], SIZE)
    assert "at crop factors of 1 to 1.51." in found.found


def test_focal_lengths_that_photos_may_share_come_first_where_something_is_wrong():
    options = "--focal plane --shared-focal folder, if the photos of a folder are of one zoom,"
    assert findings_of_own_focals(options, "good") == []
    assert findings_of_own_focals("", "doubtful") == []
    (found,) = findings_of_own_focals(options, "doubtful")
    assert (found.verdict, found.cause) == ("doubtful", True)
    assert found.advice.endswith("--shared-focal folder, if the photos of a folder are of one zoom.")


def test_photos_of_other_sizes_are_remarked_on():
    assert findings_of_sizes(0, 9) == []
    (found,) = findings_of_sizes(2, 9)
    assert found.verdict == "good"
    assert found.found == "2 of 11 photos are of another size than most and were left out."


@pytest.mark.slow
def test_two_lenses_are_to_be_parted_before_another_photo_is_taken(noisy, tmp_path):
    done = calibrate(noisy, model=WantedModel("polynomial"), centre=None)
    photos = [photo(tmp_path / f"{n}.jpg", lens=f"lens {n % 2}") for n in range(4)]
    found = findings_of_photos(photos, SIZE)
    mixed = dataclasses.replace(done, assessment=done.assessment.joined_by(found))
    assert mixed.assessment.sentence.startswith("Doubtful: the photos were taken with 2 different lenses")
    assert mixed.advice() == (
        "Calibrate the photos of each lens and camera by themselves. That comes before another photo."
    )
    assert done.advice() != mixed.advice()
    assert not mixed.summary()["next_photo"]["enough"]


def sharing(*groups):
    return Focals({}, "px", "homographies of the grid", "", groups=groups)


def test_a_standard_deviation_far_below_what_the_photos_give_is_doubtful():
    own = {"a": 10.0, "b": 30.0, "c": 50.0}
    found = Focals(dict.fromkeys(own, 1000.0), "px", "homographies of the grid", "", own)
    assert findings_of_focals(found) == []
    for given, doubtful in ((1.0, True), (0.0, True), (20.0, False), (100.0, False)):
        told = findings_of_focals(found.deviating_by(dict.fromkeys(own, given)))
        assert [one.verdict for one in told] == ["doubtful"] * doubtful
    assert "given as 1 px, in place of 30 px, in the middle of 3 photos (homographies of the grid)" in (
        findings_of_focals(found.deviating_by(dict.fromkeys(own, 1.0)))[0].found
    )
    exact = dataclasses.replace(found, deviation={})
    assert findings_of_focals(exact.deviating_by(dict.fromkeys(own, 0.0))) == []


def test_photos_that_disagree_about_a_shared_focal_length_are_doubtful():
    agree = FocalGroup(("a", "b"), 1000.0, 10.0, (990.0, 1010.0))
    near = FocalGroup(("c", "d"), 2000.0, 90.0, (1800.0, 2100.0), agree=False)
    far = FocalGroup(("e", "f", "g"), 3000.0, 400.0, (1500.0, 4000.0), agree=False)
    assert findings_of_focals(sharing(agree, FocalGroup(("h", "i"), 1.0, 0.1))) == []
    [one] = findings_of_focals(sharing(agree, near))
    assert (one.verdict, one.cause) == ("doubtful", True)
    assert one.found == near.sentence("px")
    assert "1,800 to 2,100 px" in one.found
    [both] = findings_of_focals(sharing(agree, near, far))
    assert both.found == far.sentence("px") + " Another group disagrees, too."


def test_photos_whose_strong_edges_are_on_no_line_are_remarked_on():
    """Not those of a detector that does not look at all edges, and not a few among many."""
    photos = [Detection(f"{n}.jpg", unexplained=share) for n, share in enumerate((0.2, 0.7, 0.9))]
    (found,) = findings_of_edges(photos)
    assert (found.about, found.verdict) == ("edges without lines", "good")
    assert "2 of 3 photos" in found.found
    assert "90% in 2.jpg" in found.found
    assert findings_of_edges([*photos[:2], Detection("a.jpg", unexplained=0.1)]) == []
    assert findings_of_edges([Detection("grid.jpg")]) == []


def test_selection_still_says_what_that_is_told_by(noisy):
    """The start of its message where no model can be compared."""
    small = compress(noisy)
    parts = folds_of(small, "line", 2, 0)
    with pytest.raises(ValueError, match=r"^No candidate can be compared"):
        compare_errors([object()], ["it failed"], parts, "least")


@pytest.mark.slow
def test_the_photo_at_an_end_of_the_zoom_is_told_from_the_others(noisy):
    """By the lens of the others beyond their focal lengths, or by nothing."""
    done = calibrate(noisy, model=WantedModel("polynomial"), centre=None)
    first = int(np.argmin(done.lines.focal))
    kept = np.zeros(9, bool)

    def judged(joint):
        held_out = np.where(np.arange(4) == first, joint, done.rms_held_out)
        return verdict_of_photo(
            dataclasses.replace(done, rms_held_out=held_out), first, Detection("a"), kept
        )

    verdict, reason = judged(9.0)
    assert verdict == "doubtful"
    assert "the other photos, extrapolated to its focal length, leaves 9 px" in reason
    assert judged(done.rms_frames_held_out[first]) == ("good", "")
    verdict, reason = judged(np.nan)
    assert verdict == "good"
    assert "the other photos do not determine the lens" in reason


def test_the_verdict_on_one_photo_is_that_on_its_lens(noisy):
    done = calibrate(noisy, model=WantedModel("polynomial"), centre=None)
    bad = Finding("a", "doubtful", "lines are bent.", "Look.")
    for findings, told in (((), ("good", "")), ((bad,), ("doubtful", "lines are bent"))):
        assessment = dataclasses.replace(done.assessment, findings=findings)
        one = dataclasses.replace(done, rms_uncorrected=done.rms_uncorrected[:1], assessment=assessment)
        assert verdict_of_photo(one, 0, Detection("a"), np.zeros(9, bool)) == told


@pytest.mark.parametrize(
    ("exif", "used", "in_mm", "measured", "told"),
    [
        ([18, 35, 200], [1, 1, 1], False, False, "a.jpg 18 mm and c.jpg 200 mm are of other zooms"),
        ([18, 35, 200], [18.3, 35.2, 190], True, False, ""),
        ([18, 35, 200], [3600, 7000, 39000], False, False, ""),
        ([18, 35, 200], [18, 200, 35], True, False, "b.jpg 35 mm and c.jpg 200 mm"),
        ([None, 35, None], [1, 1, 1], False, False, ""),
        (
            [18, 35, 200],
            [27, 52.5, 300],
            True,
            False,
            "a.jpg 18 mm and c.jpg 200 mm are of other zooms",
        ),
        ([18, 35, 200], [14.7, 29, 170], True, True, ""),
        ([18, 35, 200], [17, 33, 140], True, True, ""),
        ([18, 35, 200], [12, 24, 90], True, True, "a.jpg 18 mm and c.jpg 200 mm are of other zooms"),
        ([None, 35, None], [50, 50, 50], True, False, "b.jpg 35 mm is of another zoom"),
    ],
    ids=[
        *("taken as one", "rounded", "in px", "rows in another order", "one known", "equal view on film"),
        *("near things", "a zoom that shortens for near things", "a board of another size", "one in mm"),
    ],
)
def test_focal_lengths_that_contradict_exif_data_are_doubtful(exif, used, in_mm, measured, told):
    names = ["a.jpg", "b.jpg", "c.jpg"]
    found = findings_of_exif(
        [Detection(name, focal=f and float(f)) for name, f in zip(names, exif, strict=True)],
        dict(zip(names, map(float, used), strict=True)),
        in_mm=in_mm,
        measured=measured,
    )
    assert [finding.verdict for finding in found] == ["doubtful"] * bool(told)
    assert told in "".join(finding.found for finding in found)
