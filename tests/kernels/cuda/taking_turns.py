"""Numba's simulator with threads that take turns: each runs to its next barrier, in an order that is drawn every time.

The simulator has a thread of the system for each of CUDA's. They fight over the interpreter, and a barrier costs far
more than what lies between two of them. Here they are greenlets. As the order differs from launch to launch, so do
results that depend on it, and a kernel that lacks a barrier reads what is not there yet.
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
    """One of CUDA's threads, with what kernels ask the simulator's own class for."""

    def __init__(self, block: kernel.BlockManager, block_index: tuple[int, ...], index: tuple[int, ...]) -> None:
        super().__init__(block._f)
        self._manager = block
        self.blockIdx, self.threadIdx = kernelapi.Dim3(*block_index), kernelapi.Dim3(*index)
        width, height, _ = block._block_dim
        self.thread_id = index[0] + width * (index[1] + height * index[2])

    def syncthreads(self) -> None:
        """Gives all others their turn."""
        self.parent.switch()

    syncthreads_count = kernel.BlockThread.syncthreads_count
    syncthreads_and = kernel.BlockThread.syncthreads_and
    syncthreads_or = kernel.BlockThread.syncthreads_or


def run_block(self: kernel.BlockManager, block_index: tuple[int, ...], *arguments: Any) -> None:
    """Runs a block from barrier to barrier; raises what a thread raises."""
    threads = [Turn(self, block_index, index) for index in np.ndindex(*self._block_dim)]
    ORDER.shuffle(threads)
    for thread in threads:
        thread.switch(*arguments)
    while threads := [thread for thread in threads if not thread.dead]:
        ORDER.shuffle(threads)
        for thread in threads:
            thread.switch()


def take_turns() -> None:
    """Lets all kernels run so that the simulator of this process starts from now on."""
    kernel.BlockManager.run = run_block
    kernelapi.threading = SimpleNamespace(current_thread=getcurrent)
