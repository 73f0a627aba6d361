"""Two terms of the loss, each added up in one pass: edges that two images share, and the energy of harmonics.

PyTorch writes all products down before it adds them up; on a GPU that is no bottleneck, and there it stays PyTorch's.
"""

from __future__ import annotations

import functools
from functools import cache
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


CHUNK = 1024
"""Gaussians per task; part of the result's rounding, so not to be tuned per machine."""
COLORS = 3


def harmonic_energy(sh: Tensor) -> Tensor:
    """Sum of the squares of all harmonics but the constant ones. Differentiable.

    Args:
        sh: [N, K, 3] coefficients, the constant one first.

    Raises:
        ValueError: it has another shape.
        TypeError: it is neither float32 nor float64, or not where there are kernels.
    """
    check_tensors({"sh": (sh, (sh.shape[0], *sh.shape[1:2], 3))})
    node = _EnergyOnCpu if sh.device.type == "cpu" else _EnergyInTorch
    energy: Tensor = node.apply(sh)
    return energy


class _EnergyOnCpu(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sh: Tensor) -> Tensor:
        sh = sh.detach().contiguous()
        ctx.save_for_backward(sh)
        sums = torch.empty(-(-sh.shape[0] // CHUNK), dtype=torch.float64, device=sh.device)
        energy_forward(REAL_OF[sh.dtype])(sh.numpy(), sums.numpy())
        return sums.sum().to(sh.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_energy: Tensor) -> Tensor:
        (sh,) = ctx.saved_tensors
        gradient, real = torch.empty_like(sh), REAL_OF[sh.dtype]
        energy_backward(real)(sh.numpy(), real(2 * v_energy.item()), gradient.numpy())
        return gradient


class _EnergyInTorch(torch.autograd.Function):
    """PyTorch's operations as one node, for a GPU: autograd would fill and add a gradient of the slice."""

    @staticmethod
    def forward(ctx: Any, sh: Tensor) -> Tensor:
        ctx.save_for_backward(sh)
        return sh[:, 1:].square().sum()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_energy: Tensor) -> Tensor:
        (sh,) = ctx.saved_tensors
        gradient = (2 * v_energy) * sh
        gradient[:, :1].zero_()
        return gradient


@cache
def energy_forward(real: type) -> Kernel:
    """Fills the sum of each chunk of Gaussians."""

    @kernel("harmonic_energy_forward", real)
    def forward(sh, sums):
        count, floats = sh.shape[0], sh.shape[1] * COLORS
        rows = sh.reshape(count, floats)
        for chunk in prange(sums.size):
            # A sum for each column, so that a row is a few vectors.
            squares: NDArray[Any] = np.zeros(floats, real)
            for n in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
                for j in range(floats):
                    squares[j] += rows[n, j] * rows[n, j]
            total = 0.0
            for j in range(COLORS, floats):
                total += np.float64(squares[j])
            sums[chunk] = total

    return forward


@cache
def energy_backward(real: type) -> Kernel:
    """Fills the gradient: `factor` times the harmonics, and 0 for the constant ones."""
    zero = real(0.0)

    @kernel("harmonic_energy_backward", real)
    def backward(sh, factor, gradient):
        count, floats = sh.shape[0], sh.shape[1] * COLORS
        rows, found = sh.reshape(count, floats), gradient.reshape(count, floats)
        for chunk in prange((count + CHUNK - 1) // CHUNK):
            for n in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
                row, out = rows[n], found[n]
                for j in range(floats):
                    out[j] = factor * row[j]
                for j in range(min(COLORS, floats)):
                    out[j] = zero

    return backward
