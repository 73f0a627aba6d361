"""Initial surroundings, an environment or Gaussians for ray tracing, and the setup of stages with reflections."""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from glassplat.captures.dataset import Dataset
from glassplat.captures.view import PointCloud
from glassplat.methods.mirrors import mirror_lookalikes, turn_into_mirrors
from glassplat.options import BLACK
from glassplat.render.splat import Splat
from glassplat.scene import logit
from glassplat.scene.camera import Camera, nearest_to_lines
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Environment
from glassplat.training.densify import apply_edit, as_discs, morton_order, zero_moments
from glassplat.training.messages import Working
from glassplat.training.stage import TrainState

if TYPE_CHECKING:
    from glassplat.methods.glossy_recipes import GlossyOptions
    from glassplat.training.options import SurroundingsOptions

LARGEST_MISS = 0.35
"""Maximum distance of an optical axis from the common point, as a share of the camera's distance."""
REGION_SHARE = 0.6
"""Radius of the region, as a share of the nearest camera's distance."""
MAJORITY_SHARE, SELECTION_ROUNDS = 0.6, 10
"""Minimum share of cameras that look at it, and number of iterations of their selection."""


def reflective_region(cameras: Sequence[Camera]) -> tuple[float, float, float, float] | None:
    """Centre and radius, world units, of the sphere that the cameras surround; None without one.

    The centre is the point nearest to all optical axes in the least-squares sense. It is valid if the axes pass it
    within a share of their distance, on average, and if the cameras are on more than one side. Otherwise, cameras that
    look elsewhere, such as into the reflected room, are excluded, and the threshold for the majority is halved.
    """
    centers = torch.stack([camera.center.double().cpu() for camera in cameras])
    forward = torch.stack([camera.cam_from_world[2, :3].double().cpu() for camera in cameras])
    found = nearest_to_lines(centers, forward)
    if found is None:
        return None
    ahead, misses = _axis_misses(found, centers, forward)
    if not bool(ahead.float().mean() > 0.9) or float(misses.mean()) > LARGEST_MISS:
        for _ in range(SELECTION_ROUNDS):
            away = torch.where(ahead, misses, torch.inf)
            kept = away.argsort()[: math.ceil(MAJORITY_SHARE * len(cameras))]
            found = nearest_to_lines(centers[kept], forward[kept])
            if found is None:
                return None
            ahead, misses = _axis_misses(found, centers, forward)
        centers, ahead, misses = centers[kept], ahead[kept], misses[kept]
        if not bool(ahead.all()) or float(misses.mean()) > LARGEST_MISS / 2:
            return None
    x, y, z = found.tolist()
    return x, y, z, REGION_SHARE * float((found - centers).norm(dim=1).min())


def _axis_misses(point: torch.Tensor, centers: torch.Tensor, axes: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """[C] bool: point in front of each camera; and [C] distance of the axis from it, as a share of the camera's
    distance.
    """
    towards = point - centers
    along = (towards * axes).sum(1)
    return along > 0, (towards - along[:, None] * axes).norm(dim=1) / towards.norm(dim=1)


MOST_CELLS = 32
"""Maximum number of cells along an edge of the box by default; that of the paper (EnvGS, Section 4.3)."""
GAUSSIANS_PER_PIXEL = 0.5
"""Default number of Gaussians per pixel of a photograph."""
LEAST_SIDE = 1e-3
"""Minimum side of the box, as a share of the largest, for coplanar points."""


def suitable_cells(pixels: int, per_cell: int) -> int:
    """Cells along an edge of the box for a size of photographs in pixels; the paper's 32 above a megapixel."""
    wanted = (GAUSSIANS_PER_PIXEL * pixels / per_cell) ** (1 / 3)
    return min(max(round(wanted), 2), MOST_CELLS)


def percentile_box(points: PointCloud, outside: float) -> tuple[Tensor, Tensor]:
    """Lowest and highest corner [3] of the box that excludes a share of the points at either end of every axis."""
    positions = points.positions.double()
    low, high = (positions.quantile(share, dim=0) for share in (outside, 1 - outside))
    middle, half = (low + high) / 2, (high - low) / 2
    half = half.clamp(min=LEAST_SIDE * max(float(half.max()), 1e-9))
    return (middle - half).float(), (middle + half).float()


def surroundings_in_box(
    box: tuple[Tensor, Tensor], *, cells: int, per_cell: int, sh_degree: int, opacity: float, generator: torch.Generator
) -> Gaussians:
    """Grey isotropic Gaussians at random positions in every cell of a box (EnvGS, Section 4.3).

    The standard deviation is the mean distance between neighbours at this density.

    Args:
        box: lowest and highest corner [3].
        cells: number of cells along each edge.
        per_cell: number of Gaussians in each cell.
        sh_degree: stored SH degree; degree 0 is active.
        opacity: of every Gaussian.
        generator: random generator of the positions; the Gaussians are on its device.
    """
    low, high = (corner.to(generator.device) for corner in box)
    size = (high - low) / cells
    along = torch.arange(cells, dtype=low.dtype, device=low.device)
    corners = torch.cartesian_prod(along, along, along).repeat_interleave(per_cell, dim=0)
    means = (
        low + (corners + torch.rand(corners.shape, generator=generator, device=low.device, dtype=torch.float32)) * size
    )
    count = means.shape[0]
    # For random points of density rho, the mean distance of the nearest one is 0.554 rho^(-1/3).
    spread = 0.554 * (float(size.prod()) / per_cell) ** (1 / 3)
    return Gaussians(
        means=means,
        quats=means.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=means.new_full((count, 3), math.log(spread)),
        logit_opacities=means.new_full((count,), logit(opacity)),
        sh=means.new_zeros(count, (sh_degree + 1) ** 2, 3),
        active_sh_degree=0,
    )


def copied_surroundings(primary: Gaussians, chosen: Tensor, *, sh_degree: int) -> Gaussians:
    """Copies of the scene's non-reflective Gaussians, which mirrors show.

    Args:
        primary: the scene's Gaussians.
        chosen: [N] bool, Gaussians to copy.
        sh_degree: stored SH degree; degree 0 is active.
    """
    kept = primary.select(chosen)
    coefficients = (sh_degree + 1) ** 2
    sh = kept.sh.new_zeros(len(kept), coefficients, 3)
    shared = min(coefficients, kept.sh.shape[1])
    sh[:, :shared] = kept.sh[:, :shared]
    return replace(kept, sh=sh, channels={}, active_sh_degree=min(kept.active_sh_degree, sh_degree))


def add_environment(recipe: GlossyOptions, state: TrainState, dataset: Dataset, *, texels: int) -> None:
    """Adds an environment of random noise, with faces of some texels or none, and the region of reflections.

    That is the recipe's, or else the place that the cameras surround, if the recipe looks for it and there is one.
    """
    environment = state.scene.environment
    if texels:
        environment = Environment.random(texels, generator=state.generator("environment"))
    region = recipe.region
    if region is None and recipe.find_region:
        region = reflective_region([view.camera for view in dataset.train])
    state.scene = replace(state.scene, environment=replace(environment, region=region))


def add_surroundings(options: SurroundingsOptions, state: TrainState, dataset: Dataset, matte: Tensor) -> None:
    """Adds Gaussians as surroundings for reflections; `matte` [N] bool are the primary ones that may be copied."""
    start, primary, parts = options.start, state.scene.primary, []
    if start.source != "box":
        copies = copied_surroundings(primary, matte, sh_degree=options.sh_degree)
        parts = [copies] if len(copies) else []
    # There is nothing to copy if everything reflects.
    if start.source != "scene" or not parts:
        spread = surroundings_in_box(
            percentile_box(dataset.points, start.outside),
            cells=start.cells or suitable_cells(dataset.photograph_pixels, start.per_cell),
            per_cell=start.per_cell,
            sh_degree=options.sh_degree,
            opacity=start.opacity,
            generator=state.generator("surroundings"),
        )
        parts.append(as_discs(spread, seed=state.seed) if primary.are_discs else spread)
    # The set with the highest active SH degree, which the result has, comes first.
    found = reduce(Gaussians.concat, parts)
    ordered, _ = apply_edit(found, {}, morton_order(found.means), part="surroundings")
    state.scene = replace(state.scene, surroundings=ordered)


@dataclass(frozen=True)
class BeginReflections:
    """Adds what is reflected, and turns Gaussians that look like mirrors into mirrors.

    Attributes:
        recipe: options of environment and mirrors.
        surroundings: options of near surroundings; None if only the environment is reflected.
        has_environment: add an environment, and not only its region.
        reset_sh_degree: if mirrors were found, reset the SH degree to 0, because higher coefficients have learned their
            reflections.
    """

    recipe: GlossyOptions
    surroundings: SurroundingsOptions | None = None
    has_environment: bool = True
    reset_sh_degree: bool = True

    def __call__(self, state: TrainState, dataset: Dataset) -> Generator[Working, None, bool]:
        """Edits `state`."""
        recipe, search = self.recipe, self.recipe.search
        add_environment(recipe, state, dataset, texels=recipe.initial_texels if self.has_environment else 0)
        copies = self.surroundings is not None and self.surroundings.start.source != "box"
        seen = mirrors = torch.zeros(len(state.scene.primary), dtype=torch.bool)
        if search.begin_found or copies:
            yield Working("looking for mirrors", 0, 1)
            renderer = Splat(recipe.background or BLACK, depth=False)
            seen, mirrors = mirror_lookalikes(search, state.scene, dataset.train, renderer)
        if self.surroundings is not None:
            add_surroundings(self.surroundings, state, dataset, seen & ~mirrors)
        if search.begin_found:
            primary = turn_into_mirrors(search, state.scene, dataset.train, mirrors)
            if self.reset_sh_degree and bool(mirrors.any()):
                primary = replace(primary, active_sh_degree=0)
            state.scene = replace(state.scene, primary=primary)
            names = [f"primary.{name}" for name in primary.tensors()]
            state.optimizer.moments = zero_moments(state.optimizer.moments, names, mirrors)
        return True
