"""Gradients of blending on the GPU: one thread per (tile, splat) pair, after Taming 3DGS (arXiv 2406.15643).

A warp processes a bucket of 32 consecutive pairs of a tile, one per lane. The pixels of the tile pass through the lanes
from the nearest splat to the farthest: in step i, lane l has pixel i - l, and leaves its state for the next lane in
shared memory. So every lane sums its own splat's gradient in registers, without atomics or sums across threads. The
forward pass has stored the state of pixels at the start of each bucket: their transmittances and partial sums. One
gradient row is written per pair, and the rows of each splat are summed afterwards in a fixed order.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numba import cuda

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.backend.cuda import Kernel, kernel
from glassplat.kernels.backend.devices import SIMULATED
from glassplat.kernels.composite.cpu_tile import tile_bounds
from glassplat.kernels.composite.cuda_tile import BUCKET, COLUMNS, MEAN_X, MEAN_Y, MOMENTS, PIXELS, at, tile_steps
from glassplat.kernels.maths.blending import ALPHA_MAX, ALPHA_MIN, Scalar
from glassplat.kernels.maths.fast_maths import reciprocal_maths
from glassplat.kernels.records import ON_MEAN, TILE

WARPS = 2
"""Buckets per block, which are independent of each other."""
THREADS, SLOTS = WARPS * BUCKET, WARPS * PIXELS

BEHIND, LAST, T_GLASS, BEHIND_GLASS, LAST_GLASS, STATES = (*(at(i * SLOTS) for i in range(1, 6)), 6 * SLOTS)
"""Offsets in shared memory after the transmittances: gradient-weighted sums behind the current splat, and the last lane
whose splat each pixel blended; the same three planes for glass; and the end."""

EXTRAS = 5
"""Number of planes of a tile's pixel gradients beyond those of its channels."""


@cache
def composite_cotangents(real: type, num_channels: int = 4) -> Kernel:
    """Gathers, tile by tile, the gradients of each pixel [A, D + 5, 256]: one plane per channel, then the gradients of
    the mask and of the deviation, the mean that the latter refers to, and the gradient-weighted sums of all that the
    pixel has blended and of its glass.
    """
    shown, spread, middle, total, total_glass = range(num_channels, num_channels + EXTRAS)

    @kernel(
        f"composite_cotangents_{num_channels}",
        real,
        "int int1 real3 real3 real4 real3 real3 real4 real3 real3 real3 real3 real3",
    )
    def gather(
        channel, active, final, center, image, mask, deviation,
        v_image, v_alpha, v_mask, v_deviation, v_spread, v_pixels,
    ):  # fmt: skip
        n, pixel = cuda.blockIdx.x, cuda.threadIdx.x
        camera, x0, y0, columns, rows = tile_bounds(active[n], v_image.shape[2], v_image.shape[1])
        column, row = pixel % TILE, pixel // TILE
        if column >= columns or row >= rows:
            return
        y, x = y0 + row, x0 + column
        # alpha = 1 - T: its gradient acts like that of a background.
        of_glass = v_mask[camera, y, x] * mask[camera, y, x]
        gathered = of_glass - v_alpha[camera, y, x] * final[n, 0, pixel]
        v_pixels[n, shown, pixel], v_pixels[n, total_glass, pixel] = v_mask[camera, y, x], of_glass
        if channel >= 0:
            gathered += v_deviation[camera, y, x] * deviation[camera, y, x]
            v_pixels[n, spread, pixel], v_pixels[n, middle, pixel] = v_spread[camera, y, x], center[camera, y, x]
        for d in range(num_channels):
            v = v_image[camera, y, x, d]
            gathered += v * image[camera, y, x, d]
            v_pixels[n, d, pixel] = v
        v_pixels[n, total, pixel] = gathered

    return gather


def _enter(real: type, num_channels: int) -> Scalar:
    shown, spread, _, total, total_glass = _planes(num_channels)
    kept_t, kept_shown = PIXELS * (num_channels + 1), PIXELS * (num_channels + 2)
    behinds, last, glass_ts, glass_behinds, glass_lasts = BEHIND, LAST, T_GLASS, BEHIND_GLASS, LAST_GLASS
    zero = real(0.0)

    @inlined
    def enter(
        mine, v_at, had, had_spread, lasts, channel, has_glass, v_pixels, kept, kept_spread, state,
    ):  # fmt: skip
        """Writes a pixel's state before a bucket's first pair to shared memory."""
        behind = v_pixels[at(v_at + total)]
        for d in range(num_channels):
            behind -= v_pixels[at(v_at + d * PIXELS)] * kept[at(had + PIXELS + d * PIXELS)]
        if channel >= 0 and v_pixels[at(v_at + spread)] != zero:
            behind -= v_pixels[at(v_at + spread)] * kept_spread[at(had_spread)]
        if has_glass:
            of_glass = v_pixels[at(v_at + shown)] * kept[at(had + kept_shown)]
            behind -= of_glass
            state[mine + glass_ts], state[mine + glass_lasts] = kept[at(had + kept_t)], lasts[1]
            state[mine + glass_behinds] = v_pixels[at(v_at + total_glass)] - of_glass
        state[mine], state[mine + behinds], state[mine + last] = kept[at(had)], behind, lasts[0]

    return enter


def _write(num_channels: int, with_absgrad: bool) -> Scalar:
    @inlined
    def write(
        out, pair, g_x, g_y, g_xx, g_xy, g_yy, g_0, v_value, channel, v_apart, glass, v_mark, absgrad_x, absgrad_y
    ):  # fmt: skip
        """Fills the gradient row of a pair; a mark's gradient is stored in the column of the first channel."""
        out[pair, 0], out[pair, 1], out[pair, 2] = g_x, g_y, g_xx
        out[pair, 3], out[pair, 4], out[pair, 5] = g_xy, g_yy, g_0
        for d in range(num_channels):
            out[pair, MOMENTS + d] = v_value[d]
        if channel >= 0:
            out[pair, MOMENTS + channel] += v_apart
        if glass:
            out[pair, MOMENTS] = v_mark
        if with_absgrad:
            out[pair, MOMENTS + num_channels], out[pair, MOMENTS + num_channels + 1] = absgrad_x, absgrad_y

    return write


def _planes(num_channels: int) -> tuple[int, ...]:
    """Offsets of the planes of a tile's gradients beyond those of its channels."""
    return tuple(PIXELS * (num_channels + i) for i in range(EXTRAS))


@cache
def composite_backward(real: type, num_channels: int = 4, with_absgrad: bool = True) -> Kernel:
    """Fills one gradient row per pair that any pixel blended; all rows start at zero."""
    load, coverage = tile_steps(real)
    reciprocal = reciprocal_maths(real)
    zero, one, on_mean = real(0.0), real(1.0), real(ON_MEAN * np.finfo(real).eps)
    alpha_min, alpha_max = real(ALPHA_MIN), real(ALPHA_MAX)
    behinds, lasts, glass_lasts, glass_state, above = BEHIND, LAST, LAST_GLASS, 3 * SLOTS, BUCKET // TILE
    shown, spread, middle, _, _ = _planes(num_channels)
    enter, write = _enter(real, num_channels), _write(num_channels, with_absgrad)

    @kernel(
        f"composite_backward_{num_channels}{'_absgrad' if with_absgrad else ''}",
        real,
        "real2 real2 real1 real2 real2 int int int int int int1 long1 int1 int1 int1 int1 real1 real1 real1 real2",
    )
    def backward(
        means, conics, opacities, channels, marks, splats_per_camera, num_primary, channel, width, height,
        pair_splats, tile_offsets, active, last, looked_at, bucket_tiles, kept, kept_spread, v_pixels, out,
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
        camera, x0, y0, _, rows = tile_bounds(active[n], width, height)
        first_glass, has_glass = camera * splats_per_camera + num_primary, num_primary < splats_per_camera
        planes = num_channels + 3 if has_glass else num_channels + 1
        entry, tile_pixels, tile_last = bucket * planes * PIXELS, n * (num_channels + EXTRAS) * PIXELS, n * 2 * PIXELS
        for pixel in range(lane, PIXELS, BUCKET):
            # A pixel that stopped earlier has stored nothing, and no lane evaluates it.
            own_last, own_glass = last[at(tile_last + pixel)] - first, last[at(tile_last + PIXELS + pixel)] - first
            if own_last < 0 and own_glass < 0:
                state[at(warp * PIXELS + pixel) + lasts] = state[at(warp * PIXELS + pixel) + glass_lasts] = -one
                continue
            enter(
                at(warp * PIXELS + pixel), tile_pixels + pixel, entry + pixel, bucket * PIXELS + pixel,
                (real(own_last), real(own_glass)), channel, has_glass, v_pixels, kept, kept_spread, state,
            )  # fmt: skip
        order, place_in_bucket = first + lane, real(np.int32(lane))
        inside, glass, mark, apart = order < looked_at[n], False, zero, zero
        xx, xy, yy, absgrad_x, absgrad_y, reached = zero, zero, zero, zero, zero, np.int32(0)
        if inside:
            s = pair_splats[start + order]
            reached = load(geometry, 0, s, means, conics, opacities, x0, y0, rows)
            xx, xy, yy, glass = conics[s, 0], conics[s, 1], conics[s, 2], s >= first_glass
            if glass:
                mark = marks[camera, s - first_glass]
            else:
                apart = channels[s, max(channel, 0)]
                for d in range(num_channels):
                    value[d] = channels[s, d]
        for d in range(num_channels):
            v_value[d] = zero
        g_x, g_y, g_xx, g_xy, g_yy, g_0, v_mark, v_apart = zero, zero, zero, zero, zero, zero, zero, zero
        # Pixels are numbered starting `above` rows above the tile. Before a lane's first pixel and after its last one,
        # the number is in rows that no splat reaches; padding lanes reach none at all.
        reached, own_pixels = np.int32(reached << above), tile_pixels - above * TILE
        own_state = np.int32(warp * PIXELS + (glass_state if glass else 0) - above * TILE)
        p, end = np.int32(above * TILE - lane), np.int32(above * TILE + PIXELS + BUCKET - 1 - lane)
        while p < end:
            # Synchronises the lanes of a warp; the simulator supports only blocks.
            if SIMULATED:
                cuda.syncthreads()
            else:
                cuda.syncwarp()
            row = np.int32(p >> 4)
            if np.int32(reached & np.int32(1 << row)) != 0:
                x, y = real(np.int32(p & (TILE - 1))), real(np.int32(row - above))
                covered, mine = coverage(geometry, 0, x, y), at(own_state + p)
                if covered >= alpha_min and place_in_bucket <= state[mine + lasts]:
                    a = min(covered, alpha_max)
                    # 32-bit indices suffice for pixel gradients of up to 16 GiB.
                    v_at, inverse = at(np.uint32(own_pixels + p)), reciprocal(one - a)
                    if glass:
                        t_glass, of_all = state[mine], mine - at(glass_state)
                        v_pixel = v_pixels[v_at + at(shown)] * state[of_all] * t_glass
                        weight = a * v_pixel
                        of_glass = state[mine + behinds] - weight * mark
                        gain = (v_pixel * mark - of_glass * inverse) * a
                        v_mark += weight
                        state[mine], state[mine + behinds] = t_glass - a * t_glass, of_glass
                        state[of_all + behinds] -= weight * mark
                    else:
                        t, dot = state[mine], zero
                        weight = a * t
                        for d in range(num_channels):
                            v_pixel = v_pixels[v_at + at(d * PIXELS)]
                            dot += v_pixel * value[d]
                            v_value[d] += weight * v_pixel
                        if channel >= 0:
                            difference, v_pixel = apart - v_pixels[v_at + at(middle)], v_pixels[v_at + at(spread)]
                            dot += v_pixel * abs(difference)
                            if abs(difference) > on_mean * abs(v_pixels[v_at + at(middle)]):
                                v_apart += weight * v_pixel if difference > zero else -weight * v_pixel
                        behind = state[mine + behinds] - weight * dot
                        gain = (t * dot - behind * inverse) * a
                        state[mine], state[mine + behinds] = t - weight, behind
                    if covered < alpha_max:
                        dx, dy = x - geometry[0, MEAN_X], y - geometry[0, MEAN_Y]
                        gain_x, gain_y = gain * dx, gain * dy
                        g_0, g_x, g_y = g_0 + gain, g_x + gain_x, g_y + gain_y
                        g_xx, g_xy, g_yy = g_xx + gain_x * dx, g_xy + gain_x * dy, g_yy + gain_y * dy
                        if with_absgrad:
                            absgrad_x += abs(xx * gain_x + xy * gain_y)
                            absgrad_y += abs(xy * gain_x + yy * gain_y)
            p = np.int32(p + 1)
        if inside:
            write(
                out, start + order, g_x, g_y, g_xx, g_xy, g_yy, g_0, v_value, channel, v_apart,
                glass, v_mark, absgrad_x, absgrad_y,
            )  # fmt: skip

    return backward
