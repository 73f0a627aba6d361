"""Exposures are learned with the scene, stored with it, and restored."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from glassplat.captures.dataset import Dataset
from glassplat.captures.view import View
from glassplat.files.scene_folder import read_scene, write_scene
from glassplat.methods.recipe import RECIPES
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.training.checkpoint import load_checkpoint, save_checkpoint
from glassplat.training.corrections import Center, with_neutral_corrections
from glassplat.training.loop import train
from glassplat.training.options import PhotoExposure
from glassplat.training.stage import TrainState
from tests.training.tiny_capture import tiny_capture, true_scene

LEARNED, OFF = PhotoExposure(rate=0.003), PhotoExposure(rate=0)
CAPTURE = replace(tiny_capture(), measured_points=False)
"""With random points no plane is fitted before training."""


def darkened(dataset: Dataset) -> Dataset:
    """The capture with every other photograph darker, and those in between brighter by the same amount."""
    views = [
        View.in_memory(v.name, v.camera, photo=(v.photo * (0.7 if index % 2 else 1.3)).clamp(max=255).to(torch.uint8))
        for index, v in enumerate(dataset.train)
    ]
    return replace(dataset, train=tuple(views))


def trained(recipe: SplatRecipe, steps: int = 240) -> TrainState:
    dataset = darkened(tiny_capture())
    scene = with_neutral_corrections(recipe, replace(true_scene(), planes=type(true_scene().planes).empty()), dataset)
    state = TrainState(scene, 0)
    frozen = tuple(
        replace(
            stage,
            rates={n: r for n, r in stage.rates.items() if n.startswith("exposures")},
            actions=(),
            post_steps=tuple(post_step for post_step in stage.post_steps if post_step == Center("exposures")),
        )
        for stage in recipe.stages(0)
    )
    for _ in train(frozen, dataset, state, steps):
        pass
    return state


def test_dark_photographs_are_distinguished_from_bright_ones() -> None:
    affine = trained(SplatRecipe(exposure=LEARNED)).scene.exposures.values
    brightness = affine[:, :, :3].sum(dim=(1, 2)) / 3
    assert bool((brightness[1::2] < brightness[::2] - 0.2).all())


def test_the_common_exposure_is_left_to_the_scene() -> None:
    affine = trained(SplatRecipe(exposure=LEARNED)).scene.exposures.values
    assert float(affine.abs().max()) > 0.05
    assert float(affine.mean(dim=0).abs().max()) < 1e-6


@pytest.mark.parametrize("method", RECIPES)
@pytest.mark.parametrize("iterations", [3000, 30_000])
def test_every_stage_of_every_method_learns_them(method: str, iterations: int) -> None:
    recipe = RECIPES[method](exposure=LEARNED)
    stages = recipe.stages(0, iterations)
    assert all("exposures.affine" in stage.rates for stage in stages)
    assert all(stage.post_steps[0] == Center("exposures") for stage in stages)
    assert recipe.initialise(CAPTURE).exposures.names == tuple(v.name for v in CAPTURE.train)


@pytest.mark.parametrize("method", RECIPES)
@pytest.mark.parametrize("iterations", [3000, 30_000])
def test_no_corrections_are_stored_if_switched_off(method: str, iterations: int) -> None:
    recipe = RECIPES[method](exposure=OFF)
    assert not any("exposures.affine" in stage.rates for stage in recipe.stages(0, iterations))
    assert len(recipe.initialise(CAPTURE).exposures) == 0


def test_they_are_stored_with_the_scene_and_in_checkpoints(tmp_path: Path) -> None:
    state = trained(SplatRecipe(exposure=LEARNED), steps=12)
    write_scene(tmp_path / "scene", state.scene)
    assert torch.equal(read_scene(tmp_path / "scene").exposures.values, state.scene.exposures.values)
    save_checkpoint(tmp_path / "checkpoint.safetensors", state)
    restored = load_checkpoint(tmp_path / "checkpoint.safetensors").scene.exposures
    assert restored.names == state.scene.exposures.names
    assert torch.equal(restored.values, state.scene.exposures.values)
