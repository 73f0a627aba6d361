"""Records passed between kernel operations, and checks of their tensors.

`C` cameras, `N` Gaussians, `G >= N` splats per camera. Dense layout: Gaussians that a camera does not see have
`radii == 0`, discs `opacities == 0` too.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

REAL_OF = {torch.float32: np.float32, torch.float64: np.float64}
"""Floating-point types that kernels are built for."""
DEVICES = ("cpu", "cuda")


def check_tensors(expected: dict[str, tuple[Tensor, tuple[int, ...]]]) -> None:
    """Raises unless all tensors have their expected shapes, one floating-point type and one device with kernels."""
    first_name, (first, _) = next(iter(expected.items()))
    dtype, device = first.dtype, first.device
    is_real, has_kernels = dtype in REAL_OF, device.type in DEVICES
    for name, (tensor, shape) in expected.items():
        if tensor.shape != shape:
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}; expected {shape}")
        if tensor.dtype != dtype or not is_real:
            other = "" if tensor.dtype == dtype else f" and {first_name} is {dtype}"
            raise TypeError(f"{name} is {tensor.dtype}{other}; expected float32 or float64 throughout")
        if tensor.device != device or not has_kernels:
            check_device(name, tensor, first_name, first)


def check_device(name: str, tensor: Tensor, other_name: str, other: Tensor) -> None:
    """Raises unless a tensor is on the device of another one, and that device has kernels."""
    if tensor.device.type not in DEVICES:
        raise TypeError(
            f"{name} is on {tensor.device}, but only the CPU and NVIDIA GPUs have kernels; move it there with .cpu()"
        )
    if tensor.device != other.device:
        raise TypeError(f"{name} is on {tensor.device} and {other_name} on {other.device}; expected one device for all")


def check_image(name: str, image: Tensor, dtype: torch.dtype, other_name: str, other: Tensor) -> None:
    """Raises unless an image of indices or flags has its type, and the shape and the device of another image."""
    if image.dtype != dtype or image.shape != other.shape:
        kind, size = str(dtype).removeprefix("torch."), tuple(other.shape)
        raise TypeError(f"{name} is {image.dtype} of shape {tuple(image.shape)}; expected {kind} of {size}")
    check_device(name, image, other_name, other)


class RawGaussians(NamedTuple):
    """Unactivated Gaussians: means [N, 3], quats [N, 4], log_scales [N, 3], logit_opacities [N], sh [N, K, 3]."""

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    logit_opacities: Tensor
    sh: Tensor


def expected_shapes(gaussians: RawGaussians, scales: int) -> dict[str, tuple[Tensor, tuple[int, ...]]]:
    """The tensors with their expected shapes for `check_tensors`, given the number of scales per Gaussian."""
    count = gaussians.means.shape[0]
    coefficients = gaussians.sh.shape[1] if gaussians.sh.dim() == 3 else 0
    shapes = (count, 3), (count, 4), (count, scales), (count,), (count, coefficients, 3)
    return {name: (getattr(gaussians, name), shape) for name, shape in zip(gaussians._fields, shapes, strict=True)}


class CameraBatch(NamedTuple):
    """Cameras of one image size: cam_from_world [C, 4, 4], intrinsics [C, 4] as (fx, fy, cx, cy), pixels.

    `clip_planes` [C, 4] are world planes (n, d): a Gaussian is kept where n . mean + d > 0.
    `windows` [C, 4] are left, top, right and bottom edge, in pixels, of the region of each image to be rendered.
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
    """Inputs of rasterisation for each splat; fields as in `Projected`, [C, G, ...]."""

    means2d: Tensor
    conics: Tensor
    opacities: Tensor
    depths: Tensor
    radii: Tensor


MOST_CHANNELS = 32
"""Maximum number of channels that are blended at once."""

TILE = 16
"""Edge of a tile in pixels."""
BEHIND = 1 + 1e-5
"""Ratio of ray distances beyond which two panes are separate surfaces: panes of one shop front share their plane up to
rounding, and their rectangles may overlap."""
DAZZLING = 1.5
"""Reflected intensity beyond which a reflection is treated as that of a lamp."""

MOST_PAIRS = 2**31 - 1
"""Maximum number of (tile, splat) pairs; limited by the index type."""

LEAST_ALPHA = 1e-6
"""Coverage up to which a pixel counts as empty, and the mean of its channels as 0."""
ON_MEAN = 8
"""Values within this many rounding steps of a mean equal it: a splat alone in its pixel deviates only by rounding."""


class Deviation(NamedTuple):
    """A request for the spread of one channel along each pixel's ray.

    channel: index of the channel. where [C, H, W]: factor on the result; tiles in which it is 0 throughout are skipped.
    through_mean: propagate the gradient through the mean too.
    """

    channel: int
    where: Tensor
    through_mean: bool = False


class TileBins(NamedTuple):
    """Splats per 16 x 16 tile, front to back.

    pair_splats [P] int32: splat of each (tile, splat) pair, an index into the flattened [C * G].
    tile_offsets [C * T + 1] int64: start of each tile's pairs.
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
    """Raises ValueError if there are more (tile, splat) pairs than can be indexed."""
    if count > MOST_PAIRS:
        raise ValueError(
            f"{count} (tile, splat) pairs are more than the {MOST_PAIRS} that can be indexed; render fewer cameras at "
            "once or a smaller image"
        )


FLAT, SOLID = 2, 3
"""Number of scales of a disc and of an ellipsoid."""


class ProjectedDiscs(NamedTuple):
    """Discs on screen.

    means2d [C, N, 2] pixels. maps [C, N, 6]: map from pixels to the points where their rays meet the disc
    (`maths/disc.py`). depths [C, N] of the centres, camera z; opacities [C, N] in (0, 1); colors [C, N, 3]; normals
    [C, N, 3] unit, world axes, towards the camera. outline_centers [C, N, 2], outline_conics [C, N, 3]: an ellipse
    around the region where a disc covers at least 1/255, for `bin_tiles`; zero conics if it crosses the near plane.
    radii [C, N, 2] half extents of that ellipse in pixels, 0 where culled.
    """

    means2d: Tensor
    maps: Tensor
    depths: Tensor
    opacities: Tensor
    colors: Tensor
    normals: Tensor
    outline_centers: Tensor
    outline_conics: Tensor
    radii: Tensor

    @property
    def outlines(self) -> Splats:
        """Outlines of these discs as splats for `bin_tiles`."""
        return Splats(self.outline_centers, self.outline_conics, self.opacities, self.depths, self.radii)


class Discs(NamedTuple):
    """Inputs of blending for each disc; fields as in `ProjectedDiscs`, [C, N, ...]."""

    means2d: Tensor
    maps: Tensor
    opacities: Tensor
    depths: Tensor
    outlines: Splats


class Panes(NamedTuple):
    """K rectangles in the camera frame.

    centers [K, 3]; normals [K, 3] and in-plane axes [K, 2, 3], all of unit length; half_sizes [K, 2] along the axes.
    """

    centers: Tensor
    normals: Tensor
    axes: Tensor
    half_sizes: Tensor


class PaneHits(NamedTuple):
    """The pane visible in each pixel.

    pane [H, W] int32: the nearest pane that the pixel's ray meets, -1 where there is none.
    depth [H, W]: depth of the intersection, infinite where there is none.
    tiles [K, rows, columns] bool: tiles with a pixel that shows the pane.
    windows [K, 4]: left, top, right and bottom edge, in pixels, of the pixels that show it; all 0 if none does.
    """

    pane: Tensor
    depth: Tensor
    tiles: Tensor
    windows: Tensor


class BlendedPanes(NamedTuple):
    """An image with its panes: rgb and reflection [H, W, 3] sRGB, strength [H, W]."""

    rgb: Tensor
    reflection: Tensor
    strength: Tensor


NORMAL_MIN = 1e-6
"""Shortest blended normal that still defines a direction."""


NORMAL_AT, STRENGTH_AT, SURFACE_CHANNELS = 3, 6, 7
"""Channels of blended surfaces: colour before the normal, then strength; others may follow."""


class Shaded(NamedTuple):
    """An image, its base without reflection, and its reflection: rgb, base and reflection [H, W, 3] sRGB."""

    rgb: Tensor
    base: Tensor
    reflection: Tensor


class Rays(NamedTuple):
    """Origins [R, 3] and directions [R, 3], world units; directions may have any non-zero length."""

    origins: Tensor
    directions: Tensor


class Shapes(NamedTuple):
    """Activated Gaussians for ray intersection: means [N, 3], frames [N, 3, 3] (rows, see `maths/disc.py`),
    opacities [N], sh [N, K, 3].
    """

    means: Tensor
    frames: Tensor
    opacities: Tensor
    sh: Tensor


class Bvh(NamedTuple):
    """A bounding volume hierarchy with eight children per node, over reordered Gaussians.

    order [N] int32: Gaussian at each position; a leaf holds eight consecutive positions, a node of the next level eight
    consecutive leaves, and so on.
    boxes [nodes, 6, 8]: minimum x, y, z and maximum x, y, z of each node's children, leaves first.
    level_offsets [levels + 1] int64: start of each level's nodes.
    """

    order: Tensor
    boxes: Tensor
    level_offsets: Tensor


class Traced(NamedTuple):
    """Results of tracing rays.

    colors [R, 3]: blended front to back (EnvGS, Eq. 2), over black.
    alphas [R]: accumulated opacity, 1 - T.
    depths [R]: distance from the origin to each hit, blended like colours; divide by `alphas` for the expected
    distance.
    hits [R] int32: number of Gaussians blended.
    """

    colors: Tensor
    alphas: Tensor
    depths: Tensor
    hits: Tensor
