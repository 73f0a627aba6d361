"""Ray tracing on the GPU: the bounding volume hierarchy, one thread per ray, and the gradients.

To build the hierarchy, torch sorts, and each level is one launch; there is no synchronisation. A ray's next hits are
found by the search of `cpu_traversal`, in chunks of the nearest.

Gradients have the same bits every time, without atomics. The hits are listed ray by ray. One thread per ray traverses
its hits front to back, sums the ray's own gradients, and stores two numbers per hit. Then hits are sorted by Gaussian.
One warp per Gaussian computes the gradients from its hits, 32 at a time, and sums them in the order of the rays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from numba import cuda
from torch import Tensor

from glassplat.kernels.backend.cpu import ZERO, inlined
from glassplat.kernels.backend.cuda import Kernel, kernel
from glassplat.kernels.maths.blending import ALPHA_MAX, TRANSMITTANCE_MIN, Scalar
from glassplat.kernels.maths.disc import ray_hit_maths
from glassplat.kernels.maths.fast_maths import exp2_maths
from glassplat.kernels.maths.harmonics import MAX_DEGREE, color_maths
from glassplat.kernels.records import REAL_OF, Bvh, Shapes
from glassplat.kernels.trace import reach, steps
from glassplat.kernels.trace.bvh import build_fit_leaf, curve_cells, curve_position, level_offsets
from glassplat.kernels.trace.steps import CHUNK, FRAME_AT, GEOMETRY, LEVEL_BITS, NODE, OPACITY_AT, STACK, WIDTH

MOST_KEPT, KEPT_BYTES = 64, 2**28
"""Maximum number of hits per ray stored by the forward pass, and bytes for all rays."""


def build_bvh(shapes: Shapes, *, flat: bool) -> Bvh:
    """As `glassplat.kernels.trace.cpu.build_bvh`."""
    means, frames = (tensor.detach().contiguous() for tensor in shapes[:2])
    count, real = means.shape[0], REAL_OF[means.dtype]
    order = torch.argsort(hilbert_codes(means), stable=True).to(torch.int32)
    offsets = level_offsets(count)
    boxes = means.new_empty(offsets[-1], 6, WIDTH)
    extents = reach(shapes.opacities.detach())
    leaves = offsets[1] if count else 0
    fit_leaves(real, flat).over(leaves * WIDTH, means, frames, extents, order, boxes)
    for below, (first, last) in zip(offsets, pairwise(offsets[1:]), strict=False):
        fit_level(real).over((last - first) * WIDTH, below, first, last, boxes)
    return Bvh(order, boxes, _on_device(offsets, means.device))


def _on_device(numbers: list[int], device: torch.device) -> Tensor:
    """A short list of integers as a tensor, filled one by one: a copy from host memory would synchronise."""
    found = torch.empty(len(numbers), dtype=torch.int64, device=device)
    for place, number in enumerate(numbers):
        found[place : place + 1].fill_(number)
    return found


def hilbert_codes(points: Tensor) -> Tensor:
    """As `glassplat.kernels.trace.bvh.hilbert_codes`."""
    cells, finite = curve_cells(points)
    positions = torch.empty(len(points), dtype=torch.int64, device=points.device)
    hilbert_positions().over(len(points), cells, positions)
    return torch.where(finite, positions, torch.iinfo(torch.int64).max)


@cache
def hilbert_positions(key: type = np.int64) -> Kernel:
    """Fills the positions of cells along the curve."""

    @kernel("hilbert_positions", key, "long2 long1")
    def fill(cells, positions):
        i = cuda.grid(1)
        if i < positions.size:
            positions[i] = curve_position(cells[i, 0], cells[i, 1], cells[i, 2])

    return fill


@cache
def fit_leaves(real: type, flat: bool) -> Kernel:
    """Fills the boxes of the leaves, one thread per Gaussian and per unused position."""
    nowhere, fit_leaf = real("inf"), build_fit_leaf(real, flat)

    @kernel("fit_leaves_discs" if flat else "fit_leaves_ellipsoids", real, "real2 real3 real1 int1 real3")
    def fit(means, frames, extents, order, boxes):
        i = cuda.grid(1)
        node, k = i // WIDTH, i % WIDTH
        if node * WIDTH >= order.size:
            return
        for j in range(3):
            boxes[node, j, k], boxes[node, 3 + j, k] = nowhere, -nowhere
        if i < order.size:
            fit_leaf(means, frames, extents, order[i], boxes, node, k)

    return fit


@cache
def fit_level(real: type) -> Kernel:
    """Fills the boxes of a level from those of the level below, which spans nodes `below` to `first` (exclusive)."""
    nowhere = real("inf")

    @kernel("fit_level", real, "long long long real3")
    def fit(below, first, last, boxes):
        i = cuda.grid(1)
        node, k = first + i // WIDTH, i % WIDTH
        if node >= last:
            return
        member = below + i
        for j in range(3):
            low, high = nowhere, -nowhere
            if member < first:
                for c in range(WIDTH):
                    low, high = min(low, boxes[member, j, c]), max(high, boxes[member, 3 + j, c])
            boxes[node, j, k], boxes[node, 3 + j, k] = low, high

    return fit


@inlined
def enter(boxes, at, o, inverse, first, last):
    """Distances at which a ray enters and leaves a box, within two bounds; it hits the box if they are in order."""
    # Faces are chosen by the sign of the direction, so that rays miss empty boxes (minimum above maximum).
    low, high = at, at + 3 * WIDTH
    x0, x1 = (low, high) if inverse[0] > ZERO else (high, low)
    y0, y1 = (low, high) if inverse[1] > ZERO else (high, low)
    z0, z1 = (low, high) if inverse[2] > ZERO else (high, low)
    x, y = (boxes[x0] - o[0]) * inverse[0], (boxes[y0 + WIDTH] - o[1]) * inverse[1]
    near = max(x, y, (boxes[z0 + 2 * WIDTH] - o[2]) * inverse[2], first)
    x, y = (boxes[x1] - o[0]) * inverse[0], (boxes[y1 + WIDTH] - o[1]) * inverse[1]
    return near, min(x, y, (boxes[z1 + 2 * WIDTH] - o[2]) * inverse[2], last)


def next_hits_maths(real: type, flat: bool) -> Scalar:
    """Builds `next_hits`, which fills (ts, ids, alphas) with a ray's next hits and returns their number."""
    (intersect, _), coverage = ray_hit_maths(real, flat), steps.coverage_maths(real, exp2_maths(real))
    zero, nowhere, sooner, later = real(0.0), real("inf"), real(1.0 - steps.SLACK), real(1.0 + steps.SLACK)

    @inlined
    def next_hits(
        o, d, inverse, means, frames, opacities, order, boxes, offsets, first, first_id, ts, ids, alphas,
        stack, waiting,
    ):  # fmt: skip
        count, top = 0, 0
        farthest, farthest_id = nowhere, 2147483647
        if boxes.size > 0:
            stack[0], waiting[0] = ((boxes.size // NODE - 1) << LEVEL_BITS) | (offsets.size - 2), zero
            top = 1
        while top > 0:
            top -= 1
            if waiting[top] * sooner > farthest:
                continue
            level, node = stack[top] & ((1 << LEVEL_BITS) - 1), stack[top] >> LEVEL_BITS
            child, begin = (node - offsets[level]) * WIDTH, top
            if level > 0:
                child += offsets[level - 1]
            for k in range(WIDTH):
                enters, leaves = enter(boxes, node * NODE + k, o, inverse, first, farthest)
                if not enters * sooner <= leaves * later:
                    continue
                if level > 0:
                    place = top
                    # Nearest last, so that it is popped first.
                    while place > begin and waiting[place - 1] < enters:
                        stack[place], waiting[place] = stack[place - 1], waiting[place - 1]
                        place -= 1
                    stack[place], waiting[place] = ((child + k) << LEVEL_BITS) | (level - 1), enters
                    top += 1
                    continue
                g = order[child + k]
                offset, frame = steps.shape_of(means, frames, g, o)
                t, _, squared = intersect(offset, d, frame)
                if not (t > first or (t == first and g > first_id)):
                    continue
                if not (t < farthest or (t == farthest and g < farthest_id)):
                    continue
                _, alpha = coverage(opacities[g], squared)
                if alpha > zero:
                    count = steps.insert(ts, ids, alphas, count, CHUNK, t, g, alpha)
                    if count == CHUNK:
                        farthest, farthest_id = ts[CHUNK - 1], ids[CHUNK - 1]
        return count

    return next_hits


WARP = 32
HARMONICS = (MAX_DEGREE + 1) ** 2
STRIDE = HARMONICS + 1
"""Stride of shared rows of harmonics, odd like `GEOMETRY`: lanes that write a column access different banks."""


class Hits(NamedTuple):
    """Hits of rays, ray by ray, nearest first.

    offsets [R + 1] int64: start of each ray's hits.
    hit_ids, rays [H] int32: the Gaussian and the ray of a hit.
    alphas, weights [H]: its coverage and its blending weight.
    v_squares [H]: gradient of the loss with respect to its squared distance in standard deviations.
    """

    offsets: Tensor
    hit_ids: Tensor
    rays: Tensor
    alphas: Tensor
    weights: Tensor
    v_squares: Tensor


@cache
def trace_ray_gradients(real: type, flat: bool) -> Kernel:
    """Fills rays, weights and v_squares of hits, and the gradients of origins and directions, zero without hits."""
    ray, hit_color_gradient = steps.ray_reader(real), steps.color_backward(real)
    intersect, intersect_gradient = ray_hit_maths(real, flat)
    zero, half, one, most, nowhere = real(0.0), real(0.5), real(1.0), real(ALPHA_MAX), real("inf")

    @kernel(
        "trace_gradients_of_rays_discs" if flat else "trace_gradients_of_rays_ellipsoids",
        real,
        "real2 real3 real3 real2 real2 int long1 int1 int1 real1 real1 real1 "
        "real2 real1 real1 real2 real1 real1 real2 real2",
    )
    def ray_gradients(
        means, frames, sh, origins, directions, degree, starts, hit_ids, hit_rays, hit_alphas, weights, v_squares,
        colors, alphas, depths, v_colors, v_alphas, v_depths, v_origins, v_directions,
    ):  # fmt: skip
        # Never read, and removed by the compiler.
        v_sh = cuda.local.array((1, HARMONICS, 3), real)
        r = cuda.grid(1)
        if r >= origins.shape[0] or starts[r] == starts[r + 1]:
            return
        o, d, _, length, _ = ray(origins, directions, r)
        unit = d[0] / length, d[1] / length, d[2] / length
        # Gradient-weighted sum of the remaining hits, initially of all.
        behind = v_depths[r] * depths[r]
        for j in range(3):
            behind += v_colors[r, j] * colors[r, j]
        left, end, v_length = one, v_alphas[r] * (one - alphas[r]), zero
        by_origin, by_direction, by_unit = (zero, zero, zero), (zero, zero, zero), (zero, zero, zero)
        for place in range(starts[r], starts[r + 1]):
            g, alpha = hit_ids[place], hit_alphas[place]
            offset, frame = steps.shape_of(means, frames, g, o)
            t, q, _ = intersect(offset, d, frame)
            weight, value, v_squared = alpha * left, zero, zero
            # At the threshold, differently fused operations may find a disc edge-on.
            if t < nowhere:
                if degree >= 0:
                    value, v_unit = hit_color_gradient(sh[g : g + 1], degree, unit, v_colors, r, weight, v_sh)
                    by_unit = by_unit[0] + v_unit[0], by_unit[1] + v_unit[1], by_unit[2] + v_unit[2]
                value += v_depths[r] * (t * length)
                behind -= weight * value
                if alpha < most:
                    v_squared = -half * alpha * (left * value + (end - behind) / (one - alpha))
                v_t = weight * v_depths[r]
                v_length += v_t * t
                v_o, v_d, _ = intersect_gradient(offset, d, frame, t, q, v_t * length, v_squared)
                by_origin = by_origin[0] + v_o[0], by_origin[1] + v_o[1], by_origin[2] + v_o[2]
                by_direction = by_direction[0] + v_d[0], by_direction[1] + v_d[1], by_direction[2] + v_d[2]
            hit_rays[place], weights[place], v_squares[place] = r, weight, v_squared
            left *= one - alpha
        along = unit[0] * by_unit[0] + unit[1] * by_unit[1] + unit[2] * by_unit[2]
        v_origins[r, 0], v_origins[r, 1], v_origins[r, 2] = by_origin
        v_directions[r, 0] = by_direction[0] + v_length * unit[0] + (by_unit[0] - unit[0] * along) / length
        v_directions[r, 1] = by_direction[1] + v_length * unit[1] + (by_unit[1] - unit[1] * along) / length
        v_directions[r, 2] = by_direction[2] + v_length * unit[2] + (by_unit[2] - unit[2] * along) / length

    return ray_gradients


@cache
def trace_gaussian_gradients(real: type, flat: bool) -> Kernel:
    """Fills the gradients, initially zero, of Gaussians that rays hit, one block of one warp for each."""
    ray, hit_color_gradient = steps.ray_reader(real), steps.color_backward(real)
    intersect, intersect_gradient = ray_hit_maths(real, flat)
    zero, two, nowhere = real(0.0), real(2.0), real("inf")

    @inlined
    def fill(row, offset, d, frame, length, weight, v_depth, v_squared, opacity):
        """Fills a row with one hit's gradients of mean, frame and opacity, and its contributions."""
        t, q, _ = intersect(offset, d, frame)
        if not t < nowhere:
            for j in range(GEOMETRY):
                row[j] = zero
            return
        # Tuples are indexed only by constants, because a variable index compiles to a switch.
        v_o, _, v_frame = intersect_gradient(offset, d, frame, t, q, weight * v_depth * length, v_squared)
        row[0], row[1], row[2] = -v_o[0], -v_o[1], -v_o[2]
        row[FRAME_AT], row[FRAME_AT + 1], row[FRAME_AT + 2] = v_frame[0]
        row[FRAME_AT + 3], row[FRAME_AT + 4], row[FRAME_AT + 5] = v_frame[1]
        row[FRAME_AT + 6], row[FRAME_AT + 7], row[FRAME_AT + 8] = v_frame[2]
        row[OPACITY_AT] = -two * v_squared / opacity
        row[steps.CONTRIBUTION_AT], row[steps.CONTRIBUTION_AT + 1] = weight, weight * (t * length)

    @kernel(
        "trace_gradients_discs" if flat else "trace_gradients_ellipsoids",
        real,
        "real2 real3 real1 real3 real2 real2 int long1 long1 int1 real1 real1 real2 real1 real2 real3 real1 real3 "
        "real2",
    )
    def gaussian_gradients(
        means, frames, opacities, sh, origins, directions, degree, order, starts, hit_rays, weights, v_squares,
        v_colors, v_depths, v_means, v_frames, v_opacities, v_sh, v_contributions,
    ):  # fmt: skip
        rows = cuda.shared.array((WARP, GEOMETRY), real)
        harmonics = cuda.shared.array((WARP, STRIDE, 3), real)
        g, lane = cuda.blockIdx.x, cuda.threadIdx.x
        begin, end = starts[g], starts[g + 1]
        if begin == end:
            return
        geometry, first_color, second_color = zero, zero, zero
        used = 3 * (degree + 1) * (degree + 1)
        for first in range(begin, end, WARP):
            if first + lane < end:
                hit = order[first + lane]
                r, weight = hit_rays[hit], weights[hit]
                o, d, _, length, _ = ray(origins, directions, r)
                offset, frame = steps.shape_of(means, frames, g, o)
                fill(rows[lane], offset, d, frame, length, weight, v_depths[r], v_squares[hit], opacities[g])
                if degree >= 0:
                    for k in range(HARMONICS):
                        for j in range(3):
                            harmonics[lane, k, j] = zero
                    unit = d[0] / length, d[1] / length, d[2] / length
                    hit_color_gradient(sh[g : g + 1], degree, unit, v_colors, r, weight, harmonics[lane : lane + 1])
            cuda.syncthreads()
            for i in range(min(WARP, end - first)):
                if lane < GEOMETRY:
                    geometry += rows[i, lane]
                if lane < used:
                    first_color += harmonics[i, lane // 3, lane % 3]
                if lane + WARP < used:
                    second_color += harmonics[i, (lane + WARP) // 3, (lane + WARP) % 3]
            cuda.syncthreads()
        if lane < FRAME_AT:
            v_means[g, lane] = geometry
        elif lane < OPACITY_AT:
            v_frames[g, (lane - FRAME_AT) // 3, (lane - FRAME_AT) % 3] = geometry
        elif lane == OPACITY_AT:
            v_opacities[g] = geometry
        elif lane < GEOMETRY:
            v_contributions[g, lane - steps.CONTRIBUTION_AT] = geometry
        if lane < used:
            v_sh[g, lane // 3, lane % 3] = first_color
        if lane + WARP < used:
            v_sh[g, (lane + WARP) // 3, (lane + WARP) % 3] = second_color

    return gaussian_gradients


def trace(
    shapes: Sequence[Tensor], rays: Sequence[Tensor], bvh: Sequence[Tensor],
    *, flat: bool, degree: int, near: float, needs_gradients: bool,
) -> tuple[Tensor, ...]:  # fmt: skip
    """As `glassplat.kernels.trace.cpu.trace`, but stores hits as [K, R], along with their coverage."""
    origins = rays[0]
    count = origins.shape[0]
    bytes_of_hits = (4 + origins.element_size()) * max(count, 1)
    num_kept = min(MOST_KEPT, KEPT_BYTES // bytes_of_hits) if needs_gradients else 0
    outputs = (
        origins.new_empty(count, 3),
        origins.new_empty(count),
        origins.new_empty(count),
        torch.empty(count, dtype=torch.int32, device=origins.device),
    )
    kept = torch.empty(num_kept, count, dtype=torch.int32, device=origins.device), origins.new_empty(num_kept, count)
    _search(shapes, rays, bvh, flat)(degree, near, None, None, None, *kept, *outputs)
    return (*outputs, *kept)


def trace_gradients(
    shapes: Sequence[Tensor], rays: Sequence[Tensor], bvh: Sequence[Tensor], outputs: Sequence[Tensor],
    cotangents: Sequence[Tensor], *, flat: bool, degree: int, near: float,
) -> tuple[Tensor, ...]:  # fmt: skip
    """As `glassplat.kernels.trace.cpu.trace_gradients`; synchronises once, to read the number of hits."""
    means, sh, counts = shapes[0], shapes[3], outputs[3]
    real, num_rays, count = REAL_OF[means.dtype], counts.shape[0], means.shape[0]
    offsets = torch.zeros(num_rays + 1, dtype=torch.int64, device=means.device)
    torch.cumsum(counts, 0, out=offsets[1:])
    total = int(offsets[-1].item())
    whose = [torch.empty(total, dtype=torch.int32, device=means.device) for _ in range(2)]
    hits = Hits(offsets, *whose, *(means.new_empty(total) for _ in range(3)))
    # No colours: only the Gaussians hit and their coverage.
    collect = _search(shapes, rays, bvh, flat)
    collect(-1, near, hits.offsets, hits.hit_ids, hits.alphas, *outputs[4:], None, None, None, None)
    v_rays = [torch.zeros_like(ray) for ray in rays]
    given = (*shapes[:2], sh, *rays, degree, *hits, *outputs[:3], *cotangents)
    trace_ray_gradients(real, flat).over(num_rays, *given, *v_rays)
    by_gaussian, order = torch.sort(hits.hit_ids, stable=True)
    starts = torch.searchsorted(by_gaussian, torch.arange(count + 1, dtype=torch.int32, device=means.device))
    found = tuple(torch.zeros_like(tensor) for tensor in shapes)
    v_contributions = means.new_zeros(count, 2)
    v_colors, _, v_depths = cotangents
    trace_gaussian_gradients(real, flat)(
        count, WARP, *shapes, *rays, degree, order, starts, hits.rays, hits.weights, hits.v_squares, v_colors, v_depths,
        *found, v_contributions,
    )  # fmt: skip
    return (*found, *v_rays, v_contributions)


def _search(shapes: Sequence[Tensor], rays: Sequence[Tensor], bvh: Sequence[Tensor], flat: bool) -> Callable[..., None]:
    """Binds `trace_forward` to these shapes and rays; the result takes its remaining arguments."""
    order, boxes, offsets = bvh
    origins = rays[0]
    launch = trace_forward(REAL_OF[origins.dtype], flat).over
    return partial(launch, len(origins), *shapes, *rays, order, boxes.view(-1), offsets)


@cache
def trace_forward(real: type, flat: bool) -> Kernel:
    """Fills colors, alphas, depths and hits, and stores the nearest hits. If `starts` has elements, fills each ray's
    Gaussians and their coverage instead, from the stored hits or by another search.

    Both are one kernel, so that both find the same hits: separate kernels may fuse operations differently, and a
    Gaussian that covers just 1/255 would be hit in only one of them.
    """
    ray, next_hits, (color, _) = steps.ray_reader(real), next_hits_maths(real, flat), color_maths(real)
    zero, half, one, least = real(0.0), real(0.5), real(1.0), real(TRANSMITTANCE_MIN)

    @kernel(
        "trace_forward_discs" if flat else "trace_forward_ellipsoids",
        real,
        "real2 real3 real1 real3 real2 real2 int1 real1 long1 int real long1 int1 real1 int2 real2 "
        "real2 real1 real1 int1",
    )
    def forward(
        means, frames, opacities, sh, origins, directions, order, boxes, offsets, degree, near, starts,
        hit_ids, hit_alphas, kept, kept_alphas, colors, alphas, depths, hits,
    ):  # fmt: skip
        ts, found, ids = cuda.local.array(CHUNK, real), cuda.local.array(CHUNK, real), cuda.local.array(CHUNK, np.int32)
        stack, waiting = cuda.local.array(STACK, np.int32), cuda.local.array(STACK, real)
        r = cuda.grid(1)
        if r >= origins.shape[0]:
            return
        if starts.size > 0 and starts[r + 1] - starts[r] <= kept.shape[0]:
            for k in range(starts[r + 1] - starts[r]):
                hit_ids[starts[r] + k], hit_alphas[starts[r] + k] = kept[k, r], kept_alphas[k, r]
            return
        o, d, inverse, length, usable = ray(origins, directions, r)
        x, y, z = d[0] / length, d[1] / length, d[2] / length
        red = green = blue = depth = zero
        left, blended = one, 0
        first, first_id, num_found = near, 2147483647, CHUNK
        while usable and num_found == CHUNK:
            num_found = next_hits(
                o, d, inverse, means, frames, opacities, order, boxes, offsets, first, first_id,
                ts, ids, found, stack, waiting,
            )  # fmt: skip
            for k in range(num_found):
                after = left * (one - found[k])
                if after < least:
                    num_found = 0
                    break
                g, weight = ids[k], found[k] * left
                if starts.size > 0:
                    hit_ids[starts[r] + blended], hit_alphas[starts[r] + blended] = g, found[k]
                elif blended < kept.shape[0]:
                    kept[blended, r], kept_alphas[blended, r] = g, found[k]
                if degree >= 0:
                    c = color(sh, g, degree, x, y, z)
                    red += weight * max(c[0] + half, zero)
                    green += weight * max(c[1] + half, zero)
                    blue += weight * max(c[2] + half, zero)
                depth += weight * (ts[k] * length)
                left, blended = after, blended + 1
            first, first_id = ts[CHUNK - 1], ids[CHUNK - 1]
        if starts.size == 0:
            colors[r, 0], colors[r, 1], colors[r, 2] = red, green, blue
            alphas[r], depths[r], hits[r] = one - left, depth, blended

    return forward
