"""`traced`: glossy objects with near surroundings (EnvGS), by ray tracing of Gaussians."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from glassplat.kernels.environment import cube_lookup
from glassplat.kernels.records import NORMAL_AT, STRENGTH_AT, Rays
from glassplat.kernels.records import Traced as Found
from glassplat.kernels.trace import trace
from glassplat.render.deferred import (
    INVISIBLE,
    Surface,
    blend_surface,
    check_strengths,
    reflected_rays,
    shaded_pixels,
    view_directions,
)
from glassplat.render.frame import (
    MEDIAN_DEPTH,
    NEAR_PER_EXTENT,
    Frame,
    TracedPass,
    WithBackground,
    check_colored,
    over_background,
    raw_gaussians,
)
from glassplat.scene import SH_ZERO
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene

START_PER_EXTENT = 0.005
"""Minimum distance of hits from the reflecting surface, as a share of the scene extent, because the surroundings
include the surface."""


@dataclass(frozen=True)
class Traced(WithBackground):
    """Blends colour, normal, strength and depth of surfaces, then traces the reflection of each pixel (EnvGS, Section
    4.1).

        v = sum_i v_i alpha_i T_i,  v in {c_base, x, n, beta}                   (Eq. 3)
        d_ref = d - 2 (d . n) n,    n = N / |N|                                 (Eq. 4)
        c = (1 - beta) c_base + beta c_ref                                      (Eq. 5)

    The scene's Gaussians are discs, as in the paper, or ellipsoids, whose n_i is the shortest axis, facing the camera.
    c_ref is the colour along the ray from x in direction d_ref through the `surroundings`, a separate set of Gaussians,
    over the `environment` if the scene has one (not in the paper), or the background. Without surroundings, it is the
    environment. Colours are sRGB, as in the paper.

    Layers: `base`, `reflection` [H, W, 3]; `normal` [H, W, 3] in world axes, blended and not normalised; `strength`,
    `depth`, `alpha` [H, W], for discs also `median_depth` and `distortion`; `surroundings` [H, W, 3], surroundings and
    environment behind each pixel, if requested.

    Attributes:
        background: background colour, also behind surroundings without an environment, sRGB.
        least_strength: strength above which rays are traced (Table 6). Below, only the environment is reflected, if
            there is one.
        faintest: strength below which nothing is reflected. 0 for training, where strengths need the gradient of
            potential reflections.
        joint: False stops the reflection's gradient at the surfaces (Table 4, ablation).
        surroundings: also render the layer `surroundings`.
    """

    least_strength: float = 0.0
    faintest: float = INVISIBLE
    joint: bool = True
    surroundings: bool = False

    def __call__(self, scene: Scene, camera: Camera, *, with_records: bool = False) -> Frame:
        """Renders `scene` from `camera`, on the scene's device.

        Raises:
            ValueError: the scene has neither surroundings nor an environment, or its Gaussians have no reflection
                strength.
        """
        check_mirrored(scene)
        camera = camera.to(scene.primary.means.device)
        surface = blend_surface(scene, camera, background=self.background, with_records=with_records)
        part = scene.surroundings
        contributions = part.means.new_zeros(len(part), 2).requires_grad_() if with_records and len(part) else None
        rgb, reflection = self._shade(scene, camera, surface, contributions)
        layers = surface.layers(surface.base) | {"reflection": reflection}
        if self.surroundings:
            layers["surroundings"] = self.behind(scene, camera)
        return Frame(
            rgb=rgb,
            layers=layers,
            direct=surface.direct,
            screen=surface.screen,
            traced=() if contributions is None else (TracedPass("surroundings", contributions),),
            background=self.background,
        )

    def _shade(
        self, scene: Scene, camera: Camera, surface: Surface, contributions: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """The image and its reflection, [H, W, 3] each (Eq. 5)."""
        rgb, reflection = self._distant(scene, camera, surface)
        if not len(scene.surroundings):
            return rgb, reflection
        chosen = torch.where((surface.strength > self.least_strength) & (surface.depth > 0))
        positions, directions = reflected_rays(surface, camera, chosen)
        if not self.joint:
            positions, directions = positions.detach(), directions.detach()
        near = START_PER_EXTENT * scene.extent
        colors = traced_colors(scene, positions, directions, near, self.background, contributions)
        strength = surface.strength[chosen][:, None]
        mixed = (1 - strength) * surface.base[chosen] + strength * colors
        return rgb.index_put(chosen, mixed), reflection.index_put(chosen, colors)

    def _distant(self, scene: Scene, camera: Camera, surface: Surface) -> tuple[Tensor, Tensor]:
        """The image and its reflection of the environment, if there is one."""
        image = surface.image
        if scene.environment.is_empty:
            return surface.base, torch.zeros_like(surface.base)
        if not self.joint:
            color, normal, rest = image.tensor_split((NORMAL_AT, STRENGTH_AT), dim=2)
            image = torch.cat([color, normal.detach(), rest], dim=2)
        shaded = shaded_pixels(scene, camera, image, surface.alpha, self.background, self.faintest)
        return shaded.rgb, shaded.reflection

    def check(self, scene: Scene) -> None:
        """Raises ValueError if a scene lacks colours, or tensors for reflection."""
        check_colored(scene.primary)
        check_mirrored(scene)

    def layers(self, scene: Scene) -> tuple[str, ...]:
        """Names of the layers for display."""
        discs = (MEDIAN_DEPTH,) if scene.primary.are_discs else ()
        return ("rgb", "base", "reflection", "strength", "normal", "surroundings", "depth", "alpha", *discs)

    def with_layers(self, layers: Sequence[str]) -> Traced:
        """The renderer with `surroundings` enabled if it is among the layers."""
        return replace(self, surroundings=self.surroundings or "surroundings" in layers)

    def page_settings(self) -> Mapping[str, Any]:
        """Settings of the web page, which looks up the surroundings as seen from the centre of the region."""
        return {**super().page_settings(), "mirrored": "near"}

    def behind(self, scene: Scene, camera: Camera) -> Tensor:
        """[H, W, 3] the surroundings along the ray of each pixel."""
        d = view_directions(camera).reshape(-1, 3)
        origins = camera.center.expand_as(d).contiguous()
        seen = traced_colors(scene, origins, d, NEAR_PER_EXTENT * scene.extent, self.background)
        return seen.reshape(camera.height, camera.width, 3)


def traced_colors(
    scene: Scene,
    origins: Tensor,
    directions: Tensor,
    near: float,
    background: tuple[float, float, float],
    contributions: Tensor | None = None,
) -> Tensor:
    """Colours [R, 3] of the surroundings along rays, starting at `near` lengths of their directions.

    Behind them is the scene's environment, or the background without one.
    """
    found = traced_surroundings(scene.surroundings, origins, directions, near, contributions)
    if scene.environment.is_empty:
        return over_background(found.colors, found.alphas, background)
    return found.colors + (1 - found.alphas)[:, None] * torch.sigmoid(cube_lookup(scene.environment.raw, directions))


def traced_surroundings(
    part: Gaussians, origins: Tensor, directions: Tensor, near: float, contributions: Tensor | None = None
) -> Found:
    """Trace rays [R, 3] through a set of Gaussians."""
    rays = Rays(origins, directions)
    return trace(raw_gaussians(part), rays, sh_degree=part.active_sh_degree, near=near, contributions=contributions)


def mirrored_contributions(scene: Scene, camera: Camera) -> Tensor:
    """[N] contribution of each Gaussian of the surroundings to a view, in pixels: its blending weights times strength.

    Rays are traced where the strength is visible.
    """
    camera = camera.to(scene.primary.means.device)
    with torch.no_grad():
        surface = blend_surface(scene, camera, background=(0.0, 0.0, 0.0))
        chosen = torch.where((surface.strength > INVISIBLE) & (surface.depth > 0))
        positions, directions = reflected_rays(surface, camera, chosen)
    part = scene.surroundings
    with torch.enable_grad():
        # The blending weight is the gradient of a constant colour.
        ones = torch.full_like(part.sh[:, :1], 0.5 / SH_ZERO).requires_grad_()
        plain = replace(part.with_tensors({n: t.detach() for n, t in part.tensors().items()}), active_sh_degree=0)
        found = traced_surroundings(replace(plain, sh=ones), positions, directions, START_PER_EXTENT * scene.extent)
        (sums,) = torch.autograd.grad((found.colors[:, 0] * surface.strength[chosen]).sum(), ones)
    return sums[:, 0, 0] / SH_ZERO


def check_mirrored(scene: Scene) -> None:
    """Raises ValueError without surroundings and environment, or without reflection strengths.

    An environment alone is valid, as before the surroundings are added.
    """
    if not len(scene.surroundings) and scene.environment.is_empty:
        raise ValueError("the scene has no surroundings; expected one trained with `traced`")
    check_strengths(scene, "traced")
