"""Gradients of blending discs on the GPU: one thread for each (tile, disc) pair, as those of splats.

A warp takes a bucket of 32 consecutive pairs of a tile, one for each lane, and the pixels of the tile pass through the
lanes (`glassplat.kernels.composite.cuda_backward`). So every lane sums its own disc's gradient in registers.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numba import cuda

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.backend.cuda import Kernel, kernel
from glassplat.kernels.backend.devices import SIMULATED
from glassplat.kernels.composite.cuda_tile import BUCKET, PIXELS, at, tile_steps
from glassplat.kernels.composite_discs.cuda_tile import (
    COLUMNS,
    INVERSE_DEPTH,
    KEPT_DEPTH,
    KEPT_SQUARES,
    KEPT_T,
    KEPT_TOTAL,
    KEPT_VALUES,
    LAST,
    MEDIAN,
    ORDERS,
    U_X,
    disc_tile_steps,
)
from glassplat.kernels.composite_discs.cuda_tile import DEPTH as Z
from glassplat.kernels.maths.blending import ALPHA_MAX, Scalar
from glassplat.kernels.maths.disc import meet_maths
from glassplat.kernels.maths.fast_maths import reciprocal_maths
from glassplat.kernels.records import TILE

WARPS = 2
"""Buckets of a block; they have nothing to do with each other."""
THREADS, SLOTS = WARPS * BUCKET, WARPS * PIXELS

BEHIND, BLENDED, MIDDLE, STATES = at(SLOTS), at(2 * SLOTS), at(3 * SLOTS), 4 * SLOTS
"""Where what follows the transmittances begins in shared memory: what lies behind each pixel, the last lane whose disc
it blended and the one whose depth is its median; and the end."""

# Planes of a tile's pulls beyond those of its channels.
V_DEPTH, V_MEDIAN, V_DISTORTION, GATHERED, FIRST, COVERED, TOTAL, SQUARES, PULLS = range(9)

# Columns of a pair's row, as on the CPU; the channels' follow.
UP, VP, E, AROUND, G, DEPTH, PULL, MOMENTS = 0, 3, 6, 9, 11, 12, 13, 15


@cache
def composite_discs_pulls(real: type, num_channels: int = 6) -> Kernel:
    """Gathers, tile by tile, what each pixel's gradients pull at [A, D + 8, 256]: one plane per channel, then those
    that the constants name. What the pixel gathered in all holds each part times its gradient.
    """
    place = tile_steps(real).place
    zero, one, two = real(0.0), real(1.0), real(2.0)

    @kernel(
        f"composite_discs_pulls_{num_channels}",
        real,
        "int1 real3 real4 real3 real4 real3 real3 real3 real3 real3",
    )
    def gather(active, finals, image, depth, v_image, v_alpha, v_depth, v_median, v_distortion, pulls):
        n, pixel = cuda.blockIdx.x, cuda.threadIdx.x
        camera, x0, y0, columns, rows = place(active[n], v_image.shape[2], v_image.shape[1])
        column, row = pixel % TILE, pixel // TILE
        if column >= columns or row >= rows:
            return
        y, x = y0 + row, x0 + column
        t, total, squares = finals[n, 0, pixel], finals[n, 2, pixel], finals[n, 3, pixel]
        covered, v_spread = one - t, v_distortion[camera, y, x]
        # alpha = 1 - T: its gradient acts like something behind every disc.
        gathered = v_depth[camera, y, x] * depth[camera, y, x] - v_alpha[camera, y, x] * t
        if v_spread != zero:
            gathered += v_spread * two * (covered * squares - total * total)
        for d in range(num_channels):
            v = v_image[camera, y, x, d]
            gathered += v * image[camera, y, x, d]
            pulls[n, d, pixel] = v
        pulls[n, num_channels + V_DEPTH, pixel] = v_depth[camera, y, x]
        pulls[n, num_channels + V_MEDIAN, pixel] = v_median[camera, y, x]
        pulls[n, num_channels + V_DISTORTION, pixel], pulls[n, num_channels + GATHERED, pixel] = v_spread, gathered
        pulls[n, num_channels + FIRST, pixel] = finals[n, 1, pixel]
        pulls[n, num_channels + COVERED, pixel] = covered
        pulls[n, num_channels + TOTAL, pixel], pulls[n, num_channels + SQUARES, pixel] = total, squares

    return gather


def _enter(real: type, num_channels: int) -> Scalar:
    """Puts what a pixel is before a bucket's first pair into shared memory."""
    one, two, behinds = real(1.0), real(2.0), BEHIND
    of_depth, of_spread, gathered = (PIXELS * (num_channels + plane) for plane in (V_DEPTH, V_DISTORTION, GATHERED))
    of_covered, of_total, of_squares = (PIXELS * (num_channels + plane) for plane in (COVERED, TOTAL, SQUARES))

    @inlined
    def enter(mine, pulled, had, pulls, kept, state):
        t = kept[at(had + KEPT_T * PIXELS)]
        behind = pulls[at(pulled + gathered)]
        behind -= pulls[at(pulled + of_depth)] * kept[at(had + KEPT_DEPTH * PIXELS)]
        spread = pulls[at(pulled + of_covered)] * kept[at(had + KEPT_SQUARES * PIXELS)]
        spread -= two * pulls[at(pulled + of_total)] * kept[at(had + KEPT_TOTAL * PIXELS)]
        spread += pulls[at(pulled + of_squares)] * (one - t)
        behind -= pulls[at(pulled + of_spread)] * spread
        for d in range(num_channels):
            behind -= pulls[at(pulled + d * PIXELS)] * kept[at(had + (KEPT_VALUES + d) * PIXELS)]
        state[mine], state[mine + behinds] = t, behind

    return enter


@cache
def composite_discs_backward(real: type, num_channels: int = 6) -> Kernel:
    """Fills one gradient row per pair that any pixel blended; all rows start at zero."""
    place, (load, cover), slopes = tile_steps(real).place, disc_tile_steps(real), meet_maths(real)[1]
    reciprocal, enter = reciprocal_maths(real), _enter(real, num_channels)
    zero, one, two, alpha_max, endless = real(0.0), real(1.0), real(2.0), real(ALPHA_MAX), real(np.inf)
    behinds, lasts, middles = BEHIND, BLENDED, MIDDLE
    of_depth, of_median, of_spread, _, of_first, of_covered, of_total, of_squares = (
        at(PIXELS * (num_channels + plane)) for plane in range(PULLS)
    )

    @kernel(
        f"composite_discs_backward_{num_channels}",
        real,
        "real2 real2 real1 real1 real2 real2 real2 real real int int int1 long1 int1 int1 int1 int1 real1 real1 real2",
    )
    def backward(
        means, maps, opacities, depths, centers, conics, channels, near, sharpness, width, height,
        pair_splats, tile_offsets, active, orders, looked_at, bucket_tiles, kept, pulls, out,
    ):  # fmt: skip
        state = cuda.shared.array(STATES, real)
        geometry = cuda.local.array((1, COLUMNS), real)
        value = cuda.local.array(num_channels, real)
        v_value = cuda.local.array(num_channels, real)
        warp, lane = cuda.threadIdx.x // BUCKET, cuda.threadIdx.x % BUCKET
        bucket = cuda.blockIdx.x * WARPS + warp
        n = bucket_tiles[bucket] if bucket < bucket_tiles.size else -1
        if n < 0:
            return
        start = tile_offsets[active[n]]
        first = (bucket - n - start // BUCKET) * BUCKET
        if first >= looked_at[n]:
            return
        _, x0, y0, _, rows = place(active[n], width, height)
        entry, tile_pulls = bucket * (KEPT_VALUES + num_channels) * PIXELS, n * (num_channels + PULLS) * PIXELS
        tile_orders = n * ORDERS * PIXELS
        for pixel in range(lane, PIXELS, BUCKET):
            mine = at(warp * PIXELS + pixel)
            own_last = orders[at(tile_orders + LAST * PIXELS + pixel)] - first
            state[mine + lasts] = real(own_last)
            state[mine + middles] = real(orders[at(tile_orders + MEDIAN * PIXELS + pixel)] - first)
            # A pixel that had stopped before stored nothing, and no lane will look at it.
            if own_last >= 0:
                enter(mine, tile_pulls + pixel, entry + pixel, pulls, kept, state)
        order, tile, own = first + lane, np.uint32(n), real(np.int32(lane))
        inside, reached = order < looked_at[n], np.int32(0)
        for d in range(num_channels):
            v_value[d] = value[d] = zero
        if inside:
            s = pair_splats[start + order]
            reached = load(geometry, 0, s, means, maps, opacities, depths, centers, conics, x0, y0, rows)
            for d in range(num_channels):
                value[d] = channels[s, d]
        found = (
            geometry[0, U_X], geometry[0, U_X + 1], geometry[0, U_X + 2], geometry[0, U_X + 3], geometry[0, U_X + 4],
            geometry[0, U_X + 5],
        )  # fmt: skip
        depth, inverse_depth, around = geometry[0, Z], geometry[0, INVERSE_DEPTH], zero
        if sharpness < endless:
            around = -sharpness
        up_x, up_y, up_1, vp_x, vp_y, vp_1, e_x, e_y, e_1 = zero, zero, zero, zero, zero, zero, zero, zero, zero
        around_x, around_y, g, g_depth, pull_x, pull_y = zero, zero, zero, zero, zero, zero
        own_pulls, step = at(tile) * at((num_channels + PULLS) * PIXELS), np.int32(0)
        while step < PIXELS + BUCKET - 1:
            # The lanes of a warp wait for each other; the simulator knows no warps, but blocks.
            if SIMULATED:
                cuda.syncthreads()
            else:
                cuda.syncwarp()
            p = np.int32(step - lane)
            step = np.int32(step + 1)
            # A disc that is not there reaches no row, and none was blended where the tile reaches beyond the image.
            if 0 <= p < PIXELS and np.int32(reached & np.int32(1 << (p >> 4))) != 0:
                x, y, mine = real(np.int32(p & (TILE - 1))), real(np.int32(p >> 4)), at(warp * PIXELS + p)
                (dx, dy), (u, v, inverse), e, covered, on_disc = cover(geometry, 0, x, y, near, sharpness)
                if covered > zero and own <= state[mine + lasts]:
                    pulled, t, a = own_pulls + at(np.uint32(p)), state[mine], min(covered, alpha_max)
                    weight, worth = a * t, zero
                    for d in range(num_channels):
                        pull = pulls[pulled + at(d * PIXELS)]
                        worth += pull * value[d]
                        v_value[d] += weight * pull
                    z, apart = inverse * depth, e * inverse_depth - pulls[pulled + of_first]
                    lean = apart * pulls[pulled + of_covered] - two * pulls[pulled + of_total]
                    v_spread = pulls[pulled + of_spread]
                    worth += pulls[pulled + of_depth] * z + v_spread * (lean * apart + pulls[pulled + of_squares])
                    v_z = weight * pulls[pulled + of_depth]
                    if own == state[mine + middles]:
                        v_z += pulls[pulled + of_median]
                    # The derivative of a square is twice as steep: `lean` holds the sum of distances but for half.
                    v_inverse = weight * v_spread * two * (lean + pulls[pulled + of_total])
                    behind = state[mine + behinds] - weight * worth
                    gain = (t * worth - behind * reciprocal(one - a)) * a if covered < alpha_max else zero
                    state[mine], state[mine + behinds] = t - weight, behind
                    g += gain
                    g_depth += v_z * inverse - v_inverse * e * inverse_depth * inverse_depth
                    if on_disc:
                        v_up, v_vp = -gain * u * inverse, -gain * v * inverse
                        v_e = (gain * (u * u + v * v) - v_z * z) * inverse + v_inverse * inverse_depth
                        up_x, up_y, up_1 = up_x + v_up * dx, up_y + v_up * dy, up_1 + v_up
                        vp_x, vp_y, vp_1 = vp_x + v_vp * dx, vp_y + v_vp * dy, vp_1 + v_vp
                        e_x, e_y, e_1 = e_x + v_e * dx, e_y + v_e * dy, e_1 + v_e
                        slope_x, slope_y = slopes(found, v_up, v_vp, v_e)
                        pull_x, pull_y = pull_x + abs(slope_x), pull_y + abs(slope_y)
                    else:
                        moved_x, moved_y = gain * around * dx, gain * around * dy
                        around_x, around_y = around_x + moved_x, around_y + moved_y
                        pull_x, pull_y = pull_x + abs(moved_x), pull_y + abs(moved_y)
        if inside:
            row = start + order
            out[row, UP], out[row, UP + 1], out[row, UP + 2] = up_x, up_y, up_1
            out[row, VP], out[row, VP + 1], out[row, VP + 2] = vp_x, vp_y, vp_1
            out[row, E], out[row, E + 1], out[row, E + 2] = e_x, e_y, e_1
            out[row, AROUND], out[row, AROUND + 1], out[row, G], out[row, DEPTH] = around_x, around_y, g, g_depth
            out[row, PULL], out[row, PULL + 1] = pull_x, pull_y
            for d in range(num_channels):
                out[row, MOMENTS + d] = v_value[d]

    return backward
