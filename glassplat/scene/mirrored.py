"""Gaussians on the other side of a mirror."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.scene.gaussians import Gaussians


@torch.no_grad()
def mirrored_gaussians(gaussians: Gaussians, center: Tensor, normal: Tensor) -> Gaussians:
    """The Gaussians as a plane mirrors them: the same shapes, opacities and constant colours.

    A mirrored ellipsoid is the ellipsoid turned half around the normal, about the mirrored centre. View-dependent
    colour is dropped: its spherical harmonics would have to be mirrored too.

    Args:
        gaussians: any set.
        center: [3] a point on the plane, world units.
        normal: [3] unit normal; the sign does not matter.
    """
    distances = (gaussians.means - center) @ normal
    w, xyz = gaussians.quats[:, :1], gaussians.quats[:, 1:]
    half_turn = normal.expand_as(xyz)
    quats = torch.cat([-(half_turn * xyz).sum(-1, keepdim=True), w * half_turn + torch.linalg.cross(half_turn, xyz)], 1)
    sh = gaussians.sh.clone()
    sh[:, 1:] = 0
    means = gaussians.means - 2 * distances[:, None] * normal
    return gaussians.with_tensors({"means": means, "quats": quats, "sh": sh})
