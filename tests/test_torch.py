"""Tensors in, tensors out: values and gradients of `zoomjax.torch` are those of JAX, and of differences."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj

NO_TORCH = """
import sys
sys.modules["torch"] = None
import zoomjax
zoomjax.Distortion
try:
    import zoomjax.torch
except ImportError as error:
    print(error)
"""


def test_without_pytorch_only_this_module_fails():
    result = subprocess.run([sys.executable, "-c", NO_TORCH], capture_output=True, text=True, check=True)
    assert result.stdout.startswith("zoomjax.torch needs PyTorch, which is not installed")


torch = pytest.importorskip("torch")
import zoomjax.torch as zt  # noqa: E402

DTYPES = {torch.float32: jnp.float32, torch.float64: jnp.float64}
both = pytest.mark.parametrize("dtype", DTYPES)


def distortion(distortion_model=None, k=(0.1, -0.02)):
    distortion_model = zj.models.RadialPolynomial() if distortion_model is None else distortion_model
    return zj.Distortion(jnp.array(k), jnp.array([29.0, 20.0]), jnp.array(36.0), distortion_model)


def lens():
    parameters = jnp.array([[-0.04, 0.006], [0.02, -0.004], [0.12, 0.01]])
    zoom = zj.PolynomialZoom(2, parameters, jnp.array(20.0))
    return zj.ZoomLens(zoom, jnp.array([29.0, 20.0]), jnp.array([20.0, 80.0]), (60, 40))


DISTORTION_MODELS = [
    distortion(),
    distortion(zj.models.Division(), (-0.1,)),
    distortion(zj.models.BrownConrady(), (0.1, 0.01, -0.02)),
]
models = pytest.mark.parametrize("d", DISTORTION_MODELS, ids=lambda d: type(d.distortion_model).__name__)
methods = pytest.mark.parametrize("method", ["undistort", "distort"])


def points(dtype, *, requires_grad=False):
    values = [[[3.0, 4.0], [29.0, 20.0]], [[58.0, 37.0], [10.0, 33.0]]]
    return torch.tensor(values, dtype=dtype, requires_grad=requires_grad)


@both
@models
@methods
def test_values_are_those_of_jax(method, d, dtype):
    given = points(dtype)
    result = getattr(zt, method)(given, d)
    expected = getattr(d, method)(jnp.asarray(given.numpy()))
    assert result.dtype == dtype
    assert result.shape == given.shape
    np.testing.assert_allclose(result.numpy(), expected, rtol=1e-14 if dtype == torch.float64 else 1e-6)


@models
@methods
def test_gradients_of_distortions(method, d):
    k = zt.coefficients_of(d, torch.float64).requires_grad_()
    function = getattr(zt, method)
    given = points(torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x, k: function(x, d, coefficients=k), (given, k))


@methods
@pytest.mark.parametrize("several", [False, True])
def test_gradients_of_lenses(method, several):
    focal = torch.tensor([22.0, 60.0] if several else 35.0, dtype=torch.float64, requires_grad=True)
    parameters = zt.coefficients_of(lens(), torch.float64).requires_grad_()
    function = getattr(zt, method)
    given = points(torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda x, f, a: function(x, lens(), f, coefficients=a), (given, focal, parameters)
    )


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
@pytest.mark.parametrize("shape", [(1, 5, 6), (2, 3, 5, 6)])
def test_gradients_of_images(shape, interpolation):
    d = zj.Distortion(jnp.array([0.1, -0.02]), jnp.array([2.4, 2.1]), jnp.array(3.9))
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(shape, dtype=torch.float64, generator=generator).requires_grad_()
    k = zt.coefficients_of(d, torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda image, k: zt.warp_image(image, d, coefficients=k, interpolation=interpolation), (image, k)
    )
    expected = zj.warp_image(
        jnp.asarray(image.detach().numpy()[..., 0, :, :].reshape(-1, 5, 6)[0]),
        d,
        interpolation=interpolation,
    )
    result = zt.warp_image(image, d, interpolation=interpolation).detach().reshape(-1, 5, 6)[0]
    np.testing.assert_allclose(result.numpy(), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("wanted", [(a, b, c) for a in (0, 1) for b in (0, 1) for c in (0, 1)])
def test_gradients_go_to_those_who_want_them(wanted):
    tensors = [
        points(torch.float32),
        torch.tensor(35.0),
        zt.coefficients_of(lens()),
    ]
    tensors = [t.requires_grad_(bool(want)) for t, want in zip(tensors, wanted, strict=True)]
    result = zt.distort(tensors[0], lens(), tensors[1], coefficients=tensors[2])
    assert result.requires_grad == any(wanted)
    if any(wanted):
        result.sum().backward()
    assert [t.grad is not None for t in tensors] == [bool(want) for want in wanted]
    assert all(t.grad.dtype == t.dtype and t.grad.shape == t.shape for t in tensors if t.grad is not None)


def test_double_stays_double_where_jax_is_single():
    expected = distortion().distort(jnp.asarray(points(torch.float64).numpy()))
    d = jax.tree.map(np.asarray, distortion())
    jax.config.update("jax_enable_x64", False)
    try:
        given = points(torch.float64, requires_grad=True)
        result = zt.distort(given, d)
        result.sum().backward()
        assert jnp.zeros(()).dtype == jnp.float32
    finally:
        jax.config.update("jax_enable_x64", True)
    assert result.dtype == given.grad.dtype == torch.float64
    np.testing.assert_allclose(result.detach().numpy(), expected, rtol=1e-14)


def test_no_inverse_is_nan_with_a_gradient_of_zero():
    d = distortion(k=(-0.3,))
    given = torch.tensor([[10.0, 12.0], [400.0, 20.0]], requires_grad=True)
    result = zt.distort(given, d)
    assert torch.isnan(result).any(dim=-1).tolist() == [False, True]
    torch.where(torch.isnan(result), 0, result).sum().backward()
    assert torch.isfinite(given.grad).all()
    assert given.grad[1].tolist() == [0, 0]


def test_beyond_the_focal_range_is_nan_and_said():
    for focal in (300.0, torch.tensor([30.0, 300.0], requires_grad=True)):
        with pytest.warns(UserWarning, match="300 mm (is|are) not .*, 20 to 80 mm"):
            moved = zt.undistort(points(torch.float32), lens(), focal)
        assert torch.isnan(moved[:, 1]).all()
    with pytest.warns(UserWarning, match="20 to 80 mm"):
        zt.warp_image(torch.zeros(1, 40, 60), lens(), 300.0)
    with pytest.raises(ValueError, match="must be a positive number, but it is -3"):
        zt.undistort(points(torch.float32), lens(), -3.0)
    assert torch.isfinite(zt.undistort(points(torch.float32), lens().extended(20.0, 400.0), 300.0)).all()


def test_what_is_computed_does_not_share_memory_with_what_was_given():
    given = points(torch.float32)
    result = zt.undistort(given, distortion())
    before = result.clone()
    given.zero_()
    assert torch.equal(result, before)
    result.zero_()
    assert torch.equal(zt.undistort(points(torch.float32), distortion()), before)


def test_slices_and_turned_tensors():
    turned = points(torch.float64).flatten(0, 1).T.contiguous().T[1:]
    np.testing.assert_array_equal(
        zt.undistort(turned, distortion()).numpy(),
        zt.undistort(turned.clone().contiguous(), distortion()).numpy(),
    )


def test_coefficients_are_trained():
    """A few steps of an optimiser find the lens that made the points."""
    d, given = distortion(k=(0.1,)), points(torch.float64)
    wanted = zt.undistort(given, d)
    k = torch.nn.Parameter(torch.zeros(1, dtype=torch.float64))
    optimiser = torch.optim.LBFGS([k])

    def closure():
        optimiser.zero_grad()
        loss = (zt.undistort(given, d, coefficients=k) - wanted).square().sum()
        loss.backward()
        return loss

    for _ in range(3):
        optimiser.step(closure)
    assert k.item() == pytest.approx(0.1, abs=1e-6)


@pytest.mark.parametrize(
    ("error", "message", "call"),
    [
        (TypeError, "must be a tensor", lambda: zt.undistort(np.zeros((3, 2)), distortion())),
        (TypeError, "float32 or float64", lambda: zt.undistort(points(torch.float16), distortion())),
        (TypeError, "a Distortion or a ZoomLens", lambda: zt.undistort(points(torch.float32), None)),
        (ValueError, "focal must be given", lambda: zt.undistort(points(torch.float32), lens())),
        (ValueError, "left out", lambda: zt.undistort(points(torch.float32), distortion(), 35.0)),
        (
            ValueError,
            "shape of the lens's own",
            lambda: zt.undistort(points(torch.float32), distortion(), coefficients=torch.zeros(3)),
        ),
        (
            ValueError,
            "Argument border_value must be one number, but it is True",
            lambda: zt.warp_image(torch.zeros(1, 5, 6), distortion(), border_value=True),
        ),
        (ValueError, "channels, height, width", lambda: zt.warp_image(torch.zeros(5, 6), distortion())),
        (
            ValueError,
            "for images of another size",
            lambda: zt.warp_image(torch.zeros(3, 480, 640), distortion()),
        ),
        (
            ValueError,
            "one focal length",
            lambda: zt.warp_image(torch.zeros(2, 1, 5, 6), lens(), torch.tensor([20.0, 30.0])),
        ),
    ],
)
def test_what_cannot_be_done_is_said(error, message, call, unchecked):
    with pytest.raises(error, match=message):
        call()
