"""Gradients of blending discs, tile by tile and back to front.

As with splats, a disc is taken off the blocks that it reached, one row of sums is written per (tile, disc) pair, and
the rows of each disc are summed afterwards in a fixed order. Of the distortion a disc needs to know only the sums over
all discs of a pixel, and none over those in front of it.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numba import prange

from glassplat.kernels.backend.cpu import Kernel, even_stride, inlined, kernel
from glassplat.kernels.backend.cpu_vector import (
    absolute,
    item,
    lowest_bit,
    minimum,
    select,
    store,
    sums_of,
    vector_kind,
)
from glassplat.kernels.composite import cpu_tile as tile
from glassplat.kernels.composite.cpu_tile import lane_of
from glassplat.kernels.composite_discs import cpu_tile as discs
from glassplat.kernels.maths.blending import ALPHA_MAX, Scalar
from glassplat.kernels.maths.disc import meet_maths

# Planes of the backward pass; V_IMAGE has one per channel. T is the transmittance in front of the current disc, BEHIND
# what lies behind it, weighted by the incoming gradients, COVERED the coverage in the end, WEIGHT how much of it shows.
T, BEHIND, COVERED, WEIGHT, V_DEPTH, V_MEDIAN, V_DISTORTION, V_IMAGE = (plane * tile.PIXELS for plane in range(8))

# Columns of a pair's row, sums over its pixels: gradients of both numerators and of e, times dx, times dy and alone;
# those of the falloff around the centre, times dx and dy; of the logarithm of the coverage; of the centre's depth; the
# probe's; and from PAIR_VALUES on those of the channels.
UP, VP, E, AROUND, G, DEPTH, PULL, PAIR_VALUES = 0, 3, 6, 9, 11, 12, 13, 16


def _value_of(real: type) -> Scalar:
    load = vector_kind(real, tile.LANES).load
    PIXELS, VALUES = tile.PIXELS, discs.VALUES

    @inlined
    def value_of(planes, i, batch, splat, groups):
        """What a disc's channels are worth to a block."""
        dot = load(planes, V_IMAGE + i) * item(batch, splat + VALUES)
        for d in range(1, 4 * groups):
            dot = dot + load(planes, V_IMAGE + d * PIXELS + i) * item(batch, splat + VALUES + d)
        return dot

    return value_of


def _unblend(real: type) -> Scalar:
    full, load = vector_kind(real, tile.LANES)
    cover, value_of, slopes = discs.disc_functions(real).cover, _value_of(real), meet_maths(real)[1]
    zero, one, two, alpha_max, endless = real(0.0), real(1.0), real(2.0), real(ALPHA_MAX), real(np.inf)
    BLOCK, ACROSS, LANES = tile.BLOCK, tile.ACROSS, tile.LANES
    LAST, MEDIAN, FIRST, TOTAL, SQUARES = discs.LAST, discs.MEDIAN, discs.FIRST, discs.TOTAL, discs.SQUARES
    ORDER, Z, INVERSE = discs.ORDER, discs.DEPTH, discs.INVERSE_DEPTH

    @inlined
    def sharpness_of(sharpness):
        """Endless where there is no low-pass: then no pixel has a gradient through it, and zero times it is none."""
        return sharpness if sharpness < endless else zero

    @inlined
    def unblend(planes, state, at, batch, splat, blocks, groups, near, sharpness, row, row_at):
        """Takes a disc off the pixels of its blocks and writes its sums but for those of the channels."""
        none, most = full(zero), full(alpha_max)
        found = (
            item(batch, splat + discs.U_X), item(batch, splat + discs.U_Y), item(batch, splat + discs.V_X),
            item(batch, splat + discs.V_Y), item(batch, splat + discs.W_X), item(batch, splat + discs.W_Y),
        )  # fmt: skip
        order, depth, inverse_depth = item(batch, splat + ORDER), item(batch, splat + Z), item(batch, splat + INVERSE)
        up_x, up_y, up_1, vp_x, vp_y, vp_1 = none, none, none, none, none, none
        e_x, e_y, e_1, around_x, around_y = none, none, none, none, none
        g, g_depth, pull_x, pull_y = none, none, none, none
        while blocks != 0:
            b = lowest_bit(blocks)
            blocks &= blocks - 1
            i = b * LANES
            (dx, dy), (u, v, inverse), nearness, coverage, on_disc = cover(
                batch, splat, real(b % ACROSS * BLOCK), real(b // ACROSS * BLOCK), near, sharpness
            )
            shown = load(state, at + LAST + i) >= order
            alpha = select(shown, minimum(coverage, most), none)
            rest = one / (one - alpha)
            t = load(planes, T + i) * rest
            weight = alpha * t
            store(planes, WEIGHT + i, weight)
            z, apart = inverse * depth, nearness * inverse_depth - load(state, at + FIRST + i)
            total, covered = load(state, at + TOTAL + i), load(planes, COVERED + i)
            v_depth, v_distortion = load(planes, V_DEPTH + i), load(planes, V_DISTORTION + i)
            spread = (apart * covered - total * two) * apart + load(state, at + SQUARES + i)
            value = value_of(planes, i, batch, splat, groups) + v_depth * z + v_distortion * spread
            behind = load(planes, BEHIND + i)
            v_alpha = t * value - behind * rest
            store(planes, BEHIND + i, behind + weight * value)
            store(planes, T + i, t)
            middle = (load(state, at + MEDIAN + i) >= order) & (full(order) >= load(state, at + MEDIAN + i))
            v_z = weight * v_depth + select(middle, load(planes, V_MEDIAN + i), none)
            v_inverse = (weight * v_distortion) * ((apart * covered - total) * two)
            gain = select(coverage < most, v_alpha * alpha, none)
            v_up, v_vp = -(gain * u) * inverse, -(gain * v) * inverse
            v_e = (gain * (u * u + v * v) - v_z * z) * inverse + v_inverse * inverse_depth
            v_e = select(on_disc, v_e, none)
            v_around = select(on_disc, none, gain * (-sharpness_of(sharpness)))
            g, g_depth = g + gain, g_depth + (v_z * inverse - v_inverse * nearness * (inverse_depth * inverse_depth))
            up_x, up_y, up_1 = up_x + v_up * dx, up_y + v_up * dy, up_1 + v_up
            vp_x, vp_y, vp_1 = vp_x + v_vp * dx, vp_y + v_vp * dy, vp_1 + v_vp
            e_x, e_y, e_1 = e_x + v_e * dx, e_y + v_e * dy, e_1 + v_e
            around_x, around_y = around_x + v_around * dx, around_y + v_around * dy
            slope_x, slope_y = slopes(found, v_up, v_vp, v_e)
            pull_x = pull_x + absolute(slope_x + v_around * dx)
            pull_y = pull_y + absolute(slope_y + v_around * dy)
        sums = (
            up_x, up_y, up_1, vp_x, vp_y, vp_1, e_x, e_y, e_1, around_x, around_y, g, g_depth, pull_x, pull_y, none
        )  # fmt: skip
        store(row, row_at, sums_of(sums))

    return unblend


def _sum_channels(real: type) -> Scalar:
    full, load = vector_kind(real, tile.LANES)
    zero, LANES, PIXELS = real(0.0), tile.LANES, tile.PIXELS

    @inlined
    def sum_channels(planes, blocks, groups, rows, row, sums):
        """Adds to a row of sums the gradients of the channels, with the weights that are kept; `sums` is scratch."""
        none = full(zero)
        for d in range(0, groups * 4, 4):
            s0, s1, s2, s3, left = none, none, none, none, blocks
            while left != 0:
                i = lowest_bit(left) * LANES
                left &= left - 1
                v, weight = V_IMAGE + d * PIXELS + i, load(planes, WEIGHT + i)
                s0, s1 = s0 + weight * load(planes, v), s1 + weight * load(planes, v + PIXELS)
                s2, s3 = s2 + weight * load(planes, v + 2 * PIXELS), s3 + weight * load(planes, v + 3 * PIXELS)
            four = (s0, s1, s2, s3, none, none, none, none, none, none, none, none, none, none, none, none)
            store(sums, 0, sums_of(four))
            for i in range(4):
                rows[row + PAIR_VALUES + d + i] = sums[i]

    return sum_channels


def _begin(real: type) -> Scalar:
    zero, one, PIXELS = real(0.0), real(1.0), tile.PIXELS

    @inlined
    def begin(planes, state, at, v_images, first, width, columns, rows, channels):
        """Loads a tile's gradients; returns how many pairs of it any pixel has blended."""
        v_image, v_alpha, v_depth, v_median, v_distortion = v_images
        planes[:] = zero
        most = state[at + discs.LAST]
        for i in range(PIXELS):
            planes[T + i] = state[at + discs.T + i]
            planes[COVERED + i] = one - planes[T + i]
            most = max(most, state[at + discs.LAST + i])
        for y in range(rows):
            for x in range(columns):
                pixel, i = first + y * width + x, lane_of(x, y)
                # alpha = 1 - T: its gradient acts like something behind every disc.
                planes[BEHIND + i] = -v_alpha[pixel] * planes[T + i]
                planes[V_DEPTH + i], planes[V_MEDIAN + i] = v_depth[pixel], v_median[pixel]
                planes[V_DISTORTION + i] = v_distortion[pixel]
                for d in range(channels):
                    planes[V_IMAGE + d * PIXELS + i] = v_image[pixel * channels + d]
        return int(most) + 1

    return begin


@functools.cache
def composite_discs_backward(real: type) -> Kernel:
    """Builds the kernel that fills one row of sums per pair, given the final state of each tile."""
    place, fetch = tile.tile_functions(real).place, discs.disc_functions(real).fetch
    unblend, sum_channels, begin = _unblend(real), _sum_channels(real), _begin(real)
    zero = real(0.0)
    LANES, PIXELS, CHUNK, STATE, ORDER = tile.LANES, tile.PIXELS, tile.CHUNK, discs.STATE, discs.ORDER
    REACHED = (1 << tile.BLOCKS) - 1

    @kernel("composite_discs_backward", real)
    def backward(
        num_discs, num_channels, image_width, height, near, sharpness,
        pair_splats, tile_offsets, active, packed, pairs, state, v_images, rows,
    ):  # fmt: skip
        groups, width = (num_channels + 3) // 4, packed.size // max(1, num_discs)
        row_width = rows.size // max(1, pair_splats.size)
        stride = even_stride(active.size)
        for task in prange(active.size):
            n = task * stride % active.size
            start, stop = tile_offsets[active[n]], tile_offsets[active[n] + 1]
            if start == stop:
                continue
            camera, x0, y0, columns, lines = place(active[n], image_width, height)
            corner, at = (camera * height + y0) * image_width + x0, n * STATE
            planes = np.empty(V_IMAGE + groups * 4 * PIXELS, real)
            sums: Any = np.empty(LANES, real)
            batch = np.empty(CHUNK * width, real)
            looked_at = begin(planes, state, at, v_images, corner, image_width, columns, lines, num_channels)
            rows[(start + looked_at) * row_width : stop * row_width] = zero
            for behind in range(0, looked_at, CHUNK):
                last = start + looked_at - behind
                first = max(last - CHUNK, start)
                fetch(batch, packed, pair_splats, first, last, width, x0, y0)
                for k in range(last - first):
                    p = last - 1 - k
                    splat, row = (p - first) * width, p * row_width
                    batch[splat + ORDER] = real(np.int32(p - start))
                    blocks = np.int64(pairs[p]) & REACHED
                    if blocks == 0:
                        rows[row : row + row_width] = zero
                        continue
                    unblend(planes, state, at, batch, splat, blocks, groups, near, sharpness, rows, row)
                    sum_channels(planes, blocks, groups, rows, row, sums)

    return backward
