"""`splat`: plain 3D Gaussian Splatting, the baseline."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from glassplat.kernels.bin_tiles import bin_tiles
from glassplat.kernels.composite import composite
from glassplat.render.frame import Frame
from glassplat.render.rasterize import (
    NEAR_PER_EXTENT,
    check_colored,
    joined_probe,
    joined_splats,
    mean_depth,
    over_background,
    project_gaussians,
    screen_pass,
    shown,
)
from glassplat.scene.camera import Camera
from glassplat.scene.scene import Scene


@dataclass(frozen=True)
class Splat:
    """Renders the primary Gaussians by EWA splatting and front-to-back blending (3DGS).

        C(u) = sum_i c_i alpha_i T_i,   T_i = prod_{j<i} (1 - alpha_j)

    Layers: `alpha` [H, W] coverage; `depth` [H, W] blended depth, if asked for.

    Attributes:
        background: colour behind everything, sRGB.
        depth: also render the depth layer; costs one more channel.
    """

    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    depth: bool = True

    def __call__(self, scene: Scene, camera: Camera, *, probed: bool = False) -> Frame:
        """Renders `scene` from `camera`, where the scene's tensors are."""
        camera = camera.to(scene.primary.means.device)
        projected = project_gaussians(scene.primary, camera, near=NEAR_PER_EXTENT * scene.extent)
        splats = joined_splats(projected)
        channels = projected.colors
        if self.depth:
            channels = torch.cat([channels, projected.depths[..., None]], dim=-1)
        screen = (screen_pass("primary", projected),) if probed else ()
        bins = bin_tiles(splats, camera.width, camera.height)
        result = composite(splats, channels, bins, probe=joined_probe(screen))
        image, alpha = result.image[0], result.alpha[0]
        layers = {"alpha": alpha}
        if self.depth:
            layers["depth"] = mean_depth(image[..., 3], alpha)
        rgb = over_background(image[..., :3], alpha, self.background)
        return Frame(rgb, layers, direct=shown(projected), screen=screen)

    def check(self, scene: Scene) -> None:
        """Raises ValueError where the Gaussians have no colours."""
        check_colored(scene.primary)
