"""Models chosen by lines left out: the folds' fits are `fit_zoom`'s, and the choice is the truth."""

import dataclasses
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.models import AbstractZoom, Model
from zoomjax.trust import _linear_folds
from zoomjax.trust._lanes import lanes_of, passed, passed_for_gradient
from zoomjax.trust._linear_folds import linear_errors
from zoomjax.trust.comparison import compare, compare_errors
from zoomjax.trust.cross_validation import (
    _errors_by_fits,
    cross_validate_frames,
    cross_validate_zoom,
    errors_of,
)
from zoomjax.trust.folds import HoldOut, LineErrors, folds_of, shares
from zoomjax.trust.selection import default_candidates
from zoomjax.trust.staged_selection import select_in_stages

FOCALS = 7
POLYNOMIALS = [
    zj.models.Model(zj.PolynomialZoom(degree=d), terms) for terms in (1, 2) for d in (0, 1, 2, 3)
]
MODELS = {
    "polynomial": (zj.PolynomialZoom(degree=2), 2),
    "one term": (zj.PolynomialZoom(degree=1), 1),
    "prior": (zj.SmoothZoom(), 2),
    "prior of a lens": (zj.SmoothZoom.for_lens(16.0, 300.0, crop=1.5), 2),
    "table": (zj.models.TableZoom(), 2),
    "spline": (zj.models.SplineZoom(number=4), 2),
    "not linear": (zj.models.PowerZoom(), 1),
}
every_model = pytest.mark.parametrize(("zoom", "terms"), MODELS.values(), ids=MODELS)


@pytest.fixture(scope="module")
def scene(truth):
    return scenes.board_lines(truth, scenes.focal_sweep(FOCALS), spacing=100, noise=0.3, seed=1)


@pytest.fixture(scope="module")
def lines(scene):
    return zj.compress(scene, terms=3)


@pytest.fixture(scope="module")
def selection(lines):
    return zj.select_model(lines, POLYNOMIALS)


def compared(lines, candidates, hold_out: HoldOut = "focal"):
    """The figures of each and the names of the best and the chosen, without the fit."""
    figures, best, chosen = compare(lines, candidates, folds_of(lines, hold_out, None, 0))
    return figures, best.name, chosen.name


def without(lines, out):
    """The lines less those of some frames, as a data set of its own."""
    frame = np.asarray(lines.frame)
    kept = ~np.isin(frame, out)
    number = np.cumsum(~np.isin(np.arange(len(lines.focal)), out)) - 1
    return eqx.tree_at(
        lambda lines: (lines.triangle, lines.frame, lines.focal, lines.number),
        lines,
        (lines.triangle[kept], jnp.asarray(number[frame[kept]]), np.delete(lines.focal, out), None),
    )


def counting_nothing(lines, out):
    """The lines, those of a frame without weight, and its focal length that of its neighbour."""
    weighted = lines.weighted((np.asarray(lines.frame) != out).astype(float))
    other = lines.focal.at[out].set(lines.focal[abs(out - 1)])
    return eqx.tree_at(lambda lines: lines.focal, weighted, other)


def rms_of(lines, zoom):
    return np.asarray(zj.frame_rms(lines, jax.vmap(zoom)(lines.focal)))


@pytest.mark.slow
@every_model
def test_a_frame_left_out_is_corrected_by_the_fit_of_the_others(zoom, terms, lines):
    """Fits of one shape, so that each model is compiled once."""
    held_out = cross_validate_zoom(lines, zoom=zoom, terms=terms)
    for frame in (0, 3):
        model = zoom.prepare(np.delete(lines.focal, frame), terms)
        fit = zj.fit_zoom(counting_nothing(lines, frame), zoom=model, invertible=False)
        np.testing.assert_allclose(held_out[frame], rms_of(lines, fit.lens.zoom)[frame], rtol=1e-6)
    judged = errors_of(lines, zj.models.Model(zoom, terms), folds_of(lines, "frame", 2, 0))
    model = zoom.prepare(lines.focal, terms)
    fit = zj.fit_zoom(lines.weighted(np.ones(lines.frame.shape)), zoom=model, invertible=False)
    frame = np.asarray(lines.frame)
    seen = np.bincount(frame, judged.seen) / np.bincount(frame)
    np.testing.assert_allclose(seen, fit.frame_rms**2, rtol=1e-8)


def test_a_fold_is_a_plain_fit_of_a_subset_of_the_lines(lines):
    fit = zj.fit_zoom(without(lines, [2]))
    np.testing.assert_allclose(cross_validate_zoom(lines)[2], rms_of(lines, fit.lens.zoom)[2], rtol=1e-9)


def alone_bent():
    """Lines through the centre, which tell nothing, and one that is bent: what it says is of itself."""
    t = np.linspace(-1, 1, 30)
    through = [
        np.array([319.5, 239.5]) + 200 * np.outer(t, [np.cos(a), np.sin(a)]) for a in np.linspace(0, 3, 6)
    ]
    bent = np.stack([300 * t + 319.5, 100 + 5 * t**2], axis=-1)
    return zj.Lines.from_ragged([*through, bent], [0] * 7, [50.0], image_size=(640, 480))


@pytest.mark.parametrize(
    "measure",
    [
        lambda lines: cross_validate_zoom(
            lines, zoom=zj.PolynomialZoom(degree=0), terms=1, hold_out="line", folds=7
        ),
        lambda lines: cross_validate_frames(lines, terms=1, folds=7),
    ],
    ids=["zoom", "frames"],
)
@pytest.mark.parametrize("kind", [zj.compress, lambda lines: zj.fit.in_image(zj.compress(lines))])
def test_a_line_is_not_measured_by_what_it_said_itself(measure, kind):
    """Where the others determine nothing, it is as bent as without a correction."""
    lines = kind(alone_bent())
    bent = float(zj.frame_rms(zj.compress(alone_bent()), None)[0])
    fitted = zj.fit_zoom(lines, zoom=zj.PolynomialZoom(degree=0), terms=1)
    assert fitted.rms < 0.02 * bent
    np.testing.assert_allclose(measure(lines), bent, rtol=0.02)


@pytest.mark.parametrize("zoom", [zj.PolynomialZoom(degree=2), zj.models.SmoothZoom()])
@pytest.mark.parametrize("hold_out", ["focal", "line"])
def test_in_the_image_folds_are_what_their_fits_are(zoom, hold_out):
    """The stretch of a strong lens, its derivative and the prior, in NumPy and in JAX."""
    strong = zj.scenes.nikkor_18_200()
    strong = eqx.tree_at(lambda lens: lens.zoom.parameters, strong, 3 * strong.zoom.parameters)
    seen = zj.scenes.board_lines(strong, zj.scenes.focal_sweep(5), spacing=200, noise=1.0)
    lines, model = zj.fit.in_image(zj.compress(seen)), zj.models.Model(zoom, 2)
    parts = folds_of(lines, hold_out, 3, 0)
    found, expected = errors_of(lines, model, parts), _errors_by_fits(lines, model, parts)
    np.testing.assert_allclose(found.seen, expected.seen, rtol=1e-7)
    np.testing.assert_allclose(found.unseen, expected.unseen, rtol=1e-7)


def test_lines_left_out_are_measured_by_the_fit_of_the_others(lines):
    parts = folds_of(lines, "line", 4, 0)
    judged = errors_of(lines, zj.models.Model(zj.PolynomialZoom(degree=2)), parts)
    frame = np.asarray(lines.frame)
    for fold in (0, 3):
        own = (parts.fold == fold).astype(float)
        model = zj.PolynomialZoom(degree=2).prepare(lines.focal, 2)
        fit = zj.fit_zoom(lines.weighted(1 - own), zoom=model, invertible=False)
        expected = rms_of(lines.weighted(own), fit.lens.zoom) ** 2
        found = np.bincount(frame, own * judged.unseen) / np.bincount(frame, own)
        np.testing.assert_allclose(found, expected, rtol=1e-8)


@pytest.mark.slow
def test_frames_by_themselves_are_the_fits_of_their_other_lines(lines):
    parts = folds_of(lines, "line", 5, 0)
    squares = np.zeros(len(lines.focal))
    frame = np.asarray(lines.frame)
    number = np.bincount(frame)
    for fold in range(5):
        own = (parts.fold == fold).astype(float)
        each = zj.fit_frames(lines.weighted(1 - own), terms=2, invertible=False)
        share = np.bincount(frame, own) / number
        squares += share * np.asarray(zj.frame_rms(lines.weighted(own), each.coefficients)) ** 2
    np.testing.assert_allclose(cross_validate_frames(lines, folds=5), np.sqrt(squares), rtol=1e-8)


def test_lines_without_weight_count_nothing(lines):
    weight = np.ones(len(lines.frame))
    weight[:5] = 0
    fewer = eqx.tree_at(
        lambda lines: (lines.triangle, lines.frame, lines.number),
        lines,
        (lines.triangle[5:], lines.frame[5:], None),
    )
    np.testing.assert_allclose(
        cross_validate_zoom(lines.weighted(weight)), cross_validate_zoom(fewer), rtol=1e-9, atol=0
    )


@pytest.mark.parametrize(("degree", "hold_out"), [(1, "focal"), (2, "focal"), (3, "focal"), (2, "frame")])
def test_the_true_model_is_chosen(degree, hold_out, truth):
    """Each power of 1/f moves the corner by tens of pixels, so that the true degree is beyond doubt."""
    parameters = jnp.array([[-0.05, 0.01], [0.15, -0.02], [-0.12, 0.0], [0.15, 0.0]])[: degree + 1]
    lens = dataclasses.replace(
        truth, zoom=zj.PolynomialZoom(degree, parameters, jnp.asarray(truth.focal_range[0]))
    )
    scene = scenes.board_lines(lens, scenes.focal_sweep(FOCALS), spacing=100, noise=0.3, seed=4)
    _, _, chosen = compared(zj.compress(scene), POLYNOMIALS, hold_out)
    assert chosen == f"degree {degree}, 2 terms"


def test_the_fit_is_that_of_the_chosen_model(selection, lines):
    chosen = selection.chosen
    fit = zj.fit_zoom(lines, zoom=chosen.zoom, terms=chosen.terms)
    np.testing.assert_array_equal(fit.lens.zoom.parameters, selection.fit.lens.zoom.parameters)


def test_the_simplest_within_one_standard_error_is_chosen(selection):
    best = min(selection.compared, key=lambda v: v.held_out)
    assert best.candidate is selection.best
    assert (best.difference, best.difference_std) == (0, 0)
    good = [v for v in selection.compared if v.difference <= v.difference_std]
    assert selection.chosen is min(good, key=lambda v: v.parameters).candidate


@pytest.mark.parametrize("hold_out", ["line", "focal"])
@pytest.mark.parametrize("noise", [0.0, 1e-9])
def test_of_exact_lines_the_true_model_is_chosen(truth, hold_out, noise):
    """Its fits could not become better, and were said not to converge: others of 0.06 px were chosen."""
    exact = scenes.board_lines(truth, scenes.focal_sweep(6), spacing=100.0, noise=noise)
    found = zj.select_model(zj.compress(exact), hold_out=hold_out)
    degrees = [zj.PolynomialZoom(degree) for degree in range(4)]
    staged = select_in_stages(zj.compress(exact, 3), degrees, (2, 1, 3))
    for one in (found, staged):
        assert one.chosen.name == "degree 2, 2 terms"
        assert not any(each.problem for each in one.compared)


@pytest.mark.parametrize("rule", ["one standard error", "least"])
def test_of_candidates_that_are_the_same_the_first_is_chosen(rule, truth):
    """Rounding chose among a straight line in 1/f and its two ends, from data set to data set."""
    ways = [zj.PolynomialZoom(1), zj.models.SplineZoom(2)]
    for seed in range(4):
        lines = zj.compress(
            scenes.board_lines(truth, scenes.focal_sweep(4), spacing=150.0, noise=0.1, seed=seed)
        )
        for candidates in (ways, ways[::-1]):
            found = zj.select_model(lines, candidates, hold_out="line", rule=rule)
            assert found.compared[0].candidate is found.chosen
            assert found.best is found.chosen


@pytest.mark.parametrize(("worse", "chosen"), [(1.02, (0, 1)), (1.0003, (0, 0))])
def test_least_error_is_a_rule_of_its_own(worse, chosen, lines, rng):
    """The one with fewer numbers is worse on average, though not on every focal length."""
    candidates = [zj.models.Model(zj.PolynomialZoom(degree=degree)) for degree in (0, 1)]
    parts = folds_of(lines, "focal", None, 0)
    square = np.where(parts.fold >= 0, 1.0, np.nan)
    scatter = 1 + 0.3 * (-1.0) ** parts.unit
    scatter = scatter / np.average(scatter[parts.fold >= 0], weights=shares(lines)[parts.fold >= 0])
    errors = [
        LineErrors(np.ones(len(square)), square * scatter * worse**2, 2.0, ""),
        LineErrors(np.ones(len(square)), square, 4.0, ""),
    ]
    rules = ("one standard error", "least")
    found = [compare_errors(candidates, errors, parts, rule)[1:] for rule in rules]
    assert [candidates.index(simplest) for _, simplest in found] == list(chosen)
    assert [candidates.index(best) for best, _ in found] == [1, 1]


def test_paired_errors_are_those_of_the_differences_of_two_roots(lines):
    """A first-order formula, beside the jackknife over what is left out."""
    parts = folds_of(lines, "frame", None, 0)
    a, b = POLYNOMIALS[5], POLYNOMIALS[6]
    verdict, *_ = (v for v in compared(lines, [a, b], "frame")[0] if v.difference > 0)
    frame = np.asarray(lines.frame)
    squares = [np.bincount(frame, errors_of(lines, c, parts).unseen) / np.bincount(frame) for c in (a, b)]
    leave_out = 1 - np.eye(FOCALS)
    differences = np.subtract(*(np.sqrt(leave_out @ e / (FOCALS - 1)) for e in squares))
    jackknife = np.sqrt((FOCALS - 1) * np.var(differences))
    assert verdict.difference_std == pytest.approx(jackknife, rel=0.3)


@pytest.mark.parametrize("hold_out", ["focal", "frame", "line"])
def test_the_order_of_the_frames_changes_nothing(hold_out, lines):
    order = np.random.default_rng(3).permutation(FOCALS)
    moved = eqx.tree_at(
        lambda lines: (lines.frame, lines.focal),
        lines,
        (jnp.asarray(np.argsort(order))[lines.frame], lines.focal[order]),
    )
    one, other = (compared(each, POLYNOMIALS[4:7], hold_out) for each in (lines, moved))
    assert one[2] == other[2]
    if hold_out != "line":  # which of a frame's lines go together depends on their place in the data
        for first, second in zip(one[0], other[0], strict=True):
            assert first.held_out == pytest.approx(second.held_out, rel=1e-9)
            assert first.difference_std == pytest.approx(second.difference_std, rel=1e-6, abs=1e-12)


def test_lines_that_were_not_fitted_are_less_straight(selection):
    assert all(v.held_out > v.rms for v in selection.compared)


@pytest.mark.parametrize("hold_out", ["focal", "frame", "line"])
def test_parts_hold_each_line_once_and_never_the_ends(hold_out, lines):
    parts = folds_of(lines, hold_out, 3, 0)
    out = parts.fold >= 0
    focal = np.asarray(lines.focal)[np.asarray(lines.frame)]
    ends = (focal == focal.min()) | (focal == focal.max())
    np.testing.assert_array_equal(out, ~ends if hold_out == "focal" else np.ones_like(ends))
    assert set(parts.fold[out]) == set(range(3))
    for unit in np.unique(parts.unit[out]):
        assert np.unique(parts.fold[parts.unit == unit]).size == 1


@pytest.mark.parametrize("hold_out", ["focal", "frame"])
def test_parting_does_not_depend_on_the_numbers_of_frames(hold_out, lines):
    order = np.random.default_rng(3).permutation(FOCALS)
    moved = eqx.tree_at(
        lambda lines: (lines.frame, lines.focal),
        lines,
        (jnp.asarray(np.argsort(order))[lines.frame], lines.focal[order]),
    )
    one, other = (folds_of(each, hold_out, 3, 0).fold for each in (lines, moved))
    np.testing.assert_array_equal(one, other)


def test_parting_depends_on_the_seed_alone(lines):
    one, same, other = (folds_of(lines, "line", None, seed).fold for seed in (0, 0, 1))
    np.testing.assert_array_equal(one, same)
    assert (one != other).any()


def test_the_table_can_be_read(selection):
    title, heads, *rows = str(selection).splitlines()
    assert title.startswith("RMS distance to straight lines, px; inner focal lengths left out in 5 parts")
    assert heads.split() == ["candidate", "parameters", "fitted", "held", "out", "to", "the", "best"]
    assert len(rows) == len(POLYNOMIALS)
    assert sum("best" in row for row in rows) == 1
    assert sum("chosen" in row for row in rows) == 1
    assert rows[0].startswith("degree 0, 1 term ")
    first = selection.compared[0]
    assert f"{first.held_out:.4f} ± {first.held_out_std:.4f}" in rows[0]
    ends = {row.index(f"{v.rms:.4f}") for row, v in zip(rows, selection.compared, strict=True)}
    assert len(ends) == 1


def test_the_summary_is_json(selection):
    summary = json.loads(json.dumps(selection.summary(), allow_nan=False))
    assert summary["chosen"] == selection.chosen.name
    assert len(summary["candidates"]) == len(POLYNOMIALS)


def test_a_prior_makes_parameters_fewer(lines):
    verdict, *_ = compared(lines, [zj.models.Model(zj.SmoothZoom())])[0]
    assert 4 < verdict.parameters < 14


def test_what_cannot_be_fitted_is_in_the_table_with_the_reason(lines):
    many, left, terms = (
        zj.PolynomialZoom(degree=7),
        zj.PolynomialZoom(degree=6),
        zj.models.Model(zj.PolynomialZoom(degree=1), 4),
    )
    selection = zj.select_model(lines, [many, left, terms, zj.PolynomialZoom(degree=2)])
    problems = [v.problem for v in selection.compared]
    assert "8 or more distinct focal lengths, but there are 7" in problems[0]
    assert "7 or more distinct focal lengths, but there are 6" in problems[1]
    assert "compressed for 3 terms" in problems[2]
    assert problems[3] == ""
    assert selection.chosen.zoom is selection.compared[3].candidate.zoom
    assert str(selection).count("not compared: ") == 3
    json.dumps(selection.summary(), allow_nan=False)


def test_undetermined_candidates_do_not_win():
    """Short lines near the centre of a few frames say nothing of k2 and k3, and little of k1."""
    rng = np.random.default_rng(0)
    t = np.linspace(-60, 60, 9)
    points = []
    for _ in range(5 * 3):
        angle, offset = rng.uniform(0, np.pi), rng.uniform(-20, 20)
        along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        line = t[:, None] * along + offset * across + 0.1 * rng.standard_normal((9, 2))
        points.append(line + np.array([319.5, 239.5]))
    lines = zj.Lines.from_ragged(
        points, np.repeat(np.arange(5), 3), [20, 30, 40, 60, 80], image_size=(640, 480)
    )
    figures, _, chosen = compared(zj.compress(lines, 3), default_candidates()[:12])
    assert next(v.parameters for v in figures if v.candidate.name == chosen) <= 3
    assert all(np.isfinite(v.held_out) or v.problem for v in figures)


def test_default_candidates_are_what_the_lines_serve_and_few_focal_lengths_leave_out_lines(lines):
    assert len(default_candidates()) == 13
    few = without(lines, [1, 3, 4, 5])
    few = eqx.tree_at(lambda lines: lines.triangle, few, few.triangle[:, :5, :5])
    selection = zj.select_model(few)
    assert selection.hold_out == "line"
    assert [v.candidate.terms for v in selection.compared] == [1] * 4


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"hold_out": "photo"}, '"focal", "frame" or "line"'),
        ({"folds": 1}, "at least 2"),
        ({"candidates": []}, "is empty"),
        ({"rule": "best"}, '"one standard error" or "least"'),
        ({"seed": None}, "seed must be an integer of at least 0"),
        ({"seed": -1}, "seed must be an integer of at least 0"),
        ({"candidates": [zj.PolynomialZoom(degree=9)]}, "No candidate can be compared"),
    ],
)
def test_bad_arguments_are_told(options, message, lines):
    with pytest.raises(ValueError, match=message):
        zj.select_model(lines, **options)


@pytest.mark.usefixtures("unchecked")
def test_other_types_are_told(lines):
    with pytest.raises(TypeError, match="must be Lines"):
        zj.select_model(np.zeros(3))  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match="without with_distortion_model"):
        zj.select_model(zj.fit.with_distortion_model(lines, zj.models.Division()))
    with pytest.raises(TypeError, match="zoom model"):
        zj.select_model(lines, ["quadratic"])  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match="must be a list of zoom models"):
        zj.select_model(lines, zj.PolynomialZoom())  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match="such as Division"):
        zj.models.Model(zj.PolynomialZoom(), 2, zj.models.Division)  # pyright: ignore[reportArgumentType]


def test_too_few_focal_lengths_to_leave_one_out_are_told(lines):
    few = without(lines, [1, 3, 4, 5])
    with pytest.raises(ValueError, match="4 or more distinct focal lengths"):
        zj.select_model(few, POLYNOMIALS[:1], hold_out="focal")


def test_frames_that_cannot_be_left_out_are_nan(lines):
    few = without(lines, [1, 3, 4, 5])
    assert np.isnan(cross_validate_zoom(few, zoom=zj.PolynomialZoom(degree=2))).all()
    assert np.isfinite(cross_validate_zoom(few, zoom=zj.PolynomialZoom(degree=1))).all()


@pytest.mark.slow
def test_distortion_models_are_compared(scene):
    """A lens that the division model describes, and the polynomial not so well, with one term each."""
    zoom = zj.PolynomialZoom(1, jnp.array([[0.0], [-0.25]]), jnp.asarray(20.0))
    lens = zj.ZoomLens(
        zoom, scene.centre, jnp.array([20.0, 80.0]), scene.image_size, distortion_model=zj.models.Division()
    )
    focal = np.array([20.0, 28.0, 45.0, 80.0])
    bent = scenes.board_lines(lens, focal, spacing=150, noise=0.05)
    candidates = [
        zj.models.Model(zj.PolynomialZoom(degree=1), 1, distortion_model)
        for distortion_model in (zj.models.RadialPolynomial(), zj.models.Division())
    ]
    selection = zj.select_model(bent, candidates, hold_out="line", folds=3)
    assert selection.chosen.name == "Division, degree 1, 1 term"
    assert isinstance(selection.fit.lens.distortion_model, zj.models.Division)
    assert selection.compared[0].held_out > 1.5 * selection.compared[1].held_out
    np.testing.assert_allclose(selection.fit.lens.zoom.parameters, zoom.parameters, atol=0.01)


def test_a_distortion_model_that_the_triangles_do_not_serve_says_so(lines):
    candidates = [zj.PolynomialZoom(), zj.models.Model(zj.PolynomialZoom(), 1, zj.models.Division())]
    _, figures = zj.select_model(lines, candidates, hold_out="line", folds=2).compared
    assert "compress(lines, terms=8)" in figures.problem


def without_any_weight(lines):
    return lines.weighted(np.zeros(len(lines.frame)))


def with_a_point_that_is_nan(lines):
    return eqx.tree_at(lambda lines: lines.triangle, lines, lines.triangle.at[3, 1, 1].set(np.nan))


@pytest.mark.parametrize("spoiled", [without_any_weight, with_a_point_that_is_nan])
@pytest.mark.parametrize("measure", [cross_validate_zoom, cross_validate_frames, zj.select_model])
def test_lines_that_say_nothing_are_refused(measure, spoiled, lines):
    with pytest.raises(ValueError, match="Argument lines must"):
        measure(spoiled(lines))


@pytest.mark.slow
def test_in_the_image_the_same_model_is_selected(lines):
    """With as little noise the metric makes no difference."""
    candidates = [zj.PolynomialZoom(degree=degree) for degree in (1, 2)]
    paper, image = (
        zj.select_model(of, candidates, hold_out="line", folds=3) for of in (lines, zj.fit.in_image(lines))
    )
    assert image.chosen == paper.chosen
    for one, other in zip(image.compared, paper.compared, strict=True):
        assert one.held_out == pytest.approx(other.held_out, rel=0.1)


def test_fits_of_parts_are_the_same_where_not_all_go_into_a_cache(lines, monkeypatch):
    at_once, best, chosen = compared(lines, POLYNOMIALS)
    monkeypatch.setattr("zoomjax.trust._linear_folds._TOGETHER", 2 * len(lines.frame))
    in_turn, *same = compared(lines, POLYNOMIALS)
    assert same == [best, chosen]
    for a, b in zip(at_once, in_turn, strict=True):
        np.testing.assert_allclose(
            [a.held_out, a.difference_std], [b.held_out, b.difference_std], rtol=1e-9
        )


@pytest.mark.parametrize("metric", ["corrected", "distorted"])
def test_the_pass_of_several_coefficients_is_that_of_each(lines, metric):
    measured = zj.fit.in_image(lines) if metric == "distorted" else lines
    lanes = lanes_of(measured, np.zeros(len(lines.frame), int), np.ones(len(lines.frame)), 3)
    k = np.random.default_rng(0).normal(0, 0.1, (2, 4, lanes.frames, 3))
    together = passed(lanes, k)
    for place in np.ndindex(2, 4):
        for several, one in zip(together, passed(lanes, k[place]), strict=True):
            np.testing.assert_allclose(several[place], one, rtol=1e-12, atol=1e-9 * np.abs(one).max())


def test_a_pass_for_the_gradient_alone_is_that_for_all(lines):
    lanes = lanes_of(lines, np.zeros(len(lines.frame), int), np.ones(len(lines.frame)), 3)
    k = np.random.default_rng(0).normal(0, 0.1, (lanes.frames, 3))
    whole, part = passed(lanes, k), passed_for_gradient(lanes, k)
    np.testing.assert_array_equal(part.squares, whole.squares)
    np.testing.assert_array_equal(part.gradient, whole.gradient)
    assert part.matrix is None


def test_folds_that_keep_a_matrix_end_where_others_do(lines, monkeypatch):
    kept, best, chosen = compared(lines, POLYNOMIALS)
    minimised = _linear_folds._minimised
    monkeypatch.setattr(_linear_folds, "_minimised", lambda *of, keep=False: minimised(*of))
    renewed, *same = compared(lines, POLYNOMIALS)
    assert same == [best, chosen]
    for a, b in zip(kept, renewed, strict=True):
        np.testing.assert_allclose(
            [a.held_out, a.difference_std], [b.held_out, b.difference_std], rtol=1e-9
        )


def test_a_fold_of_which_no_step_is_left_after_one_that_fails():
    """All lines are near the centre, and say so little that a kept step of the last fold fails."""
    rng, focal, along = np.random.default_rng(1), np.linspace(18, 200, 7), np.linspace(-1, 1, 20)
    points = []
    for f in np.repeat(focal, 5):
        turn, off = rng.uniform(0, np.pi), rng.uniform(-5, 5)
        c, s = np.cos(turn), np.sin(turn)
        z = np.stack([off * s + 200 * along * c, -off * c + 200 * along * s], axis=-1) / 400
        z = z * (1 + (2 / f - 0.1) * (z**2).sum(axis=1, keepdims=True))
        points.append(400 * z + [319.5, 239.5] + 0.3 * rng.standard_normal(z.shape))
    near = zj.Lines.from_ragged(points, np.repeat(np.arange(7), 5), focal, image_size=(640, 480))
    models = [Model(zj.PolynomialZoom(degree=degree), 3) for degree in range(6)]
    selection = zj.select_model(zj.compress(near, terms=3), models, hold_out="frame")
    assert all(np.isfinite(v.held_out) or v.problem for v in selection.compared)


class AboutTheLongest(zj.PolynomialZoom):
    """A child of a model, made ready otherwise, and a basis that only JAX can take."""

    def prepare(self, focal, terms):
        about = super().prepare(focal, terms)
        return AboutTheLongest(self.degree, about.parameters, jnp.asarray(np.max(focal)))

    def basis(self, focal):
        u = self.focal_ref / jnp.asarray(focal)
        return jnp.stack([jnp.where(u < 1, u**j, 0.9 * u**j) for j in range(self.degree + 1)])


class SaysSo(AboutTheLongest):
    """The same, with all settings as the key."""

    def prepared_by(self, *settings):
        return AbstractZoom.prepared_by(self, *settings)


def test_a_child_of_a_model_is_made_ready_for_each_part_by_itself(lines):
    parts = folds_of(lines, "frame", None, 0)
    models = [Model(kind(degree=1), 2) for kind in (AboutTheLongest, SaysSo, zj.PolynomialZoom)]
    child, same, parent = linear_errors(lines, models, parts)
    np.testing.assert_array_equal(child.unseen, same.unseen)
    assert np.abs(child.unseen / parent.unseen - 1).max() > 0.01


def test_lanes_for_fewer_coefficients_are_those_of_the_first(lines):
    measured = zj.fit.in_image(lines)
    of_all, own = np.zeros(len(lines.frame), int), np.ones(len(lines.frame))
    k = np.random.default_rng(0).normal(0, 0.1, (len(lines.focal), 2))
    for a, b in zip(
        passed(lanes_of(measured, of_all, own, 3).cut(2), k),
        passed(lanes_of(measured, of_all, own, 2), k),
        strict=True,
    ):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12 * np.abs(b).max())
