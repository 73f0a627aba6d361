"""Which panes lie in one plane, as those between the posts of a glass front do."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from glassplat.scene.plane import Planes

LARGEST_ANGLE = math.radians(1.0)
LARGEST_OFFSET = 0.02
"""Of the middle of one pane from the plane of the other, as a share of the larger one's longer half side."""


@torch.no_grad()
def coplanar_groups(planes: Planes, rows: Sequence[int]) -> list[list[int]]:
    """Which of some panes lie in one plane with others, directly or by way of third ones; the largest of each first.

    Args:
        planes: the panes.
        rows: positions of those that are asked about.

    Returns:
        Every row in one group, the groups in the order of their first rows.
    """
    groups: list[list[int]] = []
    for row in rows:
        near = [group for group in groups if any(_coplanar(planes, row, other) for other in group)]
        joined = [*(other for group in near for other in group), row]
        groups = sorted([*(group for group in groups if group not in near), joined], key=min)
    areas = planes.half_sizes.prod(dim=1)
    return [sorted(group, key=lambda row: (-float(areas[row]), row)) for group in groups]


def _coplanar(planes: Planes, one: int, other: int) -> bool:
    normals, between = planes.normals[[one, other]], planes.centers[one] - planes.centers[other]
    angle = torch.linalg.cross(normals[0], normals[1]).norm().clamp(max=1).asin()
    offset = (normals @ between).abs().amax()
    return bool(angle <= LARGEST_ANGLE) and bool(offset <= LARGEST_OFFSET * planes.half_sizes[[one, other]].amax())
