"""Structural similarity on the GPU: separable blurs of tiles in shared memory, one block for each tile and channel."""

from __future__ import annotations

from functools import cache

import torch
from numba import cuda
from torch import Tensor

from glassplat.kernels.cuda.launch import Kernel, kernel
from glassplat.kernels.maths_ssim import RADIUS, ssim_maths
from glassplat.kernels.splats import TILE
from glassplat.kernels.tensor_checks import REAL_OF

CHANNELS = 3
PIXELS = TILE * TILE
WIDE = TILE + 2 * RADIUS
"""Edge of a tile with its margin."""
AREA, STRIP = WIDE * WIDE, WIDE * TILE


def ssim(image: Tensor, target: Tensor, *, with_slopes: bool) -> tuple[Tensor, Tensor, Tensor]:
    """As `glassplat.kernels.cpu.ssim.ssim`."""
    similarity = torch.empty_like(image)
    slopes = image.new_empty(3 if with_slopes else 0, *image.shape)
    ssim_forward(REAL_OF[image.dtype])(_blocks(image), PIXELS, image, target, similarity, slopes)
    return similarity.mean(), similarity, slopes


def ssim_gradient(image: Tensor, target: Tensor, slopes: Tensor, v_mean: Tensor) -> Tensor:
    """As `glassplat.kernels.cpu.ssim.ssim_gradient`."""
    v_image = torch.empty_like(image)
    scale = (v_mean / image.numel()).to(image.dtype).reshape(1)
    ssim_backward(REAL_OF[image.dtype])(_blocks(image), PIXELS, image, target, slopes, scale, v_image)
    return v_image


def _blocks(image: Tensor) -> int:
    return -(-image.shape[0] // TILE) * -(-image.shape[1] // TILE) * CHANNELS


@cache
def ssim_forward(real: type) -> Kernel:
    """Fills the similarity [H, W, 3] and, where they are not empty, its slopes [3, H, W, 3]."""
    blur, compare = ssim_maths(real)
    zero = real(0.0)

    @kernel("ssim_forward", real, "real3 real3 real3 real4")
    def forward(image, target, similarity, slopes):
        first = cuda.shared.array(AREA, real)
        second = cuda.shared.array(AREA, real)
        squares = cuda.shared.array(AREA, real)
        products = cuda.shared.array(AREA, real)
        blurred_first = cuda.shared.array(STRIP, real)
        blurred_second = cuda.shared.array(STRIP, real)
        blurred_squares = cuda.shared.array(STRIP, real)
        blurred_products = cuda.shared.array(STRIP, real)
        height, width, t = image.shape[0], image.shape[1], cuda.threadIdx.x
        tile, channel = cuda.blockIdx.x // CHANNELS, cuda.blockIdx.x % CHANNELS
        tile_columns = (width + TILE - 1) // TILE
        top, left = tile // tile_columns * TILE, tile % tile_columns * TILE
        for i in range(t, AREA, PIXELS):
            y, x = top + i // WIDE - RADIUS, left + i % WIDE - RADIUS
            a, b = zero, zero
            if 0 <= y < height and 0 <= x < width:
                a, b = image[y, x, channel], target[y, x, channel]
            first[i], second[i], squares[i], products[i] = a, b, a * a + b * b, a * b
        cuda.syncthreads()
        for i in range(t, STRIP, PIXELS):
            at = i // TILE * WIDE + i % TILE
            blurred_first[i] = blur(first, at, 1)
            blurred_second[i] = blur(second, at, 1)
            blurred_squares[i] = blur(squares, at, 1)
            blurred_products[i] = blur(products, at, 1)
        cuda.syncthreads()
        y, x = top + t // TILE, left + t % TILE
        if y >= height or x >= width:
            return
        value, by_mean, by_squares, by_product = compare(
            blur(blurred_first, t, TILE),
            blur(blurred_second, t, TILE),
            blur(blurred_squares, t, TILE),
            blur(blurred_products, t, TILE),
        )
        similarity[y, x, channel] = value
        if slopes.shape[0] > 0:
            slopes[0, y, x, channel] = by_mean
            slopes[1, y, x, channel] = by_squares
            slopes[2, y, x, channel] = by_product

    return forward


@cache
def ssim_backward(real: type) -> Kernel:
    """Fills the gradient of the image from the slopes and the factor `scale[0]`."""
    blur = ssim_maths(real).blur
    zero, two = real(0.0), real(2.0)

    @kernel("ssim_backward", real, "real3 real3 real4 real1 real3")
    def backward(image, target, slopes, scale, v_image):
        by_mean = cuda.shared.array(AREA, real)
        by_squares = cuda.shared.array(AREA, real)
        by_product = cuda.shared.array(AREA, real)
        blurred_mean = cuda.shared.array(STRIP, real)
        blurred_squares = cuda.shared.array(STRIP, real)
        blurred_product = cuda.shared.array(STRIP, real)
        height, width, t = image.shape[0], image.shape[1], cuda.threadIdx.x
        tile, channel = cuda.blockIdx.x // CHANNELS, cuda.blockIdx.x % CHANNELS
        tile_columns = (width + TILE - 1) // TILE
        top, left = tile // tile_columns * TILE, tile % tile_columns * TILE
        for i in range(t, AREA, PIXELS):
            y, x = top + i // WIDE - RADIUS, left + i % WIDE - RADIUS
            by_mean[i], by_squares[i], by_product[i] = zero, zero, zero
            if 0 <= y < height and 0 <= x < width:
                by_mean[i] = slopes[0, y, x, channel]
                by_squares[i] = slopes[1, y, x, channel]
                by_product[i] = slopes[2, y, x, channel]
        cuda.syncthreads()
        for i in range(t, STRIP, PIXELS):
            at = i // TILE * WIDE + i % TILE
            blurred_mean[i] = blur(by_mean, at, 1)
            blurred_squares[i] = blur(by_squares, at, 1)
            blurred_product[i] = blur(by_product, at, 1)
        cuda.syncthreads()
        y, x = top + t // TILE, left + t % TILE
        if y >= height or x >= width:
            return
        mean, square, product = (
            blur(blurred_mean, t, TILE),
            blur(blurred_squares, t, TILE),
            blur(blurred_product, t, TILE),
        )
        pull = mean + two * image[y, x, channel] * square + target[y, x, channel] * product
        v_image[y, x, channel] = scale[0] * pull

    return backward
