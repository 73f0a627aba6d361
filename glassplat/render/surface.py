"""Surfaces as a camera sees them, which renderers shade: colour, normal, strength and place of every pixel."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from glassplat.kernels.bin_tiles import bin_tiles
from glassplat.kernels.composite import composite
from glassplat.kernels.pane_hits.reference import ray_grid
from glassplat.kernels.shade_environment.shaded import NORMAL_AT, NORMAL_MIN, STRENGTH_AT, SURFACE_CHANNELS
from glassplat.kernels.splats import Projected
from glassplat.kernels.surface_channels import surface_channels
from glassplat.render.frame import ScreenPass
from glassplat.render.rasterize import joined_probe, joined_splats, mean_depth, over_background
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians


@dataclass(frozen=True)
class Surface:
    """The blended surfaces of one view (EnvGS, Eq. 3).

    Attributes:
        base: [H, W, 3] colour without reflection, over the background.
        normal: [H, W, 3] blended normal, world axes, turned to the camera, not normalised.
        strength: [H, W] share of the reflection.
        depth: [H, W] mean camera z, 0 where nothing is.
        alpha: [H, W] coverage.
    """

    base: Tensor
    normal: Tensor
    strength: Tensor
    depth: Tensor
    alpha: Tensor

    def layers(self) -> dict[str, Tensor]:
        """The layers of a frame."""
        return {
            "base": self.base,
            "normal": self.normal,
            "strength": self.strength,
            "depth": self.depth,
            "alpha": self.alpha,
        }


def seen_surface(
    gaussians: Gaussians,
    camera: Camera,
    projected: Projected,
    *,
    background: tuple[float, float, float],
    screen: tuple[ScreenPass, ...] = (),
) -> Surface:
    """Blends the surfaces of Gaussians with a `logit_strength`, as `projected` into the camera."""
    channels = surface_channels(
        projected.colors[0],
        projected.radii[0],
        gaussians.quats,
        gaussians.log_scales,
        gaussians.means,
        gaussians.channels["logit_strength"],
        camera.center,
        projected.depths[0, :, None],
    )
    splats = joined_splats(projected)
    bins = bin_tiles(splats, camera.width, camera.height)
    result = composite(splats, channels[None], bins, probe=joined_probe(screen))
    image, alpha = result.image[0], result.alpha[0]
    return Surface(
        base=over_background(image[..., :NORMAL_AT], alpha, background),
        normal=image[..., NORMAL_AT:STRENGTH_AT],
        strength=image[..., STRENGTH_AT],
        depth=mean_depth(image[..., SURFACE_CHANNELS], alpha),
        alpha=alpha,
    )


def reflected_rays(surface: Surface, camera: Camera, chosen: Tensor) -> tuple[Tensor, Tensor]:
    """Places [R, 3] of the surface at the chosen pixels [H, W], and unit directions [R, 3] mirrored there (Eq. 4).

    Blended positions need no channels: with d the ray of a pixel whose camera z is 1, x = o + D d, D the blended depth.
    """
    d = view_directions(camera)[chosen]
    places = camera.center + surface.depth[chosen][:, None] * d
    normal = surface.normal[chosen]
    normal = normal / normal.norm(dim=-1, keepdim=True).clamp(min=NORMAL_MIN)
    mirrored = d - 2 * (d * normal).sum(-1, keepdim=True) * normal
    return places, torch.nn.functional.normalize(mirrored, dim=-1)


def view_directions(camera: Camera) -> Tensor:
    """[H, W, 3] directions from the camera through the pixel centres, world axes, not unit."""
    rotation = camera.cam_from_world[:3, :3]
    return ray_grid(camera.intrinsics.to(rotation), camera.width, camera.height) @ rotation
