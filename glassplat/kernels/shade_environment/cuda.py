"""Deferred shading on the GPU: one thread for each pixel."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import torch
from numba import cuda
from torch import Tensor

from glassplat.kernels.cpu.jit import inlined
from glassplat.kernels.cube_lookup.cuda_texels import padded_faces, texel_gradients
from glassplat.kernels.cuda.launch import Kernel, blocks_for, kernel
from glassplat.kernels.maths.blending import Scalar
from glassplat.kernels.maths.cube import cube_maths, mirror_maths
from glassplat.kernels.maths.projection import vector_maths
from glassplat.kernels.shade_environment.shaded import NORMAL_AT, NORMAL_MIN, STRENGTH_AT, Shaded
from glassplat.kernels.tensor_checks import REAL_OF

THREADS = 128


def shade_environment(inputs: Sequence[Tensor], least_strength: float) -> Shaded:
    """As `glassplat.kernels.shade_environment.cpu.shade_environment`."""
    blended, alpha, texels, *rest = inputs
    shaded = Shaded(*(alpha.new_empty(*alpha.shape, 3) for _ in range(3)))
    shade_environment_forward(REAL_OF[blended.dtype])(
        blocks_for(alpha.numel(), THREADS), THREADS, least_strength,
        blended, alpha, padded_faces(texels), *rest, *shaded,
    )  # fmt: skip
    return shaded


def shade_environment_gradients(
    inputs: Sequence[Tensor], least_strength: float, found: Sequence[Tensor], cotangents: Sequence[Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """As `glassplat.kernels.shade_environment.cpu.shade_environment_gradients`."""
    blended, alpha, texels, *rest = inputs
    v_blended, v_alpha = torch.empty_like(blended), torch.empty_like(alpha)
    first_cells = torch.empty(alpha.numel(), dtype=torch.int32, device=alpha.device)
    fractions, v_raw = alpha.new_empty(alpha.numel(), 2), alpha.new_empty(alpha.numel(), 3)
    shade_environment_backward(REAL_OF[blended.dtype])(
        blocks_for(alpha.numel(), THREADS), THREADS, least_strength,
        blended, padded_faces(texels), *rest, *found, *cotangents, v_blended, v_alpha, first_cells, fractions, v_raw,
    )  # fmt: skip
    return v_blended, v_alpha, texel_gradients(first_cells, fractions, v_raw, texels.shape[1])


def _place(real: type) -> Scalar:
    maths, mirrored, one, half = cube_maths(real), mirror_maths(real).mirrored, real(1.0), real(0.5)
    on_face, cell = maths.on_face, maths.cell

    @inlined
    def place(row, column, normal, intrinsics, rotation, size):
        """The ray of a pixel, where on the cube it is mirrored to, and the cells and fractions there."""
        x = (real(np.int32(column)) + half - intrinsics[2]) * (one / intrinsics[0])
        y = (real(np.int32(row)) + half - intrinsics[3]) / intrinsics[1]
        ray = (
            x * rotation[0, 0] + y * rotation[0, 1] + rotation[0, 2],
            x * rotation[1, 0] + y * rotation[1, 1] + rotation[1, 2],
            x * rotation[2, 0] + y * rotation[2, 1] + rotation[2, 2],
        )
        to = mirrored(ray, normal)
        at = on_face(to[0], to[1], to[2])
        left, along = cell(at[2], size)
        top, down = cell(at[3], size)
        return ray, at, left, along, top, down

    return place


@cache
def shade_environment_forward(real: type) -> Kernel:
    """Fills rgb, base and reflection."""
    maths, place, dot = cube_maths(real), _place(real), vector_maths().dot
    logistic, between = maths.logistic, maths.between
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
        _, at, left, along, top, down = place(row, column, normal, intrinsics, rotation, padded.shape[1] - 2)
        upper, lower = padded[at[1], top], padded[at[1], top + 1]
        for d in range(3):
            raw = between(upper[left, d], upper[left + 1, d], lower[left, d], lower[left + 1, d], along, down)
            seen, behind = logistic(raw), base[row, column, d]
            reflection[row, column, d] = seen
            rgb[row, column, d] = behind + share * (seen - behind)

    return forward


@cache
def shade_environment_backward(real: type) -> Kernel:
    """Fills the gradients of blended, alpha and of what was looked up, and which cells each pixel blends."""
    maths, place, dot = cube_maths(real), _place(real), vector_maths().dot
    from_face, slopes = maths.from_face, maths.slopes
    mirrored_gradient = mirror_maths(real).gradient
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
        ray, at, left, along, top, down = place(row, column, normal, intrinsics, rotation, side - 2)
        face, v_share, by_column, by_row = at[1], zero, zero, zero
        upper, lower = padded[face, top], padded[face, top + 1]
        for d in range(3):
            seen, v = reflection[row, column, d], v_rgb[row, column, d]
            v_share += v * (seen - base[row, column, d])
            v = (v * share + v_reflection[row, column, d]) * seen * (one - seen)
            v_raw[i, d] = v
            steepness = slopes(upper[left, d], upper[left + 1, d], lower[left, d], lower[left + 1, d], along, down)
            by_column += v * steepness[0]
            by_row += v * steepness[1]
        v_pixel[STRENGTH_AT] = v_share
        cells_per_u = half * real(side - 2)
        g = from_face(at, by_column * cells_per_u, by_row * cells_per_u)
        x, y, z = mirrored_gradient(ray, normal, g)
        v_pixel[NORMAL_AT], v_pixel[NORMAL_AT + 1], v_pixel[NORMAL_AT + 2] = x, y, z
        first_cells[i] = (face * side + top) * side + left
        fractions[i, 0], fractions[i, 1] = along, down

    return backward
