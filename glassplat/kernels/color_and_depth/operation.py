"""The image and the mean depths of what was blended, over a background."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from glassplat.kernels.color_and_depth import reference as reference
from glassplat.kernels.color_and_depth.cpu import color_and_depth_backward, color_and_depth_forward
from glassplat.kernels.records import REAL_OF, check_tensors

CHANNELS = 4


def color_and_depth(image: Tensor, alpha: Tensor, background: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    """Adds a constant background behind blended colours, and divides blended depths by their weight.

        C = sum_i c_i w_i + (1 - alpha) C_b
        D = (sum_i z_i w_i) / alpha                  (TR-Gaussians, Eq. 4)

    D is 0 where alpha is 1e-6 or less. Differentiable in `image` and `alpha`.

    Args:
        image: [H, W, 4] blended colours and depths.
        alpha: [H, W] their weight.
        background: three numbers.

    Returns:
        The image [H, W, 3], contiguous, and the depths [H, W].

    Raises:
        ValueError: shapes disagree.
        TypeError: tensors of different or unsupported floating-point types, or on different devices.
    """
    height, width = alpha.shape
    check_tensors({"image": (image, (height, width, CHANNELS)), "alpha": (alpha, (height, width))})
    if image.device.type != "cpu":
        # On a GPU these few operations on an image are no bottleneck, so that there they stay PyTorch's.
        return reference.color_and_depth(image, alpha, background)
    colors, depths = _ColorAndDepth.apply(image, alpha, background)
    return colors, depths


class _ColorAndDepth(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, alpha: Tensor, background: tuple[float, ...]) -> tuple[Tensor, Tensor]:
        ctx.set_materialize_grads(False)
        image, alpha = image.detach().contiguous(), alpha.detach().contiguous()
        colors, depths = image.new_empty(*alpha.shape, 3), torch.empty_like(alpha)
        real = REAL_OF[image.dtype]
        ctx.behind = tuple(real(value) for value in background)
        arrays = (tensor.numpy() for tensor in (image, alpha))
        color_and_depth_forward(real)(*arrays, ctx.behind, colors.numpy(), depths.numpy())
        ctx.save_for_backward(alpha, depths)
        return colors, depths

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_colors: Tensor | None, v_depths: Tensor | None) -> tuple[Tensor | None, ...]:
        alpha, depths = ctx.saved_tensors
        if v_colors is None and v_depths is None:
            return None, None, None
        # Empty where nothing comes from.
        v_colors = alpha.new_empty(0, 0, 0) if v_colors is None else v_colors.contiguous()
        v_depths = alpha.new_empty(0, 0) if v_depths is None else v_depths.contiguous()
        v_image, v_alpha = alpha.new_empty(*alpha.shape, CHANNELS), torch.empty_like(alpha)
        arrays = (tensor.numpy() for tensor in (alpha, depths, v_colors, v_depths))
        color_and_depth_backward(REAL_OF[alpha.dtype])(*arrays, ctx.behind, v_image.numpy(), v_alpha.numpy())
        return v_image, v_alpha if any(ctx.behind) or v_depths.numel() else None, None
