"""Normals of depth maps, and the loss that compares blended normals with them."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from glassplat.data.view import View
from glassplat.losses.geometry import CELL, depth_normals, normal_consistency
from glassplat.render.deferred import view_directions
from glassplat.render.frame import Frame
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene
from tests.render.tiny_scene import camera_at

SCENE = Scene(Gaussians.empty(1), extent=1.0)


def oblique_camera() -> Camera:
    """A camera that is turned against the world's axes."""
    angle = 0.4
    turn = torch.tensor(
        [[math.cos(angle), 0.0, math.sin(angle)], [0.0, 1.0, 0.0], [-math.sin(angle), 0.0, math.cos(angle)]],
        dtype=torch.float64,
    )
    camera = camera_at(0.0, 0.0, 0.0)
    pose = camera.cam_from_world.clone()
    pose[:3, :3] = turn
    return replace(camera, cam_from_world=pose)


def plane_depth(camera: Camera, normal: torch.Tensor, distance: float) -> torch.Tensor:
    """[H, W] depth of the plane with n . x = -distance, n facing a camera at the origin."""
    return -distance / (view_directions(camera) @ normal)


@pytest.mark.parametrize("normal", [(0.0, 0.0, -1.0), (0.3, 0.1, -1.0), (-0.1, -0.15, -1.0)])
def test_a_flat_wall_has_its_normal_everywhere(normal: tuple[float, float, float]) -> None:
    camera = oblique_camera()
    in_camera = torch.nn.functional.normalize(torch.tensor(normal, dtype=torch.float64), dim=0)
    in_world = in_camera @ camera.cam_from_world[:3, :3]
    depth = plane_depth(camera, in_world, 3.0)
    normals, trusted = depth_normals(depth, torch.ones_like(depth), camera)
    inner = trusted[1:-1, 1:-1] > 0
    assert normals.shape == (camera.height // CELL, camera.width // CELL, 3) and inner.all()
    # The mean of a depth that is not linear in the pixels bends the wall a little.
    cosines = normals[1:-1, 1:-1] @ in_world
    assert float(cosines.min()) > math.cos(math.radians(2.0))


def test_edges_and_holes_are_not_trusted() -> None:
    camera = camera_at(0.0, 0.0, 0.0)
    depth = torch.full((camera.height, camera.width), 3.0)
    depth[:, 20:] = 6.0
    alpha = torch.ones_like(depth)
    alpha[10:12, 5:7] = 0.0
    _, trusted = depth_normals(depth, alpha, camera)
    # The step lies between cells 4 and 5, the hole in cells (2, 1).
    assert not trusted[:, 4:6].any() and not trusted[1:4, 0:3].any()
    assert trusted[5, 2] == 1 and trusted[5, 7] == 1


def loss_of(normal: torch.Tensor) -> torch.Tensor:
    camera = camera_at(0.0, 0.0, 0.0)
    depth = torch.full((camera.height, camera.width), 3.0)
    layers = {"depth": depth, "alpha": torch.ones_like(depth), "normal": normal.expand(*depth.shape, 3)}
    view = View.in_memory("view", camera, photo=torch.zeros(*depth.shape, 3, dtype=torch.uint8))
    return normal_consistency(Frame(torch.zeros(*depth.shape, 3), layers), view, SCENE)


def test_the_loss_is_nothing_where_normals_and_depths_agree() -> None:
    assert float(loss_of(torch.tensor([0.0, 0.0, -0.7]))) == pytest.approx(0.0, abs=1e-6)
    assert float(loss_of(torch.tensor([0.5, 0.0, -0.5]))) > 0.1


def test_the_gradient_turns_normals_towards_the_depths() -> None:
    normal = torch.tensor([0.5, 0.0, -0.5], requires_grad=True)
    (gradient,) = torch.autograd.grad(loss_of(normal), normal)
    assert float(loss_of((normal - 0.1 * gradient).detach())) < float(loss_of(normal.detach()))
    assert float(gradient[0]) > 0
