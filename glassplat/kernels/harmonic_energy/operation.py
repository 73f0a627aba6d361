"""How much colours change with the direction of view."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from glassplat.kernels.harmonic_energy import reference as reference
from glassplat.kernels.harmonic_energy.cpu import CHUNK, energy_backward, energy_forward
from glassplat.kernels.records import REAL_OF, check_tensors


def harmonic_energy(sh: Tensor) -> Tensor:
    """Sum of the squares of all harmonics but the constant ones. Differentiable.

    Args:
        sh: [N, K, 3] coefficients, the constant one first.

    Raises:
        ValueError: it has another shape.
        TypeError: it is neither float32 nor float64, or not where there are kernels.
    """
    check_tensors({"sh": (sh, (sh.shape[0], *sh.shape[1:2], 3))})
    node = _EnergyOnCpu if sh.device.type == "cpu" else _EnergyOnGpu
    energy: Tensor = node.apply(sh)
    return energy


class _EnergyOnCpu(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sh: Tensor) -> Tensor:
        sh = sh.detach().contiguous()
        ctx.save_for_backward(sh)
        sums = torch.empty(-(-sh.shape[0] // CHUNK), dtype=torch.float64, device=sh.device)
        energy_forward(REAL_OF[sh.dtype])(sh.numpy(), sums.numpy())
        return sums.sum().to(sh.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_energy: Tensor) -> Tensor:
        (sh,) = ctx.saved_tensors
        gradient, real = torch.empty_like(sh), REAL_OF[sh.dtype]
        energy_backward(real)(sh.numpy(), real(2 * v_energy.item()), gradient.numpy())
        return gradient


class _EnergyOnGpu(torch.autograd.Function):
    """PyTorch's operations as one node: autograd would fill and add a gradient of the slice."""

    @staticmethod
    def forward(ctx: Any, sh: Tensor) -> Tensor:
        ctx.save_for_backward(sh)
        return reference.harmonic_energy(sh)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_energy: Tensor) -> Tensor:
        (sh,) = ctx.saved_tensors
        gradient = (2 * v_energy) * sh
        gradient[:, :1].zero_()
        return gradient
