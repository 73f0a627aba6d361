"""Sharing uneven work between threads.

A `prange` gives each thread one contiguous run of tasks. Neighbouring Gaussians and tiles are alike (behind
the camera, empty, crowded), so one thread would get most of the work. Taken with a stride that visits every task once,
any run of tasks is a sample of all of them. Which thread does a task never shows in the result.
"""

from __future__ import annotations

from glassplat.kernels.cpu.jit import inlined

GOLDEN = 0.6180339887498949


@inlined
def even_stride(count):
    """A stride near the golden section of `count` and coprime to it: task `t` does piece `t * stride % count`."""
    stride = max(1, int(count * GOLDEN))
    while True:
        a, b = count, stride
        while b != 0:
            a, b = b, a % b
        if a <= 1:
            return stride
        stride += 1
