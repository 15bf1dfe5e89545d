import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj

from .._reference import assert_derivatives_agree, image_grid

FOCAL = 50.0


@pytest.fixture(scope="module")
def camera(truth):
    return zj.models.Camera(truth, principal=truth.centre + np.array([3.0, -2.0]), pixel_pitch=0.006)


@pytest.fixture(scope="module")
def pixels(truth):
    return image_grid(truth.image_size, 7)


def test_rays_are_the_formula(camera, pixels, truth):
    rays, known = camera.rays(pixels, FOCAL)
    corrected = truth(FOCAL).undistort(pixels)
    expected = (corrected - np.asarray(camera.principal)) / (FOCAL / 0.006)
    assert isinstance(rays, np.ndarray)
    assert known.all()
    np.testing.assert_allclose(rays[:, :2], expected, rtol=1e-12)
    np.testing.assert_array_equal(rays[:, 2], 1)


@pytest.mark.parametrize("kind", [np.asarray, jnp.asarray], ids=["NumPy", "JAX"])
def test_projection_inverts_rays_at_any_depth_and_focal_length(camera, pixels, kind, rng):
    focal = rng.uniform(*np.asarray(camera.lens.focal_range), len(pixels))
    rays, _ = camera.rays(kind(pixels), kind(focal))
    depth = kind(rng.uniform(0.1, 100, (len(pixels), 1)))
    back, seen = camera.project(depth * rays, kind(focal))
    assert isinstance(back, type(kind(pixels)))
    assert seen.all()
    np.testing.assert_allclose(back, pixels, rtol=0, atol=1e-9)


def test_what_is_behind_is_masked_and_has_no_derivative(camera):
    points = jnp.array([[0.1, 0.0, 1.0], [0.1, 0.0, -1.0], [0.1, 0.0, 0.0]])
    pixels, seen = camera.project(points, FOCAL)
    assert seen.tolist() == [True, False, False]
    assert jnp.isnan(pixels[1:]).all()

    def total(points, focal):
        pixels, seen = camera.project(points, focal)
        return jnp.sum(jnp.where(seen[:, None], pixels, 0))

    by_points, by_focal = jax.grad(total, (0, 1))(points, FOCAL)
    assert jnp.isfinite(by_focal)
    np.testing.assert_array_equal(by_points[1:], 0)
    assert (by_points[0] != 0).any()


@pytest.mark.slow
def test_derivatives(camera, pixels):
    rays = jnp.asarray(camera.rays(pixels[::9], FOCAL)[0])
    assert_derivatives_agree(lambda p: camera.project(p, FOCAL)[0], rays, step=1e-5)
    assert_derivatives_agree(lambda p: camera.rays(p, FOCAL)[0], pixels[::9], step=1e-2)
    focal = jnp.full(len(rays), FOCAL)
    assert_derivatives_agree(lambda f: camera.project(rays, f)[0], focal, step=1e-3)


def test_the_principal_point_is_by_default_the_centre(truth):
    camera = zj.models.Camera(truth, pixel_pitch=0.006)
    rays, _ = camera.rays(np.asarray(truth.centre), FOCAL)
    np.testing.assert_array_equal(rays, [0, 0, 1])


def test_a_lens_in_pixels_needs_no_pitch(truth):
    import dataclasses

    camera = zj.models.Camera(dataclasses.replace(truth, focal_unit="px"))
    rays, _ = camera.rays([0.0, 0.0], FOCAL)
    assert rays[0] < -1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "pixel_pitch"),
        ({"pixel_pitch": -0.006}, "positive"),
        ({"pixel_pitch": 0.006, "principal": [1.0, 2.0, 3.0]}, r"principal must have shape \(2,\)"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_what_is_missing_is_said(truth, arguments, message):
    with pytest.raises(ValueError, match=message):
        zj.models.Camera(truth, **arguments)


@pytest.mark.usefixtures("unchecked")
def test_points_of_two_numbers_are_refused(camera):
    with pytest.raises(ValueError, match="shape"):
        camera.project(np.zeros((4, 2)), FOCAL)


def test_float32_stays(camera, pixels):
    rays, _ = camera.rays(jnp.asarray(pixels, jnp.float32), FOCAL)
    assert rays.dtype == jnp.float32
    back, _ = camera.project(rays, FOCAL)
    assert back.dtype == jnp.float32
    np.testing.assert_allclose(back, pixels, rtol=0, atol=2e-3)


@pytest.mark.parametrize("kind", [np, jnp], ids=["numpy", "jax"])
@pytest.mark.parametrize("dtype", ["float16", "int8", "uint16"])
def test_points_in_space_of_few_bits_are_projected_in_more(camera, kind, dtype):
    """Half precision has steps of a px at 2,000."""
    points = np.array([[1, 0, 7], [1, 1, 9], [0, 1, 11]])
    pixels, _ = camera.project(kind.asarray(points, dtype), FOCAL)
    assert pixels.dtype == (np.float32 if dtype == "float16" else np.float64)
    np.testing.assert_allclose(pixels, camera.project(points.astype(float), FOCAL)[0], rtol=0, atol=2e-3)


@pytest.mark.parametrize("kind", [np, jnp], ids=["numpy", "jax"])
def test_the_principal_point_moves_with_the_centre(kind):
    """By default it is the centre of distortion, also of a lens whose centre moves along the zoom."""
    zoom, shift = (zj.PolynomialZoom(1, k, 20.0) for k in ([[0.0], [0.1]], [[0.0, 0.0], [0.1, -0.05]]))
    lens = zj.ZoomLens(zoom, [319.5, 239.5], [20.0, 80.0], (640, 480), "px", shift)
    camera, focal = zj.models.Camera(lens), kind.asarray([20.0, 40.0])
    centres = kind.asarray(lens(np.array([20.0, 40.0])).centre)
    assert np.ptp(centres, axis=0).min() > 9
    ahead, known = camera.rays(centres, focal)
    np.testing.assert_allclose(ahead, [[0, 0, 1]] * 2, atol=1e-6)
    pixels, seen = camera.project(camera.rays(centres + 30, focal)[0], focal)
    np.testing.assert_allclose(pixels, centres + 30, atol=1e-3)
    assert known.all()
    assert seen.all()


@pytest.mark.parametrize(
    "bad",
    [
        {"pixel_pitch": jnp.array(-0.006)},
        {"pixel_pitch": jnp.array(np.nan)},
        {"pixel_pitch": [0.006, 0.006]},
        {"pixel_pitch": 0.006, "principal": [np.nan, 1.0]},
        {"pixel_pitch": 0.006, "principal": [1.0, 1j]},
        {"pixel_pitch": 0.006, "principal": "ab"},
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_what_is_no_camera_is_refused(bad):
    name = list(bad)[-1]
    with pytest.raises(ValueError, match=f"Argument {name} must"):
        zj.models.Camera(zj.scenes.nikkor_18_200(), **bad)


def test_focal_lengths_in_px_of_images_of_another_size(tmp_path):
    """The ray of a point of the scene is the same in images of half the size, and the camera matrix."""
    zoom = zj.PolynomialZoom(1, jnp.array([[0.0], [0.1]]), jnp.array(1000.0))
    lens = zj.ZoomLens(zoom, [319.5, 239.5], [1000.0, 4000.0], (640, 480), focal_unit="px")
    with pytest.warns(UserWarning, match="scaled"):
        half = zj.models.lens_for_size(lens, (320, 240))
    with pytest.warns(UserWarning, match="scaled"):
        back = zj.models.lens_for_size(half, (640, 480))
    half.save(tmp_path / "half.json")
    point = np.array([600.0, 400.0])
    expected, _ = zj.Camera(lens).rays(point, 1500.0)
    for other in (half, zj.load_lens(tmp_path / "half.json")):
        ray, _ = zj.Camera(other).rays((point + 0.5) / 2 - 0.5, 1500.0)
        np.testing.assert_allclose(ray, expected, rtol=1e-12)
        pixel, _ = zj.Camera(other).project(np.asarray(expected), 1500.0)
        np.testing.assert_allclose(pixel, (point + 0.5) / 2 - 0.5, rtol=1e-9)
    np.testing.assert_allclose(zj.Camera(back).rays(point, 1500.0)[0], expected, rtol=1e-12)
    zj.interop.write(half, tmp_path / "half.yaml", format="opencv", focal=[1500.0])
    found = zj.interop.read(tmp_path / "half.yaml", format="opencv")
    np.testing.assert_allclose(np.asarray(found.lens.focal_range), 750.0)
