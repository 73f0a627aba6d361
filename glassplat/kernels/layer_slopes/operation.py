"""How much an image behind a pane changes with its two layers."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.kernels.layer_slopes import reference as reference
from glassplat.kernels.layer_slopes.cpu import layer_slopes_kernel
from glassplat.kernels.tensor_checks import REAL_OF, check_device, check_tensors


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
