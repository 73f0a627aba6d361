"""`deferred`: glossy objects under distant light (3D Gaussian Splatting with Deferred Reflection), and blended
surfaces.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from glassplat.kernels.composite import mean_depth
from glassplat.kernels.environment import cube_lookup, shade_environment
from glassplat.kernels.panes.reference import pixel_rays, ray_grid
from glassplat.kernels.records import NORMAL_MIN, Shaded
from glassplat.render.frame import (
    NEAR_PER_EXTENT,
    Frame,
    ScreenPass,
    WithBackground,
    check_colored,
    check_ellipsoids,
    check_numbers,
    over_background,
    project_gaussians,
    screen_pass,
    visible_gaussians,
)
from glassplat.render.splat import blend_discs, blend_ellipsoids, disc_layers, ellipsoid_channels, projected_discs
from glassplat.scene.camera import Camera
from glassplat.scene.scene import FACES, Environment, Scene

COLOR_MARGIN = 1e-3
"""Margin of colours to 0 and 1, whose logits are infinite; invisible in 8 bits."""


def equirect_from_environment(environment: Environment, height: int) -> Tensor:
    """The environment as a panorama [H, 2H, 3] sRGB in (0, 1); each pixel is an area mean.

    Differentiable in the environment.

    Args:
        environment: a non-empty environment.
        height: rows of the panorama; 2 S shows every texel.

    Raises:
        ValueError: the environment is empty, or the height is below 1.
    """
    _check_not_empty(environment)
    if height < 1:
        raise ValueError(f"the panorama's height is {height}; expected at least 1 row")
    samples = max(1, math.ceil(2 * environment.size / height))
    directions = panorama_directions(samples * height).to(environment.raw)
    colors = torch.sigmoid(cube_lookup(environment.raw, directions))
    return colors.reshape(height, samples, 2 * height, samples, 3).mean(dim=(1, 3))


def environment_from_equirect(image: Tensor, size: int) -> Environment:
    """The environment from a panorama; each texel is an area mean.

    Args:
        image: [H, 2H, 3] sRGB in [0, 1]; values are clamped to `COLOR_MARGIN` from 0 and 1.
        size: texels along the side of a face.

    Raises:
        ValueError: the image is not twice as wide as high or not finite floating point, or the size is below 1.
    """
    height = image.shape[0] if image.ndim else 0
    if height < 1 or tuple(image.shape) != (height, 2 * height, 3):
        raise ValueError(f"the panorama has shape {tuple(image.shape)}; expected (H, 2 H, 3)")
    if not image.is_floating_point() or not bool(torch.isfinite(image).all()):
        raise ValueError("the panorama contains integers or non-finite values; expected floating-point sRGB in [0, 1]")
    if size < 1:
        raise ValueError(f"the environment's size is {size}; expected at least 1 texel along a face")
    samples = max(1, math.ceil(height / (2 * size)))
    fine = _sample_panorama(image, texel_directions(samples * size).to(image))
    colors = fine.reshape(FACES, size, samples, size, samples, 3).mean(dim=(2, 4))
    return Environment(torch.logit(colors.clamp(COLOR_MARGIN, 1 - COLOR_MARGIN)))


def resize_environment(environment: Environment, size: int) -> Environment:
    """The environment at another resolution; raw values are interpolated between texel centres."""
    _check_not_empty(environment)
    return replace(environment, raw=cube_lookup(environment.raw, texel_directions(size).to(environment.raw)))


def panorama_directions(height: int) -> Tensor:
    """Unit directions [H, 2H, 3] float64 of the pixel centres of a panorama."""
    latitudes = math.pi * (0.5 - (torch.arange(height, dtype=torch.float64) + 0.5) / height)
    longitudes = 2 * math.pi * (0.5 - (torch.arange(2 * height, dtype=torch.float64) + 0.5) / (2 * height))
    z, across = latitudes.sin()[:, None], latitudes.cos()[:, None]
    return torch.stack([across * longitudes.cos(), across * longitudes.sin(), z.expand(-1, 2 * height)], dim=-1)


def texel_directions(size: int) -> Tensor:
    """Directions [6, S, S, 3] float64 of the texel centres of a cube map, faces and axes as in `cube_lookup`."""
    centers = (2 * torch.arange(size, dtype=torch.float64) + 1) / size - 1
    directions = torch.empty(FACES, size, size, 3, dtype=torch.float64)
    for face in range(FACES):
        axis = face // 2
        directions[face, ..., axis] = 1 - 2 * (face % 2)
        directions[face, ..., (axis + 1) % 3] = centers
        directions[face, ..., (axis + 2) % 3] = centers[:, None]
    return directions


def _check_not_empty(environment: Environment) -> None:
    if environment.is_empty:
        raise ValueError("the scene has no environment; expected one trained with `deferred`")


def _sample_panorama(image: Tensor, directions: Tensor) -> Tensor:
    """The panorama in directions [..., 3], with bilinear interpolation across its ends and poles."""
    height, width = image.shape[:2]
    # Beyond a pole, the opposite meridian follows.
    rows = torch.cat([image[:1].roll(height, dims=1), image, image[-1:].roll(height, dims=1)])
    padded = torch.cat([rows[:, -1:], rows, rows[:, :1]], dim=1)
    x, y, z = directions.unbind(-1)
    column = (0.5 - torch.atan2(y, x) / (2 * math.pi)) * width + 0.5
    row = (0.5 - torch.atan2(z, torch.hypot(x, y)) / math.pi) * height + 0.5
    grid = torch.stack([2 * column / (width + 1) - 1, 2 * row / (height + 1) - 1], dim=-1).reshape(1, -1, 1, 2)
    found = grid_sample(padded.permute(2, 0, 1)[None], grid, align_corners=True, padding_mode="border")
    return found[0, :, :, 0].T.reshape(directions.shape)


CELLS_ACROSS = 32
"""Cells along the longer side of an image; depths and normals are averaged over cells before they are compared."""
LEAST_COVERAGE = 0.5
"""Coverage of a pixel above which its depth counts."""
LEAST_CELLS_ACROSS = 3
"""Minimum number of cells along the shorter side, if there are enough pixels: a normal needs a cell and its
neighbours."""
MOST_DEPTH_CHANGE = 0.15
"""Maximum change of depth between neighbouring cells, as a share of the depth, on one surface."""


def cell_side(camera: Camera) -> int:
    """Pixels along the side of a cell."""
    shorter, longer = sorted((camera.width, camera.height))
    return max(1, min(round(longer / CELLS_ACROSS), shorter // LEAST_CELLS_ACROSS))


def depth_normals(depth: Tensor, alpha: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Normals [h, w, 3] of a depth map's cells, world axes, facing the camera; and their validity [h, w], 1 or 0.

    Args:
        depth: [H, W] along the optical axis.
        alpha: [H, W] coverage.
        camera: camera of the depth map.
    """
    side = cell_side(camera)
    covered = (alpha > LEAST_COVERAGE).to(depth.dtype)
    share = cell_means(covered[..., None], side)[..., 0]
    mean_depth = cell_means((depth * covered)[..., None], side)[..., 0] / share.clamp(min=1e-6)
    height, width = mean_depth.shape
    points = mean_depth[..., None] * ray_grid(camera.shared_intrinsics.to(depth) / side, width, height)
    along, down = torch.zeros_like(points), torch.zeros_like(points)
    along[:, 1:-1] = points[:, 2:] - points[:, :-2]
    down[1:-1] = points[2:] - points[:-2]
    # In a frame with x to the right, y down and z forward, down x along points to the camera.
    normals = torch.nn.functional.normalize(torch.linalg.cross(down, along), dim=-1)
    steepness = _neighbourhood_max(mean_depth) + _neighbourhood_max(-mean_depth)
    whole = (_neighbourhood_max(1 - share) == 0) & (steepness < MOST_DEPTH_CHANGE * mean_depth)
    whole &= normals.abs().sum(-1) > 0
    rotation = camera.cam_from_world[:3, :3].to(depth)
    return normals @ rotation, whole.to(depth.dtype)


def cell_means(image: Tensor, side: int) -> Tensor:
    """Means [h, w, D] over the whole cells of an image [H, W, D]."""
    return torch.nn.functional.avg_pool2d(image.permute(2, 0, 1), side).permute(1, 2, 0)


def _neighbourhood_max(image: Tensor) -> Tensor:
    """[h, w] largest value among each cell and its eight neighbours."""
    return torch.nn.functional.max_pool2d(image[None], 3, 1, 1)[0]


@dataclass(frozen=True)
class Surface:
    """The blended surfaces of one view (EnvGS, Eq. 3).

    Attributes:
        image: [H, W, D] blended channels, as `shade_environment` reads them.
        color: [H, W, 3] blended colour without reflection and background.
        normal: [H, W, 3] blended normal, world axes, facing the camera, not normalised.
        strength: [H, W] reflection strength.
        depth: [H, W] mean camera z, 0 where empty; no elements if not requested.
        alpha: [H, W] coverage.
        background: background colour, sRGB.
        direct: [N] bool, visible Gaussians.
        screen: record of the pass, if requested by `with_records`.
        extra: further layers; for discs, those of the surface's thickness.
    """

    image: Tensor
    color: Tensor
    normal: Tensor
    strength: Tensor
    depth: Tensor
    alpha: Tensor
    background: tuple[float, float, float]
    direct: Tensor
    screen: tuple[ScreenPass, ...] = ()
    extra: Mapping[str, Tensor] = field(default_factory=dict)

    @cached_property
    def base(self) -> Tensor:
        """[H, W, 3] colour without reflection, over the background, as `shade_environment` returns it."""
        return over_background(self.color, self.alpha, self.background)

    def layers(self, base: Tensor) -> dict[str, Tensor]:
        """The layers of a frame, given the colour without reflection [H, W, 3]."""
        return {
            **self.extra,
            "base": base,
            "normal": self.normal,
            "strength": self.strength,
            **({"depth": self.depth} if self.depth.numel() else {}),
            "alpha": self.alpha,
        }


def blend_surface(
    scene: Scene,
    camera: Camera,
    *,
    background: tuple[float, float, float],
    depth: bool = True,
    with_records: bool = False,
) -> Surface:
    """Blends the surfaces of the primary Gaussians, which have a `logit_strength`. Depths of ellipsoids are those of
    their centres, and are omitted without `depth`, which saves a channel; those of discs are at ray intersections.
    """
    near = NEAR_PER_EXTENT * scene.extent
    extra: dict[str, Tensor] = {}
    if scene.primary.are_discs:
        discs = projected_discs(scene.primary, camera, near=near)
        screen = (screen_pass("primary", discs),) if with_records else ()
        strengths = torch.sigmoid(scene.primary.channels["logit_strength"])[None, :, None]
        channels = torch.cat([discs.colors, discs.normals, strengths], dim=-1)
        blended = blend_discs(discs, channels, camera, near=near, screen=screen)
        image, extra = blended.image[0], disc_layers(blended, scene.extent)
        alpha, distance = extra.pop("alpha"), extra.pop("depth")
        color, normal, strength = image.split((3, 3, 1), dim=2)
        direct = visible_gaussians(discs)
    else:
        projected = project_gaussians(scene.primary, camera, near=near)
        screen = (screen_pass("primary", projected),) if with_records else ()
        depths = projected.depths[0, :, None] if depth else None
        channels = ellipsoid_channels(scene.primary, projected, camera, depths)
        result = blend_ellipsoids(projected, channels[None], camera, screen=screen)
        image, alpha = result.image[0], result.alpha[0]
        # Split in one operation, because slices have gradients as large as the image.
        color, normal, strength, *last = image.split((3, 3, 1, 1) if depth else (3, 3, 1), dim=2)
        distance = mean_depth(last[0].squeeze(2), alpha) if depth else alpha.new_zeros(0)
        direct = visible_gaussians(projected)
    return Surface(
        image=image,
        color=color,
        background=background,
        normal=normal,
        strength=strength.squeeze(2),
        depth=distance,
        alpha=alpha,
        direct=direct,
        screen=screen,
        extra=extra,
    )


def reflected_rays(surface: Surface, camera: Camera, chosen: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """Positions [R, 3] of the surface at pixels (rows and columns [R]), and reflected unit directions [R, 3] (Eq. 4).

    Blended positions need no channels: with d the ray of a pixel whose camera z is 1, x = o + D d, D the blended depth.
    """
    rotation = camera.cam_from_world[:3, :3]
    rows, columns = (index.to(rotation) for index in chosen)
    d = pixel_rays(camera.shared_intrinsics.to(rotation), columns, rows) @ rotation
    positions = camera.center + surface.depth[chosen][:, None] * d
    normal = surface.normal[chosen]
    normal = normal / normal.norm(dim=-1, keepdim=True).clamp(min=NORMAL_MIN)
    mirrored = d - 2 * (d * normal).sum(-1, keepdim=True) * normal
    return positions, torch.nn.functional.normalize(mirrored, dim=-1)


def shaded_pixels(
    scene: Scene,
    camera: Camera,
    image: Tensor,
    alpha: Tensor,
    background: tuple[float, float, float],
    least_strength: float,
) -> Shaded:
    """Shades blended surfaces [H, W, D] with coverage [H, W] by the scene's environment."""
    return shade_environment(
        image,
        alpha,
        scene.environment.raw,
        camera.shared_intrinsics,
        camera.cam_from_world[:3, :3].T.contiguous(),
        background=background,
        least_strength=least_strength,
    )


def view_directions(camera: Camera) -> Tensor:
    """[H, W, 3] directions from the camera through the pixel centres, world axes, not unit."""
    rotation = camera.cam_from_world[:3, :3]
    return ray_grid(camera.shared_intrinsics.to(rotation), camera.width, camera.height) @ rotation


INVISIBLE = 1 / 512
"""Weaker reflections change a pixel by at most half a step of 8 bits."""


@dataclass(frozen=True)
class Deferred(WithBackground):
    """Blends colour, normal and reflection strength, then shades every pixel once (3DGS-DR, Section 3.1).

        C, N, R = sum_i (c_i, n_i, r_i) alpha_i T_i                   (Eqs. 1 and 2)
        C' = (1 - R) C + R E(2 (v . n) n - v),  n = N / |N|           (Eq. 3)

    n_i is the shortest axis of a Gaussian, facing the camera, v the direction to the camera, E the environment.
    Colours are sRGB, as in the paper.

    Layers: `base` C, `reflection` E, `normal` N in world axes, blended and not normalised [H, W, 3]; `strength` R,
    `alpha`, `depth` [H, W]; `environment` [H, W, 3], the environment behind each pixel, if requested.

    Attributes:
        background: background colour, sRGB.
        depth: also render the depth layer.
        environment: also render the layer `environment`.
        least_strength: pixels below it are not shaded, and their `reflection` is 0. Not for training, where strengths
            need the gradient of potential reflections.
    """

    depth: bool = True
    environment: bool = False
    least_strength: float = 0.0

    def __call__(self, scene: Scene, camera: Camera, *, with_records: bool = False) -> Frame:
        """Renders `scene` from `camera`, on the scene's device.

        Raises:
            ValueError: the scene has no environment, or its Gaussians have no reflection strength.
        """
        check_reflective(scene)
        camera = camera.to(scene.primary.means.device)
        surface = blend_surface(scene, camera, background=self.background, depth=self.depth, with_records=with_records)
        shaded = shaded_pixels(scene, camera, surface.image, surface.alpha, self.background, self.least_strength)
        layers = surface.layers(shaded.base) | {"reflection": shaded.reflection}
        if self.environment:
            layers["environment"] = torch.sigmoid(cube_lookup(scene.environment.raw, view_directions(camera)))
        return Frame(shaded.rgb, layers, surface.direct, screen=surface.screen, background=self.background)

    def check(self, scene: Scene) -> None:
        """Raises ValueError if a scene lacks colours, or tensors for reflection."""
        check_colored(scene.primary)
        check_ellipsoids(scene.primary)
        check_reflective(scene)

    def layers(self, scene: Scene) -> tuple[str, ...]:
        """Names of the layers for display."""
        return ("rgb", "base", "reflection", "strength", "normal", "environment", "depth", "alpha")

    def with_layers(self, layers: Sequence[str]) -> Deferred:
        """The renderer with `depth` and `environment` enabled if they are among the layers."""
        environment = self.environment or "environment" in layers
        return replace(self, depth=self.depth or "depth" in layers, environment=environment)

    def page_settings(self) -> Mapping[str, Any]:
        """Settings of the web page: shading with distant light."""
        return {**super().page_settings(), "mirrored": "distant"}


def check_reflective(scene: Scene) -> None:
    """Raises ValueError if a scene lacks tensors for reflection."""
    _check_not_empty(scene.environment)
    check_strengths(scene, "deferred")


def check_strengths(scene: Scene, method: str) -> None:
    """Raises ValueError without reflection strengths, or if the environment cannot be drawn."""
    if "logit_strength" not in scene.primary.channels:
        raise ValueError(
            f"the Gaussians have the channels {sorted(scene.primary.channels)}; expected logit_strength, as "
            f"`{method}` trains it"
        )
    check_numbers(
        {"environment.raw": scene.environment.raw, "logit_strength": scene.primary.channels["logit_strength"]}
    )
