"""Floaters are removed live in the viewer, and two clicks measure a distance."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from glassplat.model.model import viewer_state
from glassplat.scene.camera import Camera
from glassplat.scene.scene import Scene
from glassplat.viewer.controls import parse_box
from glassplat.viewer.drawing import ViewRequest, edit_scene, surface_point
from glassplat.viewer.server import Client, Viewer
from tests.model.test_model import model
from tests.publish.test_cleaning import wall
from tests.viewer.free_port import free_port
from tools.viewer_client import ViewerClient

POSE = Camera.look_at((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), up=(0.0, -1.0, 0.0)).cam_from_world.float()


def wall_scene() -> Scene:
    gaussians = wall(24).with_tensors({"logit_opacities": torch.full((576,), 8.0)})
    return Scene(gaussians, 1.0)


def test_a_request_renders_without_removed_gaussians() -> None:
    scene = model().scene
    kept = torch.arange(len(scene.primary)) % 2 == 0
    request = ViewRequest(POSE, 1.0, 1.0, kept=kept)
    assert torch.equal(edit_scene(scene, request).primary.means, scene.primary.means[kept])
    assert edit_scene(scene, replace(request, kept=kept[:-1])).primary is scene.primary, (
        "the scene is another one by now"
    )


def test_surface_points_lie_only_on_the_wall() -> None:
    splat = viewer_state(replace(model(), scene=wall_scene()), {}).renderer
    request = ViewRequest(POSE, 1.0, 1.0)
    for aside in (0.0, 0.2, -0.25):
        direction = np.array([aside, 0.0, 1.0]) / np.hypot(aside, 1.0)
        found = surface_point(wall_scene(), splat, request, direction)
        np.testing.assert_allclose(found, [3 * aside, 0.0, 3.0], atol=0.05)
    for away in ([0.45, 0.0, 0.89], [0.0, 0.0, -1.0], [0.9, 0.0, 0.43]):
        with pytest.raises(ValueError, match=r"there is no surface|behind"):
            surface_point(wall_scene(), splat, request, np.array(away))


def test_a_box_is_six_numbers() -> None:
    assert parse_box("0 1 2, 3 4 5") == (0, 1, 2, 3, 4, 5)
    assert parse_box("0 1 2") is parse_box("a b c d e f") is parse_box("0 1 2 3 4 nan") is None


async def until(holds: Callable[[], bool]) -> None:
    async with asyncio.timeout(120):
        while not holds():
            await asyncio.sleep(0.05)


async def stand(client: ViewerClient, inner: Client, place: tuple[float, float, float]) -> None:
    """Moves the camera, and waits until the server has received the pose."""
    await client.look(position=place, look_at=(place[0], place[1], place[2] + 1))
    center = -torch.tensor(place)
    await until(lambda: (request := inner.request()) is not None and torch.equal(request.cam_from_world[:3, 3], center))


async def begin_to_measure(client: ViewerClient, inner: Client) -> None:
    await client.set("Click two points", True)
    await until(lambda: inner._measure._is_listening)


async def click(client: ViewerClient, aside: float) -> None:
    await client.send(
        "ScenePointerMessage",
        event_type="click",
        ray_origin=(0.0, 0.0, 0.0),
        ray_direction=(aside / math.hypot(aside, 1), 0.0, 1 / math.hypot(aside, 1)),
        screen_pos=((0.5, 0.5),),
        modifier=None,
    )


def test_a_click_uses_the_camera_at_the_time_of_the_click() -> None:
    viewer = Viewer(viewer_state(replace(model(), scene=wall_scene()), {}), "127.0.0.1", free_port())

    async def work() -> None:
        async with ViewerClient(viewer.address) as client:
            await client.look()
            await until(lambda: len(viewer._clients) == 1)
            (inner,) = viewer._clients.values()
            await stand(client, inner, (0.0, 0.0, 0.0))
            await begin_to_measure(client, inner)
            await click(client, 0.25)
            await until(lambda: len(viewer.loop._calls) == 1)
            await stand(client, inner, (0.5, 0.0, 1.0))
            viewer.start()  # The drawing thread starts only here.
            await until(lambda: len(inner._measure._points) == 1)
            np.testing.assert_allclose(inner._measure._points[0], [0.75, 0.0, 3.0], atol=0.05)

    try:
        asyncio.run(work())
    finally:
        viewer.stop()


def test_two_clicks_measure_a_distance_and_floaters_are_toggled() -> None:
    viewer = Viewer(viewer_state(replace(model(), scene=wall_scene()), {}), "127.0.0.1", free_port())
    viewer.start()

    async def work() -> None:
        async with ViewerClient(viewer.address) as client:
            await client.picture()
            (inner,) = viewer._clients.values()
            await stand(client, inner, (0.0, 0.0, 0.0))
            await begin_to_measure(client, inner)
            for aside in (0.25, -0.25):
                await click(client, aside)
            await until(lambda: "--scale" in inner._measure._message.content)
            first, second = inner._measure._points
            assert np.linalg.norm(first - second) == pytest.approx(1.5, abs=0.05)
            await client.set("Box", "-2 -2 0 0 2 4")
            await client.set("Remove floaters", True)
            await until(lambda: inner.request().kept is not None and int(inner.request().kept.sum()) == 288)
            await client.set("Remove floaters", False)
            await until(lambda: inner.request().kept is None)

    try:
        asyncio.run(work())
    finally:
        viewer.stop()
