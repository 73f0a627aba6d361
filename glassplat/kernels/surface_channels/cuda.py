"""What Gaussians add to a shaded image, on the GPU: one thread for each Gaussian."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

from numba import cuda
from torch import Tensor

from glassplat.kernels.cuda.launch import Kernel, blocks_for, kernel
from glassplat.kernels.maths.surface import surface_maths
from glassplat.kernels.shade_environment.shaded import SURFACE_CHANNELS
from glassplat.kernels.surface_channels.cpu import gradients_like
from glassplat.kernels.tensor_checks import REAL_OF

THREADS = 128


def surface_channels(inputs: Sequence[Tensor]) -> Tensor:
    """As the operation; inputs in its order."""
    colors, extra = inputs[0], inputs[-1]
    count = colors.shape[0]
    channels = colors.new_zeros(count, SURFACE_CHANNELS + extra.shape[1])
    kernel_of = surface_channels_forward(REAL_OF[colors.dtype])
    kernel_of(blocks_for(count, THREADS), THREADS, *inputs, channels)
    return channels


def surface_channels_gradients(saved: Sequence[Tensor], v_channels: Tensor) -> tuple[Tensor, ...]:
    """As `glassplat.kernels.surface_channels.cpu.surface_channels_gradients`."""
    found = tuple(tensor.zero_() for tensor in gradients_like(v_channels))
    kernel_of = surface_channels_backward(REAL_OF[v_channels.dtype])
    kernel_of(blocks_for(v_channels.shape[0], THREADS), THREADS, *saved, v_channels, *found)
    return found


@cache
def surface_channels_forward(real: type) -> Kernel:
    """Fills the channels of what is seen."""
    describe, zero = surface_maths(real).describe, real(0.0)

    @kernel("surface_channels_forward", real, "real2 real2 real2 real2 real2 real1 real1 real2 real2")
    def forward(colors, radii, quats, log_scales, means, logit_strengths, eye, extra, channels):
        i = cuda.grid(1)
        if i < radii.shape[0] and radii[i, 0] > zero:
            describe(i, colors, quats, log_scales, means, logit_strengths, eye, extra, channels)

    return forward


@cache
def surface_channels_backward(real: type) -> Kernel:
    """Fills the gradients of what is seen."""
    describe_gradient, zero = surface_maths(real).describe_gradient, real(0.0)

    @kernel("surface_channels_backward", real, "real2 real2 real2 real2 real2 real2 real2 real1 real2")
    def backward(
        radii, quats, log_scales, channels, v_channels, v_colors, v_quats, v_logit_strengths, v_extra
    ):  # fmt: skip
        i = cuda.grid(1)
        if i < radii.shape[0] and radii[i, 0] > zero:
            describe_gradient(i, quats, log_scales, channels, v_channels, v_colors, v_quats, v_logit_strengths, v_extra)

    return backward
