"""Where a capture was taken from, and what it looks at: what somebody who looks round needs to know."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from glassplat.render.seen_panes import nearest_hits, panes_in_camera
from glassplat.scene.camera import Camera
from glassplat.scene.plane import Planes

TOWARDS_MIDDLE = 0.02
"""Weight of a point before the cameras against where they look: parallel lines of sight meet nowhere."""
SPACINGS, SHARE_OF_DISTANCE = 2.5, 0.12
"""How far from a photograph one may go: in distances between neighbours, or of the distance to what they show."""
FULL_SHARE = 0.55
"""Part of the picture that a pane should fill in the first view."""


class Surveyed(NamedTuple):
    """A capture seen from above.

    Attributes:
        focus: [3] the point that the cameras look at.
        up: [3] unit vector, away from the ground.
        distance: of the cameras from the focus, the median; world units.
        reach: how far from the nearest photograph the scene is still known, world units.
    """

    focus: Tensor
    up: Tensor
    distance: float
    reach: float


def surveyed(cameras: Sequence[Camera], extent: float) -> Surveyed:
    """Looks at the poses of a capture.

    Args:
        cameras: at least one.
        extent: of the scene, for captures whose cameras all look the same way.
    """
    poses = torch.stack([camera.cam_from_world for camera in cameras]).double().cpu()
    centers, down, forward = (-(poses[:, :3, :3].mT @ poses[:, :3, 3:])[..., 0], poses[:, 1, :3], poses[:, 2, :3])
    across = torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None, :]
    ahead = centers.mean(0) + extent * forward.mean(0)
    weight = TOWARDS_MIDDLE * len(cameras)
    total = across.sum(0) + weight * torch.eye(3, dtype=torch.float64)
    focus = torch.linalg.solve(total, (across @ centers[..., None])[..., 0].sum(0) + weight * ahead)
    distance = float((centers - focus).norm(dim=1).median())
    spacing = 0.0
    if len(cameras) > 1:
        distances = torch.cdist(centers, centers) + torch.diag(
            torch.full((len(cameras),), torch.inf, dtype=torch.float64)
        )
        spacing = float(distances.amin(dim=1).median())
    reach = max(SPACINGS * spacing, SHARE_OF_DISTANCE * distance, 1e-6)
    up = torch.nn.functional.normalize(-down.mean(0), dim=0)
    return Surveyed(focus, up, distance, reach)


@torch.no_grad()
def best_view(planes: Planes, cameras: Sequence[Camera]) -> int:
    """The camera to begin with: panes fill about half of its picture, in the middle; without panes the middle one."""
    if not len(planes):
        return len(cameras) // 2
    return min(range(len(cameras)), key=lambda k: _composition(planes, cameras[k]))


def _composition(planes: Planes, camera: Camera) -> float:
    """How far a picture is from one that shows panes well: by their share of it, and by how far off its middle."""
    small = camera.resized(64, max(1, round(64 * camera.height / camera.width)))
    rows, columns = (nearest_hits(panes_in_camera(planes, small), small).pane >= 0).nonzero(as_tuple=True)
    if not len(rows):
        return math.inf
    aside = math.hypot(*(float(at.double().mean()) / size - 0.5 for at, size in ((rows, small.height), (columns, 64))))
    return abs(len(rows) / (64 * small.height) - FULL_SHARE) + 2 * aside
