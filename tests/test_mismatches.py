"""Things that do not belong together are refused, not combined into nonsense."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj


@pytest.mark.parametrize("field", ["focal", "centre"])
def test_triangles_of_other_scenes_do_not_merge(small, field):
    other = eqx.tree_at(lambda lines: getattr(lines, field), small, getattr(small, field) + 1)
    with pytest.raises(ValueError, match="same lines"):
        zj.lines.merge(small, other)


def test_coefficients_must_be_those_of_all_frames(small):
    with pytest.raises(ValueError, match="a row for each of the 4 frames"):
        zj.frame_rms(small, jnp.zeros((3, 2)))


def test_a_lens_in_millimetres_is_not_asked_for_pixels(noisy, fit):
    pixels = zj.Lines.from_ragged(
        noisy.to_ragged(),
        noisy.frame,
        np.asarray(noisy.focal) * 180,
        image_size=noisy.image_size,
        focal_unit="px",
    )
    with pytest.raises(ValueError, match="in mm"):
        zj.frame_rms(pixels, fit.lens)
