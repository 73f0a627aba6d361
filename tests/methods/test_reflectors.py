"""Shares of the views that reflect, and that look as if they should."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from glassplat.captures.view import View, sample_evenly
from glassplat.methods.mirrors import reflective_share, residual_spreads, view_dependent_share
from glassplat.render.deferred import Deferred
from glassplat.render.layers import contributions
from glassplat.scene import SH_ZERO, logit
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Environment, Scene
from tests.training.brightened_views import brightened_views

SIZE = 24
GREY = 0.5


def two_discs(*, strength: float = 1e-3) -> Scene:
    """Opaque grey Gaussians left and right of the z axis, the left one with the given strength."""
    gaussians = Gaussians(
        means=torch.tensor([[-0.5, 0.0, 2.0], [0.5, 0.0, 2.0]]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(2, 1),
        log_scales=torch.tensor([[0.15, 0.15, 0.01]]).log().repeat(2, 1),
        logit_opacities=torch.tensor([6.0, 6.0]),
        sh=torch.full((2, 1, 3), (GREY - 0.5) / SH_ZERO),
        channels={"logit_strength": torch.tensor([logit(strength), logit(1e-3)])},
    )
    environment = Environment(torch.zeros(6, 2, 2, 3), region=(0.0, 0.0, 2.0, 1.0))
    return Scene(gaussians, 1.0, environment=environment)


def camera() -> Camera:
    return Camera(torch.eye(4), 20.0, 20.0, SIZE / 2, SIZE / 2, SIZE, SIZE)


def views(*left: float) -> list[View]:
    """Photographs of the discs, each with the left half brighter by the given amount."""
    with torch.no_grad():
        base = Deferred()(two_discs(), camera()).layers["base"]
    return brightened_views(base, camera(), GREY, *left)


@pytest.mark.parametrize("strength", [1e-3, 0.1, 0.5, 0.9])
def test_reflectors_are_weighted_by_strength_and_visibility(strength: float) -> None:
    share = reflective_share(two_discs(strength=strength), views(0, 0))
    assert share == pytest.approx((strength + 1e-3) / 2, abs=1e-3)


def test_gaussians_outside_the_region_do_not_count() -> None:
    scene = two_discs(strength=0.9)
    scene = replace(scene, environment=replace(scene.environment, region=(-0.5, 0.0, 2.0, 0.3)))
    assert scene.environment.surrounds(scene.primary.means).tolist() == [True, False]
    assert reflective_share(scene, views(0)) == pytest.approx(0.9, abs=1e-3)
    everywhere = replace(scene, environment=replace(scene.environment, region=None))
    assert reflective_share(everywhere, views(0)) == pytest.approx(0.45, abs=1e-3)
    nowhere = replace(scene, environment=replace(scene.environment, region=(0.0, 0.0, 9.0, 0.3)))
    assert reflective_share(nowhere, views(0)) == 0.0


def test_a_constant_residual_has_no_spread() -> None:
    shown, spreads = residual_spreads(two_discs(), views(0.3, 0.3, 0.3, 0.3), Deferred())
    torch.testing.assert_close(shown, 4 * contributions(two_discs(), camera()))
    assert spreads.max() < 0.01
    assert view_dependent_share(two_discs(), views(0.3, 0.3), Deferred()) == 0.0


def test_a_view_dependent_residual_has_the_spread_of_the_photographs() -> None:
    _, spreads = residual_spreads(two_discs(), views(0.2, -0.2, 0.2, -0.2), Deferred())
    # A Gaussian's own weights fall off like its colour in the image, so that it sees their weighted square.
    assert 0.08 < float(spreads[0]) < 0.2
    assert float(spreads[1]) < 0.01


def test_ignored_pixels_are_no_evidence() -> None:
    """A residual that is constant wherever it is known does not vary with the view, however many views are masked."""
    plain, *masked = views(0.3, 0.3, 0.3, 0.3)
    everything = torch.ones(SIZE, SIZE, dtype=torch.bool)
    masked = [replace(view, read_ignored=lambda: everything) for view in masked]
    shown, spreads = residual_spreads(two_discs(), [plain, *masked], Deferred())
    torch.testing.assert_close(shown, contributions(two_discs(), camera()))
    assert spreads.max() < 0.01


def test_reflective_surfaces_do_not_count_as_view_dependent() -> None:
    turning = views(0.3, -0.3, 0.3, -0.3)
    assert view_dependent_share(two_discs(), turning, Deferred()) == pytest.approx(0.5, abs=1e-3)
    assert view_dependent_share(two_discs(strength=0.9), turning, Deferred()) == 0.0


def test_views_are_taken_evenly() -> None:
    assert [view.name for view in sample_evenly(views(*([0.0] * 9)), 3)] == ["0.png", "3.png", "6.png"]
    assert len(sample_evenly(views(0.0), 3)) == 1
