"""Reflective surfaces on the GPU: one thread per Gaussian, direction or pixel.

Gradients of texels are summed without atomics. Lookups are sorted by their first cell. One warp sums those of a cell,
each thread every 32nd of them, and reduces its sums in a tree; then one thread per texel gathers from the cells that
contain it. The order of every sum depends on the lookups only, so that results are bit-identical in every run. The sort
costs less than the contention of many lookups for one texel, which occurs where surfaces magnify the environment.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import torch
from numba import cuda
from torch import Tensor

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.backend.cuda import Kernel, kernel
from glassplat.kernels.environment.cpu import gradients_like
from glassplat.kernels.maths import cube
from glassplat.kernels.maths.blending import Scalar
from glassplat.kernels.maths.projection import dot
from glassplat.kernels.maths.surface import surface_maths
from glassplat.kernels.records import NORMAL_AT, NORMAL_MIN, REAL_OF, STRENGTH_AT, SURFACE_CHANNELS, Shaded


def surface_channels(inputs: Sequence[Tensor]) -> Tensor:
    """See `glassplat.kernels.environment.surface_channels`; inputs in its order."""
    colors, extra = inputs[0], inputs[-1]
    count = colors.shape[0]
    channels = colors.new_zeros(count, SURFACE_CHANNELS + extra.shape[1])
    surface_channels_forward(REAL_OF[colors.dtype]).over(count, *inputs, channels)
    return channels


def surface_channels_gradients(saved: Sequence[Tensor], v_channels: Tensor) -> tuple[Tensor, ...]:
    """As `glassplat.kernels.environment.cpu.surface_channels_gradients`."""
    found = tuple(tensor.zero_() for tensor in gradients_like(v_channels))
    surface_channels_backward(REAL_OF[v_channels.dtype]).over(len(v_channels), *saved, v_channels, *found)
    return found


@cache
def surface_channels_forward(real: type) -> Kernel:
    """Fills the channels of visible Gaussians."""
    (describe, _), zero = surface_maths(real), real(0.0)

    @kernel("surface_channels_forward", real, "real2 real2 real2 real2 real2 real1 real1 real2 real2")
    def forward(colors, radii, quats, log_scales, means, logit_strengths, camera_center, extra, channels):
        i = cuda.grid(1)
        if i < radii.shape[0] and radii[i, 0] > zero:
            describe(i, colors, quats, log_scales, means, logit_strengths, camera_center, extra, channels)

    return forward


@cache
def surface_channels_backward(real: type) -> Kernel:
    """Fills the gradients of visible Gaussians."""
    (_, describe_gradient), zero = surface_maths(real), real(0.0)

    @kernel("surface_channels_backward", real, "real2 real2 real2 real2 real2 real2 real2 real1 real2")
    def backward(
        radii, quats, log_scales, channels, v_channels, v_colors, v_quats, v_logit_strengths, v_extra
    ):  # fmt: skip
        i = cuda.grid(1)
        if i < radii.shape[0] and radii[i, 0] > zero:
            describe_gradient(i, quats, log_scales, channels, v_channels, v_colors, v_quats, v_logit_strengths, v_extra)

    return backward


WARP = 32


def padded_faces(texels: Tensor) -> Tensor:
    """Faces [6, S + 2, S + 2, D] with a ring of their neighbours' texels, as in the reference."""
    size, depth = texels.shape[1], texels.shape[3]
    padded = texels.new_empty(6, size + 2, size + 2, depth)
    pad_faces(REAL_OF[texels.dtype]).over(padded.numel(), texels, padded)
    return padded


def texel_gradients(first_cells: Tensor, fractions: Tensor, gradients: Tensor, size: int) -> Tensor:
    """Gradient [6, S, S, D] of the texels.

    Args:
        first_cells: [P] int32 flat index, among padded texels, of the first of the four cells that each lookup blends;
            6 (S + 2)^2 if there was none.
        fractions: [P, 2] of the way to the next column and to the next row.
        gradients: [P, D] gradient of each lookup's result.
        size: texels along the side of a face, S.
    """
    real, depth, count = REAL_OF[gradients.dtype], gradients.shape[1], 6 * (size + 2) ** 2
    by_cell, order = torch.sort(first_cells, stable=True)
    edges = torch.arange(count + 1, dtype=by_cell.dtype, device=by_cell.device)
    starts = torch.searchsorted(by_cell, edges)
    sums = gradients.new_zeros(count, 4, depth)
    sum_lookups(real)(count, WARP, fractions, gradients, starts, order, sums)
    texels = gradients.new_empty(6, size, size, depth)
    fold_faces(real).over(texels.numel(), sums.view(6, size + 2, size + 2, 4 * depth), texels)
    return texels


@cache
def pad_faces(real: type) -> Kernel:
    """Fills padded faces from texels, one thread per number."""
    third = real(1.0 / 3.0)

    @kernel("cube_pad_faces", real, "real4 real4")
    def pad(texels, padded):
        i, side, depth = cuda.grid(1), padded.shape[1], padded.shape[3]
        if i >= padded.size:
            return
        d, column, row, face = i % depth, i // depth % side, i // depth // side % side, i // depth // side // side
        size = side - 2
        inner_row, inner_column = min(max(row - 1, 0), size - 1), min(max(column - 1, 0), size - 1)
        beyond_row, beyond_column = row == 0 or row > size, column == 0 or column > size
        found = texels[face, inner_row, inner_column, d]
        if beyond_row or beyond_column:
            f, r, c = cube.over_column(face, 1 if column == 0 else 0, inner_row, size)
            g, s, e = cube.over_row(face, 1 if row == 0 else 0, inner_column, size)
            if beyond_row and beyond_column:
                found = (found + texels[f, r, c, d] + texels[g, s, e, d]) * third
            else:
                found = texels[g, s, e, d] if beyond_row else texels[f, r, c, d]
        padded[face, row, column, d] = found

    return pad


@cache
def sum_lookups(real: type) -> Kernel:
    """Fills the sums [cells, 4, D] of lookups starting in a cell, for it, the next column, the next row and both."""
    zero, one = real(0.0), real(1.0)

    @kernel("cube_sum_lookups", real, "real2 real2 long1 long1 real3")
    def add(fractions, gradients, starts, order, sums):
        shared = cuda.shared.array((4, WARP), real)
        cell, t = cuda.blockIdx.x, cuda.threadIdx.x
        begin, end = starts[cell], starts[cell + 1]
        if begin == end:
            return
        for d in range(gradients.shape[1]):
            for corner in range(4):
                shared[corner, t] = zero
            for position in range(begin + t, end, WARP):
                lookup = order[position]
                along, down, v = fractions[lookup, 0], fractions[lookup, 1], gradients[lookup, d]
                upper, lower = (one - down) * v, down * v
                shared[0, t] += (one - along) * upper
                shared[1, t] += along * upper
                shared[2, t] += (one - along) * lower
                shared[3, t] += along * lower
            step = WARP // 2
            while step > 0:
                cuda.syncthreads()
                if t < step:
                    for corner in range(4):
                        shared[corner, t] += shared[corner, t + step]
                step //= 2
            if t == 0:
                for corner in range(4):
                    sums[cell, corner, d] = shared[corner, 0]
            # Only now may the other threads continue with the next channel, and overwrite the values just read.
            cuda.syncthreads()

    return add


@cache
def fold_faces(real: type) -> Kernel:
    """Fills the gradient of the texels from sums [6, S + 2, S + 2, 4 D]: the transpose of `pad_faces`, gathered."""
    third = real(1.0 / 3.0)

    @inlined
    def cell(sums, face, row, column, d):
        """The gradient of a padded texel, from lookups that start in it, left of it, above it, and above left."""
        depth = sums.shape[3] // 4
        found = sums[face, row, column, d]
        if column > 0:
            found += sums[face, row, column - 1, depth + d]
        if row > 0:
            found += sums[face, row - 1, column, 2 * depth + d]
            if column > 0:
                found += sums[face, row - 1, column - 1, 3 * depth + d]
        return found

    @inlined
    def is_end(at, side, size):
        """Return whether a texel is the last of its row or column, for side = 0, or the first."""
        return at == (1 - side) * (size - 1)

    @kernel("cube_fold_faces", real, "real4 real4")
    def fold(sums, texels):
        i, size, depth = cuda.grid(1), texels.shape[1], texels.shape[3]
        if i >= texels.size:
            return
        d, column, row, face = i % depth, i // depth % size, i // depth // size % size, i // depth // size // size
        axis, outer = face // 2, (1 - face % 2) * (size + 1)
        found = cell(sums, face, row + 1, column + 1, d)
        # Neighbouring faces across an edge: the inverse of `over_column` in the first loop, and of `over_row` in the
        # second one. A corner's mean appears in all three faces that meet there.
        for side in range(2):
            if is_end(row, side, size):
                beside = 2 * ((axis + 2) % 3) + side
                found += cell(sums, beside, column + 1, outer, d)
                for other in range(2):
                    if is_end(column, other, size):
                        far = (1 - other) * (size + 1)
                        found += third * cell(sums, beside, far, outer, d)
                        found += third * cell(sums, face, (1 - side) * (size + 1), far, d)
        for side in range(2):
            if is_end(column, side, size):
                beside = 2 * ((axis + 1) % 3) + side
                found += cell(sums, beside, outer, row + 1, d)
                for other in range(2):
                    if is_end(row, other, size):
                        found += third * cell(sums, beside, outer, (1 - other) * (size + 1), d)
        texels[face, row, column, d] = found

    return fold


def cube_lookup(texels: Tensor, directions: Tensor) -> Tensor:
    """As `glassplat.kernels.environment.cpu.cube_lookup`."""
    count = directions.shape[0]
    found = texels.new_empty(count, texels.shape[3])
    cube_lookup_forward(REAL_OF[texels.dtype]).over(count, padded_faces(texels), directions, found)
    return found


def cube_lookup_gradients(texels: Tensor, directions: Tensor, cotangents: Tensor) -> tuple[Tensor, Tensor]:
    """As `glassplat.kernels.environment.cpu.cube_lookup_gradients`."""
    count = directions.shape[0]
    v_directions, fractions = torch.empty_like(directions), directions.new_empty(count, 2)
    first_cells = torch.empty(count, dtype=torch.int32, device=directions.device)
    inputs = (padded_faces(texels), directions, cotangents)
    cube_lookup_backward(REAL_OF[texels.dtype]).over(count, *inputs, v_directions, first_cells, fractions)
    return texel_gradients(first_cells, fractions, cotangents, texels.shape[1]), v_directions


@cache
def cube_lookup_forward(real: type) -> Kernel:
    """Fills the lookups in padded faces."""
    look_up, _ = cube.lookup_maths(real)

    @kernel("cube_lookup_forward", real, "real4 real2 real2")
    def forward(padded, directions, found):
        i = cuda.grid(1)
        if i < directions.shape[0]:
            look_up(i, padded, directions, found)

    return forward


@cache
def cube_lookup_backward(real: type) -> Kernel:
    """Fills the gradients of the directions, and the cells and fractions of each lookup."""
    _, look_up_gradient = cube.lookup_maths(real)

    @kernel("cube_lookup_backward", real, "real4 real2 real2 real2 int1 real2")
    def backward(padded, directions, v_found, v_directions, first_cells, fractions):
        i = cuda.grid(1)
        if i < directions.shape[0]:
            row, column = look_up_gradient(i, padded, directions, v_found, v_directions, fractions)
            first_cells[i] = row * padded.shape[1] + column

    return backward


def shade_environment(inputs: Sequence[Tensor], least_strength: float) -> Shaded:
    """As `glassplat.kernels.environment.cpu.shade_environment`."""
    blended, alpha, texels, *rest = inputs
    shaded = Shaded(*(alpha.new_empty(*alpha.shape, 3) for _ in range(3)))
    inputs = (blended, alpha, padded_faces(texels), *rest)
    shade_environment_forward(REAL_OF[blended.dtype]).over(alpha.numel(), least_strength, *inputs, *shaded)
    return shaded


def shade_environment_gradients(
    inputs: Sequence[Tensor], least_strength: float, found: Sequence[Tensor], cotangents: Sequence[Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """As `glassplat.kernels.environment.cpu.shade_environment_gradients`."""
    blended, alpha, texels, *rest = inputs
    v_blended, v_alpha = torch.empty_like(blended), torch.empty_like(alpha)
    first_cells = torch.empty(alpha.numel(), dtype=torch.int32, device=alpha.device)
    fractions, v_raw = alpha.new_empty(alpha.numel(), 2), alpha.new_empty(alpha.numel(), 3)
    given = (least_strength, blended, padded_faces(texels), *rest, *found, *cotangents)
    launch = shade_environment_backward(REAL_OF[blended.dtype]).over
    launch(alpha.numel(), *given, v_blended, v_alpha, first_cells, fractions, v_raw)
    return v_blended, v_alpha, texel_gradients(first_cells, fractions, v_raw, texels.shape[1])


def _cube_position(real: type) -> Scalar:
    cell, one, half = cube.build_cell(real), real(1.0), real(0.5)

    @inlined
    def cube_position(row, column, normal, intrinsics, rotation, size):
        """The ray of a pixel, the position on the cube that it is reflected to, and the cells and fractions there."""
        x = (real(np.int32(column)) + half - intrinsics[2]) * (one / intrinsics[0])
        y = (real(np.int32(row)) + half - intrinsics[3]) / intrinsics[1]
        ray = (
            x * rotation[0, 0] + y * rotation[0, 1] + rotation[0, 2],
            x * rotation[1, 0] + y * rotation[1, 1] + rotation[1, 2],
            x * rotation[2, 0] + y * rotation[2, 1] + rotation[2, 2],
        )
        to = cube.mirror_ray(ray, normal)
        at = cube.on_face(to[0], to[1], to[2])
        left, along = cell(at[2], size)
        top, down = cell(at[3], size)
        return ray, at, left, along, top, down

    return cube_position


@cache
def shade_environment_forward(real: type) -> Kernel:
    """Fills rgb, base and reflection."""
    logistic, cube_position = cube.build_logistic(real), _cube_position(real)
    shortest, zero, one = real(NORMAL_MIN**2), real(0.0), real(1.0)

    @kernel("shade_environment_forward", real, "real real3 real2 real4 real1 real2 real1 real3 real3 real3")
    def forward(least_strength, blended, alpha, padded, intrinsics, rotation, background, rgb, base, reflection):
        i = cuda.grid(1)
        if i >= alpha.size:
            return
        row, column = i // alpha.shape[1], i % alpha.shape[1]
        pixel, clear = blended[row, column], one - alpha[row, column]
        for d in range(3):
            base[row, column, d] = pixel[d] + clear * background[d]
        normal, share = (pixel[NORMAL_AT], pixel[NORMAL_AT + 1], pixel[NORMAL_AT + 2]), pixel[STRENGTH_AT]
        if dot(normal, normal) <= shortest or abs(share) < least_strength:
            for d in range(3):
                rgb[row, column, d], reflection[row, column, d] = base[row, column, d], zero
            return
        _, at, left, along, top, down = cube_position(row, column, normal, intrinsics, rotation, padded.shape[1] - 2)
        upper, lower = padded[at[1], top], padded[at[1], top + 1]
        for d in range(3):
            raw = cube.bilinear(upper[left, d], upper[left + 1, d], lower[left, d], lower[left + 1, d], along, down)
            seen, behind = logistic(raw), base[row, column, d]
            reflection[row, column, d] = seen
            rgb[row, column, d] = behind + share * (seen - behind)

    return forward


@cache
def shade_environment_backward(real: type) -> Kernel:
    """Fills the gradients of blended, alpha and the lookups, and the cells and fractions of each pixel."""
    cube_position = _cube_position(real)
    shortest, zero, half, one = real(NORMAL_MIN**2), real(0.0), real(0.5), real(1.0)

    @kernel(
        "shade_environment_backward",
        real,
        "real real3 real4 real1 real2 real1 real3 real3 real3 real3 real3 real3 real2 int1 real2 real2",
    )
    def backward(
        least_strength, blended, padded, intrinsics, rotation, background, base, reflection,
        v_rgb, v_base, v_reflection, v_blended, v_alpha, first_cells, fractions, v_raw,
    ):  # fmt: skip
        i, side = cuda.grid(1), padded.shape[1]
        if i >= v_alpha.size:
            return
        row, column = i // v_alpha.shape[1], i % v_alpha.shape[1]
        pixel, v_pixel = blended[row, column], v_blended[row, column]
        for d in range(NORMAL_AT, v_pixel.size):
            v_pixel[d] = zero
        normal, share = (pixel[NORMAL_AT], pixel[NORMAL_AT + 1], pixel[NORMAL_AT + 2]), pixel[STRENGTH_AT]
        bare = dot(normal, normal) <= shortest or abs(share) < least_strength
        kept, v_clear = one if bare else one - share, zero
        for d in range(3):
            v = v_base[row, column, d] + v_rgb[row, column, d] * kept
            v_pixel[d] = v
            v_clear += v * background[d]
        v_alpha[row, column] = -v_clear
        if bare:
            first_cells[i] = 6 * side * side
            return
        ray, at, left, along, top, down = cube_position(row, column, normal, intrinsics, rotation, side - 2)
        face, v_share, by_column, by_row = at[1], zero, zero, zero
        upper, lower = padded[face, top], padded[face, top + 1]
        for d in range(3):
            seen, v = reflection[row, column, d], v_rgb[row, column, d]
            v_share += v * (seen - base[row, column, d])
            v = (v * share + v_reflection[row, column, d]) * seen * (one - seen)
            v_raw[i, d] = v
            by = cube.bilinear_gradient(
                upper[left, d], upper[left + 1, d], lower[left, d], lower[left + 1, d], along, down
            )
            by_column += v * by[0]
            by_row += v * by[1]
        v_pixel[STRENGTH_AT] = v_share
        cells_per_u = half * real(side - 2)
        g = cube.from_face(at, by_column * cells_per_u, by_row * cells_per_u)
        x, y, z = cube.mirrored_gradient(ray, normal, g)
        v_pixel[NORMAL_AT], v_pixel[NORMAL_AT + 1], v_pixel[NORMAL_AT + 2] = x, y, z
        first_cells[i] = (face * side + top) * side + left
        fractions[i, 0], fractions[i, 1] = along, down

    return backward
