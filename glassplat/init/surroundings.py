"""The first surroundings: Gaussians that reflections show, spread over the scene's box or copied from the scene."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from glassplat.data.point_cloud import PointCloud
from glassplat.scene.activations import logit
from glassplat.scene.gaussians import Gaussians

MOST_CELLS = 32
"""Along an edge of the box (EnvGS, Section 4.3)."""
GAUSSIANS_PER_PIXEL = 0.5
"""Where the number of cells is left open: about so many Gaussians for each pixel of a photograph."""
NARROWEST = 1e-3
"""Smallest side of the box, as a share of the largest: points may all lie in one plane."""


def suitable_cells(pixels: int, per_cell: int) -> int:
    """Cells along an edge of the box that suit photographs of so many pixels; the paper's 32 from a megapixel on."""
    wanted = (GAUSSIANS_PER_PIXEL * pixels / per_cell) ** (1 / 3)
    return min(max(round(wanted), 2), MOST_CELLS)


def percentile_box(points: PointCloud, outside: float) -> tuple[Tensor, Tensor]:
    """Lowest and highest corner [3] of the box that leaves out a share of the points at either end of every axis."""
    positions = points.positions.double()
    low, high = (positions.quantile(share, dim=0) for share in (outside, 1 - outside))
    middle, half = (low + high) / 2, (high - low) / 2
    half = half.clamp(min=NARROWEST * max(float(half.max()), 1e-9))
    return (middle - half).float(), (middle + half).float()


def surroundings_in_box(
    box: tuple[Tensor, Tensor], *, cells: int, per_cell: int, sh_degree: int, opacity: float, generator: torch.Generator
) -> Gaussians:
    """Grey round Gaussians, as many in every cell of a box and anywhere in it (EnvGS, Section 4.3).

    The standard deviation is the mean distance of neighbours that so many points in a cell have.

    Args:
        box: lowest and highest corner [3].
        cells: along each edge.
        per_cell: in each cell.
        sh_degree: highest degree to make room for; degree 0 is active.
        opacity: of every Gaussian.
        generator: source of the places; the Gaussians are on its device.
    """
    low, high = (corner.to(generator.device) for corner in box)
    size = (high - low) / cells
    along = torch.arange(cells, dtype=low.dtype, device=low.device)
    corners = torch.cartesian_prod(along, along, along).repeat_interleave(per_cell, dim=0)
    means = low + (corners + torch.rand(corners.shape, generator=generator, device=low.device)) * size
    count = means.shape[0]
    # Of points at random with density rho the nearest one is 0.554 rho^(-1/3) away on average.
    spread = 0.554 * (float(size.prod()) / per_cell) ** (1 / 3)
    return Gaussians(
        means=means,
        quats=means.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=means.new_full((count, 3), math.log(spread)),
        logit_opacities=means.new_full((count,), logit(opacity)),
        sh=means.new_zeros(count, (sh_degree + 1) ** 2, 3),
    )


def copied_surroundings(primary: Gaussians, chosen: Tensor, *, sh_degree: int) -> Gaussians:
    """Copies of what stands in the scene and does not reflect: that is what mirrors show of it.

    Args:
        primary: the scene's Gaussians.
        chosen: [N] bool, which ones to copy.
        sh_degree: highest degree to make room for; degree 0 is active.
    """
    kept = primary.select(chosen)
    coefficients = (sh_degree + 1) ** 2
    sh = kept.sh.new_zeros(len(kept), coefficients, 3)
    shared = min(coefficients, kept.sh.shape[1])
    sh[:, :shared] = kept.sh[:, :shared]
    return Gaussians(
        means=kept.means.clone(),
        quats=kept.quats.clone(),
        log_scales=kept.log_scales.clone(),
        logit_opacities=kept.logit_opacities.clone(),
        sh=sh,
        active_sh_degree=min(kept.active_sh_degree, sh_degree),
    )


def joined(*parts: Gaussians) -> Gaussians:
    """One set of several that hold the same tensors."""
    names = parts[0].tensors()
    tensors = {name: torch.cat([part.tensors()[name] for part in parts]) for name in names}
    most = max(parts, key=lambda part: part.active_sh_degree)
    return most.with_tensors(tensors)
