"""Gradients of blending, tile by tile and back to front.

One gradient row is written per (tile, splat) pair; the rows of each splat are summed afterwards in a fixed order, so
that the result has the same bits for any number of threads. Transmittances come back by division from their final
values.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numba import prange

from glassplat.kernels.composite import cpu_tile as tile
from glassplat.kernels.cpu.jit import Kernel, inlined, kernel
from glassplat.kernels.cpu.schedule import even_stride
from glassplat.kernels.maths.blending import ALPHA_MAX, Scalar, blend_maths
from glassplat.kernels.splats import LEAST_ALPHA

# Planes of the backward pass; V_IMAGE has one per channel. BEHIND and BEHIND_GLASS hold what lies behind the current
# splat, weighted by the incoming gradients; DOT the current splat's deviation and its channels beyond the first group,
# so weighted; V_DEVIATION and CENTER the gradient of the deviation and the mean it is measured from. LANES is rows of
# 16 column sums: g, g dy and g dy^2 as `geometry_gradient` takes them, the probe's two, then one per channel.
BEHIND, BEHIND_GLASS, V_MASK, DOT = 5 * tile.PLANE, 6 * tile.PLANE, 7 * tile.PLANE, 8 * tile.PLANE
V_DEVIATION, CENTER = 9 * tile.PLANE, 10 * tile.PLANE
LANES, V_IMAGE = 11 * tile.PLANE, 14 * tile.PLANE
LANE_PROBE, LANE_VALUES = LANES + 48, LANES + 80


def _unblend_primary(real: type, probed: bool) -> Scalar:
    clipped_alpha = blend_maths(real).clipped_alpha
    zero, half, one, alpha_max = real(0.0), real(0.5), real(1.0), real(ALPHA_MAX)
    T, LAST, COVERAGE, PLANE, VALUES = tile.T, tile.LAST, tile.COVERAGE, tile.PLANE, tile.VALUES
    MEAN_Y, probe = tile.MEAN_Y, _probe(real)

    @inlined
    def unblend_primary(scratch, splat, order, x0, y0, first, last):
        """Takes a splat off the pixels of its rows and adds up its lane sums."""
        c0, c1, c2, c3 = splat[VALUES], splat[VALUES + 1], splat[VALUES + 2], splat[VALUES + 3]
        mean_y = splat[MEAN_Y] - real(y0)
        for row in range(first, last):
            base = (row & 15) * 16
            dy = real(row) + half - mean_y
            for i in range(16):
                coverage = scratch[COVERAGE + base + i]
                a = clipped_alpha(coverage) if order <= scratch[LAST + base + i] else zero
                inverse = one / (one - a)
                t = scratch[T + base + i] * inverse
                weight = a * t
                v0, v1 = scratch[V_IMAGE + base + i], scratch[V_IMAGE + PLANE + base + i]
                v2, v3 = scratch[V_IMAGE + 2 * PLANE + base + i], scratch[V_IMAGE + 3 * PLANE + base + i]
                dot = scratch[DOT + base + i] + v0 * c0 + v1 * c1 + v2 * c2 + v3 * c3
                behind = scratch[BEHIND + base + i]
                v_alpha = t * dot - behind * inverse
                scratch[BEHIND + base + i] = behind + weight * dot
                scratch[T + base + i] = t
                gain = v_alpha * a if coverage < alpha_max else zero
                scratch[LANES + i] += gain
                scratch[LANES + 16 + i] += gain * dy
                scratch[LANES + 32 + i] += gain * dy * dy
                if probed:
                    probe(scratch, splat, gain, i, x0, dy)
                scratch[LANE_VALUES + i] += weight * v0
                scratch[LANE_VALUES + 16 + i] += weight * v1
                scratch[LANE_VALUES + 32 + i] += weight * v2
                scratch[LANE_VALUES + 48 + i] += weight * v3
                # From here on the plane holds weights, for the channels of `sum_more`.
                scratch[COVERAGE + base + i] = weight

    return unblend_primary


def _probe(real: type) -> Scalar:
    half, nats, half_nats = real(0.5), real(-math.log(2.0)), real(-2.0 * math.log(2.0))
    MEAN_X, FORM_XX, FORM_XY, FORM_YY = tile.MEAN_X, tile.FORM_XX, tile.FORM_XY, tile.FORM_YY

    @inlined
    def probe(scratch, splat, gain, i, x0, dy):
        """Adds to the probe's lanes what one pixel's `gain` pulls at the mean, as `geometry_gradient` has it."""
        xx, xy, yy = half_nats * splat[FORM_XX], nats * splat[FORM_XY], half_nats * splat[FORM_YY]
        dx = real(np.int32(i)) + (half - (splat[MEAN_X] - real(x0)))
        scratch[LANE_PROBE + i] += abs(gain * (xx * dx + xy * dy))
        scratch[LANE_PROBE + 16 + i] += abs(gain * (xy * dx + yy * dy))

    return probe


def _more_channels(real: type) -> tuple[Scalar, Scalar]:
    COVERAGE, PLANE, VALUES = tile.COVERAGE, tile.PLANE, tile.VALUES

    @inlined
    def dot_more(scratch, splat, groups, first, last):
        """Adds to DOT, before `unblend_primary`."""
        for row in range(first, last):
            base = (row & 15) * 16
            for group in range(1, groups):
                at, v = VALUES + 4 * group, V_IMAGE + (group & 7) * 4 * PLANE + base
                c0, c1, c2, c3 = splat[at], splat[at + 1], splat[at + 2], splat[at + 3]
                for i in range(16):
                    front = c0 * scratch[v + i] + c1 * scratch[v + PLANE + i]
                    back = c2 * scratch[v + 2 * PLANE + i] + c3 * scratch[v + 3 * PLANE + i]
                    scratch[DOT + base + i] += front + back

    @inlined
    def sum_more(scratch, groups, first, last):
        """Adds up the lane sums of channels beyond the first group, after `unblend_primary`."""
        for row in range(first, last):
            base = (row & 15) * 16
            for group in range(1, groups):
                v, lanes = V_IMAGE + (group & 7) * 4 * PLANE + base, LANE_VALUES + (group & 7) * 64
                for i in range(16):
                    weight = scratch[COVERAGE + base + i]
                    scratch[lanes + i] += weight * scratch[v + i]
                    scratch[lanes + 16 + i] += weight * scratch[v + PLANE + i]
                    scratch[lanes + 32 + i] += weight * scratch[v + 2 * PLANE + i]
                    scratch[lanes + 48 + i] += weight * scratch[v + 3 * PLANE + i]

    return dot_more, sum_more


def _deviation(real: type) -> tuple[Scalar, Scalar]:
    zero = real(0.0)
    COVERAGE = tile.COVERAGE

    @inlined
    def dot_deviation(scratch, value, first, last):
        """Adds to DOT, before `unblend_primary`."""
        for row in range(first, last):
            base = (row & 15) * 16
            for i in range(16):
                scratch[DOT + base + i] += scratch[V_DEVIATION + base + i] * abs(value - scratch[CENTER + base + i])

    @inlined
    def sum_deviation(scratch, value, lanes, first, last):
        """Adds to the lane sums of the channel, after `unblend_primary`."""
        lanes = lanes & 0xFFFF
        for row in range(first, last):
            base = (row & 15) * 16
            for i in range(16):
                difference = value - scratch[CENTER + base + i]
                slope = scratch[COVERAGE + base + i] * scratch[V_DEVIATION + base + i]
                slope = slope if difference > zero else -slope
                scratch[lanes + i] += slope if difference != zero else zero

    return dot_deviation, sum_deviation


def _load_deviation(real: type) -> Scalar:
    one, zero, least_alpha = real(1.0), real(0.0), real(LEAST_ALPHA)
    T, PLANE = tile.T, tile.PLANE

    @inlined
    def load_deviation(scratch, channel, through_mean, center, lean, v_deviation, camera, x0, y0, columns, rows):
        """Fills V_DEVIATION and CENTER, after the other gradients; False where the tile has no such gradient."""
        wanted = False
        for y in range(rows):
            for x in range(columns):
                i, middle = (y & 15) * 16 + (x & 15), center[camera, y0 + y, x0 + x]
                v = v_deviation[camera, y0 + y, x0 + x]
                wanted |= v != zero
                scratch[V_DEVIATION + i], scratch[CENTER + i] = v, middle
                covered = one - scratch[T + i]
                if through_mean and covered > least_alpha:
                    # The mean is the channel's sum over the coverage; alpha's gradient acts as in `load_gradients`.
                    v_sum = -v * lean[camera, y0 + y, x0 + x] / covered
                    scratch[V_IMAGE + (channel & 31) * PLANE + i] += v_sum
                    scratch[BEHIND + i] += v_sum * middle * scratch[T + i]
        return wanted

    return load_deviation


def _unblend_glass(real: type, probed: bool) -> Scalar:
    clipped_alpha = blend_maths(real).clipped_alpha
    zero, half, one, alpha_max = real(0.0), real(0.5), real(1.0), real(ALPHA_MAX)
    T, T_GLASS, LAST_GLASS, COVERAGE = tile.T, tile.T_GLASS, tile.LAST_GLASS, tile.COVERAGE
    MEAN_Y, probe = tile.MEAN_Y, _probe(real)

    @inlined
    def unblend_glass(scratch, splat, mark, order, x0, y0, first, last):
        """As `unblend_primary`; the first row of value lanes gets the gradient of the mark."""
        mean_y = splat[MEAN_Y] - real(y0)
        for row in range(first, last):
            base = (row & 15) * 16
            dy = real(row) + half - mean_y
            for i in range(16):
                coverage = scratch[COVERAGE + base + i]
                a = clipped_alpha(coverage) if order <= scratch[LAST_GLASS + base + i] else zero
                inverse = one / (one - a)
                t_glass = scratch[T_GLASS + base + i] * inverse
                v_mark = scratch[V_MASK + base + i] * scratch[T + base + i] * t_glass
                behind = scratch[BEHIND_GLASS + base + i]
                v_alpha = v_mark * mark - behind * inverse
                shown = a * v_mark * mark
                scratch[BEHIND_GLASS + base + i] = behind + shown
                scratch[BEHIND + base + i] += shown
                scratch[T_GLASS + base + i] = t_glass
                gain = v_alpha * a if coverage < alpha_max else zero
                scratch[LANES + i] += gain
                scratch[LANES + 16 + i] += gain * dy
                scratch[LANES + 32 + i] += gain * dy * dy
                if probed:
                    probe(scratch, splat, gain, i, x0, dy)
                scratch[LANE_VALUES + i] += a * v_mark

    return unblend_glass


@functools.cache
def composite_backward(real: type, probed: bool) -> Kernel:
    """Builds the kernel that fills one gradient row per pair, given the final state of each tile."""
    _, place, _, _, _, load_state, fetch, cover, geometry_gradient = tile.tile_functions(real)
    unblend_primary, unblend_glass = _unblend_primary(real, probed), _unblend_glass(real, probed)
    dot_more, sum_more = _more_channels(real)
    dot_deviation, sum_deviation = _deviation(real)
    load_deviation = _load_deviation(real)
    zero = real(0.0)
    T, LAST_GLASS, PLANE, VALUES, V_VALUES, BATCH = (
        tile.T,
        tile.LAST_GLASS,
        tile.PLANE,
        tile.VALUES,
        tile.V_VALUES,
        tile.BATCH,
    )

    @inlined
    def load_gradients(scratch, v_image, v_alpha, v_mask, camera, x0, y0, columns, rows):
        for y in range(rows):
            base = (y & 15) * 16
            image_row = v_image[camera, y0 + y, x0 : x0 + columns]
            alpha_row, mask_row = v_alpha[camera, y0 + y, x0 : x0 + columns], v_mask[camera, y0 + y, x0 : x0 + columns]
            for x in range(alpha_row.size):
                # alpha = 1 - T: its gradient acts like something behind every splat.
                scratch[BEHIND + base + x] = -alpha_row[x] * scratch[T + base + x]
                scratch[V_MASK + base + x] = mask_row[x]
            for d in range(image_row.shape[1]):
                for x in range(image_row.shape[0]):
                    scratch[V_IMAGE + (d & 31) * PLANE + base + x] = image_row[x, d]

    @inlined
    def last_glass_of(scratch):
        """Position of the last glass splat that any pixel of the tile looked at."""
        last = scratch[LAST_GLASS]
        for i in range(tile.PIXELS):
            last = max(last, scratch[LAST_GLASS + i])
        return last

    @kernel("composite_backward_probed" if probed else "composite_backward", real)
    def backward(
        marks, splats_per_camera, num_primary, num_channels, channel, through_mean,
        pair_splats, tile_offsets, active, packed, state, center, lean, v_image, v_alpha, v_mask, v_deviation, out,
    ):  # fmt: skip
        groups = (num_channels + 3) // 4
        stride = even_stride(active.size)
        for task in prange(active.size):
            n = task * stride % active.size
            camera, x0, y0, columns, rows = place(active[n], v_image.shape[2], v_image.shape[1])
            scratch = np.empty(V_IMAGE + groups * 4 * PLANE, real)
            scratch[:] = zero
            looked_at = load_state(state, n, scratch)
            last_glass = last_glass_of(scratch)
            load_gradients(scratch, v_image, v_alpha, v_mask, camera, x0, y0, columns, rows)
            deviates = channel >= 0
            if deviates:
                deviates = load_deviation(
                    scratch, channel, through_mean, center, lean, v_deviation, camera, x0, y0, columns, rows
                )
            start, stop = tile_offsets[active[n]], tile_offsets[active[n] + 1]
            out[start + looked_at : stop] = zero
            batch = np.empty((BATCH, packed.shape[1]), real)
            for behind in range(0, looked_at, BATCH):
                last = start + looked_at - behind
                first = max(last - BATCH, start)
                fetch(batch, packed, pair_splats, first, last)
                for k in range(last - first):
                    p = last - 1 - k
                    order, splat = real(np.int32(p - start)), batch[p - first]
                    glass = pair_splats[p] - camera * splats_per_camera - num_primary
                    top, bottom = 0, 0
                    if glass < 0 or order <= last_glass:
                        top, bottom = cover(scratch, splat, x0, y0, rows)
                    if top >= bottom:
                        out[p, :] = zero
                        continue
                    for i in range(80 + groups * 64):
                        scratch[LANES + i] = zero
                    if glass < 0:
                        if groups > 1 or deviates:
                            scratch[DOT + top * 16 : DOT + bottom * 16] = zero
                        if groups > 1:
                            dot_more(scratch, splat, groups, top, bottom)
                        if deviates:
                            dot_deviation(scratch, splat[VALUES + channel], top, bottom)
                        unblend_primary(scratch, splat, order, x0, y0, top, bottom)
                        if groups > 1:
                            sum_more(scratch, groups, top, bottom)
                        if deviates:
                            lanes = LANE_VALUES + channel * 16
                            sum_deviation(scratch, splat[VALUES + channel], lanes, top, bottom)
                    else:
                        unblend_glass(scratch, splat, marks[camera, glass], order, x0, y0, top, bottom)
                    geometry_gradient(out, p, scratch, LANES, splat, x0)
                    for d in range(num_channels):
                        total = zero
                        for i in range(16):
                            total += scratch[LANE_VALUES + (d & 31) * 16 + i]
                        out[p, V_VALUES + d] = total
                    if probed:
                        for d in range(2):
                            total = zero
                            for i in range(16):
                                total += scratch[LANE_PROBE + d * 16 + i]
                            out[p, V_VALUES + num_channels + d] = total

    return backward
