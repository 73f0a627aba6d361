"""Adam on the CPU: one pass over parameter, gradient and both moments."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numba import prange

from glassplat.kernels.cpu.jit import Kernel, kernel


@cache
def adam_step(real: type) -> Kernel:
    """Updates flat arrays in place; `rates` holds the step sizes of consecutive elements and repeats over them."""

    @kernel("adam", real)
    def step(parameter, gradient, first, second, rates, betas, gains, second_scale, eps):
        count, block = parameter.size, rates.size
        for b in prange((count + block - 1) // block):
            # Slices from zero, because an index with an offset might be negative for all the compiler knows, and wrap.
            begin, end = b * block, min(count, (b + 1) * block)
            p, g, m, v = parameter[begin:end], gradient[begin:end], first[begin:end], second[begin:end]
            for i in range(end - begin):
                mean = betas[0] * m[i] + gains[0] * g[i]
                square = betas[1] * v[i] + gains[1] * g[i] * g[i]
                m[i], v[i] = mean, square
                p[i] -= rates[i] * mean / (math.sqrt(square) * second_scale + eps)

    return step


def repeated_rates(rates: np.ndarray, elements: int) -> np.ndarray:
    """The rates over and over, as a whole number of rows, up to about the given number of elements."""
    return np.tile(rates, max(1, elements // max(1, rates.size)))
