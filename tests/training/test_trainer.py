"""The training loop: progress, determinism, resuming, and its rejection of invalid losses."""

from __future__ import annotations

import sys
import weakref
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from glassplat.captures.dataset import Dataset
from glassplat.captures.view import View
from glassplat.errors import InputError
from glassplat.methods.planar import PaneSetup
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.scene.scene import Scene
from glassplat.training import loop
from glassplat.training.checkpoint import load_checkpoint, save_checkpoint
from glassplat.training.densify import ScreenStatistics, gaussians_from_points
from glassplat.training.loop import TrainingDivergedError, ViewGradients, collect_statistics, differentiate, train
from glassplat.training.losses import LossTerm, PhotometricLoss
from glassplat.training.messages import ActionDone, StageEntered, StepDone
from glassplat.training.options import Rate
from glassplat.training.stage import AtShares, Clock, Stage, TrainState
from tests.training.progress_of import assert_resumes, finished, trained
from tests.training.tiny_capture import place_true_planes, tiny_capture, true_scene


def fresh_state(seed: int = 0) -> TrainState:
    return TrainState(SplatRecipe(sh_degree=1).initialise(tiny_capture()), seed)


def planar_stages() -> tuple[Stage, ...]:
    stages = PlanarRecipe(sh_degree=1, stage_shares=(0.2, 0.3, 0.5)).stages(seed=0)
    return tuple(replace(s, setup=place_true_planes) if s.setup else s for s in stages)


def run(state: TrainState, stages: tuple[Stage, ...], iterations: int, until: int | None = None) -> list[StepDone]:
    return [message for message in trained(state, stages, iterations, until=until) if isinstance(message, StepDone)]


def assert_same_scene(first: Scene, second: Scene) -> None:
    for name, tensor in first.parameters().items():
        assert torch.equal(tensor, second.parameters()[name]), name


def test_training_lowers_the_loss() -> None:
    steps = run(fresh_state(), SplatRecipe(sh_degree=1).stages(seed=0), 60)
    assert sum(s.loss for s in steps[-6:]) < 0.6 * sum(s.loss for s in steps[:6])


def test_a_step_does_not_import_sympy(monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes half a second to import, and PyTorch imports it to check given gradients."""
    monkeypatch.setitem(sys.modules, "torch.fx.experimental.symbolic_shapes", None)
    with pytest.raises(ModuleNotFoundError):
        torch.autograd.grad([torch.ones((), requires_grad=True) * 1], [torch.ones(())], [torch.ones(())])
    assert run(fresh_state(), planar_stages(), iterations=20, until=2)


def test_planar_goes_through_its_stages() -> None:
    state = fresh_state()
    messages = list(train(planar_stages(), tiny_capture(), state, 20))
    assert [(m.step, m.stage[0]) for m in messages if isinstance(m, StageEntered)] == [(0, "1"), (4, "2"), (10, "3")]
    assert any(isinstance(m, ActionDone) for m in messages)
    terms = [set(m.losses) for m in messages if isinstance(m, StepDone)]
    assert terms[0] == {"photometric"}
    assert {"photometric", "depth", "conflict"} <= terms[-1]
    assert any("mask" in names for names in terms)


def test_stage_two_moves_the_plane_and_stage_one_does_not_touch_what_is_frozen() -> None:
    state = fresh_state()
    run(state, planar_stages(), 20, until=4)
    assert torch.equal(state.scene.primary.channels["log_intensity"], torch.zeros(len(state.scene.primary)))
    before = true_scene().planes
    run(state, planar_stages(), 20, until=10)
    assert not torch.equal(state.scene.planes.centers, before.centers)


def test_the_same_seed_gives_the_same_scene_and_another_seed_another() -> None:
    states = [fresh_state(0), fresh_state(0), fresh_state(1)]
    for state in states:
        run(state, planar_stages(), 12)
    assert_same_scene(states[0].scene, states[1].scene)
    assert not torch.equal(states[0].scene.primary.sh, states[2].scene.primary.sh)


def test_screen_gradients_are_collected_as_long_as_densification_reads_them() -> None:
    stages, state = tuple(replace(stage, actions=()) for stage in planar_stages()), fresh_state()
    seen = []
    for until in (10, 20):
        run(state, stages, 20, until=until)
        seen.append({part: statistics.view_count.clone() for part, statistics in state.statistics.items()})
    assert PlanarRecipe().densify.stop == 0.5
    assert seen[0]["primary"].sum() > 0
    assert seen[0]["glass"].sum() > 0
    for part, views in seen[0].items():
        assert torch.equal(views, seen[1][part]), part


def test_gradients_are_freed_before_the_actions(monkeypatch: pytest.MonkeyPatch) -> None:
    """Densification needs the most memory of a run."""
    found: list[weakref.ref[torch.Tensor]] = []
    alive: list[bool] = []

    def noted(*arguments: Any, **options: Any) -> ViewGradients:
        result = differentiate(*arguments, **options)
        found.append(weakref.ref(result.gradients["primary.means"]))
        return result

    class Look(AtShares):
        name = "look"

        def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
            alive.extend(reference() is not None for reference in found)
            return False

    monkeypatch.setattr(loop, "differentiate", noted)
    (stage,) = SplatRecipe(sh_degree=1).stages(seed=0)
    run(fresh_state(), (replace(stage, actions=(Look((0.5, 1.0)),)),), iterations=2)
    assert alive == [False, False, False]


def test_collecting_screen_gradients_changes_no_other_gradient() -> None:
    state = fresh_state()
    run(state, planar_stages(), 20, until=12)
    results = [
        differentiate(planar_stages()[-1], state.scene, tiny_capture().train[0], with_records=p) for p in (True, False)
    ]
    assert len(results[0].screen) == 3
    assert not results[1].screen
    assert results[0].losses == results[1].losses
    for name, gradient in results[0].gradients.items():
        assert torch.allclose(gradient, results[1].gradients[name], rtol=1e-4, atol=1e-9), name


def statistics_of_views(views: Sequence[View]) -> dict[str, ScreenStatistics]:
    state = fresh_state()
    place_true_planes(state, None)
    found: dict[str, ScreenStatistics] = {}
    for view in views:
        collect_statistics(found, differentiate(planar_stages()[-1], state.scene, view, with_records=True), view)
    return found


def ignoring(view: View, pixels: torch.Tensor) -> View:
    return replace(view, read_ignored=lambda: pixels)


def test_views_that_are_ignored_do_not_count_for_densification() -> None:
    views, nothing = tiny_capture().train, torch.zeros(tiny_capture().train[0].photo.shape[:2], dtype=torch.bool)
    whole = statistics_of_views([ignoring(view, ~nothing if i < 2 else nothing) for i, view in enumerate(views)])
    without = statistics_of_views(views[2:])
    assert bool(whole["primary"].view_count[0].gt(whole["primary"].view_count[1]).any())
    for part, known in whole.items():
        for name, sums in known._asdict().items():
            assert torch.equal(sums, getattr(without[part], name)), (part, name)


def test_only_what_stands_on_ignored_pixels_is_not_counted() -> None:
    view = tiny_capture().train[1]
    left = (torch.arange(view.camera.width) < view.camera.width // 2).expand(view.photo.shape[:2])
    everywhere, right = (statistics_of_views([v])["primary"].view_count[1] for v in (view, ignoring(view, left)))
    is_left = view.camera.project(fresh_state().scene.primary.means)[0][:, 0] < view.camera.width // 2
    assert 0 < int((everywhere * is_left).count_nonzero()) < int(everywhere.count_nonzero())
    assert torch.equal(right, everywhere * ~is_left)


@pytest.mark.parametrize("pause", [3, 4, 7])
def test_resuming_continues_to_the_same_result(pause: int, tmp_path: Path) -> None:
    assert_resumes(lambda state, until: run(state, planar_stages(), 12, until), fresh_state, pause, tmp_path)


@pytest.mark.parametrize("is_saved", [False, True])
@pytest.mark.parametrize("begins", [0, 4])
def test_a_setup_runs_once(begins: int, is_saved: bool, tmp_path: Path) -> None:
    def grow(state: TrainState, dataset: object) -> None:
        state.scene.primary.log_scales.add_(0.1)

    (stage,) = SplatRecipe(sh_degree=1).stages(seed=0)
    stages = (replace(stage, share=0.5, setup=grow), replace(stage, share=0.5, setup=grow))
    whole, left = fresh_state(), fresh_state()
    run(whole, stages, 8)
    for message in train(stages, tiny_capture(), left, 8):
        if isinstance(message, StageEntered) and message.step == begins:
            break
    if is_saved:
        save_checkpoint(tmp_path / "checkpoint.safetensors", left)
        left = load_checkpoint(tmp_path / "checkpoint.safetensors")
    run(left, stages, 8)
    assert_same_scene(whole.scene, left.scene)


@pytest.mark.parametrize("pause", [3, 5])
def test_a_stage_that_ends_early_leaves_its_steps_to_the_next(pause: int, tmp_path: Path) -> None:
    def grow(state: TrainState, dataset: object) -> None:
        state.scene.primary.log_scales.add_(0.1)

    (stage,) = SplatRecipe(sh_degree=1).stages(seed=0)
    stages = (
        replace(stage, name="first", share=0.5, is_finished=lambda state: state.step >= 3),
        replace(stage, name="second", share=0.5, setup=grow),
    )
    whole, left = fresh_state(), fresh_state()
    entered = [m for m in train(stages, tiny_capture(), whole, 8) if isinstance(m, StageEntered)]
    assert [(message.step, message.stage) for message in entered] == [(0, "first"), (3, "second")]
    run(left, stages, 8, until=pause)
    save_checkpoint(tmp_path / "checkpoint.safetensors", left)
    left = load_checkpoint(tmp_path / "checkpoint.safetensors")
    entered = [m for m in train(stages, tiny_capture(), left, 8) if isinstance(m, StageEntered)]
    assert [message.step for message in entered] == [3] * (pause == 3)
    assert_same_scene(whole.scene, left.scene)


def test_a_loss_that_is_not_finite_stops_training_and_is_named() -> None:
    broken = Stage(
        name="broken",
        share=1.0,
        renderer=SplatRecipe().renderer(),
        losses=(
            LossTerm("photometric", 1.0, PhotometricLoss(0.2)),
            LossTerm("poison", 1.0, lambda f, v, s: f.rgb.sum() * float("nan")),
        ),
        rates=SplatRecipe().rates.of("primary"),
    )
    state = fresh_state()
    with pytest.raises(TrainingDivergedError, match=r"'poison' is nan at step 1 in view '\d.png'"):
        run(state, (broken,), 5)
    assert state.step == 0
    assert_same_scene(state.scene, fresh_state().scene)


def test_a_truncated_checkpoint_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "checkpoint.safetensors"
    save_checkpoint(file, fresh_state())
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(InputError, match="truncated or not a checkpoint"):
        load_checkpoint(file)
    with pytest.raises(FileNotFoundError, match="no checkpoint at"):
        load_checkpoint(tmp_path / "nothing")


def test_plane_entry_needs_annotated_views() -> None:
    dataset = tiny_capture()
    bare = replace(dataset, train=tuple(replace(view, read_pane_labels=None) for view in dataset.train))
    setup = PaneSetup(PlanarRecipe(glass_count=10), 0)
    with pytest.raises(ValueError, match=r"pane 1 is marked only in 0\.png, which are test photographs"):
        finished(setup(TrainState(Scene(gaussians_from_points(dataset.points), dataset.extent), 0), bare))


@pytest.mark.parametrize("name", ["primary.mean", "primry.means"])
def test_a_rate_of_no_parameter_is_refused(name: str) -> None:
    stages = tuple(replace(s, rates={**s.rates, name: Rate(1.0)}) for s in SplatRecipe().stages(seed=0))
    with pytest.raises(ValueError, match=f"has rates of {name}; expected some of primary.means, "):
        run(fresh_state(), stages, 5)
