"""Distortion for PyTorch: the functions of this package as differentiable functions of tensors.

    import zoomjax.torch as zt
    corrected = zt.undistort(points, lens, focal=35.0)

Tensors go to JAX and back by DLPack, which copies nothing where both have the device; gradients are those
of `jax.vjp`. Each function is compiled once for a shape of its arguments. A float64 tensor is computed in
float64, whatever JAX's own setting. PyTorch must be installed; nothing else of this package imports it.

Gradients are with respect to the points or the image, to focal lengths, and to `coefficients`: those of a
`Distortion`, or the parameters of a lens's zoom model, as a tensor that takes the place of the lens's own.
So they can be trained:

    coefficients = torch.nn.Parameter(zt.coefficients_of(lens))
    loss = (zt.undistort(points, lens, focal=35.0, coefficients=coefficients) - wanted).square().sum()
"""

import contextlib
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._core.arrays import widest
from .correct.framing import Framing
from .correct.warp import warp_image as _warp_image
from .models.distortion import Distortion
from .models.lens import ZoomLens
from .models.sizes import check_image_size
from .models.zoom import with_parameters

try:
    import torch  # pyright: ignore[reportMissingImports]
    from torch.autograd.function import once_differentiable  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise ImportError(
        "zoomjax.torch needs PyTorch, which is not installed: pip install torch (see pytorch.org)."
    ) from error

Lens = Distortion | ZoomLens


def undistort(
    points: torch.Tensor,
    lens: Lens,
    focal: Any = None,
    *,
    coefficients: torch.Tensor | None = None,
) -> torch.Tensor:
    """Corrected positions of distorted points; see `Distortion.undistort` and `ZoomLens.undistort`.

    Args:
        points: (..., 2) px, float32 or float64.
        lens: a distortion, or a lens.
        focal: of a lens, the focal length, or a tensor of them that broadcasts with the points.
        coefficients: used instead of the lens's own (see `coefficients_of`).

    Returns:
        A tensor of the points' dtype and device; NaN beyond the lens's focal range (see
        `ZoomLens.extended`). First derivatives exist; for second ones use JAX.

    Warns:
        UserWarning: a focal length, not in a GPU's memory, is outside of that range. `distort` and
            `warp_image` warn of it, too.

    Raises:
        TypeError: the points are not a tensor of float32 or float64, or the lens has the wrong type.
        ValueError: a lens is given without a focal length, or a distortion with one, or a focal length is
            not positive.
    """
    return _mapped("undistort", points, lens, focal, coefficients)


def distort(
    points: torch.Tensor,
    lens: Lens,
    focal: Any = None,
    *,
    coefficients: torch.Tensor | None = None,
) -> torch.Tensor:
    """Distorted positions of corrected points: the inverse of `undistort`, with the same arguments.

    Where there is no inverse the result is NaN, with derivatives of zero.
    """
    return _mapped("distort", points, lens, focal, coefficients)


def warp_image(
    image: torch.Tensor,
    lens: Lens,
    focal: Any = None,
    *,
    coefficients: torch.Tensor | None = None,
    framing: Framing | None = None,
    interpolation: str = "linear",
    border_value: float = 0.0,
) -> torch.Tensor:
    """The corrected image, or images; see `zoomjax.warp_image`.

    Args:
        image: (..., channels, height, width), as PyTorch has them, float32 or float64; leading axes are
            those of several images.
        lens, focal, coefficients: as for `undistort`, with one focal length for all.
        framing, interpolation, border_value: as for `zoomjax.warp_image`.
    """
    _check_tensor("image", image)
    if image.ndim < 3:
        raise ValueError(
            "Argument image must have shape (..., channels, height, width), but its shape is "
            f"{tuple(image.shape)}."
        )
    if focal is not None and np.shape(focal) != ():
        raise ValueError("Argument focal must be one focal length for all images.")
    if isinstance(border_value, bool):
        raise ValueError(f"Argument border_value must be one number, but it is {border_value!r}.")
    options = (framing, interpolation, float(border_value))
    _check_range(lens, focal, 4)
    if isinstance(lens, Distortion) and (framing is None or framing.image_size is not None):
        height, width = image.shape[-2:]
        check_image_size(lens, (width, height))  # which is traced further on, and not known there
    return _called(_warped, options, image, lens, focal, coefficients)


def coefficients_of(lens: Lens, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    """What `coefficients` takes the place of: k of a distortion, the zoom model's parameters of a lens.

    Of a model whose parameters are one array, as those of all but a few are.
    """
    return torch.tensor(np.asarray(_own(lens)), dtype=dtype)


def _own(lens):
    own = lens.coefficients if isinstance(lens, Distortion) else lens.zoom.parameters
    if not eqx.is_array_like(own) or own is None:
        raise TypeError("The parameters of this zoom model are no single array: train it in JAX.")
    return own


def _mapped(method, points, lens, focal, coefficients):
    _check_tensor("points", points)
    _check_range(lens, focal, 5)
    return _called(_moved, method, points, lens, focal, coefficients)


def _check_range(lens, focal, stacklevel):
    """Check focal lengths of a lens but on a GPU, whose values would have to be waited for."""
    if isinstance(lens, ZoomLens) and focal is not None:
        values = torch.as_tensor(focal).detach()
        if values.device.type == "cpu":
            lens.check_range(values.numpy(), stacklevel=stacklevel)


def _moved(method, points, lens, focal):
    if isinstance(lens, Distortion):
        return getattr(lens, method)(points)
    return getattr(lens, method)(points, focal)


def _warped(options, image, lens, focal):
    framing, interpolation, border = options
    distortion = lens if isinstance(lens, Distortion) else lens(focal)
    planes = image.reshape(-1, *image.shape[-2:])
    warp = functools.partial(_warp_image, framing=framing, interpolation=interpolation, border_value=border)
    # All channels of all images alike: they share the positions, which are found once.
    together = warp(jnp.moveaxis(planes, 0, -1), distortion)
    return jnp.moveaxis(together, -1, 0).reshape(*image.shape[:-2], *together.shape[:2])


def _called(function, options, array, lens, focal, coefficients):
    """The function of tensors, as an operation of PyTorch."""
    if not isinstance(lens, Distortion | ZoomLens):
        raise TypeError(
            f"Argument lens must be a Distortion or a ZoomLens, but its type is {type(lens).__name__}."
        )
    if isinstance(lens, ZoomLens) == (focal is None):
        raise ValueError(
            "Argument focal must be given with a ZoomLens, and left out with a Distortion, but it is "
            f"{focal!r}."
        )
    if coefficients is not None:
        _check_tensor("coefficients", coefficients)
        if tuple(coefficients.shape) != np.shape(_own(lens)):
            raise ValueError(
                "Argument coefficients must have the shape of the lens's own, "
                f"{np.shape(_own(lens))}, but its shape is {tuple(coefficients.shape)}."
            )
    given = [None if value is None else torch.as_tensor(value).to(array) for value in (focal, coefficients)]
    return _Operation.apply(function, options, lens, array, *given)


class _Operation(torch.autograd.Function):
    """A function of (array, focal, coefficients), of which the last two may be None."""

    @staticmethod
    def forward(ctx, function, options, lens, *tensors):
        ctx.what = function, options, lens
        ctx.save_for_backward(*tensors)
        with _precision(tensors[0].dtype):
            return _to_torch(_value(function, options, lens, _to_jax(tensors)))

    @staticmethod
    @once_differentiable
    def backward(ctx, cotangent):  # pyright: ignore[reportIncompatibleMethodOverride]
        tensors = ctx.saved_tensors
        with _precision(tensors[0].dtype):
            wanted = tuple(ctx.needs_input_grad[3:])
            [cotangent] = _to_jax([cotangent])
            function, options, lens = ctx.what
            gradients = _pullback(function, options, lens, wanted, _to_jax(tensors), cotangent)
            return None, None, None, *(None if g is None else _to_torch(g) for g in gradients)


@eqx.filter_jit
def _value(function, options, lens, arrays):
    array, focal, coefficients = arrays
    if coefficients is not None:
        lens = _with(lens, coefficients)
    return function(options, array, lens, focal)


@eqx.filter_jit
def _pullback(function, options, lens, wanted, arrays, cotangent):
    """The cotangents of the arrays that are wanted, None for others."""
    moving = [array if want else None for array, want in zip(arrays, wanted, strict=True)]
    rest = [None if want else array for array, want in zip(arrays, wanted, strict=True)]
    _, back = jax.vjp(lambda moving: _value(function, options, lens, eqx.combine(moving, rest)), moving)
    return back(cotangent)[0]


def _with(lens, coefficients):
    if isinstance(lens, Distortion):
        return Distortion(coefficients, lens.centre, lens.scale, lens.distortion_model)
    return eqx.tree_at(lambda lens: lens.zoom, lens, with_parameters(lens.zoom, coefficients))


def _precision(dtype):
    """JAX as wide as the tensors, for a while: it would make float32 of float64 without a word."""
    if dtype != torch.float64 or jnp.result_type(float) == jnp.float64:
        return contextlib.nullcontext()
    return widest()


def _to_jax(tensors):
    return [None if t is None else jax.dlpack.from_dlpack(t.detach().contiguous()) for t in tensors]


def _to_torch(array):
    # Ready, for memory is shared: whoever changes a tensor now must not change what is still computed.
    return torch.from_dlpack(jax.block_until_ready(array))


def _check_tensor(name, tensor):
    if not isinstance(tensor, torch.Tensor):
        raise TypeError(f"Argument {name} must be a tensor, but its type is {type(tensor).__name__}.")
    if tensor.dtype not in (torch.float32, torch.float64):
        raise TypeError(
            f"Argument {name} must be of float32 or float64, but it is of {tensor.dtype}: use .float()."
        )
