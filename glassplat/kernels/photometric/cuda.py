"""L1 and structural similarity on the GPU: separable blurs of tiles in shared memory.

There is one block per tile and channel. The forward pass stores the derivatives of each pixel's similarity, which the
backward pass blurs; recomputing them in its larger margin would cost more than reading them.
"""

from __future__ import annotations

from functools import cache

import torch
from numba import cuda
from torch import Tensor

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.backend.cuda import Kernel, kernel
from glassplat.kernels.maths.images import RADIUS, build_blur, build_compare
from glassplat.kernels.records import REAL_OF, TILE

CHANNELS = 3
PIXELS = TILE * TILE
WIDE = TILE + 2 * RADIUS
"""Side of a tile with its margin."""
AREA, STRIP = WIDE * WIDE, WIDE * TILE


def photometric(image: Tensor, target: Tensor, *, with_gradient: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Mean L1, mean similarity, and the similarity's derivatives [3, H, W, 3] (empty unless requested).

    These are of each pixel's similarity, by the blurred image, squares and product.
    """
    blocks = _blocks(image)
    derivatives = image.new_empty(3 if with_gradient else 0, *image.shape)
    sums = image.new_empty(blocks, 2)
    photometric_forward(REAL_OF[image.dtype])(blocks, PIXELS, image, target, derivatives, sums)
    l1, ssim = (sums.sum(dim=0) / image.numel()).unbind()
    return l1, ssim, derivatives


def photometric_gradient(image: Tensor, target: Tensor, derivatives: Tensor, v_l1: Tensor, v_ssim: Tensor) -> Tensor:
    """Gradient of the image, given the results of the forward pass."""
    v_image = torch.empty_like(image)
    weights = torch.stack([v_l1, v_ssim]) / image.numel()
    photometric_backward(REAL_OF[image.dtype])(_blocks(image), PIXELS, image, target, derivatives, weights, v_image)
    return v_image


def _blocks(image: Tensor) -> int:
    return -(-image.shape[0] // TILE) * -(-image.shape[1] // TILE) * CHANNELS


@inlined
def tile_origin(block, width):
    """Channel, first row and first column of a block's tile."""
    tile, columns = block // CHANNELS, (width + TILE - 1) // TILE
    return block % CHANNELS, tile // columns * TILE, tile % columns * TILE


@inlined
def tile_pixel(i, top, left):
    """Row and column of the i-th pixel of a tile with its margin; it may lie outside of the image."""
    return top + i // WIDE - RADIUS, left + i % WIDE - RADIUS


@cache
def photometric_forward(real: type) -> Kernel:
    """Fills derivatives [3, H, W, 3], where they are not empty, and each block's sums of L1 and similarity."""
    blur, compare, zero, white = build_blur(real), build_compare(real), real(0.0), real(255.0)

    @kernel("photometric_forward", real, "real3 byte3 real4 real2")
    def forward(image, target, derivatives, sums):
        first = cuda.shared.array(AREA, real)
        second = cuda.shared.array(AREA, real)
        squares = cuda.shared.array(AREA, real)
        products = cuda.shared.array(AREA, real)
        blurred_first = cuda.shared.array(STRIP, real)
        blurred_second = cuda.shared.array(STRIP, real)
        blurred_squares = cuda.shared.array(STRIP, real)
        blurred_products = cuda.shared.array(STRIP, real)
        height, width, t = image.shape[0], image.shape[1], cuda.threadIdx.x
        channel, top, left = tile_origin(cuda.blockIdx.x, width)
        for i in range(t, AREA, PIXELS):
            y, x = tile_pixel(i, top, left)
            a, b = zero, zero
            if 0 <= y < height and 0 <= x < width:
                a, b = image[y, x, channel], real(target[y, x, channel]) / white
            first[i], second[i], squares[i], products[i] = a, b, a * a + b * b, a * b
        cuda.syncthreads()
        for i in range(t, STRIP, PIXELS):
            at = i // TILE * WIDE + i % TILE
            blurred_first[i] = blur(first, at, 1)
            blurred_second[i] = blur(second, at, 1)
            blurred_squares[i] = blur(squares, at, 1)
            blurred_products[i] = blur(products, at, 1)
        y, x = top + t // TILE, left + t % TILE
        at = (t // TILE + RADIUS) * WIDE + t % TILE + RADIUS
        # Beyond the image both are zero.
        difference, similarity = abs(first[at] - second[at]), zero
        cuda.syncthreads()
        if y < height and x < width:
            similarity, by_mean, by_squares, by_product = compare(
                blur(blurred_first, t, TILE),
                blur(blurred_second, t, TILE),
                blur(blurred_squares, t, TILE),
                blur(blurred_products, t, TILE),
            )
            if derivatives.shape[0] > 0:
                derivatives[0, y, x, channel] = by_mean
                derivatives[1, y, x, channel] = by_squares
                derivatives[2, y, x, channel] = by_product
        # Squares and products are not needed any more; their memory serves a tree reduction, whose order is fixed.
        squares[t], products[t] = difference, similarity
        step = PIXELS // 2
        while step > 0:
            cuda.syncthreads()
            if t < step:
                squares[t] += squares[t + step]
                products[t] += products[t + step]
            step //= 2
        if t == 0:
            sums[cuda.blockIdx.x, 0], sums[cuda.blockIdx.x, 1] = squares[0], products[0]

    return forward


@cache
def photometric_backward(real: type) -> Kernel:
    """Fills the gradient of the image from the derivatives and the weights [2] of each pixel's L1 and similarity."""
    blur = build_blur(real)
    zero, two, white = real(0.0), real(2.0), real(255.0)

    @kernel("photometric_backward", real, "real3 byte3 real4 real1 real3")
    def backward(image, target, derivatives, weights, v_image):
        by_mean = cuda.shared.array(AREA, real)
        by_squares = cuda.shared.array(AREA, real)
        by_product = cuda.shared.array(AREA, real)
        blurred_mean = cuda.shared.array(STRIP, real)
        blurred_squares = cuda.shared.array(STRIP, real)
        blurred_product = cuda.shared.array(STRIP, real)
        height, width, t = image.shape[0], image.shape[1], cuda.threadIdx.x
        channel, top, left = tile_origin(cuda.blockIdx.x, width)
        for i in range(t, AREA, PIXELS):
            y, x = tile_pixel(i, top, left)
            by_mean[i], by_squares[i], by_product[i] = zero, zero, zero
            if 0 <= y < height and 0 <= x < width:
                by_mean[i] = derivatives[0, y, x, channel]
                by_squares[i] = derivatives[1, y, x, channel]
                by_product[i] = derivatives[2, y, x, channel]
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
        a, b = image[y, x, channel], real(target[y, x, channel]) / white
        ssim_gradient = mean + two * a * square + b * product
        sign = weights[0] if a > b else (-weights[0] if a < b else zero)
        v_image[y, x, channel] = sign + weights[1] * ssim_gradient

    return backward
