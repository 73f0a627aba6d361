"""Structural similarity on the CPU: separable blurs of small tiles that stay in the cache.

An image row is taken as one run of interleaved channels, so that a horizontal tap is three floats away and every loop
runs over contiguous memory. Squares need no blur of their own per image: similarity depends on their sum only.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from glassplat.kernels.cpu.jit import Kernel, inlined, kernel
from glassplat.kernels.maths_blend import Scalar

RADIUS = 5
SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2
CHANNELS = 3

ROWS = 32
COLUMNS = 240  # A multiple of the three channels; counts floats, not pixels.
MARGIN = RADIUS * CHANNELS
STRIDE = COLUMNS + 2 * MARGIN + 2
PLANE = (ROWS + 2 * RADIUS) * STRIDE
# Planes of one tile with its margin, then one row of each after the vertical blur.
PLANES = 4
BLURRED = PLANES * PLANE


def ssim(image: Tensor, target: Tensor, *, with_slopes: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Mean similarity, its map [H, W, 3], and its slopes [3, H, W, 3] (empty unless asked for).

    Slopes are the derivatives of each value of the map by the blurred image, squares and product.
    """
    real = _real_of(image)
    height, width, _ = image.shape
    similarity = torch.empty_like(image)
    slopes = image.new_empty(3 if with_slopes else 0, height, width, CHANNELS)
    sums = np.zeros(_tile_rows(height) * _tile_columns(width), np.float64)
    _forward(real)(_rows(image), _rows(target), _rows(similarity), _planes(slopes), sums)
    return image.new_tensor(sums.sum() / image.numel()), similarity, slopes


def ssim_gradient(image: Tensor, target: Tensor, slopes: Tensor, v_mean: float) -> Tensor:
    """Gradient of the mean similarity with respect to the image, times `v_mean`."""
    real = _real_of(image)
    v_image = torch.empty_like(image)
    _backward(real)(_rows(image), _rows(target), _planes(slopes), real(v_mean / image.numel()), _rows(v_image))
    return v_image


def window() -> list[float]:
    """The 11 weights of the Gaussian window; they sum to one."""
    weights = [math.exp(-0.5 * (offset / SIGMA) ** 2) for offset in range(-RADIUS, RADIUS + 1)]
    return [weight / sum(weights) for weight in weights]


def _real_of(image: Tensor) -> Any:
    return np.float64 if image.dtype == torch.float64 else np.float32


def _rows(image: Tensor) -> NDArray[Any]:
    return image.numpy().reshape(image.shape[0], -1)


def _planes(slopes: Tensor) -> NDArray[Any]:
    return slopes.numpy().reshape(*slopes.shape[:2], slopes.shape[2] * CHANNELS)


def _tile_rows(height: int) -> int:
    return -(-height // ROWS)


def _tile_columns(width: int) -> int:
    return -(-width * CHANNELS // COLUMNS)


def _blur(real: type) -> Scalar:
    w0, w1, w2, w3, w4, w5 = (real(weight) for weight in window()[: RADIUS + 1])

    @inlined
    def blur(values, at, step):
        """Weighted sum of 11 values, `step` apart, the first of them at `at`."""
        outer = w0 * (values[at] + values[at + 10 * step]) + w1 * (values[at + step] + values[at + 9 * step])
        middle = w2 * (values[at + 2 * step] + values[at + 8 * step]) + w3 * (
            values[at + 3 * step] + values[at + 7 * step]
        )
        return outer + middle + w4 * (values[at + 4 * step] + values[at + 6 * step]) + w5 * values[at + 5 * step]

    return blur


def _blur_row(real: type) -> Scalar:
    blur = _blur(real)

    @inlined
    def blur_row(scratch, row, planes):
        """Blurs one row of each plane vertically, into the rows at `BLURRED`."""
        for plane in range(planes):
            source, to = (plane & 3) * PLANE + (row & 31) * STRIDE, BLURRED + (plane & 3) * STRIDE
            for j in range(STRIDE):
                scratch[to + j] = blur(scratch, source + j, STRIDE)

    return blur_row


@functools.cache
def _forward(real: type) -> Kernel:
    blur, blur_row = _blur(real), _blur_row(real)
    zero, one, two, c1, c2 = real(0.0), real(1.0), real(2.0), real(C1), real(C2)

    @inlined
    def load(scratch, image, target, top, left):
        for row in range(ROWS + 2 * RADIUS):
            y, at = top - RADIUS + row, (row & 63) * STRIDE
            if y < 0 or y >= image.shape[0]:
                continue
            first, last = max(0, MARGIN - left), min(COLUMNS + 2 * MARGIN, image.shape[1] - left + MARGIN)
            for j in range(first, last):
                a, b = image[y, left - MARGIN + j], target[y, left - MARGIN + j]
                scratch[at + j] = a
                scratch[PLANE + at + j] = b
                scratch[2 * PLANE + at + j] = a * a + b * b
                scratch[3 * PLANE + at + j] = a * b

    @kernel("ssim_forward", real)
    def forward(image, target, similarity, slopes, sums):
        height, width = image.shape
        tile_columns = (width + COLUMNS - 1) // COLUMNS
        for n in prange(sums.size):
            top, left = n // tile_columns * ROWS, n % tile_columns * COLUMNS
            rows, columns = min(ROWS, height - top), min(COLUMNS, width - left)
            scratch = np.zeros(PLANES * (PLANE + STRIDE), real)
            load(scratch, image, target, top, left)
            total = 0.0
            for row in range(rows):
                blur_row(scratch, row, PLANES)
                y, row_sum = top + row, zero
                for j in range(columns):
                    mean_a = blur(scratch, BLURRED + j, CHANNELS)
                    mean_b = blur(scratch, BLURRED + STRIDE + j, CHANNELS)
                    squares = blur(scratch, BLURRED + 2 * STRIDE + j, CHANNELS)
                    product = blur(scratch, BLURRED + 3 * STRIDE + j, CHANNELS)
                    means, mean_squares = mean_a * mean_b, mean_a * mean_a + mean_b * mean_b
                    a1, a2 = two * means + c1, two * (product - means) + c2
                    b1, b2 = one / (mean_squares + c1), one / (squares - mean_squares + c2)
                    value = a1 * a2 * b1 * b2
                    row_sum += value
                    similarity[y, left + j] = value
                    if slopes.shape[0] > 0:
                        by_mean = two * (mean_b * (a2 - a1) * b1 * b2 + mean_a * value * (b2 - b1))
                        slopes[0, y, left + j] = by_mean
                        slopes[1, y, left + j] = -value * b2
                        slopes[2, y, left + j] = two * a1 * b1 * b2
                total += row_sum
            sums[n] = total

    return forward


@functools.cache
def _backward(real: type) -> Kernel:
    blur, blur_row = _blur(real), _blur_row(real)
    two = real(2.0)

    @inlined
    def load(scratch, slopes, top, left):
        for row in range(ROWS + 2 * RADIUS):
            y, at = top - RADIUS + row, (row & 63) * STRIDE
            if y < 0 or y >= slopes.shape[1]:
                continue
            first, last = max(0, MARGIN - left), min(COLUMNS + 2 * MARGIN, slopes.shape[2] - left + MARGIN)
            for plane in range(3):
                for j in range(first, last):
                    scratch[plane * PLANE + at + j] = slopes[plane, y, left - MARGIN + j]

    @kernel("ssim_backward", real)
    def backward(image, target, slopes, scale, v_image):
        height, width = image.shape
        tile_rows, tile_columns = (height + ROWS - 1) // ROWS, (width + COLUMNS - 1) // COLUMNS
        for n in prange(tile_rows * tile_columns):
            top, left = n // tile_columns * ROWS, n % tile_columns * COLUMNS
            rows, columns = min(ROWS, height - top), min(COLUMNS, width - left)
            scratch = np.zeros(PLANES * (PLANE + STRIDE), real)
            load(scratch, slopes, top, left)
            for row in range(rows):
                blur_row(scratch, row, 3)
                y = top + row
                for j in range(columns):
                    by_mean = blur(scratch, BLURRED + j, CHANNELS)
                    by_squares = blur(scratch, BLURRED + STRIDE + j, CHANNELS)
                    by_product = blur(scratch, BLURRED + 2 * STRIDE + j, CHANNELS)
                    a, b = image[y, left + j], target[y, left + j]
                    v_image[y, left + j] = scale * (by_mean + two * a * by_squares + b * by_product)

    return backward
