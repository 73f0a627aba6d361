"""The edges that two images share, added up in one pass (TR-Gaussians, Eq. 15).

PyTorch writes all products down before it adds them up; on a GPU that is no bottleneck, and there it stays PyTorch's.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from glassplat.kernels.backend.cpu import Kernel, kernel
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
        return gradient_conflict_in_torch(transmission, reflection, hit)
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


def gradient_conflict_in_torch(transmission: Tensor, reflection: Tensor, hit: Tensor) -> Tensor:
    """The definition of `gradient_conflict`: Sobel derivatives of both images, multiplied."""
    along, across = sobel(transmission), sobel(reflection.detach())
    product = along[0] * across[0] + along[1] * across[1]
    return (product.abs() * hit[1:-1, 1:-1, None]).mean()


def sobel(image: Tensor) -> tuple[Tensor, Tensor]:
    """Horizontal and vertical Sobel derivatives [H-2, W-2, C] of an image [H, W, C], borders left out."""
    across = image[:, 2:] - image[:, :-2]
    down = image[2:] - image[:-2]
    horizontal = across[:-2] + 2 * across[1:-1] + across[2:]
    vertical = down[:, :-2] + 2 * down[:, 1:-1] + down[:, 2:]
    return horizontal, vertical


CHANNELS = 3


@functools.cache
def conflict_forward(real: type) -> Kernel:
    """Fills the sum of each row, and in slopes [2, H + 2, 3 (W + 2)] the derivatives by both of Sobel's images."""
    zero, two = real(0.0), real(2.0)

    @kernel("gradient_conflict_forward", real)
    def forward(transmission, reflection, hit, slopes, sums):
        height, width = hit.shape
        floats = CHANNELS * width
        t, r = transmission.reshape(height, floats), reflection.reshape(height, floats)
        for row in prange(1, height - 1):
            weights: NDArray[Any] = np.empty(floats, real)
            for x in range(width):
                for d in range(CHANNELS):
                    weights[CHANNELS * x + d] = hit[row, x]
            t_up, t_here, t_down = t[row - 1], t[row], t[row + 1]
            r_up, r_here, r_down = r[row - 1], r[row], r[row + 1]
            out_x, out_y = slopes[0, row + 1], slopes[1, row + 1]
            total = zero
            for j in range(floats - 2 * CHANNELS):
                k = j + 2 * CHANNELS
                m = j + CHANNELS
                t_x = t_up[k] - t_up[j] + two * (t_here[k] - t_here[j]) + t_down[k] - t_down[j]
                r_x = r_up[k] - r_up[j] + two * (r_here[k] - r_here[j]) + r_down[k] - r_down[j]
                t_y = t_down[j] - t_up[j] + two * (t_down[m] - t_up[m]) + t_down[k] - t_up[k]
                r_y = r_down[j] - r_up[j] + two * (r_down[m] - r_up[m]) + r_down[k] - r_up[k]
                product, weight = t_x * r_x + t_y * r_y, weights[m]
                total += abs(product) * weight
                signed = weight if product > zero else -weight
                signed = signed if product != zero else zero
                out_x[m + CHANNELS] = signed * r_x
                out_y[m + CHANNELS] = signed * r_y
            sums[row] = total

    return forward


@functools.cache
def conflict_backward(real: type) -> Kernel:
    """Fills the gradient of the transmission [H, W, 3], the transposed Sobel operators of the slopes."""
    two = real(2.0)

    @kernel("gradient_conflict_backward", real)
    def backward(slopes, v_mean, v_transmission):
        height, width = v_transmission.shape[:2]
        floats = CHANNELS * width
        out = v_transmission.reshape(height, floats)
        for row in prange(height):
            x_up, x_here, x_down = slopes[0, row], slopes[0, row + 1], slopes[0, row + 2]
            y_up, y_down = slopes[1, row], slopes[1, row + 2]
            target = out[row]
            for j in range(floats):
                m, k = j + CHANNELS, j + 2 * CHANNELS
                across = x_up[j] - x_up[k] + two * (x_here[j] - x_here[k]) + x_down[j] - x_down[k]
                down = y_up[j] - y_down[j] + two * (y_up[m] - y_down[m]) + y_up[k] - y_down[k]
                target[j] = v_mean * (across + down)

    return backward
