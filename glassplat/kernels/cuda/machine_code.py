"""How a CUDA kernel becomes machine code. No driver takes part: NVVM makes PTX, and nvJitLink a cubin of it."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, NamedTuple

from cuda import pathfinder
from cuda.core import Linker, LinkerOptions, ObjectCode
from numba import cuda

ENTRY = re.compile(r"\.entry\s+([\w$]+)\s*\(")
COMPILERS = (
    "numba",
    "numba-cuda",
    "llvmlite",
    "cuda-core",
    "nvidia-nvvm",
    "nvidia-nvjitlink",
    "nvidia-cuda-nvcc-cu12",
    "nvidia-nvjitlink-cu12",
)
"""Distributions that decide what the compiler makes."""


class MachineCode(NamedTuple):
    """A kernel for one compute capability: its name in the cubin, and the cubin."""

    entry: str
    cubin: bytes


def compiled(
    function: Callable[..., None],
    signature: tuple[Any, ...],
    capability: tuple[int, int],
    bounds: tuple[int, int] | None,
) -> MachineCode:
    """Compiles a kernel.

    Args:
        function: the kernel in Python.
        signature: the Numba types of its arguments.
        capability: compute capability (major, minor) of the GPU.
        bounds: threads of a block, and how many blocks a multiprocessor should hold at once.
    """
    text, _ = cuda.compile(
        function, signature, device=False, abi="numba", cc=capability, launch_bounds=bounds, debug=False, opt=True
    )
    (entry,) = ENTRY.findall(text)
    options = LinkerOptions(arch=f"sm_{capability[0]}{capability[1]}")
    linked = Linker(ObjectCode.from_ptx(text.encode()), options=options).link("cubin")
    return MachineCode(entry, bytes(linked.code))


@cache
def compiler_versions() -> str:
    """What a compiled kernel depends on beside its own code."""
    return " ".join([*(f"{name} {_version(name)}" for name in COMPILERS), f"linker {_linker_version()}"])


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "none"


def _linker_version() -> Any:
    from cuda.bindings import driver, nvjitlink

    try:
        return nvjitlink.version()
    except (RuntimeError, pathfinder.DynamicLibNotFoundError):
        # Without nvJitLink the driver links, and its version is what counts.
        return driver.cuDriverGetVersion()[1]
