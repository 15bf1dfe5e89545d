"""Lenses of all kinds, from +6 % to -2 % at the corner, in images of several shapes."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from zoomjax import PolynomialZoom, ZoomLens
from zoomjax.models import BrownConrady, Division, PowerZoom, SmoothZoom, SplineZoom
from zoomjax.models.zoom import with_parameters

STRONG = np.array([[-0.022, 0.002], [0.095, -0.015], [-0.006, 0.0]])
PITCH = 0.0367


def polynomial(rows, size, centre, **more):
    zoom = PolynomialZoom(len(rows) - 1, np.array(rows), np.array(18.0))
    return ZoomLens(zoom, np.array(centre), np.array([18.0, 200.0]), size, **more)


def in_pixels():
    factor = 1 / PITCH
    zoom = PolynomialZoom(2, STRONG, np.array(18 * factor))
    return ZoomLens(
        zoom, np.array([330.0, 231.0]), np.array([18.0, 200.0]) * factor, (641, 479), focal_unit="px"
    )


def fitted(zoom):
    """A zoom model that is linear in its parameters, with those that are nearest to `STRONG`."""
    focal = np.geomspace(18.0, 200.0, 9)
    zoom = zoom.prepare(jnp.asarray(focal), 2)
    basis = np.stack([zoom.basis(f) for f in focal])
    wanted = (18 / focal[:, None]) ** np.arange(3) @ STRONG
    return with_parameters(zoom, jnp.asarray(np.linalg.lstsq(basis, wanted, rcond=None)[0]))


def of_zoom(zoom, **more):
    return ZoomLens(zoom, np.array([325.0, 236.0]), np.array([18.0, 200.0]), (640, 480), **more)


def power():
    parameters = np.array([[-0.02, 0.002], [0.085, -0.014], [-1.2, -2.0]])
    return of_zoom(PowerZoom(parameters=parameters, focal_ref=np.array(18.0)))


def moving(lens, by=(0.03, -0.015)):
    """The lens with a centre that moves by so much along the zoom, in half diagonals."""
    rows = np.array([[0.0, 0.0], by])
    focal = np.asarray(lens.focal_range)[0]
    return dataclasses.replace(lens, shift=PolynomialZoom(1, rows, np.array(focal)))


LENSES = {
    "landscape": lambda: polynomial(STRONG, (640, 480), (325.0, 236.0)),
    "portrait": lambda: polynomial(STRONG, (427, 641), (209.5, 325.25)),
    "wide, three terms": lambda: polynomial(
        np.hstack([STRONG, [[0.001], [-0.003], [0.0]]]), (960, 540), (479.5, 269.5)
    ),
    "px": in_pixels,
    "division": lambda: polynomial(
        [[0.02], [-0.07]], (640, 480), (325.0, 236.0), distortion_model=Division()
    ),
    "decentred": lambda: polynomial(
        [[-0.02, 0.001, 3e-4, -5e-4], [0.07, -0.01, 1e-4, 2e-4]],
        (640, 480),
        (325.0, 236.0),
        distortion_model=BrownConrady(),
    ),
    "smooth": lambda: of_zoom(fitted(SmoothZoom())),
    "spline": lambda: of_zoom(fitted(SplineZoom(number=5))),
    "power": power,
    "moving centre": lambda: moving(LENSES["landscape"]()),
    "moving centre, portrait, three terms": lambda: moving(
        polynomial(np.hstack([STRONG, [[0.001], [-0.003], [0.0]]]), (427, 641), (209.5, 325.25))
    ),
    "moving centre, decentred": lambda: moving(LENSES["decentred"]()),
}
