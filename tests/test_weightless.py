"""Frames whose lines all weigh nothing, and lines that do, are as if they were not there.

They are how a photo is left out: of a wrong focal length, or of lines that a robust fit has rejected.
"""

import dataclasses

import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes, trust
from zoomjax.trust.centre_choice import choose_centre
from zoomjax.trust.staged_selection import select_in_stages

from .test_last_digits import mirrored

WRONG = {"at both ends": (0, 7), "in between": (2, 4), "every other": (1, 3, 5, 7)}
"""Frames that are left out, of those at eight focal lengths."""


@pytest.fixture(scope="module")
def board(truth):
    return scenes.board_lines(truth, scenes.focal_sweep(8), spacing=300.0, noise=0.3, seed=2)


@pytest.fixture(scope="module", params=WRONG.values(), ids=WRONG.keys())
def both(request, board):
    """Lines of which some frames weigh nothing, as all their lines are crooked; and those without them."""
    frame = np.asarray(board.frame)
    out = np.isin(frame, request.param)
    points = [
        line + 30 * np.sin(line[:, ::-1] / 200) if gone else line
        for line, gone in zip(board.to_ragged(), out, strict=True)
    ]
    options = {"image_size": board.image_size}
    whole = zj.Lines.from_ragged(points, frame, board.focal, **options).weighted(np.where(out, 0.0, 1.0))
    left = np.delete(np.arange(8), request.param)
    kept = [line for line, gone in zip(points, out, strict=True) if not gone]
    few = zj.Lines.from_ragged(
        kept, np.searchsorted(left, frame[~out]), np.asarray(board.focal)[left], **options
    )
    return (whole, zj.compress(whole)), (few, zj.compress(few)), left


def same(function, both):
    """What a function of lines and triangles gives of both."""
    whole, few, left = both
    first, second = function(*whole), function(*few)
    if np.ndim(first):
        assert np.isnan(np.delete(first, left)).all()
        first = np.asarray(first)[left]
    np.testing.assert_allclose(first, second, rtol=1e-6)


def test_the_range_of_the_lens(both):
    same(lambda _, small: float(zj.fit_zoom(small).lens.focal_range[0]), both)
    same(lambda _, small: float(zj.fit_zoom(small).lens.focal_range[1]), both)
    lens = zj.fit_zoom(both[0][1]).lens
    for focal in np.asarray(both[0][0].focal)[[0, -1]]:
        if not float(lens.focal_range[0]) <= focal <= float(lens.focal_range[1]):
            with pytest.warns(UserWarning, match="not within the range"):
                lens(float(focal))


def test_all_weights_of_zero_leave_the_whole_range(board):
    lens = zj.fit_zoom(zj.compress(board).weighted(np.zeros(len(board.frame))), throw=False).lens
    np.testing.assert_allclose(lens.focal_range, [board.focal.min(), board.focal.max()])


@pytest.mark.parametrize(
    "zoom",
    [
        zj.PolynomialZoom(),
        zj.SmoothZoom(),
        zj.models.PowerZoom(),
        zj.models.TableZoom(),
        zj.models.SplineZoom(),
    ],
    ids=lambda zoom: type(zoom).__name__,
)
@pytest.mark.parametrize("wrong", [1e-6, 1.0, 5000.0])
def test_the_reference_and_the_knots_of_models(board, zoom, wrong):
    focal = np.append(board.focal, wrong)
    points, frame = board.to_ragged(), np.asarray(board.frame)
    far = zj.Lines.from_ragged(
        [*points, points[0]], np.append(frame, 8), focal, image_size=board.image_size
    ).weighted(np.append(np.ones(len(frame)), 0.0))
    one, other = (zj.fit_zoom(zj.compress(lines), zoom=zoom) for lines in (far, board))
    assert one.result == other.result
    np.testing.assert_allclose(one.frame_rms[:8], other.frame_rms, rtol=1e-6)
    np.testing.assert_allclose(one.lens(50.0).coefficients, other.lens(50.0).coefficients, rtol=1e-6)
    std, expected = (zj.displacement_std(fit, np.array([30.0, 40.0]), focal=50.0) for fit in (one, other))
    np.testing.assert_allclose(std, expected, rtol=1e-4)


@pytest.mark.parametrize("zoom", [zj.SmoothZoom(), zj.models.TableZoom()], ids=["smooth", "table"])
@pytest.mark.parametrize("left", [0, 2], ids=["no points", "two points"])
def test_a_frame_of_which_no_line_has_three_points(board, zoom, left):
    """As chunks have them: its focal length was the reference, and a knot that nothing determines."""
    frame = np.asarray(board.frame)
    points = [line[:left] if of == 0 else line for line, of in zip(board.to_ragged(), frame, strict=True)]
    chunk = zj.Lines.from_ragged(points, frame, board.focal, image_size=board.image_size, chunk=True)
    weighted = board.weighted((frame != 0) * 1.0)
    one, other = (zj.fit_zoom(zj.compress(lines), zoom=zoom) for lines in (chunk, weighted))
    assert one.result == other.result == zj.RESULTS.successful
    np.testing.assert_allclose(one.lens(50.0).coefficients, other.lens(50.0).coefficients, rtol=1e-6)


@pytest.mark.slow
def test_the_reference_of_a_centre_that_moves(board):
    points, frame = board.to_ragged(), np.asarray(board.frame)
    far = zj.Lines.from_ragged(
        [*points, points[0]], np.append(frame, 8), np.append(board.focal, 1e-6), image_size=board.image_size
    ).weighted(np.append(np.ones(len(frame)), 0.0))
    one, other = (
        zj.fit.fit_centre(zj.lines.compress_any_centre(lines), centre=zj.PolynomialZoom(degree=1))
        for lines in (far, board)
    )
    assert one.determined == other.determined
    np.testing.assert_allclose(one.centre[:8], other.centre, atol=1e-6)


@pytest.mark.parametrize("hold_out", ["focal", "frame", "line"])
def test_cross_validation(both, hold_out):
    if hold_out == "focal" and len(both[2]) < 5:
        pytest.skip("two focal lengths between the ends alone")

    def errors(_, small):
        return trust.cross_validate_zoom(small, hold_out=hold_out, folds=5)

    whole, few, left = both
    np.testing.assert_allclose(errors(*whole)[left], errors(*few), rtol=1e-6)


def test_cross_validation_of_each_frame(both):
    same(lambda _, small: trust.cross_validate_frames(small), both)


@pytest.mark.parametrize(
    "select",
    [
        lambda small: zj.select_model(small, [zj.PolynomialZoom(degree=d) for d in range(3)]),
        lambda small: select_in_stages(small, [zj.PolynomialZoom(degree=d) for d in range(3)], (2, 1)),
    ],
    ids=["all at once", "in stages"],
)
def test_selection(both, select):
    (_, whole), (_, few), _ = both
    first, second = select(whole), select(few)
    assert (first.hold_out, first.folds, first.chosen.name) == (
        second.hold_out,
        second.folds,
        second.chosen.name,
    )
    for one, other in zip(first.compared, second.compared, strict=True):
        np.testing.assert_allclose(
            [one.held_out, one.held_out_std], [other.held_out, other.held_out_std], rtol=1e-6
        )


@pytest.mark.slow
def test_evidence(both):
    (whole, small), (few, tiny), _ = both
    one, other = (trust.evidence(lines, zj.fit_zoom(of)) for lines, of in ((whole, small), (few, tiny)))
    assert one.rejected == np.sum(np.asarray(whole.weight) == 0)
    assert [halves.parting for halves in one.halves] == [halves.parting for halves in other.halves]
    for halves, others in zip(one.halves, other.halves, strict=True):
        np.testing.assert_allclose(
            dataclasses.astuple(halves)[1:], dataclasses.astuple(others)[1:], rtol=1e-4
        )
    names = ("lines", "frames", "focals", "rms", "rms_uncorrected", "noise", "displacement", "std")
    for name in names:
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-6)
    np.testing.assert_allclose(
        dataclasses.astuple(one.vanishing), dataclasses.astuple(other.vanishing), rtol=1e-4
    )


@pytest.mark.slow
def test_frames_left_out_are_judged_without_the_ends_that_count(both):
    (whole, small), (few, tiny), left = both

    def judged(lines, of):
        size = len(lines.focal)
        there = left if size == 8 else np.arange(size)
        held_out, each = np.full((2, size), np.nan)
        held_out[there], each[there] = 0.3, 0.3
        held_out[there[[0, -1]]] = 30.0  # extrapolated
        found = trust.assess(lines, zj.fit_zoom(of), rms_held_out=held_out, rms_frames_held_out=each)
        return [finding.about for finding in found.findings if finding.about == "photos left out"]

    assert judged(whole, small) == judged(few, tiny) == []


@pytest.mark.slow
def test_the_next_photo(both):
    def figures(_, small):
        found = trust.suggest_next(zj.fit_zoom(small), small)
        return found.focal, found.before, found.after

    for part in range(3):
        same(lambda *lines, part=part: figures(*lines)[part], both)


def test_a_robust_fit_with_its_centre():
    few, t = mirrored(0.2), np.linspace(100.0, 400.0, 30)
    crooked = [np.stack([t, y + 50 * np.sin(t / 40)], -1) for y in (200.0, 220.0)]
    whole = zj.Lines.from_ragged(
        [*few.to_ragged(), *crooked], [*np.asarray(few.frame), 0, 1], few.focal, image_size=few.image_size
    ).weighted(np.repeat([1.0, 0.0], [len(few.frame), 2]))
    first, second = (zj.fit_robust(lines, centre="fit").fit for lines in (whole, few))
    np.testing.assert_allclose(first.rms, second.rms, rtol=1e-9)
    np.testing.assert_allclose(first.lens.centre, second.lens.centre, rtol=1e-9)


@pytest.mark.slow
def test_the_choice_of_a_centre(both):
    def errors(lines, _):
        found = choose_centre(zj.lines.compress_any_centre(lines), zj.models.Model(zj.PolynomialZoom()))
        return found.fitted, found.given

    for part in range(2):
        same(lambda *lines, part=part: errors(*lines)[part], both)


# Lines without points, which fill up what is spread over devices


def test_lines_without_points_are_not_rejected(board):
    lines = zj.lines.compress(board)
    padded = dataclasses.replace(
        lines,
        triangle=np.pad(np.asarray(lines.triangle), ((0, 5), (0, 0), (0, 0))),
        frame=np.pad(np.asarray(lines.frame), (0, 5)),
        weight=np.pad(np.ones(len(lines.frame)), (0, 5)),
        number=None,
    )
    first, second = zj.fit_robust(lines), zj.fit_robust(padded)
    assert second.rejected.tolist() == first.rejected.tolist()
    assert np.isnan(np.asarray(second.line_rms)[-5:]).all()
    np.testing.assert_allclose(second.line_rms[:-5], first.line_rms, rtol=1e-6)
    points = dataclasses.replace(
        board,
        points=np.pad(np.asarray(board.points), ((0, 5), (0, 0), (0, 0))),
        mask=np.pad(np.asarray(board.mask), ((0, 5), (0, 0))),
        frame=padded.frame,
        weight=np.pad(np.ones(len(lines.frame)), (0, 5)),
        number=None,
    )
    weightless = points.weighted(np.where(np.arange(len(points.frame)) > 1, points.weight, 0))
    assert trust.evidence(weightless, first.fit).rejected == 2
