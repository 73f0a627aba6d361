"""SIMD vectors in CPU kernels: several numbers processed by one instruction.

A kernel that uses them chooses itself what a vector holds, instead of leaving that to the compiler's vectoriser, and
keeps sums in registers across loops. Vectors have one element type and a power-of-two number of lanes. LLVM splits
those wider than the machine's registers, so that a kernel means the same everywhere.

    full, load = vector_kind(8)

    @kernel("scale", np.float32)
    def scale(values, factor):
        for at in range(0, values.size, 8):
            store(values, at, load(values, at) * factor)

Vectors support `+ - * /`, comparisons, which return masks, and unary minus; masks support `&` and `|`. The other
operand may be a scalar of the element type or of float32, such as `cpu.ONE`: a bare literal is float64 and does not
compile with float32 vectors. Sums and products may be fused, as everywhere in kernels. A comparison with NaN is false.

A row of four pixels with four channels is a vector of 16 lanes; with three channels it is 12 numbers, in vectors of 8
and 4 lanes. Memory holds all values of an item next to each other, such as the three coordinates of a point or its
coefficients; a vector holds the same value of several items.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

from glassplat.kernels.backend.cpu import FAST_MATH

FLAGS = tuple(sorted(FAST_MATH))
REALS = (types.float32, types.float64)
MASK_BITS = 64
"""Lanes of the widest mask."""

Intrinsic = Callable[..., Any]


class VectorType(types.Type):
    """Type of vectors of `lanes` numbers of the type `element`."""

    def __init__(self, element: types.Float, lanes: int) -> None:
        self.element, self.lanes = element, lanes
        super().__init__(name=f"vector({element} x {lanes})")


class MaskType(types.Type):
    """Type of vectors of truth values."""

    def __init__(self, lanes: int) -> None:
        self.lanes = lanes
        super().__init__(name=f"mask({lanes})")


def llvm_type(kind: VectorType) -> ir.VectorType:
    """LLVM type of the vectors."""
    return ir.VectorType(ir.DoubleType() if kind.element == types.float64 else ir.FloatType(), kind.lanes)


@register_model(VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: VectorType) -> None:
        super().__init__(manager, kind, llvm_type(kind))


@register_model(MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: MaskType) -> None:
        super().__init__(manager, kind, ir.VectorType(ir.IntType(1), kind.lanes))


class VectorKind(NamedTuple):
    """Operations on vectors of one number of lanes; their element type is that of the argument.

    Attributes:
        full: a scalar in every lane.
        load: consecutive elements of a contiguous one-dimensional array, starting at an index.
    """

    full: Intrinsic
    load: Intrinsic


def vector_kind(lanes: int) -> VectorKind:
    """The functions for vectors of `lanes` numbers, float32 or float64."""

    @intrinsic
    def full(typing, value):
        if value in REALS:
            kind = VectorType(value, lanes)
            return codegen(kind, (value,), lambda builder, x: _broadcast(builder, x, kind))

    @intrinsic
    def load(typing, array, at):
        def generate(context, builder, sig, arguments):
            value = builder.load(_pointer(context, builder, sig, arguments, sig.return_type))
            value.align = array.dtype.bitwidth // 8
            return value

        if _is_flat(array, *REALS):
            return VectorType(array.dtype, lanes)(array, types.intp), generate

    return VectorKind(full, load)


def constant(real: type, values: tuple[float, ...]) -> Intrinsic:
    """Builds a function without arguments that returns a vector of these values."""
    kind = VectorType(types.float64 if real is np.float64 else types.float32, len(values))

    @intrinsic
    def fixed(typing):
        return codegen(kind, (), lambda builder: ir.Constant(llvm_type(kind), [float(real(v)) for v in values]))

    return fixed


@intrinsic
def item(typing, array, at):
    """One element of a contiguous one-dimensional array, at an index that must not be negative.

    Among vector operations, the sign check of an ordinary index takes a good part of a loop's time.
    """

    def generate(context, builder, sig, arguments):
        data = context.make_array(sig.args[0])(context, builder, arguments[0]).data
        return builder.load(builder.gep(data, [arguments[1]]))

    if isinstance(array, types.Array) and array.ndim == 1 and array.layout == "C":
        return array.dtype(array, types.intp), generate


@intrinsic
def store(typing, array, at, value):
    """Stores a vector in consecutive elements of a contiguous one-dimensional array, starting at index `at`."""

    def generate(context, builder, sig, arguments):
        done = builder.store(arguments[2], _pointer(context, builder, sig, arguments, value))
        done.align = value.element.bitwidth // 8
        return context.get_dummy_value()

    if isinstance(value, VectorType) and _is_flat(array, value.element):
        return types.void(array, types.intp, value), generate


@intrinsic
def select(typing, mask, chosen, other):
    """`chosen` where the mask is set, `other` elsewhere."""
    if isinstance(mask, MaskType) and isinstance(chosen, VectorType) and chosen == other:
        return codegen(chosen, (mask, chosen, other), lambda builder, *arguments: builder.select(*arguments))


def _llvm_extreme(order: str) -> Intrinsic:
    @intrinsic
    def extreme(typing, a, b):
        if isinstance(a, VectorType) and a == b:
            return codegen(a, (a, b), lambda builder, x, y: builder.select(builder.fcmp_ordered(order, x, y), x, y))

    return extreme


minimum = _llvm_extreme("<")
"""The smaller of two vectors, lane by lane; the second where either is NaN."""
maximum = _llvm_extreme(">")
"""The larger of two vectors, lane by lane; the second where either is NaN."""


def _llvm_unary(name: str) -> Intrinsic:
    @intrinsic
    def called(typing, value):
        if isinstance(value, VectorType):
            return codegen(value, (value,), lambda builder, x: _call(builder, name, value, x))

    return called


absolute = _llvm_unary("fabs")
square_root = _llvm_unary("sqrt")
exp = _llvm_unary("exp")
"""e^x; one library call per lane, accurate and slow."""


@intrinsic
def fraction(typing, value):
    """Fractional parts of numbers; undefined for magnitudes of 2^31 and more."""

    def build(builder, x):
        whole = builder.fptosi(x, ir.VectorType(ir.IntType(32), value.lanes))
        return builder.fsub(x, builder.sitofp(whole, x.type), flags=FLAGS)

    if isinstance(value, VectorType):
        return codegen(value, (value,), build)


@intrinsic
def times_power_of_2(typing, value, exponent):
    """`value` times 2^n, where n is the truncated exponent; undefined where the result is not a normal number."""
    if isinstance(value, VectorType) and value == exponent:
        return codegen(value, (value, exponent), lambda builder, x, y: _times_power_of_2(builder, x, y, value))


@intrinsic
def bits_of(typing, mask):
    """A mask as an integer; the first lane is its lowest bit."""

    def build(builder, lanes):
        bits = builder.bitcast(lanes, ir.IntType(mask.lanes))
        return bits if mask.lanes == MASK_BITS else builder.zext(bits, ir.IntType(MASK_BITS))

    if isinstance(mask, MaskType):
        return codegen(types.int64, (mask,), build)


@intrinsic
def lowest_bit(typing, bits):
    """Index of the lowest bit that is set in an int64; undefined for 0."""
    if bits == types.int64:
        return codegen(types.intp, (bits,), lambda builder, x: builder.cttz(x, ir.Constant(ir.IntType(1), 1)))


@intrinsic
def sums_of(typing, vectors):
    """Sums over the lanes of n vectors of n lanes, as one vector; the order of addition is fixed."""

    def build(builder, packed):
        parts = [builder.extract_value(packed, i) for i in range(vectors.count)]
        groups = 1
        while len(parts) > 1:
            parts = [_halve(builder, *pair, groups) for pair in zip(parts[::2], parts[1::2], strict=True)]
            groups *= 2
        return parts[0]

    if isinstance(vectors, types.UniTuple) and vectors.count == getattr(vectors.dtype, "lanes", 0):
        return codegen(vectors.dtype, (vectors,), build)


def shuffle(builder: Any, a: Any, b: Any, order: Any) -> Any:
    """Lanes of two concatenated vectors, in a given order, as one vector."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), len(order)), list(order)))


def _halve(builder: Any, a: Any, b: Any, groups: int) -> Any:
    """Halves the lanes of each partial sum in two vectors of `groups` sums each, and joins the two."""
    lanes = a.type.count
    width = lanes // groups
    near = [g * width + i for g in range(2 * groups) for i in range(width // 2)]
    far = [i + width // 2 for i in near]
    return builder.fadd(shuffle(builder, a, b, near), shuffle(builder, a, b, far), flags=FLAGS)


def _times_power_of_2(builder: Any, x: Any, exponent: Any, kind: VectorType) -> Any:
    mantissa, width = (52, 64) if kind.element == types.float64 else (23, 32)
    narrow, bits = (ir.VectorType(ir.IntType(w), kind.lanes) for w in (32, width))
    whole = builder.fptosi(exponent, narrow)
    whole = builder.sext(whole, bits) if width > 32 else whole
    raised = builder.shl(whole, ir.Constant(bits, [mantissa] * kind.lanes))
    return builder.bitcast(builder.add(builder.bitcast(x, bits), raised), x.type)


def codegen(result: Any, arguments: tuple[Any, ...], build: Callable[..., Any]) -> tuple[Any, Callable[..., Any]]:
    """Signature and code generator of an intrinsic that needs only the values of its arguments."""
    return result(*arguments), lambda context, builder, sig, values: build(builder, *values)


def _pointer(context: Any, builder: Any, sig: Any, arguments: Any, kind: VectorType) -> Any:
    data = context.make_array(sig.args[0])(context, builder, arguments[0]).data
    return builder.bitcast(builder.gep(data, [arguments[1]]), llvm_type(kind).as_pointer())


def _broadcast(builder: Any, x: Any, kind: VectorType) -> Any:
    index = ir.IntType(32)
    undefined = ir.Constant(llvm_type(kind), ir.Undefined)
    first = builder.insert_element(undefined, x, ir.Constant(index, 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(ir.VectorType(index, kind.lanes), [0] * kind.lanes))


def _as_vector(context: Any, builder: Any, value: Any, given: Any, kind: VectorType) -> Any:
    """An operand as a vector; the type of a scalar may be float32 in place of the element type."""
    return value if given == kind else _broadcast(builder, context.cast(builder, value, given, kind.element), kind)


def _call(builder: Any, name: str, kind: VectorType, *values: Any) -> Any:
    vector = llvm_type(kind)
    full_name = f"llvm.{name}.v{kind.lanes}f{kind.element.bitwidth}"
    signature = ir.FunctionType(vector, [vector] * len(values))
    return builder.call(cgutils.get_or_insert_function(builder.module, signature, full_name), values, fastmath=FLAGS)


def _arithmetic(symbol: Callable[..., Any], build: Callable[..., Any]) -> None:
    """Registers an operator on two vectors, or on a vector and a scalar."""

    @infer_global(symbol)
    class _Template(AbstractTemplate):
        def generic(self, arguments: Any, keywords: Any) -> Any:
            kinds = [kind for kind in arguments if isinstance(kind, VectorType)]
            if kinds and all(kind in (kinds[0], kinds[0].element, types.float32) for kind in arguments):
                return signature(kinds[0], *arguments)
            return None

    def lower(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        kind = sig.return_type
        full = (_as_vector(context, builder, v, t, kind) for v, t in zip(values, sig.args, strict=True))
        return build(builder, *full)

    for arguments in ((VectorType, VectorType), (VectorType, types.Float), (types.Float, VectorType)):
        lower_builtin(symbol, *arguments)(lower)


def _comparison(symbol: Callable[..., Any], name: str) -> None:
    @infer_global(symbol)
    class _Template(AbstractTemplate):
        def generic(self, arguments: Any, keywords: Any) -> Any:
            kind = arguments[0]
            if isinstance(kind, VectorType) and arguments[1] in (kind, kind.element, types.float32):
                return signature(MaskType(kind.lanes), *arguments)
            return None

    def lower(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        kind, other = sig.args
        return builder.fcmp_ordered(name, values[0], _as_vector(context, builder, values[1], other, kind))

    for second in (VectorType, types.Float):
        lower_builtin(symbol, VectorType, second)(lower)


def _unary_and_masks() -> None:
    @infer_global(operator.neg)
    class _Negative(AbstractTemplate):
        def generic(self, arguments: Any, keywords: Any) -> Any:
            return signature(arguments[0], arguments[0]) if isinstance(arguments[0], VectorType) else None

    lower_builtin(operator.neg, VectorType)(lambda context, builder, sig, values: builder.fneg(values[0]))
    for symbol, name in ((operator.and_, "and_"), (operator.or_, "or_")):
        _logic(symbol, name)


def _logic(symbol: Callable[..., Any], name: str) -> None:
    @infer_global(symbol)
    class _Template(AbstractTemplate):
        def generic(self, arguments: Any, keywords: Any) -> Any:
            if isinstance(arguments[0], MaskType) and arguments[0] == arguments[1]:
                return signature(arguments[0], *arguments)
            return None

    lower_builtin(symbol, MaskType, MaskType)(lambda context, builder, sig, values: getattr(builder, name)(*values))


_arithmetic(operator.add, lambda builder, a, b: builder.fadd(a, b, flags=FLAGS))
_arithmetic(operator.sub, lambda builder, a, b: builder.fsub(a, b, flags=FLAGS))
_arithmetic(operator.mul, lambda builder, a, b: builder.fmul(a, b, flags=FLAGS))
_arithmetic(operator.truediv, lambda builder, a, b: builder.fdiv(a, b, flags=FLAGS))
_comparison(operator.lt, "<")
_comparison(operator.le, "<=")
_comparison(operator.gt, ">")
_comparison(operator.ge, ">=")
_unary_and_masks()


ROW = 16
"""Lanes of a row of four pixels with four channels."""


@intrinsic
def interleave(typing, vectors):
    """Interleaves four vectors: the first lanes of all four, then their second lanes, and so on.

    The result is four vectors again; `deinterleave` undoes it.
    """

    def build(builder, packed):
        a, b, c, d = (builder.extract_value(packed, i) for i in range(4))
        pairs = [zip_lanes(builder, *pair) for pair in ((a, c), (b, d))]
        rows = [row for even, odd in zip(*pairs, strict=True) for row in zip_lanes(builder, even, odd)]
        return cgutils.pack_array(builder, rows, a.type)

    if isinstance(vectors, types.UniTuple) and vectors.count == 4 and isinstance(vectors.dtype, VectorType):
        return codegen(vectors, (vectors,), build)


@intrinsic
def deinterleave(typing, vectors):
    """Collects every fourth lane of four vectors; undoes `interleave`."""

    def build(builder, packed):
        rows = [builder.extract_value(packed, i) for i in range(4)]
        halves = [_unzip_lanes(builder, *pair) for pair in zip(rows[::2], rows[1::2], strict=True)]
        evens, odds = (_unzip_lanes(builder, *pair) for pair in zip(*halves, strict=True))
        return cgutils.pack_array(builder, [evens[0], odds[0], evens[1], odds[1]], rows[0].type)

    if isinstance(vectors, types.UniTuple) and vectors.count == 4 and isinstance(vectors.dtype, VectorType):
        return codegen(vectors, (vectors,), build)


def zip_lanes(builder: Any, a: Any, b: Any) -> tuple[Any, Any]:
    """a0 b0 a1 b1 ..., in two vectors."""
    lanes = a.type.count
    order = [i // 2 + i % 2 * lanes for i in range(2 * lanes)]
    return shuffle(builder, a, b, order[:lanes]), shuffle(builder, a, b, order[lanes:])


def _unzip_lanes(builder: Any, a: Any, b: Any) -> tuple[Any, Any]:
    """Even and odd lanes of two concatenated vectors."""
    lanes = a.type.count
    return shuffle(builder, a, b, range(0, 2 * lanes, 2)), shuffle(builder, a, b, range(1, 2 * lanes, 2))


@intrinsic
def drop_fourths(typing, row):
    """The first three channels of a row of four pixels: 12 numbers, in vectors of 8 and 4 lanes."""

    def build(builder, x):
        kept = [lane for lane in range(ROW) if lane % 4 < 3]
        return cgutils.pack_struct(builder, [shuffle(builder, x, x, kept[:8]), shuffle(builder, x, x, kept[8:])])

    if isinstance(row, VectorType) and row.lanes == ROW:
        return codegen(types.Tuple((VectorType(row.element, 8), VectorType(row.element, 4))), (row,), build)


@intrinsic
def pad_fourths(typing, eight, four):
    """A row of four pixels from three channels, as `drop_fourths` returns them; the fourth is zero."""

    def build(builder, x, y):
        padded = shuffle(builder, y, y, [*range(4), *range(4)])
        twelve = shuffle(builder, x, padded, range(ROW))
        zeros = ir.Constant(twelve.type, [0.0] * ROW)
        order = [ROW if lane % 4 == 3 else lane // 4 * 3 + lane % 4 for lane in range(ROW)]
        return shuffle(builder, twelve, zeros, order)

    if isinstance(eight, VectorType) and (eight.lanes, four) == (8, VectorType(eight.element, 4)):
        return codegen(VectorType(eight.element, ROW), (eight, four), build)


@intrinsic
def split_triples(typing, first, second, third):
    """Splits triples, stored in three consecutive vectors, into their first, second and third numbers."""

    def build(builder, a, b, c):
        lanes = a.type.count
        columns = []
        for k in range(3):
            places = [3 * i + k for i in range(lanes)]
            # First the lanes from the first two vectors, with 0 as a placeholder; then those from the third.
            early = shuffle(builder, a, b, [place if place < 2 * lanes else 0 for place in places])
            late = [i if place < 2 * lanes else place - lanes for i, place in enumerate(places)]
            columns.append(shuffle(builder, early, c, late))
        return cgutils.pack_array(builder, columns, a.type)

    if isinstance(first, VectorType) and first == second == third:
        return codegen(types.UniTuple(first, 3), (first, second, third), build)


@intrinsic
def join_triples(typing, first, second, third):
    """Joins first, second and third numbers to triples in three consecutive vectors; undoes `split_triples`."""

    def build(builder, a, b, c):
        lanes, rows = a.type.count, []
        for k in range(3):
            places = [divmod(k * lanes + i, 3) for i in range(lanes)]
            early = shuffle(builder, a, b, [n + lanes * which if which < 2 else 0 for n, which in places])
            late = [i if which < 2 else lanes + n for i, (n, which) in enumerate(places)]
            rows.append(shuffle(builder, early, c, late))
        return cgutils.pack_array(builder, rows, a.type)

    if isinstance(first, VectorType) and first == second == third:
        return codegen(types.UniTuple(first, 3), (first, second, third), build)


@intrinsic
def transpose(typing, rows):
    """Transposes n vectors of n lanes: lane i of vector k becomes lane k of vector i."""

    def build(builder, packed):
        parts = [builder.extract_value(packed, i) for i in range(rows.count)]
        half = rows.count // 2
        for _ in range(half.bit_length()):
            pairs = zip(parts[:half], parts[half:], strict=True)
            parts = [part for a, b in pairs for part in zip_lanes(builder, a, b)]
        return cgutils.pack_array(builder, parts, parts[0].type)

    if isinstance(rows, types.UniTuple) and rows.count == getattr(rows.dtype, "lanes", 0):
        return codegen(rows, (rows,), build)


def row_loader(lanes: int) -> Intrinsic:
    """Builds a function that loads `lanes` vectors of an array, each starting `at` elements after a given position."""
    index = ir.IntType(64)

    @intrinsic
    def load_rows(typing, array, positions, at):
        def generate(context, builder, sig, arguments):
            kind = sig.return_type.dtype
            data, firsts = (context.make_array(sig.args[i])(context, builder, arguments[i]).data for i in range(2))
            rows = []
            for i in range(lanes):
                first = builder.load(builder.gep(firsts, [ir.Constant(index, i)]))
                place = builder.gep(data, [builder.add(first, arguments[2])])
                row = builder.load(builder.bitcast(place, llvm_type(kind).as_pointer()))
                row.align = kind.element.bitwidth // 8
                rows.append(row)
            return cgutils.pack_array(builder, rows, llvm_type(kind))

        if _is_flat(array, *REALS) and _is_flat(positions, types.int64):
            return types.UniTuple(VectorType(array.dtype, lanes), lanes)(array, positions, types.intp), generate

    return load_rows


@intrinsic
def store_all(typing, array, at, vectors):
    """Stores vectors one after the other in a contiguous one-dimensional array, starting at index `at`."""

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


def _is_flat(array: Any, *elements: types.Type) -> bool:
    return isinstance(array, types.Array) and array.ndim == 1 and array.layout == "C" and array.dtype in elements
