"""Gradients of blending on the GPU: one thread for each (tile, splat) pair, after Taming 3DGS (arXiv 2406.15643).

A warp takes a bucket of 32 consecutive pairs of a tile, one for each lane. The pixels of the tile pass through the
lanes from the nearest splat to the farthest: in step i, lane l has pixel i - l, and leaves what the next lane needs of
it in shared memory. So every lane sums its own splat's gradient in registers; there is no atomic and no sum across
threads. What a pixel is when it enters a bucket was stored by the forward pass: its transmittances and how much it had
gathered. One gradient row is written per pair, and the rows of each splat are summed afterwards in a fixed order.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numba import cuda

from glassplat.kernels.composite.cuda_pair_rows import MOMENTS
from glassplat.kernels.composite.cuda_tile import BUCKET, GEOMETRY, MEAN_X, MEAN_Y, MEMBERSHIP, PIXELS, tile_steps
from glassplat.kernels.cpu.jit import inlined
from glassplat.kernels.cuda.launch import Kernel, kernel
from glassplat.kernels.devices import SIMULATED
from glassplat.kernels.maths.blending import ALPHA_MAX, Scalar, blend_maths
from glassplat.kernels.splats import TILE

WARPS = 2
"""Buckets of a block; they have nothing to do with each other."""
THREADS, SLOTS = WARPS * BUCKET, WARPS * PIXELS

PULLS = 5
"""Planes of a tile's pulls beyond those of its channels."""


@cache
def composite_pulls(real: type, num_channels: int = 4) -> Kernel:
    """Gathers, tile by tile, what each pixel's gradients pull at [A, D + 5, 256]: one plane per channel, then the
    gradients of the mask and of the deviation, the mean that the latter is measured from, and what the pixel gathered
    in all and of glass, each part times its gradient.
    """
    place = tile_steps(real).place
    shown, spread, middle, total, total_glass = range(num_channels, num_channels + PULLS)

    @kernel(
        f"composite_pulls_{num_channels}",
        real,
        "int int1 real3 real3 real4 real3 real3 real4 real3 real3 real3 real3 real3",
    )
    def gather(
        channel, active, final, center, image, mask, deviation,
        v_image, v_alpha, v_mask, v_deviation, v_spread, pulls,
    ):  # fmt: skip
        n, pixel = cuda.blockIdx.x, cuda.threadIdx.x
        camera, x0, y0, columns, rows = place(active[n], v_image.shape[2], v_image.shape[1])
        column, row = pixel % TILE, pixel // TILE
        if column >= columns or row >= rows:
            return
        y, x = y0 + row, x0 + column
        # alpha = 1 - T: its gradient acts like something behind every splat.
        of_glass = v_mask[camera, y, x] * mask[camera, y, x]
        gathered = of_glass - v_alpha[camera, y, x] * final[n, 0, pixel]
        pulls[n, shown, pixel], pulls[n, total_glass, pixel] = v_mask[camera, y, x], of_glass
        if channel >= 0:
            gathered += v_deviation[camera, y, x] * deviation[camera, y, x]
            pulls[n, spread, pixel], pulls[n, middle, pixel] = v_spread[camera, y, x], center[camera, y, x]
        for d in range(num_channels):
            v = v_image[camera, y, x, d]
            gathered += v * image[camera, y, x, d]
            pulls[n, d, pixel] = v
        pulls[n, total, pixel] = gathered

    return gather


# Indices are unsigned, because Numba lets signed ones count from the end, which costs three instructions each.
at = np.uint64


def _enter(real: type, num_channels: int) -> Scalar:
    shown, spread, _, total, total_glass = _planes(num_channels)
    kept_t, kept_shown = PIXELS * (num_channels + 1), PIXELS * (num_channels + 2)
    zero = real(0.0)

    @inlined
    def enter(
        mine, pulled, had, had_spread, channel, has_glass, pulls, kept, kept_spread,
        ts, glass_ts, behinds, glass_behinds,
    ):  # fmt: skip
        """Puts what a pixel is before a bucket's first pair into shared memory."""
        behind = pulls[at(pulled + total)]
        for d in range(num_channels):
            behind -= pulls[at(pulled + d * PIXELS)] * kept[at(had + PIXELS + d * PIXELS)]
        if channel >= 0 and pulls[at(pulled + spread)] != zero:
            behind -= pulls[at(pulled + spread)] * kept_spread[at(had_spread)]
        if has_glass:
            of_glass = pulls[at(pulled + shown)] * kept[at(had + kept_shown)]
            behind -= of_glass
            glass_ts[mine], glass_behinds[mine] = kept[at(had + kept_t)], pulls[at(pulled + total_glass)] - of_glass
        ts[mine], behinds[mine] = kept[at(had)], behind

    return enter


def _write(num_channels: int, probed: bool) -> Scalar:
    @inlined
    def write(
        out, pair, g_x, g_y, g_xx, g_xy, g_yy, g_0, v_value, channel, v_apart, glass, v_mark, pull_x, pull_y
    ):  # fmt: skip
        """Fills the gradient row of a pair; the mark's gradient takes the place of the first channel's."""
        out[pair, 0], out[pair, 1], out[pair, 2] = g_x, g_y, g_xx
        out[pair, 3], out[pair, 4], out[pair, 5] = g_xy, g_yy, g_0
        for d in range(num_channels):
            out[pair, MOMENTS + d] = v_value[d]
        if channel >= 0:
            out[pair, MOMENTS + channel] += v_apart
        if glass:
            out[pair, MOMENTS] = v_mark
        if probed:
            out[pair, MOMENTS + num_channels], out[pair, MOMENTS + num_channels + 1] = pull_x, pull_y

    return write


def _planes(num_channels: int) -> tuple[int, ...]:
    """Where the planes of a tile's pulls beyond those of its channels begin."""
    return tuple(PIXELS * (num_channels + i) for i in range(PULLS))


@cache
def composite_backward(real: type, num_channels: int = 4, probed: bool = True) -> Kernel:
    """Fills one gradient row per pair that any pixel blended; all rows start at zero."""
    place, load, coverage = tile_steps(real)
    clipped_alpha = blend_maths(real).clipped_alpha
    zero, one, half, alpha_max = real(0.0), real(1.0), real(0.5), real(ALPHA_MAX)
    shown, spread, middle, _, _ = _planes(num_channels)
    enter, write = _enter(real, num_channels), _write(num_channels, probed)

    @kernel(
        f"composite_backward_{num_channels}{'_probed' if probed else ''}",
        real,
        "real2 real2 real1 real2 real2 int int int int int int1 long1 int1 int1 int1 int1 real1 real1 real1 real2",
    )
    def backward(
        means, conics, opacities, channels, marks, splats_per_camera, num_primary, channel, width, height,
        pair_splats, tile_offsets, active, last, looked_at, bucket_tiles, kept, kept_spread, pulls, out,
    ):  # fmt: skip
        ts = cuda.shared.array(SLOTS, real)
        glass_ts = cuda.shared.array(SLOTS, real)
        behinds = cuda.shared.array(SLOTS, real)
        glass_behinds = cuda.shared.array(SLOTS, real)
        geometry = cuda.local.array((GEOMETRY, 1), real)
        membership = cuda.local.array((MEMBERSHIP, 1), np.int32)
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
        camera, x0, y0, _, rows = place(active[n], width, height)
        first_glass, has_glass = camera * splats_per_camera + num_primary, num_primary < splats_per_camera
        planes = num_channels + 3 if has_glass else num_channels + 1
        entry, tile_pulls, tile_last = bucket * planes * PIXELS, n * (num_channels + PULLS) * PIXELS, n * 2 * PIXELS
        for pixel in range(lane, PIXELS, BUCKET):
            # A pixel that had stopped before stored nothing, and no lane will look at it.
            if last[at(tile_last + pixel)] < first and last[at(tile_last + PIXELS + pixel)] < first:
                continue
            enter(
                at(warp * PIXELS + pixel), tile_pulls + pixel, entry + pixel, bucket * PIXELS + pixel,
                channel, has_glass, pulls, kept, kept_spread, ts, glass_ts, behinds, glass_behinds,
            )  # fmt: skip
        order = first + lane
        inside, glass, mark, apart, own_last = order < looked_at[n], False, zero, zero, tile_last
        xx, xy, yy, pull_x, pull_y = zero, zero, zero, zero, zero
        if inside:
            s = pair_splats[start + order]
            load(geometry, membership, 0, s, means, conics, opacities, x0, y0, rows)
            xx, xy, yy, glass = conics[s, 0], conics[s, 1], conics[s, 2], s >= first_glass
            if glass:
                mark, own_last = marks[camera, s - first_glass], tile_last + PIXELS
            else:
                apart = channels[s, max(channel, 0)]
                for d in range(num_channels):
                    value[d] = channels[s, d]
        for d in range(num_channels):
            v_value[d] = zero
        g_x, g_y, g_xx, g_xy, g_yy, g_0, v_mark, v_apart = zero, zero, zero, zero, zero, zero, zero, zero
        for step in range(rows * TILE + BUCKET - 1):
            # The lanes of a warp wait for each other; the simulator knows no warps, but blocks.
            if SIMULATED:
                cuda.syncthreads()
            else:
                cuda.syncwarp()
            pixel = step - lane
            if not inside or pixel < 0 or pixel >= rows * TILE:
                continue
            # None was blended where the tile reaches beyond the image.
            column, row = pixel & (TILE - 1), pixel >> 4
            covered = coverage(geometry, membership, 0, column, row)
            a = clipped_alpha(covered)
            if not a > zero or order > last[at(own_last + pixel)]:
                continue
            mine, pulled = at(warp * PIXELS + pixel), tile_pulls + pixel
            t, inverse = ts[mine], one / (one - a)
            if glass:
                t_glass = glass_ts[mine]
                pull = pulls[at(pulled + shown)] * t * t_glass
                weight = a * pull
                of_glass = glass_behinds[mine] - weight * mark
                gain = (pull * mark - of_glass * inverse) * a
                v_mark += weight
                glass_ts[mine], glass_behinds[mine] = t_glass - a * t_glass, of_glass
                behinds[mine] -= weight * mark
            else:
                weight, dot = a * t, zero
                for d in range(num_channels):
                    pull = pulls[at(pulled + d * PIXELS)]
                    dot += pull * value[d]
                    v_value[d] += weight * pull
                if channel >= 0:
                    difference, pull = apart - pulls[at(pulled + middle)], pulls[at(pulled + spread)]
                    dot += pull * abs(difference)
                    if difference != zero:
                        v_apart += weight * pull if difference > zero else -weight * pull
                behind = behinds[mine] - weight * dot
                gain = (t * dot - behind * inverse) * a
                ts[mine], behinds[mine] = t - weight, behind
            if covered < alpha_max:
                dx = real(np.int32(column)) + half - geometry[MEAN_X, 0]
                dy = real(np.int32(row)) + half - geometry[MEAN_Y, 0]
                g_0 += gain
                g_x += gain * dx
                g_y += gain * dy
                g_xx += gain * dx * dx
                g_xy += gain * dx * dy
                g_yy += gain * dy * dy
                if probed:
                    pull_x += abs(gain * (xx * dx + xy * dy))
                    pull_y += abs(gain * (xy * dx + yy * dy))
        if inside:
            write(
                out, start + order, g_x, g_y, g_xx, g_xy, g_yy, g_0, v_value, channel, v_apart,
                glass, v_mark, pull_x, pull_y,
            )  # fmt: skip

    return backward
