"""Compiles every CUDA kernel without a GPU, and reports its resources: python -m tools.compile_kernels.

NVVM compiles PTX for a compute capability. nvJitLink, the linker of Numba on a GPU, turns it into machine code and
reports registers, spills and shared memory. Neither needs a driver.
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import pkgutil
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import _lru_cache_wrapper
from types import SimpleNamespace
from typing import Any, NamedTuple
from unittest import mock

import numpy as np

from glassplat.kernels.backend.devices import has_library

CAPABILITIES = ((8, 0), (9, 0), (12, 0))
SUPPORTED = ((7, 5), (8, 0), (8, 6), (8, 9), (9, 0), (10, 0), (12, 0))
PACKAGE = "glassplat.kernels"
COSTS = ("shared bytes", "local bytes")


class Resources(NamedTuple):
    """Resources of a kernel: registers and spilled bytes (stores and loads) per thread, bytes of shared memory per
    block, and bytes of local memory per thread. Arrays that do not fit into registers are in local memory.
    """

    registers: int
    spilled: int
    shared: int
    local: int


def all_kernels(real: type = np.float32) -> list[Any]:
    """All kernels of the package for one floating-point type, sorted by name."""
    package = importlib.import_module(PACKAGE)
    names = [entry.name for entry in pkgutil.walk_packages(package.__path__, f"{PACKAGE}.")]
    modules = [importlib.import_module(name) for name in names if name.rpartition(".")[2].startswith("cuda")]
    factories: set[Callable[..., Any]] = {
        value
        for module in modules
        for value in vars(module).values()
        if isinstance(value, _lru_cache_wrapper)
        and value.__module__ == module.__name__
        and first_parameter(value) in ("real", "key")
    }
    made = (kernel for factory in factories for kernel in kernels_of(factory, real))
    return sorted(made, key=lambda kernel: str(kernel.name))


def kernels_of(factory: Callable[..., Any], real: type) -> list[Any]:
    """The kernels of a factory; both variants if it has a parameter `flat` for discs and ellipsoids."""
    if "flat" in inspect.signature(factory).parameters:
        return [factory(real, flat) for flat in (True, False)]
    return [factory(real) if first_parameter(factory) == "real" else factory()]


def first_parameter(factory: Callable[..., Any]) -> str | None:
    """First parameter of a kernel factory: `real`, or `key` for kernels without floating-point numbers."""
    return next(iter(inspect.signature(factory).parameters), None)


@contextmanager
def without_device(capability: tuple[int, int]) -> Iterator[None]:
    """Lets Numba compile without a driver, and without NVRTC, which it queries for supported GPUs.

    If NVRTC is installed, as on every machine with a GPU, its answer is used, as in normal operation.
    """
    device = SimpleNamespace(compute_capability=capability)
    with ExitStack() as stack:
        stack.enter_context(mock.patch("numba.cuda.dispatcher.get_current_device", return_value=device))
        if not has_library("nvrtc"):
            stack.enter_context(mock.patch("numba.cuda.cudadrv.nvrtc.get_supported_ccs", return_value=SUPPORTED))
            stack.enter_context(mock.patch("numba.cuda.cuda_paths._get_nvrtc_path", return_value=None))
        yield


def ptx_of(kernel: Any, capabilities: Sequence[tuple[int, int]] = CAPABILITIES) -> list[str]:
    """PTX of a kernel for each compute capability."""
    from numba import types
    from numba.cuda import compiler

    options = {"debug": None, "lineinfo": False, "fastmath": False, "opt": None, "abi_info": None, "forceinline": False}
    with without_device(capabilities[0]):
        # As `numba.cuda.compile`, but with typing and lowering, which take most of the time, once for all capabilities.
        library, _ = compiler._compile_pyfunc_with_fixup(
            kernel.function, types.void(*kernel.signature), device=False, cc=capabilities[0], abi="numba",
            launch_bounds=None, lto=False, **options,
        )  # fmt: skip
        return ["".join(library.get_asm_strs(cc=capability)) for capability in capabilities]


def linked(ptx: str, capability: tuple[int, int]) -> Resources:
    """Links PTX into machine code, and parses the resources from the report of the linker."""
    from cuda.bindings import nvjitlink

    handle = nvjitlink.create(2, [f"-arch=sm_{capability[0]}{capability[1]}", "-verbose"])
    try:
        data = ptx.encode()
        nvjitlink.add_data(handle, nvjitlink.InputType.PTX, data, len(data), "kernel")
        nvjitlink.complete(handle)
        report = bytearray(nvjitlink.get_info_log_size(handle))
        nvjitlink.get_info_log(handle, report)
    finally:
        nvjitlink.destroy(handle)
    return read_report(report.decode())


def read_report(report: str) -> Resources:
    """Parses registers, spills, shared and local memory from the text of the linker."""

    def largest(pattern: str) -> int:
        return max((int(number) for number in re.findall(pattern, report)), default=0)

    frame = r"(\d+) bytes stack frame"
    spilled = largest(r"(\d+) bytes spill stores") + largest(r"(\d+) bytes spill loads")
    return Resources(largest(r"Used (\d+) registers"), spilled, largest(r"(\d+) bytes smem"), largest(frame))


def table(kernels: Sequence[Any]) -> list[str]:
    """A Markdown table of the resources of kernels, with one column of registers per compute capability."""
    heads = ["kernel", *(f"sm_{major}{minor}" for major, minor in CAPABILITIES), *COSTS]
    lines = ["| " + " | ".join(heads) + " |", "| --- " * len(heads) + "|"]
    for kernel in kernels:
        found = [linked(ptx, cc) for ptx, cc in zip(ptx_of(kernel), CAPABILITIES, strict=True)]
        cells = [f"{r.registers}" + (f" ({r.spilled} B spilled)" if r.spilled else "") for r in found]
        cells += [str(found[-1].shared), str(found[-1].local)]
        lines.append("| " + " | ".join([kernel.name, *cells]) + " |")
    return lines


def main() -> int:
    """Prints the table of all kernels."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    for line in table(all_kernels()):
        print(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
