"""What every operation asks of its tensors."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

REAL_OF = {torch.float32: np.float32, torch.float64: np.float64}
"""Floating-point types that kernels are built for."""
DEVICES = ("cpu", "cuda")


def check_tensors(expected: dict[str, tuple[Tensor, tuple[int, ...]]]) -> None:
    """Raises unless all tensors have their expected shapes, one floating-point type and one device with kernels."""
    first_name, (first, _) = next(iter(expected.items()))
    dtype, device = first.dtype, first.device
    for name, (tensor, shape) in expected.items():
        if tensor.shape != shape:
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}; expected {shape}")
        if tensor.dtype != dtype or dtype not in REAL_OF:
            raise TypeError(
                f"{name} is {tensor.dtype} and {first_name} is {dtype}; expected float32 or float64 throughout"
            )
        if tensor.device != device or device.type not in DEVICES:
            check_device(name, tensor, first_name, first)


def check_device(name: str, tensor: Tensor, other_name: str, other: Tensor) -> None:
    """Raises unless a tensor is where another one is, on a device that has kernels."""
    if tensor.device.type not in DEVICES:
        raise TypeError(
            f"{name} is on {tensor.device}, but only the CPU and NVIDIA GPUs have kernels; move it there with .cpu()"
        )
    if tensor.device != other.device:
        raise TypeError(f"{name} is on {tensor.device} and {other_name} on {other.device}; expected one device for all")
