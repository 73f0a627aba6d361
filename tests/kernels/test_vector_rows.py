"""Rows in memory and vectors of their columns, compared with NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from glassplat.kernels.backend.cpu import Kernel, kernel
from glassplat.kernels.backend.cpu_vector import (
    join_triples,
    row_loader,
    split_triples,
    store,
    store_all,
    transpose,
    vector_kind,
)

kinds = pytest.mark.parametrize(
    ("real", "lanes"), [(real, lanes) for real in (np.float32, np.float64) for lanes in (4, 16)]
)


def sorting(real: type, lanes: int) -> Kernel:
    load = vector_kind(lanes).load

    @kernel("vector_thirds", real, parallel=False)
    def compute(values, columns, again):
        x, y, z = split_triples(load(values, 0), load(values, lanes), load(values, 2 * lanes))
        store(columns, 0, x)
        store(columns, lanes, y)
        store(columns, 2 * lanes, z)
        store_all(again, 1, join_triples(x, y, z))

    return compute


@kinds
def test_triples_are_taken_apart_and_put_together(real: type, lanes: int) -> None:
    values = np.arange(3 * lanes, dtype=real)
    columns, again = np.empty(3 * lanes, real), np.zeros(3 * lanes + 2, real)
    sorting(real, lanes)(values, columns, again)
    assert np.array_equal(columns.reshape(3, lanes), values.reshape(lanes, 3).T)
    assert np.array_equal(again, [0, *values, 0])


def turning(real: type, lanes: int) -> Kernel:
    load_rows = row_loader(lanes)

    @kernel("vector_transposed", real, parallel=False)
    def compute(values, positions, at, out):
        store_all(out, 0, transpose(load_rows(values, positions, at)))

    return compute


@kinds
def test_rows_anywhere_in_memory_become_columns(real: type, lanes: int) -> None:
    values = np.random.default_rng(0).uniform(size=40 * lanes).astype(real)
    positions = np.random.default_rng(1).integers(0, 38 * lanes, lanes)
    out = np.empty(lanes * lanes, real)
    turning(real, lanes)(values, positions, 3, out)
    expected = [values[position + 3 : position + 3 + lanes] for position in positions]
    assert np.array_equal(out.reshape(lanes, lanes), np.transpose(expected))
