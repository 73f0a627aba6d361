"""Devices: which one to use, and which kernels belong to the one that holds a tensor."""

from __future__ import annotations

import functools
import importlib
import logging
import os
import warnings
from typing import TYPE_CHECKING, Any, Literal

from glassplat.kernels.cuda.toolchain import has_numba_cuda, install_hint, toolchain_problem

if TYPE_CHECKING:
    import torch

log = logging.getLogger("glassplat.kernels")

DeviceName = Literal["auto", "cpu", "cuda"]

SIMULATED = os.environ.get("NUMBA_ENABLE_CUDASIM", "0") not in ("", "0")
"""Numba's CUDA simulator is on: the CUDA kernels run in Python, on tensors of the CPU."""


class CudaUnavailableError(RuntimeError):
    """An NVIDIA GPU was asked for, and something that it needs is missing; the message says what to do."""


def kernels_for(operation: str, device: torch.device) -> Any:
    """The module that holds the kernels of an operation for tensors on a device.

    Args:
        operation: name of the operation's folder in `kernels/`, which holds `cpu.py` and `cuda.py`.
        device: where the operation's tensors are, the CPU or an NVIDIA GPU.

    Raises:
        CudaUnavailableError: the tensors are on a GPU, and its kernels cannot be used.
    """
    return _module(operation, "cuda" if device.type == "cuda" or SIMULATED else "cpu")


@functools.cache
def _module(operation: str, folder: str) -> Any:
    if folder == "cuda" and not has_numba_cuda():
        raise CudaUnavailableError(install_hint())
    return importlib.import_module(f"glassplat.kernels.{operation}.{folder}")


def chosen_device(name: DeviceName) -> torch.device:
    """The device for a name of the command line; `auto` is the GPU where it can be used. Says which in the log.

    Raises:
        CudaUnavailableError: `cuda` was asked for and cannot be used.
    """
    import torch

    problem = None if name == "cpu" else cuda_problem()
    if name == "cuda" and problem is not None:
        raise CudaUnavailableError(problem)
    if name == "cpu" or problem is not None:
        reason = "" if problem is None or not torch.cuda.is_available() else f"; {problem}"
        log.info("running on the CPU%s", reason)
        return torch.device("cpu")
    device = torch.device("cuda", torch.cuda.current_device())
    log.info("running on %s (%s)", torch.cuda.get_device_name(device), device)
    return device


def cuda_problem() -> str | None:
    """Why no GPU can be used, with the remedy; None where one can."""
    import torch

    if torch.version.cuda is None:
        return "PyTorch is built without CUDA; install another build (https://pytorch.org) or use --device cpu"
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        available = torch.cuda.is_available()
    if not available:
        reason = (
            " ".join(str(warning.message).split(". ")[0] for warning in said) or "no NVIDIA GPU or driver was found"
        )
        return (
            f"{reason.strip()}; `nvidia-smi` should list the GPU. Install or update the NVIDIA driver (CUDA "
            f"{torch.version.cuda} is needed) or use --device cpu"
        )
    major, minor = torch.cuda.get_device_capability()
    if (major, minor) < (7, 5):
        return f"the GPU has compute capability {major}.{minor}; 7.5 or newer is needed. Use --device cpu"
    return toolchain_problem()
