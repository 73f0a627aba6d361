"""Views that show no Gaussians, and scenes without any Gaussian left to show."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from glassplat.captures.dataset import Dataset
from glassplat.captures.view import View
from glassplat.cli.main import main
from glassplat.files.ply_table import write_table
from glassplat.methods.glossy_recipes import DeferredRecipe
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.training.actions import PruneIdle
from glassplat.training.loop import NoGaussiansError, VisibilityCheck, train
from glassplat.training.messages import Message, StepDone, Working
from glassplat.training.options import DefaultDensify
from glassplat.training.stage import Stage, TrainState
from tests.training.tiny_capture import place_true_planes, tiny_capture, write_tiny_capture


def looking_away(view: View) -> View:
    """The view from a camera with the whole scene behind it."""
    pose = view.camera.cam_from_world.clone()
    pose[2, 3] -= 1000
    return replace(view, camera=replace(view.camera, cam_from_world=pose))


def stages_of(recipe: SplatRecipe | PlanarRecipe | DeferredRecipe) -> tuple[Stage, ...]:
    panes = recipe.method == "planar"
    return tuple(replace(s, setup=place_true_planes) if s.setup and panes else s for s in recipe.stages(0, 24))


def fresh_state() -> TrainState:
    return TrainState(SplatRecipe(sh_degree=1).initialise(tiny_capture()), 0)


def some_views_away(count: int) -> Dataset:
    views = tiny_capture().train
    return replace(tiny_capture(), train=(*(looking_away(view) for view in views[:count]), *views[count:]))


@pytest.mark.parametrize("recipe", [SplatRecipe(), PlanarRecipe(), DeferredRecipe()], ids=lambda recipe: recipe.method)
def test_a_view_that_shows_nothing_does_not_end_a_run(recipe: SplatRecipe | PlanarRecipe | DeferredRecipe) -> None:
    scene = (recipe if recipe.method == "deferred" else SplatRecipe()).initialise(tiny_capture())
    state = TrainState(scene, 0)
    dataset = some_views_away(2)
    steps = [m for m in train(stages_of(recipe), dataset, state, 24) if isinstance(m, StepDone)]
    assert len(steps) == 24 and state.step == 24


def test_views_that_all_show_nothing_end_it_after_one_pass() -> None:
    state = fresh_state()
    with pytest.raises(NoGaussiansError, match="none of the 6 training views shows a Gaussian, up to step 6"):
        list(train(stages_of(SplatRecipe()), some_views_away(6), state, 600))


def test_a_step_that_is_refused_leaves_the_state_as_it_was() -> None:
    state, dataset = fresh_state(), some_views_away(1)
    with pytest.raises(NoGaussiansError, match="none of the 1 training views"):
        list(train(stages_of(SplatRecipe()), replace(dataset, train=dataset.train[:1]), state, 600))
    assert state.step == 0 and state.is_consistent and not state.statistics and not state.optimizer.moments


def test_only_whole_passes_are_judged() -> None:
    nothing, something = torch.zeros(3, dtype=torch.bool), torch.tensor([False, True, False])
    visibility = VisibilityCheck(3)
    for step, visible in ((1, nothing), (2, nothing), (3, nothing), (4, something), (5, nothing), (6, None)):
        visibility.record(visible, step)
    for step in (7, 8, 9, 10):
        visibility.record(nothing, step)
    with pytest.raises(NoGaussiansError):
        visibility.record(nothing, 11)


def test_losing_the_last_gaussian_is_an_error_without_a_step_message() -> None:
    (stage,) = stages_of(SplatRecipe())
    ruthless = PruneIdle(DefaultDensify(least_contribution=1e9, contribution_moments=(0.5,)))
    messages: list[Message] = []
    with pytest.raises(NoGaussiansError, match="no Gaussians are left after step 6"):
        # Collected one by one, because messages before the end count too.
        for message in train((replace(stage, actions=(ruthless,)),), tiny_capture(), fresh_state(), 12):
            messages.append(message)
    assert max(m.step for m in messages if isinstance(m, StepDone)) == 5
    assert [(m.done, m.total) for m in messages if isinstance(m, Working)] == [(done, 6) for done in range(6)]


def spoil(capture: Path, how: str) -> None:
    """Changes a capture so that little or nothing of it is visible."""
    settings = json.loads((capture / "transforms.json").read_text())
    for name in ("fl_x", "fl_y"):
        settings[name] *= {"long": 9e4, "short": 2e-3}.get(how, 1)
    (capture / "transforms.json").write_text(json.dumps(settings))
    points = {"far points": 1e6 * np.random.rand(50, 3), "one point": np.ones((50, 3))}
    if how in points:
        rows = np.concatenate([points[how], np.full((50, 3), 128)], axis=1)
        write_table(capture / "points3d.ply", ["x", "y", "z", "red", "green", "blue"], rows)


@pytest.mark.parametrize("how", ["long", "short", "far points", "one point", "few pixels"])
@pytest.mark.parametrize("method", ["splat", "deferred"])
def test_a_capture_without_content_ends_with_one_message(
    method: str, how: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capture, run = write_tiny_capture(tmp_path / "capture"), tmp_path / "run"
    spoil(capture, how)
    options = ["--data", str(capture), "--output", str(run), "--iterations", "40"]
    code = main(["train", method, *options, "--downscale", "40" if how == "few pixels" else "1"])
    message = capsys.readouterr().err
    if code == 0:
        assert (run / "point_cloud" / "iteration_40" / "point_cloud.ply").is_file() and not message
    elif code == 1:
        assert message.startswith("stopped:") and "Gaussian" in message and "unexpected error" not in message
    else:
        assert message.startswith("error:")
