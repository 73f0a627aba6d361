"""`deferred`: glossy things under distant light (3D Gaussian Splatting with Deferred Reflection)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from glassplat.kernels.composite import composite, mean_depth
from glassplat.kernels.environment import cube_lookup, shade_environment, surface_channels
from glassplat.kernels.records import NORMAL_AT, STRENGTH_AT, SURFACE_CHANNELS, Projected
from glassplat.kernels.tiles import bin_tiles
from glassplat.render.choices import Shading
from glassplat.render.frame import Frame
from glassplat.render.rasterize import (
    NEAR_PER_EXTENT,
    check_colored,
    check_ellipsoids,
    joined_probe,
    joined_splats,
    over_background,
    project_gaussians,
    screen_pass,
    shown,
)
from glassplat.render.surface import view_directions
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene

INVISIBLE = 1 / 512
"""A pixel that reflects less changes by at most half a step of eight bits, from black to white."""


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

    def __call__(self, scene: Scene, camera: Camera, *, probed: bool = False) -> Frame:
        """Renders `scene` from `camera`, where the scene's tensors are.

        Raises:
            ValueError: the scene has no environment, or its Gaussians no reflection strength.
        """
        check_reflective(scene)
        camera = camera.to(scene.primary.means.device)
        projected = project_gaussians(scene.primary, camera, near=NEAR_PER_EXTENT * scene.extent)
        shade = self._shade_pixels if self.shading == "deferred" else self._shade_gaussians
        channels = self._channels_of(scene.primary, camera, projected)
        screen = (screen_pass("primary", projected),) if probed else ()
        rgb, layers = shade(scene, camera, projected, channels, joined_probe(screen))
        if self.environment:
            layers["environment"] = torch.sigmoid(cube_lookup(scene.environment.raw, view_directions(camera)))
        return Frame(rgb, layers, direct=shown(projected), screen=screen)

    def check(self, scene: Scene) -> None:
        """Raises ValueError where a scene lacks colours, or what reflection needs."""
        check_colored(scene.primary)
        check_ellipsoids(scene.primary)
        check_reflective(scene)

    def _channels_of(self, gaussians: Gaussians, camera: Camera, projected: Projected) -> Tensor:
        """[N, D] what each Gaussian adds to the image: as `shade_environment` reads it, then depth, if asked for."""
        return surface_channels(
            projected.colors[0],
            projected.radii[0],
            gaussians.quats,
            gaussians.log_scales,
            gaussians.means,
            gaussians.channels["logit_strength"],
            camera.center,
            projected.depths[0, :, None] if self.depth else None,
        )

    def _shade_pixels(
        self, scene: Scene, camera: Camera, projected: Projected, channels: Tensor, probe: Tensor | None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        image, layers = self._blend(camera, projected, channels, probe)
        shaded = shade_environment(
            image,
            layers["alpha"],
            scene.environment.raw,
            camera.intrinsics,
            camera.cam_from_world[:3, :3].T.contiguous(),
            background=self.background,
            least_strength=self.least_strength,
        )
        return shaded.rgb, layers | {"base": shaded.base, "reflection": shaded.reflection}

    def _shade_gaussians(
        self, scene: Scene, camera: Camera, projected: Projected, channels: Tensor, probe: Tensor | None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        colors, normals, strengths = channels[:, :SURFACE_CHANNELS].split((NORMAL_AT, 3, 1), dim=1)
        to_eye = torch.nn.functional.normalize(camera.center - scene.primary.means, dim=1)
        cosines = (normals * to_eye).sum(-1, keepdim=True)
        mirrored = torch.sigmoid(cube_lookup(scene.environment.raw, 2 * cosines * normals - to_eye))
        channels = torch.cat([channels, strengths * colors, strengths * mirrored], dim=1)
        image, layers = self._blend(camera, projected, channels, probe)
        base = over_background(image[..., :NORMAL_AT], layers["alpha"], self.background)
        lost, gained = image[..., -6:-3], image[..., -3:]
        reflection = gained / layers["strength"][..., None].clamp(min=1e-6)
        return base - lost + gained, layers | {"base": base, "reflection": reflection}

    def _blend(
        self, camera: Camera, projected: Projected, channels: Tensor, probe: Tensor | None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The blended image [H, W, D] of channels [N, D], and its layers but for the base."""
        splats = joined_splats(projected)
        result = composite(splats, channels[None], bin_tiles(splats, camera.width, camera.height), probe=probe)
        image, alpha = result.image[0], result.alpha[0]
        layers = {"alpha": alpha, "normal": image[..., NORMAL_AT:STRENGTH_AT], "strength": image[..., STRENGTH_AT]}
        if self.depth:
            layers["depth"] = mean_depth(image[..., SURFACE_CHANNELS], alpha)
        return image, layers


def check_reflective(scene: Scene) -> None:
    """Raises ValueError where a scene lacks what reflection needs."""
    if scene.environment.is_empty:
        raise ValueError("the scene has no environment; expected one trained with `deferred`")
    if "logit_strength" not in scene.primary.channels:
        raise ValueError(
            f"the Gaussians have the channels {sorted(scene.primary.channels)}; expected logit_strength, as "
            "`deferred` trains it"
        )
