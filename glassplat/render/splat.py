"""`splat`: plain Gaussian Splatting, the baseline, of ellipsoids (3DGS) or of discs (2DGS)."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from glassplat.kernels.composite import composite, mean_depth
from glassplat.kernels.tiles import bin_tiles
from glassplat.render.discs import blended_discs, disc_layers, projected_discs
from glassplat.render.frame import Frame
from glassplat.render.rasterize import (
    NEAR_PER_EXTENT,
    check_colored,
    joined_probe,
    joined_splats,
    over_background,
    project_gaussians,
    screen_pass,
    shown,
)
from glassplat.scene.camera import Camera
from glassplat.scene.scene import Scene


@dataclass(frozen=True)
class Splat:
    """Renders the primary Gaussians by EWA splatting, or as discs where they are flat, and front-to-back blending.

        C(u) = sum_i c_i alpha_i T_i,   T_i = prod_{j<i} (1 - alpha_j)

    Layers: `alpha` [H, W] coverage; `depth` [H, W] blended depth, if asked for.

    Of discs (2DGS) alpha_i is that of the place where the ray of the pixel meets disc i, and depths are those of these
    places. Then the layers are `alpha`; `depth`, the expected depth, and `median_depth`, that at which half of the
    light is gone; `distortion`, how far apart along the ray lies what the pixel shows (2DGS, Eq. 13); and if asked for
    `normal` [H, W, 3], blended, world axes, towards the camera.

    Attributes:
        background: colour behind everything, sRGB.
        depth: also render the depth layer of ellipsoids; costs one more channel.
        normal: also render the normals of discs; costs three more channels.
    """

    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    depth: bool = True
    normal: bool = True

    def __call__(self, scene: Scene, camera: Camera, *, probed: bool = False) -> Frame:
        """Renders `scene` from `camera`, where the scene's tensors are."""
        camera = camera.to(scene.primary.means.device)
        if scene.primary.are_discs:
            return self._discs(scene, camera, probed)
        projected = project_gaussians(scene.primary, camera, near=NEAR_PER_EXTENT * scene.extent)
        splats = joined_splats(projected)
        channels = projected.colors
        if self.depth:
            channels = torch.cat([channels, projected.depths[..., None]], dim=-1)
        screen = (screen_pass("primary", projected),) if probed else ()
        bins = bin_tiles(splats, camera.width, camera.height)
        result = composite(splats, channels, bins, probe=joined_probe(screen))
        # As a batch of one and split, because the gradient of an indexed image is a whole one of zeros first.
        color, *depth = result.image.squeeze(0).split((3, 1) if self.depth else 3, dim=-1)
        alpha = result.alpha.squeeze(0)
        layers = {"alpha": alpha}
        if self.depth:
            layers["depth"] = mean_depth(depth[0].squeeze(-1), alpha)
        rgb = over_background(color, alpha, self.background)
        return Frame(rgb, layers, direct=shown(projected), screen=screen)

    def _discs(self, scene: Scene, camera: Camera, probed: bool) -> Frame:
        near = NEAR_PER_EXTENT * scene.extent
        projected = projected_discs(scene.primary, camera, near=near)
        channels = projected.colors
        if self.normal:
            channels = torch.cat([channels, projected.normals], dim=-1)
        screen = (screen_pass("primary", projected),) if probed else ()
        blended = blended_discs(projected, channels, camera, near=near, screen=screen)
        layers = disc_layers(blended, scene.extent)
        if self.normal:
            layers["normal"] = blended.image[0, ..., 3:]
        rgb = over_background(blended.image[0, ..., :3], layers["alpha"], self.background)
        return Frame(rgb, layers, direct=shown(projected), screen=screen)

    def check(self, scene: Scene) -> None:
        """Raises ValueError where the Gaussians have no colours."""
        check_colored(scene.primary)
