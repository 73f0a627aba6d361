"""Loss terms on the reflection strength of Gaussians."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Environment, Scene
from glassplat.training.losses import mean_strength, strength_outside

UNUSED: Any = None
STRENGTHS = torch.tensor([0.1, 0.5, 0.9])


def scene_of(region: tuple[float, float, float, float] | None) -> Scene:
    """Three Gaussians at x = 0, 1 and 5."""
    means = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    primary = Gaussians(
        means=means,
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(3, 1),
        log_scales=torch.zeros(3, 3),
        logit_opacities=torch.zeros(3),
        sh=torch.zeros(3, 1, 3),
        channels={"logit_strength": torch.logit(STRENGTHS)},
    )
    environment = replace(Environment.random(2, generator=torch.Generator().manual_seed(0)), region=region)
    return Scene(primary, 1.0, environment=environment)


def test_the_strength_regulariser_is_the_mean_strength() -> None:
    assert mean_strength(UNUSED, UNUSED, scene_of(None)).item() == pytest.approx(0.5)


@pytest.mark.parametrize(("radius", "expected"), [(2.0, 0.9), (0.5, 0.7), (9.0, 0.0)])
def test_positions_beyond_the_radius_are_outside_the_region(radius: float, expected: float) -> None:
    found = strength_outside(UNUSED, UNUSED, scene_of((0.0, 0.0, 0.0, radius)))
    assert found is not None and found.item() == pytest.approx(expected)


def test_without_a_region_nothing_is_outside() -> None:
    assert strength_outside(UNUSED, UNUSED, scene_of(None)) is None
