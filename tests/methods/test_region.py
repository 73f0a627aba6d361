"""The region that the cameras surround."""

import math

import pytest
import torch

from glassplat.methods.surroundings import reflective_region
from glassplat.scene.camera import Camera


def looking_at(eye: torch.Tensor, target: torch.Tensor) -> Camera:
    """A camera at `eye` whose optical axis passes through `target`."""
    forward = torch.nn.functional.normalize(target - eye, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0.1, 1.0])), dim=0)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    pose = torch.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ eye
    return Camera(pose, 50.0, 50.0, 20.0, 20.0, 40, 40)


def ring(center: torch.Tensor, radius: float, *, turned: bool = False, miss: float = 0.0) -> list[Camera]:
    """Sixteen cameras on a circle that look at its centre, past it, or away from it."""
    cameras = []
    for i in range(16):
        angle = 2 * math.pi * i / 16
        spoke = torch.tensor([math.cos(angle), math.sin(angle), 0.5])
        beside = miss * radius * torch.tensor([0.0, 0.0, (-1.0) ** i])
        eye = center + radius * spoke
        cameras.append(looking_at(eye, 2 * eye - center if turned else center + beside))
    return cameras


def test_cameras_around_an_object_determine_its_region() -> None:
    center = torch.tensor([3.0, -1.0, 2.0])
    region = reflective_region(ring(center, 2.0))
    assert region is not None
    assert region[:3] == pytest.approx(center.tolist(), abs=1e-4)
    assert 0 < region[3] < 2.0


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_the_region_scales_with_the_capture(scale: float) -> None:
    center = torch.tensor([3.0, -1.0, 2.0])
    small, scaled = reflective_region(ring(center, 2.0)), reflective_region(ring(scale * center, scale * 2.0))
    assert small is not None and scaled is not None
    assert scaled == pytest.approx([scale * x for x in small], rel=1e-3)


def test_cameras_looking_outwards_have_no_reflective_region() -> None:
    assert reflective_region(ring(torch.zeros(3), 2.0, turned=True)) is None


def test_cameras_looking_in_all_directions_have_no_reflective_region() -> None:
    assert reflective_region(ring(torch.zeros(3), 2.0, miss=2.0)) is None


def test_parallel_cameras_have_none() -> None:
    eyes = [torch.tensor([float(x), 0.0, 0.0]) for x in range(5)]
    assert reflective_region([looking_at(eye, eye + torch.tensor([0.0, 1.0, 0.0])) for eye in eyes]) is None


def test_a_third_of_the_cameras_may_look_elsewhere() -> None:
    center = torch.tensor([3.0, -1.0, 2.0])
    around = ring(center, 2.0)
    away = [looking_at(camera.center, 3 * camera.center - 2 * center) for camera in around[::2]]
    region = reflective_region([*around, *away])
    assert region is not None
    assert region[:3] == pytest.approx(center.tolist(), abs=1e-3)
    assert region[3] == pytest.approx(reflective_region(around)[3], rel=1e-3)  # type: ignore[index]


def test_cameras_that_mostly_look_outwards_have_no_reflective_region() -> None:
    around = ring(torch.zeros(3), 2.0)
    away = ring(torch.zeros(3), 2.0, turned=True)
    assert reflective_region([*around[:8], *away]) is None
