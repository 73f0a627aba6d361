"""Finding a ray's next hits, front to back, through the hierarchy of boxes.

Each search returns the nearest `CHUNK` hits beyond the last one that is known, ordered by (t, Gaussian), and leaves out
boxes that begin behind the farthest of those found so far (Knoll et al. 2019; EnvGS, Section 4.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from numpy.typing import NDArray
from torch import Tensor

from glassplat.kernels.cpu.jit import inlined
from glassplat.kernels.cpu.vector import bits_of, lowest_bit, maximum, minimum, store, vector_kind
from glassplat.kernels.maths.blending import Scalar, blend_maths
from glassplat.kernels.maths.ray_hit import ray_hit_maths
from glassplat.kernels.trace.steps import (
    CHUNK,
    NODE,
    SLACK,
    WIDTH,
    coverage_maths,
    nearest_maths,
    ray_reader,
    shape_reader,
)


def arrays_of(bvh: Sequence[Tensor]) -> tuple[NDArray[Any], ...]:
    """Order, boxes in one dimension, and where levels begin, as kernels take them."""
    order, boxes, offsets = bvh
    return order.numpy(), boxes.numpy().reshape(-1), offsets.numpy()


class Traversal(NamedTuple):
    """Steps for one ray.

    Attributes:
        next_hits: fills (ts, ids, alphas) with the next hits; returns their number.
        ray: (origin, direction, inverse direction, length), and whether it is one.
    """

    next_hits: Scalar
    ray: Scalar


def traversal(real: type, flat: bool) -> Traversal:
    """Builds the functions for `real`, and for discs (`flat`) or ellipsoids."""
    return Traversal(_next_hits(real, flat), ray_reader(real))


def _entry(real: type) -> Scalar:
    """Puts down where a ray enters each of a node's boxes; returns which of them it meets, as bits."""
    full, load = vector_kind(real, WIDTH)
    zero, sooner, later = real(0.0), real(1.0 - SLACK), real(1.0 + SLACK)

    @inlined
    def enter(boxes, node, o, inverse, first, last, entries):  # type: ignore[no-untyped-def]
        # Faces are chosen by the sign of the direction, so that an empty box, whose lowest corner lies above its
        # highest, is missed.
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


def _next_hits(real: type, flat: bool) -> Scalar:
    meet, insert = ray_hit_maths(real, flat).meet, nearest_maths()
    shape, coverage, enter = shape_reader(real), coverage_maths(real, blend_maths(real).exp2), _entry(real)
    zero, nowhere, sooner = real(0.0), real("inf"), real(1.0 - SLACK)

    @inlined
    def next_hits(  # type: ignore[no-untyped-def]
        o, d, inverse, means, frames, opacities, order, boxes, offsets, first, first_id, ts, ids, alphas,
        entries, stack, waiting,
    ):  # fmt: skip
        count, top = 0, 0
        farthest, farthest_id = nowhere, 2147483647
        if boxes.size > 0:
            stack[0], waiting[0] = boxes.size // NODE - 1, zero
            top = 1
        while top > 0:
            top -= 1
            node = stack[top]
            if waiting[top] * sooner > farthest:
                continue
            level = 0
            while offsets[level + 1] <= node:
                level += 1
            met = enter(boxes, node, o, inverse, first, farthest, entries)
            child = (node - offsets[level]) * WIDTH
            if level > 0:
                child += offsets[level - 1]
                begin = top
                while met != 0:
                    k = lowest_bit(met)
                    met &= met - 1
                    at, place = entries[k], top
                    # Nearest last, so that it is taken next.
                    while place > begin and waiting[place - 1] < at:
                        stack[place], waiting[place] = stack[place - 1], waiting[place - 1]
                        place -= 1
                    stack[place], waiting[place] = child + k, at
                    top += 1
                continue
            while met != 0:
                g = order[child + lowest_bit(met)]
                met &= met - 1
                offset, frame = shape(means, frames, g, o)
                t, _, squared = meet(offset, d, frame)
                if not (t > first or (t == first and g > first_id)):
                    continue
                if not (t < farthest or (t == farthest and g < farthest_id)):
                    continue
                _, alpha = coverage(opacities[g], squared)
                if alpha > zero:
                    count = insert(ts, ids, alphas, count, t, g, alpha)
                    if count == CHUNK:
                        farthest, farthest_id = ts[CHUNK - 1], ids[CHUNK - 1]
        return count

    return next_hits
