"""Structural similarity on the CPU: separable blurs of small tiles that stay in the cache.

An image row is taken as one run of interleaved channels, so that a horizontal tap is three floats away and every loop
runs over contiguous memory. Squares need no blur of their own per image: similarity depends on their sum only.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from glassplat.kernels.cpu.jit import Kernel, inlined, kernel
from glassplat.kernels.maths_blend import Scalar
from glassplat.kernels.maths_ssim import RADIUS, ssim_maths

CHANNELS = 3

ROWS = 32
COLUMNS = 240
"""Columns of a tile; like all columns here, floats and not pixels."""
MARGIN = RADIUS * CHANNELS
STRIDE = COLUMNS + 2 * MARGIN + 2
PLANE = (ROWS + 2 * RADIUS) * STRIDE
# Planes of one tile with its margin, then one row of each after the vertical blur, then rows of results. One flat
# buffer with offsets known to the compiler lets it see that they never overlap, so that loops become vector code.
PLANES = 4
BLURRED = PLANES * PLANE
RESULTS = BLURRED + PLANES * STRIDE
SCRATCH = RESULTS + PLANES * STRIDE


def ssim(image: Tensor, target: Tensor, *, with_slopes: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Mean similarity, its map [H, W, 3], and its slopes [3, H, W, 3] (empty unless asked for).

    Slopes are the derivatives of each value of the map by the blurred image, squares and product.
    """
    real = _real_of(image)
    height, width, _ = image.shape
    similarity = torch.empty_like(image)
    slopes = image.new_empty(3 if with_slopes else 0, height, width, CHANNELS)
    sums = np.zeros(-(-height // ROWS), np.float64)
    _forward(real)(_rows(image), _rows(target), _rows(similarity), _planes(slopes), sums)
    return image.new_tensor(sums.sum() / image.numel()), similarity, slopes


def ssim_gradient(image: Tensor, target: Tensor, slopes: Tensor, v_mean: Tensor) -> Tensor:
    """Gradient of the mean similarity with respect to the image, times `v_mean`."""
    real = _real_of(image)
    v_image = torch.empty_like(image)
    _backward(real)(_rows(image), _rows(target), _planes(slopes), real(v_mean.item() / image.numel()), _rows(v_image))
    return v_image


def _real_of(image: Tensor) -> Any:
    return np.float64 if image.dtype == torch.float64 else np.float32


def _rows(image: Tensor) -> NDArray[Any]:
    return image.numpy().reshape(image.shape[0], -1)


def _planes(slopes: Tensor) -> NDArray[Any]:
    return slopes.numpy().reshape(*slopes.shape[:2], slopes.shape[2] * CHANNELS)


def _blur_row(real: type) -> Scalar:
    blur = ssim_maths(real).blur

    @inlined
    def blur_row(scratch, row, planes):
        """Blurs one row of each plane vertically, into the rows at `BLURRED`."""
        for plane in range(planes):
            source, to = (plane & 3) * PLANE + (row & 31) * STRIDE, BLURRED + (plane & 3) * STRIDE
            for j in range(STRIDE):
                scratch[to + j] = blur(scratch, source + j, STRIDE)

    return blur_row


def _load_row(real: type) -> Scalar:
    zero = real(0.0)

    @inlined
    def load_row(scratch, at, image, y, left):
        """Copies a tile's row with its margin; what lies beyond the image is zero."""
        for j in range(STRIDE):
            scratch[at + j] = zero
        if y < 0 or y >= image.shape[0]:
            return
        values, skipped = image[y, max(0, left - MARGIN) : left + COLUMNS + MARGIN], max(0, MARGIN - left) & 15
        for j in range(values.size):
            scratch[at + skipped + j] = values[j]

    return load_row


@functools.cache
def _forward(real: type) -> Kernel:
    (blur, compare), blur_row, load_row = ssim_maths(real), _blur_row(real), _load_row(real)
    zero = real(0.0)

    @inlined
    def load(scratch, image, target, top, left):
        for row in range(ROWS + 2 * RADIUS):
            at = (row & 63) * STRIDE
            load_row(scratch, at, image, top - RADIUS + row, left)
            load_row(scratch, PLANE + at, target, top - RADIUS + row, left)
            for j in range(STRIDE):
                a, b = scratch[at + j], scratch[PLANE + at + j]
                scratch[2 * PLANE + at + j] = a * a + b * b
                scratch[3 * PLANE + at + j] = a * b

    @inlined
    def compare_row(scratch):
        """Similarity of one row and its slopes, from the blurred rows."""
        for j in range(COLUMNS):
            mean_a = blur(scratch, BLURRED + j, CHANNELS)
            mean_b = blur(scratch, BLURRED + STRIDE + j, CHANNELS)
            squares = blur(scratch, BLURRED + 2 * STRIDE + j, CHANNELS)
            product = blur(scratch, BLURRED + 3 * STRIDE + j, CHANNELS)
            value, by_mean, by_squares, by_product = compare(mean_a, mean_b, squares, product)
            scratch[RESULTS + j] = value
            scratch[RESULTS + STRIDE + j] = by_mean
            scratch[RESULTS + 2 * STRIDE + j] = by_squares
            scratch[RESULTS + 3 * STRIDE + j] = by_product

    @kernel("ssim_forward", real)
    def forward(image, target, similarity, slopes, sums):
        height, width = image.shape
        for n in prange(sums.size):
            top, total = n * ROWS, 0.0
            scratch: NDArray[Any] = np.empty(SCRATCH, real)
            for left in range(0, width, COLUMNS):
                load(scratch, image, target, top, left)
                for y in range(top, min(top + ROWS, height)):
                    blur_row(scratch, y - top, PLANES)
                    compare_row(scratch)
                    out, row_sum = similarity[y, left : left + COLUMNS], zero
                    for j in range(out.size):
                        out[j] = scratch[RESULTS + j]
                        row_sum += scratch[RESULTS + j]
                    total += row_sum
                    for plane in range(slopes.shape[0]):
                        out, at = slopes[plane, y, left : left + COLUMNS], RESULTS + (1 + (plane & 3)) * STRIDE
                        for j in range(out.size):
                            out[j] = scratch[at + j]
            sums[n] = total

    return forward


@functools.cache
def _backward(real: type) -> Kernel:
    blur, blur_row, load_row = ssim_maths(real).blur, _blur_row(real), _load_row(real)
    two = real(2.0)

    @kernel("ssim_backward", real)
    def backward(image, target, slopes, scale, v_image):
        height, width = image.shape
        for n in prange((height + ROWS - 1) // ROWS):
            top = n * ROWS
            scratch: NDArray[Any] = np.empty(SCRATCH, real)
            for left in range(0, width, COLUMNS):
                for plane in range(3):
                    for row in range(ROWS + 2 * RADIUS):
                        at = (plane & 3) * PLANE + (row & 63) * STRIDE
                        load_row(scratch, at, slopes[plane], top - RADIUS + row, left)
                for y in range(top, min(top + ROWS, height)):
                    blur_row(scratch, y - top, 3)
                    for j in range(COLUMNS):
                        scratch[RESULTS + j] = blur(scratch, BLURRED + j, CHANNELS)
                        scratch[RESULTS + STRIDE + j] = blur(scratch, BLURRED + STRIDE + j, CHANNELS)
                        scratch[RESULTS + 2 * STRIDE + j] = blur(scratch, BLURRED + 2 * STRIDE + j, CHANNELS)
                    a, b = image[y, left : left + COLUMNS], target[y, left : left + COLUMNS]
                    out = v_image[y, left : left + COLUMNS]
                    for j in range(out.size):
                        by_squares, by_product = scratch[RESULTS + STRIDE + j], scratch[RESULTS + 2 * STRIDE + j]
                        out[j] = scale * (scratch[RESULTS + j] + two * a[j] * by_squares + b[j] * by_product)

    return backward
