"""Measured peaks of arithmetic and memory bandwidth of a GPU. Requires numba-cuda."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from functools import cache

import numpy as np
import torch
from numba import cuda

from benchmarks.gpu_roofline import Peaks
from glassplat.kernels.backend.cuda import Kernel, kernel

THREADS, CHAINS, ROUNDS = 256, 8, 4096


@cache
def multiply_adds(real: type) -> Kernel:
    """Kernel of independent chains of multiply-adds."""

    @kernel("multiply_adds", real, "real1 int")
    def chains(values, rounds):  # type: ignore[no-untyped-def]
        i = cuda.grid(1)
        x = values[i]
        a, b, c, d, e, f, g, h = x, x, x, x, x, x, x, x
        for _ in range(rounds):
            a, b, c, d = a * x + x, b * x + x, c * x + x, d * x + x
            e, f, g, h = e * x + x, f * x + x, g * x + x, h * x + x
        values[i] = a + b + c + d + e + f + g + h

    return chains


def measured_peaks() -> Peaks:
    """Peaks that simple kernels reach on the current GPU."""
    blocks = 32 * torch.cuda.get_device_properties(0).multi_processor_count
    values = torch.full((blocks * THREADS,), 0.5, device="cuda")
    arithmetic = seconds(lambda: multiply_adds(np.float32)(blocks, THREADS, values, ROUNDS))
    source = torch.zeros(2**28, device="cuda")
    target = torch.empty_like(source)
    copy = seconds(lambda: target.copy_(source))
    return Peaks(len(values) * CHAINS * ROUNDS / arithmetic, 2 * 4 * len(source) / copy)


def seconds(work: Callable[[], object], repeats: int = 7) -> float:
    """Median seconds of work on the GPU, measured by CUDA events."""
    work()
    found = []
    for _ in range(repeats):
        begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        begin.record()
        work()
        end.record()
        torch.cuda.synchronize()
        found.append(begin.elapsed_time(end) / 1e3)
    return statistics.median(found)
