"""A camera that turns and zooms, for tests of `fit_motion`."""

import jax.numpy as jnp

from zoomjax import PolynomialZoom, ZoomLens

SIZE, FRAMES = (1280, 720), 24


def turning_lens():
    """Barrel at the short end, with the centre some px off."""
    zoom = PolynomialZoom(2, jnp.array([[0.02, 0.0], [-0.05, 0.01], [-0.15, 0.05]]), jnp.array(800.0))
    return ZoomLens(zoom, jnp.array([645.0, 356.0]), jnp.array([800.0, 2400.0]), SIZE, "px")
