"""The formulas of other tools, and their fit."""

import numpy as np
import pytest

from zoomjax.interop._forms import Form

RAY = np.sin(np.linspace(0, np.pi / 2, 30)[1:])[:, None] * np.array([0.8, 0.6])


def corrected(points, k):
    t = np.sum(points**2, -1, keepdims=True)
    return points * (1 + sum(c * t ** (i + 1) for i, c in enumerate(k)))


@pytest.mark.parametrize(
    ("k", "form", "least", "most"),
    [
        ((0.03,), Form(2), 0.018, 0.022),
        ((0.1,), Form(2), 0.6, 0.68),
        ((0.1,), Form(3), 0.05, 0.065),
        ((0.25, -0.05), Form(2), 7.0, 7.6),
        ((0.25, -0.05), Form(3, 3), 0.0, 0.03),
    ],
)
def test_the_greatest_error_of_a_refit_is_the_least_there_is(k, form, least, most):
    """By an independent computation, px at 4288 x 2848."""
    end = corrected(RAY, k)
    error = form.distances(form.fit(end, RAY), end, RAY).max() * np.hypot(4288, 2848) / 2
    assert least <= error <= most


def test_a_formula_that_holds_the_points_is_found(rng):
    form = Form(2, 1, tangential=True)
    theta = np.array([0.05, -0.01, 0.02, 1e-3, -2e-3])
    points = rng.uniform(-0.7, 0.7, (300, 2))
    found = form.fit(points, form(theta, points))
    assert form.distances(found, points, form(theta, points)).max() < 1e-6


def test_coefficients_in_another_unit_are_the_same_map(rng):
    form = Form(2, 1, tangential=True)
    theta = np.array([0.05, -0.01, 0.02, 1e-3, -2e-3])
    points = rng.uniform(-0.7, 0.7, (30, 2))
    assert form(form.rescaled(theta, 3.0), points / 3) * 3 == pytest.approx(form(theta, points), abs=1e-14)
