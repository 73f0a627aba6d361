"""What each Gaussian adds to an image that is shaded after blending."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from glassplat.kernels.devices import kernels_for
from glassplat.kernels.tensor_checks import check_tensors


def surface_channels(
    colors: Tensor,
    radii: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    means: Tensor,
    logit_strengths: Tensor,
    eye: Tensor,
    extra: Tensor | None = None,
) -> Tensor:
    """Colour, normal and reflection strength of each Gaussian, side by side (3DGS-DR, Section 3.1).

    The normal is the Gaussian's shortest axis, the first of equally short ones, turned towards the eye. Which axis it
    is and on which side count as constants. It is 0 where a quaternion is 0 or not finite.

    Differentiable in `colors`, `quats`, `logit_strengths` and `extra`; the length of a quaternion has no effect, and
    its gradient is 0.

    Args:
        colors: [N, 3] of the projected Gaussians, sRGB.
        radii: [N, 2] half extents on screen; a Gaussian with 0 is not seen: its channels and gradients are 0.
        quats: [N, 4] orientations `wxyz` of any length.
        log_scales: [N, 3] logarithm of the standard deviation along each axis.
        means: [N, 3] centres, world units.
        logit_strengths: [N] logit of the reflection strength.
        eye: [3] camera centre in the world.
        extra: [N, E] more channels.

    Returns:
        [N, 7 + E]: colour, unit normal in world axes and strength, as `shade_environment` reads them, then `extra`.

    Raises:
        ValueError: shapes disagree.
        TypeError: tensors of different or unsupported floating-point types, or on different devices.
    """
    count = quats.shape[0]
    if extra is None:
        extra = means.new_empty(count, 0)
    check_tensors(
        {
            "colors": (colors, (count, 3)),
            "radii": (radii, (count, 2)),
            "quats": (quats, (count, 4)),
            "log_scales": (log_scales, (count, 3)),
            "means": (means, (count, 3)),
            "logit_strengths": (logit_strengths, (count,)),
            "eye": (eye, (3,)),
            "extra": (extra, (count, *extra.shape[1:2])),
        }
    )
    channels: Tensor = _SurfaceChannels.apply(
        colors, radii, quats, log_scales, means, logit_strengths, eye, extra
    )  # fmt: skip
    return channels


class _SurfaceChannels(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> Tensor:
        inputs = [tensor.detach().contiguous() for tensor in tensors]
        channels: Tensor = kernels_for("surface_channels", inputs[0].device).surface_channels(inputs)
        _, radii, quats, log_scales, *_ = inputs
        ctx.save_for_backward(radii, quats, log_scales, channels)
        return channels

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_channels: Tensor) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        kernels = kernels_for("surface_channels", v_channels.device)
        found = kernels.surface_channels_gradients(saved, v_channels.contiguous())
        v_colors, v_quats, v_logit_strengths, v_extra = found
        return v_colors, None, v_quats, None, None, v_logit_strengths, None, v_extra
