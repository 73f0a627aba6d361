"""Shared edges on the CPU: an image row is one run of interleaved channels, a pixel's neighbour three floats away."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from glassplat.kernels.backend.cpu import Kernel, kernel

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
