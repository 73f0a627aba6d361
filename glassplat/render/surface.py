"""Surfaces as a camera sees them, which renderers shade: colour, normal, strength and place of every pixel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from glassplat.kernels.composite import composite, mean_depth
from glassplat.kernels.environment import surface_channels
from glassplat.kernels.panes.reference import ray_grid
from glassplat.kernels.records import NORMAL_AT, NORMAL_MIN, STRENGTH_AT, SURFACE_CHANNELS, Projected
from glassplat.kernels.tiles import bin_tiles
from glassplat.render.discs import blended_discs, disc_layers, projected_discs
from glassplat.render.frame import ScreenPass
from glassplat.render.rasterize import (
    NEAR_PER_EXTENT,
    joined_probe,
    joined_splats,
    over_background,
    project_gaussians,
    screen_pass,
    shown,
)
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene


@dataclass(frozen=True)
class Surface:
    """The blended surfaces of one view (EnvGS, Eq. 3).

    Attributes:
        base: [H, W, 3] colour without reflection, over the background.
        normal: [H, W, 3] blended normal, world axes, turned to the camera, not normalised.
        strength: [H, W] share of the reflection.
        depth: [H, W] mean camera z, 0 where nothing is.
        alpha: [H, W] coverage.
        direct: [N] bool, which Gaussians reach a pixel.
        screen: the record of the pass, if it was probed.
        extra: further layers, of discs those that say how thin the surface is.
    """

    base: Tensor
    normal: Tensor
    strength: Tensor
    depth: Tensor
    alpha: Tensor
    direct: Tensor
    screen: tuple[ScreenPass, ...] = ()
    extra: Mapping[str, Tensor] = field(default_factory=dict)

    def layers(self) -> dict[str, Tensor]:
        """The layers of a frame."""
        return {
            **self.extra,
            "base": self.base,
            "normal": self.normal,
            "strength": self.strength,
            "depth": self.depth,
            "alpha": self.alpha,
        }


def seen_surface(
    scene: Scene, camera: Camera, *, background: tuple[float, float, float], probed: bool = False
) -> Surface:
    """Blends the surfaces of the primary Gaussians, which have a `logit_strength`: ellipsoids or discs."""
    near = NEAR_PER_EXTENT * scene.extent
    seen = _seen_discs if scene.primary.are_discs else _seen_ellipsoids
    return seen(scene, camera, near, background, probed)


def _seen_ellipsoids(
    scene: Scene, camera: Camera, near: float, background: tuple[float, float, float], probed: bool
) -> Surface:
    """Depths are those of the centres."""
    projected = project_gaussians(scene.primary, camera, near=near)
    screen = (screen_pass("primary", projected),) if probed else ()
    channels = _ellipsoid_channels(scene.primary, projected, camera.center)
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
        direct=shown(projected),
        screen=screen,
    )


def _ellipsoid_channels(gaussians: Gaussians, projected: Projected, eye: Tensor) -> Tensor:
    """[N, 8] colour, normal, strength and depth of each ellipsoid; normals are turned to `eye` [3]."""
    return surface_channels(
        projected.colors[0],
        projected.radii[0],
        gaussians.quats,
        gaussians.log_scales,
        gaussians.means,
        gaussians.channels["logit_strength"],
        eye,
        projected.depths[0, :, None],
    )


def _seen_discs(
    scene: Scene, camera: Camera, near: float, background: tuple[float, float, float], probed: bool
) -> Surface:
    """Depths are those of the places where rays meet the discs."""
    projected = projected_discs(scene.primary, camera, near=near)
    screen = (screen_pass("primary", projected),) if probed else ()
    strengths = torch.sigmoid(scene.primary.channels["logit_strength"])[None, :, None]
    channels = torch.cat([projected.colors, projected.normals, strengths], dim=-1)
    blended = blended_discs(projected, channels, camera, near=near, screen=screen)
    image, extra = blended.image[0], disc_layers(blended, scene.extent)
    alpha, depth = extra.pop("alpha"), extra.pop("depth")
    return Surface(
        base=over_background(image[..., :NORMAL_AT], alpha, background),
        normal=image[..., NORMAL_AT:STRENGTH_AT],
        strength=image[..., STRENGTH_AT],
        depth=depth,
        alpha=alpha,
        direct=shown(projected),
        screen=screen,
        extra=extra,
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
