"""Normals of depth maps, and the loss that compares blended normals with them."""

from __future__ import annotations

import math

import pytest
import torch

from glassplat.captures.view import View
from glassplat.render.deferred import cell_side, depth_normals, view_directions
from glassplat.render.frame import Frame
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene
from glassplat.training.losses import normal_consistency
from tests.render.tiny_scene import camera_at

SCENE = Scene(Gaussians.empty(1), extent=1.0)


def oblique_camera() -> Camera:
    """A camera at the origin, rotated against the world's axes; its cells are 5 pixels wide."""
    turn = math.cos(0.4), math.sin(0.4)
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, [0, 2]], pose[2, [0, 2]] = (
        torch.tensor(turn, dtype=torch.float64),
        torch.tensor([-turn[1], turn[0]]).double(),
    )
    return Camera(pose, 150.0, 152.0, 81.0, 55.0, 160, 112)


def plane_depth(camera: Camera, normal: torch.Tensor, distance: float) -> torch.Tensor:
    """[H, W] depth of the plane with n . x = -distance, n facing a camera at the origin."""
    return -distance / (view_directions(camera) @ normal)


@pytest.mark.parametrize("normal", [(0.0, 0.0, -1.0), (0.3, 0.1, -1.0), (-0.2, -0.3, -1.0)])
def test_a_flat_wall_has_its_normal_everywhere(normal: tuple[float, float, float]) -> None:
    camera = oblique_camera()
    in_camera = torch.nn.functional.normalize(torch.tensor(normal, dtype=torch.float64), dim=0)
    in_world = in_camera @ camera.cam_from_world[:3, :3]
    depth = plane_depth(camera, in_world, 3.0)
    normals, trusted = depth_normals(depth, torch.ones_like(depth), camera)
    inner = trusted[1:-1, 1:-1] > 0
    assert normals.shape == (camera.height // cell_side(camera), camera.width // cell_side(camera), 3) and inner.all()
    # Depth is not linear in the pixels, so its mean over a cell bends the wall slightly.
    cosines = normals[1:-1, 1:-1] @ in_world
    assert float(cosines.min()) > math.cos(math.radians(1.0))


@pytest.mark.parametrize(("width", "height"), [(640, 16), (16, 640), (3, 1)])
def test_narrow_images_have_cells_too(width: int, height: int) -> None:
    camera = Camera(torch.eye(4), 100.0, 100.0, width / 2, height / 2, width, height)
    depth = torch.full((height, width), 3.0)
    normals, trusted = depth_normals(depth, torch.ones_like(depth), camera)
    assert bool(trusted.any()) == (min(width, height) > 1)
    torch.testing.assert_close(normals[trusted > 0], torch.tensor([0.0, 0, -1]).expand(int(trusted.sum()), 3))


def test_edges_and_holes_are_not_trusted() -> None:
    camera = oblique_camera()
    depth = torch.full((camera.height, camera.width), 3.0)
    depth[:, 100:] = 6.0
    alpha = torch.ones_like(depth)
    alpha[52, 27] = 0.0
    _, trusted = depth_normals(depth, alpha, camera)
    # The step lies between cells 19 and 20 of each row, the hole in cell 5 of row 10.
    assert not trusted[:, 19:21].any() and not trusted[9:12, 4:7].any()
    assert trusted[1:8, 1:19].all() and trusted[1:-1, 21:-1].all()


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
