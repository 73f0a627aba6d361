"""Vectors in kernels, compared with NumPy lane by lane."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numba.core.errors import TypingError
from numpy.typing import NDArray

from glassplat.kernels.backend import cpu_vector as vector
from glassplat.kernels.backend.cpu import ZERO, Kernel, inlined, kernel
from glassplat.kernels.backend.cpu_vector import (
    ROW,
    constant,
    deinterleave,
    drop_fourths,
    interleave,
    item,
    pad_fourths,
    store,
    vector_kind,
)

REALS = [np.float32, np.float64]
LANES = [4, 8, 16]

kinds = pytest.mark.parametrize(("real", "lanes"), [(real, lanes) for real in REALS for lanes in LANES])


def numbers(real: type, count: int, low: float = -2.0, high: float = 2.0) -> NDArray[Any]:
    return np.random.default_rng(0).uniform(low, high, count).astype(real)


def arithmetic(real: type, lanes: int) -> Kernel:
    load, half, two = vector_kind(lanes).load, real(0.5), real(2)

    @kernel("vector_arithmetic", real, parallel=False)
    def compute(a, b, out):
        x, y = load(a, 0), load(b, 0)
        results = (x + y, x - y, x * y, x / y, -x, x + half, half - x, x * half, two / y)
        for i in range(9):
            store(out, i * lanes, results[i])

    return compute


@kinds
def test_arithmetic_is_that_of_each_lane(real: type, lanes: int) -> None:
    a, b = numbers(real, 2 * lanes).reshape(2, lanes)
    out = np.empty(9 * lanes, real)
    arithmetic(real, lanes)(a, b, out)
    half, two = real(0.5), real(2)
    expected = [a + b, a - b, a * b, a / b, -a, a + half, half - a, a * half, two / b]
    np.testing.assert_allclose(out.reshape(9, lanes), expected, rtol=4 * np.finfo(real).eps)


def choices(real: type, lanes: int) -> Kernel:
    full, load = vector_kind(lanes)
    select, bits_of, zero = vector.select, vector.bits_of, real(0)

    @kernel("vector_choices", real, parallel=False)
    def compute(a, b, out, bits):
        x, y = load(a, 0), load(b, 0)
        masks = (x < y, x <= y, x > y, x >= y, x < zero, (x < y) & (x > ZERO), (x < y) | (x > zero))
        for i in range(7):
            bits[i] = bits_of(masks[i])
            store(out, i * lanes, select(masks[i], x, full(zero)))
        store(out, 7 * lanes, vector.minimum(x, y))
        store(out, 8 * lanes, vector.maximum(x, y))

    return compute


@kinds
def test_masks_choose_lane_by_lane_and_never_where_there_is_nan(real: type, lanes: int) -> None:
    a, b = numbers(real, 2 * lanes).reshape(2, lanes)
    a[1], b[2], b[3] = np.nan, np.nan, a[3]
    out, bits = np.empty(9 * lanes, real), np.zeros(7, np.int64)
    choices(real, lanes)(a, b, out, bits)
    masks = [a < b, a <= b, a > b, a >= b, a < 0, (a < b) & (a > 0), (a < b) | (a > 0)]
    expected = [np.where(mask, a, 0) for mask in masks] + [np.where(a < b, a, b), np.where(a > b, a, b)]
    np.testing.assert_array_equal(out.reshape(9, lanes), expected)
    assert bits.tolist() == [int((mask * 2 ** np.arange(lanes)).sum()) for mask in masks]


def functions(real: type, lanes: int) -> Kernel:
    load = vector_kind(lanes).load
    ramp = constant(real, tuple(range(lanes)))
    fraction, times_power_of_2 = vector.fraction, vector.times_power_of_2

    @kernel("vector_functions", real, parallel=False)
    def compute(a, out):
        x = load(a, 0)
        results = (
            vector.absolute(x), vector.square_root(vector.absolute(x)), vector.exp(x), fraction(x),
            times_power_of_2(ramp() - x, x), ramp(),
        )  # fmt: skip
        for i in range(6):
            store(out, i * lanes, results[i])

    return compute


@kinds
def test_functions_are_those_of_each_lane(real: type, lanes: int) -> None:
    a = numbers(real, lanes, -50, 50)
    out, ramp = np.empty(6 * lanes, real), np.arange(lanes).astype(real)
    functions(real, lanes)(a, out)
    whole = np.trunc(a)
    expected = [abs(a), np.sqrt(abs(a)), np.exp(a), a - whole, (ramp - a) * real(2) ** whole, ramp]
    np.testing.assert_allclose(out.reshape(6, lanes), expected, rtol=4 * np.finfo(real).eps)


def reorders(real: type, lanes: int) -> Kernel:
    load = vector_kind(lanes).load

    @kernel("vector_reorders", real, parallel=False)
    def compute(a, out):
        four = (load(a, 0), load(a, lanes), load(a, 2 * lanes), load(a, 3 * lanes))
        mixed = interleave(four)
        again = deinterleave(mixed)
        for i in range(4):
            store(out, i * lanes, mixed[i])
            store(out, (4 + i) * lanes, again[i])

    return compute


@kinds
def test_four_vectors_interleave_and_come_apart_again(real: type, lanes: int) -> None:
    a, out = numbers(real, 4 * lanes), np.empty(8 * lanes, real)
    reorders(real, lanes)(a, out)
    np.testing.assert_array_equal(out[: 4 * lanes], a.reshape(4, lanes).T.ravel())
    np.testing.assert_array_equal(out[4 * lanes :], a)


def three_channels(real: type) -> Kernel:
    load = vector_kind(ROW).load

    @kernel("vector_three_channels", real, parallel=False)
    def compute(row, three, four):
        eight, rest = drop_fourths(load(row, 0))
        store(three, 0, eight)
        store(three, 8, rest)
        store(four, 0, pad_fourths(eight, rest))

    return compute


@pytest.mark.parametrize("real", REALS)
def test_the_fourth_channel_of_a_row_is_left_out_and_comes_back_as_zero(real: type) -> None:
    row, three, four = numbers(real, ROW), np.empty(12, real), np.empty(ROW, real)
    three_channels(real)(row, three, four)
    pixels = row.reshape(4, 4)
    np.testing.assert_array_equal(three, pixels[:, :3].ravel())
    np.testing.assert_array_equal(four.reshape(4, 4), np.c_[pixels[:, :3], np.zeros(4)])


def four_sums(real: type) -> Kernel:
    load = vector_kind(4).load

    @kernel("vector_sums", real, parallel=False)
    def compute(a, out):
        store(out, 0, vector.sums_of((load(a, 0), load(a, 4), load(a, 8), load(a, 12))))

    return compute


def sixteen_sums(real: type) -> Kernel:
    load = vector_kind(16).load

    @kernel("vector_sums_of_16", real, parallel=False)
    def compute(a, out):
        one, two, three, four = load(a, 0), load(a, 16), load(a, 32), load(a, 48)
        eight = (one, two, three, four, one, two, three, four)
        store(out, 0, vector.sums_of(eight + eight))

    return compute


@pytest.mark.parametrize("real", REALS)
def test_sums_of_as_many_vectors_as_lanes(real: type) -> None:
    a, out = numbers(real, 64), np.empty(16, real)
    four_sums(real)(a[:16], out)
    np.testing.assert_allclose(out[:4], a[:16].reshape(4, 4).sum(1), rtol=1e-5)
    sixteen_sums(real)(a, out)
    np.testing.assert_allclose(out, np.tile(a.reshape(4, 16).sum(1), 4), rtol=1e-5)


def bit_positions() -> Kernel:
    lowest_bit = vector.lowest_bit

    @kernel("vector_bits", np.float32, parallel=False)
    def compute(bits, found):
        count = 0
        while bits != 0:
            found[count] = lowest_bit(bits)
            bits &= bits - 1
            count += 1
        return count

    return compute


def test_bits_are_found_from_the_lowest() -> None:
    found = np.zeros(64, np.int64)
    count = bit_positions()(0b1001_0000_0110, found)
    assert found[:count].tolist() == [1, 2, 8, 11]


def test_an_item_is_an_element() -> None:
    @kernel("vector_item", np.float32, parallel=False)
    def compute(values, indices, at):
        return item(values, item(indices, at))

    assert compute(np.arange(5, dtype=np.float32), np.array([3, 4], np.int32), 1) == 4


def test_vectors_pass_through_functions_and_loops() -> None:
    full, load = vector_kind(16)
    zero = np.float32(0)

    @inlined
    def moved(x, by):
        return x + by, x * by

    @kernel("vector_loop", np.float32, parallel=False)
    def compute(values, out):
        total, product = full(zero), full(zero)
        for at in range(0, values.size, 16):
            total, product = moved(total + load(values, at), values[at])
        store(out, 0, total)
        store(out, 16, product)

    values, out = numbers(np.float32, 64), np.zeros(32, np.float32)
    compute(values, out)
    total = np.zeros(16, np.float32)
    for row in values.reshape(4, 16):
        total, product = total + row + row[0], (total + row) * row[0]
    np.testing.assert_allclose(out, np.concatenate([total, product]), rtol=1e-5)


def test_a_literal_that_would_be_float64_is_refused() -> None:
    load = vector_kind(8).load

    @kernel("vector_literal", np.float32, parallel=False)
    def compute(values):
        store(values, 0, load(values, 0) * 0.5)

    with pytest.raises(TypingError, match="mul"):
        compute(np.zeros(8, np.float32))


def test_only_contiguous_arrays_of_the_same_type_are_loaded() -> None:
    load = vector_kind(8).load

    @kernel("vector_load", np.float32, parallel=False)
    def compute(values, out):
        store(out, 0, load(values, 0))

    for values in (np.zeros(16, np.float32)[::2], np.zeros((2, 8), np.float32), np.zeros(8)):
        with pytest.raises(TypingError):
            compute(values, np.zeros(8, np.float32))
