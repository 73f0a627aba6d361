"""Reflections of the photographer in panes: as if a body stood at the camera, visible only in the panes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from glassplat.kernels.maths.images import linear_from_srgb
from glassplat.render.planar import Planar
from glassplat.scene.camera import Camera, rotation_from_quat
from glassplat.scene.corrections import Direction, world_from_photographer
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene
from tests.render.tiny_scene import (
    assert_gradient_matches,
    camera_at,
    concatenated,
    joined,
    pane,
    quat_product,
    random_gaussians,
    showcase,
)

TURN = torch.nn.functional.normalize(torch.tensor([0.98, 0.12, -0.1, 0.06], dtype=torch.float64), dim=0)
UP = (0.0, -1.0, 0.0)
PRESENT = Planar(photographer="present")


def tilted_camera() -> Camera:
    camera = camera_at(0.1, 0.0, 0.2)
    pose = camera.cam_from_world.clone()
    pose[:3] = rotation_from_quat(TURN) @ pose[:3]
    return replace(camera, cam_from_world=pose)


CAMERA = tilted_camera()


def body() -> Gaussians:
    """A body around the photographer, of one colour from all sides, part of which extends to the front."""
    drawn = random_gaussians(10, (0.0, 0.1, -0.5), seed=5)
    return replace(drawn, channels={}, sh=drawn.sh[:, :1], active_sh_degree=0)


def photographed(up: Direction | None = UP, scene: Scene | None = None) -> Scene:
    return replace(scene or showcase(), photographer=body(), up=up)


def with_somebody_there(scene: Scene, camera: Camera) -> Scene:
    """The scene in which the body is an object like all others, at the camera."""
    frame = world_from_photographer(camera, scene.up)
    there = scene.photographer
    motion = TURN * torch.tensor([1.0, -1, -1, -1]) if scene.up is None else _quat_of(frame)
    sh = torch.nn.functional.pad(there.sh, (0, 0, 0, scene.primary.sh.shape[1] - 1))
    standing = replace(
        there,
        means=there.means @ frame[:3, :3].T + frame[:3, 3],
        quats=quat_product(motion, there.quats),
        sh=sh,
        channels={"log_intensity": torch.zeros(len(there), dtype=torch.float64)},
        active_sh_degree=scene.primary.active_sh_degree,
    )
    return replace(scene, primary=concatenated(scene.primary, standing), photographer=Gaussians.empty())


def _quat_of(frame: Tensor) -> Tensor:
    """Quaternion of a rotation by less than half a circle."""
    rotation = frame[:3, :3]
    w = torch.sqrt(1 + rotation.trace()) / 2
    skew = torch.stack(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    return torch.cat([w[None], skew / (4 * w)])


TWO_PANES = joined(pane(2.0, half=0.7, label=1), pane(4.0, label=2))


@pytest.mark.parametrize("up", [None, UP])
@pytest.mark.parametrize("planes", [pane(2.0), TWO_PANES])
def test_the_mirror_image_is_that_of_a_body_at_the_camera(up: Direction | None, planes: object) -> None:
    scene = photographed(up, showcase(planes))  # type: ignore[arg-type]
    mirrored = PRESENT(scene, CAMERA)
    explicit = Planar()(with_somebody_there(scene, CAMERA), CAMERA)
    nobody = Planar()(scene, CAMERA)
    torch.testing.assert_close(mirrored.layers["reflection"], explicit.layers["reflection"], atol=1e-7, rtol=1e-7)
    assert float((mirrored.layers["reflection"] - nobody.layers["reflection"]).abs().max()) > 0.1


def test_the_photographer_is_visible_only_in_panes() -> None:
    scene = photographed()
    ahead = replace(scene.photographer, means=scene.photographer.means + torch.tensor([0.0, 0.0, 1.5]))
    frame, nobody = PRESENT(replace(scene, photographer=ahead), CAMERA), Planar()(scene, CAMERA)
    for name in ("transmission", "without_panes", "mask", "strength", "depth"):
        assert torch.equal(frame.layers[name], nobody.layers[name])
    assert frame.direct is not None and nobody.direct is not None and torch.equal(frame.direct, nobody.direct)


def test_a_photographer_behind_the_pane_is_not_mirrored() -> None:
    scene = photographed()
    beyond = replace(scene.photographer, means=scene.photographer.means + torch.tensor([0.0, 0.0, 8.0]))
    frame = PRESENT(replace(scene, photographer=beyond), CAMERA)
    assert torch.equal(frame.rgb, Planar()(scene, CAMERA).rgb)


def test_new_views_omit_the_photographer_by_default() -> None:
    scene = photographed()
    absent, separate, present = (Planar(photographer=mode)(scene, CAMERA) for mode in ("absent", "separate", "present"))  # type: ignore[arg-type]
    empty = Planar()(replace(scene, photographer=Gaussians.empty()), CAMERA)
    assert torch.equal(absent.rgb, empty.rgb) and torch.equal(separate.rgb, empty.rgb)
    assert torch.equal(separate.photographed, present.rgb) and torch.equal(absent.photographed, absent.rgb)
    assert not torch.equal(present.rgb, absent.rgb)


def test_layers_recombine_with_a_photographer() -> None:
    frame = PRESENT(photographed(), CAMERA)
    strength = frame.layers["strength"][..., None]
    behind, reflected = (linear_from_srgb(frame.layers[name]) for name in ("transmission", "reflection"))
    expected = (1 - strength) * behind + strength * reflected
    torch.testing.assert_close(linear_from_srgb(frame.rgb), expected, rtol=1e-4, atol=2e-5)


def test_a_scene_without_panes_shows_no_photographer() -> None:
    scene = photographed()
    bare = replace(scene, planes=type(scene.planes).empty())
    assert torch.equal(PRESENT(bare, CAMERA).rgb, Planar()(bare, CAMERA).rgb)


NAMES = ["photographer.means", "photographer.quats", "photographer.log_scales", "photographer.logit_opacities",
         "photographer.sh", "planes.centers", "planes.raw_normals"]  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_gradients_match_finite_differences_through_the_whole_renderer(name: str) -> None:
    assert_gradient_matches(PRESENT, photographed(), name, rtol=2e-4)


def test_only_the_photographer_is_trained_during_plane_adjustment() -> None:
    scene = photographed()
    means, body_means = (
        scene.parameters()[n].clone().requires_grad_() for n in ("primary.means", "photographer.means")
    )
    trainable = scene.with_parameters({"primary.means": means, "photographer.means": body_means})
    frame = replace(PRESENT, reflection_gradient="planes")(trainable, CAMERA)
    to_room, to_body = torch.autograd.grad(frame.layers["reflection"].sum(), [means, body_means])
    assert not bool(to_room.any()) and float(to_body.abs().sum()) > 0


def test_mirror_images_of_the_photographer_are_recorded_for_densification() -> None:
    frame = PRESENT(photographed(), CAMERA, with_records=True)
    records = [record for record in frame.screen if record.part == "photographer"]
    assert len(records) == 1 and records[0].direct and float(records[0].radii.max()) > 0
    assert 0 < float(torch.as_tensor(records[0].weight)) < 1
