"""Reference projection of ellipsoids and discs in PyTorch, which defines the result."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from glassplat.kernels.maths.blending import ALPHA_MIN
from glassplat.kernels.maths.disc import EDGE_ON, MOST_DEVIATIONS, MOST_LOG_SCALE, SLACK
from glassplat.kernels.maths.disc import LOW_PASS as DISC_LOW_PASS
from glassplat.kernels.maths.harmonics import SH_CONSTANTS
from glassplat.kernels.maths.projection import LOW_PASS, TANGENT_MARGIN
from glassplat.kernels.records import CameraBatch, Projected, ProjectedDiscs, RawGaussians


class _Ellipses(NamedTuple):
    """Screen-space covariances [C, N] (xx, xy, yy), low-pass included, and their determinant."""

    xx: Tensor
    xy: Tensor
    yy: Tensor
    determinant: Tensor


def project(gaussians: RawGaussians, cameras: CameraBatch, *, sh_degree: int, near: float) -> Projected:
    """Projects Gaussians into cameras; see `glassplat.kernels.project.project`."""
    with torch.no_grad():
        visible = _project_all(gaussians, cameras, sh_degree, near)[1]
    projected, _ = _project_all(_harmless(gaussians, visible), cameras, sh_degree, near, visible)
    return Projected(*(where(visible, tensor, torch.zeros_like(tensor)) for tensor in projected))


def _harmless(gaussians: RawGaussians, visible: Tensor) -> RawGaussians:
    """Ones for invisible Gaussians: a NaN masked afterwards would still reach gradients, as NaN times zero."""
    seen = visible.any(dim=0)
    return RawGaussians(*(where(seen, tensor, torch.ones_like(tensor)) for tensor in gaussians))


def where(mask: Tensor, value: Tensor, other: Tensor) -> Tensor:
    """`torch.where` with a mask over the leading dimensions."""
    return torch.where(mask.reshape(mask.shape + (1,) * (value.dim() - mask.dim())), value, other)


def _project_all(
    gaussians: RawGaussians, cameras: CameraBatch, sh_degree: int, near: float, visible: Tensor | None = None
) -> tuple[Projected, Tensor]:
    """Projections of all Gaussians, culled or not, and the mask of visible ones [C, N]."""
    linear, offset = cameras.cam_from_world[:, :3, :3], cameras.cam_from_world[:, :3, 3]
    in_camera = gaussians.means @ linear.mT + offset[:, None]
    depths = in_camera[..., 2]
    if visible is not None:
        in_camera = where(visible, in_camera, torch.ones_like(in_camera))
    tangents = in_camera[..., :2] / in_camera[..., 2:]
    means2d = tangents * cameras.intrinsics[:, None, :2] + cameras.intrinsics[:, None, 2:]
    opacities = torch.sigmoid(gaussians.logit_opacities).expand(depths.shape)
    ellipse = _ellipses(gaussians, cameras, tangents, in_camera[..., 2])
    if visible is not None:
        ellipse = _Ellipses(*(where(visible, entry, torch.ones_like(entry)) for entry in ellipse))
    conics = torch.stack([ellipse.yy, -ellipse.xy, ellipse.xx], dim=-1) / ellipse.determinant[..., None]
    reach = 2 * torch.log(opacities / ALPHA_MIN).clamp(min=0)
    radii = torch.sqrt(reach[..., None] * torch.stack([ellipse.xx, ellipse.yy], dim=-1)).detach()
    colors = _colors(gaussians, _outwards(gaussians, linear, offset), sh_degree)
    projected = Projected(means2d, conics, depths, opacities, colors.clamp(min=0), radii)
    if visible is None:
        visible = _visible(projected, gaussians, cameras, near) & ellipse.determinant.isfinite()
        visible &= colors.isfinite().all(dim=-1)
    return projected, visible


def _ellipses(gaussians: RawGaussians, cameras: CameraBatch, tangents: Tensor, depths: Tensor) -> _Ellipses:
    """EWA projection: J A Sigma A^T J^T with the Jacobian J at tangents clamped near the image, plus the low-pass."""
    focal, center = cameras.intrinsics[:, None, :2], cameras.intrinsics[:, None, 2:]
    size = torch.tensor([cameras.width, cameras.height], dtype=focal.dtype)
    margin = TANGENT_MARGIN * size / 2
    held = torch.clamp(tangents, -(center + margin) / focal, (size - center + margin) / focal)
    scale = focal / depths[..., None]
    linear = cameras.cam_from_world[:, None, :3, :3]
    footprint = scale[..., None] * (linear[..., :2, :] - held[..., None] * linear[..., 2:, :])
    # Columns are principal axes, each as long as its standard deviation.
    axes = rotations(gaussians.quats) * torch.exp(gaussians.log_scales)[:, None, :]
    x, y = (footprint @ axes).unbind(dim=-2)
    xx, xy, yy = (x * x).sum(-1), (x * y).sum(-1), (y * y).sum(-1)
    # Lagrange's identity: |x|^2 |y|^2 - (x.y)^2 = |x cross y|^2 does not cancel for needles.
    spread = torch.linalg.cross(x, y).square().sum(-1)
    determinant = spread + LOW_PASS * (xx + yy) + LOW_PASS**2
    return _Ellipses(xx + LOW_PASS, xy, yy + LOW_PASS, determinant)


def rotations(quats: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3] of quaternions [N, 4] `wxyz` of any length."""
    w, x, y, z = (quats / quats.square().sum(-1, keepdim=True).sqrt()).unbind(-1)
    return torch.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ], dim=-1).reshape(-1, 3, 3)  # fmt: skip


def _outwards(gaussians: RawGaussians, linear: Tensor, offset: Tensor) -> Tensor:
    """Vectors from the camera centres, -A^T t, to the means [C, N, 3]."""
    centers = -(linear.mT @ offset[..., None])[..., 0]
    return gaussians.means - centers[:, None]


def _colors(gaussians: RawGaussians, outwards: Tensor, sh_degree: int) -> Tensor:
    """Colours [C, N, 3] before the clamp; zero where there are no coefficients."""
    if gaussians.sh.shape[1] == 0:
        return torch.zeros_like(outwards)
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


def usable(gaussians: RawGaussians) -> Tensor:
    """Mask [N] of Gaussians with finite parameters, except coefficients, and an orientation."""
    norm = gaussians.quats.square().sum(-1)
    raw = torch.cat([*gaussians[:3], gaussians.logit_opacities[:, None]], dim=-1)
    return raw.isfinite().all(dim=-1) & norm.isfinite() & (norm > 0)


def _visible(projected: Projected, gaussians: RawGaussians, cameras: CameraBatch, near: float) -> Tensor:
    """Mask [C, N] of Gaussians beyond the near plane, on the kept side of the clip plane and in the window."""
    visible = usable(gaussians) & (projected.depths > near) & projected.depths.isfinite()
    low, high = projected.means2d - projected.radii, projected.means2d + projected.radii
    return visible & _in_window(low, high, gaussians, cameras) & (projected.radii > 0).all(dim=-1)


def _in_window(low: Tensor, high: Tensor, gaussians: RawGaussians, cameras: CameraBatch) -> Tensor:
    """Mask [C, N] of Gaussians on the kept side of the clip plane with boxes that overlap the window."""
    windows = cameras.windows
    if windows is None:
        windows = torch.tensor([[0, 0, cameras.width, cameras.height]], dtype=low.dtype)
    found = ((high > windows[:, None, :2]) & (low < windows[:, None, 2:])).all(dim=-1)
    if cameras.clip_planes is not None:
        found &= cameras.clip_planes[:, :3] @ gaussians.means.T + cameras.clip_planes[:, 3:] > 0
    return found


SMOOTH = ("means2d", "maps", "depths", "opacities", "colors", "normals")


def project_discs(gaussians: RawGaussians, cameras: CameraBatch, *, sh_degree: int, near: float) -> ProjectedDiscs:
    """Projects discs into cameras; see `glassplat.kernels.project.project_discs`."""
    with torch.no_grad():
        visible = _visible_discs(_project_all_discs(gaussians, cameras, sh_degree, near), gaussians, cameras, near)
    projected = _project_all_discs(_harmless(gaussians, visible), cameras, sh_degree, near, visible)
    projected = projected._replace(colors=projected.colors.clamp(min=0))
    return ProjectedDiscs(*(where(visible, tensor, torch.zeros_like(tensor)) for tensor in projected))


def _project_all_discs(
    gaussians: RawGaussians, cameras: CameraBatch, sh_degree: int, near: float, visible: Tensor | None = None
) -> ProjectedDiscs:
    """Projections of all discs, culled or not."""
    linear, offset = cameras.cam_from_world[:, :3, :3], cameras.cam_from_world[:, :3, 3]
    focal, middle = cameras.intrinsics[:, None, :2], cameras.intrinsics[:, None, 2:]
    centers = gaussians.means @ linear.mT + offset[:, None]
    turned = rotations(gaussians.quats)
    p, q = (torch.einsum("cij,nj->cni", linear, turned[..., i]) for i in range(2))
    if visible is not None:
        harmless = torch.eye(3, dtype=centers.dtype)
        p, q, centers = (where(visible, value, harmless[i].expand_as(value)) for i, value in enumerate((p, q, centers)))
    inverse = torch.exp(-gaussians.log_scales)
    n = torch.linalg.cross(p, q)
    per_slope = (centers[..., 2] / (n * centers).sum(-1))[..., None] / focal
    maps = torch.cat(
        [
            torch.linalg.cross(q, centers)[..., :2] * inverse[:, :1] * per_slope,
            torch.linalg.cross(centers, p)[..., :2] * inverse[:, 1:] * per_slope,
            n[..., :2] * per_slope,
        ],
        dim=-1,
    )
    depths = centers[..., 2]
    opacities = torch.sigmoid(gaussians.logit_opacities).expand(depths.shape)
    with torch.no_grad():
        ahead = torch.stack([p[..., 2], q[..., 2]], dim=-1) * torch.exp(gaussians.log_scales)
        nearest = depths - squared_reach(opacities).sqrt() * ahead.norm(dim=-1)
        outlines = _outlines(maps, opacities, nearest > near, cameras.width, cameras.height)
    towards = -_outwards(gaussians, linear, offset)
    side = torch.where((towards * turned[..., 2]).sum(-1, keepdim=True) < 0, -1.0, 1.0).to(depths.dtype)
    means2d = centers[..., :2] / depths[..., None] * focal + middle
    shift, conics, radii = (tensor.to(depths.dtype) for tensor in outlines)
    return ProjectedDiscs(
        means2d, maps, depths, opacities, _colors(gaussians, -towards, sh_degree), side * turned[..., 2],
        means2d.detach() + shift, conics, radii,
    )  # fmt: skip


def squared_reach(opacities: Tensor) -> Tensor:
    """Squared standard deviations up to which rays hit discs; zero for invisible discs."""
    return (2 * torch.log(opacities / ALPHA_MIN)).clamp(min=0, max=MOST_DEVIATIONS**2)


def _outlines(maps: Tensor, opacities: Tensor, whole: Tensor, width: int, height: int) -> tuple[Tensor, ...]:
    """Shift of the centre [C, N, 2], conics [C, N, 3] and half extents [C, N, 2] of the ellipses, float64."""
    maps, opacities = maps.double(), opacities.double()
    squared = squared_reach(opacities)
    rows = maps.unflatten(-1, (3, 2))
    u, v, w = (rows[..., i, :] for i in range(3))
    outer = [x[..., :, None] * x[..., None, :] for x in (u, v, w)]
    form = outer[0] + outer[1] - squared[..., None, None] * outer[2]
    determinant = form[..., 0, 0] * form[..., 1, 1] - form[..., 0, 1] ** 2
    whole = whole & (determinant > 0) & (form[..., 0, 0] > 0) & (squared > 0)
    inverse = torch.linalg.inv(where(whole, form, torch.eye(2, dtype=form.dtype)))
    shift = squared[..., None] * (inverse @ w[..., None])[..., 0]
    covariance = (squared * (1 + (w * shift).sum(-1)))[..., None, None] * inverse
    least = DISC_LOW_PASS * squared.sqrt() + shift.norm(dim=-1)
    values, axes = torch.linalg.eigh(torch.where(covariance.isfinite(), covariance, 0))
    values = torch.maximum(values, least[..., None].square()) * SLACK**2
    wide = axes @ torch.diag_embed(values) @ axes.mT
    conic = torch.linalg.inv(where(whole, wide, torch.eye(2, dtype=form.dtype)))
    conic = conic * (2 * torch.log(opacities / ALPHA_MIN))[..., None, None]
    entries = torch.stack([conic[..., 0, 0], conic[..., 0, 1], conic[..., 1, 1]], dim=-1)
    radii = wide.diagonal(dim1=-2, dim2=-1).sqrt()
    image = torch.tensor([width, height], dtype=radii.dtype).expand_as(radii)
    nothing = torch.zeros_like(entries)
    return where(whole, shift, nothing[..., :2]), where(whole, entries, nothing), where(whole, radii, image)


def _visible_discs(projected: ProjectedDiscs, gaussians: RawGaussians, cameras: CameraBatch, near: float) -> Tensor:
    """Mask [C, N] of discs beyond the near plane, not edge-on, on the kept side and in the window."""
    sized = (gaussians.log_scales.abs() <= MOST_LOG_SCALE).all(dim=-1)
    visible = usable(gaussians) & sized & (projected.depths > near)
    visible = visible & projected.maps.isfinite().all(dim=-1) & projected.colors.isfinite().all(dim=-1)
    visible = visible & projected.depths.isfinite() & _is_not_edge_on(gaussians, cameras)
    visible = visible & (projected.opacities > ALPHA_MIN)
    low, high = projected.outline_centers - projected.radii, projected.outline_centers + projected.radii
    crossing = (projected.outline_conics == 0).all(dim=-1, keepdim=True)
    lowest, highest = _crossing_boxes(gaussians, cameras, projected.opacities, near)
    low, high = torch.where(crossing, lowest, low), torch.where(crossing, highest, high)
    return visible & _in_window(low, high, gaussians, cameras)


def _crossing_boxes(
    gaussians: RawGaussians, cameras: CameraBatch, opacities: Tensor, near: float
) -> tuple[Tensor, Tensor]:
    """Minimum and maximum pixel coordinates [C, N, 2] covered by the parts of discs beyond the near plane.

    They bound the low-pass and a rectangle around each disc, with one side along the depth, cut off at the plane.
    """
    poses, lenses = cameras.cam_from_world.double(), cameras.intrinsics.double()
    linear, offset = poses[:, :3, :3], poses[:, :3, 3]
    focal, middle = lenses[:, None, :2], lenses[:, None, 2:]
    centers = gaussians.means.double() @ linear.mT + offset[:, None]
    axes = rotations(gaussians.quats.double())[..., :2] * torch.exp(gaussians.log_scales.double())[:, None]
    sides = torch.einsum("cij,njk->cnki", linear, axes)
    slopes, depths = sides[..., 2], centers[..., 2:]
    steepness = slopes.norm(dim=-1, keepdim=True)
    reach = squared_reach(opacities.double()).sqrt()[..., None]
    turn = slopes / steepness
    along = (turn[..., None] * sides).sum(-2)
    across = turn[..., :1] * sides[..., 1, :] - turn[..., 1:] * sides[..., 0, :]
    nearest = torch.maximum(torch.tensor(near, dtype=torch.float64), 1e-6 * depths)
    first = torch.maximum((nearest - depths) / steepness, -reach)
    points = [centers + way * along + side * reach * across for way in (first, reach) for side in (-1, 1)]
    corners = torch.stack([point[..., :2] / point[..., 2:] * focal for point in points])
    spot, place = DISC_LOW_PASS * reach, centers[..., :2] / depths * focal
    lowest = torch.minimum(corners.amin(0), place - spot) + middle
    return lowest.to(opacities.dtype), (torch.maximum(corners.amax(0), place + spot) + middle).to(opacities.dtype)


def _is_not_edge_on(gaussians: RawGaussians, cameras: CameraBatch) -> Tensor:
    """Mask [C, N] of discs that are not seen edge-on."""
    linear, offset = cameras.cam_from_world[:, :3, :3], cameras.cam_from_world[:, :3, 3]
    centers = gaussians.means @ linear.mT + offset[:, None]
    turned = rotations(gaussians.quats)
    n = torch.linalg.cross(*(torch.einsum("cij,nj->cni", linear, turned[..., i]) for i in range(2)))
    slope = (n * centers).sum(-1)
    limit = EDGE_ON**2 * n.square().sum(-1) * centers.square().sum(-1)
    return (slope.square() > limit) & slope.square().isfinite()
