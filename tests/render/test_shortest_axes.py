"""Normals of ellipsoids for methods that do not shade with them."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from glassplat.render.deferred import Deferred
from glassplat.render.frame import Renderer
from glassplat.render.planar import Planar
from glassplat.render.splat import Splat
from glassplat.scene.camera import rotation_from_quat
from glassplat.scene.scene import Scene
from tests.render.test_deferred import glossy
from tests.render.tiny_scene import camera_at, pane, random_gaussians

TURN = torch.tensor([0.9, 0.2, -0.3, 0.1], dtype=torch.float64)


def wall(sign: float) -> Scene:
    """Flat ellipsoids in a rotated plane, their shortest axes towards the camera or away from it."""
    rotation = rotation_from_quat(TURN)
    spread = torch.linspace(-1.5, 1.5, 12, dtype=torch.float64)
    across, up = torch.meshgrid(spread, spread, indexing="ij")
    places = torch.stack([across, up, torch.zeros_like(up)], dim=-1).reshape(-1, 3) @ rotation.T
    gaussians = random_gaussians(len(places), (0.0, 0.0, 0.0), seed=0)
    # Half a turn about the first axis reverses the third one and leaves the ellipsoids unchanged.
    quats = TURN if sign > 0 else torch.tensor([-TURN[1], TURN[0], TURN[3], -TURN[2]], dtype=torch.float64)
    tensors = {
        "means": places + torch.tensor([0.0, 0.0, 3.0], dtype=torch.float64),
        "quats": quats.expand(len(places), 4).clone(),
        "log_scales": torch.tensor([0.2, 0.25, 0.01], dtype=torch.float64).log().expand(len(places), 3).clone(),
        "logit_opacities": torch.full((len(places),), 3.0, dtype=torch.float64),
    }
    return Scene(gaussians.with_tensors(tensors), extent=3.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_wall_faces_the_camera_across_its_shortest_axes(sign: float) -> None:
    frame = Splat(ellipsoid_normal=True)(wall(sign), camera_at(0, 0, 0))
    covered = frame.layers["alpha"] > 0.99
    normals = torch.nn.functional.normalize(frame.layers["normal"][covered], dim=-1)
    assert int(covered.sum()) > 100
    expected = -rotation_from_quat(TURN)[:, 2]
    torch.testing.assert_close(normals, expected.expand_as(normals), atol=1e-9, rtol=0)
    torch.testing.assert_close(frame.layers["normal"].norm(dim=-1), frame.layers["alpha"], atol=1e-9, rtol=0)


@pytest.mark.parametrize("renderer", [Splat(), Planar()], ids=["splat", "planar"])
def test_a_frame_has_normals_only_on_request(renderer: Renderer) -> None:
    glass = random_gaussians(20, (0.0, 0.0, 2.0), seed=2, glass=True)
    scene = replace(wall(1.0), planes=pane(2.0), glass=glass)
    camera = camera_at(0, 0, 0)
    plain, whole = (renderer.with_layers([layer])(scene, camera) for layer in ("rgb", "normal"))
    assert set(whole.layers) - set(plain.layers) == {"normal"} and torch.equal(plain.rgb, whole.rgb)
    assert all(torch.equal(whole.layers[name], image) for name, image in plain.layers.items())
    middle = whole.layers["normal"][14, 20]
    assert math.isclose(float(middle @ -rotation_from_quat(TURN)[:, 2]), float(middle.norm()), rel_tol=1e-6)


@pytest.mark.parametrize("renderer", [Splat(), Splat(normal=False)])
def test_discs_keep_their_own_normals(renderer: Splat) -> None:
    scene = wall(1.0)
    flat = replace(scene, primary=scene.primary.with_tensors({"log_scales": scene.primary.log_scales[:, :2].clone()}))
    camera = camera_at(0, 0, 0)
    expected = Splat()(flat, camera).layers["normal"]
    assert torch.equal(renderer.with_layers(["normal"])(flat, camera).layers["normal"], expected)


@pytest.mark.parametrize(
    ("renderer", "scene"),
    [(Splat(depth=False), wall(1.0)), (Deferred(depth=False), glossy(0.5))],
    ids=["splat", "deferred"],
)
def test_a_renderer_without_depths_adds_them_on_request(renderer: Renderer, scene: Scene) -> None:
    camera = camera_at(0, 0, 0)
    expected = replace(renderer, depth=True)(scene, camera).layers["depth"]
    assert "depth" not in renderer.with_layers(["rgb"])(scene, camera).layers
    assert torch.equal(renderer.with_layers(["depth"])(scene, camera).layers["depth"], expected)


def test_channels_required_by_the_renderer_are_checked() -> None:
    with pytest.raises(ValueError, match="logit_mark"):
        Planar().check(replace(wall(1.0), glass=random_gaussians(3, (0.0, 0.0, 2.0), seed=2)))
