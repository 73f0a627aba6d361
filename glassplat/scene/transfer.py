"""Numbers and tensors on their way to the device that computes, without making the program wait for it."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from torch import Tensor


def waits(device: torch.device) -> bool:
    """Whether the program has to wait before it can look at what this device computes, as for a GPU."""
    return device.type == "cuda"


def moved(tensor: Tensor, device: torch.device | str) -> Tensor:
    """The tensor on a device; on its way there, if it comes from memory: what is computed from it comes after it."""
    if tensor.device.type != "cpu" or torch.device(device).type != "cuda":
        return tensor.to(device)
    # Only from memory that stays in its place can a GPU fetch by itself.
    return tensor.pin_memory().to(device, non_blocking=True)


@lru_cache(maxsize=1024)
def constant(values: tuple[Any, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """A tensor of these numbers, or rows of them: the same one at every call, so leave it as it is."""
    return moved(torch.tensor(values, dtype=dtype, device="cpu"), device)
