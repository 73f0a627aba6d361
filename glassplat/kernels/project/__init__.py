"""Projects Gaussians into a batch of cameras: ellipsoids (3DGS), and discs (2DGS)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from glassplat.kernels.backend.devices import kernels_for
from glassplat.kernels.maths.harmonics import check_sh_degree
from glassplat.kernels.records import (
    FLAT,
    SOLID,
    CameraBatch,
    Projected,
    ProjectedDiscs,
    RawGaussians,
    check_tensors,
    expected_shapes,
)


def projection_inputs(
    gaussians: RawGaussians, cameras: CameraBatch, *, scales: int, sh_degree: int, near: float
) -> tuple[Tensor, ...]:
    """The raw tensors, poses [C, 4, 4], intrinsics [C, 4], clip planes [C or 0, 4] and windows [C, 4].

    Args:
        gaussians: raw tensors, float32 or float64.
        cameras: of the same floating-point type.
        scales: number of scales per Gaussian.
        sh_degree: highest degree of the spherical harmonics to evaluate.
        near: smallest depth.
    """
    num_cameras = cameras.cam_from_world.shape[0]
    expected = {
        **expected_shapes(gaussians, scales),
        "cam_from_world": (cameras.cam_from_world, (num_cameras, 4, 4)),
        "intrinsics": (cameras.intrinsics, (num_cameras, 4)),
    }
    if cameras.clip_planes is not None:
        expected["clip_planes"] = (cameras.clip_planes, (num_cameras, 4))
    if cameras.windows is not None:
        expected["windows"] = (cameras.windows, (num_cameras, 4))
    check_tensors(expected)
    check_sh_degree(sh_degree, gaussians.sh.shape[1])
    if not near >= 0:
        raise ValueError(f"near is {near}; expected a depth of at least 0")
    clip_planes = cameras.clip_planes
    if clip_planes is None:
        clip_planes = gaussians.means.new_empty(0, 4)
    windows = cameras.windows
    if windows is None:
        poses = cameras.cam_from_world
        windows = _whole_images(poses.shape[0], cameras.width, cameras.height, poses.dtype, poses.device)
    return (*gaussians, cameras.cam_from_world, cameras.intrinsics, clip_planes, windows)


def _degree(gaussians: RawGaussians, sh_degree: int) -> int:
    """SH degree for the kernels: -1 without coefficients."""
    return sh_degree if gaussians.sh.shape[1] else -1


@lru_cache(maxsize=64)
@torch.inference_mode(False)
def _whole_images(count: int, width: int, height: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Windows of whole images, in a cached tensor; filled on the device, because copying from the host synchronises."""
    windows = torch.zeros(count, 4, dtype=dtype, device=device)
    windows[:, 2].fill_(width)
    windows[:, 3].fill_(height)
    return windows


@dataclass
class GradientSum:
    """Shared tensors in which projections of the same Gaussians accumulate their gradients.

    Most of a gradient is zeros, for Gaussians that a camera does not see; filling and adding them costs more than the
    rest. Each projection passes a token to the next one, so that autograd visits them from the last to the first, and
    only the first returns the sum.

    Attributes:
        token: token of the previous projection.
        found: sum of later projections, if their backward pass has run; empty otherwise. Graph nodes hold this list and
            not the record, because its token refers back to them.
    """

    token: Tensor | None = None
    found: list[Tensor] = field(default_factory=list)


def project(
    gaussians: RawGaussians,
    cameras: CameraBatch,
    *,
    sh_degree: int,
    near: float,
    gradient_sum: GradientSum | None = None,
) -> Projected:
    """Projects Gaussians into cameras: activation, EWA splatting, bounds, culling and view-dependent colour.

    A Gaussian is culled in a camera if its depth is at most `near`, its centre is on the clipped side of the clip
    plane, its coverage stays below 1/255 throughout the camera's window, or a parameter is not finite. Then its radii
    and all its other outputs are zero and it gets no gradient from that camera.

    A splat's covariance is J A Sigma A^T J^T plus 0.3 px^2 on the diagonal, with A the upper 3x3 block of
    `cam_from_world` and J the Jacobian of the projection. Beyond 1.3 times the image, J is that of the border. Colours
    are evaluated along the direction from the camera centre, defined as -A^T t, to the mean, offset by 0.5 and clamped
    at 0. A may be a mirrored, left-handed pose.

    Differentiable in all tensors of `gaussians` and in `cam_from_world`; `radii` carry no gradient.

    Args:
        gaussians: raw tensors, float32 or float64.
        cameras: of the same floating-point type; intrinsics, clip planes and windows get no gradient.
        sh_degree: highest degree of the spherical harmonics to evaluate; `gaussians.sh` may hold more, or
            none at all, which makes all colours zero.
        near: smallest depth (camera z, world units), at least 0.
        gradient_sum: shared by all projections of these same tensors whose gradients are to be summed.
    """
    inputs = projection_inputs(gaussians, cameras, scales=SOLID, sh_degree=sh_degree, near=near)
    gradient_sum = gradient_sum or GradientSum()
    *fields, gradient_sum.token = _Project.apply(
        *inputs, gradient_sum.token, gradient_sum.found,
        cameras.width, cameras.height, _degree(gaussians, sh_degree), near,
    )  # fmt: skip
    return Projected(*fields)


class _Project(torch.autograd.Function):
    """The kernels as one node of the autograd graph."""

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        *inputs, _, ctx.shared, width, height, degree, near = arguments
        tensors = [tensor.detach().contiguous() for tensor in inputs]
        kernels = kernels_for("project", tensors[0].device)
        *outputs, radii = kernels.project(tensors, width, height, degree=degree, near=near)
        ctx.save_for_backward(*tensors[:7], radii)
        ctx.size_and_degree = (width, height, degree)
        ctx.mark_non_differentiable(radii)
        ctx.set_materialize_grads(False)
        return *outputs, radii, radii.new_empty(0)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        *inputs, radii = ctx.saved_tensors
        # A gradient of the token means that the next projection has run in this backward pass.
        accumulated = None if gradients[6] is None else list(ctx.shared)
        ctx.shared.clear()
        found, cameras = kernels_for("project", radii.device).project_gradients(
            inputs, *ctx.size_and_degree,
            radii=radii, cotangents=_cotangents(gradients, radii), needs_camera=bool(ctx.needs_input_grad[5]),
            accumulated=accumulated,
        )  # fmt: skip
        pose_gradient, v_token = _pose_gradient(cameras, inputs[5]) if ctx.needs_input_grad[5] else None, None
        if ctx.needs_input_grad[9]:
            ctx.shared.extend(found)
            found, v_token = [None] * 5, radii.new_empty(0)
        return *found, pose_gradient, None, None, None, v_token, None, None, None, None, None


def _pose_gradient(cameras: Tensor, cam_from_world: Tensor) -> Tensor:
    """Gradient of poses [C, 4, 4] from those of their first three rows [C, 12]."""
    gradient = torch.zeros_like(cam_from_world)
    gradient[:, :3] = cameras.reshape(-1, 3, 4)
    return gradient


def _cotangents(gradients: Sequence[Tensor | None], radii: Tensor) -> list[Tensor]:
    """Gradients of means2d, conics, depths, opacities and colors; zeros where autograd passes None."""
    return [
        radii.new_zeros(*radii.shape[:2], *rest) if gradient is None else gradient.contiguous()
        for gradient, rest in zip(gradients[:5], ((2,), (3,), (), (), (3,)), strict=True)
    ]


SMOOTH = 6
"""Number of differentiable outputs; they come first."""


def project_discs(gaussians: RawGaussians, cameras: CameraBatch, *, sh_degree: int, near: float) -> ProjectedDiscs:
    """Projects discs into cameras: activation, the map from pixels to the disc, outlines, culling and colour.

    A disc lies in the plane of the first two axes of its rotation and falls off with two standard deviations; the third
    axis is its normal. It is cut off at three deviations, or earlier if its coverage falls to 1/255.

    A disc is culled in a camera if the depth of its centre is at most `near`, its centre is on the clipped side of the
    clip plane, its outline lies outside the camera's window, or it is seen edge-on (cosine between its normal and the
    ray to its centre at most 1e-3). It is also culled if its opacity is at most 1/255, a log scale is beyond -40 or 40,
    or a parameter or its map is not finite. Then its radii and all its other outputs are zero and it gets no gradient
    from that camera. A disc that crosses the near plane is kept if its part beyond that plane may be visible. Then its
    outline is the whole image, and `composite_discs` omits the part in front of the plane.

    Colours are those of `project`: along the direction from the camera centre, -A^T t, to the mean. A may be a
    mirrored, left-handed pose.

    Differentiable in all tensors of `gaussians` and in `cam_from_world`; outlines and radii carry no gradient.

    Args:
        gaussians: raw tensors with `log_scales` [N, 2], float32 or float64.
        cameras: of the same floating-point type; intrinsics, clip planes and windows get no gradient.
        sh_degree: highest degree of the spherical harmonics to evaluate; `gaussians.sh` may hold more, or none at all,
            which makes all colours zero.
        near: smallest depth (camera z, world units), at least 0.
    """
    inputs = projection_inputs(gaussians, cameras, scales=FLAT, sh_degree=sh_degree, near=near)
    degree = _degree(gaussians, sh_degree)
    return ProjectedDiscs(*_ProjectDiscs.apply(*inputs, cameras.width, cameras.height, degree, near))


class _ProjectDiscs(torch.autograd.Function):
    """The kernels as one node of the autograd graph."""

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        *inputs, width, height, degree, near = arguments
        tensors = [tensor.detach().contiguous() for tensor in inputs]
        kernels = kernels_for("project", tensors[0].device)
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
        needs_camera = bool(ctx.needs_input_grad[5])
        found, cameras = kernels_for("project", radii.device).project_discs_gradients(
            inputs, *ctx.size_and_degree, seen=(radii, maps), cotangents=cotangents, needs_camera=needs_camera
        )
        pose_gradient = _pose_gradient(cameras, inputs[5]) if needs_camera else None
        return (*found, pose_gradient, None, None, None, None, None, None, None)
