"""How CPU kernels are compiled: one place for the flags."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numba.extending import register_jitable

from glassplat.kernels.cpu.cache import KernelCache
from glassplat.kernels.cpu.memory import keep_freed_memory
from glassplat.kernels.cpu.threads import entrance, prefer_openmp

# Before anything else in the process can start Numba's threads.
prefer_openmp()
keep_freed_memory()

HOW = "".join(Path(__file__).with_name(name).read_text() for name in ("jit.py", "vector.py"))
"""This file and what operators on vectors mean, which no kernel names: with its own code, they decide whether the cache
still holds."""

# `nnan` and `ninf` stay out: with them a comparison with NaN is undefined, and culling bad Gaussians relies on it.
FAST_MATH = frozenset({"contract", "reassoc", "nsz", "arcp", "afn"})

# Forced, because the compiler balks at functions of many arrays, where a call costs more than the body. Without
# reference counting too: one atomic increment per array and call, of counters that all threads share.
inlined = register_jitable(forceinline=True, _nrt=False, fastmath=set(FAST_MATH), error_model="numpy")
"""Marks a scalar function that kernels call; it must not create arrays. Compiles for the CPU and for CUDA."""


class Kernel:
    """A compiled kernel and its name."""

    def __init__(self, dispatcher: Any, name: str, *, parallel: bool) -> None:
        self.dispatcher = dispatcher
        self.name = name
        self._run: Callable[..., Any] = self._first_run if parallel else dispatcher

    def __call__(self, *arguments: Any) -> Any:
        """Runs the kernel, compiled at the first call unless the disk has it."""
        return self._run(*arguments)

    def _first_run(self, *arguments: Any) -> Any:
        """Starts the threads: only then it is known which they are, and how a parallel kernel may be entered."""
        self._run = entrance(self.dispatcher)
        return self._run(*arguments)

    @property
    def compilations(self) -> int:
        """How often this process had to compile it, once for each combination of argument types."""
        return int(self.dispatcher._cache.compilations)


def kernel(name: str, real: type, *, parallel: bool = True) -> Callable[[Callable[..., Any]], Kernel]:
    """Compiles a kernel function made by a factory for one floating-point type.

    The function may use functions marked `inlined` and typed constants, but no other compiled kernel.

    Args:
        name: the operation and direction, such as `composite_forward`.
        real: `np.float32` or `np.float64`, part of the cached file's name.
        parallel: whether the function holds a `prange`.
    """

    def decorate(function: Callable[..., Any]) -> Kernel:
        full_name = f"{name}_{np.dtype(real).name}"
        function.__name__ = full_name
        function.__qualname__ = full_name
        compiled = numba.njit(parallel=parallel, fastmath=set(FAST_MATH), error_model="numpy")
        dispatcher = compiled(function)
        dispatcher._cache = KernelCache(function, compiled, flags=f"parallel={parallel} {HOW}")
        return Kernel(dispatcher, full_name, parallel=parallel)

    return decorate
