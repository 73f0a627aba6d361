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

DARKEST = 0.05
"""sRGB value from which on the slope of linear light is taken to grow as the value, as of a gamma of 2."""
MOST_HELD = 2.0
"""Times what a pane adds, up to which a transmission may hold the edges of a reflection."""


def gradient_conflict(
    transmission: Tensor, reflection: Tensor, hit: Tensor, strength: Tensor | None = None, *, cell: int = 1
) -> Tensor:
    """Edges that transmission and reflection share, per colour channel and inner pixel (after TR-Gaussians, Eq. 15).

    In cells of a single pixel, and without a strength, that is Eq. 15: the mean of hit |grad C_t . grad C_r|. In larger
    cells it is their |sum of hit grad C_t . grad C_r|, which is small where edges only happen to meet.
    With a strength R, a cell counts by how much of the reflection the transmission seems to hold, in units of what a
    pane of that strength adds: s, the sum of grad C_t . grad C_r over that of R |grad C_r|^2, in linear light. What is
    left of a reflection has an s of 1, or of 2 where the reflection has found half of its contrast. From there to twice
    as much, cells count less and less: that is an edge of the transmission itself.

    Gradients are Sobel's; pixels on the image border are left out.
    Differentiable in `transmission` only, for which what cells count is constant: an edge of the reflection should not
    appear in the transmission, and the reflection is not to give way.

    Args:
        transmission: [H, W, 3] C_t, with H and W of at least 3.
        reflection: [H, W, 3] C_r.
        hit: [H, W] weight of each pixel, 1 where a pane is.
        strength: [H, W] R, the share of the light that is reflected; None counts all cells alike.
        cell: side of the cells, in pixels.

    Raises:
        ValueError: shapes disagree, an image is too small, or cells have no pixels.
        TypeError: tensors of different or unsupported floating-point types, or on different devices.
    """
    height, width = hit.shape
    if height < 3 or width < 3:
        raise ValueError(f"the images are {width} x {height} pixels; expected at least 3 x 3 for Sobel derivatives")
    if cell < 1:
        raise ValueError(f"cell is {cell}; expected at least one pixel")
    shape = (height, width, 3)
    check_tensors(
        {"transmission": (transmission, shape), "reflection": (reflection, shape), "hit": (hit, (height, width))}
        | ({} if strength is None else {"strength": (strength, (height, width))})
    )
    if transmission.device.type != "cpu":
        # On a GPU these few sums over an image are no bottleneck, so that there they stay PyTorch's.
        return gradient_conflict_in_torch(transmission, reflection, hit, strength, cell=cell)
    mean: Tensor = _GradientConflict.apply(transmission, reflection, hit, strength, cell)
    return mean


class _GradientConflict(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, transmission: Tensor, reflection: Tensor, hit: Tensor, strength: Tensor | None, cell: int
    ) -> Tensor:
        height, width = hit.shape
        shown_mask = hit if strength is None else strength
        images = (tensor.detach().contiguous() for tensor in (transmission, reflection, hit, shown_mask))
        # A ring of zeros around the derivatives spares the backward pass all questions about the border.
        slopes = transmission.new_zeros(2, height + 2, 3 * (width + 2))
        sums = torch.zeros(-(-(height - 2) // cell), dtype=torch.float64, device=hit.device)
        forward = conflict_forward(REAL_OF[hit.dtype])
        forward(*(t.numpy() for t in images), strength is not None, cell, slopes.numpy(), sums.numpy())
        ctx.save_for_backward(slopes)
        ctx.count = 3 * (height - 2) * (width - 2)
        return (sums.sum() / ctx.count).to(transmission.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_mean: Tensor) -> tuple[Tensor | None, ...]:
        (slopes,) = ctx.saved_tensors
        real = REAL_OF[slopes.dtype]
        v_transmission = slopes.new_empty(slopes.shape[1] - 2, slopes.shape[2] // 3 - 2, 3)
        conflict_backward(real)(slopes.numpy(), real(v_mean.item() / ctx.count), v_transmission.numpy())
        return v_transmission, None, None, None, None


def gradient_conflict_in_torch(
    transmission: Tensor, reflection: Tensor, hit: Tensor, strength: Tensor | None = None, *, cell: int = 1
) -> Tensor:
    """The definition of `gradient_conflict`: Sobel derivatives of both images, multiplied and added up in cells."""
    reflection, weight = reflection.detach(), hit[1:-1, 1:-1, None]
    of_transmission, of_reflection = sobel(transmission), sobel(reflection)
    products = weight * (of_transmission[0] * of_reflection[0] + of_transmission[1] * of_reflection[1])
    shared = in_cells(products, cell)
    counted = torch.ones_like(shared)
    if strength is not None:
        with torch.no_grad():
            light_t, light_r = (image[1:-1, 1:-1].clamp(DARKEST, 1) for image in (transmission, reflection))
            squares = of_reflection[0].square() + of_reflection[1].square()
            held = in_cells(light_t * light_r * products, cell).abs()
            full = in_cells(weight * strength[1:-1, 1:-1, None] * light_r.square() * squares, cell)
            counted = torch.where(held > 0, (2 - held / (MOST_HELD * full)).clamp(0, 1), 1)
    return (counted * shared.abs()).sum() / products.numel()


def in_cells(values: Tensor, cell: int) -> Tensor:
    """Sums of values [H, W, C] over square cells of so many pixels; the last ones of a row or column may be smaller."""
    sums = torch.nn.functional.avg_pool2d(values.permute(2, 0, 1), cell, ceil_mode=True, divisor_override=1)
    return sums.permute(1, 2, 0)


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
    """Fills the sum of each row of cells, and slopes [2, H + 2, 3 (W + 2)], the derivatives by both of Sobel's images.

    Columns are added up first, and then cells, so that the loops over pixels are of one piece.
    """
    zero, one, two, darkest, most = real(0.0), real(1.0), real(2.0), real(DARKEST), real(MOST_HELD)

    @kernel("gradient_conflict_forward", real)
    def forward(transmission, reflection, hit, strength, is_told, cell, slopes, sums):
        height, width = hit.shape
        floats = CHANNELS * width
        t, r = transmission.reshape(height, floats), reflection.reshape(height, floats)
        for block in prange(len(sums)):
            top = 1 + block * cell
            bottom = min(top + cell, height - 1)
            shared: NDArray[Any] = np.zeros(floats, real)
            held: NDArray[Any] = np.zeros(floats, real)
            full: NDArray[Any] = np.zeros(floats, real)
            weights: NDArray[Any] = np.empty(floats, real)
            strengths: NDArray[Any] = np.empty(floats, real)
            for row in range(top, bottom):
                for x in range(width):
                    for d in range(CHANNELS):
                        weights[CHANNELS * x + d] = hit[row, x]
                        strengths[CHANNELS * x + d] = strength[row, x]
                t_up, t_here, t_down = t[row - 1], t[row], t[row + 1]
                r_up, r_here, r_down = r[row - 1], r[row], r[row + 1]
                out_x, out_y = slopes[0, row + 1], slopes[1, row + 1]
                for j in range(floats - 2 * CHANNELS):
                    k = j + 2 * CHANNELS
                    m = j + CHANNELS
                    t_x = t_up[k] - t_up[j] + two * (t_here[k] - t_here[j]) + t_down[k] - t_down[j]
                    r_x = r_up[k] - r_up[j] + two * (r_here[k] - r_here[j]) + r_down[k] - r_down[j]
                    t_y = t_down[j] - t_up[j] + two * (t_down[m] - t_up[m]) + t_down[k] - t_up[k]
                    r_y = r_down[j] - r_up[j] + two * (r_down[m] - r_up[m]) + r_down[k] - r_up[k]
                    weight = weights[m]
                    product = weight * (t_x * r_x + t_y * r_y)
                    shared[m] += product
                    out_x[m + CHANNELS] = weight * r_x
                    out_y[m + CHANNELS] = weight * r_y
                    if is_told:
                        light_t, light_r = min(max(t_here[m], darkest), one), min(max(r_here[m], darkest), one)
                        held[m] += light_t * light_r * product
                        full[m] += weight * strengths[m] * light_r * light_r * (r_x * r_x + r_y * r_y)
            total = zero
            factors = weights
            for left in range(1, width - 1, cell):
                right = min(left + cell, width - 1)
                for d in range(CHANNELS):
                    edges, holds, could = zero, zero, zero
                    for x in range(left, right):
                        edges += shared[CHANNELS * x + d]
                        holds += held[CHANNELS * x + d]
                        could += full[CHANNELS * x + d]
                    counted = one
                    if is_told and holds != zero:
                        counted = min(max(two - abs(holds) / (most * could), zero), one)
                    total += counted * abs(edges)
                    factor = counted if edges > zero else -counted
                    factor = factor if edges != zero else zero
                    for x in range(left, right):
                        factors[CHANNELS * x + d] = factor
            for row in range(top, bottom):
                for axis in range(2):
                    out = slopes[axis, row + 1]
                    for m in range(CHANNELS, floats - CHANNELS):
                        out[m + CHANNELS] *= factors[m]
            sums[block] = total

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
