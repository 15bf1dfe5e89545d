"""Photos of one zoom share a focal length: rendered boards seen obliquely, with exact truth."""

import dataclasses
import json
import shutil

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.app.board_bundle import bundle_of
from zoomjax.app.console import show_images
from zoomjax.app.focal_sources import GRID, Focals, choose_focals
from zoomjax.app.image_calibration import calibrate_images
from zoomjax.app.image_job import ImageJob
from zoomjax.app.model_choice import WantedModel
from zoomjax.app.plane_focals import FocalGroup, Sharing, focals_from_grids, similar
from zoomjax.app.plans import images_plan, lines_plan
from zoomjax.app.report import report
from zoomjax.detect.batch import Detection, detect
from zoomjax.detect.sources import find_photos
from zoomjax.io.exif import exif_with_focal

SIZE = (480, 360)
ROWS, COLUMNS = 8, 11
ZOOMS = {24.0: 620.0, 35.0: 900.0, 50.0: 1290.0}
"""Focal lengths in px by those in the EXIF data, mm."""

TILTS = ((0.18, 0.06), (-0.15, 0.09), (0.06, -0.2), (0.03, 0.15), (0.0, 0.0))
"""Radians about x and y; the last view is square to the board and says nothing alone."""


def photo(focal, tilt, rng):
    """A checkerboard, 2 x 2 samples a pixel, with a blur and noise."""
    x, y = ((np.arange(2 * side) + 0.5) / 2 - 0.5 for side in SIZE)
    middle = (np.array(SIZE) - 1) / 2
    lens = zj.Distortion(
        jnp.array([0.05 - 20 / focal, 0.0]), jnp.array(middle), jnp.array(np.hypot(*SIZE) / 2)
    )
    rays = (np.asarray(lens.undistort(jnp.array(np.stack(np.meshgrid(x, y), -1)))) - middle) / focal
    turn = cv2.Rodrigues(np.array([*tilt, 0.1]))[0]
    # The board's step is 1, and its middle at the depth at which it fills the height.
    depth = focal * 1.35 * ROWS / SIZE[1]
    plane = np.column_stack([turn[:, 0], turn[:, 1], [0, 0, depth]])
    at = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], -1) @ np.linalg.inv(plane).T
    i, j = np.floor(np.moveaxis(at[..., :2] / at[..., 2:] + [COLUMNS / 2, ROWS / 2], -1, 0))
    board = (i >= -1) & (i <= COLUMNS) & (j >= -1) & (j <= ROWS)
    bright = np.where(board, (i + j) % 2, 1.0).reshape(SIZE[1], 2, SIZE[0], 2).mean(axis=(1, 3))
    image = cv2.GaussianBlur(40 + 170 * bright, None, 0.7) + 10 * rng.standard_normal(bright.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def grid_seen(turn, cell=1.0, off=0.0):
    """Nodes as a camera of 900 px sees them, rows so far apart, corrected about a centre so far off."""
    y, x = np.meshgrid(cell * (np.arange(ROWS) - ROWS / 2), np.arange(COLUMNS) - COLUMNS / 2, indexing="ij")
    points = np.stack([x, np.cos(turn) * y, 25 + np.sin(turn) * y], -1)
    seen = 900 * points[..., :2] / points[..., 2:]
    radius = np.sum((seen / 300) ** 2, -1, keepdims=True)
    moved = np.sum(((seen - [0, off]) / 300) ** 2, -1, keepdims=True)
    middle = (np.array(SIZE) - 1) / 2
    return Detection("a", image_size=SIZE, nodes=middle + seen * (1 + 0.1 * radius) / (1 + 0.1 * moved))


@pytest.mark.parametrize("cell", [0.9, 0.97, 1.0, 1.03])
@pytest.mark.parametrize("off", [-6.0, -2.0, 0.0, 2.0, 6.0])
def test_a_view_from_the_front_tells_no_focal_length_whatever_the_cells(cell, off):
    straight = zj.Distortion(jnp.zeros(1), jnp.array((np.array(SIZE) - 1) / 2), jnp.array(300.0))
    assert not focals_from_grids([grid_seen(0.001, cell, off)], [straight]).focal
    found = focals_from_grids([grid_seen(0.4)], [straight]).focal["a"]
    assert float(found.focal) == pytest.approx(900, rel=1e-3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Five photos in a folder for each of three zooms, with focal lengths in mm in their EXIF data."""
    folder, rng = tmp_path_factory.mktemp("zooms"), np.random.default_rng(0)
    for mm, focal in ZOOMS.items():
        (folder / f"{mm:g}mm").mkdir()
        exif = np.frombuffer(exif_with_focal(mm), np.uint8)
        for number, tilt in enumerate(TILTS):
            _, content = cv2.imencodeWithMetadata(
                ".png", photo(focal, tilt, rng), [cv2.IMAGE_METADATA_EXIF], [exif]
            )
            (folder / f"{mm:g}mm" / f"{mm:g}-{number}.png").write_bytes(content.tobytes())
    return folder


def inputs(folder):
    return tuple(str(folder / f"{mm:g}mm") for mm in ZOOMS)


@pytest.fixture(scope="module")
def detections(folder):
    found = list(detect(find_photos(inputs(folder)), zj.detect.GridDetector(), grid="all"))
    assert [d.problem for d in found] == [""] * 15
    return found


@pytest.fixture(scope="module")
def alone(detections):
    return choose_focals(detections, "plane")


def truth(name):
    return ZOOMS[float(name.split("-")[0])]


def errors(found):
    return np.array([focal / truth(name) - 1 for name, focal in found.focal.items()])


@pytest.mark.parametrize("how", ["exif", "folder", "similarity"])
def test_a_shared_focal_length_is_nearer_to_the_truth(how, detections, alone):
    shared = choose_focals(detections, "plane", sharing=Sharing(how))
    assert np.sqrt(np.mean(errors(shared) ** 2)) < 0.7 * np.sqrt(np.mean(errors(alone) ** 2))
    for name, focal in shared.focal.items():
        assert abs(focal - truth(name)) < 4 * shared.deviation[name]
    assert np.median(list(shared.deviation.values())) < 0.75 * np.median(list(alone.deviation.values()))
    if how == "similarity":  # a square view has nothing to be told by
        assert {truth(name) for group in shared.groups for name in group.names} == set(ZOOMS.values())
        assert all(len({truth(name) for name in group.names}) == 1 for group in shared.groups)
        return
    assert [len(group.names) for group in shared.groups] == [5, 5, 5]
    assert len(shared.focal) == 15 > len(alone.focal)  # square views, too
    assert len(set(shared.focal.values())) == 3


def test_other_numbers_of_photos_compile_nothing_and_change_nothing(detections, compilations):
    middle = (np.array(SIZE) - 1) / 2
    none = zj.Distortion(np.zeros(2), middle, np.array(np.hypot(*SIZE) / 2))
    all_of_them = focals_from_grids(detections, [none] * 15, Sharing("folder"))
    compilations()
    focals_from_grids(detections[3:12], [none] * 9, Sharing("folder"))
    assert compilations() == 0
    own = focals_from_grids(detections[:5], [none] * 5, Sharing("folder"))  # in arrays of other sizes
    for name, estimate in own.focal.items():
        np.testing.assert_allclose(estimate.focal, all_of_them.focal[name].focal, rtol=1e-11)
        np.testing.assert_allclose(estimate.std, all_of_them.focal[name].std, rtol=1e-8)


def test_photos_without_a_grid_have_the_focal_length_of_their_zoom(detections):
    some = [
        dataclasses.replace(d, nodes=None) if place % 5 == 1 else d for place, d in enumerate(detections)
    ]
    found = choose_focals(some, "plane", sharing=Sharing("folder"))
    for d in some[1::5]:
        assert found.focal[d.name] == pytest.approx(truth(d.name), rel=0.03)


def test_photos_without_a_focal_length_in_exif_data_stay_alone(detections):
    some = [dataclasses.replace(d, focal=None) if place < 2 else d for place, d in enumerate(detections)]
    found = choose_focals(some, "plane", sharing=Sharing("exif"))
    assert [len(group.names) for group in found.groups] == [3, 5, 5]
    assert len({found.focal[d.name] for d in some[:3]}) == 3


@pytest.mark.slow
def test_photos_that_disagree_are_told_and_widen_the_deviation(detections):
    """As where a folder holds two zooms."""
    mixed = [dataclasses.replace(d, focal=24.0 if d.focal == 35 else d.focal) for d in detections]
    found = choose_focals(mixed, "plane", sharing=Sharing("exif"))
    wrong, right = found.groups
    assert (wrong.agree, right.agree) == (False, True)
    assert wrong.std > 3 * right.std
    assert "10 photos share f = " in wrong.sentence("px")
    assert "farther apart than their standard deviations explain" in wrong.sentence("px")


def test_similar_focal_lengths_are_those_of_one_value(rng):
    true = np.repeat([1000.0, 1030.0, 2000.0, 3000.0], 6)
    std = np.where(true > 1500, 30.0, 4.0)
    numbers = similar(true + std * rng.standard_normal(24), std)
    assert [len(set(numbers[true == f])) for f in (1000, 1030, 2000, 3000)] == [1] * 4
    assert len(set(numbers)) == 4
    assert similar(np.array([1000.0]), np.array([5.0])).tolist() == [0]
    assert similar(np.zeros(0), np.zeros(0)).tolist() == []
    np.testing.assert_array_equal(similar(np.array([5.0, 7.0, 5.0]), np.zeros(3)), [0, 1, 0])


def test_a_group_in_words():
    group = FocalGroup(("a", "b", "c"), 1234.4, 5.3, (1220.0, 1250.0))
    assert group.sentence("px") == "3 photos share f = 1,234 ± 5 px."
    assert dataclasses.replace(group, std=0.04).sentence("px") == "3 photos share f = 1,234.40 ± 0.04 px."


@pytest.mark.slow
def test_groups_are_told_in_terminal_report_and_summary(folder, tmp_path, capsys):
    job = ImageJob(inputs(folder), detector="grid", focal="plane", shared_focal="folder", centre="image")
    done = calibrate_images(job)
    told = done.shared()
    assert [sentence.partition(" f ")[0] for sentence in told] == ["5 photos share"] * 3
    show_images(done, tmp_path)
    out = " ".join(capsys.readouterr().out.split())  # in lines of the terminal's width
    assert all(sentence in out for sentence in told)
    assert all(sentence in report(done.calibration, done) for sentence in told)
    done.write(tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    groups, board = summary["focal_groups"], summary["board"]
    assert board["photos"] == 15
    assert board["bend_steps"][0] < 0.1  # it is flat
    assert [group["focal"] for group in groups] == pytest.approx(board["focal_px"])
    compared = done.bundle.compared(done.calibration.fit.lens, board["focal_px"])
    alone = [f"{f:.4g}" for f in np.asarray(done.bundle.fit.label)]  # by homographies alone
    assert [row[0] for row in compared] == alone
    assert [row[1].partition(" ")[0] for row in compared] == [f"{f:.0f}" for f in board["focal_px"]]
    sentence = done.bundle.sentences()[0]
    assert "bundle adjustment of 15 photos" in sentence
    assert sentence in out
    page = report(done.calibration, done)
    assert sentence in page
    assert "Straightness and bundle adjustment" in page
    assert "f of homographies, px" in page
    assert [len(group["names"]) for group in groups] == [5, 5, 5]
    for group, focal in zip(groups, ZOOMS.values(), strict=True):
        assert group["focal"] == pytest.approx(focal, rel=0.02)
        assert group["std"] > 0


def test_few_photos_make_no_bundle_and_say_what_would(detections):
    focals = Focals({d.name: 1.0 for d in detections}, "px", "", "")
    bundle, told, _ = bundle_of(detections[:3], focals)
    assert bundle is None
    assert told == (
        "The board counts as flat: 3 photos at 1 focal length cannot separate its shape from the lens. "
        "That takes 4 at each, or 12 in all."
    )
    apart = Focals({d.name: 1.0 + i for i, d in enumerate(detections)}, "px", "", "")
    assert bundle_of(detections[:11], apart).bundle is None  # each at a zoom of its own


def test_options_that_say_which_photos_are_of_one_zoom_are_named_where_they_help(detections):
    few = [dataclasses.replace(d, file=f"a/{i}.png", focal=None) for i, d in enumerate(detections[:6])]
    measured = Focals({d.name: 1.0 + i for i, d in enumerate(few)}, "px", GRID, "")
    ways = ImageJob(("a.png",), focal="plane").other_sharing

    def told(used, focals=measured, sharing=ways):
        return bundle_of(used, focals, sharing=sharing).told

    assert "say so: --focal plane --shared-focal folder, if the photos of a folder are" in told(few)
    exif = [dataclasses.replace(d, focal=24.0) for d in few]
    assert "--shared-focal exif, for photos of one focal length in their EXIF data." in told(exif)
    alone = [dataclasses.replace(d, file=f"{i}/a.png") for i, d in enumerate(few)]
    assert told(alone).endswith("say so: --focal plane --shared-focal similarity.")
    clip = ImageJob(("a.mp4",), focal="plane").other_sharing
    assert told(exif, sharing=clip).endswith("--shared-focal similarity.")
    shared = ImageJob(("a.png",), focal="plane", shared_focal="similarity").other_sharing
    assert "--shared" not in told(few, sharing=shared)  # it is given
    given = dataclasses.replace(measured, origin="EXIF data")
    assert "--shared" not in told(few, given)


@pytest.mark.slow
def test_a_folder_of_two_zooms_is_doubtful(folder, tmp_path):
    mixed = tmp_path / "mixed"
    mixed.mkdir()
    for photo in [*(folder / "24mm").iterdir(), *(folder / "50mm").iterdir()]:
        shutil.copy(photo, mixed / f"{photo.parent.name}-{photo.name}")
    job = ImageJob(
        (str(mixed), str(folder / "35mm")),
        detector="grid",
        focal="plane",
        shared_focal="folder",
        centre="image",
        model=WantedModel("polynomial", degree=1),
    )
    done = calibrate_images(job).calibration
    assert done.assessment.verdict != "good"
    first = done.assessment.findings[0]
    assert first.about == "shared focal lengths"
    assert "10 photos share f = " in first.found
    assert "one zoom" in done.advice()


def test_a_dry_run_shows_which_photos_would_share(folder):
    def planned(how):
        return images_plan(ImageJob(inputs(folder), detector="grid", focal="plane", shared_focal=how))

    alone = planned(None)
    assert planned("similarity") == [*alone, "Photos whose focal lengths agree would share one."]
    head = "Photos that would share a focal length:"
    for how, called in (("folder", str(folder) + "/{:g}mm"), ("exif", "{:g} mm in EXIF data")):
        told = planned(how)
        assert told[: len(alone) + 1] == [*alone, head]
        said = [line.partition(": ")[0] for line in told[len(alone) + 1 :]]
        assert said == [f"  {called.format(mm)}" for mm in ZOOMS]
        assert all(line.count(".png") == len(TILTS) for line in told[len(alone) + 1 :])


def test_a_dry_run_says_that_a_focal_length_is_not_known(folder):
    _, *photos = images_plan(ImageJob((str(folder / "24mm"),), detector="grid", focal="same"))
    assert photos
    assert all(line.endswith(".png: f not known") for line in photos)
    lines = zj.Lines.from_ragged([[[1, 1], [2, 2], [3, 4]]] * 2, [0, 1], [1.0, 1.0], image_size=(640, 480))
    told = "2 of 2 lines in 2 frames, all at one f, which is not known."
    assert lines_plan(lines, [], focal_known=False) == [told]
    assert lines_plan(lines, [1]) == ["1 of 2 lines in 2 frames, f = 1 mm."]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"shared_focal": "folder"}, 'give argument focal "plane", too'),
        ({"shared_focal": "folder", "focal": "exif"}, "measured from a flat grid"),
        ({"shared_focal": "folder", "focal": "35"}, "measured from a flat grid"),
        ({"shared_focal": "size", "focal": "plane"}, "one of exif, folder, similarity"),
    ],
)
def test_sharing_without_effect_is_refused_before_any_work(settings, message):
    with pytest.raises(ValueError, match=message):
        ImageJob(("photos",), **settings)


def test_sharing_by_data_that_are_not_there_is_refused(folder, tmp_path):
    with pytest.raises(ValueError, match='"folder" is for photos'):
        ImageJob(("a.mp4",), focal="plane", shared_focal="folder")
    ImageJob(("a.mp4",), focal="plane", shared_focal="similarity")
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((9, 9), np.uint8))
    (tmp_path / "b.jpg").write_bytes(b"")
    with pytest.raises(ValueError, match="no photo has one"):
        ImageJob((str(tmp_path),), focal="plane", shared_focal="exif")
    ImageJob(inputs(folder), focal="plane", shared_focal="exif")
