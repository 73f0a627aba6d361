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
            start = b * block
            for j in range(min(block, count - start)):
                i = start + j
                g = gradient[i]
                m = betas[0] * first[i] + gains[0] * g
                v = betas[1] * second[i] + gains[1] * g * g
                first[i] = m
                second[i] = v
                parameter[i] -= rates[j] * m / (math.sqrt(v) * second_scale + eps)

    return step


def repeated_rates(rates: np.ndarray, elements: int) -> np.ndarray:
    """The rates over and over, as a whole number of rows, up to about the given number of elements."""
    return np.tile(rates, max(1, elements // max(1, rates.size)))
