"""Projects discs (2DGS) onto the screens of a batch of cameras."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from glassplat.kernels.backend.devices import kernels_for
from glassplat.kernels.projection_inputs import projection_inputs
from glassplat.kernels.records import FLAT, CameraBatch, ProjectedDiscs, RawGaussians

SMOOTH = 6
"""Outputs with a gradient; they come first."""


def project_discs(gaussians: RawGaussians, cameras: CameraBatch, *, sh_degree: int, near: float) -> ProjectedDiscs:
    """Projects discs into cameras: activation, the map from pixels to the disc, outlines, culling and colour.

    A disc lies in the plane of the first two axes of its rotation and falls off with two deviations; the third axis is
    its normal. It ends at three deviations, or before that where its coverage falls to 1/255.

    A disc is culled in a camera when the depth of its centre is at most `near`, its centre is not on the kept side of
    the camera's clip plane, it is seen from its edge (the cosine between its normal and the ray to its centre is at
    most 1e-3), its outline lies beside the camera's window, its opacity is at most 1/255, it has no size (a log scale
    beyond -40 or 40), or a parameter or its map is not finite. Then its radii and all its other values are zero and it
    gets no gradient from that camera. A disc that reaches through the near plane is kept where what lies behind
    that plane may be seen: then its outline is the whole image, and `composite_discs` leaves out what lies before it.

    Colours are those of `project`: along the direction from the camera centre, -A^T t, to the mean. A mirrored,
    left-handed A is as good as any.

    Differentiable in all tensors of `gaussians` and in `cam_from_world`; outlines and radii carry no gradient.

    Args:
        gaussians: raw tensors with `log_scales` [N, 2], float32 or float64.
        cameras: of the same floating-point type; intrinsics, clip planes and windows get no gradient.
        sh_degree: highest degree of the spherical harmonics to evaluate; `gaussians.sh` may hold more, or none at all,
            which makes all colours zero.
        near: smallest depth (camera z, world units), at least 0.

    Raises:
        ValueError: a shape, the degree or `near` is out of range.
        TypeError: tensors of different or unsupported floating-point types, or on different devices.
    """
    inputs = projection_inputs(gaussians, cameras, scales=FLAT, sh_degree=sh_degree, near=near)
    return ProjectedDiscs(*_ProjectDiscs.apply(*inputs, cameras.width, cameras.height, sh_degree, near))


class _ProjectDiscs(torch.autograd.Function):
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
        kernels = kernels_for("project_discs", means.device)
        outputs: tuple[Tensor, ...] = kernels.project_discs(tensors, width, height, degree=degree, near=near)
        ctx.save_for_backward(*tensors[:7], outputs[-1], outputs[1])
        ctx.size_and_degree = (width, height, degree)
        ctx.mark_non_differentiable(*outputs[SMOOTH:])
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        *inputs, radii, maps = ctx.saved_tensors
        cotangents = [gradient.contiguous() for gradient in gradients[:SMOOTH]]
        cam_from_world, needs_camera = inputs[5], bool(ctx.needs_input_grad[5])
        found, cameras = kernels_for("project_discs", radii.device).project_discs_gradients(
            inputs, *ctx.size_and_degree, seen=(radii, maps), cotangents=cotangents, needs_camera=needs_camera
        )
        pose_gradient = None
        if needs_camera:
            pose_gradient = torch.zeros_like(cam_from_world)
            pose_gradient[:, :3] = cameras.reshape(-1, 3, 4)
        return (*found, pose_gradient, None, None, None, None, None, None, None)
