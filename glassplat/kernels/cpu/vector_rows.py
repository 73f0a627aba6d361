"""Small tables in vectors: from rows of numbers in memory to one vector for each column, and back.

What belongs to one thing lies beside each other in memory, the three coordinates of a place or its many coefficients; a
vector holds one of these of several things.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from glassplat.kernels.cpu.pixel_rows import zipped
from glassplat.kernels.cpu.vector import VectorType, llvm_type, plain, shuffled


@intrinsic
def thirds(typing, first, second, third):
    """Three vectors in a row that hold triples: their first numbers, their second and their third ones."""

    def build(builder, a, b, c):
        lanes = a.type.count
        columns = []
        for k in range(3):
            places = [3 * i + k for i in range(lanes)]
            # From the first two vectors, 0 for what is in the third; then that from there.
            early = shuffled(builder, a, b, [place if place < 2 * lanes else 0 for place in places])
            late = [i if place < 2 * lanes else place - lanes for i, place in enumerate(places)]
            columns.append(shuffled(builder, early, c, late))
        return cgutils.pack_array(builder, columns, a.type)

    if isinstance(first, VectorType) and first == second == third:
        return plain(types.UniTuple(first, 3), (first, second, third), build)


@intrinsic
def triples(typing, first, second, third):
    """Three vectors in a row that hold the triples of whose numbers these are the first, the second and the third ones.

    Undoes `thirds`.
    """

    def build(builder, a, b, c):
        lanes, rows = a.type.count, []
        for k in range(3):
            places = [divmod(k * lanes + i, 3) for i in range(lanes)]
            early = shuffled(builder, a, b, [n + lanes * which if which < 2 else 0 for n, which in places])
            late = [i if which < 2 else lanes + n for i, (n, which) in enumerate(places)]
            rows.append(shuffled(builder, early, c, late))
        return cgutils.pack_array(builder, rows, a.type)

    if isinstance(first, VectorType) and first == second == third:
        return plain(types.UniTuple(first, 3), (first, second, third), build)


@intrinsic
def transposed(typing, rows):
    """As many vectors as each has lanes, lane i of vector k being lane k of vector i."""

    def build(builder, packed):
        parts = [builder.extract_value(packed, i) for i in range(rows.count)]
        half = rows.count // 2
        for _ in range(half.bit_length()):
            pairs = zip(parts[:half], parts[half:], strict=True)
            parts = [part for a, b in pairs for part in zipped(builder, a, b)]
        return cgutils.pack_array(builder, parts, parts[0].type)

    if isinstance(rows, types.UniTuple) and rows.count == getattr(rows.dtype, "lanes", 0):
        return plain(rows, (rows,), build)


def row_loader(real: type, lanes: int) -> Callable[..., Any]:
    """The function that loads `lanes` vectors of an array, which begin `at` elements after as many positions in it."""
    kind = VectorType(types.float64 if real is np.float64 else types.float32, lanes)
    index = ir.IntType(64)

    @intrinsic
    def load_rows(typing, array, positions, at):
        def generate(context, builder, sig, arguments):
            data, firsts = (context.make_array(sig.args[i])(context, builder, arguments[i]).data for i in range(2))
            rows = []
            for i in range(lanes):
                first = builder.load(builder.gep(firsts, [ir.Constant(index, i)]))
                place = builder.gep(data, [builder.add(first, arguments[2])])
                row = builder.load(builder.bitcast(place, llvm_type(kind).as_pointer()))
                row.align = kind.element.bitwidth // 8
                rows.append(row)
            return cgutils.pack_array(builder, rows, llvm_type(kind))

        fits = _is_flat(array, kind.element) and _is_flat(positions, types.int64)
        return (types.UniTuple(kind, lanes)(array, positions, types.intp), generate) if fits else None

    return load_rows


@intrinsic
def store_all(typing, array, at, vectors):
    """Puts vectors one after the other into a contiguous one-dimensional array, from index `at` on."""

    def generate(context, builder, sig, arguments):
        data = context.make_array(sig.args[0])(context, builder, arguments[0]).data
        kind = vectors.dtype
        for i in range(vectors.count):
            place = builder.gep(data, [builder.add(arguments[1], ir.Constant(arguments[1].type, i * kind.lanes))])
            value = builder.extract_value(arguments[2], i)
            done = builder.store(value, builder.bitcast(place, llvm_type(kind).as_pointer()))
            done.align = kind.element.bitwidth // 8
        return context.get_dummy_value()

    kind = getattr(vectors, "dtype", None)
    if isinstance(vectors, types.UniTuple) and isinstance(kind, VectorType) and _is_flat(array, kind.element):
        return types.void(array, types.intp, vectors), generate


def _is_flat(array: Any, element: types.Type) -> bool:
    return isinstance(array, types.Array) and array.ndim == 1 and array.layout == "C" and array.dtype == element
