"""A whole run: interrupted, resumed, and the files it leaves."""

from __future__ import annotations

import json
import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from glassplat.data.dataset import load_dataset
from glassplat.data.errors import InputError
from glassplat.train.checkpoint import load_checkpoint, recorded_seconds, save_checkpoint
from glassplat.train.messages import Message, StepDone
from glassplat.train.planar_recipe import PlanarRecipe, ReflectionWeights
from glassplat.train.recipe import recipe_from_json, recipe_to_json
from glassplat.train.run import run_training
from glassplat.train.run_directory import RunDirectory, RunSettings
from glassplat.train.splat_recipe import SplatRecipe
from tests.train.tiny_capture import tiny_capture, write_tiny_capture

SETTINGS = RunSettings("tiny", iterations=12)
RECIPE = SplatRecipe(sh_degree=1)


def run(
    path: Path, *, resume: bool = False, interrupt_at: int | None = None, by: signal.Signals = signal.SIGINT
) -> Any:
    def listen(message: Message) -> None:
        if isinstance(message, StepDone) and message.step == interrupt_at:
            signal.raise_signal(by)

    return run_training(RECIPE, SETTINGS, RunDirectory(path), tiny_capture(), resume=resume, listen=listen)


@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_resumes_to_the_same_scene(tmp_path: Path, by: signal.Signals) -> None:
    before = signal.getsignal(by)
    whole = run(tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "stopped", interrupt_at=5, by=by)
    assert load_checkpoint(RunDirectory(tmp_path / "stopped").checkpoint).step == 5
    resumed = run(tmp_path / "stopped", resume=True)
    for name, tensor in whole.scene.parameters().items():
        assert torch.equal(tensor, resumed.scene.parameters()[name]), name
    assert signal.getsignal(by) is before


def test_the_log_has_every_tenth_step_once(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, interrupt_at=11)
    run(tmp_path, resume=True)
    lines = [json.loads(line) for line in RunDirectory(tmp_path).log.read_text().splitlines()]
    assert [line["step"] for line in lines if line["message"] == "StepDone"] == [10]


def test_the_training_time_is_read_without_the_tensors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    state = run(tmp_path)
    monkeypatch.setattr("glassplat.train.checkpoint.restored_state", None)
    assert recorded_seconds(RunDirectory(tmp_path).checkpoint) == state.seconds > 0


@pytest.mark.parametrize("content", [b"", b"no checkpoint at all"])
def test_the_time_of_a_broken_checkpoint_is_not_guessed(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "broken").write_bytes(content)
    with pytest.raises(InputError, match="truncated or not a checkpoint"):
        recorded_seconds(tmp_path / "broken")


def test_the_exported_scene_is_the_trained_one(tmp_path: Path) -> None:
    state = run(tmp_path)
    scene, iterations = RunDirectory(tmp_path).latest_scene()
    assert iterations == 12
    assert scene.extent == state.scene.extent
    for name, tensor in state.scene.primary.tensors().items():
        assert torch.equal(tensor, scene.primary.tensors()[name]), name


def test_a_broken_test_photograph_ends_a_run_at_the_start(tmp_path: Path) -> None:
    dataset = load_dataset(write_tiny_capture(tmp_path / "capture"))
    path = dataset.test[0].image_path
    os.truncate(path, path.stat().st_size // 2)

    def listen(message: Message) -> None:
        assert message.step < 2000, "the photograph was not found"

    with pytest.raises(InputError, match=path.name):
        run_training(
            RECIPE, RunSettings("", 10**6), RunDirectory(tmp_path / "run"), dataset, resume=False, listen=listen
        )


def test_the_checkpoint_of_another_method_is_not_gone_on_with(tmp_path: Path) -> None:
    run(tmp_path)
    state = load_checkpoint(RunDirectory(tmp_path).checkpoint)
    for changed, message in (
        (replace(state, method="planar"), "is a checkpoint of planar; expected one of splat"),
        (replace(state, step=13), "is of step 13; expected one of at most 12"),
        (replace(state, seed=1), "is of a run with the seed 1; expected 0"),
    ):
        save_checkpoint(RunDirectory(tmp_path).checkpoint, changed)
        with pytest.raises(InputError, match=message):
            run(tmp_path, resume=True)


@pytest.mark.parametrize(
    "recipe", [RECIPE, PlanarRecipe(fresnel="none", weights=ReflectionWeights(depth=0.0), background=(1.0, 1.0, 1.0))]
)
def test_a_recipe_survives_its_file(recipe: Any) -> None:
    assert recipe_from_json(recipe_to_json(recipe)) == recipe
    assert recipe_from_json(recipe_to_json(recipe)) != replace(recipe, sh_degree=0)


def test_a_recipe_with_a_choice_that_there_is_no_more_is_refused() -> None:
    text = recipe_to_json(PlanarRecipe()).replace('"fresnel": "pane"', '"fresnel": true')
    with pytest.raises(InputError, match="fresnel is True; expected one of pane, schlick, none"):
        recipe_from_json(text)
