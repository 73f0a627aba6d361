"""`deferred`: glossy things under distant light (3D Gaussian Splatting with Deferred Reflection)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from glassplat.kernels.bin_tiles import bin_tiles
from glassplat.kernels.composite import composite
from glassplat.kernels.cube_lookup import cube_lookup
from glassplat.kernels.facing_normals import facing_normals
from glassplat.kernels.reference.pane_hits import ray_grid
from glassplat.kernels.shade_environment import shade_environment
from glassplat.kernels.shaded import NORMAL_AT, STRENGTH_AT, SURFACE_CHANNELS
from glassplat.render.frame import Frame, ScreenPass
from glassplat.render.rasterize import (
    NEAR_PER_EXTENT,
    joined_splats,
    mean_depth,
    over_background,
    probe_of,
    project_gaussians,
)
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene

Shading = Literal["deferred", "forward"]
INVISIBLE = 1 / 512
"""A pixel that reflects less changes by at most half a step of eight bits, from black to white."""


class Surface(NamedTuple):
    """What each Gaussian adds to the image besides its colour: normals [N, 3] facing the camera, strengths [N]."""

    normals: Tensor
    strengths: Tensor


@dataclass(frozen=True)
class Deferred:
    """Blends colour, normal and reflection strength, then shades every pixel once (3DGS-DR, Section 3.1).

        C, N, R = sum_i (c_i, n_i, r_i) alpha_i T_i                   (Eqs. 1 and 2)
        C' = (1 - R) C + R E(2 (v . n) n - v),  n = N / |N|           (Eq. 3)

    n_i is the shortest axis of a Gaussian, turned to the camera, v the direction to the camera, E the environment.
    Colours are sRGB, as in the paper.

    Layers: `base` C, `reflection` E, `normal` N in world axes, blended and not normalised [H, W, 3]; `strength` R,
    `alpha`, `depth` [H, W]; `environment` [H, W, 3], what surrounds the scene behind each pixel, if asked for.

    Attributes:
        background: colour behind everything, sRGB.
        shading: `forward` shades every Gaussian instead of every pixel, the paper's ablation; its `reflection` layer
            is the blended light that the Gaussians reflect, divided by R.
        depth: also render the depth layer.
        environment: also render the layer `environment`.
        least_strength: pixels that reflect less are not shaded, and their `reflection` is 0. Not for training, where a
            strength learns from what it would reflect.
    """

    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shading: Shading = "deferred"
    depth: bool = True
    environment: bool = False
    least_strength: float = 0.0

    def __call__(self, scene: Scene, camera: Camera) -> Frame:
        """Renders `scene` from `camera`, where the scene's tensors are.

        Raises:
            ValueError: the scene has no environment, or its Gaussians no reflection strength.
        """
        check_reflective(scene)
        camera = camera.to(scene.primary.means.device)
        surface = surface_of(scene.primary, camera)
        rgb, layers, screen = (
            self._shade_pixels(scene, camera, surface)
            if self.shading == "deferred"
            else self._shade_gaussians(scene, camera, surface)
        )
        if self.environment:
            layers["environment"] = torch.sigmoid(cube_lookup(scene.environment.raw, view_directions(camera)))
        return Frame(rgb, layers, (screen,))

    def _shade_pixels(
        self, scene: Scene, camera: Camera, surface: Surface
    ) -> tuple[Tensor, dict[str, Tensor], ScreenPass]:
        image, layers, screen = self._blend(scene, camera, surface)
        shaded = shade_environment(
            image,
            layers["alpha"],
            scene.environment.raw,
            camera.intrinsics,
            camera.cam_from_world[:3, :3].T.contiguous(),
            background=self.background,
            least_strength=self.least_strength,
        )
        return shaded.rgb, layers | {"base": shaded.base, "reflection": shaded.reflection}, screen

    def _shade_gaussians(
        self, scene: Scene, camera: Camera, surface: Surface
    ) -> tuple[Tensor, dict[str, Tensor], ScreenPass]:
        to_eye = torch.nn.functional.normalize(camera.center - scene.primary.means, dim=1)
        cosines = (surface.normals * to_eye).sum(-1, keepdim=True)
        mirrored = torch.sigmoid(cube_lookup(scene.environment.raw, 2 * cosines * surface.normals - to_eye))
        image, layers, screen = self._blend(scene, camera, surface, mirrored)
        base = over_background(image[..., :NORMAL_AT], layers["alpha"], self.background)
        lost, gained = image[..., -6:-3], image[..., -3:]
        reflection = gained / layers["strength"][..., None].clamp(min=1e-6)
        return base - lost + gained, layers | {"base": base, "reflection": reflection}, screen

    def _blend(
        self, scene: Scene, camera: Camera, surface: Surface, mirrored: Tensor | None = None
    ) -> tuple[Tensor, dict[str, Tensor], ScreenPass]:
        """The blended image [H, W, D] and its layers but for the base.

        Channels are those of `shade_environment`, then depth, if asked for; given what each Gaussian mirrors [N, 3],
        the colours lost and gained come last.
        """
        projected = project_gaussians(scene.primary, camera, near=NEAR_PER_EXTENT * scene.extent)
        splats = joined_splats(projected)
        colors, shares = projected.colors[0], surface.strengths[:, None]
        values = [colors, surface.normals, shares]
        if self.depth:
            values.append(projected.depths[0, :, None])
        if mirrored is not None:
            values += [shares * colors, shares * mirrored]
        channels = torch.cat(values, dim=-1)[None]
        probe = probe_of(projected)
        result = composite(splats, channels, bin_tiles(splats, camera.width, camera.height), probe=probe)
        image, alpha = result.image[0], result.alpha[0]
        layers = {"alpha": alpha, "normal": image[..., NORMAL_AT:STRENGTH_AT], "strength": image[..., STRENGTH_AT]}
        if self.depth:
            layers["depth"] = mean_depth(image[..., SURFACE_CHANNELS], alpha)
        return image, layers, ScreenPass("primary", projected.means2d, probe, projected.radii)


def check_reflective(scene: Scene) -> None:
    """Raises ValueError where a scene lacks what reflection needs."""
    if scene.environment.is_empty:
        raise ValueError("the scene has no environment; expected one trained with `deferred`")
    if "logit_strength" not in scene.primary.channels:
        raise ValueError(
            f"the Gaussians have the channels {sorted(scene.primary.channels)}; expected logit_strength, as "
            "`deferred` trains it"
        )


def surface_of(gaussians: Gaussians, camera: Camera) -> Surface:
    """Normals and strengths of the Gaussians, as seen from a camera."""
    normals = facing_normals(gaussians.quats, gaussians.log_scales, gaussians.means, camera.center)
    return Surface(normals, torch.sigmoid(gaussians.channels["logit_strength"]))


def view_directions(camera: Camera) -> Tensor:
    """[H, W, 3] directions from the camera through the pixel centres, world axes, not unit."""
    rotation = camera.cam_from_world[:3, :3]
    return ray_grid(camera.intrinsics.to(rotation), camera.width, camera.height) @ rotation
