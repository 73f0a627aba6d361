"""Records of ray tracing: rays, the shapes that they meet, the hierarchy of boxes around these, and what comes back."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class Rays(NamedTuple):
    """Origins [R, 3] and directions [R, 3], world units; a direction may have any length but zero."""

    origins: Tensor
    directions: Tensor


class Shapes(NamedTuple):
    """Activated Gaussians as rays meet them: means [N, 3], frames [N, 3, 3] (rows, see `maths/ray_hit.py`),
    opacities [N], sh [N, K, 3].
    """

    means: Tensor
    frames: Tensor
    opacities: Tensor
    sh: Tensor


class Bvh(NamedTuple):
    """A bounding volume hierarchy of eight children a node, over Gaussians in an order of their own.

    order [N] int32: Gaussian at each place; a node of the lowest level holds eight places in a row, one of the next
    level eight such nodes in a row, and so on.
    boxes [nodes, 6, 8]: lowest x, y, z and highest x, y, z of each node's children, the lowest level first.
    level_offsets [levels + 1] int64: where each level's nodes begin.
    """

    order: Tensor
    boxes: Tensor
    level_offsets: Tensor


class Traced(NamedTuple):
    """What rays meet.

    colors [R, 3]: blended front to back (EnvGS, Eq. 2), over black.
    alphas [R]: share of the light that Gaussians take.
    depths [R]: distance from the origin to each hit, blended as colours are; divide by `alphas` for its mean.
    hits [R] int32: how many Gaussians were blended.
    """

    colors: Tensor
    alphas: Tensor
    depths: Tensor
    hits: Tensor
