"""The CUDA kernels of panes against their PyTorch twins; see `test_parity.py`."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from glassplat.kernels import Fresnel
from glassplat.kernels import panes as panes_operation
from glassplat.kernels.panes import cpu as panes_on_the_cpu
from glassplat.kernels.panes import reference as panes_twin
from glassplat.kernels.records import Panes
from glassplat.render.panes import mirrored_views, panes_in_camera
from glassplat.scene.camera import Camera
from glassplat.scene.panes import Planes
from tests.kernels.cuda.agreement import (
    DEVICE,
    DTYPES,
    HEIGHT,
    WIDTH,
    check_gradients,
    close,
    many,
    on_a_device_or_skipped,
    on_device,
)
from tests.kernels.gaussians_and_cameras import draw, random_cameras
from tests.kernels.test_gradient_conflict import pictures

on_a_device_or_skipped()


def two_panes(dtype: torch.dtype) -> tuple[Panes, Tensor]:
    """Two rectangles that overlap on screen, and the intrinsics."""
    centers = torch.tensor([[0.0, 0.1, 3.0], [0.6, 0.0, 2.5]])
    normals = torch.nn.functional.normalize(torch.tensor([[0.1, 0.2, -1.0], [-0.8, 0.0, -0.6]]), dim=1)
    first = torch.nn.functional.normalize(
        torch.linalg.cross(normals, torch.tensor([[0.0, 1.0, 0.0]]).expand(2, 3)), dim=1
    )
    axes = torch.stack([first, torch.linalg.cross(normals, first)], dim=1)
    half_sizes = torch.tensor([[0.6, 0.4], [0.8, 0.5]])
    intrinsics = torch.tensor([0.9 * WIDTH, 0.8 * WIDTH, WIDTH / 2, HEIGHT / 2])
    return Panes(*(tensor.to(dtype) for tensor in (centers, normals, axes, half_sizes))), intrinsics.to(dtype)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("masked", [False, True])
def test_pane_hits(masked: bool, dtype: torch.dtype) -> None:
    panes, intrinsics = two_panes(dtype)
    mask = draw(HEIGHT, WIDTH, seed=5).to(dtype).clamp(min=0) if masked else None
    own_mask = None if mask is None else mask.to(DEVICE)
    found = panes_operation.pane_hits(on_device(panes), intrinsics.to(DEVICE), WIDTH, HEIGHT, own_mask)
    expected = panes_twin.pane_hits(panes, intrinsics, WIDTH, HEIGHT, mask)
    assert set(expected.pane.flatten().tolist()) == {-1, 0, 1}
    for value, want in zip(found, expected, strict=True):
        close(value, want)
    further = panes_operation.pane_hits(on_device(panes), intrinsics.to(DEVICE), WIDTH, HEIGHT, own_mask, beyond=found)
    expected = panes_twin.pane_hits(panes, intrinsics, WIDTH, HEIGHT, mask, beyond=expected)
    assert bool((expected.pane >= 0).any())
    for value, want in zip(further, expected, strict=True):
        close(value, want)


@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("dtype", DTYPES)
def test_layer_derivatives(linear: bool, dtype: torch.dtype) -> None:
    strength = draw(HEIGHT, WIDTH, seed=1).to(dtype).sigmoid()
    layers = [1.2 * draw(HEIGHT, WIDTH, 3, seed=seed).to(dtype).sigmoid() - 0.1 for seed in (2, 3)]
    where = draw(HEIGHT, WIDTH, seed=4) > 0
    own = (tensor.to(DEVICE) for tensor in (strength, *layers, where))
    found = panes_operation.layer_derivatives(*own, linear=linear)
    for value, want in zip(found, panes_twin.layer_derivatives(strength, *layers, where, linear=linear), strict=True):
        close(value, want)


@pytest.mark.parametrize("dtype", DTYPES)
def test_sample_derivatives(dtype: torch.dtype) -> None:
    """At centres inside the image, far outside it and at NaN, in front of and behind the surface."""
    slopes, near = (draw(HEIGHT, WIDTH, seed=seed).to(dtype) for seed in (1, 2))
    means, depths = 30 * draw(2, many(20, 2000), 2, seed=3).to(dtype), draw(2, many(20, 2000), seed=4).to(dtype)
    means[0, 0, 0], means[1, 1, 1], means[0, 2], means[1, 3] = torch.nan, torch.nan, torch.inf, -torch.inf
    given = slopes, near, means, depths
    found, expected = (
        panes_operation.sample_derivatives(*map(on_device, given)),
        panes_on_the_cpu.sample_derivatives(*given),
    )
    close(found, expected)
    assert 0.2 < float((expected == 1).double().mean()) < 0.8


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    ("size", "cell", "has_strength"), [((many(4, 60), 5), 1, False), ((many(7, HEIGHT), many(8, WIDTH)), 4, True)]
)
def test_gradient_conflict(size: tuple[int, int], cell: int, has_strength: bool, dtype: torch.dtype) -> None:
    images = pictures(*size, dtype)
    strength = draw(*size, seed=7).to(dtype).sigmoid() if has_strength else None
    transmission, own = images[0].requires_grad_(), on_device(images[0])
    found = panes_operation.gradient_conflict(own, *map(on_device, images[1:]), on_device(strength), cell=cell)
    expected = panes_twin.gradient_conflict(*images, strength, cell=cell)
    close(found, expected)
    check_gradients([found], [expected], [own], [transmission])


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("size", [(many(9, HEIGHT), many(20, WIDTH)), (1, 7), (7, 1)])
def test_inside_of_panes(size: tuple[int, int], dtype: torch.dtype) -> None:
    """Stripes of two panes and of no pane, with holes where nothing reflects."""
    pane = (torch.arange(size[1]).expand(size) // 6 % 3 - 1).int().contiguous()
    strength = (draw(*size, seed=3).to(dtype) + 1.8).clamp(min=0)
    found = panes_operation.inside_panes(pane.to(DEVICE), strength.to(DEVICE))
    expected = panes_on_the_cpu.inside_panes(pane, strength)
    close(found, expected)
    assert min(size) == 1 or 0.1 < float(expected.mean()) < 0.9


def three_planes(dtype: torch.dtype) -> tuple[Planes, Camera]:
    """Planes with raw normals of any length, one of which faces away from the camera."""
    planes = Planes(*(draw(3, n, seed=n + i) for i, n in enumerate((3, 3))), draw(3, seed=5), draw(3, 3, seed=6),
                    draw(3, 2, seed=7).exp(), (1, 2, 3))  # fmt: skip
    pose = random_cameras(1).cam_from_world[0].detach()
    camera = Camera(pose.to(dtype), 10.0, 10.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
    return planes.with_tensors({name: tensor.to(dtype) for name, tensor in planes.tensors().items()}), camera


@pytest.mark.parametrize("dtype", DTYPES)
def test_mirrored_views(dtype: torch.dtype) -> None:
    planes, camera = three_planes(dtype)
    rows, last = camera.cam_from_world.split((3, 1))
    leaves = [t.requires_grad_() for t in (planes.centers, planes.raw_normals, rows)]
    own = [on_device(leaf) for leaf in leaves]
    found = panes_operation.mirrored_views(*own[:2], torch.cat([own[2], last.to(DEVICE)]))
    expected = mirrored_views(planes, replace(camera, cam_from_world=torch.cat([rows, last])))
    sides = expected.half_spaces[:, :3] * planes.normals
    assert len(set(sides.sum(dim=1).sign().tolist())) == 2
    for value, want in zip(found, expected, strict=True):
        close(value, want)
    check_gradients(found[:2], expected[:2], own, leaves)


@pytest.mark.parametrize("dtype", DTYPES)
def test_panes_in_camera(dtype: torch.dtype) -> None:
    planes, camera = three_planes(dtype)
    given = planes.centers, planes.raw_normals, planes.tangents, planes.half_sizes, camera.cam_from_world
    found = panes_operation.panes_in_camera(*map(on_device, given))
    for value, want in zip(found, panes_in_camera(planes, camera), strict=True):
        close(value, want)


def test_pixels_without_a_pane_hit_none() -> None:
    panes, intrinsics = two_panes(torch.float64)
    none = Panes(*(tensor[:0].to(DEVICE) for tensor in panes))
    found = panes_operation.pane_hits(none, intrinsics.to(DEVICE), WIDTH, HEIGHT)
    assert (found.pane == -1).all()
    assert found.windows.shape == (0, 4)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    "switches", [("pane", True, True), ("schlick", True, True), ("none", True, False), ("pane", False, True)]
)
def test_blend_panes(switches: tuple[Fresnel, bool, bool], dtype: torch.dtype) -> None:
    panes, intrinsics = two_panes(dtype)
    pane = panes_twin.pane_hits(panes, intrinsics, WIDTH, HEIGHT).pane
    mask = draw(HEIGHT, WIDTH, seed=1).to(dtype).clamp(min=0, max=1)
    images = (torch.rand(HEIGHT, WIDTH, 3, dtype=dtype), mask, 2 * torch.rand(2, HEIGHT, WIDTH, 4, dtype=dtype))
    leaves = [t.requires_grad_() for t in (*images, panes.normals, torch.tensor([0.04, 0.5], dtype=dtype))]
    own = [on_device(leaf) for leaf in leaves]
    names = dict(zip(("fresnel", "intensity", "linear"), switches, strict=True))
    found = panes_operation.blend_panes(*own[:3], pane.to(DEVICE), *own[3:], intrinsics.to(DEVICE), **names)
    expected = panes_twin.blend_panes(*leaves[:3], pane, *leaves[3:], intrinsics, **names)
    for value, want in zip(found, expected, strict=True):
        close(value, want, 5)
    check_gradients(found, expected, own, leaves)
