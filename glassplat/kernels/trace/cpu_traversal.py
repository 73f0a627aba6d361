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
from glassplat.kernels.maths.blending import ALPHA_MAX, ALPHA_MIN, Scalar, blend_maths
from glassplat.kernels.maths.ray_hit import MOST_DEVIATIONS, ray_hit_maths

CHUNK = 16
"""Hits that a search returns at most."""
WIDTH = 8
"""Children of a node."""
NODE = 6 * WIDTH
"""Numbers of a node: the lowest x, y, z and the highest x, y, z of its children."""
STACK = 128
"""Nodes that wait at most: seven siblings on each of the levels that 32-bit places can have, and the nearest."""
SLACK = 1e-5
"""Share by which boxes begin earlier and end later, so that rounding loses no hit."""
LARGEST_INVERSE = 1e18
"""In place of 1 / 0 in the direction of a ray."""


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
    return Traversal(_next_hits(real, flat), _ray(real))


def _ray(real: type) -> Scalar:
    zero, one, largest, most = real(0.0), real(1.0), real(LARGEST_INVERSE), real("inf")

    @inlined
    def inverse(x):  # type: ignore[no-untyped-def]
        if x > one / largest or x < -one / largest:
            return one / x
        return -largest if x < zero else largest

    @inlined
    def ray(origins, directions, r):  # type: ignore[no-untyped-def]
        o = origins[r, 0], origins[r, 1], origins[r, 2]
        d = directions[r, 0], directions[r, 1], directions[r, 2]
        squared = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
        # NaN and infinity fail one of the comparisons.
        usable = squared > zero and squared < most and abs(o[0]) + abs(o[1]) + abs(o[2]) < most
        return o, d, (inverse(d[0]), inverse(d[1]), inverse(d[2])), squared ** real(0.5), usable

    return ray


def shape_reader(real: type) -> Scalar:
    """Offset from the origin, and frame, of one Gaussian."""

    @inlined
    def shape(means, frames, g, o):  # type: ignore[no-untyped-def]
        offset = means[g, 0] - o[0], means[g, 1] - o[1], means[g, 2] - o[2]
        first = frames[g, 0, 0], frames[g, 0, 1], frames[g, 0, 2]
        second = frames[g, 1, 0], frames[g, 1, 1], frames[g, 1, 2]
        third = frames[g, 2, 0], frames[g, 2, 1], frames[g, 2, 2]
        return offset, (first, second, third)

    return shape


def coverage_maths(real: type) -> Scalar:
    """(coverage before clamping, blended alpha) from the opacity and the squared distance; alpha is 0 beyond reach."""
    half_bits, farthest = real(-0.5 / 0.6931471805599453), real(MOST_DEVIATIONS**2)
    zero, least, most, exp2 = real(0.0), real(ALPHA_MIN), real(ALPHA_MAX), blend_maths(real).exp2

    @inlined
    def coverage(opacity, squared):  # type: ignore[no-untyped-def]
        if not squared <= farthest:
            return zero, zero
        covered = opacity * exp2(half_bits * squared)
        if not covered >= least:
            return zero, zero
        return covered, covered if covered < most else most

    return coverage


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
    meet = ray_hit_maths(real, flat).meet
    shape, coverage, enter = shape_reader(real), coverage_maths(real), _entry(real)
    zero, nowhere, sooner = real(0.0), real("inf"), real(1.0 - SLACK)

    @inlined
    def insert(ts, ids, alphas, count, t, g, alpha):  # type: ignore[no-untyped-def]
        """Puts a hit in its place among the nearest; returns how many there are."""
        place = count if count < CHUNK else CHUNK - 1
        while place > 0 and (ts[place - 1] > t or (ts[place - 1] == t and ids[place - 1] > g)):
            ts[place], ids[place], alphas[place] = ts[place - 1], ids[place - 1], alphas[place - 1]
            place -= 1
        ts[place], ids[place], alphas[place] = t, g, alpha
        return count + 1 if count < CHUNK else count

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
