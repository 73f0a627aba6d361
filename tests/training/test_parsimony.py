"""Regularisation of opacity, scale and view-dependent colour."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from glassplat.render.frame import Frame
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene
from glassplat.training.losses import mean_opacity, mean_scale, view_dependence

UNUSED: Any = None
UNTOLD = Frame(torch.zeros(1, 1, 3))
"""A frame that does not say what it shows."""


def scene_of(opacities: list[float], scale: float, extent: float = 1.0) -> Scene:
    count = len(opacities)
    gaussians = Gaussians(
        means=torch.zeros(count, 3),
        quats=torch.ones(count, 4),
        log_scales=torch.full((count, 3), scale).log().requires_grad_(),
        logit_opacities=torch.logit(torch.tensor(opacities)).requires_grad_(),
        sh=torch.zeros(count, 1, 3),
    )
    return Scene(gaussians, extent)


def test_the_terms_are_means_of_activated_values() -> None:
    scene = scene_of([0.2, 0.6], scale=0.3)
    assert mean_opacity(UNTOLD, UNUSED, scene).item() == pytest.approx(0.4)
    assert mean_scale(UNTOLD, UNUSED, scene).item() == pytest.approx(0.3)


def test_the_scale_term_does_not_depend_on_the_units_of_the_capture() -> None:
    metres, millimetres = scene_of([0.5], 0.3, extent=2.0), scene_of([0.5], 300.0, extent=2000.0)
    assert mean_scale(UNTOLD, UNUSED, metres).item() == pytest.approx(mean_scale(UNTOLD, UNUSED, millimetres).item())


def test_gradients_reach_the_raw_values() -> None:
    scene = scene_of([0.2, 0.6], scale=0.3)
    (mean_opacity(UNTOLD, UNUSED, scene) + mean_scale(UNTOLD, UNUSED, scene)).backward()
    assert scene.primary.logit_opacities.grad is not None and scene.primary.log_scales.grad is not None
    assert scene.primary.logit_opacities.grad.tolist() == pytest.approx([0.2 * 0.8 / 2, 0.6 * 0.4 / 2])
    assert scene.primary.log_scales.grad.flatten().tolist() == pytest.approx([0.3 / 6] * 6)


def test_what_a_view_does_not_show_directly_is_left_alone() -> None:
    scene = scene_of([0.2, 0.6, 0.7], scale=0.3)
    frame = replace(UNTOLD, direct=torch.tensor([True, False, True]), mirrored=torch.tensor([False, True, True]))
    opacity, scale = mean_opacity(frame, UNUSED, scene), mean_scale(frame, UNUSED, scene)
    assert opacity.item() == pytest.approx(0.45) and scale.item() == pytest.approx(0.3)
    (opacity + scale).backward()
    assert scene.primary.logit_opacities.grad is not None and scene.primary.log_scales.grad is not None
    assert scene.primary.logit_opacities.grad.tolist() == pytest.approx([0.2 * 0.8 / 2, 0.0, 0.7 * 0.3 / 2])
    assert scene.primary.log_scales.grad[:, 0].tolist() == pytest.approx([0.3 / 6, 0.0, 0.3 / 6])
    nothing = replace(UNTOLD, direct=torch.zeros(3, dtype=torch.bool))
    assert mean_opacity(nothing, UNUSED, scene).item() == mean_scale(nothing, UNUSED, scene).item() == 0


def test_no_gaussians_cost_nothing() -> None:
    scene = scene_of([], scale=0.3)
    assert mean_opacity(UNTOLD, UNUSED, scene).item() == 0
    assert mean_scale(UNTOLD, UNUSED, scene).item() == 0


def test_only_colours_that_turn_with_the_view_are_held() -> None:
    scene = scene_of([0.5, 0.5], scale=0.3)
    sh = torch.zeros(2, 4, 3)
    sh[:, 0] = 7.0
    constant = replace(scene, primary=scene.primary.with_tensors({"sh": sh}))
    assert view_dependence(UNUSED, UNUSED, constant).item() == 0
    sh = sh.clone()
    sh[1, 2] = torch.tensor([1.0, -2.0, 0.0])
    turning = replace(scene, primary=scene.primary.with_tensors({"sh": sh}))
    assert view_dependence(UNUSED, UNUSED, turning).item() == pytest.approx(5 / 2)
    assert view_dependence(UNUSED, UNUSED, scene).item() == 0


def test_the_gradient_holds_harmonics_and_leaves_the_constant_alone() -> None:
    scene = scene_of([0.5, 0.5, 0.5], scale=0.3)
    sh = torch.randn(3, 9, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()

    def penalty(values: torch.Tensor) -> torch.Tensor:
        return view_dependence(UNUSED, UNUSED, replace(scene, primary=scene.primary.with_tensors({"sh": values})))

    assert torch.autograd.gradcheck(penalty, sh)
    (gradient,) = torch.autograd.grad(penalty(sh), sh)
    assert not gradient[:, 0].any()
