"""Deferred shading on the CPU: runs of pixels of one row that have a normal and reflect.

A run is kept in *planes* of one flat buffer, one plane per quantity, at offsets known to the compiler; that is what
lets it turn the lookup and the sigmoid into vector instructions.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from glassplat.kernels.cpu.jit import Kernel, inlined, kernel
from glassplat.kernels.cpu.schedule import even_stride
from glassplat.kernels.cube_lookup.cpu_texels import NO_LOOKUP, padded_faces, texel_gradients
from glassplat.kernels.maths.blending import Scalar
from glassplat.kernels.maths.cube import cube_maths, mirror_maths
from glassplat.kernels.maths.projection import vector_maths
from glassplat.kernels.shade_environment.shaded import NORMAL_AT, NORMAL_MIN, STRENGTH_AT, Shaded
from glassplat.kernels.tensor_checks import REAL_OF

RUN = 32
"""Pixels of a run."""

# Planes of a run: real numbers, and whole ones. What a run does not fill is left from another one and not read.
NORMAL, RAY, PLACE, ALONG, DOWN, SEEN = (plane * RUN for plane in (0, 3, 6, 9, 10, 11))
FORWARD_PLANES = 14
V_RAW, BY_COLUMN, BY_ROW = (plane * RUN for plane in (14, 17, 18))
BACKWARD_PLANES = 19
COLUMN, AXIS, FACE, CELL_ROW, CELL, FIRST = (plane * RUN for plane in range(6))
WHOLE_PLANES = 6


def shade_environment(inputs: Sequence[Tensor], least_strength: float) -> Shaded:
    """As the operation; inputs in the order of the kernel."""
    blended, alpha, texels, *rest = inputs
    real = REAL_OF[blended.dtype]
    shaded = Shaded(*(alpha.new_empty(*alpha.shape, 3) for _ in range(3)))
    tensors = (blended, alpha, padded_faces(texels), *rest, *shaded)
    shade_environment_forward(real)(real(least_strength), *(tensor.numpy() for tensor in tensors))
    return shaded


def shade_environment_gradients(
    inputs: Sequence[Tensor], least_strength: float, found: Sequence[Tensor], cotangents: Sequence[Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of blended, alpha and texels, given the base and the reflection that the kernel found."""
    blended, alpha, texels, *rest = inputs
    real = REAL_OF[blended.dtype]
    v_blended, v_alpha = torch.empty_like(blended), torch.empty_like(alpha)
    first_cells = torch.empty(*alpha.shape, 2, dtype=torch.int32)
    fractions, v_raw = alpha.new_empty(*alpha.shape, 2), alpha.new_empty(*alpha.shape, 3)
    lookups = (first_cells, fractions, v_raw)
    tensors = (blended, padded_faces(texels), *rest, *found, *cotangents, v_blended, v_alpha, *lookups)
    shade_environment_backward(real)(real(least_strength), *(tensor.numpy() for tensor in tensors))
    first_cells, fractions, v_raw = (tensor.flatten(0, 1) for tensor in lookups)
    return v_blended, v_alpha, texel_gradients(first_cells, fractions, v_raw, texels.shape[1])


@inlined
def normal_of(blended, row, column):
    """The blended normal of a pixel."""
    return blended[row, column, NORMAL_AT], blended[row, column, NORMAL_AT + 1], blended[row, column, NORMAL_AT + 2]


def _place(real: type) -> Scalar:
    maths, mirrored = cube_maths(real), mirror_maths(real).mirrored
    on_face, cell = maths.on_face, maths.cell
    one, half = real(1.0), real(0.5)

    @inlined
    def place(run, whole, row, side, intrinsics, rotation):
        """Where on the cube the pixels of a run are mirrored to."""
        inverse_f, start = one / intrinsics[0], half - intrinsics[2]
        y = (real(np.int32(row)) + half - intrinsics[3]) / intrinsics[1]
        across_x, across_y, across_z = rotation[0, 0], rotation[1, 0], rotation[2, 0]
        from_x = y * rotation[0, 1] + rotation[0, 2]
        from_y = y * rotation[1, 1] + rotation[1, 2]
        from_z = y * rotation[2, 1] + rotation[2, 2]
        size = side - np.int32(2)
        for i in range(RUN):
            x = (real(whole[COLUMN + i]) + start) * inverse_f
            ray = x * across_x + from_x, x * across_y + from_y, x * across_z + from_z
            normal = run[NORMAL + i], run[NORMAL + RUN + i], run[NORMAL + 2 * RUN + i]
            to = mirrored(ray, normal)
            axis, face, u, v, inverse = on_face(to[0], to[1], to[2])
            left, along = cell(u, size)
            top, down = cell(v, size)
            run[RAY + i], run[RAY + RUN + i], run[RAY + 2 * RUN + i] = ray
            run[PLACE + i], run[PLACE + RUN + i], run[PLACE + 2 * RUN + i] = u, v, inverse
            run[ALONG + i], run[DOWN + i] = along, down
            whole[AXIS + i], whole[FACE + i] = axis, face
            cell_row = face * side + top
            whole[CELL_ROW + i], whole[CELL + i] = cell_row, left
            whole[FIRST + i] = (cell_row * side + left) * np.int32(3)

    return place


@cache
def shade_environment_forward(real: type) -> Kernel:
    """Fills rgb, base and reflection."""
    maths, place, dot = cube_maths(real), _place(real), vector_maths().dot
    logistic, between = maths.logistic, maths.between
    shortest = real(NORMAL_MIN**2)
    zero, one = real(0.0), real(1.0)

    @inlined
    def look(run, whole, flat, below):
        """The colour that each pixel of a run mirrors; `below` is the distance of the next row of cells."""
        for d in range(3):
            for i in range(RUN):
                at, along, down = whole[FIRST + i] + d, run[ALONG + i], run[DOWN + i]
                under = at + below
                run[SEEN + d * RUN + i] = between(flat[at], flat[at + 3], flat[under], flat[under + 3], along, down)
        for i in range(3 * RUN):
            run[SEEN + i] = logistic(run[SEEN + i])

    @kernel("shade_environment_forward", real)
    def forward(
        least_strength, blended, alpha, padded, intrinsics, rotation, background, rgb, base, reflection
    ):  # fmt: skip
        height, width = alpha.shape
        side, flat = np.int32(padded.shape[1]), padded.reshape(padded.size)
        stride = even_stride(height)
        for task in prange(height):
            row = task * stride % height
            run: NDArray[Any] = np.zeros(FORWARD_PLANES * RUN, real)
            whole: NDArray[Any] = np.zeros(WHOLE_PLANES * RUN, np.int32)
            count = 0
            for column in range(width):
                clear = one - alpha[row, column]
                for d in range(3):
                    base[row, column, d] = blended[row, column, d] + clear * background[d]
                normal = normal_of(blended, row, column)
                if dot(normal, normal) <= shortest or abs(blended[row, column, STRENGTH_AT]) < least_strength:
                    for d in range(3):
                        rgb[row, column, d], reflection[row, column, d] = base[row, column, d], zero
                else:
                    whole[COLUMN + count] = column
                    run[NORMAL + count], run[NORMAL + RUN + count], run[NORMAL + 2 * RUN + count] = normal
                    count += 1
                if count < RUN and column < width - 1:
                    continue
                if count > 0:
                    place(run, whole, row, side, intrinsics, rotation)
                    look(run, whole, flat, 3 * side)
                for i in range(count):
                    at = whole[COLUMN + i]
                    for d in range(3):
                        seen, behind = run[SEEN + d * RUN + i], base[row, at, d]
                        reflection[row, at, d] = seen
                        rgb[row, at, d] = behind + blended[row, at, STRENGTH_AT] * (seen - behind)
                count = 0

    return forward


def _slopes(real: type) -> Scalar:
    slopes, zero = cube_maths(real).slopes, real(0.0)

    @inlined
    def slopes_of_run(run, whole, flat, below):
        """Gradients of each pixel's place among the cells, from those of what it looks up."""
        for i in range(RUN):
            run[BY_COLUMN + i], run[BY_ROW + i] = zero, zero
        for d in range(3):
            for i in range(RUN):
                at, v = whole[FIRST + i] + d, run[V_RAW + d * RUN + i]
                under = at + below
                by_column, by_row = slopes(
                    flat[at], flat[at + 3], flat[under], flat[under + 3], run[ALONG + i], run[DOWN + i]
                )
                run[BY_COLUMN + i] += v * by_column
                run[BY_ROW + i] += v * by_row

    return slopes_of_run


def _turn(real: type) -> Scalar:
    from_face, mirrored_gradient = cube_maths(real).from_face, mirror_maths(real).gradient
    half = real(0.5)

    @inlined
    def turn(run, whole, side):
        """Gradients of the normals, in place of the normals."""
        cells_per_u = half * real(side - np.int32(2))
        for i in range(RUN):
            place = whole[AXIS + i], whole[FACE + i], run[PLACE + i], run[PLACE + RUN + i], run[PLACE + 2 * RUN + i]
            g = from_face(place, run[BY_COLUMN + i] * cells_per_u, run[BY_ROW + i] * cells_per_u)
            ray = run[RAY + i], run[RAY + RUN + i], run[RAY + 2 * RUN + i]
            normal = run[NORMAL + i], run[NORMAL + RUN + i], run[NORMAL + 2 * RUN + i]
            x, y, z = mirrored_gradient(ray, normal, g)
            run[NORMAL + i], run[NORMAL + RUN + i], run[NORMAL + 2 * RUN + i] = x, y, z

    return turn


@cache
def shade_environment_backward(real: type) -> Kernel:
    """Fills the gradients of blended, alpha and of what was looked up, and which cells each pixel blends."""
    place, slopes, turn, dot = _place(real), _slopes(real), _turn(real), vector_maths().dot
    shortest = real(NORMAL_MIN**2)
    zero, one = real(0.0), real(1.0)

    @kernel("shade_environment_backward", real)
    def backward(
        least_strength, blended, padded, intrinsics, rotation, background, base, reflection,
        v_rgb, v_base, v_reflection, v_blended, v_alpha, first_cells, fractions, v_raw,
    ):  # fmt: skip
        height, width = v_alpha.shape
        side, flat = np.int32(padded.shape[1]), padded.reshape(padded.size)
        stride = even_stride(height)
        for task in prange(height):
            row = task * stride % height
            run: NDArray[Any] = np.zeros(BACKWARD_PLANES * RUN, real)
            whole: NDArray[Any] = np.zeros(WHOLE_PLANES * RUN, np.int32)
            count = 0
            for column in range(width):
                for d in range(NORMAL_AT, blended.shape[2]):
                    v_blended[row, column, d] = zero
                normal, share = normal_of(blended, row, column), blended[row, column, STRENGTH_AT]
                bare = dot(normal, normal) <= shortest or abs(share) < least_strength
                kept, v_share, v_clear = one if bare else one - share, zero, zero
                for d in range(3):
                    v = v_rgb[row, column, d]
                    v_blended[row, column, d] = v_base[row, column, d] + v * kept
                    v_clear += v_blended[row, column, d] * background[d]
                    if not bare:
                        seen = reflection[row, column, d]
                        v_share += v * (seen - base[row, column, d])
                        v = (v * share + v_reflection[row, column, d]) * seen * (one - seen)
                        v_raw[row, column, d] = v
                        run[V_RAW + d * RUN + count] = v
                v_alpha[row, column], v_blended[row, column, STRENGTH_AT] = -v_clear, v_share
                if bare:
                    first_cells[row, column, 0] = NO_LOOKUP
                else:
                    whole[COLUMN + count] = column
                    run[NORMAL + count], run[NORMAL + RUN + count], run[NORMAL + 2 * RUN + count] = normal
                    count += 1
                if count < RUN and column < width - 1:
                    continue
                if count > 0:
                    place(run, whole, row, side, intrinsics, rotation)
                    slopes(run, whole, flat, 3 * side)
                    turn(run, whole, side)
                for i in range(count):
                    at = whole[COLUMN + i]
                    for d in range(3):
                        v_blended[row, at, NORMAL_AT + d] = run[NORMAL + d * RUN + i]
                    first_cells[row, at, 0], first_cells[row, at, 1] = whole[CELL_ROW + i], whole[CELL + i]
                    fractions[row, at, 0], fractions[row, at, 1] = run[ALONG + i], run[DOWN + i]
                count = 0

    return backward
