"""Data sets of other sizes share compiled programs, and padding changes no result."""

import dataclasses
import functools
import os
import resource
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import zoomjax as zj
from tests.conftest import MOST_MAPS
from zoomjax import scenes
from zoomjax._core.programs import use_once
from zoomjax.fit import (
    algebraic_frames,
    algebraic_zoom,
    compress_for,
    fit_centre,
    fit_focal,
    fit_frame_centres,
    frame_energy,
    global_energy,
    in_image,
    with_focal_sigma,
)
from zoomjax.lines import compress_any_centre
from zoomjax.lines.buckets import bucket, bucketed
from zoomjax.models import BrownConrady, Division, Model, SmoothZoom, SplineZoom, TableZoom
from zoomjax.trust import assess, cross_validate_frames, cross_validate_zoom, suggest_next, with_misfit


def scene(frames: int, lines: int, points: int, seed: int = 0) -> zj.Lines:
    """Lines that a Nikkor 18-200 bends: some more in every third frame, some longer ones."""
    rng = np.random.default_rng(seed)
    lens, focal = scenes.nikkor_18_200(), scenes.focal_sweep(frames)
    width, height = lens.image_size
    bent, frame = [], []
    for index, f in enumerate(focal):
        for line in range(lines + index % 3):
            ends = rng.uniform(0, (width, height), (2, 2))
            along = np.linspace(0, 1, points + line % 4)[:, None]
            straight = ends[0] + along * (ends[1] - ends[0])
            bent.append(np.asarray(lens(f).distort(straight)) + 0.2 * rng.standard_normal(straight.shape))
            frame.append(index)
    inside = [np.clip(line, 0, (width - 1, height - 1)) for line in bent]
    return zj.Lines.from_ragged(inside, frame, focal, image_size=(width, height))


LINES = scene(7, 9, 30)
SIZES = ((64, 256), (8,), (32, 64, 128))


@given(st.integers(1, 200_000), st.sampled_from(SIZES))
def test_a_size_holds_what_is_there_and_is_not_much_larger(number, sizes):
    size = bucket(number, sizes)
    assert number <= size == bucket(size, sizes)
    assert size in sizes or size <= 1.25 * number
    assert size <= bucket(number + 1, sizes)


def test_there_are_few_sizes():
    sizes = {bucket(number, (64, 256, 1024)) for number in range(1, 10_000)}
    assert len(sizes) == 3 + 4 * 3 + 1  # the last holds 10,240


def test_padding_repeats_no_line_and_no_frame():
    padded = bucketed(LINES)
    assert padded.points.shape == (256, 64, 2)
    assert padded.focal.shape == (8,)
    number = len(LINES.frame)
    assert not padded.mask[number:].any()
    assert not padded.weight[number:].any()
    assert padded.weight[:number].all()
    np.testing.assert_array_equal(padded.focal[7:], LINES.focal[-1])


@pytest.mark.slow
def test_commands_have_fewer_sizes():
    small = zj.compress(LINES)
    use_once()
    assert {len(bucketed(scene(5, lines, 4)).frame) for lines in (2, 60, 250, 400)} == {256, 2048}
    other = zj.fit_zoom(small, terms=1)
    use_once(False)
    assert_same(other.lens, zj.fit_zoom(small, terms=1).lens, 1e-12)


def test_millions_of_points_are_not_copied():
    many = 2**21 + 1
    points, mask = np.zeros((1, many, 2)), np.ones((1, many), bool)
    lines = zj.Lines(points, mask, np.zeros(1, int), np.ones(1), np.zeros(2), (4, 4))
    assert bucketed(lines) is lines


def test_lines_inside_of_jit_are_left_alone():
    same = []
    jax.eval_shape(lambda lines: same.append(bucketed(lines) is lines), LINES)
    assert same == [True]


def weighted(lines):
    rng = np.random.default_rng(1)
    return lines.weighted(rng.uniform(0.5, 2, lines.frame.shape) * (rng.random(lines.frame.shape) > 0.1))


FORMS = {
    "points": lambda: LINES,
    "compressed": lambda: zj.compress(LINES),
    "weighted": lambda: weighted(zj.compress(LINES)),
    "any centre": lambda: compress_any_centre(LINES),
    "in the image": lambda: in_image(zj.compress(LINES)),
    "division": lambda: compress_for(LINES, Division(), terms=1),
    "Brown-Conrady": lambda: compress_for(LINES, BrownConrady()),
}
ZOOMS = {
    "polynomial": zj.PolynomialZoom(degree=2),
    "table": TableZoom(number=4),
    "spline": SplineZoom(number=4),
    "smooth": SmoothZoom(),
}


def assert_same(padded, plain, tolerance=1e-9):
    for own, other in zip(jax.tree.leaves(padded), jax.tree.leaves(plain), strict=True):
        own, other = np.asarray(own), np.asarray(other)
        assert own.shape == other.shape
        size = np.max(np.abs(other), initial=1e-300, where=np.isfinite(other)) if other.size else 1
        np.testing.assert_allclose(own, other, rtol=0, atol=tolerance * size)


def without_steps(fit):
    """A fit without the number of steps, and of its certificate the bound: its place may be another."""
    fit = eqx.tree_at(lambda fit: fit.certificate, fit, fit.certificate.least)
    return eqx.tree_at(lambda fit: fit.steps, fit, 0) if hasattr(fit, "steps") else fit


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
def test_fits_are_those_of_the_lines_alone(form):
    """Inside ``jit`` nothing is padded."""
    lines, zoom = FORMS[form](), zj.PolynomialZoom(degree=1)
    fit = functools.partial(zj.fit_zoom, zoom=zoom, terms=1, invertible=False)
    own, plain = without_steps(fit(lines)), without_steps(eqx.filter_jit(fit)(lines))
    assert own.frame_rms.shape == (7,)
    assert_same(own, plain, 1e-8)
    k = jax.numpy.full((7, 3 if form == "Brown-Conrady" else 1), 0.01)
    assert_same(frame_energy(lines, k), eqx.filter_jit(frame_energy)(lines, k), 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("form", ["compressed", "weighted"])
def test_fits_of_frames_are_those_of_the_lines_alone(form):
    lines = FORMS[form]()
    fit = functools.partial(zj.fit_frames, terms=1, invertible=False)
    own, plain = without_steps(fit(lines)), without_steps(eqx.filter_jit(fit)(lines))
    assert own.frame_rms.shape == (7,)
    assert_same(own, plain, 1e-8)


@pytest.mark.parametrize("zoom", ZOOMS)
def test_zoom_models_are_made_ready_for_the_frames_there_are(zoom):
    lines, model = zj.compress(LINES), Model(ZOOMS[zoom])
    own = zj.fit_zoom(lines, zoom=model)
    ready = own.lens.zoom.prepare(np.asarray(lines.focal), 2)
    for leaf, other in zip(jax.tree.leaves(own.lens.zoom), jax.tree.leaves(ready), strict=True):
        assert np.shape(leaf) == np.shape(other)
    again = zj.fit_zoom(bucketed(lines), zoom=own.lens.zoom)
    assert_same(own.lens, again.lens, 1e-7)


@pytest.mark.slow
def test_robust_fits_and_centres_are_those_of_the_lines_alone():
    lines = weighted(zj.compress(LINES))
    robust = zj.fit_robust(lines)
    plain = eqx.filter_jit(zj.fit_robust)(lines)
    assert robust.weight.shape == robust.line_rms.shape == lines.frame.shape
    assert_same((robust.weight, robust.line_rms), (plain.weight, plain.line_rms), 1e-7)
    held = compress_any_centre(LINES)
    found = fit_centre(held)
    assert found.std.shape == found.centre.shape == (7, 2)
    other = eqx.filter_jit(lambda held: fit_centre(held).centre)(held)
    assert_same(found.centre, other, 1e-7)
    each = fit_frame_centres(held, terms=1)
    assert each.std.shape == (7, 2)
    assert each.each.certificate.least.shape == each.determined.shape == (7,)


def everything(frames: int, lines: int, points: int) -> None:
    """What a calibration does with lines."""
    given = scene(frames, lines, points, seed=frames)
    small, held = zj.compress(given), compress_any_centre(given)
    fit = zj.fit_zoom(small)
    each = zj.fit_frames(small)
    zj.fit_robust(small)
    zj.fit_zoom(weighted(small), zoom=TableZoom(number=3))
    zj.fit_zoom(in_image(small), zoom=SmoothZoom())
    zj.fit_zoom(small, zoom=SmoothZoom())  # which is chosen below for some of the sets
    zj.fit_zoom(compress_for(given, Division(), terms=1))
    algebraic_zoom(small)
    algebraic_frames(small)
    zj.frame_rms(small, fit.lens)
    zj.frame_rms(small, each.coefficients)
    fit_centre(held)
    fit_frame_centres(held)
    held.about(held.centre + 1)
    zj.select_model(small)
    cross_validate_zoom(small)
    cross_validate_frames(small)
    with_misfit(fit, small)
    with_focal_sigma(fit, small, focal_sigma=0.3)
    fit_focal(small, 0.3)
    assess(given, fit)
    suggest_next(fit, small)
    zj.displacement_std(fit, np.zeros((3, 2)), focal=30.0)


@pytest.mark.slow
def test_other_sizes_compile_nothing(compilations):
    everything(9, 9, 30)
    assert compilations() > 20
    everything(12, 14, 23)
    everything(17, 5, 31)
    assert compilations() == 0


@pytest.mark.slow
def test_judging_longer_lines_compiles_nothing(compilations):
    """Numbers of points that other programs are compiled for."""
    judged = []
    for sizes in ((9, 9, 70), (17, 12, 250)):
        given = scene(*sizes)
        small = zj.compress(given)
        judged.append((given, zj.fit_zoom(small), small))
    assert len({bucketed(given).points.shape for given, *_ in judged}) == 2
    compilations()
    for number, (given, fit, small) in enumerate(judged):
        assess(given, fit, compressed=small)
        assert (compilations() > 0) == (number == 0)


def test_other_lines_and_frames_compile_nothing(compilations):
    fit = functools.partial(zj.fit_zoom, zoom=zj.PolynomialZoom(degree=0), terms=1)
    other = scene(5, 14, 33)
    compilations()
    fit(zj.compress(LINES))
    assert compilations() > 1
    fit(zj.compress(other))
    assert compilations() == 0


@pytest.mark.parametrize("number", [1, 6, 8])
def test_rows_of_other_frames_are_refused_before_they_are_padded(number, unchecked):
    lines = zj.compress(LINES)
    for function in (frame_energy, global_energy, lambda lines, k: zj.frame_rms(lines, k)):
        with pytest.raises(ValueError, match="a row for each of the 7 frames"):
            function(lines, jax.numpy.zeros((number, 2)))


def _used() -> tuple[int, int]:
    """Memory maps of this process, and the most memory that it has had, KiB."""
    maps = len(Path("/proc/self/maps").read_text().splitlines())
    return maps, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/proc/self/maps"), reason="Memory maps are counted on Linux.")
def test_three_thousand_sizes_fit_into_one_process():
    """Counted over 300, after the first 20, and extrapolated."""
    rng = np.random.default_rng(3)
    whole = zj.compress(scene(20, 12, 20))
    frame = np.asarray(whole.frame)
    for number in range(320):
        frames = int(rng.integers(3, 21))
        kept = rng.permutation(np.flatnonzero(frame < frames))[: int(rng.integers(30, 250))]
        own = {name: np.asarray(getattr(whole, name))[np.sort(kept)] for name in ("triangle", "frame")}
        lines = dataclasses.replace(whole, **own, number=None, focal=np.asarray(whole.focal)[:frames])
        zj.fit_zoom(lines, throw=False)
        if number == 19:
            before = _used()
    maps, memory = (now - then for now, then in zip(_used(), before, strict=True))
    assert 10 * maps < MOST_MAPS / 2
    assert 10 * memory < 2**20  # KiB: a GiB for 3,000
