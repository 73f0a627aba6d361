"""Cameras around a scene of which nobody knows from where it was photographed."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians

COUNT = 24
WIDTH, HEIGHT = 960, 640
FOV_RAD = math.radians(50)
ELEVATION = 0.25
"""Tangent of the angle from which the cameras look down."""
INNER_SHARE = 0.96
"""Part of the Gaussians, the middle ones, that the pictures should hold."""
MOST_SAMPLED = 200_000
CLOSE = 1.15


def cameras_around(gaussians: Gaussians, up: Tensor) -> list[tuple[str, Camera]]:
    """Named cameras on a circle, which look at the middle of the scene.

    Args:
        gaussians: at least one, all finite.
        up: [3] away from the ground.
    """
    middle, radius = bounding_ball(gaussians)
    up = torch.nn.functional.normalize(up.double(), dim=0)
    aside = torch.nn.functional.normalize(torch.linalg.cross(up, _least_along(up)), dim=0)
    ahead = torch.linalg.cross(up, aside)
    distance = CLOSE * radius / math.tan(FOV_RAD / 2)
    cameras = []
    for index in range(COUNT):
        angle = 2 * math.pi * index / COUNT
        arm = math.cos(angle) * ahead + math.sin(angle) * aside + ELEVATION * up
        eye = middle + distance * arm
        camera = Camera.look_at(eye, middle, up=up, fov_rad=FOV_RAD, width=WIDTH, height=HEIGHT)
        cameras.append((f"{index:03d}.png", camera))
    return cameras


def bounding_ball(gaussians: Gaussians) -> tuple[Tensor, float]:
    """Middle [3] and radius of a ball around the inner Gaussians; those that are hardly visible do not count."""
    means = gaussians.means.double()
    seen = gaussians.logit_opacities > 0
    means = means[seen] if bool(seen.any()) else means
    means = means[:: max(1, len(means) // MOST_SAMPLED)]
    rest = (1 - INNER_SHARE) / 2
    middle = (means.quantile(rest, dim=0) + means.quantile(1 - rest, dim=0)) / 2
    distances = (means - middle).norm(dim=1)
    return middle, max(float(distances.quantile(INNER_SHARE)), 1e-6)


def _least_along(up: Tensor) -> Tensor:
    """The coordinate axis that is furthest from a direction."""
    return torch.eye(3, dtype=up.dtype)[int(up.abs().argmin())]
