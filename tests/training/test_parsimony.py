"""Regularisation of opacity, scale and view-dependent colour."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.render.frame import Frame
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene
from glassplat.training.loop import update_parameters
from glassplat.training.losses import mean_opacity, mean_scale
from glassplat.training.options import GaussianRates, Rate
from glassplat.training.stage import TrainState, decay_tensor

UNUSED: Any = None
UNTOLD = Frame(torch.zeros(1, 1, 3))
"""A frame without visibility."""


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


def test_gaussians_not_directly_visible_are_unchanged() -> None:
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


def test_decay_is_the_gradient_of_the_squares_of_harmonics_beyond_the_constant() -> None:
    sh = torch.randn(5, 9, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    (expected,) = torch.autograd.grad(0.7 * sh[:, 1:].square().sum() / 5, sh)
    decay = decay_tensor(GaussianRates().of("primary", 0.7)["primary.sh"], sh)
    assert decay is not None
    torch.testing.assert_close(decay.reshape(9, 3) * sh.detach(), expected)
    assert not expected[:, 0].any()


@pytest.mark.parametrize("rate", [Rate(1.0, rest=0.05), Rate(1.0, rest=0.05, penalty=0.7)])
def test_nothing_decays_that_has_no_penalty_or_no_harmonics(rate: Rate) -> None:
    assert decay_tensor(rate, torch.zeros(5 if not rate.penalty else 0, 9, 3)) is None


def test_every_stage_of_planar_holds_harmonics_of_the_primary_gaussians_alone() -> None:
    for stage in PlanarRecipe(view_dependence_weight=0.3).stages(seed=0):
        assert {name: rate.penalty for name, rate in stage.rates.items() if rate.penalty} == {"primary.sh": 0.3}


def test_the_view_dependence_weight_shrinks_harmonics() -> None:
    (stage,) = SplatRecipe(view_dependence_weight=0.1).stages(seed=0)
    state = TrainState(scene_of([0.5, 0.5], scale=0.3), seed=0)
    state.scene = replace(state.scene, primary=state.scene.primary.with_tensors({"sh": torch.full((2, 9, 3), 0.2)}))
    before = state.scene.primary.sh.clone()
    update_parameters(stage, state, {"primary.sh": torch.zeros_like(before)}, iterations=100)
    assert bool((state.scene.primary.sh[:, 1:] < before[:, 1:]).all())
    assert torch.equal(state.scene.primary.sh[:, :1], before[:, :1])
