"""Points to Gaussians, one small sphere (3DGS) or disc (2DGS) a point, and their order in memory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from glassplat.captures.view import PointCloud
from glassplat.kernels.trace.bvh import morton_codes
from glassplat.scene.activations import SH_ZERO, logit
from glassplat.scene.gaussians import DISC_SCALES, Gaussians
from glassplat.training.densify import Edit

NEIGHBOURS = 3
SMALLEST_SCALE = 1e-6
"""Floor of the standard deviation, as a share of the cloud's size: points that coincide would have none."""
MORTON_BITS = 21


def gaussians_from_points(
    points: PointCloud, *, sh_degree: int = 3, opacity: float = 0.1, spread: float = 1.0
) -> Gaussians:
    """One isotropic Gaussian for every point, in Morton order, so that neighbours in space are neighbours in memory.

    The standard deviation is `spread` times the mean distance to the three nearest points, the constant SH coefficient
    reproduces the point's colour, all other coefficients are zero. The channel `log_intensity` starts at zero
    (intensity one).

    Args:
        points: at least one.
        sh_degree: highest degree to make room for, 0 to 3; degree 0 is active.
        opacity: of every Gaussian, in (0, 1).
        spread: standard deviation as a share of that distance, positive.

    Raises:
        ValueError: no points, a position that is not finite, or an argument out of range.
    """
    if not len(points):
        raise ValueError("there are no points to start from; expected at least one")
    if not torch.isfinite(points.positions).all():
        count = int((~torch.isfinite(points.positions)).any(dim=1).sum())
        raise ValueError(f"{count} of {len(points)} points are not finite; remove them first")
    if not 0 <= sh_degree <= 3 or not 0 < opacity < 1:
        raise ValueError(f"sh_degree is {sh_degree} and opacity {opacity}; expected 0..3 and a number between 0 and 1")
    if not spread > 0:
        raise ValueError(f"spread is {spread}; expected a positive share of the distance between points")
    order = torch.from_numpy(morton_order(points.positions.numpy()))
    means = points.positions[order].clone()
    count = len(points)
    sh = torch.zeros(count, (sh_degree + 1) ** 2, 3)
    sh[:, 0] = (points.colors[order].float() / 255 - 0.5) / SH_ZERO
    return Gaussians(
        means=means,
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=torch.log(spread * _spacing(means)).float()[:, None].repeat(1, 3),
        logit_opacities=torch.full((count,), logit(opacity)),
        sh=sh,
        channels={"log_intensity": torch.zeros(count)},
    )


def as_discs(spheres: Gaussians, *, seed: int = 0) -> Gaussians:
    """Discs as large as the spheres, turned at random: nothing is known yet of the surface that they lie on."""
    generator = torch.Generator().manual_seed(seed)
    quats = torch.randn(spheres.quats.shape, generator=generator).to(spheres.quats)
    log_scales = spheres.log_scales[:, :DISC_SCALES].contiguous()
    return replace(spheres, quats=torch.nn.functional.normalize(quats, dim=1), log_scales=log_scales)


def morton_order(positions: NDArray[np.float32]) -> NDArray[np.int64]:
    """Indices [P] that sort points [P, 3] along a Z-order curve over their bounding box; ties keep their order."""
    low = positions.min(axis=0).astype(np.float64)
    size = float((positions.max(axis=0) - low).max()) or 1.0
    cells = ((positions - low) / size * (2**MORTON_BITS - 1)).astype(np.uint64)
    codes = _spread(cells[:, 0]) | (_spread(cells[:, 1]) << np.uint64(1)) | (_spread(cells[:, 2]) << np.uint64(2))
    return np.argsort(codes, kind="stable")


def _spread(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Move bit i of 21-bit values to bit 3 i."""
    steps = (
        (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    )  # fmt: skip
    for shift, mask in steps:
        values = (values | (values << np.uint64(shift))) & np.uint64(mask)
    return values


def _spacing(means: Tensor) -> Tensor:
    """[P] float64 mean distance to the nearest other points, floored; a single point is taken to be one unit wide."""
    positions = means.double().numpy()
    neighbours = min(NEIGHBOURS, len(positions) - 1)
    size = float(np.linalg.norm(positions.max(axis=0) - positions.min(axis=0))) or 1.0
    if neighbours == 0:
        return torch.full((1,), size, dtype=torch.float64)
    from scipy.spatial import cKDTree

    distances, _ = cKDTree(positions).query(positions, k=neighbours + 1)
    return torch.from_numpy(np.maximum(distances[:, 1:].mean(axis=1), SMALLEST_SCALE * size))


def in_morton_order(means: Tensor) -> Edit:
    """The edit that puts Gaussians at `means` [N, 3] into Morton order; equal places keep their order.

    A tile of an image fetches Gaussians that lie near each other in space, so that more of what a cache line or a wide
    load brings is used.
    """
    source = torch.argsort(morton_codes(means), stable=True)
    return Edit(source, torch.zeros_like(source, dtype=torch.bool))
