"""The statistics on the CPU: one pass over the Gaussians."""

from __future__ import annotations

import functools
import math

from numba import prange

from glassplat.kernels.backend.cpu import Kernel, kernel

CHUNK = 1024
"""Gaussians per task."""


@functools.cache
def add_views_kernel(real: type) -> Kernel:
    """Adds to the first `rows` rows of the sums; `weight` is [C, N], or [1, 1] where it is the same for all."""
    half, zero = real(0.5), real(0.0)

    @kernel("screen_statistics", real)
    def add(
        gradient_sum, pull_sum, view_count, max_radius, v_means2d, v_probe, radii, weight, width, height, rows
    ):  # fmt: skip
        cameras, count = radii.shape[0], radii.shape[1]
        right, down, longer = half * real(width), half * real(height), real(max(width, height))
        for chunk in prange((count + CHUNK - 1) // CHUNK):
            for n in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
                gradient = pull = views = radius = zero
                for c in range(cameras):
                    if radii[c, n, 0] > zero and radii[c, n, 1] > zero:
                        x, y = right * v_means2d[c, n, 0], down * v_means2d[c, n, 1]
                        gradient += math.sqrt(x * x + y * y)
                        x, y = right * v_probe[c, n, 0], down * v_probe[c, n, 1]
                        pull += math.sqrt(x * x + y * y)
                        views += weight[c, n] if weight.size > 1 else weight[0, 0]
                        radius = max(radius, radii[c, n, 0], radii[c, n, 1])
                for row in range(rows):
                    gradient_sum[row, n] += gradient
                    pull_sum[row, n] += pull
                    view_count[row, n] += views
                max_radius[n] = max(max_radius[n], radius / longer)

    return add
