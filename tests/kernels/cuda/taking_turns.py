"""Numba's simulator with cooperative threads: each runs to its next barrier, in an order that is drawn every time.

The simulator starts an operating system thread for each of CUDA's. They contend for the interpreter, and a barrier
costs far more than the work between two of them. Here they are greenlets. As the order differs from launch to launch,
so do results that depend on it, and a kernel that lacks a barrier reads values that have not been written yet.
"""

from __future__ import annotations

import random
from types import SimpleNamespace
from typing import Any

import numpy as np
from greenlet import getcurrent, greenlet
from numba.cuda.simulator import kernel, kernelapi

ORDER = random.Random(0)


class Turn(greenlet):
    """One CUDA thread, with the attributes that kernels request of the simulator's own class."""

    def __init__(self, block: kernel.BlockManager, block_index: tuple[int, ...], index: tuple[int, ...]) -> None:
        super().__init__(block._f)
        self._manager = block
        self.blockIdx, self.threadIdx = kernelapi.Dim3(*block_index), kernelapi.Dim3(*index)
        width, height, _ = block._block_dim
        self.thread_id = index[0] + width * (index[1] + height * index[2])

    def syncthreads(self) -> None:
        """Yields to all other threads."""
        self.parent.switch()

    syncthreads_count = kernel.BlockThread.syncthreads_count
    syncthreads_and = kernel.BlockThread.syncthreads_and
    syncthreads_or = kernel.BlockThread.syncthreads_or


def run_block(self: kernel.BlockManager, block_index: tuple[int, ...], *arguments: Any) -> None:
    """Runs a block from barrier to barrier and raises the errors of its threads."""
    threads = [Turn(self, block_index, index) for index in np.ndindex(*self._block_dim)]
    ORDER.shuffle(threads)
    for thread in threads:
        thread.switch(*arguments)
    while threads := [thread for thread in threads if not thread.dead]:
        ORDER.shuffle(threads)
        for thread in threads:
            thread.switch()


def take_turns() -> None:
    """Makes the simulator of this process run all kernels with cooperative threads."""
    kernel.BlockManager.run = run_block
    kernelapi.threading = SimpleNamespace(current_thread=getcurrent)
