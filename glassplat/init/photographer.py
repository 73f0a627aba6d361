"""The first Gaussians of whoever took the photographs."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from glassplat.scene.activations import logit
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.plane import Planes

NEAREST, FARTHEST = 0.03, 0.6
"""Of the cloud from the camera, as shares of the distance to the panes: what a body measures in the capture's units is
not known, and from head to feet it is ten times as far as from the camera to the head."""
SPREAD = 0.2
"""Standard deviation of each Gaussian, as a share of its distance from the camera."""
OPACITY = 0.05


def first_photographer(
    planes: Planes, cameras: Sequence[Camera], *, count: int, sh_degree: int, seed: int
) -> Gaussians:
    """A faint grey cloud behind the camera, as dense in the logarithm of the distance from it everywhere.

    Args:
        planes: the panes, at least one.
        cameras: of the training views.
        count: of Gaussians.
        sh_degree: highest degree of their colours.
        seed: fixes the places.

    Returns:
        In the photographer's frame, with x to the right, y down and z ahead.
    """
    generator = torch.Generator().manual_seed(seed)
    distance = distance_to_panes(planes, cameras)
    low, high = math.log(NEAREST * distance), math.log(FARTHEST * distance)
    radii = torch.exp(low + (high - low) * torch.rand(count, generator=generator))
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    # Behind the camera; where the face is, all around it.
    directions[:, 2] = -directions[:, 2].abs()
    device = planes.centers.device
    found = Gaussians(
        means=radii[:, None] * directions,
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=torch.log(SPREAD * radii)[:, None].repeat(1, 3),
        logit_opacities=torch.full((count,), logit(OPACITY)),
        sh=torch.zeros(count, (sh_degree + 1) ** 2, 3),
    )
    return found.to(device)


def distance_to_panes(planes: Planes, cameras: Sequence[Camera]) -> float:
    """The median, over the cameras, of the distance to the nearest rectangle; world units."""
    centers = torch.stack([camera.center for camera in cameras]).to(planes.centers)
    offsets = centers[:, None] - planes.centers
    along = torch.stack([(offsets * axis).sum(-1) for axis in planes.axes()], dim=-1)
    outside = (along.abs() - planes.half_sizes).clamp(min=0)
    across: Tensor = (offsets * planes.normals).sum(-1, keepdim=True)
    return float(torch.cat([outside, across], dim=-1).norm(dim=-1).amin(dim=1).median())
