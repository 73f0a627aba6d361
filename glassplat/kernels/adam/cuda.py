"""Adam on the GPU: one thread per element; a launch covers several parameters, because many are small."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from functools import cache
from typing import Any

from numba import cuda
from torch import Tensor

from glassplat.kernels.adam import Update
from glassplat.kernels.backend.cuda import Kernel, blocks_for, kernel
from glassplat.kernels.records import REAL_OF

THREADS = 256
AT_ONCE = 5
"""Parameters per launch."""
NOTHING = (None, None, None, None, None, None, 0.0, 0.0)
"""Arguments of an absent parameter, in a launch with fewer."""


def adam(flat: Sequence[Update], betas: tuple[float, float], eps: float) -> None:
    """As `glassplat.kernels.adam.cpu.adam`."""
    step = adam_step(REAL_OF[flat[0].parameter.dtype])
    common = (betas[0], betas[1], 1 - betas[0], 1 - betas[1], eps)
    for begin in range(0, len(flat), AT_ONCE):
        updates = flat[begin : begin + AT_ONCE]
        blocks = sum(blocks_for(update.parameter.numel(), THREADS) for update in updates)
        own = itertools.chain(*(_arguments(update, betas) for update in updates))
        step(blocks, THREADS, *common, *own, *NOTHING * (AT_ONCE - len(updates)))


def _arguments(update: Update, betas: tuple[float, float]) -> tuple[Any, ...]:
    """Kernel arguments of a parameter, with as few tensor operations as possible: each costs more than a small step."""
    parameter, lr, decays, (rate, root) = update.parameter, update.lr, update.decay, update.corrections(betas)
    rates = None
    if isinstance(lr, Tensor):
        rates = lr.to(parameter.device, parameter.dtype).contiguous()
    else:
        rate *= lr
    if decays is not None:
        decays = decays.to(parameter.device, parameter.dtype).contiguous()
    return *update[:4], rates, decays, rate, root


@cache
def adam_step(real: type) -> Kernel:
    """Updates flat arrays in place; each starts at a new block, so that all threads of a block take the same branch.

    The step size is `rate`, multiplied by the column's entry in `rates` if there are any.
    """
    one = "real1 real1 real1 real1 real1 real1 real real "

    @kernel("adam", real, "real real real real real " + AT_ONCE * one)
    def step(
        beta_1, beta_2, gain_1, gain_2, eps,
        p_0, g_0, m_0, v_0, rates_0, decays_0, rate_0, scale_0,
        p_1, g_1, m_1, v_1, rates_1, decays_1, rate_1, scale_1,
        p_2, g_2, m_2, v_2, rates_2, decays_2, rate_2, scale_2,
        p_3, g_3, m_3, v_3, rates_3, decays_3, rate_3, scale_3,
        p_4, g_4, m_4, v_4, rates_4, decays_4, rate_4, scale_4,
    ):  # fmt: skip
        end_0 = (p_0.size + THREADS - 1) // THREADS
        end_1 = end_0 + (p_1.size + THREADS - 1) // THREADS
        end_2 = end_1 + (p_2.size + THREADS - 1) // THREADS
        end_3 = end_2 + (p_3.size + THREADS - 1) // THREADS
        block = cuda.blockIdx.x
        if block < end_0:
            p, g, m, v, rates, decays, rate, scale = p_0, g_0, m_0, v_0, rates_0, decays_0, rate_0, scale_0
        elif block < end_1:
            block -= end_0
            p, g, m, v, rates, decays, rate, scale = p_1, g_1, m_1, v_1, rates_1, decays_1, rate_1, scale_1
        elif block < end_2:
            block -= end_1
            p, g, m, v, rates, decays, rate, scale = p_2, g_2, m_2, v_2, rates_2, decays_2, rate_2, scale_2
        elif block < end_3:
            block -= end_2
            p, g, m, v, rates, decays, rate, scale = p_3, g_3, m_3, v_3, rates_3, decays_3, rate_3, scale_3
        else:
            block -= end_3
            p, g, m, v, rates, decays, rate, scale = p_4, g_4, m_4, v_4, rates_4, decays_4, rate_4, scale_4
        i = block * THREADS + cuda.threadIdx.x
        if i >= p.size:
            return
        gradient = g[i] + decays[i % decays.size] * p[i] if decays.size > 0 else g[i]
        mean = beta_1 * m[i] + gain_1 * gradient
        square = beta_2 * v[i] + gain_2 * gradient * gradient
        m[i], v[i] = mean, square
        step_size = rate * rates[i % rates.size] if rates.size > 0 else rate
        p[i] -= step_size * mean / (math.sqrt(square) * scale + eps)

    return step
