"""Squares of harmonics on the CPU, in one pass; PyTorch writes them all down before it adds them up."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from glassplat.kernels.backend.cpu import Kernel, kernel

CHUNK = 1024
"""Gaussians per task; part of the result's rounding, so not to be tuned per machine."""
COLORS = 3


@cache
def energy_forward(real: type) -> Kernel:
    """Fills the sum of each chunk of Gaussians."""

    @kernel("harmonic_energy_forward", real)
    def forward(sh, sums):
        count, floats = sh.shape[0], sh.shape[1] * COLORS
        rows = sh.reshape(count, floats)
        for chunk in prange(sums.size):
            # A sum for each column, so that a row is a few vectors.
            squares: NDArray[Any] = np.zeros(floats, real)
            for n in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
                for j in range(floats):
                    squares[j] += rows[n, j] * rows[n, j]
            total = 0.0
            for j in range(COLORS, floats):
                total += np.float64(squares[j])
            sums[chunk] = total

    return forward


@cache
def energy_backward(real: type) -> Kernel:
    """Fills the gradient: `factor` times the harmonics, and 0 for the constant ones."""
    zero = real(0.0)

    @kernel("harmonic_energy_backward", real)
    def backward(sh, factor, gradient):
        count, floats = sh.shape[0], sh.shape[1] * COLORS
        rows, found = sh.reshape(count, floats), gradient.reshape(count, floats)
        for chunk in prange((count + CHUNK - 1) // CHUNK):
            for n in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
                row, out = rows[n], found[n]
                for j in range(floats):
                    out[j] = factor * row[j]
                for j in range(min(COLORS, floats)):
                    out[j] = zero

    return backward
