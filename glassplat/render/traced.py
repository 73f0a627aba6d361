"""`traced`: glossy things that mirror what is near (EnvGS), by rays through Gaussians."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from glassplat.kernels.environment import cube_lookup
from glassplat.kernels.records import NORMAL_AT, STRENGTH_AT, RawGaussians, Rays
from glassplat.kernels.records import Traced as Found
from glassplat.kernels.trace import trace
from glassplat.render.deferred import (
    INVISIBLE,
    Surface,
    check_strengths,
    page_settings,
    reflected_rays,
    seen_surface,
    shaded_pixels,
    view_directions,
)
from glassplat.render.frame import (
    MEDIAN_DEPTH,
    NEAR_PER_EXTENT,
    Frame,
    OverBackground,
    SpacePass,
    check_colored,
    over_background,
)
from glassplat.scene import SH_ZERO
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene

START_PER_EXTENT = 0.005
"""Distance from a surface, as a share of the scene extent, before which a reflected ray meets nothing: the surroundings
hold the surface too."""


@dataclass(frozen=True)
class Traced(OverBackground):
    """Blends colour, normal, strength and depth of surfaces, then traces what each pixel mirrors (EnvGS, Section 4.1).

        v = sum_i v_i alpha_i T_i,  v in {c_base, x, n, beta}                   (Eq. 3)
        d_ref = d - 2 (d . n) n,    n = N / |N|                                 (Eq. 4)
        c = (1 - beta) c_base + beta c_ref                                      (Eq. 5)

    The scene's Gaussians are discs, as in the paper, or ellipsoids, whose n_i is the shortest axis, turned to the
    camera. c_ref is what the ray from x along d_ref meets of the scene's `surroundings`, a set of Gaussians of their
    own, and behind these the `environment` where the scene has one (not in the paper), else the background. Without
    surroundings it is the environment alone. Colours are sRGB, as in the paper.

    Layers: `base`, `reflection` [H, W, 3]; `normal` [H, W, 3] in world axes, blended and not normalised; `strength`,
    `depth`, `alpha` [H, W], of discs also `median_depth` and `distortion`; `surroundings` [H, W, 3], with the
    environment those behind each pixel, if asked for.

    Attributes:
        background: colour behind everything, also behind surroundings without an environment, sRGB.
        least_strength: rays are traced where the strength is larger (Table 6). Elsewhere the environment alone is
            mirrored, and nothing where there is none.
        faintest: what reflects less mirrors nothing. 0 for training, where a strength learns from what it would
            reflect.
        joint: False keeps the reflection's gradient from the surfaces (Table 4, ablation).
        surroundings: also render the layer `surroundings`.
    """

    least_strength: float = 0.0
    faintest: float = INVISIBLE
    joint: bool = True
    surroundings: bool = False

    def __call__(self, scene: Scene, camera: Camera, *, with_absgrad: bool = False) -> Frame:
        """Renders `scene` from `camera`, where the scene's tensors are.

        Raises:
            ValueError: the scene has neither surroundings nor an environment, or its Gaussians no reflection strength.
        """
        check_mirrored(scene)
        camera = camera.to(scene.primary.means.device)
        surface = seen_surface(scene, camera, background=self.background, with_absgrad=with_absgrad)
        part = scene.surroundings
        contributions = part.means.new_zeros(len(part), 2).requires_grad_() if with_absgrad and len(part) else None
        rgb, reflection = self._shade(scene, camera, surface, contributions)
        layers = surface.layers(surface.base) | {"reflection": reflection}
        if self.surroundings:
            layers["surroundings"] = self.behind(scene, camera)
        return Frame(
            rgb=rgb,
            layers=layers,
            direct=surface.direct,
            screen=surface.screen,
            space=() if contributions is None else (SpacePass("surroundings", contributions),),
        )

    def _shade(
        self, scene: Scene, camera: Camera, surface: Surface, contributions: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """The image and what it mirrors, [H, W, 3] each (Eq. 5)."""
        rgb, reflection = self._distant(scene, camera, surface)
        if not len(scene.surroundings):
            return rgb, reflection
        chosen = torch.where((surface.strength > self.least_strength) & (surface.depth > 0))
        places, directions = reflected_rays(surface, camera, chosen)
        if not self.joint:
            places, directions = places.detach(), directions.detach()
        near = START_PER_EXTENT * scene.extent
        colors = traced_colors(scene, places, directions, near, self.background, contributions)
        strength = surface.strength[chosen][:, None]
        mixed = (1 - strength) * surface.base[chosen] + strength * colors
        return rgb.index_put(chosen, mixed), reflection.index_put(chosen, colors)

    def _distant(self, scene: Scene, camera: Camera, surface: Surface) -> tuple[Tensor, Tensor]:
        """The image and what it mirrors if the environment is all that is mirrored; without one nothing is."""
        image = surface.image
        if scene.environment.is_empty:
            return surface.base, torch.zeros_like(surface.base)
        if not self.joint:
            color, normal, rest = image.tensor_split((NORMAL_AT, STRENGTH_AT), dim=2)
            image = torch.cat([color, normal.detach(), rest], dim=2)
        shaded = shaded_pixels(scene, camera, image, surface.alpha, self.background, self.faintest)
        return shaded.rgb, shaded.reflection

    def check(self, scene: Scene) -> None:
        """Raises ValueError where a scene lacks colours, or what reflection needs."""
        check_colored(scene.primary)
        check_mirrored(scene)

    def layers(self, scene: Scene) -> tuple[str, ...]:
        """Names of the layers that are worth looking at."""
        discs = (MEDIAN_DEPTH,) if scene.primary.are_discs else ()
        return ("rgb", "base", "reflection", "strength", "normal", "surroundings", "depth", "alpha", *discs)

    def with_layers(self, layers: Sequence[str]) -> Traced:
        """The renderer, also of `surroundings` where that is among the layers."""
        return replace(self, surroundings=self.surroundings or "surroundings" in layers)

    def page_settings(self) -> Mapping[str, Any]:
        """Settings for the web page, which looks up the surroundings as they are seen from the middle of the things."""
        return page_settings(self.background, "near")

    def behind(self, scene: Scene, camera: Camera) -> Tensor:
        """[H, W, 3] the surroundings that a ray through each pixel meets."""
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
    """Colours [R, 3] of the surroundings along rays, from `near` lengths of their directions on.

    Behind them is the scene's environment, or without one the background.
    """
    found = traced_surroundings(scene.surroundings, origins, directions, near, contributions)
    if scene.environment.is_empty:
        return over_background(found.colors, found.alphas, background)
    return found.colors + (1 - found.alphas)[:, None] * torch.sigmoid(cube_lookup(scene.environment.raw, directions))


def traced_surroundings(
    part: Gaussians, origins: Tensor, directions: Tensor, near: float, contributions: Tensor | None = None
) -> Found:
    """Trace rays [R, 3] through a set of Gaussians."""
    raw = RawGaussians(part.means, part.quats, part.log_scales, part.logit_opacities, part.sh)
    return trace(
        raw, Rays(origins, directions), sh_degree=part.active_sh_degree, near=near, contributions=contributions
    )


def mirrored_contributions(scene: Scene, camera: Camera) -> Tensor:
    """[N] how many pixels' worth each Gaussian of the surroundings adds to a view: its blending weights times strength.

    Rays are traced where the strength can be seen.
    """
    camera = camera.to(scene.primary.means.device)
    with torch.no_grad():
        surface = seen_surface(scene, camera, background=(0.0, 0.0, 0.0))
        chosen = torch.where((surface.strength > INVISIBLE) & (surface.depth > 0))
        places, directions = reflected_rays(surface, camera, chosen)
    part = scene.surroundings
    with torch.enable_grad():
        # The blending weight is what a constant colour has for a gradient; that of this one is 1.
        ones = torch.full_like(part.sh[:, :1], 0.5 / SH_ZERO).requires_grad_()
        plain = replace(part.with_tensors({n: t.detach() for n, t in part.tensors().items()}), active_sh_degree=0)
        found = traced_surroundings(replace(plain, sh=ones), places, directions, START_PER_EXTENT * scene.extent)
        (sums,) = torch.autograd.grad((found.colors[:, 0] * surface.strength[chosen]).sum(), ones)
    return sums[:, 0, 0] / SH_ZERO


def check_mirrored(scene: Scene) -> None:
    """Raises ValueError where there is nothing to mirror, or nothing mirrors.

    An environment alone will do, as before the surroundings have begun.
    """
    if not len(scene.surroundings) and scene.environment.is_empty:
        raise ValueError("the scene has no surroundings; expected one trained with `traced`")
    check_strengths(scene, "traced")
