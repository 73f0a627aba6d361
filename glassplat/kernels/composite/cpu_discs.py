"""Blending of sorted discs on the CPU, tile by tile and block by block, and its gradients.

Tiles, blocks and outlines are those of `cpu_tile`: the outline of a disc determines the blocks that it may reach, its
map the coverage. The forward pass blends discs front to back. The backward pass removes a disc from the blocks that it
reached and writes one row of sums per (tile, disc) pair; the rows of each disc are summed afterwards in a fixed order.
The gradient of the distortion needs only sums over all discs of a pixel, none over those in front of a disc.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import prange
from torch import Tensor

from glassplat.kernels.backend.cpu import ENDLESS, ONE, ZERO, Kernel, even_stride, inlined, kernel
from glassplat.kernels.backend.cpu_vector import (
    absolute,
    bits_of,
    item,
    lowest_bit,
    minimum,
    select,
    store,
    sums_of,
    vector_kind,
)
from glassplat.kernels.composite import cpu_tile as tile
from glassplat.kernels.composite.cpu_tile import PIXELS, SPLATS, STOP_AFTER, lane_of, list_block, tile_bounds
from glassplat.kernels.maths.blending import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN, Scalar
from glassplat.kernels.maths.disc import MAP, MOST_DEVIATIONS, intersect, offset_gradient
from glassplat.kernels.records import REAL_OF, Discs, TileBins

full, load = vector_kind(tile.LANES)
BLOCK, ACROSS, BLOCKS, LANES, CHUNK = tile.BLOCK, tile.ACROSS, tile.BLOCKS, tile.LANES, tile.CHUNK

# Columns of a packed disc: first its outline as a packed splat, whose ORDER column is reused once blocks are known.
CENTER_X, CENTER_Y, U_X, U_Y, V_X, V_Y, W_X, W_Y, BITS, Z, INVERSE_Z, VALUES = range(tile.VALUES, tile.VALUES + 12)
ORDER = tile.ORDER

# Planes of a tile's state, which the backward pass starts from: transmittance; position in the tile's list of the last
# disc that a pixel blended and of its median disc; and, for inverse depths, their origin and the weighted sums of
# offsets from it and of their squares. T is negative if a pixel has stopped.
T, LAST, MEDIAN, FIRST, TOTAL, SQUARES = (plane * tile.PIXELS for plane in range(6))
STATE = 6 * tile.PIXELS


def _pack(real: type) -> Scalar:
    pack_outline = tile.pack_of(real)
    zero, one, nothing, endless = real(0.0), real(1.0), real(-np.inf), real(np.inf)
    alpha_min, bits = real(ALPHA_MIN), 1.0 / math.log(2.0)

    @inlined
    def pack(packed, at, center, map_of, opacity, depth, outline_center, conic):
        """Copies one disc's geometry to its packed row."""
        pack_outline(packed, at, outline_center, conic, opacity)
        if conic[0] == zero and conic[1] == zero and conic[2] == zero:
            # The disc crosses the near plane and may reach any block.
            for column in range(tile.FORM_XX, tile.VALUES):
                packed[at + column] = zero
        total = center[0] + center[1] + depth
        for j in range(6):
            packed[at + U_X + j] = map_of[j]
            total += map_of[j]
        drawn = abs(total) < endless and alpha_min <= opacity < endless and zero < depth
        if not drawn:
            packed[at + tile.BITS] = nothing
        packed[at + CENTER_X], packed[at + CENTER_Y] = center[0], center[1]
        packed[at + BITS] = real(bits * math.log(np.float64(opacity))) if drawn else nothing
        packed[at + Z], packed[at + INVERSE_Z] = depth, one / depth

    return pack


@inlined
def _fetch(batch, packed, pair_splats, first, last, width, x0, y0):
    """Copies the packed discs of consecutive pairs to a contiguous batch, with centres relative to the tile."""
    tile.fetch(batch, packed, pair_splats, first, last, width, x0, y0)
    for k in range(last - first):
        batch[k * width + CENTER_X] -= np.float32(x0)
        batch[k * width + CENTER_Y] -= np.float32(y0)


def _cover(real: type) -> Scalar:
    exp2, (x_centers, y_centers) = tile.exp2_of(real), tile.pixel_centers(real)
    zero, one, farthest = real(0.0), real(1.0), real(MOST_DEVIATIONS**2)
    half_bits, least = real(0.5 / math.log(2.0)), real(math.log2(ALPHA_MIN))
    far = real(4 * MOST_DEVIATIONS**2)

    @inlined
    def cover(batch, at, x, y, near, sharpness):
        """Coverage of a fetched disc over the block whose corner is (x, y).

        Returns the offsets (dx, dy) of the pixels; (u, v, 1 / e) and e at the intersections; the coverage before
        clamping, 0 where not drawn; and a mask of pixels that show the disc. Elsewhere, only the falloff around the
        centre counts; (0, 0, 1) and 1 replace the intersection. `sharpness` is one over the low-pass variance.
        """
        dx = x_centers() + (x - item(batch, at + CENTER_X))
        dy = y_centers() + (y - item(batch, at + CENTER_Y))
        found = (
            item(batch, at + U_X), item(batch, at + U_Y), item(batch, at + V_X), item(batch, at + V_Y),
            item(batch, at + W_X), item(batch, at + W_Y),
        )  # fmt: skip
        none, ones = full(zero), full(one)
        up, vp, e = intersect(found, dx, dy)
        inverse = ones / e
        u, v = up * inverse, vp * inverse
        solid = u * u + v * v
        around = (dx * dx + dy * dy) * sharpness
        # Comparisons with NaN are false, so a NaN falloff is never chosen.
        within = (e > zero) & (full(item(batch, at + Z)) > e * near) & (solid <= farthest)
        solid = select(within, solid, full(far))
        nearer = around < solid
        q = select(nearer, around, solid)
        bits = full(item(batch, at + BITS)) - q * half_bits
        drawn = (q <= farthest) & (bits >= least)
        coverage = select(drawn, exp2(bits), none)
        on_disc = within & (solid <= select(nearer, around, full(far)))
        hit = select(on_disc, u, none), select(on_disc, v, none), select(on_disc, inverse, ones)
        return (dx, dy), hit, select(on_disc, e, ones), coverage, on_disc

    return cover


# Planes of a tile's results; SUMS has one per channel.
DEPTH_SUM, MIDDLE, DISTORTION, SUMS = (plane * tile.PIXELS for plane in range(4))


def _blend_block(real: type) -> Scalar:
    """Builds the loop over the discs of a block."""
    cover = _cover(real)
    zero, half, one, t_min, alpha_max = real(0.0), real(0.5), real(1.0), real(TRANSMITTANCE_MIN), real(ALPHA_MAX)

    @inlined
    def blend_block(state, at_state, planes, at, batch, width, entries, count, x, y, near, sharpness, weights):
        """Fills the weights; returns the number of discs processed, and whether any pixel still runs."""
        none, most = full(zero), full(alpha_max)
        t, last, middle_at = load(state, at_state + T), load(state, at_state + LAST), load(state, at_state + MEDIAN)
        first, total = load(state, at_state + FIRST), load(state, at_state + TOTAL)
        squares, distortion = load(state, at_state + SQUARES), load(planes, at + DISTORTION)
        depth, middle = load(planes, at + DEPTH_SUM), load(planes, at + MIDDLE)
        e = 0
        while e < count:
            splat = item(entries, e) * width
            _, hit, nearness, coverage, _ = cover(batch, splat, x, y, near, sharpness)
            alpha = minimum(coverage, most)
            weight = alpha * t
            after = t - weight
            alive = after >= t_min
            weight = select(alive, weight, none)
            z, position = hit[2] * item(batch, splat + Z), full(item(batch, splat + ORDER))
            inverse = nearness * item(batch, splat + INVERSE_Z)
            # Relative to the first disc of the pixel: squares of nearly equal inverse depths would cancel.
            first = select(t >= one, inverse, first)
            apart = inverse - first
            part = (apart * apart) * (one - t) - (apart * total) * (one + one) + squares
            distortion = distortion + weight * part
            total, squares = total + weight * apart, squares + weight * (apart * apart)
            depth = depth + weight * z
            halfway = (t > half) & (weight > zero)
            middle, middle_at = select(halfway, z, middle), select(halfway, position, middle_at)
            last = select(weight > zero, position, last)
            t = select(alive, after, -absolute(t))
            store(weights, e * LANES, weight)
            e += 1
            if e % STOP_AFTER == 0 and bits_of(t > zero) == 0:
                break
        store(state, at_state + T, t)
        store(state, at_state + LAST, last)
        store(state, at_state + MEDIAN, middle_at)
        store(state, at_state + FIRST, first)
        store(state, at_state + TOTAL, total)
        store(state, at_state + SQUARES, squares)
        store(planes, at + DISTORTION, distortion)
        store(planes, at + DEPTH_SUM, depth)
        store(planes, at + MIDDLE, middle)
        return e, bits_of(t > zero) != 0

    return blend_block


@inlined
def _blend_channels(planes, at, batch, width, entries, count, column, weights):
    """Blends four channels, starting at `column` of a disc."""
    s0, s1 = load(planes, at), load(planes, at + PIXELS)
    s2, s3 = load(planes, at + 2 * PIXELS), load(planes, at + 3 * PIXELS)
    for e in range(count):
        weight, value = load(weights, e * LANES), item(entries, e) * width + column
        # Skips discs that no pixel of the block shows, because their channels can be non-finite.
        if bits_of(weight > ZERO) != 0:
            s0 = s0 + weight * item(batch, value)
            s1 = s1 + weight * item(batch, value + 1)
            s2 = s2 + weight * item(batch, value + 2)
            s3 = s3 + weight * item(batch, value + 3)
    store(planes, at, s0)
    store(planes, at + PIXELS, s1)
    store(planes, at + 2 * PIXELS, s2)
    store(planes, at + 3 * PIXELS, s3)


@inlined
def write_tile(state, at, planes, images, first, width, columns, rows, channels):
    """Writes a tile to the flat images, and removes the signs that mark stopped pixels."""
    image, alpha, depth, median, distortion = images
    for i in range(PIXELS):
        state[at + T + i] = abs(state[at + T + i])
    for y in range(rows):
        for x in range(columns):
            pixel, lane = first + y * width + x, lane_of(x, y)
            alpha[pixel] = ONE - state[at + T + lane]
            depth[pixel], median[pixel] = planes[DEPTH_SUM + lane], planes[MIDDLE + lane]
            distortion[pixel] = planes[DISTORTION + lane]
            for d in range(channels):
                image[pixel * channels + d] = planes[SUMS + d * PIXELS + lane]


@functools.cache
def composite_discs_forward(real: type) -> Kernel:
    """Builds the kernel that blends all tiles."""
    pack, reached, begin, blend_block = _pack(real), tile.reached_of(real), tile.begin_state(real), _blend_block(real)
    zero, never = real(0.0), real(-1.0)

    @kernel("composite_discs_forward", real)
    def forward(
        means, maps, opacities, depths, outline_centers, conics, channels, image_width, height, near, sharpness,
        pair_splats, tile_offsets, splat_offsets, active, packed, pairs, state, images,
    ):  # fmt: skip
        num_discs, num_channels = channels.shape
        width, groups = packed.size // max(1, num_discs), (num_channels + 3) // 4
        num_chunks = (num_discs + SPLATS - 1) // SPLATS
        pack_stride = even_stride(num_chunks)
        for task in prange(num_chunks):
            chunk = task * pack_stride % num_chunks
            for s in range(chunk * SPLATS, min(num_discs, (chunk + 1) * SPLATS)):
                if splat_offsets[s + 1] > splat_offsets[s]:
                    pack(packed, s * width, means[s], maps[s], opacities[s], depths[s], outline_centers[s], conics[s])
                    for d in range(width - VALUES):
                        packed[s * width + VALUES + d] = channels[s, d] if d < num_channels else zero
        stride = even_stride(active.size)
        for task in prange(active.size):
            n = task * stride % active.size
            camera, x0, y0, columns, rows = tile_bounds(active[n], image_width, height)
            start, stop = tile_offsets[active[n]], tile_offsets[active[n] + 1]
            at = n * STATE
            running = begin(state, at, columns, rows)
            state[at + MEDIAN : at + FIRST] = never
            state[at + FIRST : at + STATE] = zero
            if start == stop:
                continue
            planes = np.empty(SUMS + groups * 4 * PIXELS, real)
            planes[:] = zero
            batch, entries = np.empty(CHUNK * width, real), np.empty(CHUNK + 1, np.int32)
            weights: Any = np.empty(CHUNK * LANES, real)
            for first in range(start, stop, CHUNK):
                last = min(first + CHUNK, stop)
                _fetch(batch, packed, pair_splats, first, last, width, x0, y0)
                for p in range(first, last):
                    pairs[p] = reached(batch, (p - first) * width) & running
                    batch[(p - first) * width + ORDER] = real(np.int32(p - start))
                for b in range(BLOCKS):
                    count = list_block(entries, pairs, first, last, b)
                    if count == 0:
                        continue
                    x, y = real(b % ACROSS * BLOCK), real(b // ACROSS * BLOCK)
                    i = b * LANES
                    taken, runs = blend_block(
                        state, at + i, planes, i, batch, width, entries, count, x, y, near, sharpness, weights
                    )
                    for group in range(groups):
                        _blend_channels(
                            planes, SUMS + 4 * group * PIXELS + i, batch, width, entries, taken, VALUES + 4 * group,
                            weights,
                        )  # fmt: skip
                    if not runs:
                        running &= ~(np.int64(1) << b)
                        # Discs that the stopped block has skipped must not reach it in the backward pass.
                        for e in range(taken, count):
                            pairs[first + entries[e]] &= ~(np.int32(1) << b)
                if running == 0:
                    break
            corner = (camera * height + y0) * image_width + x0
            write_tile(state, at, planes, images, corner, image_width, columns, rows, num_channels)

    return forward


# Planes of the backward pass; V_IMAGE has one per channel. T_AT is the transmittance in front of the current disc,
# BEHIND the gradient-weighted sum behind it, COVERED the final coverage, WEIGHT the disc's blending weight.
T_AT, BEHIND, COVERED, WEIGHT, V_DEPTH, V_MEDIAN, V_DISTORTION, V_IMAGE = (plane * tile.PIXELS for plane in range(8))

# Columns of a pair's row, sums over its pixels: gradients of both numerators and of e, times dx, times dy and alone; of
# the falloff around the centre, times dx and dy; of the logarithm of the coverage; of the centre's depth; the absolute
# gradient; and, starting at PAIR_VALUES, gradients of the channels.
UP, VP, E, AROUND, G, V_Z, ABSGRAD, PAIR_VALUES = 0, 3, 6, 9, 11, 12, 13, 16


@inlined
def _value_of(planes, i, batch, splat, groups):
    """Dot product of a disc's channels with the gradients of the image, for a block."""
    dot = load(planes, V_IMAGE + i) * item(batch, splat + VALUES)
    for d in range(1, 4 * groups):
        dot = dot + load(planes, V_IMAGE + d * PIXELS + i) * item(batch, splat + VALUES + d)
    return dot


@inlined
def sharpness_of(sharpness):
    """The sharpness, or zero if it is infinite for lack of a low-pass: zero times infinity would be NaN."""
    return sharpness if sharpness < ENDLESS else ZERO


def _unblend(real: type) -> Scalar:
    cover, zero, one, two, alpha_max = _cover(real), real(0.0), real(1.0), real(2.0), real(ALPHA_MAX)

    @inlined
    def unblend(planes, state, at, batch, splat, blocks, groups, near, sharpness, row, row_at):
        """Removes a disc from the pixels of its blocks and writes its sums, except for those of the channels."""
        none, most = full(zero), full(alpha_max)
        found = (
            item(batch, splat + U_X), item(batch, splat + U_Y), item(batch, splat + V_X),
            item(batch, splat + V_Y), item(batch, splat + W_X), item(batch, splat + W_Y),
        )  # fmt: skip
        order, depth, inverse_depth = item(batch, splat + ORDER), item(batch, splat + Z), item(batch, splat + INVERSE_Z)
        up_x, up_y, up_1, vp_x, vp_y, vp_1 = none, none, none, none, none, none
        e_x, e_y, e_1, around_x, around_y = none, none, none, none, none
        g, g_depth, absgrad_x, absgrad_y = none, none, none, none
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
            t = load(planes, T_AT + i) * rest
            weight = alpha * t
            store(planes, WEIGHT + i, weight)
            z, apart = inverse * depth, nearness * inverse_depth - load(state, at + FIRST + i)
            total, covered = load(state, at + TOTAL + i), load(planes, COVERED + i)
            v_depth, v_distortion = load(planes, V_DEPTH + i), load(planes, V_DISTORTION + i)
            spread = (apart * covered - total * two) * apart + load(state, at + SQUARES + i)
            value = _value_of(planes, i, batch, splat, groups) + v_depth * z + v_distortion * spread
            behind = load(planes, BEHIND + i)
            v_alpha = t * value - behind * rest
            store(planes, BEHIND + i, behind + weight * value)
            store(planes, T_AT + i, t)
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
            slope_x, slope_y = offset_gradient(found, v_up, v_vp, v_e)
            absgrad_x = absgrad_x + absolute(slope_x + v_around * dx)
            absgrad_y = absgrad_y + absolute(slope_y + v_around * dy)
        sums = (
            up_x, up_y, up_1, vp_x, vp_y, vp_1, e_x, e_y, e_1, around_x, around_y, g, g_depth, absgrad_x, absgrad_y,
            none,
        )  # fmt: skip
        store(row, row_at, sums_of(sums))

    return unblend


@inlined
def begin_gradients(planes, state, at, v_images, first, width, columns, rows, channels):
    """Loads a tile's gradients; returns the number of pairs up to the last one blended by a pixel."""
    v_image, v_alpha, v_depth, v_median, v_distortion = v_images
    planes[:] = ZERO
    most = state[at + LAST]
    for i in range(PIXELS):
        planes[T_AT + i] = state[at + T + i]
        planes[COVERED + i] = ONE - planes[T_AT + i]
        most = max(most, state[at + LAST + i])
    for y in range(rows):
        for x in range(columns):
            pixel, i = first + y * width + x, lane_of(x, y)
            # alpha = 1 - T_AT: its gradient acts like that of a background.
            planes[BEHIND + i] = -v_alpha[pixel] * planes[T_AT + i]
            planes[V_DEPTH + i], planes[V_MEDIAN + i] = v_depth[pixel], v_median[pixel]
            planes[V_DISTORTION + i] = v_distortion[pixel]
            for d in range(channels):
                planes[V_IMAGE + d * PIXELS + i] = v_image[pixel * channels + d]
    return int(most) + 1


@functools.cache
def composite_discs_backward(real: type) -> Kernel:
    """Builds the kernel that fills one row of sums per pair, given the final state of each tile."""
    unblend, sum_channels = _unblend(real), tile.sum_channels_of(real, V_IMAGE, WEIGHT, PAIR_VALUES)
    zero, REACHED = real(0.0), (1 << BLOCKS) - 1

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
            camera, x0, y0, columns, lines = tile_bounds(active[n], image_width, height)
            corner, at = (camera * height + y0) * image_width + x0, n * STATE
            planes = np.empty(V_IMAGE + groups * 4 * PIXELS, real)
            sums: Any = np.empty(LANES, real)
            batch = np.empty(CHUNK * width, real)
            looked_at = begin_gradients(planes, state, at, v_images, corner, image_width, columns, lines, num_channels)
            rows[(start + looked_at) * row_width : stop * row_width] = zero
            for behind in range(0, looked_at, CHUNK):
                last = start + looked_at - behind
                first = max(last - CHUNK, start)
                _fetch(batch, packed, pair_splats, first, last, width, x0, y0)
                for k in range(last - first):
                    p = last - 1 - k
                    splat, row = (p - first) * width, p * row_width
                    batch[splat + ORDER] = real(np.int32(p - start))
                    blocks = np.int64(pairs[p]) & REACHED
                    if blocks == 0:
                        rows[row : row + row_width] = zero
                        continue
                    unblend(planes, state, at, batch, splat, blocks, groups, near, sharpness, rows, row)
                    sum_channels(planes, blocks, 0, groups, rows, row, sums)

    return backward


class Saved(NamedTuple):
    """Flat results of the forward pass for the backward pass: packed discs, the blocks that each pair reaches, and
    each active tile's final state.
    """

    packed: Tensor
    pairs: Tensor
    state: Tensor


def composite_discs(
    discs: Discs, channels: Tensor, bins: TileBins, *, near: float, low_pass: float, needs_gradients: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Saved]:
    """The fields of `BlendedDiscs`, and the state for `composite_discs_gradients`, which costs nothing extra here."""
    cameras, count, num_channels = channels.shape
    shape, real = (bins.num_cameras, bins.height, bins.width), REAL_OF[channels.dtype]
    images = [channels.new_zeros(s) for s in ((*shape, num_channels), shape, shape, shape, shape)]
    # Arrays of PyTorch, because they are aligned to cache lines, and a packed disc fills whole ones.
    sizes = cameras * count * tile.row_width(VALUES, num_channels), len(bins.active) * STATE
    packed, state = (torch.empty(size, dtype=channels.dtype) for size in sizes)
    saved = Saved(packed, torch.zeros(len(bins.pair_splats), dtype=torch.int32), state)
    composite_discs_forward(real)(
        *tile.joined_cameras((*discs[:4], *discs.outlines[:2], channels)), bins.width, bins.height,
        *_real_options(real, near, low_pass), bins.pair_splats, bins.tile_offsets, bins.splat_offsets, bins.active,
        *saved, tuple(tile.flat(image) for image in images),
    )  # fmt: skip
    image, alpha, depth, median, distortion = images
    return image, alpha, depth, median, distortion, saved


def composite_discs_gradients(
    discs: Discs, channels: Tensor, bins: TileBins, saved: Saved, v_outputs: Sequence[Tensor],
    *, near: float, low_pass: float, with_absgrad: bool,
) -> tuple[Tensor | None, ...]:  # fmt: skip
    """Gradients of means2d, maps, opacities, depths, channels and absgrad; the last is None without `with_absgrad`."""
    (cameras, count, num_channels), real = channels.shape, REAL_OF[channels.dtype]
    rows = tile.new_pair_rows(bins, tile.row_width(PAIR_VALUES, num_channels), channels.dtype)
    composite_discs_backward(real)(
        cameras * count, num_channels, bins.width, bins.height, *_real_options(real, near, low_pass),
        bins.pair_splats, bins.tile_offsets, bins.active, *saved, tuple(tile.flat(v) for v in v_outputs), rows,
    )  # fmt: skip
    widths = ((2,), (MAP,), (), (), (num_channels,), (2,))
    found = [channels.new_zeros(cameras, count, *rest) for rest in widths]
    arrays = tile.joined_cameras((discs.maps, discs.opacities, *found))
    sum_disc_rows(real)(rows, bins.pair_slots, bins.splat_offsets, *arrays)
    return (*found[:5], found[5] if with_absgrad else None)


def _real_options(real: type, near: float, low_pass: float) -> tuple[Any, Any]:
    """The near plane, and one over the variance of the low-pass."""
    return real(near), real(1 / low_pass**2) if low_pass else real(np.inf)


@functools.cache
def sum_disc_rows(real: type) -> Kernel:
    """Fills the gradients, initially zero, of each disc from the rows of its pairs, in a fixed order."""
    zero = real(0.0)

    @kernel("sum_disc_rows", real)
    def sum_rows(rows, slots, offsets, maps, opacities, v_means, v_maps, v_opacities, v_depths, v_channels, v_absgrad):
        count, width = offsets.size - 1, rows.size // max(1, slots.size)
        num_chunks = (count + SPLATS - 1) // SPLATS
        stride = even_stride(num_chunks)
        for task in prange(num_chunks):
            chunk = task * stride % num_chunks
            total = np.empty(width, real)
            for s in range(chunk * SPLATS, min(count, (chunk + 1) * SPLATS)):
                if offsets[s] == offsets[s + 1]:
                    continue
                for column in range(0, width, LANES):
                    part = full(zero)
                    for k in range(offsets[s], offsets[s + 1]):
                        part = part + load(rows, slots[k] * width + column)
                    store(total, column, part)
                for d in range(v_channels.shape[1]):
                    v_channels[s, d] = total[PAIR_VALUES + d]
                for j in range(2):
                    v_maps[s, j], v_maps[s, 2 + j], v_maps[s, 4 + j] = total[UP + j], total[VP + j], total[E + j]
                    # Gradients of invisible discs stay zero, even if their geometry is not finite.
                    if total[UP + 2] != zero or total[VP + 2] != zero or total[E + 2] != zero:
                        v_means[s, j] -= total[UP + 2] * maps[s, j]
                        v_means[s, j] -= total[VP + 2] * maps[s, 2 + j]
                        v_means[s, j] -= total[E + 2] * maps[s, 4 + j]
                    v_means[s, j] -= total[AROUND + j]
                    v_absgrad[s, j] = total[ABSGRAD + j]
                if total[G] != zero:
                    v_opacities[s] = total[G] / opacities[s]
                v_depths[s] = total[V_Z]

    return sum_rows
