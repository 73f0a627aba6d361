"""What each Gaussian adds to a view."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from glassplat.kernels.composite import composite
from glassplat.kernels.records import Projected
from glassplat.kernels.tiles import bin_tiles
from glassplat.render.discs import blended_discs, projected_discs
from glassplat.render.mirror_images import project_mirrored
from glassplat.render.planar import detached
from glassplat.render.rasterize import NEAR_PER_EXTENT, joined_splats, project_gaussians
from glassplat.render.seen_panes import nearest_hits, panes_in_camera, seen_panes
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene


def contributions(scene: Scene, camera: Camera) -> Tensor:
    """[N] how many pixels' worth each primary Gaussian adds to a view: the sum of its blending weights alpha_i T_i.

    That is in the direct image or in those that the panes mirror, wherever it is most; a mirrored pixel counts as much
    as a direct one, however weak the reflection. After RadSplat (arXiv 2403.13806), which takes the largest weight
    instead of their sum: what covers a hundredth of a pixel is superfluous however opaque it is there.

    Args:
        scene: with or without panes.
        camera: of the view.
    """
    camera = camera.to(scene.primary.means.device)
    # Colours do not matter here.
    primary, near = replace(detached(scene.primary), active_sh_degree=0), NEAR_PER_EXTENT * scene.extent
    if primary.are_discs:
        return _disc_sums(primary, camera, near, primary.means.new_ones(camera.height, camera.width, 1))[:, 0]
    most = _weight_sums(project_gaussians(primary, camera, near=near), camera)
    seen = seen_panes(scene.planes, camera, nearest_hits(panes_in_camera(scene.planes, camera), camera))
    if seen is None:
        return most
    mirrored = project_mirrored(primary, camera, seen, near=near)
    return torch.maximum(most, _weight_sums(mirrored, camera, seen.tiles))


def gathered(scene: Scene, camera: Camera, values: Tensor) -> Tensor:
    """[N, D] an image [H, W, D] summed over the pixels of each primary Gaussian, by its blending weights."""
    camera = camera.to(scene.primary.means.device)
    primary, near = replace(detached(scene.primary), active_sh_degree=0), NEAR_PER_EXTENT * scene.extent
    if primary.are_discs:
        return _disc_sums(primary, camera, near, values)
    return _sums(project_gaussians(primary, camera, near=near), camera, values)[0]


def _weight_sums(projected: Projected, camera: Camera, tiles: Tensor | None = None) -> Tensor:
    """[N] blending weights summed over the pixels of the images."""
    ones = projected.depths.new_ones(camera.height, camera.width, 1)
    return _sums(projected, camera, ones, tiles)[..., 0].amax(dim=0)


def _sums(projected: Projected, camera: Camera, values: Tensor, tiles: Tensor | None = None) -> Tensor:
    """[C, N, D] what a constant channel has for a gradient where `values` [H, W, D] are those of the images."""
    splats = joined_splats(projected)
    with torch.enable_grad():
        ones = projected.depths.new_ones(*projected.depths.shape, values.shape[-1]).requires_grad_()
        image = composite(splats, ones, bin_tiles(splats, camera.width, camera.height, tiles)).image
        (sums,) = torch.autograd.grad((image * values).sum(), ones)
    return sums


def _disc_sums(discs: Gaussians, camera: Camera, near: float, values: Tensor) -> Tensor:
    """[N, D] as `_sums`, of discs and one camera."""
    projected = projected_discs(discs, camera, near=near)
    with torch.enable_grad():
        ones = projected.depths.new_ones(*projected.depths.shape, values.shape[-1]).requires_grad_()
        image = blended_discs(projected, ones, camera, near=near).image
        (sums,) = torch.autograd.grad((image * values).sum(), ones)
    return sums[0]
