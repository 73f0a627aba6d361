"""Edges that two images share."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from glassplat.kernels.gradient_conflict import reference as reference
from glassplat.kernels.gradient_conflict.cpu import conflict_backward, conflict_forward
from glassplat.kernels.records import REAL_OF, check_tensors


def gradient_conflict(transmission: Tensor, reflection: Tensor, hit: Tensor) -> Tensor:
    """Mean of hit |grad C_t . grad C_r| over channels and inner pixels (TR-Gaussians, Eq. 15).

    Gradients are Sobel's, per colour channel; pixels on the image border are left out.
    Differentiable in `transmission` only: an edge of the reflection should not appear in the transmission, and the
    reflection is not to give way.

    Args:
        transmission: [H, W, 3] C_t, with H and W of at least 3.
        reflection: [H, W, 3] C_r.
        hit: [H, W] weight of each pixel, 1 where a pane is.

    Raises:
        ValueError: shapes disagree, or an image is too small.
        TypeError: tensors of different or unsupported floating-point types, or not on the CPU.
    """
    height, width = hit.shape
    if height < 3 or width < 3:
        raise ValueError(f"the images are {width} x {height} pixels; expected at least 3 x 3 for Sobel derivatives")
    shape = (height, width, 3)
    check_tensors(
        {"transmission": (transmission, shape), "reflection": (reflection, shape), "hit": (hit, (height, width))}
    )
    if transmission.device.type != "cpu":
        # On a GPU these few sums over an image are no bottleneck, so that there they stay PyTorch's.
        return reference.gradient_conflict(transmission, reflection, hit)
    mean: Tensor = _GradientConflict.apply(transmission, reflection, hit)
    return mean


class _GradientConflict(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, transmission: Tensor, reflection: Tensor, hit: Tensor) -> Tensor:
        height, width = hit.shape
        images = (tensor.detach().contiguous() for tensor in (transmission, reflection, hit))
        # A ring of zeros around the derivatives spares the backward pass all questions about the border.
        slopes = transmission.new_zeros(2, height + 2, 3 * (width + 2))
        sums = torch.zeros(height, dtype=torch.float64, device=hit.device)
        conflict_forward(REAL_OF[hit.dtype])(*(t.numpy() for t in images), slopes.numpy(), sums.numpy())
        ctx.save_for_backward(slopes)
        ctx.count = 3 * (height - 2) * (width - 2)
        return (sums.sum() / ctx.count).to(transmission.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_mean: Tensor) -> tuple[Tensor, None, None]:
        (slopes,) = ctx.saved_tensors
        real = REAL_OF[slopes.dtype]
        v_transmission = slopes.new_empty(slopes.shape[1] - 2, slopes.shape[2] // 3 - 2, 3)
        conflict_backward(real)(slopes.numpy(), real(v_mean.item() / ctx.count), v_transmission.numpy())
        return v_transmission, None, None
