"""What a first scene, trained without reflections, built behind a mirror."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from glassplat.scene.camera import Camera
from glassplat.scene.plane import Planes
from glassplat.scene.sight import crosses_pane, in_image

MOST_SEEN_DIRECTLY = 0.5
"""A Gaussian is virtual when fewer than this share of the views that hold it see it past the mirrors."""


@torch.no_grad()
def virtual_points(points: Tensor, mirrors: Planes, cameras: Sequence[Camera]) -> Tensor:
    """[N] bool: which points are the mirror image of something, because most views see them through a mirror.

    Nothing real is seen through a mirror, so these can go as soon as the mirror reflects. Left in place they would keep
    explaining what it shows, and its reflectance would sink to let them.

    Args:
        points: [N, 3] world positions.
        mirrors: planes that transmit nothing.
        cameras: the training views.
    """
    if len(mirrors) == 0:
        return torch.zeros(points.shape[0], dtype=torch.bool, device=points.device)
    held, through = (torch.zeros(points.shape[0], device=points.device) for _ in range(2))
    for camera in (camera.to(points.device) for camera in cameras):
        inside = in_image(points, camera)
        held += inside
        through += inside & crosses_pane(points, mirrors, camera.center)
    return through > (1 - MOST_SEEN_DIRECTLY) * held
