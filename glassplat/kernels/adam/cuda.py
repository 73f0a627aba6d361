"""Adam on the GPU: one thread for each element."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache

from numba import cuda
from torch import Tensor

from glassplat.kernels.adam import Update
from glassplat.kernels.backend.cuda import Kernel, blocks_for, kernel
from glassplat.kernels.records import REAL_OF

THREADS = 256


def adam(flat: Sequence[Update], betas: tuple[float, float], eps: float) -> None:
    """As `glassplat.kernels.adam.cpu.adam`."""
    for update in flat:
        parameter, lr, (step_correction, root) = update.parameter, update.lr, update.corrections(betas)
        # As few small operations as can be: each costs more than the step of a small parameter.
        rates, rate = None, step_correction
        if isinstance(lr, Tensor):
            rates = lr.detach().to(parameter.device, parameter.dtype).contiguous()
        else:
            rate *= lr
        decays = update.decay
        if decays is not None:
            decays = decays.detach().to(parameter.device, parameter.dtype).contiguous()
        adam_step(REAL_OF[parameter.dtype])(
            blocks_for(parameter.numel(), THREADS), THREADS, *update[:4], rates, decays, rate,
            betas[0], betas[1], 1 - betas[0], 1 - betas[1], root, eps,
        )  # fmt: skip


@cache
def adam_step(real: type) -> Kernel:
    """Updates flat arrays in place; `rate` is the step size, times that of the column in `rates`."""

    @kernel("adam", real, "real1 real1 real1 real1 real1 real1 real real real real real real real")
    def step(
        parameter, gradient, first, second, rates, decays, rate, beta_1, beta_2, gain_1, gain_2, second_scale, eps
    ):  # fmt: skip
        i = cuda.grid(1)
        if i >= parameter.size:
            return
        g = gradient[i] + decays[i % decays.size] * parameter[i] if decays.size > 0 else gradient[i]
        mean = beta_1 * first[i] + gain_1 * g
        square = beta_2 * second[i] + gain_2 * g * g
        first[i], second[i] = mean, square
        step_size = rate * rates[i % rates.size] if rates.size > 0 else rate
        parameter[i] -= step_size * mean / (math.sqrt(square) * second_scale + eps)

    return step
