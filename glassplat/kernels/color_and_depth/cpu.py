"""Image and depths on the CPU: rows of pixels, each read once."""

from __future__ import annotations

from functools import cache

from numba import prange

from glassplat.kernels.backend.cpu import Kernel, kernel
from glassplat.kernels.records import LEAST_ALPHA


@cache
def color_and_depth_forward(real: type) -> Kernel:
    """Fills the image [H, W, 3] and the depths [H, W]."""
    zero, one, least = real(0.0), real(1.0), real(LEAST_ALPHA)

    @kernel("color_and_depth_forward", real)
    def forward(image, alpha, background, colors, depths):
        height, width = alpha.shape
        red, green, blue = background
        for row in prange(height):
            for x in range(width):
                covered = alpha[row, x]
                through = one - covered
                colors[row, x, 0] = image[row, x, 0] + through * red
                colors[row, x, 1] = image[row, x, 1] + through * green
                colors[row, x, 2] = image[row, x, 2] + through * blue
                depths[row, x] = image[row, x, 3] / max(covered, least) if covered > least else zero

    return forward


@cache
def color_and_depth_backward(real: type) -> Kernel:
    """Fills the gradients of blended image and alpha; cotangents that are empty count as 0."""
    zero, one, least = real(0.0), real(1.0), real(LEAST_ALPHA)

    @kernel("color_and_depth_backward", real)
    def backward(alpha, depths, v_colors, v_depths, background, v_image, v_alpha):
        height, width = alpha.shape
        red, green, blue = background
        from_colors, from_depths = v_colors.size > 0, v_depths.size > 0
        for row in prange(height):
            for x in range(width):
                v_image[row, x, 0] = v_image[row, x, 1] = v_image[row, x, 2] = v_image[row, x, 3] = zero
                v_alpha[row, x] = zero
                if from_colors:
                    v_red, v_green, v_blue = v_colors[row, x, 0], v_colors[row, x, 1], v_colors[row, x, 2]
                    v_image[row, x, 0], v_image[row, x, 1], v_image[row, x, 2] = v_red, v_green, v_blue
                    v_alpha[row, x] = -(v_red * red + v_green * green + v_blue * blue)
                if from_depths and alpha[row, x] > least:
                    slope = v_depths[row, x] * (one / alpha[row, x])
                    v_image[row, x, 3] = slope
                    v_alpha[row, x] -= slope * depths[row, x]

    return backward
