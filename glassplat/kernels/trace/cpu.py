"""Ray tracing on the CPU: the bounding volume hierarchy, the rays, and their gradients.

Boxes are fitted level by level, leaves first. Rays are traced in blocks of neighbours, each ray in chunks of its
nearest hits: first sixteen, which suffice for most rays, then four times as many, because every search starts at the
root of the tree. Blocks have a fixed size, independent of the number of threads.

Gradients have the same bits for any number of threads, without atomics. The hits are listed ray by ray: the forward
pass stores them for rays that have few; the others are traced again. Then every block of rays sums one row for each
Gaussian that it has hit. Finally the rows of each Gaussian are added in the order of the blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numba
import numpy as np
import torch
from numba import prange
from torch import Tensor

from glassplat.kernels.backend.cpu import Kernel, even_stride, inlined, kernel
from glassplat.kernels.maths.blending import ALPHA_MAX, TRANSMITTANCE_MIN, Scalar, build_exp2
from glassplat.kernels.maths.disc import ray_hit_maths
from glassplat.kernels.maths.harmonics import color_maths
from glassplat.kernels.records import REAL_OF, Bvh, Shapes
from glassplat.kernels.trace import reach, steps
from glassplat.kernels.trace.bvh import build_fit_leaf, hilbert_codes, level_offsets
from glassplat.kernels.trace.cpu_traversal import flat_boxes, next_hits_maths, packed_leaves
from glassplat.kernels.trace.steps import CHUNK, CONTRIBUTION_AT, FRAME_AT, GEOMETRY, OPACITY_AT, STACK, WIDTH


def build_bvh(shapes: Shapes, *, flat: bool) -> Bvh:
    """As `glassplat.kernels.trace.build_bvh`."""
    count, real = shapes.means.shape[0], REAL_OF[shapes.means.dtype]
    order = torch.argsort(hilbert_codes(shapes.means.detach()), stable=True).to(torch.int32)
    offsets = torch.tensor(level_offsets(count))
    boxes = shapes.means.new_empty(int(offsets[-1]), 6, WIDTH)
    extents = reach(shapes.opacities)
    inputs = (tensor.detach().contiguous() for tensor in (shapes.means, shapes.frames, extents, order, offsets))
    fit_boxes(real, flat)(*inputs, boxes)
    return Bvh(order, boxes, offsets)


@cache
def fit_boxes(real: type, flat: bool) -> Kernel:
    """Fills the boxes of all nodes."""
    nowhere, fit_leaf = real("inf"), build_fit_leaf(real, flat)

    @kernel("fit_boxes_discs" if flat else "fit_boxes_ellipsoids", real)
    def fit(means, frames, extents, order, offsets, boxes):
        for level in range(offsets.size - 1):
            first, last = offsets[level], offsets[level + 1]
            members = order.size if level == 0 else first - offsets[level - 1]
            for node in prange(first, last):
                for k in range(WIDTH):
                    member = (node - first) * WIDTH + k
                    for j in range(3):
                        boxes[node, j, k], boxes[node, 3 + j, k] = nowhere, -nowhere
                    if member >= members:
                        continue
                    if level > 0:
                        below = offsets[level - 1] + member
                        for j in range(3):
                            low, high = nowhere, -nowhere
                            for i in range(WIDTH):
                                low, high = min(low, boxes[below, j, i]), max(high, boxes[below, 3 + j, i])
                            boxes[node, j, k], boxes[node, 3 + j, k] = low, high
                        continue
                    fit_leaf(means, frames, extents, order[member], boxes, node, k)

    return fit


BLOCK = 64
"""Rays per task of the forward pass."""
GRADIENT_BLOCK = 256
"""Rays per task of the backward pass, which share rows of sums."""
LATER_CHUNK = 64
"""Maximum number of hits of each search after a ray's first one."""
SUM_CHUNK = 512
"""Gaussians per task of the final sum."""


def trace_gradients(
    shapes: Sequence[Tensor], rays: Sequence[Tensor], bvh: Sequence[Tensor], outputs: Sequence[Tensor],
    cotangents: Sequence[Tensor], *, flat: bool, degree: int, near: float,
) -> tuple[Tensor, ...]:  # fmt: skip
    """Gradients of means, frames, opacities, sh, origins, directions, contributions; `outputs` are those of `trace`."""
    means, sh, hits, kept = shapes[0], shapes[3], outputs[3], outputs[4]
    real, count = REAL_OF[means.dtype], means.shape[0]
    hit_offsets = torch.cat([hits.new_zeros(1, dtype=torch.int64), hits.cumsum(0)])
    # Zeros: if the second kernel rounds differently and finds fewer hits, the remaining indices must be valid.
    hit_ids = torch.zeros(int(hit_offsets[-1]), dtype=torch.int32)
    num_blocks = -(-hits.shape[0] // GRADIENT_BLOCK)
    distinct = torch.zeros(num_blocks, dtype=torch.int64)
    places = np.full((numba.get_num_threads(), 2, count), -1, np.int32)
    trace_collect(real, flat)(
        packed_leaves(shapes, bvh[0]), *rays, *flat_boxes(bvh), real(near), kept, hit_offsets, places, hit_ids, distinct
    )
    row_offsets = torch.cat([distinct.new_zeros(1), distinct.cumsum(0)])
    num_rows = int(row_offsets[-1])
    owners = torch.empty(num_rows, dtype=torch.int32)
    # Uninitialised: rows are cleared at their first use, and the allocator can reuse memory of the previous step.
    rows, sh_rows = (means.new_empty(num_rows, *shape) for shape in ((GEOMETRY,), sh.shape[1:]))
    v_rays = tuple(torch.zeros_like(ray) for ray in rays)
    places[...] = -1
    trace_backward(real, flat)(
        *shapes[:3], *rays, sh, degree, hit_offsets, hit_ids, row_offsets, places, *outputs[:3], *cotangents,
        owners, rows, sh_rows, *v_rays,
    )  # fmt: skip
    # Zeros of NumPy, because untouched pages take no memory.
    sums, v_sh = (torch.from_numpy(np.zeros((count, *shape), real)) for shape in ((GEOMETRY,), sh.shape[1:]))
    order = torch.argsort(owners, stable=True)
    offsets = torch.cat([owners.new_zeros(1, dtype=torch.int64), torch.bincount(owners, minlength=count).cumsum(0)])
    sum_block_rows(real)(rows, sh_rows, order, offsets, sums, v_sh)
    v_means, v_frames, v_opacities, v_contributions = sums.tensor_split((FRAME_AT, OPACITY_AT, CONTRIBUTION_AT), dim=1)
    return v_means, v_frames.reshape(-1, 3, 3), v_opacities[:, 0], v_sh, *v_rays, v_contributions


@cache
def trace_collect(real: type, flat: bool) -> Kernel:
    """Fills `hit_ids`, the Gaussians hit by each ray, nearest first, and the number of distinct ones in each block."""
    next_hits, ray = next_hits_maths(real, flat), steps.ray_reader(real)

    @kernel("trace_collect_discs" if flat else "trace_collect_ellipsoids", real)
    def collect(leaves, origins, directions, order, boxes, offsets, near, kept, hit_offsets, places, hit_ids, distinct):
        count, num_blocks = origins.shape[0], distinct.size
        stride = even_stride(num_blocks)
        for task in prange(num_blocks):
            block = task * stride % num_blocks
            seen = places[numba.get_thread_id(), 0]
            ts, alphas = np.empty((LATER_CHUNK,), real), np.empty((LATER_CHUNK,), real)
            ids = np.empty((LATER_CHUNK,), np.int32)
            entries, squares = np.empty((WIDTH,), real), np.empty((WIDTH,), real)
            stack, waiting = np.empty((STACK,), np.int64), np.empty((STACK,), real)
            different = 0
            for r in range(block * GRADIENT_BLOCK, min(count, (block + 1) * GRADIENT_BLOCK)):
                begin, end = hit_offsets[r], hit_offsets[r + 1]
                if end - begin <= kept.shape[1]:
                    for k in range(end - begin):
                        hit_ids[begin + k] = kept[r // BLOCK, k, r % BLOCK]
                else:
                    o, d, inverse, _, _ = ray(origins, directions, r)
                    first, first_id, place = near, 2147483647, begin
                    while place < end:
                        num_found = next_hits(
                            o, d, inverse, leaves, order, boxes, offsets, first, first_id, LATER_CHUNK,
                            ts, ids, alphas, entries, squares, stack, waiting,
                        )  # fmt: skip
                        for k in range(min(num_found, end - place)):
                            hit_ids[place + k] = ids[k]
                        first, first_id, place = ts[LATER_CHUNK - 1], ids[LATER_CHUNK - 1], place + LATER_CHUNK
                for place in range(begin, end):
                    g = hit_ids[place]
                    if seen[g] != block:
                        seen[g] = block
                        different += 1
            distinct[block] = different

    return collect


def _hit_gradients(real: type, flat: bool) -> Scalar:
    """Builds the step that adds one hit's gradients to its Gaussian's row and to its ray."""
    (_, intersect_gradient), half, most = ray_hit_maths(real, flat), real(0.5), real(ALPHA_MAX)
    zero = real(0.0)

    @inlined
    def add_gradients(offset, d, frame, hit, opacity, v_alpha, v_t, row, v_origin, v_direction):
        t, q, covered = hit
        v_covered = v_alpha if covered < most else zero
        row[OPACITY_AT] += v_covered * covered / opacity
        v_o, v_d, v_frame = intersect_gradient(offset, d, frame, t, q, v_t, -half * covered * v_covered)
        for j in range(3):
            row[j] -= v_o[j]
            row[FRAME_AT + j] += v_frame[0][j]
            row[FRAME_AT + 3 + j] += v_frame[1][j]
            row[FRAME_AT + 6 + j] += v_frame[2][j]
            v_origin[j] += v_o[j]
            v_direction[j] += v_d[j]

    return add_gradients


@cache
def trace_backward(real: type, flat: bool) -> Kernel:
    """Fills each block's rows and their owners, and the gradients, initially zero, of the rays."""
    coverage, add_gradients = steps.coverage_maths(real, build_exp2(real)), _hit_gradients(real, flat)
    (intersect, _), hit_color_gradient = ray_hit_maths(real, flat), steps.color_backward(real)
    zero, half, one, nowhere = real(0.0), real(0.5), real(1.0), real("inf")

    @kernel("trace_backward_discs" if flat else "trace_backward_ellipsoids", real)
    def backward(
        means, frames, opacities, origins, directions, sh, degree, hit_offsets, hit_ids, row_offsets, places,
        colors, alphas, depths, v_colors, v_alphas, v_depths, owners, rows, sh_rows, v_origins, v_directions,
    ):  # fmt: skip
        count, num_blocks = origins.shape[0], row_offsets.size - 1
        stride = even_stride(num_blocks)
        for task in prange(num_blocks):
            block = task * stride % num_blocks
            seen, own = places[numba.get_thread_id(), 0], places[numba.get_thread_id(), 1]
            free = row_offsets[block]
            unit, v_unit = np.empty((3,), real), np.empty((3,), real)
            for r in range(block * GRADIENT_BLOCK, min(count, (block + 1) * GRADIENT_BLOCK)):
                o = origins[r, 0], origins[r, 1], origins[r, 2]
                d = directions[r, 0], directions[r, 1], directions[r, 2]
                length = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]) ** half
                # Gradient-weighted sum of the remaining hits, initially of all.
                behind = v_depths[r] * depths[r]
                for j in range(3):
                    unit[j], v_unit[j] = d[j] / length, zero
                    behind += v_colors[r, j] * colors[r, j]
                left, end, v_length = one, v_alphas[r] * (one - alphas[r]), zero
                for place in range(hit_offsets[r], hit_offsets[r + 1]):
                    g = hit_ids[place]
                    if seen[g] != block:
                        seen[g], own[g], owners[free] = block, free, g
                        rows[free] = zero
                        sh_rows[free] = zero
                        free += 1
                    row = own[g]
                    offset, frame = steps.shape_of(means, frames, g, o)
                    t, q, squared = intersect(offset, d, frame)
                    # At a threshold, a hit of the search may be missed here because of different rounding.
                    if not t < nowhere:
                        continue
                    covered, alpha = coverage(opacities[g], squared)
                    weight = alpha * left
                    value = zero
                    if degree >= 0:
                        own_sh, v_sh = sh[g : g + 1], sh_rows[row : row + 1]
                        value, by_unit = hit_color_gradient(own_sh, degree, unit, v_colors, r, weight, v_sh)
                        for j in range(3):
                            v_unit[j] += by_unit[j]
                    distance = t * length
                    value += v_depths[r] * distance
                    behind -= weight * value
                    rows[row, CONTRIBUTION_AT] += weight
                    rows[row, CONTRIBUTION_AT + 1] += weight * distance
                    v_alpha, v_t = left * value + (end - behind) / (one - alpha), weight * v_depths[r]
                    v_length += v_t * t
                    add_gradients(
                        offset, d, frame, (t, q, covered), opacities[g], v_alpha, v_t * length, rows[row],
                        v_origins[r], v_directions[r],
                    )  # fmt: skip
                    left *= one - alpha
                if hit_offsets[r] < hit_offsets[r + 1]:
                    along = unit[0] * v_unit[0] + unit[1] * v_unit[1] + unit[2] * v_unit[2]
                    for j in range(3):
                        v_directions[r, j] += v_length * unit[j] + (v_unit[j] - unit[j] * along) / length

    return backward


@cache
def sum_block_rows(real: type) -> Kernel:
    """Sums each Gaussian's rows."""

    @kernel("trace_sum_rows", real)
    def total(rows, sh_rows, order, offsets, sums, sh_sums):
        count = offsets.size - 1
        num_chunks = (count + SUM_CHUNK - 1) // SUM_CHUNK
        for chunk in prange(num_chunks):
            for g in range(chunk * SUM_CHUNK, min(count, (chunk + 1) * SUM_CHUNK)):
                for k in range(offsets[g], offsets[g + 1]):
                    row = order[k]
                    for j in range(rows.shape[1]):
                        sums[g, j] += rows[row, j]
                    for i in range(sh_rows.shape[1]):
                        for j in range(3):
                            sh_sums[g, i, j] += sh_rows[row, i, j]

    return total


MOST_KEPT, KEPT_BYTES = 256, 2**27
"""Maximum number of hits per ray stored by the forward pass, and bytes for all rays, most of them never touched."""


def trace(
    shapes: Sequence[Tensor], rays: Sequence[Tensor], bvh: Sequence[Tensor],
    *, flat: bool, degree: int, near: float, needs_gradients: bool,
) -> tuple[Tensor, ...]:  # fmt: skip
    """Fields of `Traced`, and each ray's nearest Gaussians [blocks, K, BLOCK] int32 for its gradients.

    Degree -1 skips colours.
    """
    origins = rays[0]
    count, real = origins.shape[0], REAL_OF[origins.dtype]
    num_kept = min(MOST_KEPT, KEPT_BYTES // (4 * max(count, 1))) if needs_gradients else 0
    outputs = (
        origins.new_empty(count, 3),
        origins.new_empty(count),
        origins.new_empty(count),
        torch.empty(count, dtype=torch.int32),
        torch.empty(-(-count // BLOCK), num_kept, BLOCK, dtype=torch.int32),
    )
    leaves = packed_leaves(shapes, bvh[0])
    trace_forward(real, flat)(leaves, shapes[3], *rays, *flat_boxes(bvh), degree, real(near), *outputs)
    return outputs


@cache
def trace_forward(real: type, flat: bool) -> Kernel:
    """Fills colors, alphas, depths and hits, and lists the nearest Gaussians."""
    next_hits, ray = next_hits_maths(real, flat), steps.ray_reader(real)
    color, _ = color_maths(real)
    zero, half, one, least = real(0.0), real(0.5), real(1.0), real(TRANSMITTANCE_MIN)

    @kernel("trace_forward_discs" if flat else "trace_forward_ellipsoids", real)
    def forward(
        leaves, sh, origins, directions, order, boxes, offsets, degree, near,
        colors, alphas, depths, hits, kept,
    ):  # fmt: skip
        count = origins.shape[0]
        num_blocks = (count + BLOCK - 1) // BLOCK
        stride = even_stride(num_blocks)
        for task in prange(num_blocks):
            block = task * stride % num_blocks
            ts, found = np.empty((LATER_CHUNK,), real), np.empty((LATER_CHUNK,), real)
            ids = np.empty((LATER_CHUNK,), np.int32)
            entries, squares = np.empty((WIDTH,), real), np.empty((WIDTH,), real)
            stack, waiting = np.empty((STACK,), np.int64), np.empty((STACK,), real)
            for r in range(block * BLOCK, min(count, (block + 1) * BLOCK)):
                o, d, inverse, length, usable = ray(origins, directions, r)
                red = green = blue = depth = zero
                left, blended = one, 0
                first, first_id, most, ended = near, 2147483647, CHUNK, not usable
                while not ended:
                    num_found = next_hits(
                        o, d, inverse, leaves, order, boxes, offsets, first, first_id, most,
                        ts, ids, found, entries, squares, stack, waiting,
                    )  # fmt: skip
                    ended = num_found < most
                    for k in range(num_found):
                        after = left * (one - found[k])
                        if after < least:
                            ended = True
                            break
                        g, weight = ids[k], found[k] * left
                        if blended < kept.shape[1]:
                            kept[block, blended, r - block * BLOCK] = g
                        if degree >= 0:
                            x, y, z = d[0] / length, d[1] / length, d[2] / length
                            c = color(sh, g, degree, x, y, z)
                            red += weight * max(c[0] + half, zero)
                            green += weight * max(c[1] + half, zero)
                            blue += weight * max(c[2] + half, zero)
                        depth += weight * (ts[k] * length)
                        left, blended = after, blended + 1
                    first, first_id, most = ts[most - 1], ids[most - 1], LATER_CHUNK
                colors[r, 0], colors[r, 1], colors[r, 2] = red, green, blue
                alphas[r], depths[r], hits[r] = one - left, depth, blended

    return forward
