"""`traced`: glossy things that mirror what is near (EnvGS), by rays through Gaussians."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from glassplat.kernels.build_bvh import build_bvh
from glassplat.kernels.splats import RawGaussians
from glassplat.kernels.trace import Rays, trace
from glassplat.kernels.trace.shapes import FLAT, shapes_of
from glassplat.render.frame import Frame
from glassplat.render.rasterize import NEAR_PER_EXTENT, over_background, project_gaussians, screen_pass, shown
from glassplat.render.surface import Surface, reflected_rays, seen_surface, view_directions
from glassplat.scene.camera import Camera
from glassplat.scene.scene import Scene

START_PER_EXTENT = 0.005
"""Distance from a surface, as a share of the scene extent, before which a reflected ray meets nothing: the surroundings
hold the surface too."""


@dataclass(frozen=True)
class Traced:
    """Blends colour, normal, strength and depth of surfaces, then traces what each pixel mirrors (EnvGS, Section 4.1).

        v = sum_i v_i alpha_i T_i,  v in {c_base, x, n, beta}                   (Eq. 3)
        d_ref = d - 2 (d . n) n,    n = N / |N|                                 (Eq. 4)
        c = (1 - beta) c_base + beta c_ref                                      (Eq. 5)

    c_ref is what the ray from x along d_ref meets of the scene's `surroundings`, a set of Gaussians of their own. n_i
    is the shortest axis of a Gaussian, turned to the camera. Colours are sRGB, as in the paper.

    Layers: `base`, `reflection` [H, W, 3], the reflection black where it is not traced; `normal` [H, W, 3] in world
    axes, blended and not normalised; `strength`, `depth`, `alpha` [H, W]; `surroundings` [H, W, 3], those behind each
    pixel, if asked for.

    Attributes:
        background: colour behind everything, also behind the surroundings, sRGB.
        least_strength: rays are traced where the strength is larger (Table 6). Not for training, where a strength
            learns from what it would reflect.
        joint: False keeps the reflection's gradient from the surfaces (Table 4, ablation).
        surroundings: also render the layer `surroundings`.
    """

    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    least_strength: float = 0.0
    joint: bool = True
    surroundings: bool = False

    def __call__(self, scene: Scene, camera: Camera, *, probed: bool = False) -> Frame:
        """Renders `scene` from `camera`, where the scene's tensors are.

        Raises:
            ValueError: the scene has no surroundings, or its Gaussians no reflection strength.
        """
        check_surrounded(scene)
        camera = camera.to(scene.primary.means.device)
        projected = project_gaussians(scene.primary, camera, near=NEAR_PER_EXTENT * scene.extent)
        screen = (screen_pass("primary", projected),) if probed else ()
        surface = seen_surface(scene.primary, camera, projected, background=self.background, screen=screen)
        chosen = (surface.strength > self.least_strength) & (surface.depth > 0)
        reflection = self._reflection(scene, camera, surface, chosen)
        share = torch.where(chosen, surface.strength, torch.zeros_like(surface.strength))[..., None]
        layers = surface.layers() | {"reflection": reflection}
        if self.surroundings:
            d = view_directions(camera).reshape(-1, 3)
            origins = camera.center.expand_as(d).contiguous()
            seen = traced_colors(scene, origins, d, NEAR_PER_EXTENT * scene.extent, self.background)
            layers["surroundings"] = seen.reshape(camera.height, camera.width, 3)
        return Frame((1 - share) * surface.base + share * reflection, layers, direct=shown(projected), screen=screen)

    def _reflection(self, scene: Scene, camera: Camera, surface: Surface, chosen: Tensor) -> Tensor:
        """[H, W, 3] what the chosen pixels mirror, black elsewhere."""
        places, directions = reflected_rays(surface, camera, chosen)
        if not self.joint:
            places, directions = places.detach(), directions.detach()
        colors = traced_colors(scene, places, directions, START_PER_EXTENT * scene.extent, self.background)
        return torch.zeros_like(surface.base).index_put(torch.where(chosen), colors)


def traced_colors(
    scene: Scene, origins: Tensor, directions: Tensor, near: float, background: tuple[float, float, float]
) -> Tensor:
    """Colours [R, 3] of the surroundings along rays, from `near` lengths of their directions on."""
    part = scene.surroundings
    raw = RawGaussians(part.means, part.quats, part.log_scales, part.logit_opacities, part.sh)
    bvh = build_bvh(shapes_of(raw), flat=part.log_scales.shape[1] == FLAT)
    found = trace(raw, Rays(origins, directions), bvh, sh_degree=part.active_sh_degree, near=near)
    return over_background(found.colors, found.alphas, background)


def check_surrounded(scene: Scene) -> None:
    """Raises ValueError where a scene lacks what traced reflections need."""
    if not len(scene.surroundings):
        raise ValueError("the scene has no surroundings; expected one trained with `traced`")
    if "logit_strength" not in scene.primary.channels:
        raise ValueError(
            f"the Gaussians have the channels {sorted(scene.primary.channels)}; expected logit_strength, as `traced` "
            "trains it"
        )
