"""Comparison of values and gradients of CUDA kernels with those of their twins, on a GPU or in Numba's simulator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest
import torch
from torch import Tensor

from glassplat.kernels.backend.devices import SIMULATED, cuda_problem
from tests.kernels.gaussians_and_cameras import draw

if SIMULATED:
    from tests.kernels.cuda.taking_turns import take_turns

    take_turns()

DEVICE = torch.device("cpu" if SIMULATED else "cuda")
DTYPES = [torch.float64, torch.float32]
WIDTH, HEIGHT = (20, 17) if SIMULATED else (203, 117)
TOLERANCE = {torch.float64: 1e-9, torch.float32: 2e-4}


def on_a_device_or_skipped() -> None:
    """Skips the calling test module if there is neither a GPU nor the simulator."""
    if not SIMULATED and (problem := cuda_problem()) is not None:
        pytest.skip(f"no GPU to run the CUDA kernels on: {problem}", allow_module_level=True)


def many(few: int, number: int) -> int:
    """`few` in the simulator, `number` on a GPU."""
    return few if SIMULATED else number


def on_device(value: Any) -> Any:
    """Tensors, and records of tensors, copied to the device under test as new leaves."""
    if isinstance(value, Tensor):
        return value.detach().to(DEVICE).requires_grad_(value.requires_grad)
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*map(on_device, value))
    return value


def close(found: Tensor, expected: Tensor, factor: float = 1.0) -> None:
    """Asserts agreement relative to the largest entry, as gradients of one tensor differ by orders of magnitude."""
    assert found.shape == expected.shape
    if expected.numel() == 0:
        return
    if not expected.is_floating_point():
        assert torch.equal(found.cpu(), expected)
        return
    scale = max(float(expected.detach().abs().max()), 1e-12)
    tolerance = factor * TOLERANCE[expected.dtype] * scale
    torch.testing.assert_close(found.detach().cpu(), expected.detach(), rtol=0, atol=tolerance)


def check_gradients(
    found: Sequence[Tensor], expected: Sequence[Tensor], inputs: Sequence[Tensor], expected_inputs: Sequence[Tensor]
) -> None:
    """Asserts that the gradients of random sums of the outputs agree."""
    cotangents = [draw(*tensor.shape, seed=90 + i).to(tensor.dtype) for i, tensor in enumerate(expected)]
    gradients = torch.autograd.grad(found, inputs, [c.to(DEVICE) for c in cotangents], allow_unused=True)
    wanted = torch.autograd.grad(expected, expected_inputs, cotangents, allow_unused=True)
    for gradient, want, leaf in zip(gradients, wanted, expected_inputs, strict=True):
        zeros = torch.zeros_like(leaf)
        close(zeros if gradient is None else gradient, zeros if want is None else want, 10)
