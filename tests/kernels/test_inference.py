"""Values cached while PyTorch records no gradients also serve later calls with gradients."""

from __future__ import annotations

import dataclasses

import torch

from glassplat.kernels.environment import _color
from glassplat.kernels.project import _whole_images
from glassplat.render.splat import Splat
from glassplat.scene.camera import constant
from tests.training.tiny_capture import tiny_capture, true_scene


def test_rendering_in_inference_mode_does_not_affect_later_training() -> None:
    for made_once in (constant, _color, _whole_images):
        made_once.cache_clear()
    scene, view = true_scene(), tiny_capture().train[0]
    renderer = Splat(background=(0.25, 0.5, 0.75))
    with torch.inference_mode():
        expected = renderer(scene, view.camera).rgb.clone()
    means = scene.primary.means.clone().requires_grad_()
    primary = dataclasses.replace(scene.primary, means=means)
    image = renderer(dataclasses.replace(scene, primary=primary), view.camera).rgb
    assert torch.equal(image.detach(), expected)
    image.sum().backward()
    assert means.grad is not None and bool(means.grad.any())
    assert not _color((0.5, 0.5, 0.5), torch.float32, torch.device("cpu")).is_inference()
