"""The place that cameras stand around."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from glassplat.scene.camera import Camera

LARGEST_MISS = 0.35
"""Share of their distance by which optical axes may pass the common point and still count as looking at it."""
SHARE = 0.6
"""Radius of the region, as a share of the nearest camera's distance."""
LARGER_PART, ROUNDS = 0.6, 10
"""Share of the cameras that have to look at it, and how often those are chosen anew that do."""


def reflective_region(cameras: Sequence[Camera]) -> tuple[float, float, float, float] | None:
    """Centre and radius, world units, of the sphere that the cameras look at from around; None where there is none.

    The centre is the point nearest to all optical axes in the least-squares sense. It counts if the axes pass it
    within a share of their distance, on average, and if the cameras are in front of it on more than one side. Where it
    does not, those may be left out that look elsewhere, such as into the room that is mirrored: the point then is that
    of the larger part of the cameras, which have to pass it twice as closely.
    """
    centers = torch.stack([camera.center.double().cpu() for camera in cameras])
    forward = torch.stack([camera.cam_from_world[2, :3].double().cpu() for camera in cameras])
    found = _common_point(centers, forward)
    if found is None:
        return None
    ahead, misses = _seen_from(found, centers, forward)
    if not bool(ahead.float().mean() > 0.9) or float(misses.mean()) > LARGEST_MISS:
        for _ in range(ROUNDS):
            away = torch.where(ahead, misses, torch.inf)
            kept = away.argsort()[: math.ceil(LARGER_PART * len(cameras))]
            found = _common_point(centers[kept], forward[kept])
            if found is None:
                return None
            ahead, misses = _seen_from(found, centers, forward)
        centers, ahead, misses = centers[kept], ahead[kept], misses[kept]
        if not bool(ahead.all()) or float(misses.mean()) > LARGEST_MISS / 2:
            return None
    x, y, z = found.tolist()
    return x, y, z, SHARE * float((found - centers).norm(dim=1).min())


def _seen_from(point: torch.Tensor, centers: torch.Tensor, forward: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """[C] whether a point lies ahead of each camera, and by which share of its distance the axis passes it."""
    towards = point - centers
    along = (towards * forward).sum(1)
    return along > 0, (towards - along[:, None] * forward).norm(dim=1) / towards.norm(dim=1)


def _common_point(centers: torch.Tensor, forward: torch.Tensor) -> torch.Tensor | None:
    """[3] the point nearest to the axes from centers [C, 3] along unit vectors [C, 3]; None if they are parallel."""
    across = torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None, :]
    normal_matrix = across.sum(0)
    if float(torch.linalg.eigvalsh(normal_matrix)[0]) < 1e-3 * len(centers):
        return None
    return torch.linalg.solve(normal_matrix, (across @ centers[:, :, None]).sum(0)).squeeze(1)
