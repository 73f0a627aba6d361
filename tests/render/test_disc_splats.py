"""`Splat` draws discs for flat Gaussians."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from glassplat.render.deferred import Deferred
from glassplat.render.frame import Renderer
from glassplat.render.layers import contributions
from glassplat.render.planar import Planar
from glassplat.render.splat import Splat
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene
from tests.render.tiny_scene import camera_at, random_gaussians

LAYERS = {"alpha", "depth", "median_depth", "distortion", "normal"}


def disc_scene() -> Scene:
    solid = random_gaussians(80, (0.0, 0.0, 2.0), seed=1)
    return Scene(replace(solid, log_scales=solid.log_scales[:, :2].contiguous()), 2.0)


def test_every_layer_is_rendered() -> None:
    frame = Splat()(disc_scene(), camera_at(0, 0, 0))
    assert set(frame.layers) == LAYERS
    assert set(Splat(normal=False)(disc_scene(), camera_at(0, 0, 0)).layers) == LAYERS - {"normal"}
    covered = frame.layers["alpha"] > 0.5
    assert bool(covered.any())
    for name in ("depth", "median_depth"):
        assert 1.0 < float(frame.layers[name][covered].mean()) < 3.0
    assert float(frame.layers["normal"].norm(dim=-1).max()) <= 1.0
    assert bool((frame.layers["normal"][covered] @ torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64) > -0.3).all())


def test_the_background_lies_behind() -> None:
    black, white = (Splat(background=(c, c, c))(disc_scene(), camera_at(0, 0, 0)) for c in (0.0, 1.0))
    torch.testing.assert_close(white.rgb - black.rgb, (1 - black.layers["alpha"])[..., None].expand_as(black.rgb))


def test_a_frame_with_records_has_the_gradient_of_each_pass() -> None:
    scene = disc_scene()
    leaves = {name: t.detach().requires_grad_() for name, t in scene.parameters().items() if t.numel()}
    frame = Splat()(scene.with_parameters(leaves), camera_at(0, 0, 0), with_records=True)
    (record,) = frame.screen
    v_means, v_absgrad = torch.autograd.grad(frame.rgb.sum(), [record.means2d, record.absgrad])
    assert bool((v_absgrad >= v_means.abs() - 1e-9).all()) and bool(v_absgrad.any())


def test_moving_scene_and_camera_together_changes_nothing() -> None:
    scene, camera, shift = disc_scene(), camera_at(0, 0, 0), torch.tensor([3.0, -2.0, 5.0], dtype=torch.float64)
    moved = Scene(scene.primary.with_tensors({"means": scene.primary.means + shift}), 2.0)
    there = Splat()(moved, camera_at(3, -2, 5))
    torch.testing.assert_close(there.rgb, Splat()(scene, camera).rgb)


def test_contributions_of_discs_are_their_blending_weights() -> None:
    scene, camera = disc_scene(), camera_at(0, 0, 0)
    found = contributions(scene, camera)
    assert found.shape == (80,) and bool((found >= 0).all())
    assert float(found.sum()) == pytest.approx(float(Splat()(scene, camera).layers["alpha"].sum()))


def test_a_scene_of_no_discs_is_empty() -> None:
    none: Gaussians = disc_scene().primary.select(torch.zeros(80, dtype=torch.bool))
    assert not Splat()(Scene(none, 2.0), camera_at(0, 0, 0)).rgb.any()


@pytest.mark.parametrize("renderer", [Planar(), Deferred()])
def test_methods_of_ellipsoids_refuse_discs(renderer: Renderer) -> None:
    with pytest.raises(ValueError, match="the Gaussians are discs, with two scales; expected three"):
        renderer.check(disc_scene())
