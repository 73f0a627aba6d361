"""Devices: the choice of one, and the kernel modules for a tensor's device."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import logging
import os
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any, Literal, get_args

if TYPE_CHECKING:
    import torch


COMPILER_LIBRARIES = ("nvvm", "nvrtc")
"""Libraries that Numba needs to compile: the compiler, and the one that lists the supported GPUs."""

EXTRAS = {12: "glassplat[cuda12]", 13: "glassplat[cuda]"}
"""Package to install for each major version of CUDA."""


log = logging.getLogger("glassplat.kernels")
_compile_times: list[float] = []


def compile_seconds() -> float:
    """Seconds that this process has spent compiling kernels; later processes load them from the cache."""
    return sum(_compile_times)


@contextmanager
def announce_compilation(name: str, where: str) -> Iterator[None]:
    """Logs that a kernel is being compiled, and how long it took."""
    log.info("compiling %s for %s (first use only, then cached on disk) ...", name, where)
    started = time.perf_counter()
    yield
    _compile_times.append(time.perf_counter() - started)
    log.info("compiled %s in %.1f s", name, _compile_times[-1])


def has_numba_cuda() -> bool:
    """Return whether numba-cuda, which all CUDA kernels need, is installed."""
    return importlib.util.find_spec("numba_cuda") is not None


def install_hint() -> str:
    """Hint on installing numba-cuda."""
    return "the CUDA kernels need numba-cuda; run `pip install 'glassplat[cuda]'` or use --device cpu"


def toolchain_problem() -> str | None:
    """Reason why kernels cannot be compiled or loaded, with the remedy; None if none is known."""
    if not has_numba_cuda():
        return install_hint()
    major = bindings_major()
    if major is None:
        return "numba-cuda is installed, but not cuda-bindings; run `pip install 'glassplat[cuda]'` or use --device cpu"
    driver = driver_version()
    # Machine code of one major version of CUDA runs on every driver of that version and of later ones, on no other.
    if driver // 1000 < major:
        return (
            f"the NVIDIA driver supports CUDA {driver // 1000}.{driver % 1000 // 10}, but the kernels' compiler is for "
            f"CUDA {major}; update the driver, or {_other_compiler(driver // 1000)}, or use --device cpu"
        )
    missing = [f"lib{name}" for name in COMPILER_LIBRARIES if not has_library(name)]
    if missing:
        extra = EXTRAS.get(major, EXTRAS[13])
        return f"the kernels' compiler lacks {' and '.join(missing)}; run `pip install '{extra}'` or use --device cpu"
    return None


def bindings_major() -> int | None:
    """The major version of CUDA that cuda-bindings and the compiler are built for; None if not installed."""
    try:
        return int(version("cuda-bindings").partition(".")[0])
    except PackageNotFoundError:
        return None


def driver_version() -> int:
    """The newest CUDA that the NVIDIA driver supports, as 1000 times the major plus 10 times the minor version."""
    from cuda.bindings import driver

    return int(driver.cuDriverGetVersion()[1])


def has_library(name: str) -> bool:
    """Return whether a library of the CUDA toolkit can be loaded."""
    from cuda import pathfinder

    try:
        pathfinder.load_nvidia_dynamic_lib(name)
    except pathfinder.DynamicLibNotFoundError:
        return False
    return True


def _other_compiler(major: int) -> str:
    if major not in EXTRAS:
        return "use a machine with a newer one"
    return f"run `pip install '{EXTRAS[major]}'` in a fresh environment with a PyTorch of CUDA {major}"


DeviceName = Literal["auto", "cpu", "cuda"]

SIMULATED = os.environ.get("NUMBA_ENABLE_CUDASIM", "0") not in ("", "0")
"""Numba's CUDA simulator is on: the CUDA kernels run in Python, on tensors of the CPU."""


class CudaUnavailableError(RuntimeError):
    """An NVIDIA GPU was requested, but something that it needs is missing; the message gives the remedy."""


def kernels_for(operation: str, device: torch.device) -> Any:
    """The module that holds the kernels of an operation for tensors on a device.

    Args:
        operation: name of the operation's folder in `kernels/`, which holds `cpu.py` and `cuda.py`.
        device: device of the operation's tensors, the CPU or an NVIDIA GPU.

    Raises:
        CudaUnavailableError: the tensors are on a GPU, and its kernels cannot be used.
    """
    return _module(operation, "cuda" if device.type == "cuda" or SIMULATED else "cpu")


@functools.cache
def _module(operation: str, folder: str) -> Any:
    if folder == "cuda" and not has_numba_cuda():
        raise CudaUnavailableError(install_hint())
    return importlib.import_module(f"glassplat.kernels.{operation}.{folder}")


def chosen_device(name: str | torch.device) -> torch.device:
    """The device for a name from the command line; `auto` is the GPU if it can be used. Logs the choice.

    Raises:
        CudaUnavailableError: `cuda` was requested but cannot be used.
        ValueError: the name is not one of these.
    """
    import torch

    name = str(name)
    if torch.cuda.is_available() and name == f"cuda:{torch.cuda.current_device()}":
        name = "cuda"
    if name not in get_args(DeviceName):
        raise ValueError(f"device is {name!r}; expected auto, cpu or cuda, which is PyTorch's current GPU")
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
    """Reason why no GPU can be used, with the remedy; None if one can."""
    import torch

    if torch.version.cuda is None:
        return "PyTorch is built without CUDA; install another build (https://pytorch.org) or use --device cpu"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        available = torch.cuda.is_available()
    if not available:
        reason = (
            " ".join(str(warning.message).split(". ")[0] for warning in caught) or "no NVIDIA GPU or driver was found"
        )
        return (
            f"{reason.strip()}; `nvidia-smi` should list the GPU. Install or update the NVIDIA driver (CUDA "
            f"{torch.version.cuda} is needed) or use --device cpu"
        )
    major, minor = torch.cuda.get_device_capability()
    if (major, minor) < (7, 5):
        return f"the GPU has compute capability {major}.{minor}; 7.5 or newer is needed. Use --device cpu"
    return toolchain_problem()
