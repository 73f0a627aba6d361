"""`splat`: plain Gaussian Splatting, of ellipsoids (3DGS) or discs (2DGS)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from glassplat.kernels.composite import BlendedDiscs, Composite, composite, composite_discs, mean_depth
from glassplat.kernels.environment import surface_channels
from glassplat.kernels.project import project_discs
from glassplat.kernels.records import NORMAL_AT, STRENGTH_AT, Discs, Projected, ProjectedDiscs
from glassplat.kernels.tiles import bin_tiles
from glassplat.render.frame import (
    MEDIAN_DEPTH,
    NEAR_PER_EXTENT,
    Frame,
    ScreenPass,
    WithBackground,
    camera_batch,
    check_colored,
    concat_absgrad,
    concat_splats,
    over_background,
    project_gaussians,
    raw_gaussians,
    screen_pass,
    visible_gaussians,
)
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene

NDC_NEAR = 0.05
"""Near plane of the depth distortion, in scene extents; 0.2 world units in 2DGS, whose captures have an extent of
about four."""


def projected_discs(gaussians: Gaussians, camera: Camera, *, near: float) -> ProjectedDiscs:
    """Projects a set of discs into a camera.

    Args:
        gaussians: the set, of discs.
        camera: intrinsics, pose and image size.
        near: depth below which disc centres are culled and hits ignored, world units.
    """
    return project_discs(
        raw_gaussians(gaussians), camera_batch(camera), sh_degree=gaussians.active_sh_degree, near=near
    )


def blend_discs(
    projected: ProjectedDiscs, channels: Tensor, camera: Camera, *, near: float, screen: Sequence[ScreenPass] = ()
) -> BlendedDiscs:
    """Blends channels [1, N, D] of discs over the pixels of a camera; fields of one camera, [1, H, W, ...].

    Args:
        projected: result of `projected_discs` with the same `near`.
        channels: values to blend.
        camera: camera with the image size.
        near: see `projected_discs`.
        screen: record whose `absgrad` receives its gradient, if any.
    """
    discs = Discs(projected.means2d, projected.maps, projected.opacities, projected.depths, projected.outlines)
    bins = bin_tiles(projected.outlines, camera.width, camera.height)
    return composite_discs(discs, channels, bins, near=near, absgrad=concat_absgrad(screen))


def disc_layers(blended: BlendedDiscs, extent: float) -> dict[str, Tensor]:
    """Layers [H, W] of blended discs: coverage, depths, distortion.

    The distortion uses depths in NDC with a near plane at `NDC_NEAR` extents and an infinite far plane, independent of
    the capture's units.
    """
    alpha = blended.alpha[0]
    return {
        "alpha": alpha,
        "depth": mean_depth(blended.depth[0], alpha),
        "median_depth": blended.median[0],
        "distortion": blended.distortion[0] * (NDC_NEAR * extent) ** 2,
    }


def ellipsoid_channels(
    gaussians: Gaussians, projected: Projected, camera: Camera, extra: Tensor | None = None
) -> Tensor:
    """Values [N, D] of ellipsoids to blend: colour, normal towards the camera, strength, and extra values.

    Args:
        gaussians: the set; without a `logit_strength`, strengths are meaningless.
        projected: the set in that camera.
        camera: camera that the normals face.
        extra: [N, E] further values.
    """
    strengths = gaussians.channels.get("logit_strength")
    return surface_channels(
        projected.colors[0],
        projected.radii[0],
        gaussians.quats,
        gaussians.log_scales,
        gaussians.means,
        gaussians.means.new_zeros(len(gaussians)) if strengths is None else strengths,
        camera.center,
        extra,
    )


def blend_ellipsoids(
    projected: Projected, channels: Tensor, camera: Camera, *, screen: Sequence[ScreenPass] = ()
) -> Composite:
    """Blends channels [1, N, D] of ellipsoids over the pixels of a camera; arguments as for `blend_discs`."""
    splats = concat_splats(projected)
    bins = bin_tiles(splats, camera.width, camera.height)
    return composite(splats, channels, bins, absgrad=concat_absgrad(screen))


def ellipsoid_normals(scene: Scene, camera: Camera) -> Tensor:
    """[H, W, 3] blended normals of the primary ellipsoids, world axes, towards the camera, at most of unit length.

        n(u) = sum_i n_i alpha_i T_i

    n_i is the shortest axis of ellipsoid i, facing the camera (3DGS-DR, Section 3.1). At panes, they are those of the
    objects behind, as depths are. They need a pass of their own.
    """
    projected = project_gaussians(scene.primary, camera, near=NEAR_PER_EXTENT * scene.extent)
    channels = ellipsoid_channels(scene.primary, projected, camera)
    normals = channels[None, :, NORMAL_AT:STRENGTH_AT].contiguous()
    return blend_ellipsoids(projected, normals, camera).image[0]


@dataclass(frozen=True)
class Splat(WithBackground):
    """Renders the primary Gaussians by EWA splatting, or as discs where they are flat, and front-to-back blending.

        C(u) = sum_i c_i alpha_i T_i,   T_i = prod_{j<i} (1 - alpha_j)

    Layers: `alpha` [H, W] coverage; `depth` [H, W] blended depth and `normal` [H, W, 3] (`ellipsoid_normals`), if asked
    for.

    For discs (2DGS), alpha_i and depths are those at the intersection of the pixel's ray with disc i. Then the layers
    are `alpha`; `depth`, the expected depth; `median_depth`, at which half of the light is absorbed; `distortion`, the
    spread of depths along the ray (2DGS, Eq. 13); and, if requested, `normal` [H, W, 3], blended, world axes, towards
    the camera.

    Attributes:
        background: background colour, sRGB.
        depth: also render the depth layer of ellipsoids; costs one more channel.
        normal: also render the normals of discs; costs three more channels.
        ellipsoid_normal: also render the normals of ellipsoids, in another pass.
    """

    depth: bool = True
    normal: bool = True
    ellipsoid_normal: bool = False

    def __call__(self, scene: Scene, camera: Camera, *, with_records: bool = False) -> Frame:
        """Renders `scene` from `camera`, on the scene's device."""
        camera = camera.to(scene.primary.means.device)
        if scene.primary.are_discs:
            return self._discs(scene, camera, with_records)
        projected = project_gaussians(scene.primary, camera, near=NEAR_PER_EXTENT * scene.extent)
        channels = projected.colors
        if self.depth:
            channels = torch.cat([channels, projected.depths[..., None]], dim=-1)
        screen = (screen_pass("primary", projected),) if with_records else ()
        result = blend_ellipsoids(projected, channels, camera, screen=screen)
        # As a batch of one, then split, because indexing an image allocates a gradient of zeros.
        color, *depth = result.image.squeeze(0).split((3, 1) if self.depth else 3, dim=-1)
        alpha = result.alpha.squeeze(0)
        layers = {"alpha": alpha}
        if self.depth:
            layers["depth"] = mean_depth(depth[0].squeeze(-1), alpha)
        if self.ellipsoid_normal:
            layers["normal"] = ellipsoid_normals(scene, camera)
        rgb = over_background(color, alpha, self.background)
        return Frame(rgb, layers, visible_gaussians(projected), screen=screen, background=self.background)

    def _discs(self, scene: Scene, camera: Camera, with_records: bool) -> Frame:
        near = NEAR_PER_EXTENT * scene.extent
        projected = projected_discs(scene.primary, camera, near=near)
        channels = projected.colors
        if self.normal:
            channels = torch.cat([channels, projected.normals], dim=-1)
        screen = (screen_pass("primary", projected),) if with_records else ()
        blended = blend_discs(projected, channels, camera, near=near, screen=screen)
        layers = disc_layers(blended, scene.extent)
        if self.normal:
            layers["normal"] = blended.image[0, ..., 3:]
        rgb = over_background(blended.image[0, ..., :3], layers["alpha"], self.background)
        return Frame(rgb, layers, visible_gaussians(projected), screen=screen, background=self.background)

    def check(self, scene: Scene) -> None:
        """Raises ValueError if the Gaussians have no colours."""
        check_colored(scene.primary)

    def layers(self, scene: Scene) -> tuple[str, ...]:
        """Names of the layers for display."""
        return ("rgb", "normal", "depth", "alpha", *((MEDIAN_DEPTH,) if scene.primary.are_discs else ()))

    def with_layers(self, layers: Sequence[str]) -> Splat:
        """The renderer of frames that also have `depth` and `normal` where they are among the layers."""
        depth, normal = "depth" in layers, "normal" in layers
        return replace(
            self,
            depth=self.depth or depth,
            normal=self.normal or normal,
            ellipsoid_normal=self.ellipsoid_normal or normal,
        )
