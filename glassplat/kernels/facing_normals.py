"""Normals of Gaussians."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from glassplat.kernels.devices import kernels_for
from glassplat.kernels.tensor_checks import check_tensors


def facing_normals(quats: Tensor, log_scales: Tensor, means: Tensor, eye: Tensor) -> Tensor:
    """The shortest axis of each Gaussian, turned towards the eye (3DGS-DR, Section 3.1).

    Of axes that are equally short, the first is taken. Which axis it is and on which side count as constants.

    Differentiable in `quats` only; their length has no effect, and its gradient is 0.

    Args:
        quats: [N, 4] orientations `wxyz` of any length.
        log_scales: [N, 3] logarithm of the standard deviation along each axis.
        means: [N, 3] centres, world units.
        eye: [3] camera centre in the world.

    Returns:
        [N, 3] unit vectors in world axes; 0 where a quaternion is 0 or not finite.

    Raises:
        ValueError: shapes disagree.
        TypeError: tensors of different or unsupported floating-point types, or on different devices.
    """
    count = quats.shape[0]
    check_tensors(
        {
            "quats": (quats, (count, 4)),
            "log_scales": (log_scales, (count, 3)),
            "means": (means, (count, 3)),
            "eye": (eye, (3,)),
        }
    )
    normals: Tensor = _FacingNormals.apply(quats, log_scales, means, eye)
    return normals


class _FacingNormals(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> Tensor:
        quats, log_scales, means, eye = (tensor.detach().contiguous() for tensor in tensors)
        normals: Tensor = kernels_for("facing_normals", quats.device).facing_normals(quats, log_scales, means, eye)
        ctx.save_for_backward(quats, log_scales, normals)
        return normals

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_normals: Tensor) -> tuple[Tensor, None, None, None]:
        quats, log_scales, normals = ctx.saved_tensors
        gradient = kernels_for("facing_normals", quats.device).facing_normals_gradient
        return gradient(quats, log_scales, normals, v_normals.contiguous()), None, None, None
