"""The derivatives by which `fit_motion` steps, beside those of automatic differentiation."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from zoomjax import PolynomialZoom, ZoomLens
from zoomjax.fit._columns import columns
from zoomjax.fit._motion_levers import guessed_levers
from zoomjax.fit._motion_model import Model, Noise, Speed, speed_of, units_of
from zoomjax.fit._motion_parallax import Spread
from zoomjax.fit._motion_problem import Asked, Given, problem_of
from zoomjax.fit._motion_rows import averaged, columns_of, rows_of
from zoomjax.fit._motion_stages import STAGES
from zoomjax.fit._motion_start import Path
from zoomjax.models import BrownConrady, Division, RadialPolynomial
from zoomjax.models.zoom import with_parameters
from zoomjax.scenes import motion_lines, motion_tracks, pan_and_zoom

FRAMES = 9


@pytest.fixture(scope="module")
def scene():
    """Tracks and lines of a lens in px, and its path."""
    zoom = PolynomialZoom(2, jnp.array([[0.02, 0.0], [-0.05, 0.01], [-0.15, 0.05]]), jnp.array(800.0))
    lens = ZoomLens(zoom, jnp.array([645.0, 356.0]), jnp.array([800.0, 2400.0]), (1280, 720), "px")
    path = pan_and_zoom(lens, FRAMES, pan=20, tilt=5, seed=1)
    tracks = motion_tracks(lens, *path, views=12, life=5, noise=0.5, seed=1).tracks
    return path, tracks, motion_lines(lens, path[0], noise=0.5)


def made(
    scene, zoom, distortion_model, terms, shift, *, levers=False, with_lines=False, with_weights=False
):
    """What rows are made of: a model at random, near the path."""
    (focal, rotation), tracks, lines = scene
    if with_weights:
        weight = np.random.default_rng(4).uniform(0.1, 3, tracks.mask.shape)
        tracks = dataclasses.replace(tracks, weight=weight)
    given = Given(tracks, lines if with_lines else None, None, None, None)
    data = problem_of(given, Asked(zoom, distortion_model, terms, shift, None)).data
    rng, more = np.random.default_rng(3), len(data.log_focal) - FRAMES
    focal = np.pad(np.asarray(focal), (0, more), mode="edge")
    rotation = np.pad(np.asarray(rotation), ((0, more), (0, 0), (0, 0)), mode="edge")
    rays = jnp.tile(jnp.array([[0.0, 0.0, 1.0]]), (data.structure.tracks, 1))
    path = Path(jnp.log(focal), jnp.asarray(rotation), rays)

    def at_random(model, size):
        ready = model.prepare(focal, size)
        return with_parameters(ready, 0.02 * rng.normal(size=ready.parameters.shape))

    model = Model(
        path,
        at_random(zoom, distortion_model.num_coefficients(terms)),
        None if shift is None else at_random(shift, 2),
        jnp.asarray(0.3),
        Speed(jnp.zeros((len(focal), 4)), jnp.zeros((len(focal), 4))),
        distortion_model,
        guessed_levers(Spread(jnp.asarray(1e-3), jnp.asarray(0.5)), data.structure.tracks)
        if levers
        else None,
    )
    seen = averaged(data, model)
    path = path._replace(rays=seen)
    model = Model(
        path,
        model.zoom,
        model.shift,
        model.readout,
        speed_of(path, data.neighbours),
        distortion_model,
        model.levers,
    )
    noise = Noise(jnp.asarray(2.0), jnp.asarray(3.0), jnp.asarray(1.5))
    units = units_of(data, model, noise)
    unknowns = jax.tree.map(lambda unit: 0.3 * jnp.asarray(rng.normal(size=unit.shape)), units)
    return (data, model, noise, STAGES[1]), unknowns


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"shift": None},
        {"levers": True},
        {"with_lines": True},
        {"with_weights": True, "levers": True},
        {"distortion_model": Division(), "terms": 1},
        {"distortion_model": BrownConrady(), "zoom": PolynomialZoom(1)},
    ],
    ids=["default", "centred", "levers", "lines", "weights", "division", "Brown-Conrady"],
)
def test_columns_are_those_of_automatic_differentiation(scene, options):
    default = {"zoom": PolynomialZoom(2), "distortion_model": RadialPolynomial(), "terms": 2}
    args, unknowns = made(scene, **{"shift": PolynomialZoom(1)} | default | options)
    found = columns_of(args, unknowns)
    expected = columns(jax.linearize(lambda x: rows_of(x, args), unknowns)[1], unknowns)
    views = np.arange(len(args[0].points))
    pairs = [(of.of_views(views), of[1:]) for of in (found, expected)]
    for one, other in zip(*(jax.tree.leaves(of) for of in pairs), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-10 * abs(other).max(initial=0))
    assert abs(pairs[0][0]).max() > 0.1
