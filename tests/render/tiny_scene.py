"""A tiny random scene with panes, for the optics tests."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from glassplat.render.frame import Renderer
from glassplat.render.panes import nearest_hits, panes_in_camera
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.panes import Planes
from glassplat.scene.scene import Scene


def random_gaussians(count: int, center: tuple[float, float, float], seed: int, glass: bool = False) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    return Gaussians(
        means=torch.tensor(center, dtype=torch.float64) + 0.5 * draw(count, 3),
        quats=draw(count, 4),
        log_scales=math.log(0.15) + 0.3 * draw(count, 3),
        logit_opacities=draw(count),
        sh=0.4 * draw(count, 0 if glass else 9, 3),
        channels={"logit_mark": 2 + draw(count)} if glass else {"log_intensity": 0.2 * draw(count)},
        active_sh_degree=0 if glass else 2,
    )


def camera_at(x: float, y: float, z: float, *, width: int = 40, height: int = 28) -> Camera:
    """A camera that looks along +z, upright."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = -torch.tensor([x, y, z], dtype=torch.float64)
    return Camera(pose, 30.0, 31.0, width / 2 + 0.3, height / 2 - 0.2, width, height)


CAMERA = camera_at(0.0, 0.0, -0.2)


def pane(z: float, half: float = 50.0, label: int = 1, base_reflectance: float = 0.3) -> Planes:
    """A pane across the z axis, facing -z, slightly tilted."""
    return Planes(
        centers=torch.tensor([[0.1, -0.05, z]], dtype=torch.float64),
        raw_normals=torch.tensor([[0.05, 0.08, -1.0]], dtype=torch.float64),
        logit_reflectances=torch.logit(torch.tensor([base_reflectance], dtype=torch.float64)),
        tangents=torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64),
        half_sizes=torch.tensor([[half, half]], dtype=torch.float64),
        labels=(label,),
    )


def joined(*parts: Planes) -> Planes:
    tensors = {name: torch.cat([p.tensors()[name] for p in parts]) for name in parts[0].tensors()}
    return Planes(**tensors, labels=tuple(label for p in parts for label in p.labels))


def concatenated(*parts: Gaussians) -> Gaussians:
    return parts[0].with_tensors({name: torch.cat([p.tensors()[name] for p in parts]) for name in parts[0].tensors()})


def showcase(planes: Planes | None = None) -> Scene:
    """Objects behind a pane at z = 2, objects behind the camera at the origin, and glass on the pane."""
    behind_pane = random_gaussians(14, (0.0, 0.0, 3.5), seed=1)
    in_room = random_gaussians(16, (0.2, 0.1, -1.5), seed=2)
    glass = random_gaussians(12, (0.0, 0.0, 2.0), seed=3, glass=True)
    return Scene(primary=concatenated(behind_pane, in_room), glass=glass, planes=planes or pane(2.0), extent=2.0)


def in_single_precision(scene: Scene) -> Scene:
    parts = {
        name: part.with_tensors({n: t.float() for n, t in part.tensors().items()})
        for name, part in scene.gaussian_sets().items()
    }
    planes = scene.planes.with_tensors({n: t.float() for n, t in scene.planes.tensors().items()})
    return replace(scene, **parts, planes=planes)


def shown_panes(planes: Planes, camera: Camera) -> Tensor:
    """[K, H, W] bool: the pixels that show each pane; where panes overlap, the nearest."""
    index = nearest_hits(panes_in_camera(planes, camera), camera).pane
    return index == torch.arange(len(planes), dtype=torch.int32)[:, None, None]


def quat_product(left: Tensor, right: Tensor) -> Tensor:
    """The rotation `left` [4] applied after each of the rotations `right` [N, 4]."""
    w, v = left[0], left[1:]
    rw, rv = right[:, :1], right[:, 1:]
    vector = w * rv + rw * v + torch.linalg.cross(v.expand_as(rv), rv)
    return torch.cat([w * rw - (rv * v).sum(-1, keepdim=True), vector], dim=1)


FEW = 12
"""Values of a tensor up to which each is checked."""


def assert_gradient_matches(renderer: Renderer, scene: Scene, name: str, *, rtol: float = 1e-4) -> None:
    """Compares the gradient of a tensor through a renderer with finite differences: for each of a few values, or in
    three random directions.
    """
    values = scene.parameters()[name].clone().requires_grad_()
    weights = torch.randn(28, 40, 3, generator=torch.Generator().manual_seed(9), dtype=torch.float64)

    def objective(values: Tensor) -> Tensor:
        return (renderer(scene.with_parameters({name: values}), CAMERA).rgb * weights).sum()

    (gradient,) = torch.autograd.grad(objective(values), values)
    assert float(gradient.abs().max()) > 1e-3
    count, generator = values.numel(), torch.Generator().manual_seed(5)
    if count <= FEW:
        steps = torch.eye(count, dtype=torch.float64)
    else:
        steps = torch.randn(3, count, generator=generator, dtype=torch.float64)
    with torch.no_grad():
        for step in steps.reshape(-1, *values.shape):
            slope = (objective(values + 1e-6 * step) - objective(values - 1e-6 * step)) / 2e-6
            torch.testing.assert_close((gradient * step).sum(), slope, rtol=rtol, atol=1e-5)
