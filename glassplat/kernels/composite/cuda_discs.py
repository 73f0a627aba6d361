"""Blending of sorted discs on the GPU.

The forward pass uses one block per active tile, one thread per pixel. The backward pass uses one thread per (tile,
disc) pair: a warp processes a bucket of 32 consecutive pairs of a tile, one per lane, and the pixels of the tile pass
through the lanes (`cuda_backward`). So every lane sums its own disc's gradient in registers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from numba import cuda
from torch import Tensor

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.backend.cuda import Kernel, blocks_for, kernel
from glassplat.kernels.backend.devices import SIMULATED
from glassplat.kernels.composite.cpu_tile import joined_cameras, tile_bounds
from glassplat.kernels.composite.cuda_tile import BUCKET, PIXELS, SUM_THREADS, at
from glassplat.kernels.maths.blending import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN, Scalar, build_reached_rows
from glassplat.kernels.maths.disc import MAP, MOST_DEVIATIONS, offset_gradient
from glassplat.kernels.maths.fast_maths import exp2_maths, fused_maths, reciprocal_maths
from glassplat.kernels.records import REAL_OF, TILE, Discs, TileBins

CENTER_X, CENTER_Y, U_X, U_Y, V_X, V_Y, W_X, W_Y, OPACITY, Z, INVERSE_Z, COLUMNS = range(12)
"""Columns of a disc's geometry; the centre is relative to that of the tile's first pixel."""

# Planes of the final state of a tile's pixels, and, with `LAST` and `MEDIAN`, of the pairs that determined it.
T, FIRST, TOTAL, SQUARES, FINALS = range(5)
LAST, MEDIAN, ORDERS = range(3)

# Planes of a pixel's partial sums before a bucket, followed by those of its channels.
KEPT_T, KEPT_DEPTH, KEPT_TOTAL, KEPT_SQUARES, KEPT_VALUES = range(5)


def _load(real: type) -> Scalar:
    reached_rows, half, alpha_min = build_reached_rows(real), real(0.5), real(ALPHA_MIN)
    zero, one, endless = real(0.0), real(1.0), real(np.inf)

    @inlined
    def load(geometry, i, s, means, maps, opacities, depths, centers, conics, x0, y0, num_rows):
        """Copies a disc's geometry to row `i` of an array; returns the rows that its outline reaches, as bits."""
        opacity, depth, total = opacities[s], depths[s], means[s, 0] + means[s, 1] + depths[s]
        geometry[i, CENTER_X], geometry[i, CENTER_Y] = means[s, 0] - real(x0) - half, means[s, 1] - real(y0) - half
        for j in range(6):
            geometry[i, U_X + j] = maps[s, j]
            total += maps[s, j]
        geometry[i, OPACITY], geometry[i, Z], geometry[i, INVERSE_Z] = opacity, depth, one / depth
        # Written so that NaN anywhere ends in "reaches nothing".
        if not (abs(total) < endless and alpha_min <= opacity < endless and zero < depth):
            return np.int32(0)
        if conics[s, 0] == zero and conics[s, 1] == zero and conics[s, 2] == zero:
            # The disc crosses the near plane and may reach any row.
            return np.int32((1 << num_rows) - 1)
        center_y = centers[s, 1] - real(y0)
        return reached_rows(center_y, conics[s, 0], conics[s, 1], conics[s, 2], opacity, num_rows)

    return load


def _cover(real: type) -> Scalar:
    exp2, fused, reciprocal = exp2_maths(real), fused_maths(), reciprocal_maths(real)
    zero, one, farthest, far = real(0.0), real(1.0), real(MOST_DEVIATIONS**2), real(4 * MOST_DEVIATIONS**2)
    half_bits, alpha_min = real(-0.5 / math.log(2.0)), real(ALPHA_MIN)

    @inlined
    def cover(geometry, i, x, y, near, sharpness):
        """As in `cpu_discs`, for the disc in row `i` and the pixel in column x and row y of the tile."""
        dx, dy = x - geometry[i, CENTER_X], y - geometry[i, CENTER_Y]
        # Explicit fused operations, because the compiler would fuse differently in each kernel: a disc at exactly 1/255
        # could be in the image and not in its gradient.
        e = fused(dx, geometry[i, W_X], fused(dy, geometry[i, W_Y], one))
        inverse, solid = one, far
        u, v = zero, zero
        if e > zero and geometry[i, Z] > near * e:
            inverse = reciprocal(e)
            u = fused(dx, geometry[i, U_X], dy * geometry[i, U_Y]) * inverse
            v = fused(dx, geometry[i, V_X], dy * geometry[i, V_Y]) * inverse
            solid = fused(u, u, v * v)
            solid = solid if solid <= farthest else far
        around = fused(dx, dx, dy * dy) * sharpness
        on_disc = solid <= farthest and not around < solid
        q = solid if on_disc else around
        covered = geometry[i, OPACITY] * exp2(q * half_bits) if q <= farthest else zero
        covered = covered if covered >= alpha_min else zero
        if not on_disc:
            u, v, inverse, e = zero, zero, one, one
        return (dx, dy), (u, v, inverse), e, covered, on_disc

    return cover


WARPS = 2
"""Buckets per block, which are independent of each other."""
THREADS, SLOTS = WARPS * BUCKET, WARPS * PIXELS

BEHIND, BLENDED, MIDDLE, STATES = at(SLOTS), at(2 * SLOTS), at(3 * SLOTS), 4 * SLOTS
"""Offsets in shared memory after the transmittances: gradient-weighted sums behind the current disc, the last lane
whose disc each pixel blended, the lane of its median disc; and the end."""

# Planes of a tile's pixel gradients beyond those of its channels.
V_DEPTH, V_MEDIAN, V_DISTORTION, GATHERED, SAVED_FIRST, SAVED_COVERED, SAVED_TOTAL, SAVED_SQUARES, EXTRAS = range(9)

# Columns of a pair's row, as on the CPU, followed by those of channels.
UP, VP, E, AROUND, G, G_Z, ABSGRAD, MOMENTS = 0, 3, 6, 9, 11, 12, 13, 15


@cache
def composite_discs_cotangents(real: type, num_channels: int = 6) -> Kernel:
    """Gathers, tile by tile, the gradients of each pixel [A, D + 8, 256]: one plane per channel, then those named by
    the constants. GATHERED is the gradient-weighted sum of all outputs of the pixel.
    """
    zero, one, two = real(0.0), real(1.0), real(2.0)

    @kernel(
        f"composite_discs_cotangents_{num_channels}", real, "int1 real3 real4 real3 real4 real3 real3 real3 real3 real3"
    )
    def gather(active, finals, image, depth, v_image, v_alpha, v_depth, v_median, v_distortion, v_pixels):
        n, pixel = cuda.blockIdx.x, cuda.threadIdx.x
        camera, x0, y0, columns, rows = tile_bounds(active[n], v_image.shape[2], v_image.shape[1])
        column, row = pixel % TILE, pixel // TILE
        if column >= columns or row >= rows:
            return
        y, x = y0 + row, x0 + column
        t, total, squares = finals[n, T, pixel], finals[n, TOTAL, pixel], finals[n, SQUARES, pixel]
        covered, v_spread = one - t, v_distortion[camera, y, x]
        # alpha = 1 - T: its gradient acts like that of a background.
        gathered = v_depth[camera, y, x] * depth[camera, y, x] - v_alpha[camera, y, x] * t
        if v_spread != zero:
            gathered += v_spread * two * (covered * squares - total * total)
        for d in range(num_channels):
            v = v_image[camera, y, x, d]
            gathered += v * image[camera, y, x, d]
            v_pixels[n, d, pixel] = v
        v_pixels[n, num_channels + V_DEPTH, pixel] = v_depth[camera, y, x]
        v_pixels[n, num_channels + V_MEDIAN, pixel] = v_median[camera, y, x]
        v_pixels[n, num_channels + V_DISTORTION, pixel] = v_spread
        v_pixels[n, num_channels + GATHERED, pixel] = gathered
        v_pixels[n, num_channels + SAVED_FIRST, pixel] = finals[n, FIRST, pixel]
        v_pixels[n, num_channels + SAVED_COVERED, pixel] = covered
        v_pixels[n, num_channels + SAVED_TOTAL, pixel] = total
        v_pixels[n, num_channels + SAVED_SQUARES, pixel] = squares

    return gather


def _enter(real: type, num_channels: int) -> Scalar:
    """Builds the step that writes a pixel's state before a bucket's first pair to shared memory."""
    one, two, behinds = real(1.0), real(2.0), BEHIND
    of_depth, of_spread, gathered = (PIXELS * (num_channels + plane) for plane in (V_DEPTH, V_DISTORTION, GATHERED))
    of_covered, of_total, of_squares = (
        PIXELS * (num_channels + plane) for plane in (SAVED_COVERED, SAVED_TOTAL, SAVED_SQUARES)
    )

    @inlined
    def enter(mine, v_at, had, v_pixels, kept, state):
        t = kept[at(had + KEPT_T * PIXELS)]
        behind = v_pixels[at(v_at + gathered)]
        behind -= v_pixels[at(v_at + of_depth)] * kept[at(had + KEPT_DEPTH * PIXELS)]
        spread = v_pixels[at(v_at + of_covered)] * kept[at(had + KEPT_SQUARES * PIXELS)]
        spread -= two * v_pixels[at(v_at + of_total)] * kept[at(had + KEPT_TOTAL * PIXELS)]
        spread += v_pixels[at(v_at + of_squares)] * (one - t)
        behind -= v_pixels[at(v_at + of_spread)] * spread
        for d in range(num_channels):
            behind -= v_pixels[at(v_at + d * PIXELS)] * kept[at(had + (KEPT_VALUES + d) * PIXELS)]
        state[mine], state[mine + behinds] = t, behind

    return enter


@cache
def composite_discs_backward(real: type, num_channels: int = 6) -> Kernel:
    """Fills one gradient row per pair that any pixel blended; all rows start at zero."""
    load, cover = _load(real), _cover(real)
    reciprocal, enter = reciprocal_maths(real), _enter(real, num_channels)
    zero, one, two, alpha_max, endless = real(0.0), real(1.0), real(2.0), real(ALPHA_MAX), real(np.inf)
    behinds, lasts, middles = BEHIND, BLENDED, MIDDLE
    of_depth, of_median, of_spread, _, of_first, of_covered, of_total, of_squares = (
        at(PIXELS * (num_channels + plane)) for plane in range(EXTRAS)
    )

    @kernel(
        f"composite_discs_backward_{num_channels}",
        real,
        "real2 real2 real1 real1 real2 real2 real2 real real int int int1 long1 int1 int1 int1 int1 real1 real1 real2",
    )
    def backward(
        means, maps, opacities, depths, centers, conics, channels, near, sharpness, width, height,
        pair_splats, tile_offsets, active, orders, looked_at, bucket_tiles, kept, v_pixels, out,
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
        _, x0, y0, _, rows = tile_bounds(active[n], width, height)
        entry, tile_pixels = bucket * (KEPT_VALUES + num_channels) * PIXELS, n * (num_channels + EXTRAS) * PIXELS
        tile_orders = n * ORDERS * PIXELS
        for pixel in range(lane, PIXELS, BUCKET):
            mine = at(warp * PIXELS + pixel)
            own_last = orders[at(tile_orders + LAST * PIXELS + pixel)] - first
            state[mine + lasts] = real(own_last)
            state[mine + middles] = real(orders[at(tile_orders + MEDIAN * PIXELS + pixel)] - first)
            # A pixel that stopped earlier has stored nothing, and no lane evaluates it.
            if own_last >= 0:
                enter(mine, tile_pixels + pixel, entry + pixel, v_pixels, kept, state)
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
        depth, inverse_depth, around = geometry[0, Z], geometry[0, INVERSE_Z], zero
        if sharpness < endless:
            around = -sharpness
        up_x, up_y, up_1, vp_x, vp_y, vp_1, e_x, e_y, e_1 = zero, zero, zero, zero, zero, zero, zero, zero, zero
        around_x, around_y, g, g_depth, absgrad_x, absgrad_y = zero, zero, zero, zero, zero, zero
        own_pixels, step = at(tile) * at((num_channels + EXTRAS) * PIXELS), np.int32(0)
        while step < PIXELS + BUCKET - 1:
            # Synchronises the lanes of a warp; the simulator supports only blocks.
            if SIMULATED:
                cuda.syncthreads()
            else:
                cuda.syncwarp()
            p = np.int32(step - lane)
            step = np.int32(step + 1)
            # A padding lane reaches no row, and pixels of the tile outside the image have blended no disc.
            if 0 <= p < PIXELS and np.int32(reached & np.int32(1 << (p >> 4))) != 0:
                x, y, mine = real(np.int32(p & (TILE - 1))), real(np.int32(p >> 4)), at(warp * PIXELS + p)
                (dx, dy), (u, v, inverse), e, covered, on_disc = cover(geometry, 0, x, y, near, sharpness)
                if covered > zero and own <= state[mine + lasts]:
                    v_at, t, a = own_pixels + at(np.uint32(p)), state[mine], min(covered, alpha_max)
                    weight, worth = a * t, zero
                    for d in range(num_channels):
                        v_pixel = v_pixels[v_at + at(d * PIXELS)]
                        worth += v_pixel * value[d]
                        v_value[d] += weight * v_pixel
                    z, apart = inverse * depth, e * inverse_depth - v_pixels[v_at + of_first]
                    lean = apart * v_pixels[v_at + of_covered] - two * v_pixels[v_at + of_total]
                    v_spread = v_pixels[v_at + of_spread]
                    worth += v_pixels[v_at + of_depth] * z + v_spread * (lean * apart + v_pixels[v_at + of_squares])
                    v_z = weight * v_pixels[v_at + of_depth]
                    if own == state[mine + middles]:
                        v_z += v_pixels[v_at + of_median]
                    # The derivative is twice `apart` times the coverage minus the total, which `lean` subtracts twice.
                    v_inverse = weight * v_spread * two * (lean + v_pixels[v_at + of_total])
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
                        slope_x, slope_y = offset_gradient(found, v_up, v_vp, v_e)
                        absgrad_x, absgrad_y = absgrad_x + abs(slope_x), absgrad_y + abs(slope_y)
                    else:
                        moved_x, moved_y = gain * around * dx, gain * around * dy
                        around_x, around_y = around_x + moved_x, around_y + moved_y
                        absgrad_x, absgrad_y = absgrad_x + abs(moved_x), absgrad_y + abs(moved_y)
        if inside:
            row = start + order
            out[row, UP], out[row, UP + 1], out[row, UP + 2] = up_x, up_y, up_1
            out[row, VP], out[row, VP + 1], out[row, VP + 2] = vp_x, vp_y, vp_1
            out[row, E], out[row, E + 1], out[row, E + 2] = e_x, e_y, e_1
            out[row, AROUND], out[row, AROUND + 1], out[row, G], out[row, G_Z] = around_x, around_y, g, g_depth
            out[row, ABSGRAD], out[row, ABSGRAD + 1] = absgrad_x, absgrad_y
            for d in range(num_channels):
                out[row, MOMENTS + d] = v_value[d]

    return backward


class Saved(NamedTuple):
    """Results of the forward pass for the backward pass.

    finals [A, 4, 256], orders [A, 2, 256] int32: the planes named above, for each pixel of the active tiles; orders are
    relative to the tile's first pair, -1 for none. looked_at [A] int32: number of pairs of each tile up to the last one
    that any pixel blended. bucket_tiles [B] int32: the active tile that each bucket belongs to, -1 for none. kept
    [B, D + 4, 256]: each pixel's partial sums before a bucket. outputs: image and depth.
    """

    finals: Tensor
    orders: Tensor
    looked_at: Tensor
    bucket_tiles: Tensor
    kept: Tensor
    outputs: tuple[Tensor, Tensor]


def composite_discs(
    discs: Discs, channels: Tensor, bins: TileBins, *, near: float, low_pass: float, needs_gradients: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Saved]:
    """As `glassplat.kernels.composite.cpu_discs.composite_discs`."""
    num_channels, tiles, device = channels.shape[2], len(bins.active), channels.device
    shape = (bins.num_cameras, bins.height, bins.width)
    image, *flat = (channels.new_zeros(s) for s in ((*shape, num_channels), shape, shape, shape, shape))
    buckets = len(bins.pair_splats) // BUCKET + tiles if needs_gradients else 0
    alpha, depth, median, distortion = flat
    saved = Saved(
        channels.new_empty(tiles, FINALS, PIXELS),
        torch.empty(tiles, ORDERS, PIXELS, dtype=torch.int32, device=device),
        torch.empty(tiles, dtype=torch.int32, device=device),
        torch.full((buckets,), -1, dtype=torch.int32, device=device),
        channels.new_empty(buckets, KEPT_VALUES + num_channels, PIXELS),
        # Detached, because the autograd graph holds this record: a reference cycle would keep both alive.
        (image.detach(), depth.detach()),
    )
    composite_discs_forward(REAL_OF[channels.dtype], num_channels)(
        tiles, PIXELS, *joined_cameras((*discs[:4], *discs.outlines[:2])), channels.view(-1),
        near, _sharpness(low_pass), bins.pair_splats, bins.tile_offsets, bins.active, *saved[:5], image, *flat,
    )  # fmt: skip
    return image, alpha, depth, median, distortion, saved


def composite_discs_gradients(
    discs: Discs, channels: Tensor, bins: TileBins, saved: Saved, v_outputs: Sequence[Tensor],
    *, near: float, low_pass: float, with_absgrad: bool,
) -> tuple[Tensor | None, ...]:  # fmt: skip
    """As `glassplat.kernels.composite.cpu_discs.composite_discs_gradients`."""
    real, (cameras, count, num_channels) = REAL_OF[channels.dtype], channels.shape
    tiles, size = len(bins.active), cameras * count
    v_pixels = channels.new_empty(tiles, num_channels + EXTRAS, PIXELS)
    composite_discs_cotangents(real, num_channels)(
        tiles, PIXELS, bins.active, saved.finals, *saved.outputs, *v_outputs, v_pixels
    )  # fmt: skip
    rows = channels.new_zeros(len(bins.pair_splats), MOMENTS + num_channels)
    composite_discs_backward(real, num_channels)(
        blocks_for(len(saved.bucket_tiles), WARPS), THREADS,
        *joined_cameras((*discs[:4], *discs.outlines[:2], channels)),
        near, _sharpness(low_pass), bins.width, bins.height, bins.pair_splats, bins.tile_offsets, bins.active,
        saved.orders.view(-1), saved.looked_at, saved.bucket_tiles, saved.kept.view(-1), v_pixels.view(-1), rows,
    )  # fmt: skip
    sums = channels.new_empty(size, MOMENTS + num_channels)
    given = (rows, bins.pair_slots, bins.splat_offsets)
    sum_disc_rows(real).over(sums.numel(), *given, sums, threads=SUM_THREADS)
    return _from_sums(sums, discs, with_absgrad)


def _from_sums(sums: Tensor, discs: Discs, with_absgrad: bool) -> tuple[Tensor | None, ...]:
    """Gradients of each disc from the sums over its pixels; invisible discs get zeros, even if not finite."""
    leading, size = discs.opacities.shape, sums.shape[0]
    by_row = sums[:, :AROUND].unflatten(1, (3, 3))
    v_maps, alone = by_row[:, :, :2], by_row[:, :, 2:]
    through_map = torch.where(alone != 0, alone * discs.maps.view(-1, 3, 2), 0).sum(1)
    v_means = -through_map - sums[:, AROUND:G]
    gained, opacities = sums[:, G], discs.opacities.view(-1)
    v_opacities = torch.where(gained != 0, gained / opacities, 0)
    found = (v_means, v_maps.reshape(size, MAP), v_opacities, sums[:, G_Z], sums[:, MOMENTS:])
    shaped = [tensor.reshape(*leading, *tensor.shape[1:]) for tensor in found]
    return (*shaped, sums[:, ABSGRAD:MOMENTS].reshape(*leading, 2) if with_absgrad else None)


def _sharpness(low_pass: float) -> float:
    """One over the variance of the low-pass."""
    return 1 / low_pass**2 if low_pass else float("inf")


@cache
def composite_discs_forward(real: type, num_channels: int = 6) -> Kernel:
    """Fills the images of the active tiles, and the state for the backward pass."""
    load, cover = _load(real), _cover(real)
    zero, half, one, two = real(0.0), real(0.5), real(1.0), real(2.0)
    t_min, alpha_max, stopped = real(TRANSMITTANCE_MIN), real(ALPHA_MAX), np.int32(PIXELS)

    @kernel(
        f"composite_discs_forward_{num_channels}",
        real,
        "real2 real2 real1 real1 real2 real2 real1 real real int1 long1 int1 "
        "real3 int3 int1 int1 real3 real4 real3 real3 real3 real3",
    )
    def forward(
        means, maps, opacities, depths, centers, conics, channels, near, sharpness, pair_splats, tile_offsets, active,
        finals, orders, looked_at, bucket_tiles, kept, image, alpha, depth, median, distortion,
    ):  # fmt: skip
        geometry = cuda.shared.array((PIXELS, COLUMNS), real)
        reached = cuda.shared.array(PIXELS, np.int32)
        members = cuda.shared.array(PIXELS, np.int32)
        most = cuda.shared.array(1, np.int32)
        sums = cuda.local.array(num_channels, real)
        n, pixel = cuda.blockIdx.x, cuda.threadIdx.x
        camera, x0, y0, columns, num_rows = tile_bounds(active[n], image.shape[2], image.shape[1])
        column, row = pixel % TILE, pixel // TILE
        x, y, bit = real(np.int32(column)), real(np.int32(row)), np.int32(1 << row)
        inside = column < columns and row < num_rows
        running, last_order, middle_order = np.int32(inside), np.int32(-1), np.int32(-1)
        t, spread, far, middle, first_seen, total, squares = one, zero, zero, zero, zero, zero, zero
        for d in range(num_channels):
            sums[d] = zero
        if pixel == 0:
            most[0] = 0
        start, stop = tile_offsets[active[n]], tile_offsets[active[n] + 1]
        first_bucket, keeps = start // BUCKET + n, bucket_tiles.size > 0
        for first in range(0, stop - start, PIXELS):
            if not cuda.syncthreads_or(running):
                break
            if start + first + pixel < stop:
                if keeps and pixel % BUCKET == 0:
                    bucket_tiles[first_bucket + (first + pixel) // BUCKET] = n
                s = pair_splats[start + first + pixel]
                reached[pixel] = load(
                    geometry, pixel, s, means, maps, opacities, depths, centers, conics, x0, y0, num_rows
                )
                members[pixel] = s
            cuda.syncthreads()
            here, group = np.int32(min(PIXELS, stop - start - first)), np.int32(0)
            while running != 0 and group < here:
                if keeps:
                    bucket = first_bucket + (first + group) // BUCKET
                    kept[bucket, KEPT_T, pixel], kept[bucket, KEPT_DEPTH, pixel] = t, far
                    kept[bucket, KEPT_TOTAL, pixel], kept[bucket, KEPT_SQUARES, pixel] = total, squares
                    for d in range(num_channels):
                        kept[bucket, KEPT_VALUES + d, pixel] = sums[d]
                i = group
                group = np.int32(min(group + BUCKET, here))
                while i < group:
                    k = np.uint32(i)
                    if np.int32(reached[k] & bit) != 0:
                        _, hit, e, covered, _ = cover(geometry, k, x, y, near, sharpness)
                        weight = min(covered, alpha_max) * t
                        left = t - weight
                        if covered > zero and left >= t_min:
                            inverse = e * geometry[k, INVERSE_Z]
                            if last_order < 0:
                                first_seen = inverse
                            apart = inverse - first_seen
                            spread += weight * ((apart * (one - t) - two * total) * apart + squares)
                            total += weight * apart
                            squares += weight * apart * apart
                            z = hit[2] * geometry[k, Z]
                            far += weight * z
                            last_order = np.int32(first + i)
                            if t > half:
                                middle, middle_order = z, last_order
                            t = left
                            for d in range(num_channels):
                                sums[d] += weight * channels[at(members[k] * num_channels + d)]
                        elif covered > zero:
                            i = stopped
                    i = np.int32(i + 1)
                if i > stopped:
                    running = np.int32(0)
        cuda.syncthreads()
        cuda.atomic.max(most, 0, np.int32(last_order + 1))
        cuda.syncthreads()
        if pixel == 0:
            looked_at[n] = most[0]
        finals[n, T, pixel], finals[n, FIRST, pixel] = t, first_seen
        finals[n, TOTAL, pixel], finals[n, SQUARES, pixel] = total, squares
        orders[n, LAST, pixel], orders[n, MEDIAN, pixel] = last_order, middle_order
        if inside:
            alpha[camera, y0 + row, x0 + column], depth[camera, y0 + row, x0 + column] = one - t, far
            median[camera, y0 + row, x0 + column] = middle
            distortion[camera, y0 + row, x0 + column] = spread
            for d in range(num_channels):
                image[camera, y0 + row, x0 + column, d] = sums[d]

    return forward


@cache
def sum_disc_rows(real: type) -> Kernel:
    """Sums the rows of each disc's pairs in a fixed order, one thread per column and disc."""
    zero = real(0.0)

    @kernel("sum_disc_rows", real, "real2 int1 long1 real2")
    def sum_up(rows, slots, offsets, sums):
        i, width = cuda.grid(1), rows.shape[1]
        s, column = i // width, i % width
        if s >= sums.shape[0]:
            return
        total = zero
        for k in range(offsets[s], offsets[s + 1]):
            total += rows[slots[k], column]
        sums[s, column] = total

    return sum_up
