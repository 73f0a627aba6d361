"""Joining channels on the CPU; PyTorch copies columns of rows that are not whole ones several times as slowly."""

from __future__ import annotations

from functools import cache

from numba import prange

from glassplat.kernels.backend.cpu import Kernel, kernel

CHUNK = 4096
"""Splats per task."""


@cache
def join_channels_forward(real: type) -> Kernel:
    """Fills the channels [C, G, 4] of colours [C, N, 3] and values [C, N], G >= N; zeros beyond."""
    zero = real(0.0)

    @kernel("join_channels_forward", real)
    def forward(colors, values, channels):
        cameras, count, total = values.shape[0], values.shape[1], channels.shape[1]
        chunks = (total + CHUNK - 1) // CHUNK
        for task in prange(cameras * chunks):
            c, chunk = task // chunks, task % chunks
            begin, end = chunk * CHUNK, min(total, (chunk + 1) * CHUNK)
            for n in range(begin, min(end, count)):
                channels[c, n, 0], channels[c, n, 1] = colors[c, n, 0], colors[c, n, 1]
                channels[c, n, 2], channels[c, n, 3] = colors[c, n, 2], values[c, n]
            for n in range(max(begin, count), end):
                channels[c, n, 0] = channels[c, n, 1] = channels[c, n, 2] = channels[c, n, 3] = zero

    return forward


@cache
def join_channels_backward(real: type) -> Kernel:
    """Fills the gradients of colours and values."""

    @kernel("join_channels_backward", real)
    def backward(v_channels, v_colors, v_values):
        cameras, count = v_values.shape
        chunks = (count + CHUNK - 1) // CHUNK
        for task in prange(cameras * chunks):
            c, chunk = task // chunks, task % chunks
            for n in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
                v_colors[c, n, 0], v_colors[c, n, 1] = v_channels[c, n, 0], v_channels[c, n, 1]
                v_colors[c, n, 2], v_values[c, n] = v_channels[c, n, 2], v_channels[c, n, 3]

    return backward
