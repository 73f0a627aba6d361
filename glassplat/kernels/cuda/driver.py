"""A kernel on one GPU, and the way it is launched: two calls of the driver, and memory that is written, not created."""

from __future__ import annotations

import ctypes
import struct
import threading
from typing import Any

from cuda.bindings import driver
from cuda.core import ObjectCode
from numba import cuda

from glassplat.kernels.cuda.machine_code import MachineCode

SLOT = 8
"""Bytes that each argument has to itself."""


class LoadedKernel:
    """A kernel in the memory of one GPU.

    Attributes:
        name: of the kernel.
    """

    def __init__(self, code: MachineCode, name: str, index: int, layout: struct.Struct) -> None:
        """Loads machine code.

        Args:
            code: for the GPU.
            name: of the kernel.
            index: of the GPU, as torch counts.
            layout: how the arguments lie in memory, each at the beginning of a slot.
        """
        self.name = name
        with current_gpu(index):
            self._context = driver.CUcontext(int(checked("cuCtxGetCurrent", driver.cuCtxGetCurrent())))
            self._library = ObjectCode.from_cubin(code.cubin, name=name)
            self._function = driver.CUfunction(int(self._library.get_kernel(code.entry).handle))
        self._layout, self._memory = layout, ctypes.create_string_buffer(layout.size)
        first = ctypes.addressof(self._memory)
        self._slots = (ctypes.c_void_p * (layout.size // SLOT))(*range(first, first + layout.size, SLOT))
        self._address = ctypes.addressof(self._slots)
        # The threads of a backward pass launch too, and the driver reads the arguments while others may run.
        self._lock = threading.Lock()

    def launch(self, blocks: int, threads: int, stream: int, values: list[Any]) -> None:
        """Queues the kernel.

        Args:
            blocks: how many of them.
            threads: in each block.
            stream: the address of a stream of the GPU's primary context.
            values: what the slots hold.
        """
        with self._lock:
            self._layout.pack_into(self._memory, 0, *values)
            # A thread that has not used the GPU yet has no context, and one may be busy with another GPU.
            current = checked("cuCtxGetCurrent", driver.cuCtxGetCurrent())
            elsewhere = int(current) != int(self._context)
            if elsewhere:
                checked("cuCtxPushCurrent", driver.cuCtxPushCurrent(self._context))
            try:
                done = driver.cuLaunchKernel(
                    self._function, blocks, 1, 1, threads, 1, 1, 0, stream, self._address, 0
                )  # fmt: skip
            finally:
                if elsewhere:
                    checked("cuCtxPopCurrent", driver.cuCtxPopCurrent())
            checked(self.name, done)


def current_gpu(index: int) -> Any:
    """A block in which a GPU's primary context, the one that torch uses too, is the current one."""
    return cuda.gpus[index]


def checked(what: str, answer: tuple[Any, ...]) -> Any:
    """What the driver answered.

    Raises:
        RuntimeError: the driver refused; the message names the call and the driver's error.
    """
    if answer[0] != 0:
        raise RuntimeError(f"{what} failed on the GPU: {answer[0].name}")
    return answer[1] if len(answer) > 1 else None
