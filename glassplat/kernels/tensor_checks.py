"""What every operation on the CPU asks of its tensors."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

REAL_OF = {torch.float32: np.float32, torch.float64: np.float64}
"""Floating-point types that kernels are built for."""


def check_tensors(expected: dict[str, tuple[Tensor, tuple[int, ...]]]) -> None:
    """Raises unless all tensors have their expected shapes, one floating-point type and lie on the CPU."""
    first_name, (first, _) = next(iter(expected.items()))
    for name, (tensor, shape) in expected.items():
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}; expected {shape}")
        if tensor.dtype not in REAL_OF or tensor.dtype != first.dtype:
            raise TypeError(
                f"{name} is {tensor.dtype} and {first_name} is {first.dtype}; expected float32 or float64 throughout"
            )
        if tensor.device.type != "cpu":
            raise TypeError(f"{name} is on {tensor.device}, but only the CPU has kernels; move it there with .cpu()")
