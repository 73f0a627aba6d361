"""Measured multiply-add peak of the machine, the reference for the compositing kernel."""

from __future__ import annotations

import numba
import numpy as np
from numba import prange

from benchmarks.timing import median_seconds

LANES, ROUNDS = 256, 200_000


@numba.njit(parallel=True, fastmath=True)
def _multiply_add(seeds: np.ndarray, rounds: int) -> float:
    total = np.float32(0)
    for worker in prange(seeds.shape[0]):
        sums = np.full(LANES, seeds[worker], dtype=np.float32)
        factor, addend = seeds[worker], np.float32(1e-3)
        for _ in range(rounds):
            for lane in range(LANES):
                sums[lane] = sums[lane] * factor + addend
        total += sums.sum()
    return float(total)


def peak_multiply_adds(threads: int) -> float:
    """Single-precision multiply-adds per second of this machine on `threads` threads."""
    numba.set_num_threads(threads)
    seeds = np.full(threads, 0.5, dtype=np.float32)
    seconds = median_seconds(lambda: _multiply_add(seeds, ROUNDS), repeats=5)
    return threads * LANES * ROUNDS / seconds
