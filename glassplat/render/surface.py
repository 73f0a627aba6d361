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
from glassplat.render.tint import further_channels, tint_layer
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
        excess: [H, W, 3] by how much red, green and blue reflect more strongly; None where reflections are white.
        screen: the record of the pass, if it was probed.
        extra: further layers, of discs those that say how thin the surface is.
    """

    base: Tensor
    normal: Tensor
    strength: Tensor
    depth: Tensor
    alpha: Tensor
    direct: Tensor
    excess: Tensor | None = None
    screen: tuple[ScreenPass, ...] = ()
    extra: Mapping[str, Tensor] = field(default_factory=dict)

    def layers(self) -> dict[str, Tensor]:
        """The layers of a frame."""
        tint = {} if self.excess is None else {"tint": tint_layer(self.strength, self.excess)}
        return {
            **self.extra,
            **tint,
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
    channels = ellipsoid_channels(scene.primary, projected, camera.center[None])
    splats = joined_splats(projected)
    bins = bin_tiles(splats, camera.width, camera.height)
    result = composite(splats, channels, bins, probe=joined_probe(screen))
    return blended_surface(result.image[0], result.alpha[0], shown(projected), background, screen)


def ellipsoid_channels(gaussians: Gaussians, projected: Projected, eyes: Tensor) -> Tensor:
    """[C, N, D] what each ellipsoid adds to the images that `blended_surface` reads.

    Args:
        gaussians: with a `logit_strength`.
        projected: the same, into C cameras.
        eyes: [C, 3] the cameras' centres, to which normals are turned.
    """
    return torch.stack(
        [
            surface_channels(
                projected.colors[view],
                projected.radii[view],
                gaussians.quats,
                gaussians.log_scales,
                gaussians.means,
                gaussians.channels["logit_strength"],
                eye,
                further_channels(gaussians, projected.depths[view, :, None]),
            )
            for view, eye in enumerate(eyes)
        ]
    )


def blended_surface(
    image: Tensor,
    alpha: Tensor,
    direct: Tensor,
    background: tuple[float, float, float],
    screen: tuple[ScreenPass, ...] = (),
) -> Surface:
    """The surface of one view from the blended `ellipsoid_channels`.

    Args:
        image: [H, W, D] of these channels.
        alpha: [H, W] coverage.
        direct: [N] bool, which Gaussians reach a pixel.
        background: colour behind everything, sRGB.
        screen: the record of the pass, if it was probed.
    """
    return Surface(
        base=over_background(image[..., :NORMAL_AT], alpha, background),
        normal=image[..., NORMAL_AT:STRENGTH_AT],
        strength=image[..., STRENGTH_AT],
        depth=mean_depth(image[..., SURFACE_CHANNELS], alpha),
        alpha=alpha,
        direct=direct,
        excess=_excess(image, SURFACE_CHANNELS + 1),
        screen=screen,
    )


def _seen_discs(
    scene: Scene, camera: Camera, near: float, background: tuple[float, float, float], probed: bool
) -> Surface:
    """Depths are those of the places where rays meet the discs."""
    projected = projected_discs(scene.primary, camera, near=near)
    screen = (screen_pass("primary", projected),) if probed else ()
    strengths = torch.sigmoid(scene.primary.channels["logit_strength"])[None, :, None]
    further = further_channels(scene.primary, None)
    parts = [projected.colors, projected.normals, strengths, *([] if further is None else [further[None]])]
    channels = torch.cat(parts, dim=-1)
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
        excess=_excess(image, SURFACE_CHANNELS),
        screen=screen,
        extra=extra,
    )


def _excess(image: Tensor, start: int) -> Tensor | None:
    """What was blended [H, W, D] from a channel on, where there is any."""
    return image[..., start:] if image.shape[-1] > start else None


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
