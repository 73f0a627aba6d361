"""What the kernels need beside PyTorch, and what to do where it is missing. Importing this needs none of it."""

from __future__ import annotations

import importlib.util
from importlib.metadata import PackageNotFoundError, version

COMPILER_LIBRARIES = ("nvvm", "nvrtc")
"""Libraries without which Numba compiles nothing: the compiler, and the one that it asks for the known GPUs."""

EXTRAS = {12: "glassplat[cuda12]", 13: "glassplat[cuda]"}
"""What to install for each major version of CUDA."""


def has_numba_cuda() -> bool:
    """Whether the package is there that all CUDA kernels need."""
    return importlib.util.find_spec("numba_cuda") is not None


def install_hint() -> str:
    """What to say where numba-cuda is missing."""
    return "the CUDA kernels need numba-cuda; run `pip install 'glassplat[cuda]'` or use --device cpu"


def toolchain_problem() -> str | None:
    """Why kernels could not be compiled or loaded, with the remedy; None where nothing is known to be in the way."""
    if not has_numba_cuda():
        return install_hint()
    major = bindings_major()
    if major is None:
        return "numba-cuda is there, but not cuda-bindings; run `pip install 'glassplat[cuda]'` or use --device cpu"
    driver = driver_version()
    # Machine code of one major version of CUDA runs on every driver of that version and of later ones, on no other.
    if driver // 1000 < major:
        return (
            f"the NVIDIA driver knows CUDA {driver // 1000}.{driver % 1000 // 10}, but the kernels' compiler is that "
            f"of CUDA {major}; update the driver, or {_other_compiler(driver // 1000)}, or use --device cpu"
        )
    missing = [f"lib{name}" for name in COMPILER_LIBRARIES if not has_library(name)]
    if missing:
        extra = EXTRAS.get(major, EXTRAS[13])
        return f"the kernels' compiler lacks {' and '.join(missing)}; run `pip install '{extra}'` or use --device cpu"
    return None


def bindings_major() -> int | None:
    """The version of CUDA that cuda-bindings, and with it the compiler, is made for; None where it is missing."""
    try:
        return int(version("cuda-bindings").partition(".")[0])
    except PackageNotFoundError:
        return None


def driver_version() -> int:
    """The newest CUDA that the NVIDIA driver knows, as 1000 times the major plus 10 times the minor version."""
    from cuda.bindings import driver

    return int(driver.cuDriverGetVersion()[1])


def has_library(name: str) -> bool:
    """Whether a library of the CUDA toolkit can be loaded."""
    from cuda import pathfinder

    try:
        pathfinder.load_nvidia_dynamic_lib(name)
    except pathfinder.DynamicLibNotFoundError:
        return False
    return True


def _other_compiler(major: int) -> str:
    if major not in EXTRAS:
        return "take a machine with a newer one"
    return f"run `pip install '{EXTRAS[major]}'` in a fresh environment with a PyTorch of CUDA {major}"
