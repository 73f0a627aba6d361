"""The steps that every renderer of discs shares: project a set, blend it."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from glassplat.kernels.composite import BlendedDiscs, composite_discs, mean_depth
from glassplat.kernels.project import project_discs
from glassplat.kernels.records import Discs, ProjectedDiscs
from glassplat.kernels.tiles import bin_tiles
from glassplat.render.frame import ScreenPass
from glassplat.render.rasterize import camera_batch, joined_probe, raw_gaussians
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians

NDC_NEAR = 0.05
"""Near plane of the depths whose distortion is measured, in scene extents; 0.2 world units in 2DGS, whose captures have
an extent of about four."""


def projected_discs(gaussians: Gaussians, camera: Camera, *, near: float) -> ProjectedDiscs:
    """Projects a set of discs into a camera.

    Args:
        gaussians: the set, of discs.
        camera: intrinsics, pose and image size.
        near: depth below which a disc's centre is culled and a hit is left out, world units.
    """
    return project_discs(
        raw_gaussians(gaussians), camera_batch(camera), sh_degree=gaussians.active_sh_degree, near=near
    )


def blended_discs(
    projected: ProjectedDiscs, channels: Tensor, camera: Camera, *, near: float, screen: Sequence[ScreenPass] = ()
) -> BlendedDiscs:
    """Blends channels [1, N, D] of discs over the pixels of a camera; fields of one camera, [1, H, W, ...].

    Args:
        projected: what `projected_discs` made, with the same `near`.
        channels: values to blend.
        camera: image size.
        near: as for `projected_discs`.
        screen: the record whose probe to feed, if any.
    """
    discs = Discs(projected.means2d, projected.maps, projected.opacities, projected.depths, projected.outlines)
    bins = bin_tiles(projected.outlines, camera.width, camera.height)
    return composite_discs(discs, channels, bins, near=near, probe=joined_probe(screen))


def disc_layers(blended: BlendedDiscs, extent: float) -> dict[str, Tensor]:
    """Layers [H, W] that blending discs gives in any case: coverage, depths, distortion.

    The distortion is that of depths in NDC with a near plane at `NDC_NEAR` extents and none far away, so that it does
    not depend on the capture's units.
    """
    alpha = blended.alpha[0]
    return {
        "alpha": alpha,
        "depth": mean_depth(blended.depth[0], alpha),
        "median_depth": blended.median[0],
        "distortion": blended.distortion[0] * (NDC_NEAR * extent) ** 2,
    }
