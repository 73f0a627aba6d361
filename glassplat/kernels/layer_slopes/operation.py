"""How much an image behind a pane changes with its two layers."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.kernels.layer_slopes import reference as reference
from glassplat.kernels.layer_slopes.cpu import layer_slopes_kernel, slopes_at_kernel
from glassplat.kernels.records import REAL_OF, check_device, check_tensors


@torch.no_grad()
def layer_slopes(
    strength: Tensor, transmission: Tensor, reflection: Tensor, where: Tensor, *, linear: bool
) -> tuple[Tensor, Tensor]:
    """The derivatives of Eq. 1 of TR-Gaussians by the transmission and by the reflection, of grey.

    Grey is as bright as the mean of a layer's channels. In linear radiance the derivatives are not 1 - R and R: a weak
    reflection stands out from a dark transmission, and takes contrast from it. Not differentiable.

    Args:
        strength: [H, W] R.
        transmission: [H, W, 3] C_t, sRGB.
        reflection: [H, W, 3] C_r, sRGB.
        where: [H, W] bool; elsewhere the derivatives are 1 and 0.
        linear: blend linear radiance; False blends sRGB values, as the paper does.

    Returns:
        Two images [H, W].

    Raises:
        ValueError: shapes disagree.
        TypeError: tensors of different or unsupported floating-point types, `where` is not bool, or differing devices.
    """
    height, width = strength.shape
    shape = (height, width, 3)
    check_tensors(
        {"strength": (strength, shape[:2]), "transmission": (transmission, shape), "reflection": (reflection, shape)}
    )
    check_device("where", where, "strength", strength)
    if where.dtype != torch.bool or where.shape != strength.shape:
        raise TypeError(f"where is {where.dtype} of shape {tuple(where.shape)}; expected bool of {(height, width)}")
    if strength.device.type != "cpu":
        # On a GPU these few operations on an image are no bottleneck, so that there they stay PyTorch's.
        return reference.layer_slopes(strength, transmission, reflection, where, linear=linear)
    through, mirrored = torch.empty_like(strength), torch.empty_like(strength)
    layers = (tensor.detach().contiguous().numpy() for tensor in (strength, transmission, reflection, where))
    layer_slopes_kernel(REAL_OF[strength.dtype])(*layers, linear, through.numpy(), mirrored.numpy())
    return through, mirrored


@torch.no_grad()
def slopes_at(slopes: Tensor, near: Tensor, means2d: Tensor, depths: Tensor) -> Tensor:
    """What an image of slopes holds at the centres of splats, 1 where they lie before a surface. Not differentiable.

    Args:
        slopes: [H, W], by the transmission.
        near: [H, W] depth of the surface, infinite where there is none.
        means2d: [C, N, 2] centres in pixels; those beyond the image, and NaN, count as at its border.
        depths: [C, N] of the centres.

    Returns:
        [C, N].

    Raises:
        ValueError: shapes disagree.
        TypeError: tensors of different or unsupported floating-point types, or on different devices.
    """
    size, leading = tuple(slopes.shape), tuple(depths.shape)
    expected = {"slopes": (slopes, size), "near": (near, size), "means2d": (means2d, (*leading, 2))}
    check_tensors({**expected, "depths": (depths, leading)})
    if slopes.device.type != "cpu":
        # On a GPU these few operations on the splats are no bottleneck, so that there they stay PyTorch's.
        return reference.slopes_at(slopes, near, means2d, depths)
    found = torch.empty_like(depths)
    tensors = (tensor.detach().contiguous().numpy() for tensor in (slopes, near, means2d, depths))
    slopes_at_kernel(REAL_OF[slopes.dtype])(*tensors, found.numpy())
    return found
