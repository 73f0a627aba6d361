"""Adam on the CPU: one pass over parameter, gradient and both moments."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache

import numpy as np
from numba import prange
from torch import Tensor

from glassplat.kernels.cpu.jit import Kernel, kernel
from glassplat.kernels.tensor_checks import REAL_OF

BLOCK = 4096
"""Elements per task, about."""


def adam(
    flat: Sequence[Tensor], lr: float | Tensor, betas: tuple[float, float], eps: float,
    *, corrections: tuple[float, float],
) -> None:  # fmt: skip
    """Updates flat parameter and moments; `corrections` are the factors on the step size and on the root moment."""
    real = REAL_OF[flat[0].dtype]
    rates = lr.detach().numpy().astype(np.float64) if isinstance(lr, Tensor) else np.full(1, lr)
    rates = repeated_rates((rates * corrections[0]).astype(real), BLOCK)
    # 1 - 0.999 loses half of its digits in single precision, so the gains are rounded from the double.
    decays, gains = tuple(real(b) for b in betas), tuple(real(1 - b) for b in betas)
    adam_step(real)(*(t.numpy() for t in flat), rates, decays, gains, real(corrections[1]), real(eps))


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
