"""The result of a run is the mean over its last pass."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.training.actions import AverageLast, replace_sorted
from glassplat.training.loop import train
from glassplat.training.messages import StepDone
from glassplat.training.options import Intervals
from glassplat.training.stage import Clock, Stage, TrainState
from tests.training.progress_of import assert_resumes, trained
from tests.training.tiny_capture import tiny_capture

ITERATIONS, LAST = 40, 4
"""The mean covers at most a tenth of a run."""


def stages(passes: float) -> tuple[Stage, ...]:
    recipe = SplatRecipe(sh_degree=1, intervals=Intervals(averaged_passes=passes))
    return tuple(replace(stage, actions=()) for stage in recipe.stages(seed=0))


def fresh_state() -> TrainState:
    return TrainState(SplatRecipe(sh_degree=1).initialise(tiny_capture()), 0)


def run(state: TrainState, passes: float, until: int = ITERATIONS) -> list[dict[str, Tensor]]:
    """The parameters after each step."""
    found = []
    for message in train(stages(passes), tiny_capture(), state, ITERATIONS):
        if isinstance(message, StepDone):
            found.append({name: tensor.clone() for name, tensor in state.scene.parameters().items()})
            if message.step == until:
                break
    return found


def test_the_scene_is_the_mean_of_the_last_steps() -> None:
    state = fresh_state()
    single, averaged = run(fresh_state(), passes=0), run(state, passes=1)
    assert len(tiny_capture().train) >= LAST
    for name, tensor in averaged[-1].items():
        assert torch.equal(averaged[-2][name], single[-2][name]), name
        expected = torch.stack([parameters[name] for parameters in single[-LAST:]]).mean(dim=0)
        torch.testing.assert_close(tensor, expected)
    assert not torch.equal(averaged[-1]["primary.sh"], single[-1]["primary.sh"])
    assert not state.means
    assert not state.records


def test_averaging_keeps_constant_tensors_bit_for_bit() -> None:
    averaged = run(fresh_state(), passes=1)
    assert torch.equal(averaged[-1]["primary.log_intensity"], averaged[0]["primary.log_intensity"])


@pytest.mark.parametrize("pause", [ITERATIONS - LAST, ITERATIONS - 2])
def test_a_resumed_run_ends_with_the_same_mean(pause: int, tmp_path: Path) -> None:
    assert_resumes(
        lambda state, until: trained(state, stages(1), ITERATIONS, until=until), fresh_state, pause, tmp_path
    )


def test_the_mean_restarts_when_the_set_of_gaussians_changes() -> None:
    state, average = fresh_state(), AverageLast(passes=1)
    average(state, Clock(97, 100, views=10), None)
    fewer = state.scene.primary.select(torch.arange(len(state.scene.primary)) > 2)
    state.scene = replace(state.scene, primary=fewer)
    for step in (98, 99, 100):
        average(state, Clock(step, 100, views=10), None)
    assert torch.equal(state.scene.primary.means, fewer.means)


def test_the_mean_restarts_when_gaussians_are_reordered() -> None:
    state, average = fresh_state(), AverageLast(passes=1)
    average(state, Clock(97, 100, views=10), None)
    backwards = state.scene.primary.select(torch.arange(len(state.scene.primary)).flip(0))
    replace_sorted(state, backwards.with_tensors({"means": -backwards.means}), {})
    expected = state.scene.primary.means
    for step in (98, 99, 100):
        average(state, Clock(step, 100, views=10), None)
    torch.testing.assert_close(state.scene.primary.means, expected)
