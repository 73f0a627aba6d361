"""Energy of the view-dependent colours.

On the CPU squares of harmonics are added up in one pass; PyTorch writes them all down before it adds them up.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from glassplat.kernels.backend.cpu import Kernel, kernel
from glassplat.kernels.records import REAL_OF, check_tensors

CHUNK = 1024
"""Gaussians per task; part of the result's rounding, so not to be tuned per machine."""
COLORS = 3


def harmonic_energy(sh: Tensor) -> Tensor:
    """Sum of the squares of all harmonics but the constant ones. Differentiable.

    Args:
        sh: [N, K, 3] coefficients, the constant one first.

    Raises:
        ValueError: it has another shape.
        TypeError: it is neither float32 nor float64, or not where there are kernels.
    """
    check_tensors({"sh": (sh, (sh.shape[0], *sh.shape[1:2], 3))})
    node = _EnergyOnCpu if sh.device.type == "cpu" else _EnergyInTorch
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


class _EnergyInTorch(torch.autograd.Function):
    """PyTorch's operations as one node, for a GPU: autograd would fill and add a gradient of the slice."""

    @staticmethod
    def forward(ctx: Any, sh: Tensor) -> Tensor:
        ctx.save_for_backward(sh)
        return sh[:, 1:].square().sum()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_energy: Tensor) -> Tensor:
        (sh,) = ctx.saved_tensors
        gradient = (2 * v_energy) * sh
        gradient[:, :1].zero_()
        return gradient


@cache
def energy_forward(real: type) -> Kernel:
    """Fills the sum of each chunk of Gaussians."""

    @kernel("harmonic_energy_forward", real)
    def forward(sh, sums):  # type: ignore[no-untyped-def]
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
    def backward(sh, factor, gradient):  # type: ignore[no-untyped-def]
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
