"""One table of all models, ours and a user's: each through everything that a model is used for.

A row is a zoom model or a distortion model; what it is fitted to are lines bent by a lens of that model. A
new model is one file and one entry in the registry: this table takes it from there. Models of a user's own
(`_own_models`) are in it, too.
"""

import functools
import json
from typing import NamedTuple

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.models import registry

from ._own_models import Halved, LogZoom
from ._reference import assert_derivatives_agree

SIZE = (640, 480)
CENTRE, SCALE = np.array([319.5, 239.5]), 400.0
FOCAL = np.array([20.0, 24.0, 30.0, 40.0, 57.0, 80.0])
FOCUS = np.array([0.0, 1.0, 1.0, 0.0, 0.5, 0.0])
POINTS = np.array([[3.0, 5.0], [320.0, 240.0], [500.0, 33.0], [636.0, 470.0]])
SEEN = np.array([[160.0, 150.0], [320.0, 240.0], [430.0, 320.0]])  # among the lines


class Row(NamedTuple):
    """A model: the zoom model as a user gives it to a fit, and the distortion model."""

    zoom: zj.models.AbstractZoom
    distortion: zj.models.AbstractDistortionModel = zj.models.RadialPolynomial()
    terms: int = 2


ROWS = {
    "PolynomialZoom": Row(zj.PolynomialZoom(2)),
    "TableZoom": Row(zj.models.TableZoom()),
    "SplineZoom": Row(zj.models.SplineZoom(number=4)),
    "PowerZoom": Row(zj.models.PowerZoom(), terms=1),
    "TwoRegionZoom": Row(zj.models.TwoRegionZoom(crossover=jnp.asarray(35.0))),
    "SmoothZoom": Row(zj.models.SmoothZoom()),
    "FocusSplineZoom": Row(zj.models.FocusSplineZoom(number=3)),
    "LogZoom": Row(LogZoom()),
    "RadialPolynomial": Row(zj.PolynomialZoom(1)),
    "Division": Row(zj.PolynomialZoom(1), zj.models.Division()),
    "BrownConrady": Row(zj.PolynomialZoom(1), zj.models.BrownConrady()),
    "half-polynomial": Row(zj.PolynomialZoom(1), Halved()),
}

every = pytest.mark.parametrize("name", ROWS)


def test_every_registered_model_is_in_the_table():
    """But for those that other tests register."""
    ours = {
        name
        for table in (registry._ZOOMS, registry._DISTORTION_MODELS)
        for name, cls in table.items()
        if cls.__module__.startswith(("zoomjax.", "tests._own_models"))
    }
    assert ours == set(ROWS)


def focus_of(row, frames=slice(None)):
    return (FOCUS[frames],) if isinstance(row.zoom, zj.models.AbstractFocusZoom) else ()


@functools.cache
def lens_of(name):
    """A lens of the model itself, mild and invertible, with parameters that differ."""
    row = ROWS[name]
    zoom = row.zoom.prepare(
        jnp.asarray(FOCAL), row.distortion.num_coefficients(row.terms), *map(jnp.asarray, focus_of(row))
    )
    if isinstance(zoom, zj.models.PowerZoom):
        k = jnp.array([[0.05], [-0.12], [-1.0]])
        zoom = eqx.tree_at(lambda z: z.parameters, zoom, k)
    else:
        basis = np.stack(
            [
                np.asarray(zoom.basis(*at))
                for at in zip(
                    map(jnp.asarray, FOCAL), *(map(jnp.asarray, f) for f in focus_of(row)), strict=True
                )
            ]
        )
        u = 20 / FOCAL[:, None]
        k = np.concatenate([0.05 - 0.12 * u, -0.01 + 0.02 * u], axis=1)
        if row.distortion.num_coefficients(2) == 4:
            k = np.concatenate([k, 2e-3 * u, -1e-3 * u], axis=1)
        parameters = np.linalg.lstsq(basis, k, rcond=None)[0]
        zoom = eqx.tree_at(lambda z: z.parameters, zoom, jnp.asarray(parameters))
    ends = (FOCUS.min(), FOCUS.max()) if focus_of(row) else None
    return zj.ZoomLens(
        zoom,
        jnp.asarray(CENTRE),
        jnp.asarray([20.0, 80.0]),
        SIZE,
        focus_range=None if ends is None else jnp.asarray(ends),
        distortion_model=row.distortion,
    )


def at(lens, frame):
    """The lens as it was in a frame."""
    return lens(FOCAL[frame], *(f[frame] for f in focus_of(Row(lens.zoom))))


@functools.cache
def lines_of(name, crooked=False):
    """Straight lines of all directions as the lens shows them, with noise; crooked: but for the first."""
    lens, rng = lens_of(name), np.random.default_rng(0)
    t = np.linspace(-0.5, 0.5, 15)[:, None] * SCALE
    seen, frame = [], []
    for index in range(len(FOCAL)):
        distortion = at(lens, index)
        for angle in np.pi * (np.arange(9) + rng.uniform()) / 9:
            along = np.array([np.cos(angle), np.sin(angle)])
            straight = CENTRE + t * along + rng.uniform(-30, 30) * along[::-1] * [-1, 1]
            seen.append(distortion.distort(straight) + 0.02 * rng.standard_normal((15, 2)))
            frame.append(index)
    if crooked:
        seen[0] = seen[0] + 3 * (t / SCALE) ** 2 * [1, -1]
    focus = {"focus": FOCUS} if focus_of(ROWS[name]) else {}
    return zj.Lines.from_ragged(seen, frame, FOCAL, image_size=SIZE, **focus)


@functools.cache
def ready(name, crooked=False):
    """The lines, compressed in the distortion model."""
    return zj.fit.compress_for(lines_of(name, crooked), ROWS[name].distortion, terms=ROWS[name].terms)


@functools.cache
def fit_of(name):
    return zj.fit_zoom(ready(name), zoom=ROWS[name].zoom, terms=ROWS[name].terms)


# The model as a function


@every
def test_shapes(name):
    lens = lens_of(name)
    size = ROWS[name].distortion.num_coefficients(ROWS[name].terms)
    assert at(lens, 1).coefficients.shape == (size,)
    focus = focus_of(ROWS[name])
    assert lens(FOCAL, *focus).coefficients.shape == (len(FOCAL), size)
    np.testing.assert_array_equal(
        lens(FOCAL, *focus).coefficients[3], jnp.asarray(at(lens, 3).coefficients)
    )


@every
def test_round_trip(name):
    for frame in range(len(FOCAL)):
        distortion = at(lens_of(name), frame)
        corrected = distortion.undistort(POINTS)
        assert np.abs(corrected - POINTS).max() > 0.5
        np.testing.assert_allclose(distortion.distort(corrected), POINTS, atol=1e-9)


@every
def test_derivatives_by_focal_length_and_parameters(name):
    lens = lens_of(name)
    focus = [f[1] for f in focus_of(ROWS[name])]
    values, rebuilt = jax.flatten_util.ravel_pytree(lens.zoom.parameters)

    def undistorted(numbers):
        moved = eqx.tree_at(lambda lens: lens.zoom.parameters, lens, rebuilt(numbers[1:] * 0.01))
        return moved(25 + numbers[0], *focus).undistort(jnp.asarray(POINTS)).ravel()

    start = jnp.concatenate([jnp.zeros(1), values / 0.01])
    assert_derivatives_agree(undistorted, start, step=1e-4, rtol=1e-5)


@every
def test_certificate(name):
    """Mild lenses are certified; strongly bent ones never."""
    lens = lens_of(name)
    certificate = zj.models.certify(lens)
    assert not certificate.folded
    assert certificate.certified or zj.models.AbstractZoom.pieces is type(lens.zoom).pieces
    k = lens.zoom.parameters
    bent = eqx.tree_at(lambda lens: lens.zoom.parameters, lens, jax.tree.map(lambda k: 40 * k, k))
    assert not zj.models.certify(bent).certified


# What is fitted


@pytest.mark.slow
@every
def test_fit_and_covariance(name):
    """The lens that bent the lines comes back, within 4 of its standard deviations; 0.02 px are noise."""
    fit, lens = fit_of(name), lens_of(name)
    assert fit.rms < 0.023
    for frame in range(len(FOCAL)):
        ours, true = (at(of, frame).undistort(SEEN) for of in (fit.lens, lens))
        np.testing.assert_allclose(
            ours, true, atol=0.6 if name == "SmoothZoom" else 0.25
        )  # its prior is of real lenses
    covariance = np.asarray(fit.covariance)
    numbers, true = (jax.flatten_util.ravel_pytree(of.zoom.parameters)[0] for of in (fit.lens, lens))
    assert covariance.shape == (numbers.size, numbers.size)
    known = np.isfinite(np.diag(covariance))
    assert known.any()
    known_part = covariance[np.ix_(known, known)]
    scale = np.sqrt(np.outer(np.diag(known_part), np.diag(known_part)))
    np.testing.assert_allclose(known_part / scale, known_part.T / scale, atol=1e-9)
    assert (np.linalg.eigvalsh(known_part / scale) > -1e-9).all()
    assert (np.abs(numbers - true)[known] < 4 * np.sqrt(np.diag(known_part)) + 1e-9).all()


@pytest.mark.slow
@every
def test_robust_fit(name):
    """The crooked line is rejected, and no other is missed by much."""
    robust = zj.fit_robust(ready(name, True), zoom=ROWS[name].zoom, terms=ROWS[name].terms)
    weights = np.asarray(robust.weight)
    assert weights[0] < 0.05
    assert np.mean(weights > 0.5) > 0.85
    difference = at(robust.fit.lens, 0).undistort(SEEN) - at(lens_of(name), 0).undistort(SEEN)
    assert np.abs(difference).max() < 0.3


@pytest.mark.slow
@every
def test_cross_validation(name):
    """Lines left out are straight too, and less so than those fitted."""
    row = ROWS[name]
    candidate = zj.models.Model(row.zoom, row.terms, row.distortion)
    if name == "FocusSplineZoom":
        focal = zj.trust.cross_validate_zoom(zj.compress(lines_of(name)), zoom=row.zoom)
        assert np.nanmax(focal) < 1
        return
    chosen = zj.select_model(lines_of(name), candidates=[candidate], hold_out="line", folds=3)
    (figures,) = chosen.compared
    assert not figures.problem
    assert figures.rms < figures.held_out < 0.05


# Files and images


@every
def test_save_and_load(name, tmp_path):
    path = tmp_path / "lens.json"
    lens_of(name).save(path)
    again = zj.load_lens(path)
    for frame in range(len(FOCAL)):
        np.testing.assert_array_equal(
            at(again, frame).undistort(POINTS), at(lens_of(name), frame).undistort(POINTS)
        )


@every
def test_damaged_files_are_refused_or_harmless(name, tmp_path):
    """Each entry of the file in turn missing, or of another kind: a ValueError that names the file."""
    path = tmp_path / "lens.json"
    lens_of(name).save(path)
    content = json.loads(path.read_text())
    places = [(content, key) for key in content] + [(content["zoom"], key) for key in content["zoom"]]
    for holder, key in places:
        kept = holder[key]
        for wrong in ("x", None, [], -1, [[float("nan")]], {"a": 1}):
            holder[key] = wrong
            path.write_text(json.dumps(content))
            try:
                lens = zj.load_lens(path)
            except ValueError as error:
                assert "lens.json" in str(error)  # noqa: PT017
            else:  # what users' own models do not look at is theirs
                assert name == "LogZoom" or np.isfinite(at(lens, 1).coefficients).all()
        holder[key] = kept


@pytest.mark.slow
@every
def test_image_correction(name):
    """A pixel of the corrected image shows what is where its centre is distorted to."""
    distortion = at(lens_of(name), 0)
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    image = np.stack([x, y], axis=-1).astype(np.float32)
    corrected = zj.undistort_image(image, distortion)
    inside = np.stack([x, y], axis=-1)[200:280:20, 250:400:30].astype(float)
    np.testing.assert_allclose(corrected[200:280:20, 250:400:30], distortion.distort(inside), atol=0.02)
