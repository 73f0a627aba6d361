"""Deferred shading on the GPU: one thread for each pixel."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import torch
from numba import cuda
from torch import Tensor

from glassplat.kernels.cpu.jit import inlined
from glassplat.kernels.cuda.cube_texels import padded_faces, texel_gradients
from glassplat.kernels.cuda.launch import Kernel, blocks_for, kernel
from glassplat.kernels.maths import vector_maths
from glassplat.kernels.maths_blend import Scalar
from glassplat.kernels.maths_cube import cube_maths, mirror_maths
from glassplat.kernels.shaded import NORMAL_MIN
from glassplat.kernels.tensor_checks import REAL_OF

THREADS = 128
INPUTS = "real real3 real3 real2 real4 real1 real2"


def shade_environment(inputs: Sequence[Tensor], least_strength: float) -> tuple[Tensor, Tensor]:
    """As `glassplat.kernels.cpu.shade_environment.shade_environment`."""
    base, normals, strength, texels, *camera = inputs
    rgb, reflection = torch.empty_like(base), torch.empty_like(base)
    shade_environment_forward(REAL_OF[base.dtype])(
        blocks_for(strength.numel(), THREADS), THREADS, least_strength,
        base, normals, strength, padded_faces(texels), *camera, rgb, reflection,
    )  # fmt: skip
    return rgb, reflection


def shade_environment_gradients(
    inputs: Sequence[Tensor], least_strength: float, reflection: Tensor, cotangents: Sequence[Tensor]
) -> tuple[Tensor, ...]:
    """As `glassplat.kernels.cpu.shade_environment.shade_environment_gradients`."""
    base, normals, strength, texels, *camera = inputs
    found = tuple(torch.empty_like(like) for like in (base, normals, strength))
    first_cells = torch.empty(strength.numel(), dtype=torch.int32, device=base.device)
    fractions, v_raw = base.new_empty(strength.numel(), 2), torch.empty_like(base)
    shade_environment_backward(REAL_OF[base.dtype])(
        blocks_for(strength.numel(), THREADS), THREADS, least_strength,
        base, normals, strength, padded_faces(texels), *camera, reflection, *cotangents, *found,
        first_cells, fractions, v_raw,
    )  # fmt: skip
    return (*found, texel_gradients(first_cells, fractions, v_raw.view(-1, 3), texels.shape[1]))


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
    """Fills rgb and reflection."""
    logistic, place, dot = cube_maths(real).logistic, _place(real), vector_maths().dot
    shortest, zero, one = real(NORMAL_MIN**2), real(0.0), real(1.0)

    @kernel("shade_environment_forward", real, f"{INPUTS} real3 real3")
    def forward(least_strength, base, normals, strength, padded, intrinsics, rotation, rgb, reflection):
        i = cuda.grid(1)
        if i >= strength.size:
            return
        row, column = i // strength.shape[1], i % strength.shape[1]
        normal = normals[row, column, 0], normals[row, column, 1], normals[row, column, 2]
        if dot(normal, normal) <= shortest or abs(strength[row, column]) < least_strength:
            for d in range(3):
                rgb[row, column, d], reflection[row, column, d] = base[row, column, d], zero
            return
        _, at, left, along, top, down = place(row, column, normal, intrinsics, rotation, padded.shape[1] - 2)
        face = at[1]
        for d in range(3):
            upper = padded[face, top, left, d] * (one - along) + padded[face, top, left + 1, d] * along
            lower = padded[face, top + 1, left, d] * (one - along) + padded[face, top + 1, left + 1, d] * along
            seen, behind = logistic(upper * (one - down) + lower * down), base[row, column, d]
            reflection[row, column, d] = seen
            rgb[row, column, d] = behind + strength[row, column] * (seen - behind)

    return forward


@cache
def shade_environment_backward(real: type) -> Kernel:
    """Fills the gradients of base, normals, strength and of what was looked up, and which cells each pixel blends."""
    from_face, place, dot = cube_maths(real).from_face, _place(real), vector_maths().dot
    mirrored_gradient = mirror_maths(real).gradient
    shortest, zero, half, one = real(NORMAL_MIN**2), real(0.0), real(0.5), real(1.0)

    @kernel("shade_environment_backward", real, f"{INPUTS} real3 real3 real3 real3 real3 real2 int1 real2 real3")
    def backward(
        least_strength, base, normals, strength, padded, intrinsics, rotation, reflection, v_rgb, v_reflection,
        v_base, v_normals, v_strength, first_cells, fractions, v_raw,
    ):  # fmt: skip
        i, side = cuda.grid(1), padded.shape[1]
        if i >= strength.size:
            return
        row, column = i // strength.shape[1], i % strength.shape[1]
        normal = normals[row, column, 0], normals[row, column, 1], normals[row, column, 2]
        if dot(normal, normal) <= shortest or abs(strength[row, column]) < least_strength:
            v_strength[row, column], first_cells[i] = zero, 6 * side * side
            for d in range(3):
                v_base[row, column, d], v_normals[row, column, d] = v_rgb[row, column, d], zero
            return
        ray, at, left, along, top, down = place(row, column, normal, intrinsics, rotation, side - 2)
        face, share, v_share, by_column, by_row = at[1], strength[row, column], zero, zero, zero
        for d in range(3):
            seen, v = reflection[row, column, d], v_rgb[row, column, d]
            v_base[row, column, d] = v * (one - share)
            v_share += v * (seen - base[row, column, d])
            v = (v * share + v_reflection[row, column, d]) * seen * (one - seen)
            v_raw[row, column, d] = v
            first, under = padded[face, top, left, d], padded[face, top + 1, left, d]
            across = padded[face, top, left + 1, d] - first
            twist = padded[face, top + 1, left + 1, d] - under - across
            by_column += v * (across + down * twist)
            by_row += v * (under - first + along * twist)
        v_strength[row, column] = v_share
        cells_per_u = half * real(side - 2)
        g = from_face(at, by_column * cells_per_u, by_row * cells_per_u)
        x, y, z = mirrored_gradient(ray, normal, g)
        v_normals[row, column, 0], v_normals[row, column, 1], v_normals[row, column, 2] = x, y, z
        first_cells[i] = (face * side + top) * side + left
        fractions[i, 0], fractions[i, 1] = along, down

    return backward
