"""Projection in plain PyTorch: the definition of `glassplat.kernels.project.project`, same name and signature."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from glassplat.kernels.maths.harmonics import SH_CONSTANTS
from glassplat.kernels.maths.projection import ALPHA_MIN, LOW_PASS, TANGENT_MARGIN
from glassplat.kernels.records import CameraBatch, Projected, RawGaussians


class _Ellipses(NamedTuple):
    """Screen covariances [C, N] (xx, xy, yy), low-pass included, and their determinant."""

    xx: Tensor
    xy: Tensor
    yy: Tensor
    determinant: Tensor


def project(gaussians: RawGaussians, cameras: CameraBatch, *, sh_degree: int, near: float) -> Projected:
    """Projects Gaussians into cameras; see `glassplat.kernels.project.project`."""
    with torch.no_grad():
        visible = _project_all(gaussians, cameras, sh_degree, near)[1]
    # Where nothing is seen the arithmetic runs on harmless stand-ins: a NaN masked afterwards would still reach the
    # gradients, as NaN times zero.
    seen = visible.any(dim=0)
    harmless = RawGaussians(*(_where(seen, tensor, torch.ones_like(tensor)) for tensor in gaussians))
    projected, _ = _project_all(harmless, cameras, sh_degree, near, visible)
    return Projected(*(_where(visible, tensor, torch.zeros_like(tensor)) for tensor in projected))


def _where(mask: Tensor, value: Tensor, other: Tensor) -> Tensor:
    """`torch.where` with a mask over the leading dimensions."""
    return torch.where(mask.reshape(mask.shape + (1,) * (value.dim() - mask.dim())), value, other)


def _project_all(
    gaussians: RawGaussians, cameras: CameraBatch, sh_degree: int, near: float, visible: Tensor | None = None
) -> tuple[Projected, Tensor]:
    """Everything projected, culled or not, and what is visible [C, N]."""
    linear, offset = cameras.cam_from_world[:, :3, :3], cameras.cam_from_world[:, :3, 3]
    in_camera = gaussians.means @ linear.mT + offset[:, None]
    depths = in_camera[..., 2]
    if visible is not None:
        in_camera = _where(visible, in_camera, torch.ones_like(in_camera))
    tangents = in_camera[..., :2] / in_camera[..., 2:]
    means2d = tangents * cameras.intrinsics[:, None, :2] + cameras.intrinsics[:, None, 2:]
    opacities = torch.sigmoid(gaussians.logit_opacities).expand(depths.shape)
    ellipse = _ellipses(gaussians, cameras, tangents, in_camera[..., 2])
    if visible is not None:
        ellipse = _Ellipses(*(_where(visible, entry, torch.ones_like(entry)) for entry in ellipse))
    conics = torch.stack([ellipse.yy, -ellipse.xy, ellipse.xx], dim=-1) / ellipse.determinant[..., None]
    radii = _half_extents(ellipse, opacities).detach()
    colors = _colors(gaussians, linear, offset, sh_degree)
    projected = Projected(means2d, conics, depths, opacities, colors.clamp(min=0), radii)
    if visible is None:
        visible = _visible(projected, gaussians, cameras, near) & ellipse.determinant.isfinite()
        visible &= colors.isfinite().all(dim=-1)
    return projected, visible


def _ellipses(gaussians: RawGaussians, cameras: CameraBatch, tangents: Tensor, depths: Tensor) -> _Ellipses:
    """EWA projection: J A Sigma A^T J^T with the Jacobian J at the tangents held near the image, plus the low-pass."""
    focal, center = cameras.intrinsics[:, None, :2], cameras.intrinsics[:, None, 2:]
    size = torch.tensor([cameras.width, cameras.height], dtype=focal.dtype)
    margin = TANGENT_MARGIN * size / 2
    held = torch.clamp(tangents, -(center + margin) / focal, (size - center + margin) / focal)
    scale = focal / depths[..., None]
    linear = cameras.cam_from_world[:, None, :3, :3]
    footprint = scale[..., None] * (linear[..., :2, :] - held[..., None] * linear[..., 2:, :])
    x, y = (footprint @ _axes(gaussians)).unbind(dim=-2)
    xx, xy, yy = (x * x).sum(-1), (x * y).sum(-1), (y * y).sum(-1)
    # Lagrange's identity: |x|^2 |y|^2 - (x.y)^2 = |x cross y|^2 does not cancel for needles.
    spread = torch.linalg.cross(x, y).square().sum(-1)
    determinant = spread + LOW_PASS * (xx + yy) + LOW_PASS**2
    return _Ellipses(xx + LOW_PASS, xy, yy + LOW_PASS, determinant)


def _axes(gaussians: RawGaussians) -> Tensor:
    """Principal axes as columns [N, 3, 3], each as long as its standard deviation."""
    return rotations(gaussians.quats) * torch.exp(gaussians.log_scales)[:, None, :]


def rotations(quats: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3] of quaternions [N, 4] `wxyz` of any length."""
    w, x, y, z = (quats / quats.square().sum(-1, keepdim=True).sqrt()).unbind(-1)
    return torch.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ], dim=-1).reshape(-1, 3, 3)  # fmt: skip


def _half_extents(ellipse: _Ellipses, opacities: Tensor) -> Tensor:
    """Half extents [C, N, 2] of the region with alpha >= 1/255; zero where there is none."""
    reach = 2 * torch.log(opacities / ALPHA_MIN).clamp(min=0)
    return torch.sqrt(reach[..., None] * torch.stack([ellipse.xx, ellipse.yy], dim=-1))


def _colors(gaussians: RawGaussians, linear: Tensor, offset: Tensor, sh_degree: int) -> Tensor:
    """Colours [C, N, 3] before the clamp; zero where there are no coefficients."""
    if gaussians.sh.shape[1] == 0:
        return torch.zeros_like(gaussians.means).expand(linear.shape[0], -1, -1)
    centers = -(linear.mT @ offset[..., None])[..., 0]
    outwards = gaussians.means - centers[:, None]
    basis = sh_basis(outwards / outwards.square().sum(-1, keepdim=True).sqrt())
    count = (sh_degree + 1) ** 2
    return 0.5 + torch.einsum("cnk,nkd->cnd", basis[..., :count], gaussians.sh[:, :count])


def sh_basis(directions: Tensor) -> Tensor:
    """Real spherical harmonics [..., 16] of degrees 0 to 3 at unit directions [..., 3], with the signs of 3DGS."""
    c0, c1, c_xy, c_zz, c_xx, c_yxx, c_xyz, c_yzz, c_zzz, c_zxx = SH_CONSTANTS
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    return torch.stack([
        torch.full_like(x, c0),
        -c1 * y, c1 * z, -c1 * x,
        c_xy * x * y, -c_xy * y * z, c_zz * (2 * zz - xx - yy), -c_xy * x * z, c_xx * (xx - yy),
        -c_yxx * y * (3 * xx - yy), c_xyz * x * y * z, -c_yzz * y * (4 * zz - xx - yy),
        c_zzz * z * (2 * zz - 3 * xx - 3 * yy), -c_yzz * x * (4 * zz - xx - yy), c_zxx * z * (xx - yy),
        -c_yxx * x * (xx - 3 * yy),
    ], dim=-1)  # fmt: skip


def _visible(projected: Projected, gaussians: RawGaussians, cameras: CameraBatch, near: float) -> Tensor:
    """What is in front of the near plane, on the kept side of the clip plane and in the window [C, N]."""
    raw = (gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.logit_opacities[:, None])
    norm = gaussians.quats.square().sum(-1)
    usable = torch.cat(raw, dim=-1).isfinite().all(dim=-1) & norm.isfinite() & (norm > 0)
    visible = usable & (projected.depths > near) & projected.depths.isfinite()
    if cameras.clip_planes is not None:
        visible &= cameras.clip_planes[:, :3] @ gaussians.means.T + cameras.clip_planes[:, 3:] > 0
    windows = cameras.windows
    if windows is None:
        windows = torch.tensor([[0, 0, cameras.width, cameras.height]], dtype=projected.means2d.dtype)
    first, last = windows[:, None, :2], windows[:, None, 2:]
    on_screen = (projected.means2d + projected.radii > first) & (projected.means2d - projected.radii < last)
    return visible & on_screen.all(dim=-1) & (projected.radii > 0).all(dim=-1)
