"""Training from Python: message by message, in memory and in a run's directory."""

from __future__ import annotations

import math
import os
import signal
import threading
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import glassplat
from glassplat import Frame, InputError, LossTerm, Scene, SplatRecipe, Stage, StageEntered, StepDone, Training, View
from glassplat.captures.dataset import load_dataset
from glassplat.methods.glossy_recipes import DeferredRecipe, TracedRecipe
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.panes import PlaneFitError
from glassplat.training.messages import Message
from tests.training.tiny_capture import tiny_capture, write_tiny_capture

RECIPE = SplatRecipe(sh_degree=1)


def steps(training: Training) -> list[int]:
    return [message.step for message in training if isinstance(message, StepDone)]


def test_a_training_in_memory_can_be_viewed_and_continued() -> None:
    training = Training(tiny_capture(), RECIPE, iterations=6, device="cpu")
    assert training.step == 0
    with pytest.raises(RuntimeError, match="has not started"):
        _ = training.model
    images = []
    for message in training:
        if isinstance(message, StepDone):
            images.append(training.model.image("2.png"))
            if message.step == 3:
                break
    assert not torch.equal(images[0], images[2])
    assert (training.step, steps(training), training.step) == (3, [4, 5, 6], 6)
    with pytest.raises(RuntimeError, match="no output"):
        training.save()


def test_the_same_run_in_memory_and_in_a_directory(tmp_path: Path) -> None:
    inside = Training(tiny_capture(), RECIPE, iterations=5, device="cpu").run()
    heard: list[object] = []
    outside = Training(tiny_capture(), RECIPE, iterations=5, device="cpu", output=tmp_path / "run").run(heard.append)
    assert torch.equal(inside.scene.primary.means, outside.scene.primary.means)
    assert torch.equal(glassplat.load(tmp_path / "run", device="cpu").image("2.png"), outside.image("2.png"))
    assert [type(message).__name__ for message in heard[:3]] == ["Working", "RunBegun", "StageEntered"]


def test_iteration_can_continue_after_a_break(tmp_path: Path) -> None:
    def training(**options: bool) -> Training:
        return Training(tiny_capture(), RECIPE, iterations=6, device="cpu", output=tmp_path / "run", **options)

    begun = training()
    for message in begun:
        if isinstance(message, StepDone) and message.step == 2:
            break
    assert steps(training(resume=True)) == [3, 4, 5, 6]
    whole = Training(tiny_capture(), RECIPE, iterations=6, device="cpu").run()
    assert torch.equal(glassplat.load(tmp_path / "run", device="cpu").scene.primary.means, whole.scene.primary.means)
    with pytest.raises(InputError, match="already holds a run"):
        training()


PANES = PlanarRecipe(sh_degree=1, stage_shares=(0.4, 0.2, 0.4), detect_mirrors=False, seed_reflections=False)
SETUPS = {
    "planar": PANES,
    "deferred": DeferredRecipe(sh_degree=1, least_iterations=1, texels=4, first_texels=2, bootstrap=0.4),
    "traced": TracedRecipe(sh_degree=1, least_iterations=1, texels=4, first_texels=2, bootstrap=0.4),
}


@pytest.mark.parametrize("recipe", SETUPS.values(), ids=SETUPS)
def test_iteration_can_continue_after_a_break_at_a_stage(recipe: Any, tmp_path: Path) -> None:
    """Results of the stage's setup are in the checkpoint and are not computed a second time."""
    dataset = load_dataset(write_tiny_capture(tmp_path / "capture"))

    def training(**options: Any) -> Training:
        return Training(dataset, recipe, iterations=10, device="cpu", **options)

    for message in training(output=tmp_path / "run"):
        if isinstance(message, StageEntered) and message.step == 4:
            break
    resumed = training(output=tmp_path / "run", resume=True)
    assert steps(resumed) == [5, 6, 7, 8, 9, 10]
    found, whole = resumed.model.scene.parameters(), training().run().scene.parameters()
    assert found.keys() == whole.keys()
    assert all(torch.equal(tensor, whole[name]) for name, tensor in found.items())


def test_a_pane_marked_after_the_plane_fit_is_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    dataset = load_dataset(write_tiny_capture(tmp_path / "capture"))
    options: Any = {"iterations": 10, "device": "cpu", "output": tmp_path / "run"}
    for message in Training(dataset, PANES, **options):
        if isinstance(message, StageEntered) and message.step == 4:
            break
    assert "was marked" not in caplog.text
    next(iter(Training(replace(dataset, pane_labels=(1, 2)), PANES, resume=True, **options)))
    assert "fitted before pane 2 was marked" in caplog.text


def test_masks_without_a_plane_end_training_with_a_checkpoint(tmp_path: Path) -> None:
    dataset = replace(load_dataset(write_tiny_capture(tmp_path / "capture")), measured_points=False)

    def elsewhere(number: int) -> Tensor:
        labels = torch.zeros(dataset.train[0].photo.shape[:2], dtype=torch.uint8)
        labels[4 * number : 4 * number + 6, 7 * number : 7 * number + 6] = 1
        return labels

    views = tuple(replace(v, read_pane_labels=partial(elsewhere, i)) for i, v in enumerate(dataset.train))
    broken = replace(dataset, train=views)
    options: Any = {"iterations": 10, "device": "cpu", "output": tmp_path / "run"}
    with pytest.raises(PlaneFitError, match="no plane brings its masks together"):
        Training(broken, PANES, **options).run()
    resumed = Training(dataset, PANES, resume=True, **options)
    assert steps(resumed) == [5, 6, 7, 8, 9, 10]
    whole = Training(dataset, PANES, iterations=10, device="cpu").run()
    assert torch.equal(resumed.model.scene.primary.means, whole.scene.primary.means)


def test_a_resumed_training_can_be_stopped_and_resumed_again(tmp_path: Path) -> None:
    def training(**options: bool) -> Training:
        return Training(tiny_capture(), RECIPE, iterations=6, device="cpu", output=tmp_path / "run", **options)

    for message in training():
        if isinstance(message, StepDone) and message.step == 2:
            break
    resumed = training(resume=True)
    for message in resumed:
        if isinstance(message, StepDone) and message.step == 4:
            break
    assert steps(resumed) == [5, 6] and steps(resumed) == []
    whole = Training(tiny_capture(), RECIPE, iterations=6, device="cpu").run()
    assert torch.equal(resumed.model.scene.primary.means, whole.scene.primary.means)


def test_a_listener_that_fails_at_the_start_of_a_stage_loses_no_progress(tmp_path: Path) -> None:
    def listen(message: Message) -> None:
        if isinstance(message, StageEntered):
            raise ConnectionError("nobody listens")

    with pytest.raises(ConnectionError):
        Training(tiny_capture(), RECIPE, iterations=6, device="cpu", output=tmp_path / "run").run(listen)
    resumed = Training(tiny_capture(), RECIPE, iterations=6, device="cpu", output=tmp_path / "run", resume=True)
    assert steps(resumed) == [1, 2, 3, 4, 5, 6]


def test_a_scene_is_saved_in_the_middle_of_a_run(tmp_path: Path) -> None:
    training = Training(tiny_capture(), RECIPE, iterations=4, device="cpu", output=tmp_path / "run")
    for message in training:
        if isinstance(message, StepDone) and message.step == 2:
            training.save()
            saved = glassplat.load(tmp_path / "run", device="cpu")
            assert torch.equal(saved.scene.primary.means, training.model.scene.primary.means)
    assert (tmp_path / "run" / "point_cloud" / "iteration_4").is_dir()


@pytest.mark.skipif(os.name == "nt", reason="Windows moves no folder in which a file is open")
@pytest.mark.parametrize("checkpoint_every", [1e-3, math.inf])
def test_a_directory_that_was_moved_away_meanwhile_is_a_run_again(checkpoint_every: float, tmp_path: Path) -> None:
    output = tmp_path / "run"
    options: Any = {"iterations": 4, "device": "cpu", "output": output}
    training = Training(tiny_capture(), RECIPE, **options, checkpoint_every=checkpoint_every)
    for message in training:
        if isinstance(message, StepDone) and message.step == 2:
            output.rename(tmp_path / "elsewhere")
    assert glassplat.load(output, device="cpu").recipe == training.recipe
    assert steps(Training(tiny_capture(), RECIPE, **options, resume=True)) == []


@dataclass(frozen=True)
class Brighter(SplatRecipe):
    """A recipe with one additional loss term."""

    def stages(self, seed: int, iterations: int = 30_000) -> tuple[Stage, ...]:
        term = LossTerm("brightness", 10.0, brightness)
        return tuple(replace(stage, losses=(*stage.losses, term)) for stage in super().stages(seed, iterations))


def brightness(frame: Frame, view: View, scene: Scene) -> torch.Tensor:
    return (1 - frame.rgb).square().mean()


@pytest.mark.parametrize("given", [lambda rgb: 0.5, lambda rgb: rgb, lambda rgb: rgb.mean()[None]])
def test_an_invalid_loss_term_is_named(given: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(globals(), "brightness", lambda frame, view, scene: given(frame.rgb))
    with pytest.raises(
        ValueError, match=r"the loss term 'brightness' gave .*; expected a tensor of one number, or None"
    ):
        list(Training(tiny_capture(), Brighter(), iterations=4, device="cpu"))


def test_a_custom_recipe_is_trained() -> None:
    losses = []
    for message in Training(tiny_capture(), Brighter(), iterations=4, device="cpu"):
        if isinstance(message, StepDone):
            losses.append(message.losses)
    assert all("brightness" in terms for terms in losses)
    assert losses[-1]["brightness"] < losses[0]["brightness"]


def test_a_loss_term_with_a_duplicate_name_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Brighter, "stages", lambda self, seed, iterations: twice(SplatRecipe.stages(self, seed)))
    with pytest.raises(ValueError, match=r"loss terms .*; expected another name for each"):
        Training(tiny_capture(), Brighter(), iterations=4, device="cpu")


def twice(stages: tuple[Stage, ...]) -> tuple[Stage, ...]:
    return tuple(replace(stage, losses=(*stage.losses, *stage.losses)) for stage in stages)


def test_untrainable_input_is_refused_at_once(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="dataset is 'captures/shop'; expected what"):
        Training("captures/shop", "splat")
    with pytest.raises(InputError, match="there is no method 'nerf'; expected splat, planar"):
        Training(tiny_capture(), "nerf")
    with pytest.raises(InputError, match="no training views"):
        Training(replace(tiny_capture(), train=()), "splat")
    for nothing in (SplatRecipe, None, {"sh_degree": 1}):
        with pytest.raises(InputError, match=r"recipe is .*; expected a method's name, or a recipe such as"):
            Training(tiny_capture(), nothing)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="expected at least"):
        Training(tiny_capture(), "planar", iterations=2)
    for wrong in (SplatRecipe(strategy="foo"), SplatRecipe(ssim_weight=-3.0)):  # type: ignore[arg-type]
        with pytest.raises(InputError, match=r"(strategy is 'foo'|ssim_weight is -3\.0); expected"):
            Training(tiny_capture(), wrong)
    with pytest.raises(InputError, match=r"iterations is 20\.5; expected"):
        Training(tiny_capture(), "splat", iterations=20.5)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="needs the output"):
        Training(tiny_capture(), "splat", resume=True)
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError):
        Training(tiny_capture(), "splat", output=tmp_path / "file")


@pytest.mark.parametrize("switched_off", [torch.no_grad, torch.inference_mode])
def test_a_training_learns_where_gradients_are_switched_off(switched_off: Any) -> None:
    dataset = replace(tiny_capture(), train=tuple(replace(view) for view in tiny_capture().train))
    whole = Training(tiny_capture(), RECIPE, iterations=4, device="cpu").run()
    with switched_off():
        for message in (training := Training(dataset, RECIPE, iterations=4, device="cpu")):
            assert not torch.is_grad_enabled()
            if isinstance(message, StepDone):
                assert torch.isfinite(training.model.image("2.png")).all()
    assert torch.equal(training.model.scene.primary.means, whole.scene.primary.means)
    training.model.render("2.png").rgb.mean()
    assert not training.model.scene.primary.means.is_inference()


def test_photographs_first_used_without_gradients_can_be_trained_on(tmp_path: Path) -> None:
    dataset = load_dataset(write_tiny_capture(tmp_path / "capture"))
    with torch.inference_mode():
        assert all(float(view.photo.float().mean()) > 0 for view in dataset.train)
    assert steps(Training(dataset, RECIPE, iterations=2, device="cpu")) == [1, 2]


@pytest.mark.parametrize("recipe", [RECIPE, *SETUPS.values()], ids=["splat", *SETUPS])
def test_the_precision_that_tensors_have_by_default_changes_nothing(recipe: Any, tmp_path: Path) -> None:
    capture = write_tiny_capture(tmp_path / "capture")

    def found(folder: Path) -> tuple[dict[str, Tensor], Tensor]:
        model = Training(load_dataset(capture), recipe, iterations=10, device="cpu").run()
        model.save(folder)
        return glassplat.load(folder, device="cpu").scene.parameters(), model.image("2.png")

    usual, picture = found(tmp_path / "single")
    torch.set_default_dtype(torch.float64)
    try:
        other, same = found(tmp_path / "double")
    finally:
        torch.set_default_dtype(torch.float32)
    assert torch.equal(picture, same) and usual.keys() == other.keys()
    assert all(torch.equal(tensor, other[name]) for name, tensor in usual.items())


@dataclass(frozen=True)
class Weighted(SplatRecipe):
    """A recipe with an additional option."""

    brightness: float = 10.0


def test_a_run_of_a_custom_recipe_is_resumed_and_loaded(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    def training(recipe: Any, **options: bool) -> Training:
        return Training(tiny_capture(), recipe, iterations=4, device="cpu", output=tmp_path / "run", **options)

    for message in training(Weighted(sh_degree=1)):
        if isinstance(message, StepDone):
            break
    for other, changed in (
        (RECIPE, r"recipe was Weighted and is SplatRecipe, brightness was 10\.0 and is unknown"),
        (Weighted(sh_degree=1, brightness=2.0), r"brightness was 10\.0 and is 2\.0"),
    ):
        with pytest.raises(InputError, match=f"options: .*{changed}"):
            training(other, resume=True).run()
    trained = training(Weighted(sh_degree=1), resume=True).run()
    loaded = glassplat.load(tmp_path / "run", device="cpu")
    assert torch.equal(loaded.image("2.png"), trained.image("2.png")) and type(loaded.recipe) is SplatRecipe
    assert "of a custom recipe, 'Weighted'; read as SplatRecipe" in caplog.text


def test_running_a_finished_training_again_keeps_its_scene(tmp_path: Path) -> None:
    training = Training(tiny_capture(), RECIPE, iterations=4, device="cpu", output=tmp_path / "run")
    first = training.run().scene.primary.means.clone()
    assert torch.equal(training.run().scene.primary.means, first) and training.step == 4
    other = Training(tiny_capture(), RECIPE, iterations=4, device="cpu", output=tmp_path / "taken")
    Training(tiny_capture(), RECIPE, iterations=4, device="cpu", output=tmp_path / "taken").run()
    with pytest.raises(InputError, match="already holds a run"):
        other.run()
    assert other.step == 0


def test_alternating_trainings_restore_signal_handlers(tmp_path: Path) -> None:
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    runs = [Training(tiny_capture(), RECIPE, iterations=6, device="cpu", output=tmp_path / name) for name in "ab"]
    first, second = (iter(training) for training in runs)
    for _ in range(6):
        next(first), next(second)
    os.kill(os.getpid(), signal.SIGTERM)  # Both receive the request, and end after their step.
    assert all(training.is_stopping for training in runs)
    for messages, training in zip((first, second), runs, strict=True):
        with pytest.raises(SystemExit if callable(before[1]) else KeyboardInterrupt):
            list(messages)
        assert 0 < training.step < 6 and (tmp_path / "a" / "checkpoint.safetensors").is_file()
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


def test_a_training_that_ends_in_another_thread_leaves_signals_to_the_next(tmp_path: Path) -> None:
    messages = iter(Training(tiny_capture(), RECIPE, iterations=6, device="cpu", output=tmp_path / "run"))
    for _ in range(6):
        next(messages)
    (closing := threading.Thread(target=messages.close)).start()
    closing.join()
    with pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
