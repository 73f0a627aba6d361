"""Records that the kernel operations hand to each other.

`C` cameras, `N` Gaussians, `G >= N` splats per camera. Dense layout: what a camera does not see has
`radii == 0`.
"""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class RawGaussians(NamedTuple):
    """Unactivated Gaussians: means [N, 3], quats [N, 4], log_scales [N, 3], logit_opacities [N], sh [N, K, 3]."""

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    logit_opacities: Tensor
    sh: Tensor


class CameraBatch(NamedTuple):
    """Cameras of one image size: cam_from_world [C, 4, 4], intrinsics [C, 4] as (fx, fy, cx, cy), pixels.

    `clip_planes` [C, 4] are world planes (n, d): a Gaussian is kept where n . mean + d > 0.
    `windows` [C, 4] are left, top, right and bottom edge, in pixels, of the part of each image that is wanted.
    """

    cam_from_world: Tensor
    intrinsics: Tensor
    width: int
    height: int
    clip_planes: Tensor | None = None
    windows: Tensor | None = None


class Projected(NamedTuple):
    """Gaussians on screen.

    means2d [C, N, 2] pixels; conics [C, N, 3] inverse covariance (xx, xy, yy) in 1/px^2; depths [C, N] camera z;
    opacities [C, N] in (0, 1); colors [C, N, 3]; radii [C, N, 2] half extents in pixels of the region where
    alpha >= 1/255, 0 where culled.
    """

    means2d: Tensor
    conics: Tensor
    depths: Tensor
    opacities: Tensor
    colors: Tensor
    radii: Tensor


class Splats(NamedTuple):
    """What rasterisation needs of each splat; fields as in `Projected`, [C, G, ...]."""

    means2d: Tensor
    conics: Tensor
    opacities: Tensor
    depths: Tensor
    radii: Tensor


MOST_CHANNELS = 32
"""Channels of a splat that can be blended at once."""

TILE = 16
"""Edge of a tile in pixels."""

MOST_PAIRS = 2**31 - 1
"""(tile, splat) pairs that their index type can count."""

LEAST_ALPHA = 1e-6
"""Coverage up to which a pixel holds nothing, and the mean of its channels is taken for 0."""


class Deviation(NamedTuple):
    """A request for the spread of one channel along each pixel's ray.

    channel: which one. where [C, H, W]: factor on the result; tiles in which it is 0 throughout cost nothing.
    through_mean: let the gradient pass through the mean too.
    """

    channel: int
    where: Tensor
    through_mean: bool = False


class TileBins(NamedTuple):
    """Splats per 16 x 16 tile, front to back.

    pair_splats [P] int32: splat of each (tile, splat) pair, an index into the flattened [C * G].
    tile_offsets [C * T + 1] int64: where each tile's pairs begin.
    pair_slots [P] int32, splat_offsets [C * G + 1] int64: `pair_slots[splat_offsets[s] : splat_offsets[s + 1]]`
    are the positions of splat s in `pair_splats`.
    active [A] int32: tiles (camera * T + tile) to traverse.
    """

    pair_splats: Tensor
    tile_offsets: Tensor
    pair_slots: Tensor
    splat_offsets: Tensor
    active: Tensor
    width: int
    height: int
    num_cameras: int


def check_pair_count(count: int) -> None:
    """Raises ValueError where there are more (tile, splat) pairs than can be indexed."""
    if count > MOST_PAIRS:
        raise ValueError(
            f"{count} (tile, splat) pairs are more than the {MOST_PAIRS} that can be indexed; render fewer cameras at "
            "once or a smaller image"
        )
