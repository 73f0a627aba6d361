"""Adam in plain PyTorch: the definition of `glassplat.kernels.adam.adam`, by the same name and signature."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from glassplat.kernels.adam import Update


@torch.no_grad()
def adam(updates: Sequence[Update], *, betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-15) -> None:
    """Takes one Adam step in place; see `glassplat.kernels.adam.adam`."""
    for parameter, gradient, first_moment, second_moment, lr, step, decay in updates:
        if decay is not None:
            gradient = gradient + decay.reshape(parameter.shape[1:]) * parameter
        first_moment.mul_(betas[0]).add_(gradient, alpha=1 - betas[0])
        second_moment.mul_(betas[1]).add_(gradient * gradient, alpha=1 - betas[1])
        mean = first_moment / (1 - betas[0] ** step)
        deviation = torch.sqrt(second_moment / (1 - betas[1] ** step)) + eps
        rates = lr.reshape(parameter.shape[1:]) if isinstance(lr, Tensor) else lr
        parameter.sub_(rates * mean / deviation)
