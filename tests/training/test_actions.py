"""Edits of the training state that no recipe's test looks at by itself."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.scene.scene import Scene
from glassplat.training.actions import Densify, PruneIdle, limit_of
from glassplat.training.densify import ScreenStatistics
from glassplat.training.options import DefaultDensify
from glassplat.training.stage import Clock, TrainState
from tests.training.progress_of import finished
from tests.training.tiny_capture import tiny_capture


def state_with_one_out_of_sight() -> TrainState:
    scene: Scene = SplatRecipe(sh_degree=1).initialise(tiny_capture())
    means = scene.primary.means.clone()
    means[3] = 1000.0
    state = TrainState(replace(scene, primary=scene.primary.with_tensors({"means": means})), seed=0)
    rows = torch.arange(len(means), dtype=torch.float32)[:, None].expand(-1, 3).contiguous()
    state.optimizer.moments["primary.means"] = (rows.clone(), rows.clone())
    return state


def test_what_no_view_needs_is_removed_with_its_moments() -> None:
    state, action = state_with_one_out_of_sight(), PruneIdle(DefaultDensify(least_contribution=1e-3))
    before = state.scene.primary.means
    assert finished(action.apply(state, tiny_capture(), Clock(50, 100, 5)))
    kept = state.optimizer.moments["primary.means"][0][:, 0].long()
    assert 0 < len(kept) < len(before) and 3 not in kept.tolist()
    assert torch.equal(state.scene.primary.means, before[kept])
    assert not finished(action.apply(state, tiny_capture(), Clock(80, 100, 5)))


def test_idle_gaussians_are_looked_for_at_the_moments_that_were_asked_for() -> None:
    def due(densifier: DefaultDensify) -> list[int]:
        return [step for step in range(1, 101) if PruneIdle(densifier).due(Clock(step, 100, 5))]

    assert due(DefaultDensify(contribution_moments=(0.5, 0.8))) == [50, 80]
    assert due(DefaultDensify(least_contribution=0)) == []


@pytest.mark.parametrize(
    ("densifier", "limit"),
    [
        (DefaultDensify(per_pixel=0.01), 0.01),
        (DefaultDensify(per_pixel=0.01, cap=5), None),
        (DefaultDensify(per_pixel=0.0), None),
        (DefaultDensify.published(), None),
    ],
)
def test_photographs_limit_the_number_of_gaussians(densifier: DefaultDensify, limit: float | None) -> None:
    capture = tiny_capture()
    pixels = sum(view.camera.width * view.camera.height for view in capture.train)
    assert limit_of(densifier, capture) == (densifier.cap if limit is None else round(limit * pixels))


def test_a_set_grows_to_its_limit_and_no_further() -> None:
    state, capture = TrainState(SplatRecipe(sh_degree=1).initialise(tiny_capture()), seed=0), tiny_capture()
    count = len(state.scene.primary)
    ones = torch.ones(2, count)
    state.statistics["primary"] = ScreenStatistics(ones, ones, ones, torch.full((count,), 0.01))
    share = (count + 2) / sum(view.camera.width * view.camera.height for view in capture.train)
    Densify(DefaultDensify(per_pixel=share)).apply(state, capture, Clock(10, 100, 5))
    assert len(state.scene.primary) == count + 2
