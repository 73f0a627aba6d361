"""Deferred shading on the CPU, one pixel at a time."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import torch
from numba import prange
from torch import Tensor

from glassplat.kernels.cpu.cube_texels import NO_LOOKUP, padded_faces, texel_gradients
from glassplat.kernels.cpu.jit import Kernel, inlined, kernel
from glassplat.kernels.cpu.schedule import even_stride
from glassplat.kernels.maths import vector_maths
from glassplat.kernels.maths_blend import Scalar
from glassplat.kernels.maths_cube import cube_maths
from glassplat.kernels.shaded import NORMAL_MIN
from glassplat.kernels.tensor_checks import REAL_OF


def shade_environment(inputs: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """The fields of `Shaded`; inputs in the order of the kernel."""
    base, normals, strength, texels, *camera = inputs
    rgb, reflection = torch.empty_like(base), torch.empty_like(base)
    tensors = (base, normals, strength, padded_faces(texels), *camera, rgb, reflection)
    shade_environment_forward(REAL_OF[base.dtype])(*(tensor.numpy() for tensor in tensors))
    return rgb, reflection


def shade_environment_gradients(
    inputs: Sequence[Tensor], reflection: Tensor, cotangents: Sequence[Tensor]
) -> tuple[Tensor, ...]:
    """Gradients of base, normals, strength and texels, given the reflection that the kernel found."""
    base, normals, strength, texels, *camera = inputs
    found = tuple(torch.empty_like(like) for like in (base, normals, strength))
    first_cells = torch.empty(strength.shape, dtype=torch.int32)
    fractions, v_raw = base.new_empty(*strength.shape, 2), torch.empty_like(base)
    tensors = (*inputs[:3], padded_faces(texels), *camera, reflection, *cotangents, *found)
    lookups = (first_cells, fractions, v_raw)
    shade_environment_backward(REAL_OF[base.dtype])(*(tensor.numpy() for tensor in (*tensors, *lookups)))
    v_texels = texel_gradients(first_cells.flatten(), fractions.flatten(0, 1), v_raw.flatten(0, 1), texels.shape[1])
    return (*found, v_texels)


def _ray(real: type) -> Scalar:
    half, scaled_sum = real(0.5), vector_maths().scaled_sum
    one = real(1.0)

    @inlined
    def ray(row, column, intrinsics, rotation):
        """The ray of a pixel in world axes, of any length."""
        x = (real(np.int32(column)) + half - intrinsics[2]) / intrinsics[0]
        y = (real(np.int32(row)) + half - intrinsics[3]) / intrinsics[1]
        return scaled_sum((x, y, one), rotation[:, 0], rotation[:, 1], rotation[:, 2])

    return ray


def _mirrored(real: type) -> tuple[Scalar, Scalar]:
    dot, blend, two = vector_maths().dot, vector_maths().blend, real(2.0)

    @inlined
    def mirrored(ray, normal):
        """The ray mirrored by a normal of any length, times the square of that length."""
        return blend(dot(normal, normal), ray, -two * dot(ray, normal), normal)

    @inlined
    def mirrored_gradient(ray, normal, g):
        """Gradient of the normal."""
        by_square = blend(two * dot(ray, g), normal, -two * dot(normal, g), ray)
        across = -two * dot(ray, normal)
        return by_square[0] + across * g[0], by_square[1] + across * g[1], by_square[2] + across * g[2]

    return mirrored, mirrored_gradient


@cache
def shade_environment_forward(real: type) -> Kernel:
    """Fills rgb and reflection."""
    maths, ray_of, mirrored, dot = cube_maths(real), _ray(real), _mirrored(real)[0], vector_maths().dot
    on_face, cell, logistic = maths.on_face, maths.cell, maths.logistic
    shortest = real(NORMAL_MIN**2)
    zero, one = real(0.0), real(1.0)

    @kernel("shade_environment_forward", real)
    def forward(base, normals, strength, padded, intrinsics, rotation, rgb, reflection):
        height, width = strength.shape
        size = padded.shape[1] - 2
        stride = even_stride(height)
        for task in prange(height):
            row = task * stride % height
            for column in range(width):
                normal = normals[row, column, 0], normals[row, column, 1], normals[row, column, 2]
                if dot(normal, normal) <= shortest:
                    for d in range(3):
                        rgb[row, column, d], reflection[row, column, d] = base[row, column, d], zero
                    continue
                x, y, z = mirrored(ray_of(row, column, intrinsics, rotation), normal)
                _, face, u, v, _ = on_face(x, y, z)
                left, along = cell(u, size)
                top, down = cell(v, size)
                upper, lower = padded[face, top], padded[face, top + 1]
                for d in range(3):
                    above = upper[left, d] * (one - along) + upper[left + 1, d] * along
                    below = lower[left, d] * (one - along) + lower[left + 1, d] * along
                    seen = logistic(above * (one - down) + below * down)
                    behind = base[row, column, d]
                    reflection[row, column, d] = seen
                    rgb[row, column, d] = behind + strength[row, column] * (seen - behind)

    return forward


@cache
def shade_environment_backward(real: type) -> Kernel:
    """Fills the gradients of base, normals, strength and of what was looked up, and which cells each pixel blends."""
    maths, ray_of, dot = cube_maths(real), _ray(real), vector_maths().dot
    mirrored, mirrored_gradient = _mirrored(real)
    on_face, from_face, cell = maths.on_face, maths.from_face, maths.cell
    shortest = real(NORMAL_MIN**2)
    zero, one, half = real(0.0), real(1.0), real(0.5)

    @kernel("shade_environment_backward", real)
    def backward(
        base, normals, strength, padded, intrinsics, rotation, reflection, v_rgb, v_reflection,
        v_base, v_normals, v_strength, first_cells, fractions, v_raw,
    ):  # fmt: skip
        height, width = strength.shape
        side = padded.shape[1]
        size = side - 2
        texels_per_u = half * real(size)
        stride = even_stride(height)
        for task in prange(height):
            row = task * stride % height
            for column in range(width):
                normal = normals[row, column, 0], normals[row, column, 1], normals[row, column, 2]
                v_strength[row, column] = zero
                if dot(normal, normal) <= shortest:
                    first_cells[row, column] = NO_LOOKUP
                    for d in range(3):
                        v_base[row, column, d], v_normals[row, column, d] = v_rgb[row, column, d], zero
                    continue
                ray = ray_of(row, column, intrinsics, rotation)
                x, y, z = mirrored(ray, normal)
                place = on_face(x, y, z)
                face = place[1]
                left, along = cell(place[2], size)
                top, down = cell(place[3], size)
                upper, lower = padded[face, top], padded[face, top + 1]
                share = strength[row, column]
                v_share, v_along, v_down = zero, zero, zero
                for d in range(3):
                    seen, v = reflection[row, column, d], v_rgb[row, column, d]
                    v_base[row, column, d] = v * (one - share)
                    v_share += v * (seen - base[row, column, d])
                    v = (v * share + v_reflection[row, column, d]) * seen * (one - seen)
                    v_raw[row, column, d] = v
                    across_above = upper[left + 1, d] - upper[left, d]
                    twist = lower[left + 1, d] - lower[left, d] - across_above
                    v_along += v * (across_above + down * twist)
                    v_down += v * (lower[left, d] - upper[left, d] + along * twist)
                v_strength[row, column] = v_share
                g = mirrored_gradient(ray, normal, from_face(place, v_along * texels_per_u, v_down * texels_per_u))
                v_normals[row, column, 0], v_normals[row, column, 1], v_normals[row, column, 2] = g
                first_cells[row, column] = (face * side + top) * side + left
                fractions[row, column, 0], fractions[row, column, 1] = along, down

    return backward
