"""Reflective surfaces on the CPU: channels, cube maps, deferred shading.

Channels are filled one Gaussian at a time, and cube maps read one direction at a time. Gradients of texels are summed
in an order that does not depend on the number of threads: lookups are sorted by the row of their first cell. Each row
is then one task, which sums the contributions of those lookups to the row and to the next one, in index order and in
memory of its own.

Deferred shading processes runs of pixels of one image row that have a normal and reflect. A run is stored in *planes*
of one flat buffer, one plane per quantity. Their offsets are known to the compiler, so that it can vectorise the lookup
and the sigmoid.
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

from glassplat.kernels.backend.cpu import ZERO, Kernel, even_stride, inlined, kernel
from glassplat.kernels.maths import cube
from glassplat.kernels.maths.blending import Scalar
from glassplat.kernels.maths.projection import dot
from glassplat.kernels.maths.surface import surface_maths
from glassplat.kernels.records import NORMAL_AT, NORMAL_MIN, REAL_OF, STRENGTH_AT, SURFACE_CHANNELS, Shaded


def surface_channels(inputs: Sequence[Tensor]) -> Tensor:
    """See `glassplat.kernels.environment.surface_channels`; inputs in its order."""
    colors, extra = inputs[0], inputs[-1]
    channels = colors.new_empty(colors.shape[0], SURFACE_CHANNELS + extra.shape[1])
    surface_channels_forward(REAL_OF[colors.dtype])(*inputs, channels)
    return channels


def surface_channels_gradients(saved: Sequence[Tensor], v_channels: Tensor) -> tuple[Tensor, ...]:
    """Gradients of colors, quats, logit strengths and extra, given radii, quats, log scales and channels."""
    found = gradients_like(v_channels)
    surface_channels_backward(REAL_OF[v_channels.dtype])(*saved, v_channels, *found)
    return found


def gradients_like(v_channels: Tensor) -> tuple[Tensor, ...]:
    """Uninitialised tensors for the gradients of colors, quats, logit strengths and extra."""
    count, width = v_channels.shape
    shapes = (count, 3), (count, 4), (count,), (count, width - SURFACE_CHANNELS)
    return tuple(torch.empty(shape, dtype=v_channels.dtype, device=v_channels.device) for shape in shapes)


@cache
def surface_channels_forward(real: type) -> Kernel:
    """Fills the channels."""
    (describe, _), zero = surface_maths(real), real(0.0)

    @kernel("surface_channels_forward", real)
    def forward(colors, radii, quats, log_scales, means, logit_strengths, camera_center, extra, channels):
        for i in prange(radii.shape[0]):
            if radii[i, 0] > zero:
                describe(i, colors, quats, log_scales, means, logit_strengths, camera_center, extra, channels)
            else:
                channels[i] = zero

    return forward


@cache
def surface_channels_backward(real: type) -> Kernel:
    """Fills the gradients."""
    (_, describe_gradient), zero = surface_maths(real), real(0.0)

    @kernel("surface_channels_backward", real)
    def backward(
        radii, quats, log_scales, channels, v_channels, v_colors, v_quats, v_logit_strengths, v_extra
    ):  # fmt: skip
        for i in prange(radii.shape[0]):
            if radii[i, 0] > zero:
                describe_gradient(
                    i, quats, log_scales, channels, v_channels, v_colors, v_quats, v_logit_strengths, v_extra
                )
            else:
                v_colors[i], v_quats[i], v_extra[i] = zero, zero, zero
                v_logit_strengths[i] = zero

    return backward


NO_LOOKUP = np.int32(-1)
"""First cell of a pixel without a lookup."""


def padded_faces(texels: Tensor) -> Tensor:
    """Faces [6, S + 2, S + 2, D] with a ring of their neighbours' texels, as in the reference."""
    size, depth = texels.shape[1], texels.shape[3]
    padded = texels.new_empty(6, size + 2, size + 2, depth)
    pad_faces(REAL_OF[texels.dtype])(texels, padded)
    return padded


def texel_gradients(first_cells: Tensor, fractions: Tensor, gradients: Tensor, size: int) -> Tensor:
    """Gradient [6, S, S, D] of the texels.

    Args:
        first_cells: [P, 2] int32 row, counted through all faces, and column of the first of the four cells that each
            lookup blends; the row is `NO_LOOKUP` where there was none.
        fractions: [P, 2] of the way to the next column and to the next row.
        gradients: [P, D] gradient of each lookup's result.
        size: texels along the side of a face, S.
    """
    real, side, depth = REAL_OF[gradients.dtype], size + 2, gradients.shape[1]
    starts = torch.zeros(6 * side + 1, dtype=torch.int64)
    order = torch.empty(first_cells.shape[0], dtype=torch.int32)
    sort_lookups(real)(first_cells, starts, order)
    rows = gradients.new_empty(6 * side, 2, side * depth)
    sum_lookups(real)(first_cells, fractions, gradients, starts, order, rows)
    texels = gradients.new_empty(6, size, size, depth)
    fold_faces(real)(rows.view(6, side, 2, side, depth), texels)
    return texels


@cache
def pad_faces(real: type) -> Kernel:
    """Fills padded faces from texels."""
    third = real(1.0 / 3.0)

    @kernel("cube_pad_faces", real)
    def pad(texels, padded):
        size, depth = texels.shape[1], texels.shape[3]
        rows = texels.reshape(6, size, size * depth)
        padded_rows = padded.reshape(6, size + 2, (size + 2) * depth)
        for task in prange(6 * (size + 2)):
            face, row = task // (size + 2), task % (size + 2) - 1
            low, outside = 1 if row < 0 else 0, row < 0 or row == size
            inner = min(max(row, 0), size - 1)
            target = padded[face, row + 1]
            if outside:
                for column in range(size):
                    f, r, c = cube.over_row(face, low, column, size)
                    for d in range(depth):
                        target[column + 1, d] = texels[f, r, c, d]
            else:
                # Everything but the ring is copied in long runs.
                copied, to = rows[face, row], padded_rows[face, row + 1, depth : (size + 1) * depth]
                for i in range(to.size):
                    to[i] = copied[i]
            for side in range(2):
                column, cell = (size - 1, size + 1) if side == 0 else (0, 0)
                f, r, c = cube.over_column(face, side, inner, size)
                g, s, e = cube.over_row(face, low, column, size)
                for d in range(depth):
                    beside = texels[f, r, c, d]
                    target[cell, d] = (
                        (texels[face, inner, column, d] + beside + texels[g, s, e, d]) * third if outside else beside
                    )

    return pad


@cache
def sort_lookups(real: type) -> Kernel:
    """Fills the order of the lookups, without empty ones, and the start of each row of cells in it."""

    @kernel("cube_sort_lookups", real, parallel=False)
    def sort(first_cells, starts, order):
        for lookup in range(order.size):
            row = first_cells[lookup, 0]
            if row >= 0:
                starts[row + 1] += 1
        for row in range(starts.size - 1):
            starts[row + 1] += starts[row]
        # Filling moves each row's start to its end, which is the start of the next row.
        for lookup in range(order.size):
            row = first_cells[lookup, 0]
            if row >= 0:
                order[starts[row]] = lookup
                starts[row] += 1
        for row in range(starts.size - 1, 0, -1):
            starts[row] = starts[row - 1]
        starts[0] = 0

    return sort


@cache
def sum_lookups(real: type) -> Kernel:
    """Fills rows of cells [R, 2, floats] with the sums that lookups starting in a row add to it and to the next one."""
    zero, one = real(0.0), real(1.0)

    @kernel("cube_sum_lookups", real)
    def add(first_cells, fractions, gradients, starts, order, rows):
        depth = gradients.shape[1]
        stride = even_stride(rows.shape[0])
        for task in prange(rows.shape[0]):
            row = task * stride % rows.shape[0]
            here, below = rows[row, 0], rows[row, 1]
            here[:], below[:] = zero, zero
            for position in range(starts[row], starts[row + 1]):
                lookup = order[position]
                along, down = fractions[lookup, 0], fractions[lookup, 1]
                at = first_cells[lookup, 1] * depth
                for d in range(depth):
                    upper, lower = (one - down) * gradients[lookup, d], down * gradients[lookup, d]
                    here[at + d] += (one - along) * upper
                    here[at + depth + d] += along * upper
                    below[at + d] += (one - along) * lower
                    below[at + depth + d] += along * lower

    return add


@cache
def fold_faces(real: type) -> Kernel:
    """Fills the gradient of the texels from sums [6, S + 2, 2, S + 2, D], the transpose of `pad_faces`."""
    third = real(1.0 / 3.0)

    @inlined
    def cell(sums, face, row, column, d):
        """The gradient of a cell, including lookups that start in the row before."""
        found = sums[face, row, 0, column, d]
        return found + sums[face, row - 1, 1, column, d] if row > 0 else found

    @kernel("cube_fold_faces", real)
    def fold(sums, texels):
        size, depth = texels.shape[1], texels.shape[3]
        for task in prange(6 * size):
            face, row = task // size, task % size
            for column in range(size):
                for d in range(depth):
                    texels[face, row, column, d] = cell(sums, face, row + 1, column + 1, d)
        for face in range(6):
            for side in range(2):
                outer, inner = (size + 1, size - 1) if side == 0 else (0, 0)
                for i in range(size):
                    f, r, c = cube.over_column(face, side, i, size)
                    g, s, e = cube.over_row(face, side, i, size)
                    for d in range(depth):
                        texels[f, r, c, d] += cell(sums, face, i + 1, outer, d)
                        texels[g, s, e, d] += cell(sums, face, outer, i + 1, d)
                for other in range(2):
                    outer_row, inner_row = (size + 1, size - 1) if other == 0 else (0, 0)
                    f, r, c = cube.over_column(face, side, inner_row, size)
                    g, s, e = cube.over_row(face, other, inner, size)
                    for d in range(depth):
                        share = cell(sums, face, outer_row, outer, d) * third
                        texels[face, inner_row, inner, d] += share
                        texels[f, r, c, d] += share
                        texels[g, s, e, d] += share

    return fold


def cube_lookup(texels: Tensor, directions: Tensor) -> Tensor:
    """Look up texels [6, S, S, D] in directions [P, 3], as [P, D]."""
    found = texels.new_empty(directions.shape[0], texels.shape[3])
    cube_lookup_forward(REAL_OF[texels.dtype])(padded_faces(texels), directions, found)
    return found


def cube_lookup_gradients(texels: Tensor, directions: Tensor, cotangents: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of texels and directions."""
    v_directions = torch.empty_like(directions)
    first_cells = torch.empty(directions.shape[0], 2, dtype=torch.int32)
    fractions = directions.new_empty(directions.shape[0], 2)
    inputs = (padded_faces(texels), directions, cotangents)
    cube_lookup_backward(REAL_OF[texels.dtype])(*inputs, v_directions, first_cells, fractions)
    return texel_gradients(first_cells, fractions, cotangents, texels.shape[1]), v_directions


@cache
def cube_lookup_forward(real: type) -> Kernel:
    """Fills the lookups in padded faces."""
    look_up, _ = cube.lookup_maths(real)

    @kernel("cube_lookup_forward", real)
    def forward(padded, directions, found):
        for i in prange(directions.shape[0]):
            look_up(i, padded, directions, found)

    return forward


@cache
def cube_lookup_backward(real: type) -> Kernel:
    """Fills the gradients of the directions, and the cells and fractions of each lookup."""
    _, look_up_gradient = cube.lookup_maths(real)

    @kernel("cube_lookup_backward", real)
    def backward(padded, directions, v_found, v_directions, first_cells, fractions):
        for i in prange(directions.shape[0]):
            first_cells[i, 0], first_cells[i, 1] = look_up_gradient(
                i, padded, directions, v_found, v_directions, fractions
            )

    return backward


RUN = 32
"""Pixels of a run."""

# Planes of a run: floats, then integers. Entries that a run does not fill are stale and not read.
NORMAL, RAY, PLACE, ALONG, DOWN, SEEN = (plane * RUN for plane in (0, 3, 6, 9, 10, 11))
FORWARD_PLANES = 14
V_RAW, BY_COLUMN, BY_ROW = (plane * RUN for plane in (14, 17, 18))
BACKWARD_PLANES = 19
COLUMN, AXIS, FACE, CELL_ROW, CELL, FIRST = (plane * RUN for plane in range(6))
WHOLE_PLANES = 6


def shade_environment(inputs: Sequence[Tensor], least_strength: float) -> Shaded:
    """See `glassplat.kernels.environment.shade_environment`; inputs in the order of the kernel."""
    blended, alpha, texels, *rest = inputs
    real = REAL_OF[blended.dtype]
    shaded = Shaded(*(alpha.new_empty(*alpha.shape, 3) for _ in range(3)))
    shade_environment_forward(real)(real(least_strength), blended, alpha, padded_faces(texels), *rest, *shaded)
    return shaded


def shade_environment_gradients(
    inputs: Sequence[Tensor], least_strength: float, found: Sequence[Tensor], cotangents: Sequence[Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of blended, alpha and texels, given base and reflection of the forward pass."""
    blended, alpha, texels, *rest = inputs
    real = REAL_OF[blended.dtype]
    v_blended, v_alpha = torch.empty_like(blended), torch.empty_like(alpha)
    first_cells = torch.empty(*alpha.shape, 2, dtype=torch.int32)
    fractions, v_raw = alpha.new_empty(*alpha.shape, 2), alpha.new_empty(*alpha.shape, 3)
    lookups = (first_cells, fractions, v_raw)
    inputs = (blended, padded_faces(texels), *rest, *found, *cotangents)
    shade_environment_backward(real)(real(least_strength), *inputs, v_blended, v_alpha, *lookups)
    first_cells, fractions, v_raw = (tensor.flatten(0, 1) for tensor in lookups)
    return v_blended, v_alpha, texel_gradients(first_cells, fractions, v_raw, texels.shape[1])


@inlined
def normal_of(blended, row, column):
    """The blended normal of a pixel."""
    return blended[row, column, NORMAL_AT], blended[row, column, NORMAL_AT + 1], blended[row, column, NORMAL_AT + 2]


def _cube_positions(real: type) -> Scalar:
    cell, one, half = cube.build_cell(real), real(1.0), real(0.5)

    @inlined
    def cube_positions(run, whole, row, side, intrinsics, rotation):
        """Positions on the cube that the pixels of a run reflect."""
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
            to = cube.mirror_ray(ray, normal)
            axis, face, u, v, inverse = cube.on_face(to[0], to[1], to[2])
            left, along = cell(u, size)
            top, down = cell(v, size)
            run[RAY + i], run[RAY + RUN + i], run[RAY + 2 * RUN + i] = ray
            run[PLACE + i], run[PLACE + RUN + i], run[PLACE + 2 * RUN + i] = u, v, inverse
            run[ALONG + i], run[DOWN + i] = along, down
            whole[AXIS + i], whole[FACE + i] = axis, face
            cell_row = face * side + top
            whole[CELL_ROW + i], whole[CELL + i] = cell_row, left
            whole[FIRST + i] = (cell_row * side + left) * np.int32(3)

    return cube_positions


@cache
def shade_environment_forward(real: type) -> Kernel:
    """Fills rgb, base and reflection."""
    logistic, cube_positions = cube.build_logistic(real), _cube_positions(real)
    shortest, zero, one = real(NORMAL_MIN**2), real(0.0), real(1.0)

    @inlined
    def sample_cube(run, whole, flat, below):
        """The colour that each pixel of a run reflects; `below` is the offset of the next row of cells."""
        for d in range(3):
            for i in range(RUN):
                at, along, down = whole[FIRST + i] + d, run[ALONG + i], run[DOWN + i]
                under = at + below
                run[SEEN + d * RUN + i] = cube.bilinear(
                    flat[at], flat[at + 3], flat[under], flat[under + 3], along, down
                )
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
                    cube_positions(run, whole, row, side, intrinsics, rotation)
                    sample_cube(run, whole, flat, 3 * side)
                for i in range(count):
                    at = whole[COLUMN + i]
                    for d in range(3):
                        seen, behind = run[SEEN + d * RUN + i], base[row, at, d]
                        reflection[row, at, d] = seen
                        rgb[row, at, d] = behind + blended[row, at, STRENGTH_AT] * (seen - behind)
                count = 0

    return forward


@inlined
def position_gradients(run, whole, flat, below):
    """Gradients of each pixel's position among the cells, from those of its lookup."""
    for i in range(RUN):
        run[BY_COLUMN + i], run[BY_ROW + i] = ZERO, ZERO
    for d in range(3):
        for i in range(RUN):
            at, v = whole[FIRST + i] + d, run[V_RAW + d * RUN + i]
            under = at + below
            by_column, by_row = cube.bilinear_gradient(
                flat[at], flat[at + 3], flat[under], flat[under + 3], run[ALONG + i], run[DOWN + i]
            )
            run[BY_COLUMN + i] += v * by_column
            run[BY_ROW + i] += v * by_row


def _normal_gradients(real: type) -> Scalar:
    half = real(0.5)

    @inlined
    def normal_gradients(run, whole, side):
        """Replaces the normals by their gradients."""
        cells_per_u = half * real(side - np.int32(2))
        for i in range(RUN):
            position = whole[AXIS + i], whole[FACE + i], run[PLACE + i], run[PLACE + RUN + i], run[PLACE + 2 * RUN + i]
            g = cube.from_face(position, run[BY_COLUMN + i] * cells_per_u, run[BY_ROW + i] * cells_per_u)
            ray = run[RAY + i], run[RAY + RUN + i], run[RAY + 2 * RUN + i]
            normal = run[NORMAL + i], run[NORMAL + RUN + i], run[NORMAL + 2 * RUN + i]
            x, y, z = cube.mirrored_gradient(ray, normal, g)
            run[NORMAL + i], run[NORMAL + RUN + i], run[NORMAL + 2 * RUN + i] = x, y, z

    return normal_gradients


@cache
def shade_environment_backward(real: type) -> Kernel:
    """Fills the gradients of blended, alpha and the lookups, and the cells and fractions of each pixel."""
    cube_positions, normal_gradients, shortest = _cube_positions(real), _normal_gradients(real), real(NORMAL_MIN**2)
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
                    cube_positions(run, whole, row, side, intrinsics, rotation)
                    position_gradients(run, whole, flat, 3 * side)
                    normal_gradients(run, whole, side)
                for i in range(count):
                    at = whole[COLUMN + i]
                    for d in range(3):
                        v_blended[row, at, NORMAL_AT + d] = run[NORMAL + d * RUN + i]
                    first_cells[row, at, 0], first_cells[row, at, 1] = whole[CELL_ROW + i], whole[CELL + i]
                    fractions[row, at, 0], fractions[row, at, 1] = run[ALONG + i], run[DOWN + i]
                count = 0

    return backward
