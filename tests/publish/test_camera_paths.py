"""Camera paths: smooth, upright, and within the known part of the scene."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
import torch

from glassplat.publish.camera_paths import fit_to_width, interpolate_cameras, orbit, select_keyframes
from glassplat.publish.web_page import best_view, cameras_around, survey_capture
from glassplat.scene.camera import Camera
from tests.files.test_spz import typical
from tests.render.tiny_scene import camera_at
from tests.training.tiny_capture import true_scene

UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
AROUND = [camera for _, camera in cameras_around(typical(), UP)]
IN_FRONT = [
    replace(c, cam_from_world=c.cam_from_world.float())
    for c in (camera_at(0.2 * k, 0.05 * (-1) ** k, -0.3) for k in range(-4, 5))
]


def forward(camera: Camera) -> torch.Tensor:
    return camera.cam_from_world[2, :3].double()


def test_the_survey_finds_the_common_focus_point() -> None:
    survey = survey_capture(AROUND, 1.0)
    middle = torch.stack([camera.center for camera in AROUND]).mean(0).double()
    down = (survey.focus - middle) @ survey.up
    assert float(down) < 0 and float((survey.focus - middle + survey.up * -down).norm()) < 1e-3 * survey.distance
    torch.testing.assert_close(survey.up, UP, atol=1e-3, rtol=0)


def test_cameras_that_look_down_from_one_side_are_not_taken_to_stand_upright() -> None:
    tilt = math.radians(20)
    angles = [math.radians(yaw) for yaw in range(0, 91, 10)]
    eyes = [(math.sin(a), -math.tan(tilt), math.cos(a)) for a in angles]
    arc = [Camera.look_at(eye, (0.0, 0.0, 0.0), up=UP) for eye in eyes]
    assert float(torch.rad2deg(torch.acos(survey_capture(arc, 1.0).up @ UP))) < 2


@pytest.mark.parametrize("aside", [0.0, 0.3])
def test_an_orbit_goes_around_below_cameras_that_look_straight_down(aside: float) -> None:
    cameras = [
        Camera.look_at((aside * x, -2.0, aside * z), (aside * x, 0.0, aside * z), up=(x, 0.0, z))
        for x, z in ((1, 0), (0, 1), (-1, 0), (0, -1))
    ]
    torch.testing.assert_close(survey_capture(cameras, 2.0).up, UP, atol=1e-6, rtol=0)
    assert all(float(forward(camera) @ -UP) > 0.9 for camera in orbit(cameras, 2.0, 12))


def test_an_orbit_goes_all_around_what_was_seen_from_all_sides() -> None:
    survey, path = survey_capture(AROUND, 1.0), orbit(AROUND, 1.0, 40)
    arms = torch.stack([camera.center.double() - survey.focus for camera in path])
    assert float(torch.nn.functional.normalize(arms, dim=1).mean(0).norm()) < 0.4
    for camera, arm in zip(path, arms, strict=True):
        assert float(forward(camera) @ torch.nn.functional.normalize(-arm, dim=0)) > 0.999
        assert abs(float(arm.norm()) / survey.distance - 1) < 0.05


def test_an_orbit_stays_in_front_of_what_was_seen_from_one_side() -> None:
    path = orbit(IN_FRONT, 2.0, 24)
    for camera in path:
        assert float(forward(camera)[2]) > 0.8
        assert min(float((camera.center - other.center).norm()) for other in IN_FRONT) < 0.5
    # A closed loop that is both wide and tall.
    centers = torch.stack([camera.center for camera in path])
    wide, tall, _ = (centers.amax(dim=0) - centers.amin(dim=0)).tolist()
    assert wide > tall > 0.05 and float((centers - centers.roll(1, dims=0)).norm(dim=1).max()) < 0.5 * wide
    quarters = centers[::6, :2] - centers[:, :2].mean(dim=0)
    assert abs(float(quarters[0] @ quarters[1])) < 0.05 * wide * tall


@pytest.mark.parametrize("count", [1, 2, 5, 12, 40])
def test_keyframes_are_few_and_spread_from_the_first_to_the_last(count: int) -> None:
    found: list[Any] = select_keyframes(range(count))  # type: ignore[arg-type]
    assert found[0] == 0 and found[-1] == count - 1 and len(found) == min(count, 12)
    steps = [after - before for before, after in pairwise(found)]
    assert not steps or max(steps) - min(steps) <= 1


@pytest.mark.parametrize("frames", [2, 25])
def test_an_interpolated_path_begins_and_ends_at_its_cameras(frames: int) -> None:
    keys = select_keyframes(AROUND)[:5]
    path = interpolate_cameras(keys, frames)
    assert len(path) == frames
    for mine, given in ((path[0], keys[0]), (path[-1], keys[-1])):
        torch.testing.assert_close(mine.cam_from_world, given.cam_from_world, atol=1e-5, rtol=1e-5)
    for camera in path:
        rotation = camera.cam_from_world[:3, :3]
        torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), atol=1e-5, rtol=0)


@pytest.mark.parametrize("width", [2, 322, 1000])
def test_pictures_of_a_film_have_even_sides_and_the_shape_of_the_camera(width: int) -> None:
    camera = Camera.look_at((0.0, 0.0, -1.0), (0.0, 0.0, 0.0), up=UP, width=800, height=600)
    fitted = fit_to_width(camera, width)
    assert fitted.width == width and fitted.height % 2 == 0 and abs(fitted.height - 0.75 * width) <= 1
    assert math.isclose(fitted.fy / fitted.height, camera.fy / 600) and math.isclose(fitted.cx, width / 2)


def test_a_portrait_camera_does_not_stretch_frames_of_a_path() -> None:
    wide = Camera.look_at((0.0, 0.0, -1.0), (0.0, 0.0, 0.0), up=UP, width=800, height=600)
    tall = Camera.look_at((0.5, 0.0, -1.0), (0.0, 0.0, 0.0), up=UP, width=300, height=400)
    *_, last = path = interpolate_cameras([wide, replace(tall, cx=160.0)], 5)
    assert all(math.isclose(camera.fx, camera.fy) for camera in path)
    # As wide as the photograph, centred in height; an offset of 10 pixels is scaled to the larger image.
    scale = 800 / 300
    assert math.isclose(last.fx, scale * tall.fx) and math.isclose(last.cx, 400 + 10 * scale)
    assert (last.width, last.height, last.cy) == (800, 600, 300)


def test_one_camera_is_no_path() -> None:
    with pytest.raises(ValueError, match="at least two"):
        interpolate_cameras(AROUND[:1], 10)
    assert select_keyframes(AROUND[:1]) == AROUND[:1]


def test_the_first_view_shows_the_pane_in_its_middle() -> None:
    away = replace(IN_FRONT[0], cam_from_world=torch.diag(torch.tensor([-1.0, 1, -1, 1])) @ IN_FRONT[0].cam_from_world)
    assert best_view(true_scene().planes, [away, *IN_FRONT]) in range(3, 8)
