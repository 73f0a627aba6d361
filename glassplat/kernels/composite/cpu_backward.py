"""Gradients of blending, tile by tile and back to front.

A splat is removed from the blocks that it reached, with the sums over its pixels in registers. One row of sums is
written per (tile, splat) pair; the rows of each splat are summed afterwards in a fixed order, so that the result has
the same bits for any number of threads. Transmittances are recovered by division from their final values.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
from numba import prange

from glassplat.kernels.backend.cpu import ZERO, Kernel, even_stride, inlined, kernel
from glassplat.kernels.backend.cpu_vector import (
    absolute,
    deinterleave,
    item,
    lowest_bit,
    maximum,
    minimum,
    pad_fourths,
    select,
    store,
    sums_of,
    vector_kind,
)
from glassplat.kernels.composite import cpu_tile as tile
from glassplat.kernels.composite.cpu_tile import PAIR_VALUES, exponent, lane_of, tile_bounds
from glassplat.kernels.maths.blending import ALPHA_MAX, ALPHA_MIN, Scalar
from glassplat.kernels.records import LEAST_ALPHA, ON_MEAN

(full, load), load_eight = vector_kind(tile.LANES), vector_kind(2 * tile.BLOCK).load
load_row = vector_kind(tile.BLOCK).load
BLOCK, ACROSS, LANES, PIXELS, VALUES = tile.BLOCK, tile.ACROSS, tile.LANES, tile.PIXELS, tile.VALUES

# Planes of the backward pass; V_IMAGE has one per channel. T and T_GLASS are transmittances in front of the current
# splat, BEHIND and BEHIND_GLASS the gradient-weighted sums behind it, WEIGHT its blending weight.
T, T_GLASS, BEHIND, BEHIND_GLASS, V_MASK, V_DEVIATION, CENTER, WEIGHT, V_IMAGE = (
    plane * tile.PIXELS for plane in range(9)
)


LEAN = PAIR_VALUES + tile.GROUP
"""Column of a pair's row that is unused with up to four channels."""


def _unblend(real: type, with_absgrad: bool, of_glass: bool) -> Scalar:
    x_centers, y_centers = tile.pixel_centers(real)
    exp2, sided = tile.exp2_of(real), _sided(real)
    zero, one, two, alpha_max = real(0.0), real(1.0), real(2.0), real(ALPHA_MAX)
    least = real(math.log2(ALPHA_MIN))
    MEAN_X, MEAN_Y, FORM_XX, FORM_XY, FORM_YY = tile.MEAN_X, tile.MEAN_Y, tile.FORM_XX, tile.FORM_XY, tile.FORM_YY
    OWN_T, OWN_BEHIND, LAST = (T_GLASS, BEHIND_GLASS, tile.LAST_GLASS) if of_glass else (T, BEHIND, tile.LAST)

    @inlined
    def unblend(planes, state, at, batch, splat, blocks, groups, deviating, row, row_at):
        """Removes a splat from the pixels of its blocks and writes its sums, zero beyond the first four channels.

        With up to four channels, the next column is the gradient of the deviation with respect to its channel. For
        glass, the first is the gradient of the mark, and the others are zero.
        """
        none, most = full(zero), full(alpha_max)
        g, g_x, g_y, g_xx, g_xy, g_yy = none, none, none, none, none, none
        absgrad_x, absgrad_y, s0, s1, s2, s3, lean = none, none, none, none, none, none, none
        while blocks != 0:
            b = lowest_bit(blocks)
            blocks &= blocks - 1
            i = b * LANES
            dx = x_centers() + (real(b % ACROSS * BLOCK) - item(batch, splat + MEAN_X))
            dy = y_centers() + (real(b // ACROSS * BLOCK) - item(batch, splat + MEAN_Y))
            bits = exponent(batch, splat, dx, dy)
            coverage = exp2(bits)
            shown = (bits >= least) & (load(state, at + LAST + i) >= item(batch, splat + tile.ORDER))
            alpha = select(shown, minimum(coverage, most), none)
            inverse = one / (one - alpha)
            t, behind = load(planes, OWN_T + i) * inverse, load(planes, OWN_BEHIND + i)
            if of_glass:
                mark, v_mark = item(batch, splat + VALUES), load(planes, V_MASK + i) * load(planes, T + i) * t
                v_alpha, seen = v_mark * mark - behind * inverse, alpha * v_mark * mark
                store(planes, BEHIND + i, load(planes, BEHIND + i) + seen)
                s0 = s0 + alpha * v_mark
            else:
                weight = alpha * t
                v0, v1 = load(planes, V_IMAGE + i), load(planes, V_IMAGE + PIXELS + i)
                v2, v3 = load(planes, V_IMAGE + 2 * PIXELS + i), load(planes, V_IMAGE + 3 * PIXELS + i)
                dot = v0 * item(batch, splat + VALUES) + v1 * item(batch, splat + VALUES + 1)
                dot = dot + (v2 * item(batch, splat + VALUES + 2) + v3 * item(batch, splat + VALUES + 3))
                if groups > 1:
                    dot = _dot_more(dot, planes, i, batch, splat, groups, deviating)
                    store(planes, WEIGHT + i, weight)
                elif deviating >= 0:
                    center = load(planes, CENTER + i)
                    difference = item(batch, splat + VALUES + deviating) - center
                    v_deviation = load(planes, V_DEVIATION + i)
                    slope = weight * v_deviation
                    dot = dot + v_deviation * absolute(difference)
                    lean = lean + sided(difference, center, slope)
                v_alpha, seen = t * dot - behind * inverse, weight * dot
                s0, s1, s2, s3 = s0 + weight * v0, s1 + weight * v1, s2 + weight * v2, s3 + weight * v3
            store(planes, OWN_BEHIND + i, behind + seen)
            store(planes, OWN_T + i, t)
            gain = select(coverage < most, v_alpha * alpha, none)
            gain_x, gain_y = gain * dx, gain * dy
            g, g_x, g_y = g + gain, g_x + gain_x, g_y + gain_y
            g_xx, g_xy, g_yy = g_xx + gain_x * dx, g_xy + gain_x * dy, g_yy + gain_y * dy
            if with_absgrad:
                across = item(batch, splat + FORM_XY)
                absgrad_x = absgrad_x + absolute(gain_x * (two * item(batch, splat + FORM_XX)) + gain_y * across)
                absgrad_y = absgrad_y + absolute(gain_y * (two * item(batch, splat + FORM_YY)) + gain_x * across)
        sums = (g, g_x, g_y, g_xx, g_xy, g_yy, absgrad_x, absgrad_y, s0, s1, s2, s3, lean, none, none, none)
        store(row, row_at, sums_of(sums))

    return unblend


def _sided(real: type) -> Scalar:
    zero, on_mean = real(0.0), real(ON_MEAN * np.finfo(real).eps)

    @inlined
    def sided(difference, center, slope):
        """A gradient with the sign of the difference from the mean, zero for values equal to it up to rounding."""
        slack = on_mean * absolute(center)
        return select(difference > slack, slope, select(difference < -slack, -slope, full(zero)))

    return sided


@inlined
def _dot_more(dot, planes, i, batch, splat, groups, deviating):
    """Adds channels beyond the first four to the dot product, and the deviation of one channel."""
    for d in range(4, groups * 4, 4):
        v, value = V_IMAGE + d * PIXELS + i, splat + VALUES + d
        dot = dot + (load(planes, v) * item(batch, value) + load(planes, v + PIXELS) * item(batch, value + 1))
        v, value = v + 2 * PIXELS, value + 2
        dot = dot + (load(planes, v) * item(batch, value) + load(planes, v + PIXELS) * item(batch, value + 1))
    if deviating >= 0:
        difference = item(batch, splat + VALUES + deviating) - load(planes, CENTER + i)
        dot = dot + load(planes, V_DEVIATION + i) * absolute(difference)
    return dot


def _sum_more(real: type) -> Scalar:
    zero, sided = real(0.0), _sided(real)
    sum_channels = tile.sum_channels_of(real, V_IMAGE, WEIGHT, PAIR_VALUES)

    @inlined
    def sum_more(planes, batch, splat, blocks, groups, deviating, rows, row, sums):
        """Adds the channels that `unblend` omits to a row of sums, with the stored weights; `sums` is scratch."""
        sum_channels(planes, blocks, 1, groups, rows, row, sums)
        if deviating >= 0:
            none, left = full(zero), blocks
            s0 = none
            while left != 0:
                i = lowest_bit(left) * LANES
                left &= left - 1
                center = load(planes, CENTER + i)
                difference = item(batch, splat + VALUES + deviating) - center
                slope = load(planes, WEIGHT + i) * load(planes, V_DEVIATION + i)
                s0 = s0 + sided(difference, center, slope)
            one = (s0, none, none, none, none, none, none, none, none, none, none, none, none, none, none, none)
            store(sums, 0, sums_of(one))
            rows[row + PAIR_VALUES + deviating] += sums[0]

    return sum_more


@inlined
def _load_row_of_four(v_image, pixel, channels):
    if channels == 4:
        return load(v_image, pixel * 4)
    return pad_fourths(load_eight(v_image, pixel * 3), load_row(v_image, pixel * 3 + 8))


@inlined
def _load_whole_block(planes, i, v_image, v_alpha, first, width, channels):
    """Loads a block of three or four channels that lies within the image; `first` is its first pixel."""
    r0, r1 = _load_row_of_four(v_image, first, channels), _load_row_of_four(v_image, first + width, channels)
    r2 = _load_row_of_four(v_image, first + 2 * width, channels)
    r3 = _load_row_of_four(v_image, first + 3 * width, channels)
    v0, v1, v2, v3 = deinterleave((r0, r1, r2, r3))
    store(planes, V_IMAGE + i, v0)
    store(planes, V_IMAGE + PIXELS + i, v1)
    store(planes, V_IMAGE + 2 * PIXELS + i, v2)
    store(planes, V_IMAGE + 3 * PIXELS + i, v3)
    for y in range(BLOCK):
        store(planes, BEHIND + i + y * BLOCK, load_row(v_alpha, first + y * width))


@inlined
def _load_gradients(planes, v_image, v_alpha, first, width, columns, rows, channels):
    """Fills V_IMAGE and BEHIND; pixels outside the image stay zero."""
    for b in range(tile.BLOCKS):
        x0, y0 = b % ACROSS * BLOCK, b // ACROSS * BLOCK
        corner = first + y0 * width + x0
        if 3 <= channels <= 4 and x0 + BLOCK <= columns and y0 + BLOCK <= rows:
            _load_whole_block(planes, b * LANES, v_image, v_alpha, corner, width, channels)
            continue
        for y in range(min(BLOCK, rows - y0)):
            for x in range(min(BLOCK, columns - x0)):
                pixel, i = corner + y * width + x, b * LANES + y * BLOCK + x
                planes[BEHIND + i] = v_alpha[pixel]
                for d in range(channels):
                    planes[V_IMAGE + d * PIXELS + i] = v_image[pixel * channels + d]
    # alpha = 1 - T: its gradient acts like that of a background.
    for i in range(0, PIXELS, LANES):
        store(planes, BEHIND + i, -load(planes, BEHIND + i) * load(planes, T + i))


def _load_deviation(real: type) -> Scalar:
    one, zero, least_alpha = real(1.0), real(0.0), real(LEAST_ALPHA)

    @inlined
    def load_deviation(planes, spread, n, channel, through_mean, v_deviation, first, width, columns, rows):
        """Fills V_DEVIATION and CENTER, after the other gradients; returns False if the tile has no such gradient."""
        wanted, keep = False, n * 2 * PIXELS
        for y in range(rows):
            for x in range(columns):
                i, v = lane_of(x, y), v_deviation[first + y * width + x]
                wanted |= v != zero
                middle, lean = spread[keep + i], spread[keep + PIXELS + i]
                covered = one - planes[T + i]
                planes[V_DEVIATION + i], planes[CENTER + i] = v, middle
                if v != zero and through_mean and covered > least_alpha:
                    # The mean is the channel's sum over the coverage; alpha's gradient acts as in `_load_gradients`.
                    v_sum = -v * lean / covered
                    planes[V_IMAGE + channel * PIXELS + i] += v_sum
                    planes[BEHIND + i] += v_sum * middle * planes[T + i]
        return wanted

    return load_deviation


@inlined
def _begin(planes, state, at, v_mask, first, width, columns, rows, with_glass):
    """Loads final transmittances; returns the number of pairs up to the last one evaluated by a pixel."""
    planes[:] = ZERO
    for i in range(0, PIXELS, LANES):
        store(planes, T + i, load(state, at + tile.T + i))
        store(planes, T_GLASS + i, load(state, at + tile.T_GLASS + i))
    if with_glass:
        for y in range(rows):
            for x in range(columns):
                planes[V_MASK + lane_of(x, y)] = v_mask[first + y * width + x]
    latest = load(state, at + tile.LAST)
    for i in range(0, PIXELS, LANES):
        of_both = maximum(load(state, at + tile.LAST + i), load(state, at + tile.LAST_GLASS + i))
        latest = maximum(latest, of_both)
    # WEIGHT serves as scratch here, because it is written again before it is read.
    store(planes, WEIGHT, latest)
    most = planes[WEIGHT]
    for i in range(1, LANES):
        most = max(most, planes[WEIGHT + i])
    return int(most) + 1


@functools.cache
def composite_backward(real: type, with_absgrad: bool) -> Kernel:
    """Builds the kernel that fills one row of sums per pair, given the final state of each tile."""
    unblend_primary, unblend_glass = _unblend(real, with_absgrad, False), _unblend(real, with_absgrad, True)
    sum_more, load_deviation, zero = _sum_more(real), _load_deviation(real), real(0.0)
    CHUNK, TILES, REACHED = tile.CHUNK, tile.TILES, (1 << tile.BLOCKS) - 1

    @kernel("composite_backward_absgrad" if with_absgrad else "composite_backward", real)
    def backward(
        num_splats, with_glass, num_channels, image_width, height, channel, through_mean,
        pair_splats, tile_offsets, active, packed, pairs, state, spread,
        v_image, v_alpha, v_mask, v_deviation, rows,
    ):  # fmt: skip
        groups, width = (num_channels + 3) // 4, packed.size // max(1, num_splats)
        row_width = rows.size // max(1, pair_splats.size)
        num_tasks = (active.size + TILES - 1) // TILES
        stride = even_stride(num_tasks)
        for task in prange(num_tasks):
            planes = np.empty(V_IMAGE + groups * 4 * PIXELS, real)
            sums: Any = np.empty(LANES, real)
            batch = np.empty(CHUNK * width, real)
            begun = task * stride % num_tasks * TILES
            for n in range(begun, min(active.size, begun + TILES)):
                start, stop = tile_offsets[active[n]], tile_offsets[active[n] + 1]
                if start == stop:
                    continue
                camera, x0, y0, columns, lines = tile_bounds(active[n], image_width, height)
                corner, at = (camera * height + y0) * image_width + x0, n * tile.STATE
                looked_at = _begin(planes, state, at, v_mask, corner, image_width, columns, lines, with_glass)
                _load_gradients(planes, v_image, v_alpha, corner, image_width, columns, lines, num_channels)
                deviating = channel
                if channel >= 0 and not load_deviation(
                    planes, spread, n, channel, through_mean, v_deviation, corner, image_width, columns, lines
                ):
                    deviating = -1
                rows[(start + looked_at) * row_width : stop * row_width] = zero
                for behind in range(0, looked_at, CHUNK):
                    last = start + looked_at - behind
                    first = max(last - CHUNK, start)
                    tile.fetch(batch, packed, pair_splats, first, last, width, x0, y0)
                    for k in range(last - first):
                        p = last - 1 - k
                        splat, row = (p - first) * width, p * row_width
                        batch[splat + tile.ORDER] = real(np.int32(p - start))
                        blocks = np.int64(pairs[p]) & REACHED
                        if blocks == 0:
                            rows[row : row + row_width] = zero
                        elif (pairs[p] >> tile.GLASS) & 1:
                            unblend_glass(planes, state, at, batch, splat, blocks, groups, deviating, rows, row)
                            rows[row + LANES : row + row_width] = zero
                        else:
                            unblend_primary(planes, state, at, batch, splat, blocks, groups, deviating, rows, row)
                            if groups > 1:
                                sum_more(planes, batch, splat, blocks, groups, deviating, rows, row, sums)
                            elif deviating >= 0:
                                rows[row + PAIR_VALUES + deviating] += rows[row + LEAN]

    return backward
