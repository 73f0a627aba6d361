"""The slopes on the CPU, row by row: greys first, so that the curves of the colour space become vector instructions."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from glassplat.kernels.backend.cpu import Kernel, kernel
from glassplat.kernels.maths.color import color_space_maths

CHUNK = 4096
"""Splats per task."""


@functools.cache
def layer_slopes_kernel(real: type) -> Kernel:
    """Fills both images [H, W]."""
    linear_of, linear_slope, encoded, encoded_slope = color_space_maths(real)
    zero, one, third = real(0.0), real(1.0), real(1.0 / 3.0)

    @kernel("layer_slopes", real)
    def slopes(strength, transmission, reflection, where, linear, through, mirrored):
        height, width = strength.shape
        for row in prange(height):
            greys: NDArray[Any] = np.empty((2, width), real)
            for x in range(width):
                t, r = transmission[row, x], reflection[row, x]
                greys[0, x] = (t[0] + t[1] + t[2]) * third
                greys[1, x] = (r[0] + r[1] + r[2]) * third
            behind, mirror_image, share = greys[0], greys[1], strength[row]
            shown, out_through, out_mirrored = where[row], through[row], mirrored[row]
            for x in range(width):
                by_behind, by_mirror_image = one - share[x], share[x]
                if linear:
                    lit, bright = linear_of(behind[x]), linear_of(mirror_image[x])
                    light = lit + share[x] * (bright - lit)
                    slope = encoded_slope(light, encoded(light))
                    by_behind *= slope * linear_slope(behind[x], lit)
                    by_mirror_image *= slope * linear_slope(mirror_image[x], bright)
                out_through[x] = by_behind if shown[x] else one
                out_mirrored[x] = by_mirror_image if shown[x] else zero

    return slopes


@functools.cache
def slopes_at_kernel(real: type) -> Kernel:
    """Fills what is found at the centres [C, N]."""
    zero, one = real(0.0), real(1.0)

    @kernel("slopes_at", real)
    def slopes_at(slopes, near, means2d, depths, found):
        (height, width), (cameras, count) = slopes.shape, depths.shape
        right, bottom = real(width - 1), real(height - 1)
        chunks = (count + CHUNK - 1) // CHUNK
        for task in prange(cameras * chunks):
            c, chunk = task // chunks, task % chunks
            for n in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
                if not depths[c, n] > zero:  # As where a splat is not seen; no surface is that near.
                    found[c, n] = one
                    continue
                x, y = means2d[c, n, 0], means2d[c, n, 1]
                # Clamped before the conversion, so that infinities are well defined; NaN is the first pixel.
                column = np.int64(min(x, right)) if x > zero else 0
                row = np.int64(min(y, bottom)) if y > zero else 0
                found[c, n] = slopes[row, column] if depths[c, n] > near[row, column] else one

    return slopes_at
