"""Widths of pixels: those of all cameras pass, and those in another unit do not."""

import jax.numpy as jnp
import numpy as np
import pytest

from zoomjax._core.pixels import check_pitch, pitch_problem

REAL = {
    "endoscope": (0.00175, (200, 200)),
    "phone": (0.00056, (16320, 12240)),
    "its photo at a quarter": (0.00224, (4080, 3060)),
    "APS-C": (0.0039, (6000, 4000)),
    "film format": (0.006, (6016, 4016)),
    "a thumbnail of it": (0.225, (160, 120)),
    "broadcast": (0.005, (1920, 1080)),
    "heat": (0.017, (640, 512)),
    "telescope": (0.01, (45000, 45000)),
    "plate": (0.0254, (10000, 8000)),
}


@pytest.mark.parametrize("name", REAL)
def test_widths_of_real_pixels_pass(name):
    pitch, size = REAL[name]
    assert pitch_problem(pitch, size) is None
    assert pitch_problem(pitch) is None


@pytest.mark.parametrize("unit", [1e3, 1e-3], ids=["in µm", "in m"])
@pytest.mark.parametrize("name", [name for name in REAL if "thumbnail" not in name])
def test_other_units_are_refused(name, unit):
    pitch, size = REAL[name]
    with pytest.raises(ValueError, match=r"must be the width of a pixel.* which there are not"):
        check_pitch(pitch * unit, size)
    with pytest.raises(ValueError, match=r"3\.9 µm are 0\.0039"):
        check_pitch(pitch * unit)


@pytest.mark.parametrize("value", [jnp.array([0.004, 3.9]), np.array([0.004, 3.9]), np.nan, np.inf, -1.0])
def test_one_bad_value_is_enough(value):
    with pytest.raises(ValueError, match="pixel_pitch"):
        check_pitch(value)


def test_nothing_known_is_nothing_wrong():
    assert pitch_problem(None) is None
    assert pitch_problem(None, (640, 480)) is None
