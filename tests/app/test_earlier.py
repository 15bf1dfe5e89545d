"""Another fit to the lines of a folder of results: what its summary knows of them."""

import dataclasses
import json

import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.app.earlier import Earlier, earlier_of, findings_of_counted_again
from zoomjax.app.model_choice import WantedModel
from zoomjax.app.runs import calibrate_lines

SIGMA = [0.5, 0.5, 2.0]


@pytest.fixture
def results(tmp_path):
    """A folder of results of three photos, two of which share a focal length."""
    lens = scenes.nikkor_18_200((1072, 712))
    lines = scenes.board_lines(lens, np.array([24.0, 24.0, 60.0]), spacing=24, noise=0.1)
    lines = lines.about(np.array([541.0, 350.0]))
    lines.save(tmp_path / "lines.npz")
    lens.save(tmp_path / "lens.json")
    names = ["a.jpg", "b.jpg", "c.jpg"]
    summary = {
        "centre": {"how": "fitted"},
        "board": {"flat_lines": True},
        "focal_groups": [{"names": ["a.jpg", "b.jpg", "e.jpg"]}],
        "images": [
            {"name": name, "focal": float(f), "focal_sigma": s}
            for name, f, s in zip(names, lines.focal, SIGMA, strict=True)
        ],
    }
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    return tmp_path, lines, summary


@pytest.mark.parametrize("how", ["fitted", "moving"])
def test_deviations_groups_centre_and_board_are_those_of_the_summary(how, results):
    folder, lines, summary = results
    (folder / "summary.json").write_text(json.dumps(summary | {"centre": {"how": how}}))
    known = earlier_of([folder / "lines.npz"], lines)
    np.testing.assert_array_equal(known.sigma, SIGMA)
    assert known.shared[0] == known.shared[1] != known.shared[2]
    assert known.centre
    assert [finding.verdict for finding in known.findings()] == ["doubtful"]


def test_lines_that_count_again_are_said(results):
    folder, lines, summary = results
    file, number = folder / "lines.npz", len(lines.frame)
    before = {"lines": number, "rejected": [{"line": line} for line in (2, 5, 9)]}
    (folder / "summary.json").write_text(json.dumps(summary | before))
    rejected = np.arange(number) == 5
    [found] = findings_of_counted_again([file], rejected)
    assert found.verdict == "good"
    assert found.found == "2 lines that the fit before this one left out count again: 2, 9."
    [found] = findings_of_counted_again([file, file], np.tile(rejected, 2))
    assert f"2, 9, {number + 2}, {number + 9}." in found.found
    [found] = findings_of_counted_again([file], np.isin(np.arange(number), (2, 5)))
    assert found.found == "a line that the fit before this one left out counts again: 9."
    assert findings_of_counted_again([file], np.isin(np.arange(number), (2, 5, 9))) == []
    for other in ({}, before | {"lines": number + 1}, before | {"rejected": [{"line": number}]}):
        (folder / "summary.json").write_text(json.dumps(summary | other))
        assert findings_of_counted_again([file], rejected) == []


def test_several_folders_are_put_together(results):
    folder, lines, _ = results
    twice = zj.Lines.from_ragged(
        lines.to_ragged() * 2,
        np.concatenate([lines.frame, lines.frame + 3]),
        np.concatenate([lines.focal, lines.focal]),
        image_size=lines.image_size,
    )
    known = earlier_of([folder / "lines.npz"] * 2, twice)
    np.testing.assert_array_equal(known.sigma, SIGMA * 2)
    assert len(np.unique(known.shared)) == 4
    assert not known.centre  # two may have been fitted, and differ


def test_folders_that_were_fitted_again_and_lines_without_a_summary_keep_their_places(results):
    """Of three files: one whose summary is of another fit to lines, one bare, one of photos."""
    folder, lines, _ = results
    (folder / "again").mkdir()
    for name in ("lines.npz", "lens.json"):
        (folder / "again" / name).write_bytes((folder / name).read_bytes())
    before = {"focal_sigma": [0.1, 0.2, 0.3], "shared": [4, 7, 4], "centre": True, "flat": False}
    rows = [{"focal": float(f)} for f in lines.focal]
    (folder / "again" / "summary.json").write_text(
        json.dumps({"centre": {"how": "image"}, "earlier": before, "per_frame": rows})
    )
    lines.save(folder / "bare.npz")
    together = zj.fit.concatenate([lines] * 3)
    files = [folder / "again" / "lines.npz", folder / "bare.npz", folder / "lines.npz"]
    known = earlier_of(files, together)
    np.testing.assert_array_equal(known.sigma, [0.1, 0.2, 0.3, 0, 0, 0, *SIGMA])
    np.testing.assert_array_equal(known.shared, [0, 1, 0, 3, 4, 5, 6, 6, 8])
    assert known.flat
    assert not known.lost


def test_uncertain_focal_lengths_that_are_those_of_other_lines_are_told(results):
    folder, lines, _ = results
    other = zj.Lines.from_ragged(
        lines.to_ragged(), lines.frame, [24.0, 25.0, 60.0], image_size=lines.image_size
    )
    known = earlier_of([folder / "lines.npz"], other)
    assert known.sigma is None
    assert "focal lengths" in [finding.about for finding in known.findings()]


@pytest.mark.parametrize(
    "change",
    [
        lambda folder, s: (folder / "summary.json").unlink(),
        lambda folder, s: (folder / "lens.json").unlink(),
    ],
)
def test_nothing_is_known_of_what_is_not_there(results, change):
    folder, lines, summary = results
    change(folder, summary)
    assert earlier_of([folder / "lines.npz"], lines) == Earlier()


def with_sigma(summary, sigma):
    return summary | {"images": [image | {"focal_sigma": sigma} for image in summary["images"]]}


@pytest.mark.parametrize(
    "damaged",
    [
        lambda s: [1],
        lambda s: {},
        lambda s: s | {"images": [1, 2, 3]},
        lambda s: s | {"images": s["images"][:2]},
        lambda s: s | {"centre": None},
        lambda s: with_sigma(s, np.nan),
        lambda s: with_sigma(s, -0.5),
        lambda s: with_sigma(s, "0,5"),
        lambda s: {
            "centre": {"how": "image"},
            "earlier": {"focal_sigma": [-1, 0, 0], "shared": None, "centre": False, "flat": False},
            "per_frame": [{"focal": image["focal"]} for image in s["images"]],
        },
    ],
)
def test_of_a_summary_that_is_damaged_it_is_told_that_focal_lengths_count_as_exact(results, damaged):
    """They may have been uncertain: bands would be too narrow without a word."""
    folder, lines, summary = results
    (folder / "summary.json").write_text(json.dumps(damaged(summary)))
    known = earlier_of([folder / "lines.npz"], lines)
    assert known.sigma is None or not known.sigma.any()
    assert [(of.about, of.verdict) for of in known.findings()][-1] == ("focal lengths", "doubtful")
    (folder / "summary.json").write_text("{")
    assert earlier_of([folder / "lines.npz"], lines).lost


def test_of_exact_focal_lengths_of_other_lines_it_is_told_too(results):
    """A summary put beside other lines says nothing of those."""
    folder, lines, summary = results
    exact = with_sigma(summary, None)
    exact["images"][1]["focal"] = 25.0
    (folder / "summary.json").write_text(json.dumps(exact))
    assert earlier_of([folder / "lines.npz"], lines).lost


def test_lines_whose_lens_cannot_be_read_are_refused(results):
    """It may say that the focal length is not known: the number in its place would be taken for one."""
    folder, lines, _ = results
    (folder / "lens.json").write_text("{")
    with pytest.raises(ValueError, match=r"lens\.json cannot be read.*move lines\.npz to another folder"):
        earlier_of([folder / "lines.npz"], lines)


def test_focal_lengths_of_other_lines_are_not_taken(results):
    folder, lines, _ = results
    other = zj.Lines.from_ragged(
        lines.to_ragged(), lines.frame, [24.0, 25.0, 60.0], image_size=lines.image_size
    )
    assert earlier_of([folder / "lines.npz"], other).sigma is None


@pytest.mark.slow
def test_that_focal_lengths_are_relative_stays_with_the_lens(results):
    folder, lines, _ = results
    lens = zj.load_lens(folder / "lens.json")
    dataclasses.replace(lens, about={"focal": "relative"}).save(folder / "lens.json")
    for name in ("lens.json", "summary.json", "lines.npz"):
        assert (folder / name).exists()
    (folder / "out").mkdir()
    done = calibrate_lines(
        lines,
        folder / "out",
        lambda _: None,
        model=WantedModel("polynomial", degree=1),
        centre="image",
        focal_sigma=None,
        robust=False,
        files=[folder / "lines.npz"],
        names=[],
    )
    assert done.assessment.verdict == "not determined"
    assert zj.load_lens(folder / "out" / "lens.json").about["focal"] == "relative"
    assert json.loads((folder / "out" / "summary.json").read_text())["focal_scale"] == "relative"
    assert "whose focal lengths are relative" in (folder / "out" / "report.html").read_text("utf-8")


@pytest.mark.slow
def test_bands_of_another_fit_have_them_and_of_one_after_that(results):
    """In the folder itself, whose lines stay while the summary is written anew."""
    folder, lines, _ = results

    def fitted(sigma=None):
        calibration = calibrate_lines(
            lines,
            folder,
            lambda _: None,
            model=WantedModel("polynomial", degree=1),
            centre="fit",
            focal_sigma=sigma,
            robust=False,
            files=[folder / "lines.npz"],
            names=[],
        )
        return calibration, json.loads((folder / "summary.json").read_text())

    first, summary = fitted()
    assert first.focal_sigma.tolist() == SIGMA
    assert summary["verdict"] != "good"
    assert summary["centre"]["how"] == "fitted"  # from the middle of the image, not kept where it was
    again, _ = fitted()
    assert again.focal_sigma.tolist() == SIGMA
    assert again.corner == first.corner
    exact, summary = fitted("0")
    [told] = [found["found"] for found in summary["findings"] if "was given as" in found["found"]]
    assert "as 0 mm, in place of 0.5 mm, in the middle of 3 frames (the fit before this one)" in told
    assert summary["verdict"] != "good"
    assert exact.focal_sigma.tolist() == [0, 0, 0]
    assert all(there[2] < of[2] for there, of in zip(exact.corner, first.corner, strict=True))
    again, summary = fitted()  # what was measured is not lost
    assert again.focal_sigma.tolist() == SIGMA
    assert not [found for found in summary["findings"] if "was given as" in found["found"]]
    wider, _ = fitted("1")
    assert wider.focal_sigma.tolist() == [1, 1, 1]
    again, _ = fitted()
    assert again.focal_sigma.tolist() == [1, 1, 2]
