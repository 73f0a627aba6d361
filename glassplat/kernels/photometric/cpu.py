"""L1 and structural similarity on the CPU in one pass, with the gradient of the similarity if requested.

A tile is a range of columns in a strip of rows. Rows enter it from above in groups. They are blurred along the row,
then down the columns, and compared; the derivatives of the similarity are blurred in the same two steps. All
intermediate results thus stay in the cache. An image row is treated as one array of interleaved channels: horizontal
taps are three floats apart, and every loop runs over contiguous memory. The squares of both images share one blur,
because similarity depends on their sum only.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from glassplat.kernels.backend.cpu import Kernel, inlined, kernel
from glassplat.kernels.maths.blending import Scalar
from glassplat.kernels.maths.images import RADIUS, build_blur, build_compare
from glassplat.kernels.records import REAL_OF

CHANNELS = 3
MARGIN = RADIUS * CHANNELS

ROWS = 76
"""Rows of a tile; with two margins above and below they fill six groups."""
COLUMNS = 256
"""Columns of a tile; all columns here count floats, not pixels."""
WIDE = COLUMNS + 2 * 16
"""Columns with one margin on either side, rounded up to whole vectors."""
STRIDE = WIDE + 2 * 16
GROUP = 16
"""Rows that enter a tile at once; ten rows before them are still needed."""
TOGETHER = 4
"""Rows that are blurred vertically at once, because they share most of their inputs."""

# With one flat buffer and constant offsets the compiler sees that its parts never overlap, and vectorises the loops. A
# plane holds the rows that are needed at a time; it has 32, so that a mask can bound the row's index.
PLANE = 32 * STRIDE
ENTERED = 0  # One row of image, photograph, sum of squares and product,
BLURRED = ENTERED + 4 * STRIDE  # a plane of each after the blur along the row,
RESULTS = BLURRED + 4 * PLANE  # four rows of each after the blur down the columns,
DERIVATIVES = RESULTS + 4 * TOGETHER * STRIDE  # one row of similarity and three derivatives,
BLURRED_DERIVATIVES = DERIVATIVES + 4 * STRIDE  # and a plane of each derivative after the blur along the row.
SCRATCH = BLURRED_DERIVATIVES + 3 * PLANE


def photometric(image: Tensor, target: Tensor, *, with_gradient: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Mean L1, mean similarity, and the gradient [H, W, 3] of the similarity's sum (empty unless requested)."""
    height, width, _ = image.shape
    ssim_gradient = image.new_empty(image.shape if with_gradient else (0, 0, CHANNELS))
    sums = np.zeros((-(-height // ROWS) * -(-width * CHANNELS // COLUMNS), 2), np.float64)
    _forward(REAL_OF[image.dtype])(image.flatten(1), target.flatten(1), ssim_gradient.flatten(1), sums)
    l1, ssim = (torch.tensor(total / image.numel(), dtype=image.dtype) for total in sums.sum(axis=0))
    return l1, ssim, ssim_gradient


def photometric_gradient(image: Tensor, target: Tensor, ssim_gradient: Tensor, v_l1: Tensor, v_ssim: Tensor) -> Tensor:
    """Gradient of the image, given the results of the forward pass."""
    real, v_image = REAL_OF[image.dtype], torch.empty_like(image)
    weights = (real(v.item() / image.numel()) for v in (v_l1, v_ssim))
    _backward(real)(image.flatten(1), target.flatten(1), ssim_gradient.flatten(1), *weights, v_image.flatten(1))
    return v_image


def _brightness(real: type) -> Scalar:
    per_step = 1.0 / 255.0

    @inlined
    def brightness(byte):
        """A byte scaled to [0, 1]; in double precision, so that it is the number nearest to the quotient."""
        return real(np.float64(byte) * per_step)

    return brightness


def _enter(real: type) -> Scalar:
    blur, brightness, zero = build_blur(real), _brightness(real), real(0.0)

    @inlined
    def enter(scratch, image, target, y, left, row):
        """Blurs an image row of a tile, with its margins, into row `row` of the planes; beyond the image it is zero."""
        begin, end = max(0, left - 2 * MARGIN), min(image.shape[1], left + COLUMNS + 2 * MARGIN)
        inside, skipped = 0 <= y < image.shape[0], (begin - left + 2 * MARGIN) & 31
        for j in range(0 if inside and end - begin == COLUMNS + 4 * MARGIN else 4 * STRIDE):
            scratch[ENTERED + j] = zero
        if inside:
            a, b = image[y, begin:end], target[y, begin:end]
            for j in range(a.size):
                own, wanted = a[j], brightness(b[j])
                scratch[ENTERED + skipped + j] = own
                scratch[ENTERED + STRIDE + skipped + j] = wanted
                scratch[ENTERED + 2 * STRIDE + skipped + j] = own * own + wanted * wanted
                scratch[ENTERED + 3 * STRIDE + skipped + j] = own * wanted
        for plane in range(4):
            source, to = ENTERED + (plane & 3) * STRIDE, BLURRED + (plane & 3) * PLANE + (row & 31) * STRIDE
            for j in range(WIDE):
                scratch[to + j] = blur(scratch, source + j, CHANNELS)

    return enter


def _blur_down(real: type) -> Scalar:
    blur = build_blur(real)

    @inlined
    def blur_down(scratch, first, row, planes, count):
        """Blurs four rows of each plane vertically, into the rows at `RESULTS`."""
        for plane in range(planes):
            source, to = first + (plane & 3) * PLANE + (row & 15) * STRIDE, RESULTS + (plane & 3) * TOGETHER * STRIDE
            for j in range(count):
                one = blur(scratch, source + j, STRIDE)
                two = blur(scratch, source + STRIDE + j, STRIDE)
                three = blur(scratch, source + 2 * STRIDE + j, STRIDE)
                four = blur(scratch, source + 3 * STRIDE + j, STRIDE)
                scratch[to + j], scratch[to + STRIDE + j] = one, two
                scratch[to + 2 * STRIDE + j], scratch[to + 3 * STRIDE + j] = three, four

    return blur_down


def _compare_row(real: type) -> Scalar:
    compare = build_compare(real)

    @inlined
    def compare_row(scratch, row):
        """Similarity of one of the four rows at `RESULTS`, and its derivatives."""
        at = RESULTS + (row & 3) * STRIDE
        for j in range(WIDE):
            value, by_mean, by_squares, by_product = compare(
                scratch[at + j],
                scratch[at + TOGETHER * STRIDE + j],
                scratch[at + 2 * TOGETHER * STRIDE + j],
                scratch[at + 3 * TOGETHER * STRIDE + j],
            )
            scratch[DERIVATIVES + j] = by_mean
            scratch[DERIVATIVES + STRIDE + j] = by_squares
            scratch[DERIVATIVES + 2 * STRIDE + j] = by_product
            scratch[DERIVATIVES + 3 * STRIDE + j] = value

    return compare_row


def _blur_derivatives(real: type) -> Scalar:
    blur, zero = build_blur(real), real(0.0)

    @inlined
    def blur_derivatives(scratch, inside, left, rest, row):
        """Blurs derivatives into row `row` of the planes; beyond the image, after `rest` columns, they are 0."""
        for plane in range(3):
            at, to = DERIVATIVES + (plane & 3) * STRIDE, BLURRED_DERIVATIVES + (plane & 3) * PLANE + (row & 31) * STRIDE
            if inside:
                for j in range(MARGIN if left == 0 else 0):
                    scratch[at + j] = zero
                for j in range(min(rest + MARGIN, WIDE) & 511, WIDE):
                    scratch[at + j] = zero
                for j in range(COLUMNS):
                    scratch[to + j] = blur(scratch, at + j, CHANNELS)
            else:
                for j in range(COLUMNS):
                    scratch[to + j] = zero

    return blur_derivatives


def _ssim_gradient_row(real: type) -> Scalar:
    brightness, two = _brightness(real), real(2.0)

    @inlined
    def ssim_gradient_row(scratch, row, image, target, out):
        """The gradient of one row, from one of the four rows at `RESULTS`."""
        at = RESULTS + (row & 3) * STRIDE
        for j in range(out.size):
            by_squares = scratch[at + TOGETHER * STRIDE + j]
            by_product = scratch[at + 2 * TOGETHER * STRIDE + j]
            out[j] = scratch[at + j] + two * image[j] * by_squares + brightness(target[j]) * by_product

    return ssim_gradient_row


@inlined
def _scroll(scratch, first, planes):
    """Moves the last ten rows of each plane to its top, in one loop: a loop per row takes LLVM a minute to compile."""
    for plane in range(planes):
        to = first + (plane & 7) * PLANE
        for j in range(2 * RADIUS * STRIDE):
            scratch[to + j] = scratch[to + GROUP * STRIDE + j]


@functools.cache
def _forward(real: type) -> Kernel:
    enter, blur_down, compare_row = _enter(real), _blur_down(real), _compare_row(real)
    blur_derivatives, ssim_gradient_row, scroll = _blur_derivatives(real), _ssim_gradient_row(real), _scroll
    zero = real(0.0)

    @inlined
    def differences(scratch, count):
        """Sum of the absolute differences of the row that entered last."""
        total = zero
        for j in range(count):
            total += abs(scratch[ENTERED + 2 * MARGIN + j] - scratch[ENTERED + STRIDE + 2 * MARGIN + j])
        return total

    @inlined
    def similarity(scratch, count):
        """Sum of the similarities of the row that was compared last."""
        total = zero
        for j in range(count):
            total += scratch[DERIVATIVES + 3 * STRIDE + MARGIN + j]
        return total

    @kernel("photometric_forward", real)
    def forward(image, target, ssim_gradient, sums):
        height, width = image.shape
        columns = (width + COLUMNS - 1) // COLUMNS
        reach = RADIUS if ssim_gradient.size > 0 else 0
        for tile in prange(sums.shape[0]):
            scratch: NDArray[Any] = np.empty(SCRATCH, real)
            top, left = tile // columns * ROWS, tile % columns * COLUMNS
            bottom, right = min(height, top + ROWS), min(width, left + COLUMNS)
            l1, ssim = 0.0, 0.0
            for begin in range(top - reach - RADIUS, bottom + reach + RADIUS, GROUP):
                for i in range(GROUP):
                    enter(scratch, image, target, begin + i, left, 2 * RADIUS + i)
                    if top <= begin + i < bottom:
                        l1 += differences(scratch, right - left)
                for i in range(GROUP):
                    y = begin + i - RADIUS
                    if i % TOGETHER == 0 and top - reach - TOGETHER < y < bottom + reach:
                        blur_down(scratch, BLURRED, i, 4, WIDE)
                    inside = max(0, top - reach) <= y < min(height, bottom + reach)
                    if inside:
                        compare_row(scratch, i)
                    if top <= y < bottom:
                        ssim += similarity(scratch, right - left)
                    if reach > 0:
                        blur_derivatives(scratch, inside, left, width - left, 2 * RADIUS + i)
                scroll(scratch, BLURRED, 4)
                if reach == 0:
                    continue
                for i in range(GROUP):
                    y = begin + i - 2 * RADIUS
                    if i % TOGETHER == 0 and top - TOGETHER < y < bottom:
                        blur_down(scratch, BLURRED_DERIVATIVES, i, 3, COLUMNS)
                    if top <= y < bottom:
                        ssim_gradient_row(
                            scratch, i, image[y, left:right], target[y, left:right], ssim_gradient[y, left:right]
                        )
                scroll(scratch, BLURRED_DERIVATIVES, 3)
            sums[tile, 0], sums[tile, 1] = l1, ssim

    return forward


@functools.cache
def _backward(real: type) -> Kernel:
    brightness, zero = _brightness(real), real(0.0)

    @kernel("photometric_backward", real)
    def backward(image, target, ssim_gradient, v_l1, v_ssim, v_image):
        for y in prange(image.shape[0]):
            for j in range(image.shape[1]):
                difference = image[y, j] - brightness(target[y, j])
                sign = v_l1 if difference > zero else (-v_l1 if difference < zero else zero)
                v_image[y, j] = sign + v_ssim * ssim_gradient[y, j]

    return backward
