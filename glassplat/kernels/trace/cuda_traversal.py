"""Finding a ray's next hits on the GPU: the search of `cpu_traversal`, a thread for each ray."""

from __future__ import annotations

from glassplat.kernels.cpu.jit import inlined
from glassplat.kernels.cuda.fast_maths import exp2_maths
from glassplat.kernels.maths.blending import Scalar
from glassplat.kernels.maths.ray_hit import ray_hit_maths
from glassplat.kernels.trace.steps import CHUNK, NODE, SLACK, WIDTH, coverage_maths, nearest_maths, shape_reader

LEVEL_BITS = 4
"""Of what stands on the stack: a node's number lies above its level."""


def _entry(real: type) -> Scalar:
    """Where a ray enters one box and where it leaves it, between two bounds; it meets the box if that is in order."""
    zero = real(0.0)

    @inlined
    def enter(boxes, at, o, inverse, first, last):  # type: ignore[no-untyped-def]
        # Faces are chosen by the sign of the direction, so that an empty box, whose lowest corner lies above its
        # highest, is missed.
        low, high = at, at + 3 * WIDTH
        x0, x1 = (low, high) if inverse[0] > zero else (high, low)
        y0, y1 = (low, high) if inverse[1] > zero else (high, low)
        z0, z1 = (low, high) if inverse[2] > zero else (high, low)
        x, y = (boxes[x0] - o[0]) * inverse[0], (boxes[y0 + WIDTH] - o[1]) * inverse[1]
        near = max(x, y, (boxes[z0 + 2 * WIDTH] - o[2]) * inverse[2], first)
        x, y = (boxes[x1] - o[0]) * inverse[0], (boxes[y1 + WIDTH] - o[1]) * inverse[1]
        return near, min(x, y, (boxes[z1 + 2 * WIDTH] - o[2]) * inverse[2], last)

    return enter


def next_hits_maths(real: type, flat: bool) -> Scalar:
    """Builds `next_hits`, which fills (ts, ids, alphas) with a ray's next hits and returns their number."""
    meet, insert, enter = ray_hit_maths(real, flat).meet, nearest_maths(), _entry(real)
    shape, coverage = shape_reader(real), coverage_maths(real, exp2_maths(real))
    zero, nowhere, sooner, later = real(0.0), real("inf"), real(1.0 - SLACK), real(1.0 + SLACK)

    @inlined
    def next_hits(  # type: ignore[no-untyped-def]
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
                    # Nearest last, so that it is taken next.
                    while place > begin and waiting[place - 1] < enters:
                        stack[place], waiting[place] = stack[place - 1], waiting[place - 1]
                        place -= 1
                    stack[place], waiting[place] = ((child + k) << LEVEL_BITS) | (level - 1), enters
                    top += 1
                    continue
                g = order[child + k]
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
