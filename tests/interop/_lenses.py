"""Lenses of all kinds, from +6 % to -2 % at the corner, in images of several shapes."""

import numpy as np

from zoomjax import PolynomialZoom, ZoomLens
from zoomjax.models import BrownConrady, Division, PowerZoom, SplineZoom

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


def spline():
    inverse = 1 / np.geomspace(200.0, 18.0, 5)
    u = 18 * inverse[:, None]
    zoom = SplineZoom(parameters=np.hstack([u**j for j in range(3)]) @ STRONG, knots=inverse)
    return ZoomLens(zoom, np.array([325.0, 236.0]), np.array([18.0, 200.0]), (640, 480))


def power():
    parameters = np.array([[0.0, 0.06, -1.2], [0.0, -0.01, -1.0]])
    zoom = PowerZoom(parameters=parameters, focal_ref=np.array(18.0))
    return ZoomLens(zoom, np.array([325.0, 236.0]), np.array([18.0, 200.0]), (640, 480))


LENSES = {
    "landscape": lambda: polynomial(STRONG, (640, 480), (325.0, 236.0)),
    "portrait": lambda: polynomial(STRONG, (427, 641), (209.5, 325.25)),
    "wide, three terms": lambda: polynomial(
        np.hstack([STRONG, [[0.001], [-0.003], [0.0]]]), (960, 540), (479.5, 269.5)
    ),
    "px": in_pixels,
    "division": lambda: polynomial([[0.02], [-0.07]], (640, 480), (325.0, 236.0), family=Division()),
    "decentred": lambda: polynomial(
        [[-0.02, 0.001, 3e-4, -5e-4], [0.07, -0.01, 1e-4, 2e-4]],
        (640, 480),
        (325.0, 236.0),
        family=BrownConrady(),
    ),
}
