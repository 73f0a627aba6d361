"""What Gaussians add to a shaded image, on the CPU, one Gaussian at a time."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import torch
from numba import prange
from torch import Tensor

from glassplat.kernels.cpu.jit import Kernel, kernel
from glassplat.kernels.maths.surface import surface_maths
from glassplat.kernels.shade_environment.shaded import SURFACE_CHANNELS
from glassplat.kernels.tensor_checks import REAL_OF


def surface_channels(inputs: Sequence[Tensor]) -> Tensor:
    """As the operation; inputs in its order."""
    colors, extra = inputs[0], inputs[-1]
    channels = colors.new_empty(colors.shape[0], SURFACE_CHANNELS + extra.shape[1])
    surface_channels_forward(REAL_OF[colors.dtype])(*(tensor.numpy() for tensor in (*inputs, channels)))
    return channels


def surface_channels_gradients(saved: Sequence[Tensor], v_channels: Tensor) -> tuple[Tensor, ...]:
    """Gradients of colors, quats, logit strengths and extra, given radii, quats, log scales and channels."""
    found = gradients_like(v_channels)
    tensors = (*saved, v_channels, *found)
    surface_channels_backward(REAL_OF[v_channels.dtype])(*(tensor.numpy() for tensor in tensors))
    return found


def gradients_like(v_channels: Tensor) -> tuple[Tensor, ...]:
    """Room for the gradients of colors, quats, logit strengths and extra."""
    count, width = v_channels.shape
    shapes = (count, 3), (count, 4), (count,), (count, width - SURFACE_CHANNELS)
    return tuple(torch.empty(shape, dtype=v_channels.dtype, device=v_channels.device) for shape in shapes)


@cache
def surface_channels_forward(real: type) -> Kernel:
    """Fills the channels."""
    describe, zero = surface_maths(real).describe, real(0.0)

    @kernel("surface_channels_forward", real)
    def forward(colors, radii, quats, log_scales, means, logit_strengths, eye, extra, channels):
        for i in prange(radii.shape[0]):
            if radii[i, 0] > zero:
                describe(i, colors, quats, log_scales, means, logit_strengths, eye, extra, channels)
            else:
                channels[i] = zero

    return forward


@cache
def surface_channels_backward(real: type) -> Kernel:
    """Fills the gradients."""
    describe_gradient, zero = surface_maths(real).describe_gradient, real(0.0)

    @kernel("surface_channels_backward", real)
    def backward(
        radii, quats, log_scales, channels, v_channels, v_colors, v_quats, v_logit_strengths, v_extra
    ):  # fmt: skip
        for i in prange(radii.shape[0]):
            if radii[i, 0] > zero:
                describe_gradient(
                    i, quats, log_scales, channels, v_channels, v_colors, v_quats, v_logit_strengths, v_extra
                )
            else:
                v_colors[i], v_quats[i], v_extra[i] = zero, zero, zero
                v_logit_strengths[i] = zero

    return backward
