"""Rows of pixels in vectors: channels lie beside each other in an image, and each in a vector to compute with.

A row of four pixels with four channels is a vector of 16 lanes; with three channels it is 12 numbers, in vectors of 8
and 4 lanes.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from glassplat.kernels.cpu.vector import VectorType, plain, shuffled

ROW = 16
"""Lanes of a row of four pixels with four channels."""


@intrinsic
def interleaved(typing, vectors):
    """Four vectors taken apart lane by lane: the first lanes of all four, then their second lanes, and so on.

    The result is four vectors again; `sorted_apart` undoes it.
    """

    def build(builder, packed):
        a, b, c, d = (builder.extract_value(packed, i) for i in range(4))
        pairs = [zipped(builder, *pair) for pair in ((a, c), (b, d))]
        rows = [row for even, odd in zip(*pairs, strict=True) for row in zipped(builder, even, odd)]
        return cgutils.pack_array(builder, rows, a.type)

    if isinstance(vectors, types.UniTuple) and vectors.count == 4 and isinstance(vectors.dtype, VectorType):
        return plain(vectors, (vectors,), build)


@intrinsic
def sorted_apart(typing, vectors):
    """Four vectors of which every fourth lane belongs together; undoes `interleaved`."""

    def build(builder, packed):
        rows = [builder.extract_value(packed, i) for i in range(4)]
        halves = [_unzipped(builder, *pair) for pair in zip(rows[::2], rows[1::2], strict=True)]
        evens, odds = (_unzipped(builder, *pair) for pair in zip(*halves, strict=True))
        return cgutils.pack_array(builder, [evens[0], odds[0], evens[1], odds[1]], rows[0].type)

    if isinstance(vectors, types.UniTuple) and vectors.count == 4 and isinstance(vectors.dtype, VectorType):
        return plain(vectors, (vectors,), build)


def zipped(builder: Any, a: Any, b: Any) -> tuple[Any, Any]:
    """a0 b0 a1 b1 ..., in two vectors."""
    lanes = a.type.count
    order = [i // 2 + i % 2 * lanes for i in range(2 * lanes)]
    return shuffled(builder, a, b, order[:lanes]), shuffled(builder, a, b, order[lanes:])


def _unzipped(builder: Any, a: Any, b: Any) -> tuple[Any, Any]:
    """The even lanes of two vectors in a row, and the odd ones."""
    lanes = a.type.count
    return shuffled(builder, a, b, range(0, 2 * lanes, 2)), shuffled(builder, a, b, range(1, 2 * lanes, 2))


@intrinsic
def without_fourths(typing, row):
    """The first three channels of a row of four pixels: 12 numbers, in vectors of 8 and 4 lanes."""

    def build(builder, x):
        kept = [lane for lane in range(ROW) if lane % 4 < 3]
        return cgutils.pack_struct(builder, [shuffled(builder, x, x, kept[:8]), shuffled(builder, x, x, kept[8:])])

    if isinstance(row, VectorType) and row.lanes == ROW:
        return plain(types.Tuple((VectorType(row.element, 8), VectorType(row.element, 4))), (row,), build)


@intrinsic
def with_fourths(typing, eight, four):
    """A row of four pixels of which three channels are given, as `without_fourths` gives them; the fourth is zero."""

    def build(builder, x, y):
        padded = shuffled(builder, y, y, [*range(4), *range(4)])
        twelve = shuffled(builder, x, padded, range(ROW))
        zeros = ir.Constant(twelve.type, [0.0] * ROW)
        order = [ROW if lane % 4 == 3 else lane // 4 * 3 + lane % 4 for lane in range(ROW)]
        return shuffled(builder, twelve, zeros, order)

    if isinstance(eight, VectorType) and (eight.lanes, four) == (8, VectorType(eight.element, 4)):
        return plain(VectorType(eight.element, ROW), (eight, four), build)
