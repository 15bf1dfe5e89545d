"""Lines of different frames, compressed apart, are fitted as one data set."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj


def split(lines, at):
    """The frames before one and those from there on, as data sets of their own."""
    frame, points = np.asarray(lines.frame), lines.to_ragged()
    parts = []
    for frames in (range(at), range(at, lines.focal.shape[0])):
        own = np.flatnonzero(np.isin(frame, list(frames)))
        part = zj.Lines.from_ragged(
            [points[i] for i in own],
            frame[own] - frames[0],
            np.asarray(lines.focal)[list(frames)],
            image_size=lines.image_size,
            centre=lines.centre,
        )
        parts.append(part if lines.weight is None else part.weighted(np.asarray(lines.weight)[own]))
    return parts


WAYS = {
    "points": lambda lines: lines,
    "compressed": zj.compress,
    "for any centre": zj.lines.compress_any_centre,
    "of a distortion model": lambda lines: zj.fit.compress_for(lines, zj.models.Division()),
    "in the image": lambda lines: zj.fit.in_image(zj.compress(lines)),
}
SLOW = {
    "in the image, of a distortion model": lambda lines: zj.fit.in_image(
        zj.fit.compress_for(lines, zj.models.Division())
    )
}
every_way = pytest.mark.parametrize(
    "way",
    [
        *(pytest.param(way, id=name) for name, way in WAYS.items()),
        *(pytest.param(way, id=name, marks=pytest.mark.slow) for name, way in SLOW.items()),
    ],
)


@pytest.mark.slow
@every_way
def test_it_is_all_lines_at_once(way, noisy):
    lines = noisy.weighted(0.5 + np.arange(noisy.frame.shape[0]) % 3)
    whole, parts = way(lines), [way(part) for part in split(lines, 1)]
    both = zj.fit.concatenate(parts)
    assert type(both) is type(whole)
    np.testing.assert_array_equal(both.frame, whole.frame)
    np.testing.assert_array_equal(both.focal, whole.focal)
    k = np.zeros((4, 2))
    k[:, 0] = 0.05
    np.testing.assert_allclose(
        zj.fit.frame_energy(both, jnp.asarray(k)), zj.fit.frame_energy(whole, jnp.asarray(k)), rtol=1e-12
    )


@pytest.mark.parametrize("at", [1, 3])
def test_the_fit_is_that_of_all_at_once(at, noisy, fit):
    both = zj.fit.concatenate([zj.compress(part) for part in split(noisy, at)])
    again = zj.fit_zoom(both)
    np.testing.assert_allclose(again.lens.zoom.parameters, fit.lens.zoom.parameters, rtol=0, atol=1e-12)
    np.testing.assert_allclose(again.rms, fit.rms, rtol=1e-12)


def test_points_of_different_numbers_and_some_weights(noisy, ragged):
    more = zj.Lines.from_ragged(
        [points[:4] for points in ragged.to_ragged()],
        ragged.frame,
        ragged.focal,
        image_size=ragged.image_size,
    ).weighted(np.full(9, 2.0))
    both = zj.fit.concatenate([ragged, more, ragged])
    assert both.points.shape == (27, *ragged.points.shape[1:])
    assert [len(line) for line in both.to_ragged()[9:18]] == [3] + [4] * 8
    np.testing.assert_array_equal(both.weight, np.repeat([1.0, 2.0, 1.0], 9))
    np.testing.assert_array_equal(both.frame, np.concatenate([ragged.frame + 3 * i for i in range(3)]))
    assert both.number is None


def test_focus_goes_with_the_frames(ragged):
    def focused(value):
        focus = jnp.full(3, value)
        return eqx.tree_at(lambda lines: lines.focus, ragged, focus, is_leaf=lambda leaf: leaf is None)

    both = zj.fit.concatenate([focused(0.5), focused(1.0)])
    np.testing.assert_array_equal(both.focus, [0.5] * 3 + [1.0] * 3)
    with pytest.raises(ValueError, match=r"focus of parts\[0\] is given, and that of parts\[1\] is None"):
        zj.fit.concatenate([focused(0.5), ragged])


def test_under_jit(noisy, small):
    parts = [zj.compress(part) for part in split(noisy, 2)]
    both = eqx.filter_jit(zj.fit.concatenate)(parts)
    assert eqx.tree_equal(both, zj.fit.concatenate(parts))
    np.testing.assert_array_equal(both.frame, small.frame)


def test_one_is_itself(small):
    assert eqx.tree_equal(zj.fit.concatenate([small]).triangle, small.triangle)


OTHERS = {
    "image size": lambda lines: zj.compress(
        zj.Lines.from_ragged(
            lines.to_ragged(), lines.frame, lines.focal, image_size=(4400, 2900), centre=lines.centre
        )
    ),
    "unit of focal lengths": lambda lines: zj.compress(
        zj.Lines.from_ragged(
            lines.to_ragged(), lines.frame, lines.focal, image_size=lines.image_size, focal_unit="px"
        )
    ),
    "centre of distortion": lambda lines: zj.compress(lines.about(lines.centre + 1)),
    "number of terms": lambda lines: zj.compress(lines, terms=3),
}


@pytest.mark.parametrize("what", OTHERS)
def test_other_cameras_are_refused(what, noisy, small):
    with pytest.raises(ValueError, match=f"the {what} of parts"):
        zj.fit.concatenate([small, OTHERS[what](noisy)])


def test_other_kinds_are_refused(noisy, small, unchecked):
    with pytest.raises(TypeError, match=r"parts\[0\] are CompressedLines and parts\[1\] Lines"):
        zj.fit.concatenate([small, noisy])
    division, decentred = (
        zj.fit.with_distortion_model(noisy, distortion_model)
        for distortion_model in (zj.models.Division(), zj.models.BrownConrady())
    )
    with pytest.raises(ValueError, match=r"the distortion model of parts\[0\] is Division, and"):
        zj.fit.concatenate([division, decentred])
    with pytest.raises(TypeError, match=r"parts\[1\] must be Lines"):
        zj.fit.concatenate([small, "lines.npz"])
    with pytest.raises(ValueError, match="it is empty"):
        zj.fit.concatenate([])
