"""Derivatives of fits that leave something undetermined: what is not determined does not move."""

import jax
import jax.numpy as jnp
import numpy as np

from zoomjax import Lines, PolynomialZoom, compress, fit_frames, fit_zoom

T = np.linspace(0.0, 479.0, 12)
POINTS = np.stack(
    [
        np.stack([x + 200 / f * (x / 320 - 1) * (T / 240 - 1) ** 2, T], axis=-1)
        for f in (24, 50)
        for x in (20, 128, 236, 510)
    ]
)
FRAME = np.repeat(np.arange(2), 4).astype(np.int32)
FIRST = FRAME == 0
THROUGH_CENTRE = np.stack([np.linspace(0.0, 639.0, 12), np.full(12, 239.5)], axis=-1)
NO_WEIGHT = np.where(FIRST, 1.0, 0.0)


def slope_of(fit, points=POINTS, *, chosen=slice(None), focal=(24.0, 50.0), weight=None):
    """The gradient by the points of the sum of the first frame's coefficients in a fit of their lines."""

    def total(points):
        lines = Lines(
            points=points,
            mask=np.ones(points.shape[:2], bool),
            frame=FRAME[chosen],
            focal=np.array(focal),
            centre=np.array([319.5, 239.5]),
            image_size=(640, 480),
            weight=weight,
        )
        return jnp.sum(fit(compress(lines)))

    return np.asarray(jax.grad(total)(jnp.asarray(points)[chosen]))


def of_first_frame(lines):
    return fit_frames(lines, invertible=False, throw=False).coefficients[0]


def of_lens(lines):
    return fit_zoom(lines, zoom=PolynomialZoom(degree=1), invertible=False, throw=False).lens.zoom(24.0)


def test_undetermined_parameters_do_not_move():
    alone = slope_of(of_first_frame, chosen=FIRST, focal=(24.0,))
    assert np.abs(alone).max() > 1e-6
    straight = np.where(FIRST[:, None, None], POINTS, THROUGH_CENTRE)
    for slope in (
        slope_of(of_first_frame, weight=NO_WEIGHT),
        slope_of(of_first_frame, straight),
        slope_of(of_lens, weight=NO_WEIGHT),
    ):
        np.testing.assert_allclose(slope[FIRST], alone, rtol=1e-5, atol=1e-9)
        assert np.abs(slope[~FIRST]).max() < 1e-9
