"""The definition of `glassplat.kernels.join_channels.join_channels`, in PyTorch."""

from __future__ import annotations

import torch
from torch import Tensor


def join_channels(colors: Tensor, values: Tensor, more: int = 0) -> Tensor:
    """See `glassplat.kernels.join_channels.join_channels`."""
    return torch.nn.functional.pad(torch.cat([colors, values[..., None]], dim=-1), (0, 0, 0, more))
