"""Losses that keep discs on a common surface."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from glassplat.render.deferred import view_directions
from glassplat.render.frame import Frame
from glassplat.render.splat import Splat
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene
from glassplat.training.losses import disc_normal_consistency, distortion, normals_of_depths
from tests.render.tiny_scene import camera_at
from tests.training.tiny_capture import tiny_capture

CAMERA = camera_at(0.0, 0.0, -2.0)
VIEW = tiny_capture().train[0].__class__.in_memory("0.png", CAMERA, photo=torch.zeros(28, 40, 3, dtype=torch.uint8))


def wall(tilt: float = 0.0, *, count: int = 25, turned: float = 0.0, gap: float = 0.0) -> Scene:
    """Discs in a plane through the origin, tilted about the x axis; `turned` rotates each disc further."""
    across = torch.linspace(-2, 2, count, dtype=torch.float64)
    x, y = (grid.flatten() for grid in torch.meshgrid(across, across, indexing="ij"))
    angle = torch.tensor(tilt, dtype=torch.float64)
    half = torch.tensor((tilt + turned) / 2, dtype=torch.float64)
    means = torch.stack([x, y * angle.cos(), y * angle.sin() + gap * (torch.arange(len(x)) % 2)], dim=1)
    quat = torch.stack([half.cos(), half.sin(), torch.zeros_like(half), torch.zeros_like(half)])
    gaussians = Gaussians(
        means=means.requires_grad_(),
        quats=quat.repeat(len(means), 1).requires_grad_(),
        log_scales=torch.full((len(means), 2), -2.0, dtype=torch.float64),
        logit_opacities=torch.full((len(means),), 3.0, dtype=torch.float64),
        sh=torch.zeros(len(means), 1, 3, dtype=torch.float64),
    )
    return Scene(gaussians, 2.0)


def frame_of(scene: Scene) -> Frame:
    return Splat()(scene, CAMERA)


def test_normals_of_a_depth_map_are_those_of_its_plane() -> None:
    for tilt in (0.0, 0.5):
        frame = frame_of(wall(tilt))
        # Normal of the side of the plane that faces the camera, which looks along +z.
        expected = torch.tensor([0.0, torch.tensor(tilt).sin(), -torch.tensor(tilt).cos()], dtype=torch.float64)
        normals = torch.stack(normals_of_depths(frame.layers["depth"], CAMERA), dim=-1)
        torch.testing.assert_close(normals[10:16, 12:24].mean((0, 1)), expected, atol=0.02, rtol=0)
        blended = frame.layers["normal"][12:16, 15:20] / frame.layers["alpha"][12:16, 15:20, None]
        torch.testing.assert_close(blended, expected.expand_as(blended), atol=1e-6, rtol=0)


@pytest.mark.parametrize("normal", [(0.0, 0.0, -1.0), (0.5, 0.2, -1.0), (-0.3, 0.6, -1.0)])
def test_normals_of_a_true_depth_map_are_exact(normal: tuple[float, float, float]) -> None:
    expected = torch.nn.functional.normalize(torch.tensor(normal, dtype=torch.float64), dim=0)
    depth = -3.0 / (view_directions(replace(CAMERA, cam_from_world=torch.eye(4).double())) @ expected)
    normals = torch.stack(normals_of_depths(depth, CAMERA), dim=-1)
    torch.testing.assert_close(normals, expected.expand_as(normals))


def test_discs_that_lie_in_their_surface_agree_with_it() -> None:
    agreeing = disc_normal_consistency(frame_of(wall(0.5)), VIEW, wall(0.5)).detach()
    apart = disc_normal_consistency(frame_of(wall(0.5, turned=0.4)), VIEW, wall(0.5)).detach()
    assert abs(float(agreeing)) < 0.02 < float(apart)


def test_normals_turn_discs_into_their_surface() -> None:
    scene = wall(0.3, turned=0.3)
    (gradient,) = torch.autograd.grad(disc_normal_consistency(frame_of(scene), VIEW, scene), scene.primary.quats)
    turned: Tensor = scene.primary.quats.detach() - 20 * gradient
    after = Scene(scene.primary.with_tensors({"quats": turned}), 2.0)
    before, better = (disc_normal_consistency(frame_of(s), VIEW, s).detach() for s in (scene, after))
    assert float(better) < float(before)


def test_one_surface_has_less_distortion_than_two() -> None:
    one, two = wall(), wall(gap=0.3)
    flat, apart = distortion(frame_of(one), VIEW, one), distortion(frame_of(two), VIEW, two)
    assert float(flat.detach()) < 1e-9 < 1e-7 < float(apart.detach())
    (gradient,) = torch.autograd.grad(apart, two.primary.means)
    back = torch.arange(len(two.primary)) % 2 == 1
    assert float(gradient[back, 2].sum()) > 0 > float(gradient[~back, 2].sum())


def test_distortion_does_not_depend_on_the_units_of_a_capture() -> None:
    scene, scale = wall(gap=0.3), 7.0
    larger = scene.primary.with_tensors(
        {"means": scene.primary.means * scale, "log_scales": scene.primary.log_scales + torch.tensor(scale).log()}
    )
    pose = CAMERA.cam_from_world.clone()
    pose[:3, 3] *= scale
    far = Splat()(Scene(larger, scene.extent * scale), type(CAMERA)(pose, *camera_values()))
    torch.testing.assert_close(far.layers["distortion"], frame_of(scene).layers["distortion"])


def camera_values() -> tuple[float, float, float, float, int, int]:
    return CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, CAMERA.width, CAMERA.height
