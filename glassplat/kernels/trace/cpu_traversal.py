"""BVH traversal that finds a ray's next hits, front to back.

Each search returns the nearest hits beyond the last known one, ordered by (t, Gaussian), and skips boxes that start
beyond the farthest of the hits found so far (Knoll et al. 2019; EnvGS, Section 4.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

from numba import prange
from torch import Tensor

from glassplat.kernels.backend.cpu import Kernel, inlined, kernel
from glassplat.kernels.backend.cpu_vector import bits_of, lowest_bit, maximum, minimum, store, vector_kind
from glassplat.kernels.maths.blending import Scalar, build_exp2
from glassplat.kernels.maths.disc import EDGE_ON, MOST_DEVIATIONS
from glassplat.kernels.records import REAL_OF
from glassplat.kernels.trace.steps import LEVEL_BITS, NODE, SLACK, WIDTH, coverage_maths, insert

full, load = vector_kind(WIDTH)
LEAF = 13 * WIDTH
"""Numbers per leaf: means, rows of frames and opacities, each for all its positions."""


def flat_boxes(bvh: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Order, flat boxes and level offsets."""
    order, boxes, offsets = bvh
    return order, boxes.view(-1), offsets


def _entry(real: type) -> Scalar:
    """Builds the step that writes a ray's entry distances of a node's boxes, and returns the boxes hit, as bits."""
    zero, sooner, later = real(0.0), real(1.0 - SLACK), real(1.0 + SLACK)

    @inlined
    def enter(boxes, node, o, inverse, first, last, entries):
        # Faces are chosen by the sign of the direction, so that rays miss empty boxes (minimum above maximum).
        lowest = node * NODE
        highest = lowest + 3 * WIDTH
        x0, x1 = (lowest, highest) if inverse[0] > zero else (highest, lowest)
        y0, y1 = (lowest, highest) if inverse[1] > zero else (highest, lowest)
        z0, z1 = (lowest, highest) if inverse[2] > zero else (highest, lowest)
        x, y = (load(boxes, x0) - o[0]) * inverse[0], (load(boxes, y0 + WIDTH) - o[1]) * inverse[1]
        z = (load(boxes, z0 + 2 * WIDTH) - o[2]) * inverse[2]
        near = maximum(maximum(x, y), maximum(z, full(first)))
        x, y = (load(boxes, x1) - o[0]) * inverse[0], (load(boxes, y1 + WIDTH) - o[1]) * inverse[1]
        z = (load(boxes, z1 + 2 * WIDTH) - o[2]) * inverse[2]
        far = minimum(minimum(x, y), minimum(z, full(last)))
        store(entries, 0, near)
        return bits_of(near * sooner <= far * later)

    return enter


def _intersect_lanes(real: type, flat: bool) -> Scalar:
    """Builds the step that writes (t, squared |q|) of a ray and eight Gaussians, and returns possible hits, as bits.

    It vectorises the intersection of `maths/disc.py`.
    """
    zero, edge_on, farthest = real(0.0), real(EDGE_ON**2), real(MOST_DEVIATIONS**2)

    @inlined
    def row(leaves, at, x, y, z, d):
        """Products of one row of the frames with the offsets, and with the direction."""
        a, b, c = load(leaves, at), load(leaves, at + WIDTH), load(leaves, at + 2 * WIDTH)
        return a * x + b * y + c * z, a * d[0] + b * d[1] + c * d[2]

    @inlined
    def offsets_of(leaves, at, o):
        return load(leaves, at) - o[0], load(leaves, at + WIDTH) - o[1], load(leaves, at + 2 * WIDTH) - o[2]

    @inlined
    def intersect_discs(leaves, leaf, o, d, first, last, ts, squares):
        at = leaf * LEAF
        x, y, z = offsets_of(leaves, at, o)
        distance, slope = row(leaves, at + 9 * WIDTH, x, y, z, d)
        t = distance / slope
        offset_u, along_u = row(leaves, at + 3 * WIDTH, x, y, z, d)
        offset_v, along_v = row(leaves, at + 6 * WIDTH, x, y, z, d)
        u, v = t * along_u - offset_u, t * along_v - offset_v
        squared = u * u + v * v
        store(ts, 0, t)
        store(squares, 0, squared)
        facing = slope * slope > edge_on * (d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
        return bits_of(facing & (t >= first) & (t <= last) & (squared <= farthest))

    @inlined
    def intersect_ellipsoids(leaves, leaf, o, d, first, last, ts, squares):
        at = leaf * LEAF
        x, y, z = offsets_of(leaves, at, o)
        e0, f0 = row(leaves, at + 3 * WIDTH, x, y, z, d)
        e1, f1 = row(leaves, at + 6 * WIDTH, x, y, z, d)
        e2, f2 = row(leaves, at + 9 * WIDTH, x, y, z, d)
        length = f0 * f0 + f1 * f1 + f2 * f2
        t = (e0 * f0 + e1 * f1 + e2 * f2) / length
        u, v, w = t * f0 - e0, t * f1 - e1, t * f2 - e2
        # Removes the rounding error along the ray, see `maths/disc.py`.
        rest = (u * f0 + v * f1 + w * f2) / length
        u, v, w = u - rest * f0, v - rest * f1, w - rest * f2
        squared = u * u + v * v + w * w
        store(ts, 0, t)
        store(squares, 0, squared)
        return bits_of((length > zero) & (t >= first) & (t <= last) & (squared <= farthest))

    return intersect_discs if flat else intersect_ellipsoids


@cache
def pack_leaves(real: type) -> Kernel:
    """Fills the leaves in order; positions after the last Gaussian are padded so that rays never hit them."""
    zero = real(0.0)

    @kernel("trace_pack_leaves", real)
    def pack(means, frames, opacities, order, leaves):
        for leaf in prange(leaves.shape[0]):
            for k in range(WIDTH):
                place = leaf * WIDTH + k
                if place >= order.size:
                    for j in range(13):
                        leaves[leaf, j, k] = zero
                    continue
                g = order[place]
                for j in range(3):
                    leaves[leaf, j, k] = means[g, j]
                    for i in range(3):
                        leaves[leaf, 3 + 3 * i + j, k] = frames[g, i, j]
                leaves[leaf, 12, k] = opacities[g]

    return pack


def packed_leaves(shapes: Sequence[Tensor], order: Tensor) -> Tensor:
    """Flat contents of the leaves of a hierarchy."""
    means, frames, opacities = shapes[:3]
    leaves = means.new_empty(-(-order.shape[0] // WIDTH), 13, WIDTH)
    pack_leaves(REAL_OF[means.dtype])(means, frames, opacities, order, leaves)
    return leaves.view(-1)


def next_hits_maths(real: type, flat: bool) -> Scalar:
    """Builds `next_hits`, which fills (ts, ids, alphas) with up to `most` next hits of a ray; returns their number."""
    enter, intersect = _entry(real), _intersect_lanes(real, flat)
    coverage = coverage_maths(real, build_exp2(real))
    zero, nowhere, sooner = real(0.0), real("inf"), real(1.0 - SLACK)

    @inlined
    def next_hits(
        o, d, inverse, leaves, order, boxes, offsets, first, first_id, most, ts, ids, alphas,
        entries, squares, stack, waiting,
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
            if level > 0:
                hit_bits = enter(boxes, node, o, inverse, first, farthest, entries)
                child, begin = (node - offsets[level]) * WIDTH + offsets[level - 1], top
                while hit_bits != 0:
                    k = lowest_bit(hit_bits)
                    hit_bits &= hit_bits - 1
                    at, place = entries[k], top
                    # Nearest last, so that it is popped first.
                    while place > begin and waiting[place - 1] < at:
                        stack[place], waiting[place] = stack[place - 1], waiting[place - 1]
                        place -= 1
                    stack[place], waiting[place] = ((child + k) << LEVEL_BITS) | (level - 1), at
                    top += 1
                continue
            # Testing eight Gaussians takes hardly longer than testing boxes around them.
            hit_bits = intersect(leaves, node, o, d, first, farthest, entries, squares)
            while hit_bits != 0:
                k = lowest_bit(hit_bits)
                hit_bits &= hit_bits - 1
                t, g = entries[k], order[node * WIDTH + k]
                if not (t > first or g > first_id):
                    continue
                if not (t < farthest or (t == farthest and g < farthest_id)):
                    continue
                _, alpha = coverage(leaves[node * LEAF + 12 * WIDTH + k], squares[k])
                if alpha > zero:
                    count = insert(ts, ids, alphas, count, most, t, g, alpha)
                    if count == most:
                        farthest, farthest_id = ts[most - 1], ids[most - 1]
        return count

    return next_hits
