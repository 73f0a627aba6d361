"""The frame of whoever takes the photographs, which goes along with the camera."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from glassplat.scene.camera import Camera

Direction = tuple[float, float, float]

LEVEL_SHARE = 0.2
"""Of the image's own horizontal axis, which decides where a camera looks straight down or up."""
TILT_PENALTY = 0.01
"""Against an upward direction that only fits because all cameras look the same way."""


def upward(cameras: Sequence[Camera]) -> Direction:
    """The direction away from the ground, as the cameras tell: unit, world axes.

    Handheld cameras are tilted up and down, but hardly rolled: their x axes are level. Of the directions at right
    angles to these the one along which images stand upright is taken; where all cameras look the same way, that of
    the mean image.
    """
    rotations = torch.stack([camera.cam_from_world[:3, :3] for camera in cameras]).double().cpu()
    level, upright = rotations[:, 0], -rotations[:, 1].mean(dim=0)
    spread = level.T @ level / len(cameras) + TILT_PENALTY * torch.eye(3, dtype=torch.float64)
    x, y, z = torch.nn.functional.normalize(torch.linalg.solve(spread, upright), dim=0).tolist()
    return (x, y, z)


def world_from_photographer(camera: Camera, up: Direction | None) -> Tensor:
    """[4, 4] the frame of whoever holds the camera: its origin, x to the right, y down, z ahead; differentiable.

    Args:
        camera: held; OpenCV axes, not mirrored.
        up: the direction in which people stand, unit; None leans the frame with the camera.
    """
    rotation = camera.cam_from_world[:3, :3].T
    if up is not None:
        rotation = _stood_up(rotation, torch.tensor(up, dtype=rotation.dtype, device=rotation.device))
    top = torch.cat([rotation, camera.center[:, None]], dim=1)
    return torch.cat([top, top.new_tensor([[0.0, 0.0, 0.0, 1.0]])])


def _stood_up(world_from_cam: Tensor, up: Tensor) -> Tensor:
    """[3, 3] the rotation whose y axis points down and whose z axis points where the camera does."""
    right, ahead = world_from_cam[:, 0], world_from_cam[:, 2]
    across = torch.linalg.cross(ahead, up) + LEVEL_SHARE * (right - (right @ up) * up)
    across = torch.nn.functional.normalize(across, dim=0)
    return torch.stack([across, -up, torch.linalg.cross(across, -up)], dim=1)
