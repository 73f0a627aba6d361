"""Deferred shading: Eq. 3 of 3DGS-DR in an image, its gradients, and its limits."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from glassplat.kernels.environment.reference import cube_lookup
from glassplat.render.deferred import Deferred, view_directions
from glassplat.render.splat import Splat
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Environment, Scene
from tests.render.tiny_scene import camera_at, in_single_precision, random_gaussians


def glossy(strength: float = 0.3, *, count: int = 14, size: int = 4) -> Scene:
    """Random Gaussians in front of the camera that reflect a random environment; float64."""
    primary = random_gaussians(count, (0.0, 0.0, 3.0), seed=4)
    raw = 2 * torch.randn(6, size, size, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    strengths = torch.full((count,), math.log(strength / (1 - strength)), dtype=torch.float64)
    primary = replace(primary, channels={"logit_strength": strengths})
    return Scene(primary, extent=2.0, environment=Environment(raw))


def wall(tilt: float) -> Scene:
    """One huge, flat, opaque Gaussian at z = 3 that reflects everything, rotated about the vertical axis."""
    primary = Gaussians(
        means=torch.tensor([[0.0, 0.0, 3.0]], dtype=torch.float64),
        quats=torch.tensor([[math.cos(tilt / 2), 0.0, math.sin(tilt / 2), 0.0]], dtype=torch.float64),
        log_scales=torch.log(torch.tensor([[50.0, 50.0, 1e-3]], dtype=torch.float64)),
        logit_opacities=torch.full((1,), 20.0, dtype=torch.float64),
        sh=torch.zeros(1, 1, 3, dtype=torch.float64),
        channels={"logit_strength": torch.full((1,), 20.0, dtype=torch.float64)},
    )
    raw = 2 * torch.randn(6, 8, 8, 3, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    return Scene(primary, extent=2.0, environment=Environment(raw))


def rolled(camera: Camera) -> Camera:
    """The camera rotated about an oblique axis, so that no world axis is an image axis."""
    half = 0.05
    turn = torch.linalg.matrix_exp(
        2 * half * torch.tensor([[0, -0.5, 0.7], [0.5, 0, -0.6], [-0.7, 0.6, 0]], dtype=torch.float64)
    )
    pose = camera.cam_from_world.clone()
    pose[:3] = turn @ pose[:3]
    return replace(camera, cam_from_world=pose)


@pytest.mark.parametrize("tilt", [0.0, 0.3, -0.2])
def test_a_flat_mirror_shows_the_environment_in_the_mirrored_direction(tilt: float) -> None:
    camera = rolled(camera_at(0.1, -0.2, 0.0))
    frame = Deferred()(wall(tilt), camera)
    normal = torch.tensor([math.sin(tilt), 0.0, math.cos(tilt)], dtype=torch.float64)
    away = view_directions(camera)
    mirrored = away - 2 * (away @ normal)[..., None] * normal
    expected = torch.sigmoid(cube_lookup(wall(tilt).environment.raw, mirrored))
    # Alphas are at most 0.99.
    torch.testing.assert_close(frame.rgb, 0.99 * expected, atol=0.02, rtol=0)
    normals = torch.nn.functional.normalize(frame.layers["normal"], dim=-1)
    torch.testing.assert_close(normals, -normal.expand_as(normals), atol=1e-6, rtol=0)


def test_zero_strength_equals_splat() -> None:
    scene, camera = glossy(1e-12), camera_at(0.1, 0.0, 0.0)
    plain = Splat()(scene, camera)
    frame = Deferred()(scene, camera)
    torch.testing.assert_close(frame.rgb, plain.rgb, atol=1e-9, rtol=0)
    for name in ("alpha", "depth"):
        torch.testing.assert_close(frame.layers[name], plain.layers[name])


def test_the_image_is_composed_of_its_layers() -> None:
    frame = Deferred()(glossy(), camera_at(0.1, 0.0, 0.0))
    share = frame.layers["strength"][..., None]
    composed = (1 - share) * frame.layers["base"] + share * frame.layers["reflection"]
    torch.testing.assert_close(frame.rgb, composed)
    assert float(share.max()) > 0.2


def test_pixels_that_hardly_reflect_cost_no_visible_difference() -> None:
    scene, camera = glossy(), camera_at(0.1, 0.0, 0.0)
    every = Deferred()(scene, camera)
    least = 0.5 * float(every.layers["strength"].max())
    some = Deferred(least_strength=least)(scene, camera)
    dull = every.layers["strength"] < least
    assert torch.equal(some.rgb[~dull], every.rgb[~dull])
    assert float(some.layers["reflection"][dull].abs().max()) == 0
    change, most = (some.rgb - every.rgb).abs(), (every.layers["reflection"] - every.layers["base"]).abs()
    assert float(change.max()) > 0
    assert bool((change <= least * most + 1e-12).all())


def test_an_empty_pixel_shows_the_background() -> None:
    scene = glossy(count=1)
    frame = Deferred(background=(1.0, 0.5, 0.25))(scene, camera_at(0.0, 0.0, 0.0))
    empty = frame.layers["alpha"] == 0
    assert empty.any() and not empty.all()
    assert frame.rgb[empty].unique(dim=0).tolist() == [[1.0, 0.5, 0.25]]


def test_gradients_reach_everything_that_learns() -> None:
    scene, camera = glossy(count=5, size=2), camera_at(0.1, 0.0, 0.0, width=12, height=10)
    names = ["primary.means", "primary.quats", "primary.log_scales", "primary.logit_opacities", "primary.sh",
             "primary.logit_strength", "environment.raw"]  # fmt: skip
    values = [scene.parameters()[name].clone().requires_grad_() for name in names]
    weights = torch.randn(10, 12, 3, generator=torch.Generator().manual_seed(7), dtype=torch.float64)

    def loss(*tensors: torch.Tensor) -> torch.Tensor:
        learning = scene.with_parameters(dict(zip(names, tensors, strict=True)))
        return (Deferred()(learning, camera).rgb * weights).sum()

    assert torch.autograd.gradcheck(loss, values, eps=1e-6, atol=1e-5, rtol=1e-3)
    found = torch.autograd.grad(loss(*values), values)
    assert all(bool(gradient.abs().max() > 0) for gradient in found)


def test_the_environment_layer_shows_the_environment_behind_each_pixel() -> None:
    scene, camera = glossy(), rolled(camera_at(0.1, 0.0, 0.0))
    layer = Deferred(environment=True)(scene, camera).layers["environment"]
    row, column = 3, 31
    pixel = torch.tensor([column + 0.5, row + 0.5], dtype=torch.float64)
    x = (pixel[0] - camera.cx) / camera.fx
    y = (pixel[1] - camera.cy) / camera.fy
    direction = camera.cam_from_world[:3, :3].T @ torch.stack([x, y, torch.ones_like(x)])
    expected = torch.sigmoid(cube_lookup(scene.environment.raw, direction[None]))[0]
    torch.testing.assert_close(layer[row, column], expected)


def test_a_scene_without_reflection_is_refused() -> None:
    scene, camera = in_single_precision(glossy()), camera_at(0.0, 0.0, 0.0)
    with pytest.raises(ValueError, match="no environment"):
        Deferred()(replace(scene, environment=Environment.empty()), camera)
    with pytest.raises(ValueError, match="logit_strength"):
        Deferred()(replace(scene, primary=replace(scene.primary, channels={})), camera)
