"""A synthetic room with splats as large as those of a trained capture, and panes over part of the image."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.panes import Planes
from glassplat.scene.scene import Environment, Scene

PANE_DEPTH = 2.0


def bench_camera(width: int, height: int) -> Camera:
    """A camera at the origin that looks along +z."""
    focal = 0.9 * width
    return Camera(torch.eye(4), focal, focal, width / 2, height / 2, width, height)


def room(count: int, seed: int = 0, sh_degree: int = 3) -> Gaussians:
    """A room with half of the Gaussians in front of the camera, and half behind it, where panes reflect them.

    Sizes shrink with the number, as in training, so that the overdraw of the image stays about constant.
    """
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    depth = 2.5 + 3 * torch.rand(count, generator=generator)
    sideways = (torch.rand(count, 2, generator=generator) - 0.5) * 1.4 * depth[:, None]
    means = torch.cat([sideways, depth[:, None]], dim=1)
    means[count // 2 :, 2] *= -1
    size = 0.012 * math.sqrt(100_000 / count)
    return Gaussians(
        means=means,
        quats=draw(count, 4),
        log_scales=math.log(size) + 0.6 * draw(count, 3),
        logit_opacities=1.5 * draw(count),
        sh=0.2 * draw(count, (sh_degree + 1) ** 2, 3),
        channels={"log_intensity": torch.zeros(count)},
        active_sh_degree=sh_degree,
    )


def panes(count: int, share: float, camera: Camera) -> Planes:
    """Upright panes next to each other that cover a share of the image width, over its full height."""
    left, right = -camera.cx / camera.fx, (camera.width - camera.cx) / camera.fx
    width = share * (right - left) / count * PANE_DEPTH
    centers = torch.zeros(count, 3)
    centers[:, 0] = left * PANE_DEPTH + width * (torch.arange(count) + 0.5)
    centers[:, 2] = PANE_DEPTH
    return Planes(
        centers=centers,
        raw_normals=torch.tensor([[0.0, 0.0, -1.0]]).repeat(count, 1),
        logit_reflectances=torch.full((count,), -1.5),
        tangents=torch.tensor([[1.0, 0.0, 0.0]]).repeat(count, 1),
        half_sizes=torch.tensor([[width / 2, 10.0]]).repeat(count, 1),
        labels=tuple(range(1, count + 1)),
    )


def glass_on(planes: Planes, per_pane: int = 1000, seed: int = 1) -> Gaussians:
    """Glass discs spread over the visible part of each pane."""
    generator = torch.Generator().manual_seed(seed)
    count = len(planes) * per_pane
    across = (2 * torch.rand(count, generator=generator) - 1) * planes.half_sizes[:, :1].repeat_interleave(per_pane)
    upright = 2 * (torch.rand(count, generator=generator) - 0.5) * PANE_DEPTH
    means = planes.centers.repeat_interleave(per_pane, dim=0).clone()
    means[:, 0] += across
    means[:, 1] = upright
    size = math.log(0.06)
    return Gaussians(
        means=means,
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        log_scales=torch.tensor([[size, size, size - 3]]).repeat(count, 1),
        logit_opacities=torch.full((count,), 2.0),
        sh=torch.zeros(count, 0, 3),
        channels={"logit_mark": torch.full((count,), 4.0)},
    )


def bench_scene(count: int, num_panes: int, share: float, camera: Camera) -> Scene:
    """The room on both sides of `num_panes` panes."""
    planes = panes(num_panes, share, camera) if num_panes else Planes.empty()
    if not num_panes:
        return Scene(room(count), extent=3.0)
    return Scene(room(count), extent=3.0, planes=planes, glass=glass_on(planes))


def glossy_scene(count: int) -> Scene:
    """The same room with glossy Gaussians only, in a random environment."""
    primary = room(count)
    environment = Environment.random(128, generator=torch.Generator().manual_seed(2))
    return Scene(replace(primary, channels={"logit_strength": torch.zeros(count)}), extent=3.0, environment=environment)


def mirroring_scene(count: int) -> Scene:
    """The same room with glossy Gaussians only, which reflect a second room of equally many Gaussians."""
    primary, others = room(count), replace(room(count, seed=3), channels={})
    return Scene(replace(primary, channels={"logit_strength": torch.zeros(count)}), extent=3.0, surroundings=others)
