"""What splats carry, side by side."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from glassplat.kernels.join_channels import reference as reference
from glassplat.kernels.join_channels.cpu import join_channels_backward, join_channels_forward
from glassplat.kernels.records import REAL_OF, check_tensors


def join_channels(colors: Tensor, values: Tensor, more: int = 0) -> Tensor:
    """Colours and one value more of each splat, as `composite` reads them. Differentiable in both.

    Args:
        colors: [C, N, 3].
        values: [C, N].
        more: how many splats follow that carry zeros.

    Returns:
        [C, N + more, 4].

    Raises:
        ValueError: shapes disagree.
        TypeError: tensors of different or unsupported floating-point types, or on different devices.
    """
    leading = tuple(values.shape)
    check_tensors({"colors": (colors, (*leading, 3)), "values": (values, leading)})
    if colors.device.type != "cpu":
        # On a GPU these copies are no bottleneck, so that there they stay PyTorch's.
        return reference.join_channels(colors, values, more)
    channels: Tensor = _JoinChannels.apply(colors, values, more)
    return channels


class _JoinChannels(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, colors: Tensor, values: Tensor, more: int) -> Tensor:
        cameras, count = values.shape
        channels = colors.new_empty(cameras, count + more, 4)
        tensors = (colors.detach().contiguous(), values.detach().contiguous(), channels)
        join_channels_forward(REAL_OF[colors.dtype])(*(tensor.numpy() for tensor in tensors))
        ctx.count = count
        return channels

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_channels: Tensor) -> tuple[Tensor, Tensor, None]:
        cameras = v_channels.shape[0]
        v_colors, v_values = v_channels.new_empty(cameras, ctx.count, 3), v_channels.new_empty(cameras, ctx.count)
        tensors = (v_channels.contiguous(), v_colors, v_values)
        join_channels_backward(REAL_OF[v_channels.dtype])(*(tensor.numpy() for tensor in tensors))
        return v_colors, v_values, None
