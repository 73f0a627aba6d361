"""The place that cameras stand around."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from glassplat.scene.camera import Camera

LARGEST_MISS = 0.35
"""Share of their distance by which optical axes may pass the common point and still count as looking at it."""
SHARE = 0.6
"""Radius of the region, as a share of the nearest camera's distance."""


def reflective_region(cameras: Sequence[Camera]) -> tuple[float, float, float, float] | None:
    """Centre and radius, world units, of the sphere that the cameras look at from around; None where there is none.

    The centre is the point nearest to all optical axes in the least-squares sense. It counts if the axes pass it
    within a share of their distance, on average, and if the cameras are in front of it on more than one side.
    """
    centers = torch.stack([camera.center.double().cpu() for camera in cameras])
    forward = torch.stack([camera.cam_from_world[2, :3].double().cpu() for camera in cameras])
    across = torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None, :]
    normal_matrix = across.sum(0)
    # Parallel axes have no point in common.
    if float(torch.linalg.eigvalsh(normal_matrix)[0]) < 1e-3 * len(cameras):
        return None
    center = torch.linalg.solve(normal_matrix, (across @ centers[:, :, None]).sum(0)).squeeze(1)
    towards = center - centers
    distances = towards.norm(dim=1)
    misses = (across @ towards[:, :, None]).squeeze(2).norm(dim=1)
    looks_at = (towards * forward).sum(1) > 0
    if not bool(looks_at.float().mean() > 0.9) or float((misses / distances).mean()) > LARGEST_MISS:
        return None
    x, y, z = center.tolist()
    return x, y, z, SHARE * float(distances.min())
