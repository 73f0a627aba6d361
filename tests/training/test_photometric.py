"""The loss shared by all methods."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from glassplat.captures.view import View, _composite_over
from glassplat.render.frame import Frame
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene
from glassplat.training.losses import PhotometricLoss, residual

SCENE = Scene(Gaussians.empty(), extent=1.0)
CAMERA = Camera(torch.eye(4), 20.0, 20.0, 12.0, 8.0, 24, 16)


def test_the_weight_blends_l1_and_dssim() -> None:
    photo = (torch.rand(16, 24, 3) * 255).to(torch.uint8)
    view, frame = View.in_memory("a.png", CAMERA, photo=photo), Frame(torch.rand(16, 24, 3))
    l1, dssim, both = (PhotometricLoss(weight)(frame, view, SCENE).item() for weight in (0.0, 1.0, 0.2))
    assert l1 == pytest.approx((frame.rgb - photo / 255).abs().mean().item())
    assert both == pytest.approx(0.8 * l1 + 0.2 * dssim)


def test_a_residual_is_what_the_render_lacks_and_nothing_where_it_is_not_counted() -> None:
    photo, ignored = (torch.rand(16, 24, 3) * 255).to(torch.uint8), torch.rand(16, 24) < 0.3
    view = replace(View.in_memory("a.png", CAMERA, photo=photo), read_ignored=lambda: ignored)
    rendered = torch.rand(16, 24, 3)
    expected = torch.where(ignored[..., None], 0, photo / 255 - rendered)
    torch.testing.assert_close(residual(Frame(rendered), view, SCENE), expected)


def test_a_render_over_the_background_of_a_transparent_photograph_is_without_loss() -> None:
    rgba = (torch.rand(16, 24, 4) * 255).to(torch.uint8)
    rgba[:, :12, 3] = 0
    view = View.in_memory("a.png", CAMERA, photo=torch.from_numpy(_composite_over(rgba.numpy(), (1.0, 1.0, 1.0))))
    alpha = rgba[..., 3:] / 255
    rgb = (rgba[..., :3] / 255 * alpha + 1 - alpha).requires_grad_()
    loss = PhotometricLoss(0.0)(Frame(rgb), view, SCENE)
    (gradient,) = torch.autograd.grad(loss, rgb)
    assert loss.item() < 0.5 / 255
    assert gradient[:, :12].abs().max() == 0
