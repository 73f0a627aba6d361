"""What cameras see through panes."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from glassplat.scene.camera import Camera
from glassplat.scene.plane import Planes


@torch.no_grad()
def behind_panes(points: Tensor, planes: Planes, cameras: Sequence[Camera]) -> Tensor:
    """[N] bool: which points some camera sees through some pane.

    A point counts if a camera, on either side of a pane, has the point in its image and the segment from the camera's
    centre to the point crosses the pane's rectangle.

    Args:
        points: [N, 3] world positions.
        planes: the panes.
        cameras: the training views.
    """
    found = torch.zeros(points.shape[0], dtype=torch.bool, device=points.device)
    if len(planes) == 0:
        return found
    # The views are taken one by one: all of them at once would need views x panes x points values.
    for camera in (camera.to(points.device) for camera in cameras):
        found |= crosses_pane(points, planes, camera.center) & in_image(points, camera)
    return found


def crosses_pane(points: Tensor, planes: Planes, eye: Tensor) -> Tensor:
    """[N] bool: whether the segment from `eye` to the point crosses any of the panes."""
    normals = planes.normals
    eye_distance = ((eye - planes.centers) * normals).sum(-1)
    distances = points @ normals.T - (planes.centers * normals).sum(-1)
    behind = eye_distance * distances < 0
    share = torch.where(behind, eye_distance / (eye_distance - distances), 0)
    inside = behind
    for axis, half in zip(planes.axes(), planes.half_sizes.T, strict=True):
        start = ((eye - planes.centers) * axis).sum(-1)
        end = points @ axis.T - (planes.centers * axis).sum(-1)
        inside = inside & ((start + share * (end - start)).abs() <= half)
    return inside.any(dim=1)


def in_image(points: Tensor, camera: Camera) -> Tensor:
    """[N] bool: whether the points lie in the image of a camera, hidden or not."""
    pixels, depths = camera.project(points)
    size = pixels.new_tensor([camera.width, camera.height])
    return (depths > 0) & ((pixels >= 0) & (pixels <= size)).all(dim=1)
