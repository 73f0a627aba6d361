"""How CPU kernels are compiled: one place for the flags, the on-disk cache and its announcement."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numba.extending import register_jitable

log = logging.getLogger("glassplat.kernels")

# `nnan` and `ninf` stay out: with them a comparison with NaN is undefined, and culling bad Gaussians relies on it.
FAST_MATH = frozenset({"contract", "reassoc", "nsz", "arcp", "afn"})

# Forced, because the compiler balks at functions of many arrays, where a call costs more than the body.
inlined = register_jitable(forceinline=True, fastmath=set(FAST_MATH), error_model="numpy")
"""Marks a scalar function that kernels call; compiles for the CPU and for CUDA."""


class Kernel:
    """A compiled kernel that says so before it makes the user wait for the compiler."""

    def __init__(self, dispatcher: Any, name: str) -> None:
        self.dispatcher = dispatcher
        self.name = name
        self._ready = False

    def __call__(self, *arguments: Any) -> Any:
        if self._ready:
            return self.dispatcher(*arguments)
        self._ready = True
        if self._is_cached():
            return self.dispatcher(*arguments)
        log.info("compiling %s for this machine (first use only, then cached on disk) ...", self.name)
        start = time.perf_counter()
        result = self.dispatcher(*arguments)
        log.info("compiled %s in %.1f s", self.name, time.perf_counter() - start)
        return result

    def _is_cached(self) -> bool:
        folder = Path(self.dispatcher.stats.cache_path)
        return folder.is_dir() and any(folder.glob(f"*.{self.name}-*.nbi"))


def kernel(name: str, real: type, *, parallel: bool = True) -> Callable[[Callable[..., Any]], Kernel]:
    """Compiles a kernel function made by a factory for one floating-point type.

    The factory may close over functions marked `inlined` and over typed constants only: a closure
    over another compiled kernel never hits the on-disk cache.

    Args:
        name: the operation and direction, such as `composite_forward`.
        real: `np.float32` or `np.float64`, part of the cached file's name.
        parallel: whether the function holds a `prange`.
    """

    def decorate(function: Callable[..., Any]) -> Kernel:
        full_name = f"{name}_{np.dtype(real).name}"
        function.__name__ = full_name
        function.__qualname__ = full_name
        dispatcher = numba.njit(parallel=parallel, fastmath=set(FAST_MATH), error_model="numpy", cache=True)(function)
        return Kernel(dispatcher, full_name)

    return decorate
