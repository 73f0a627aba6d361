"""Adam on the CPU: one parallel pass over all parameters, gradients and moments."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache

import numpy as np
from numba import prange
from torch import Tensor

from glassplat.kernels.adam import Update
from glassplat.kernels.backend.cpu import Kernel, array_at, kernel
from glassplat.kernels.records import REAL_OF

BLOCK = 4096
"""Approximate number of elements per task: whole rows of a tensor whose columns have their own rates."""

# Columns of the table of updates: addresses of the four tensors, their size, and the number of their step sizes.
PARAMETER, GRADIENT, FIRST, SECOND, SIZE, COLUMNS = range(6)


def adam(flat: Sequence[Update], betas: tuple[float, float], eps: float) -> None:
    """Performs the updates, whose tensors are flat."""
    real = REAL_OF[flat[0].parameter.dtype]
    table, step_sizes, roots = [], [], []
    weight_decays: list[float] = []
    for update in flat:
        step_correction, root = update.corrections(betas)
        columns = 1 if update.decay is None else len(update.decay)
        rates = update.lr.tolist() if isinstance(update.lr, Tensor) else [update.lr] * columns
        table.append([*(tensor.data_ptr() for tensor in update[:4]), update.parameter.numel(), len(rates)])
        step_sizes += [rate * step_correction for rate in rates]
        weight_decays += [0.0] * len(rates) if update.decay is None else update.decay.tolist()
        roots.append(root)
    # 1 - 0.999 loses half of its digits in single precision, so the gains are computed in double and then rounded.
    decays, gains = tuple(real(b) for b in betas), tuple(real(1 - b) for b in betas)
    columns_of = np.array([step_sizes, weight_decays]).astype(real)
    adam_step(real)(np.array(table), columns_of, np.array(roots, real), decays, gains, real(eps))


@cache
def adam_step(real: type) -> Kernel:
    """Updates flat arrays in place; `columns` holds the step sizes and decays of all tensors, concatenated."""
    at = array_at(real)

    @kernel("adam", real)
    def step(table, columns, roots, betas, gains, eps):
        # Per tensor: the number of tasks before it, and step size and decay of each element of a task.
        count, known = table.shape[0], 0
        tasks, begins = np.zeros(count + 1, np.int64), np.zeros(count + 1, np.int64)
        for k in range(count):
            block = table[k, COLUMNS] * max(1, BLOCK // table[k, COLUMNS])
            tasks[k + 1] = tasks[k] + (table[k, SIZE] + block - 1) // block
            begins[k + 1] = begins[k] + block
        repeated = np.empty((2, begins[count]), real)
        for k in range(count):
            for begin in range(begins[k], begins[k + 1], table[k, COLUMNS]):
                for column in range(table[k, COLUMNS]):
                    repeated[0, begin + column] = columns[0, known + column]
                    repeated[1, begin + column] = columns[1, known + column]
            known += table[k, COLUMNS]
        for task in prange(tasks[count]):
            k = 0
            while tasks[k + 1] <= task:
                k += 1
            rates, decays = repeated[0, begins[k] : begins[k + 1]], repeated[1, begins[k] : begins[k + 1]]
            root = roots[k]
            first = (task - tasks[k]) * rates.size
            size = min(rates.size, table[k, SIZE] - first)
            p, g = at(table[k, PARAMETER], first, size), at(table[k, GRADIENT], first, size)
            m, v = at(table[k, FIRST], first, size), at(table[k, SECOND], first, size)
            for i in range(size):
                gradient = g[i] + decays[i] * p[i]
                mean = betas[0] * m[i] + gains[0] * gradient
                square = betas[1] * v[i] + gains[1] * gradient * gradient
                m[i], v[i] = mean, square
                p[i] -= rates[i] * mean / (math.sqrt(square) * root + eps)

    return step
