"""The photographer's frame follows the camera and stands on the ground."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from glassplat.scene.camera import Camera
from glassplat.scene.corrections import DEFAULT_UP, estimate_up, world_from_photographer
from tests.render.tiny_scene import camera_at

UP = (0.36, 0.48, -0.8)


def turned(yaw_deg: float, pitch_deg: float, roll_deg: float = 0.0) -> Camera:
    """A camera rotated about `UP` and tilted about its own axes."""
    x = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor(UP), torch.tensor([1.0, 0.0, 0.0])), dim=0)
    down = -torch.tensor(UP)
    level = torch.stack([x, down, torch.linalg.cross(x, down)], dim=1).double()
    axes = Rotation.from_euler("YXZ", [yaw_deg, pitch_deg, roll_deg], degrees=True).as_matrix()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = (level @ torch.from_numpy(axes)).T
    pose[:3, 3] = torch.tensor([0.3, -0.2, 0.5])
    return replace(camera_at(0, 0, 0), cam_from_world=pose)


def angle_deg(direction: tuple[float, float, float], other: tuple[float, float, float]) -> float:
    cosine = torch.tensor(direction).double() @ torch.tensor(other).double()
    return float(torch.rad2deg(torch.acos(cosine.clamp(-1, 1))))


def test_cameras_tilted_down_determine_the_up_direction() -> None:
    cameras = [turned(yaw, -40 + (yaw % 7)) for yaw in range(0, 360, 25)]
    assert angle_deg(estimate_up(cameras), UP) < 0.5
    wobbly = [turned(yaw, -40, 3 * (-1) ** (yaw % 2)) for yaw in range(0, 360, 25)]
    assert angle_deg(estimate_up(wobbly), UP) < 1.5


def test_cameras_tilted_down_on_one_side_determine_the_up_direction() -> None:
    """Their image verticals agree on a direction that deviates from up by their tilt."""
    cameras = [turned(yaw, -30) for yaw in range(-40, 41, 20)]
    assert angle_deg(estimate_up(cameras), UP) < 3
    assert estimate_up(100 * cameras) == pytest.approx(estimate_up(cameras))


def test_cameras_that_look_one_way_are_taken_to_stand_upright() -> None:
    assert angle_deg(estimate_up([turned(10, 0), turned(10, 0)]), UP) < 1e-3


@pytest.mark.parametrize("wobble_deg", [0, 4])
def test_cameras_that_look_straight_down_look_away_from_up(wobble_deg: float) -> None:
    cameras = [turned(yaw, -90 + wobble_deg * (yaw % 4 - 1), wobble_deg) for yaw in range(0, 360, 90)]
    assert angle_deg(estimate_up(cameras), UP) < max(wobble_deg, 0.1)
    assert math.hypot(*estimate_up(cameras)) == pytest.approx(1)


def test_contradictory_cameras_give_the_default_up_direction() -> None:
    assert estimate_up([turned(0, 0), turned(0, 180)]) == DEFAULT_UP


@pytest.mark.parametrize("pitch_deg", [0.0, -35.0, 50.0, -89.9])
def test_the_body_stands_upright_at_the_camera_and_faces_as_it_does(pitch_deg: float) -> None:
    camera, level = turned(70, pitch_deg), turned(70, 0)
    frame = world_from_photographer(camera, UP)
    torch.testing.assert_close(frame[:3, 3], camera.center)
    torch.testing.assert_close(frame[:3, :3], level.cam_from_world[:3, :3].T, atol=1e-6, rtol=0)
    assert float(torch.linalg.det(frame)) == pytest.approx(1)


def test_without_an_upward_direction_the_body_leans_with_the_camera() -> None:
    camera = turned(20, -30, 10)
    product = camera.cam_from_world @ world_from_photographer(camera, None)
    torch.testing.assert_close(product, torch.eye(4, dtype=torch.float64))


def test_the_frame_is_differentiable_in_the_pose() -> None:
    camera = turned(20, -30, 5)

    def frame(pose: Tensor) -> Tensor:
        return world_from_photographer(replace(camera, cam_from_world=pose), UP)

    assert torch.autograd.gradcheck(frame, camera.cam_from_world.clone().requires_grad_())
