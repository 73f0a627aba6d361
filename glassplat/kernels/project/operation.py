"""Projects Gaussians onto the screens of a batch of cameras."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from glassplat.kernels.devices import kernels_for
from glassplat.kernels.discs import SOLID
from glassplat.kernels.projection_inputs import projection_inputs
from glassplat.kernels.splats import CameraBatch, Projected, RawGaussians


def project(gaussians: RawGaussians, cameras: CameraBatch, *, sh_degree: int, near: float) -> Projected:
    """Projects Gaussians into cameras: activation, EWA splatting, bounds, culling and view-dependent colour.

    A Gaussian is culled in a camera when its depth is at most `near`, its centre is not on the kept side of
    the camera's clip plane, its coverage reaches 1/255 nowhere in the camera's window, or a parameter is not
    finite. Then its radii and all its other values are zero and it gets no gradient from that camera.

    A splat's covariance is J A Sigma A^T J^T plus 0.3 px^2 on the diagonal, A the upper 3x3 block of
    `cam_from_world` and J the Jacobian of the projection; beyond 1.3 times the image, J stays that of the border.
    Colours are seen along the direction from the camera centre, defined as -A^T t, to the mean, offset by 0.5 and
    clamped at 0. A mirrored, left-handed A is as good as any.

    Differentiable in all tensors of `gaussians` and in `cam_from_world`; `radii` carry no gradient.

    Args:
        gaussians: raw tensors, float32 or float64.
        cameras: of the same floating-point type; intrinsics, clip planes and windows get no gradient.
        sh_degree: highest degree of the spherical harmonics to evaluate; `gaussians.sh` may hold more, or
            none at all, which makes all colours zero.
        near: smallest depth (camera z, world units), at least 0.

    Raises:
        ValueError: a shape, the degree or `near` is out of range.
        TypeError: tensors of different or unsupported floating-point types, or on different devices.
    """
    inputs = projection_inputs(gaussians, cameras, scales=SOLID, sh_degree=sh_degree, near=near)
    return Projected(*_Project.apply(*inputs, cameras.width, cameras.height, sh_degree, near))


class _Project(torch.autograd.Function):
    """The kernels as one node of the autograd graph."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quats: Tensor, log_scales: Tensor, logit_opacities: Tensor, sh: Tensor,
        cam_from_world: Tensor, intrinsics: Tensor, clip_planes: Tensor, windows: Tensor,
        width: int, height: int, sh_degree: int, near: float,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        inputs = (means, quats, log_scales, logit_opacities, sh, cam_from_world, intrinsics, clip_planes, windows)
        tensors = [tensor.detach().contiguous() for tensor in inputs]
        degree = sh_degree if sh.shape[1] else -1
        kernels = kernels_for("project", means.device)
        outputs: tuple[Tensor, ...] = kernels.project(tensors, width, height, degree=degree, near=near)
        conics, radii = outputs[1], outputs[5]
        ctx.save_for_backward(*tensors[:7], radii, conics)
        ctx.size_and_degree = (width, height, degree)
        ctx.mark_non_differentiable(radii)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        *inputs, radii, conics = ctx.saved_tensors
        cotangents = [gradient.contiguous() for gradient in gradients[:5]]
        cam_from_world, needs_camera = inputs[5], bool(ctx.needs_input_grad[5])
        found, cameras = kernels_for("project", radii.device).project_gradients(
            inputs, *ctx.size_and_degree, seen=(radii, conics), cotangents=cotangents, needs_camera=needs_camera
        )
        pose_gradient = None
        if needs_camera:
            pose_gradient = torch.zeros_like(cam_from_world)
            pose_gradient[:, :3] = cameras.reshape(-1, 3, 4)
        return (*found, pose_gradient, None, None, None, None, None, None, None)
