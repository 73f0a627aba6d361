"""Compilation and execution of CPU kernels: compiler flags, threads, and memory kept between steps.

Threads are OpenMP's if available, else those of Numba's own work queue. By default Numba prefers TBB. TBB's waiting
threads take cores from PyTorch's pool, which makes training take about twice as long, and they may deadlock when the
process exits. TBB therefore comes last, after the work queue, which is always available. Set NUMBA_THREADING_LAYER or
NUMBA_THREADING_LAYER_PRIORITY to choose.

Freed memory is kept by the process, up to a bound, if the C library supports that. Images, packed splats and gradient
rows are allocated again in every step. glibc returns freed memory to the system as soon as it exceeds twice the largest
of them, and the next step faults it in again in pages of 4 KiB. Set MALLOC_TRIM_THRESHOLD_, MALLOC_MMAP_THRESHOLD_ or
GLIBC_TUNABLES to choose.

A `prange` gives each thread one contiguous run of tasks. Neighbouring Gaussians and tiles are alike (behind the camera,
empty, crowded), so one thread would get most of the work. With a stride that visits every task once (`even_stride`),
any run of tasks is a sample of all of them. Results do not depend on the thread that runs a task.
"""

from __future__ import annotations

import ctypes
import logging
import os
import threading
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numba import types
from numba.extending import intrinsic, register_jitable
from numba.np.arrayobj import populate_array
from torch import Tensor

from glassplat.kernels.backend.cpu_cache import KernelCache

CHOSEN_BY_USER = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3
"""Codes of two parameters of glibc's `mallopt`."""
KEPT_BYTES = 128 << 20
"""Maximum of freed memory that a process keeps, in bytes."""
LARGEST_RECYCLED = 32 << 20
"""Maximum size of recycled arrays in bytes, as large as glibc allows; larger ones are returned when freed."""


def keep_freed_memory() -> bool:
    """Lets this process keep freed memory; False if the user has set it otherwise, or the C library cannot."""
    if any(name in os.environ for name in CHOSEN_BY_USER):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):  # Not glibc, or a system without one global C library.
        return False
    return bool(mallopt(TRIM_THRESHOLD, KEPT_BYTES)) and bool(mallopt(MMAP_THRESHOLD, LARGEST_RECYCLED))


log = logging.getLogger("glassplat.kernels")

LAYER_PRIORITY = ["omp", "workqueue", "tbb"]
LAYER_NAMES = {"omp": "OpenMP", "workqueue": "Numba's work queue", "tbb": "TBB"}

_work_queue_lock = threading.Lock()


def prefer_openmp() -> None:
    """Puts TBB last, unless the user has set a priority; must run before Numba starts its threads."""
    if "NUMBA_THREADING_LAYER_PRIORITY" not in os.environ:
        numba.config.THREADING_LAYER_PRIORITY = LAYER_PRIORITY


@cache
def threading_layer() -> str:
    """Numba's threading layer, `omp`, `workqueue` or `tbb`; the first call starts and logs its threads."""
    prefer_openmp()  # Again: Numba re-reads its variables when the environment has changed.
    threads = numba.get_num_threads()
    layer = str(numba.threading_layer())
    log.info("kernels run on %d thread%s of %s", threads, "" if threads == 1 else "s", LAYER_NAMES.get(layer, layer))
    return layer


def serialised(compiled: Callable[..., Any]) -> Callable[..., Any]:
    """Wrapper of a parallel kernel that any thread may call: the work queue aborts if two threads enter it."""
    if threading_layer() != "workqueue":
        return compiled

    def enter(*arguments: Any) -> Any:
        with _work_queue_lock:
            return compiled(*arguments)

    return enter


# Before anything else in the process can start Numba's threads.
prefer_openmp()
keep_freed_memory()

COMPILER_SOURCE = "".join(Path(__file__).with_name(name).read_text("utf-8") for name in ("cpu.py", "cpu_vector.py"))
"""Source of this file and of the vector operators, which kernels do not reference by name. It is part of the cache key,
along with a kernel's own code."""

# `nnan` and `ninf` stay out: with them a comparison with NaN is undefined, and culling bad Gaussians relies on it.
FAST_MATH = frozenset({"contract", "reassoc", "nsz", "arcp", "afn"})

# Inlining is forced, because the compiler declines functions of many arrays, whose call costs more than the body.
# Reference counting is off: it costs an atomic increment per array and call, of counters that all threads share.
inlined = register_jitable(
    forceinline=True, _nrt=False, no_cfunc_wrapper=True, fastmath=set(FAST_MATH), error_model="numpy"
)
"""Marks a scalar function that kernels call; it must not create arrays. Compiles for the CPU and for CUDA."""

ZERO, ONE, TWO, ENDLESS = np.float32(0.0), np.float32(1.0), np.float32(2.0), np.float32(np.inf)
"""Constants of functions for both floating-point types: exact in single precision, they do not promote it to double."""


class Kernel:
    """A compiled kernel and its name."""

    def __init__(self, dispatcher: Any, name: str, *, parallel: bool) -> None:
        self.dispatcher = dispatcher
        self.name = name
        self._run: Callable[..., Any] = self._first_run if parallel else dispatcher

    def __call__(self, *arguments: Any) -> Any:
        """Runs the kernel on the memory of tensors; the first call compiles it unless it is cached on disk."""
        return self._run(*map(_array, arguments))

    def _first_run(self, *arguments: Any) -> Any:
        """Starts the threads, which determines the threading layer and how a parallel kernel may be entered."""
        self._run = serialised(self.dispatcher)
        return self._run(*arguments)

    @property
    def compilations(self) -> int:
        """Number of compilations in this process, one for each combination of argument types."""
        return int(self.dispatcher._cache.compilations)


def _array(argument: Any) -> Any:
    """An argument with its tensors as arrays, which share their memory."""
    if isinstance(argument, tuple):
        return tuple(map(_array, argument))
    return argument.numpy() if isinstance(argument, Tensor) else argument


def kernel(name: str, real: type, *, parallel: bool = True) -> Callable[[Callable[..., Any]], Kernel]:
    """Compiles a kernel function made by a factory for one floating-point type.

    The function may use functions marked `inlined` and typed constants, but no other compiled kernel.

    Args:
        name: the operation and direction, such as `composite_forward`.
        real: `np.float32` or `np.float64`, part of the cached file's name.
        parallel: whether the function contains a `prange`.
    """

    def decorate(function: Callable[..., Any]) -> Kernel:
        full_name = f"{name}_{np.dtype(real).name}"
        function.__name__ = full_name
        function.__qualname__ = full_name
        compiled = numba.njit(parallel=parallel, no_cfunc_wrapper=True, fastmath=set(FAST_MATH), error_model="numpy")
        dispatcher = compiled(function)
        dispatcher._cache = KernelCache(function, compiled, flags=f"parallel={parallel} {COMPILER_SOURCE}")
        return Kernel(dispatcher, full_name, parallel=parallel)

    return decorate


GOLDEN = 0.6180339887498949


@inlined
def even_stride(count):
    """A stride near the golden section of `count` and coprime to it: task `t` processes item `t * stride % count`."""
    stride = max(1, int(count * GOLDEN))
    while True:
        a, b = count, stride
        while b != 0:
            a, b = b, a % b
        if a <= 1:
            return stride
        stride += 1


def array_at(real: type) -> Callable[..., Any]:
    """Builds `at(address, first, count)`: an array of `count` elements of type `real`, starting at index `first`.

    `real` may also be `np.bool_`. The array does not own its memory: the caller holds the tensors until the kernel has
    returned.
    """
    kind = types.Array(numba.from_dtype(np.dtype(real)), 1, "C")

    @intrinsic
    def at(typing, address, first, count):
        def generate(context, builder, sig, arguments):
            array = context.make_array(kind)(context, builder)
            size = context.get_constant(types.intp, np.dtype(real).itemsize)
            begin = builder.inttoptr(arguments[0], context.get_data_type(kind.dtype).as_pointer())
            data = builder.gep(begin, [arguments[1]])
            populate_array(array, data=data, shape=[arguments[2]], strides=[size], itemsize=size, meminfo=None)
            return array._getvalue()

        if all(isinstance(argument, types.Integer) for argument in (address, first, count)):
            return kind(types.int64, types.intp, types.intp), generate

    return at
