"""Panes on the GPU: which one a pixel shows, and their blending."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import torch
from numba import cuda
from torch import Tensor

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.backend.cuda import Kernel, blocks_for, kernel
from glassplat.kernels.maths.blending import Scalar
from glassplat.kernels.maths.images import color_space_maths
from glassplat.kernels.maths.pane import mixing, pane_maths
from glassplat.kernels.records import DAZZLING, REAL_OF, TILE, PaneHits

PIXELS = TILE * TILE


def pane_hits(
    inputs: Sequence[Tensor], width: int, height: int, mask: Tensor | None, beyond: PaneHits | None
) -> PaneHits:
    """As `glassplat.kernels.panes.cpu.pane_hits`."""
    centers = inputs[0]
    count, real = centers.shape[0], REAL_OF[centers.dtype]
    rows, columns = -(-height // TILE), -(-width // TILE)
    index = torch.empty(height, width, dtype=torch.int32, device=centers.device)
    depth = centers.new_empty(height, width)
    tiles = torch.zeros(count, rows, columns, dtype=torch.bool, device=centers.device)
    reaches = torch.zeros(count, 4, dtype=torch.int32, device=centers.device)
    before = (None, None) if beyond is None else (beyond.pane, beyond.depth)
    pane_hits_forward(real)(rows * columns, PIXELS, *inputs, mask, *before, index, depth, tiles, reaches)
    windows = centers.new_empty(count, 4)
    windows_of(real)(blocks_for(count, THREADS), THREADS, reaches, width, height, windows)
    return PaneHits(index, depth, tiles, windows)


@cache
def pane_hits_forward(real: type) -> Kernel:
    """Fills the index and the depth, and marks the tiles in which a pane is shown and how far that reaches.

    A pane reaches so many pixels from the image's right, lower, left and upper border; 0 where it is not shown.
    """
    half, one, zero, far = real(0.5), real(1.0), real(0.0), real(np.inf)

    @kernel("pane_hits", real, "real2 real2 real3 real2 real1 real2 int2 real2 int2 real2 bool3 int2")
    def forward(
        centers, normals, axes, half_sizes, intrinsics, mask, before, depth_before, index, depth_of, tiles, reaches,
    ):  # fmt: skip
        height, width = index.shape
        tile_columns = (width + TILE - 1) // TILE
        tile_row, tile_column = cuda.blockIdx.x // tile_columns, cuda.blockIdx.x % tile_columns
        row = tile_row * TILE + cuda.threadIdx.x // TILE
        column = tile_column * TILE + cuda.threadIdx.x % TILE
        if row >= height or column >= width:
            return
        x = (real(np.int32(column)) + half - intrinsics[2]) * (one / intrinsics[0])
        y = (real(np.int32(row)) + half - intrinsics[3]) / intrinsics[1]
        least, own = zero, -1
        if before.size:
            least, own = depth_before[row, column], before[row, column]
        nearest, hit = far, -1
        for k in range(centers.shape[0]):
            c_x, c_y, c_z = centers[k, 0], centers[k, 1], centers[k, 2]
            n_x, n_y, n_z = normals[k, 0], normals[k, 1], normals[k, 2]
            u_x, u_y, u_z = axes[k, 0, 0], axes[k, 0, 1], axes[k, 0, 2]
            v_x, v_y, v_z = axes[k, 1, 0], axes[k, 1, 1], axes[k, 1, 2]
            depth = (c_x * n_x + c_y * n_y + c_z * n_z) / (n_x * x + (n_y * y + n_z))
            along_u = depth * (u_x * x + (u_y * y + u_z)) - (c_x * u_x + c_y * u_y + c_z * u_z)
            along_v = depth * (v_x * x + (v_y * y + v_z)) - (c_x * v_x + c_y * v_y + c_z * v_z)
            within = abs(along_u) <= half_sizes[k, 0] and abs(along_v) <= half_sizes[k, 1]
            if within and k != own and least < depth < nearest:
                nearest, hit = depth, k
        index[row, column] = hit
        depth_of[row, column] = nearest
        if hit >= 0 and (mask.size == 0 or mask[row, column] > zero):
            # Many threads may write here, all of them the same.
            tiles[hit, tile_row, tile_column] = True
            cuda.atomic.max(reaches, (hit, 0), np.int32(width - column))
            cuda.atomic.max(reaches, (hit, 1), np.int32(height - row))
            cuda.atomic.max(reaches, (hit, 2), np.int32(column + 1))
            cuda.atomic.max(reaches, (hit, 3), np.int32(row + 1))

    return forward


THREADS = 128


@cache
def windows_of(real: type) -> Kernel:
    """Left, top, right and bottom edge of what each pane shows; all 0 where that is nothing."""

    @kernel("pane_windows", real, "int2 int int real2")
    def fill(reaches, width, height, windows):
        k = cuda.grid(1)
        if k < windows.shape[0]:
            shown = reaches[k, 2] > 0
            windows[k, 0] = real(np.int32(width - reaches[k, 0] if shown else 0))
            windows[k, 1] = real(np.int32(height - reaches[k, 1] if shown else 0))
            windows[k, 2], windows[k, 3] = real(reaches[k, 2]), real(reaches[k, 3])

    return fill


INPUTS = "real3 real2 real4 real2 real1 int2 real1 int bool bool"


def blend_panes(inputs: Sequence[Tensor], switches: tuple[int, bool, bool]) -> tuple[Tensor, ...]:
    """As `glassplat.kernels.panes.cpu.blend_panes`."""
    transmission, mask = inputs[:2]
    outputs = tuple(torch.empty_like(like) for like in (transmission, transmission, mask))
    kernel_of = blend_panes_forward(REAL_OF[mask.dtype])
    kernel_of(blocks_for(mask.numel(), THREADS), THREADS, *inputs, *switches, *outputs)
    return outputs


def blend_panes_gradients(
    inputs: Sequence[Tensor], switches: tuple[int, bool, bool], cotangents: Sequence[Tensor]
) -> tuple[Tensor, ...]:
    """As `glassplat.kernels.panes.cpu.blend_panes_gradients`."""
    mask, normals, pane = inputs[1], inputs[3], inputs[5]
    found = tuple(torch.zeros_like(tensor) for tensor in inputs[:3])
    shares = mask.new_zeros(*mask.shape, 4)
    kernel_of = blend_panes_backward(REAL_OF[mask.dtype])
    kernel_of(blocks_for(mask.numel(), THREADS), THREADS, *inputs, *switches, *cotangents, *found, shares)
    # A sum of its own for each pane, in an order that does not change from run to run.
    panes = torch.arange(normals.shape[0], device=mask.device)[:, None]
    sums = (pane.flatten() == panes).to(mask.dtype) @ shares.view(-1, 4)
    return (*found, sums[:, :3].contiguous(), sums[:, 3].contiguous())


def _shine(real: type) -> Scalar:
    strength, _, ray_length = pane_maths(real)
    one, half = real(1.0), real(0.5)

    @inlined
    def shine(row, column, k, normals, bases, intrinsics, law):
        """Strength before the mask, the ray's x and y, its product with the normal and its length."""
        x = (real(np.int32(column)) + half - intrinsics[2]) * (one / intrinsics[0])
        y = (real(np.int32(row)) + half - intrinsics[3]) / intrinsics[1]
        along, length = normals[k, 0] * x + (normals[k, 1] * y + normals[k, 2]), ray_length(x, y)
        raw = strength(law, bases[k], abs(along) / length)
        return raw, x, y, along, length

    return shine


@cache
def blend_panes_forward(real: type) -> Kernel:
    """Fills rgb, reflection and strength."""
    shine, (mix, _) = _shine(real), mixing(real)
    zero, one = real(0.0), real(1.0)

    @kernel("blend_panes_forward", real, f"{INPUTS} real3 real3 real2")
    def forward(
        transmission, mask, reflections, normals, bases, pane, intrinsics, law, intensity, linear,
        rgb, reflection, strength,
    ):  # fmt: skip
        i = cuda.grid(1)
        if i >= mask.size:
            return
        row, column = i // mask.shape[1], i % mask.shape[1]
        k, marked = pane[row, column], mask[row, column]
        shown = k >= 0 and marked > zero
        share, gain = zero, one
        if shown:
            raw, _, _, _, _ = shine(row, column, k, normals, bases, intrinsics, law)
            share = raw * marked
            gain = one + reflections[k, row, column, 3] if intensity else one
        strength[row, column] = share
        for d in range(3):
            behind, bright, mixed = transmission[row, column, d], zero, transmission[row, column, d]
            if shown:
                mixed, bright = mix(behind, reflections[k, row, column, d], gain, share, linear)
            rgb[row, column, d] = mixed if share > zero else behind
            reflection[row, column, d] = bright

    return forward


@cache
def blend_panes_backward(real: type) -> Kernel:
    """Fills the gradients of transmission, mask and reflections, and each pixel's share [H, W, 4] of those of its
    pane's normal and base reflectance; all but the first start at zero.
    """
    shine, strength_slopes, (_, unmix) = _shine(real), pane_maths(real).strength_slopes, mixing(real)
    zero, one, dazzling = real(0.0), real(1.0), real(DAZZLING)

    @kernel("blend_panes_backward", real, f"{INPUTS} real3 real3 real2 real3 real2 real4 real3")
    def backward(
        transmission, mask, reflections, normals, bases, pane, intrinsics, law, intensity, linear,
        v_rgb, v_reflection, v_strength, v_transmission, v_mask, v_reflections, shares,
    ):  # fmt: skip
        i = cuda.grid(1)
        if i >= mask.size:
            return
        row, column = i // mask.shape[1], i % mask.shape[1]
        k, marked = pane[row, column], mask[row, column]
        if not (k >= 0 and marked > zero):
            for d in range(3):
                v_transmission[row, column, d] = v_rgb[row, column, d]
            return
        raw, x, y, along, length = shine(row, column, k, normals, bases, intrinsics, law)
        share, v_share, v_gain = raw * marked, v_strength[row, column], zero
        gain = one + reflections[k, row, column, 3] if intensity else one
        for d in range(3):
            v_pixel = v_rgb[row, column, d]
            v_behind, v_mirrored, by_gain, by_share = unmix(
                transmission[row, column, d], reflections[k, row, column, d], gain, share, linear,
                v_pixel if share > zero else zero, v_reflection[row, column, d],
            )  # fmt: skip
            v_gain += by_gain
            v_share += by_share
            v_reflections[k, row, column, d] = v_mirrored
            v_transmission[row, column, d] = v_behind if share > zero else v_pixel
        v_reflections[k, row, column, 3] = v_gain if intensity else zero
        v_mask[row, column] = v_share * raw
        v_raw = v_share * marked if gain <= dazzling else zero
        by_base, by_cosine = strength_slopes(law, bases[k], abs(along) / length)
        slope = v_raw * by_cosine / length
        slope = slope if along > zero else -slope
        shares[row, column, 0] = slope * x
        shares[row, column, 1] = slope * y
        shares[row, column, 2] = slope
        shares[row, column, 3] = v_raw * by_base

    return backward


def layer_slopes(
    strength: Tensor, transmission: Tensor, reflection: Tensor, where: Tensor, *, linear: bool
) -> tuple[Tensor, Tensor]:
    """As `glassplat.kernels.panes.cpu.layer_slopes`."""
    through, mirrored = torch.empty_like(strength), torch.empty_like(strength)
    layer_slopes_kernel(REAL_OF[strength.dtype])(
        blocks_for(strength.numel(), THREADS), THREADS, strength, transmission, reflection, where, linear,
        through, mirrored,
    )  # fmt: skip
    return through, mirrored


@cache
def layer_slopes_kernel(real: type) -> Kernel:
    """Fills both images [H, W], a pixel for each thread."""
    linear_of, linear_slope, encoded, encoded_slope = color_space_maths(real)
    zero, one, third = real(0.0), real(1.0), real(1.0 / 3.0)

    @kernel("layer_slopes", real, "real2 real3 real3 bool2 bool real2 real2")
    def slopes(strength, transmission, reflection, where, linear, through, mirrored):
        height, width = strength.shape
        i = cuda.grid(1)
        if i >= height * width:
            return
        row, x = i // width, i % width
        if not where[row, x]:
            through[row, x], mirrored[row, x] = one, zero
            return
        share, t, r = strength[row, x], transmission[row, x], reflection[row, x]
        behind, mirror_image = (t[0] + t[1] + t[2]) * third, (r[0] + r[1] + r[2]) * third
        by_behind, by_mirror_image = one - share, share
        if linear:
            lit, bright = linear_of(behind), linear_of(mirror_image)
            light = lit + share * (bright - lit)
            slope = encoded_slope(light, encoded(light))
            by_behind *= slope * linear_slope(behind, lit)
            by_mirror_image *= slope * linear_slope(mirror_image, bright)
        through[row, x], mirrored[row, x] = by_behind, by_mirror_image

    return slopes
