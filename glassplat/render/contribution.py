"""What each Gaussian adds to a view."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.kernels.bin_tiles import bin_tiles
from glassplat.kernels.composite import composite
from glassplat.kernels.pane_hits import pane_hits
from glassplat.kernels.splats import Projected
from glassplat.render.planar import detached, half_spaces_of, panes_in_camera, those_seen
from glassplat.render.rasterize import NEAR_PER_EXTENT, joined_splats, project_gaussians
from glassplat.scene.camera import Camera
from glassplat.scene.pose import mirror_matrices
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
    primary, near = detached(scene.primary), NEAR_PER_EXTENT * scene.extent
    most = _weight_sums(project_gaussians(primary, camera, near=near), camera)
    hits = pane_hits(panes_in_camera(scene.planes, camera), camera.intrinsics, camera.width, camera.height)
    if not hits.tiles.any():
        return most
    planes, hits = those_seen(scene.planes, hits)
    mirrored = project_gaussians(
        primary,
        camera,
        near=near,
        poses=camera.cam_from_world @ mirror_matrices(planes.centers, planes.normals),
        clip_planes=half_spaces_of(planes, camera),
        windows=hits.windows,
    )
    return torch.maximum(most, _weight_sums(mirrored, camera, hits.tiles))


def _weight_sums(projected: Projected, camera: Camera, tiles: Tensor | None = None) -> Tensor:
    """[N] blending weights summed over the pixels of the images, which is what a channel of ones has for a gradient."""
    splats = joined_splats(projected)
    with torch.enable_grad():
        ones = torch.ones_like(projected.depths)[..., None].requires_grad_()
        image = composite(splats, ones, bin_tiles(splats, camera.width, camera.height, tiles)).image
        (sums,) = torch.autograd.grad(image.sum(), ones)
    return sums[..., 0].amax(dim=0)
