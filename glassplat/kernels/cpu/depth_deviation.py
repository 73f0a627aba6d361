"""Blended distance of splats from a depth map: as `composite` with one channel that differs from pixel to pixel."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from glassplat.kernels.cpu import tile
from glassplat.kernels.cpu.jit import Kernel, inlined, kernel
from glassplat.kernels.cpu.pair_gradients import CHUNK, new_pair_rows, sum_pair_rows
from glassplat.kernels.cpu.schedule import even_stride
from glassplat.kernels.maths_blend import ALPHA_MAX, TRANSMITTANCE_MIN, Scalar, blend_maths
from glassplat.kernels.splats import Splats, TileBins

DEPTH, SUM = 5 * tile.PLANE, 6 * tile.PLANE
FORWARD_PLANES = 7

# In the backward pass, LANES holds rows of 16 column sums: g, g dy and g dy^2 as `geometry_gradient` takes them, then
# the gradient of the splat's depth.
BEHIND, V_SUM, V_DEPTH, LANES = 6 * tile.PLANE, 7 * tile.PLANE, 8 * tile.PLANE, 9 * tile.PLANE
LANE_DEPTH = LANES + 48
BACKWARD_PLANES = 10


class SavedTiles(NamedTuple):
    """What the backward pass needs from the forward pass: packed splats and each active tile's final state."""

    packed: NDArray[Any]
    state: NDArray[Any]


def depth_deviation(
    splats: Splats, depth_map: Tensor, bins: TileBins, *, num_primary: int
) -> tuple[Tensor, SavedTiles]:
    """Deviation [C, H, W], and what `depth_deviation_gradients` starts from."""
    real = tile.real_of(splats)
    count = splats.opacities.numel()
    saved = SavedTiles(
        np.empty((count, tile.packed_width(1)), real),
        np.empty((len(bins.active), tile.STATE_PLANES, tile.PIXELS), real),
    )
    deviation = torch.zeros_like(depth_map)
    _forward(real)(
        splats.means2d.numpy().reshape(-1, 2), splats.conics.numpy().reshape(-1, 3),
        splats.opacities.numpy().reshape(-1), splats.depths.numpy().reshape(-1), depth_map.numpy(),
        splats.opacities.shape[1], num_primary, bins.pair_splats.numpy(), bins.tile_offsets.numpy(),
        bins.splat_offsets.numpy(), bins.active.numpy(), saved.packed, saved.state, deviation.numpy(),
    )  # fmt: skip
    return deviation, saved


def depth_deviation_gradients(
    splats: Splats, depth_map: Tensor, bins: TileBins, saved: SavedTiles, v_deviation: Tensor, *, num_primary: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gradients of means2d, conics, opacities, depths and the depth map."""
    real = tile.real_of(splats)
    rows = new_pair_rows(bins, 1, real)
    v_depth_map = torch.zeros_like(depth_map)
    _backward(real)(
        depth_map.numpy(), splats.opacities.shape[1], num_primary,
        bins.pair_splats.numpy(), bins.tile_offsets.numpy(), bins.active.numpy(), saved.packed, saved.state,
        v_deviation.contiguous().numpy(), rows, v_depth_map.numpy(),
    )  # fmt: skip
    v_means, v_conics, v_opacities, v_depths = sum_pair_rows(rows, bins, splats)
    return v_means, v_conics, v_opacities, v_depths[..., 0], v_depth_map


def _blend(real: type) -> Scalar:
    clipped_alpha = blend_maths(real).clipped_alpha
    zero, t_min = real(0.0), real(TRANSMITTANCE_MIN)
    T, LAST, COVERAGE, VALUES = tile.T, tile.LAST, tile.COVERAGE, tile.VALUES

    @inlined
    def blend(scratch, splat, order, first, last):
        depth = splat[VALUES]
        for row in range(first, last):
            base = (row & 15) * 16
            for i in range(16):
                a = clipped_alpha(scratch[COVERAGE + base + i])
                t = scratch[T + base + i]
                weight = a * t
                after = t - weight
                alive = after >= t_min
                scratch[T + base + i] = after if alive else -abs(t)
                scratch[LAST + base + i] = order if alive else scratch[LAST + base + i]
                weight = weight if alive else zero
                scratch[SUM + base + i] += weight * abs(depth - scratch[DEPTH + base + i])

    return blend


@functools.cache
def _forward(real: type) -> Kernel:
    pack, place, begin, is_finished, save_state, _, fetch, cover, _ = tile.tile_functions(real)
    blend = _blend(real)
    zero = real(0.0)
    PLANE, VALUES, BATCH = tile.PLANE, tile.VALUES, tile.BATCH

    @kernel("depth_deviation_forward", real)
    def forward(
        means, conics, opacities, depths, depth_map, splats_per_camera, num_primary,
        pair_splats, tile_offsets, splat_offsets, active, packed, state, deviation,
    ):  # fmt: skip
        num_chunks = (opacities.size + CHUNK - 1) // CHUNK
        pack_stride = even_stride(num_chunks)
        for task in prange(num_chunks):
            chunk = task * pack_stride % num_chunks
            for s in range(chunk * CHUNK, min(opacities.size, (chunk + 1) * CHUNK)):
                if splat_offsets[s + 1] > splat_offsets[s]:
                    pack(packed, s, means, conics, opacities)
                    packed[s, VALUES] = depths[s]
        stride = even_stride(active.size)
        for task in prange(active.size):
            n = task * stride % active.size
            camera, x0, y0, columns, rows = place(active[n], depth_map.shape[2], depth_map.shape[1])
            scratch: NDArray[Any] = np.empty(FORWARD_PLANES * PLANE, real)
            scratch[:] = zero
            begin(scratch, columns, rows)
            for y in range(rows):
                for x in range(columns):
                    scratch[DEPTH + (y & 15) * 16 + (x & 15)] = depth_map[camera, y0 + y, x0 + x]
            batch: NDArray[Any] = np.empty((BATCH, packed.shape[1]), real)
            start, stop = tile_offsets[active[n]], tile_offsets[active[n] + 1]
            for first in range(start, stop, BATCH):
                if is_finished(scratch):
                    break
                last = min(first + BATCH, stop)
                fetch(batch, packed, pair_splats, first, last)
                for p in range(first, last):
                    if pair_splats[p] - camera * splats_per_camera < num_primary:
                        top, bottom = cover(scratch, batch[p - first], x0, y0, rows)
                        blend(scratch, batch[p - first], real(np.int32(p - start)), top, bottom)
            save_state(state, n, scratch)
            for y in range(rows):
                for x in range(columns):
                    deviation[camera, y0 + y, x0 + x] = scratch[SUM + (y & 15) * 16 + (x & 15)]

    return forward


def _unblend(real: type) -> Scalar:
    clipped_alpha = blend_maths(real).clipped_alpha
    zero, half, one, alpha_max = real(0.0), real(0.5), real(1.0), real(ALPHA_MAX)
    T, LAST, COVERAGE, VALUES, MEAN_Y = tile.T, tile.LAST, tile.COVERAGE, tile.VALUES, tile.MEAN_Y

    @inlined
    def unblend(scratch, splat, order, y0, first, last):
        """Takes a splat off the pixels of its rows and adds up its lane sums."""
        depth, mean_y = splat[VALUES], splat[MEAN_Y] - real(y0)
        for row in range(first, last):
            base = (row & 15) * 16
            dy = real(row) + half - mean_y
            for i in range(16):
                coverage = scratch[COVERAGE + base + i]
                a = clipped_alpha(coverage) if order <= scratch[LAST + base + i] else zero
                inverse = one / (one - a)
                t = scratch[T + base + i] * inverse
                weight = a * t
                difference = depth - scratch[DEPTH + base + i]
                v_sum = scratch[V_SUM + base + i]
                dot = v_sum * abs(difference)
                behind = scratch[BEHIND + base + i]
                v_alpha = t * dot - behind * inverse
                scratch[BEHIND + base + i] = behind + weight * dot
                scratch[T + base + i] = t
                gain = v_alpha * a if coverage < alpha_max else zero
                scratch[LANES + i] += gain
                scratch[LANES + 16 + i] += gain * dy
                scratch[LANES + 32 + i] += gain * dy * dy
                v_difference = weight * v_sum
                v_difference = v_difference if difference > zero else -v_difference
                v_difference = v_difference if difference != zero else zero
                scratch[LANE_DEPTH + i] += v_difference
                scratch[V_DEPTH + base + i] -= v_difference

    return unblend


@functools.cache
def _backward(real: type) -> Kernel:
    _, place, _, _, _, load_state, fetch, cover, geometry_gradient = tile.tile_functions(real)
    unblend = _unblend(real)
    zero = real(0.0)
    PLANE, V_VALUES, BATCH = tile.PLANE, tile.V_VALUES, tile.BATCH

    @kernel("depth_deviation_backward", real)
    def backward(
        depth_map, splats_per_camera, num_primary,
        pair_splats, tile_offsets, active, packed, state, v_deviation, out, v_depth_map,
    ):  # fmt: skip
        stride = even_stride(active.size)
        for task in prange(active.size):
            n = task * stride % active.size
            camera, x0, y0, columns, rows = place(active[n], depth_map.shape[2], depth_map.shape[1])
            scratch: NDArray[Any] = np.empty(BACKWARD_PLANES * PLANE, real)
            scratch[:] = zero
            looked_at = load_state(state, n, scratch)
            for y in range(rows):
                for x in range(columns):
                    i = (y & 15) * 16 + (x & 15)
                    scratch[DEPTH + i] = depth_map[camera, y0 + y, x0 + x]
                    scratch[V_SUM + i] = v_deviation[camera, y0 + y, x0 + x]
            start, stop = tile_offsets[active[n]], tile_offsets[active[n] + 1]
            out[start + looked_at : stop] = zero
            batch: NDArray[Any] = np.empty((BATCH, packed.shape[1]), real)
            for behind in range(0, looked_at, BATCH):
                last = start + looked_at - behind
                first = max(last - BATCH, start)
                fetch(batch, packed, pair_splats, first, last)
                for k in range(last - first):
                    p = last - 1 - k
                    order, splat = real(np.int32(p - start)), batch[p - first]
                    top, bottom = cover(scratch, splat, x0, y0, rows)
                    glass = pair_splats[p] - camera * splats_per_camera >= num_primary
                    if glass or top >= bottom:
                        out[p, :] = zero
                        continue
                    for i in range(64):
                        scratch[LANES + i] = zero
                    unblend(scratch, splat, order, y0, top, bottom)
                    geometry_gradient(out, p, scratch, LANES, splat, x0)
                    total = zero
                    for i in range(16):
                        total += scratch[LANE_DEPTH + i]
                    out[p, V_VALUES] = total
            for y in range(rows):
                for x in range(columns):
                    v_depth_map[camera, y0 + y, x0 + x] = scratch[V_DEPTH + (y & 15) * 16 + (x & 15)]

    return backward
