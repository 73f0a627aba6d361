"""The environment as data and as a part of a scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from glassplat.scene.scene import Environment, scale_scene
from glassplat.training.checkpoint import load_checkpoint, save_checkpoint
from glassplat.training.stage import TrainState
from tests.render.tiny_scene import in_single_precision, showcase


def noise(size: int = 3, seed: int = 0) -> Environment:
    return Environment.random(size, generator=torch.Generator().manual_seed(seed))


def test_noise_fills_its_range_and_follows_its_generator() -> None:
    raw = noise(16).raw
    assert raw.shape == (6, 16, 16, 3) and noise(16).size == 16 and not noise(16).is_empty
    assert -5 <= float(raw.min()) < -4.9 and 4.9 < float(raw.max()) <= 5
    assert torch.equal(raw, noise(16).raw) and not torch.equal(raw, noise(16, seed=1).raw)


def test_an_empty_environment_has_no_texels() -> None:
    assert Environment.empty().is_empty and Environment.empty().size == 0


@pytest.mark.parametrize("shape", [(6, 2, 3, 3), (5, 2, 2, 3), (6, 2, 2, 4), (6, 2, 2)])
def test_a_wrong_shape_is_named(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"raw has shape .*; expected \(6, S, S, 3\)"):
        Environment(torch.zeros(shape))


def test_other_bad_input_is_named() -> None:
    with pytest.raises(ValueError, match="size is 0"):
        noise(0)
    with pytest.raises(ValueError, match=r"unknown tensors \['texels'\]"):
        noise().with_tensors({"texels": noise().raw})


def test_a_scene_trains_its_environment_only_where_there_is_one() -> None:
    scene = showcase()
    assert "environment.raw" not in scene.parameters()
    lit = replace(scene, environment=noise())
    assert lit.parameters()["environment.raw"] is lit.environment.raw
    assert set(lit.parameters()) == {*scene.parameters(), "environment.raw"}
    changed = lit.with_parameters({"environment.raw": torch.zeros(6, 3, 3, 3)})
    assert float(changed.environment.raw.abs().max()) == 0
    assert changed.primary.means is lit.primary.means
    assert lit.to("meta").environment.raw.device.type == "meta"
    with pytest.raises(ValueError, match=r"'environment', 'exposures', .*'poses', 'primary'"):
        lit.with_parameters({"sky.raw": torch.zeros(1)})


def test_the_region_of_an_environment_has_the_units_of_the_scene() -> None:
    scene = replace(in_single_precision(showcase()), environment=replace(noise(), region=(1.0, -2.0, 0.5, 3.0)))
    assert scale_scene(scene, 2.0).environment.region == (2.0, -4.0, 1.0, 6.0)


def test_a_checkpoint_keeps_the_environment(tmp_path: Path) -> None:
    lit = replace(in_single_precision(showcase()), environment=noise())
    for scene in (lit, replace(lit, environment=Environment.empty())):
        save_checkpoint(tmp_path / "checkpoint.safetensors", TrainState(scene, seed=0))
        restored = load_checkpoint(tmp_path / "checkpoint.safetensors").scene
        assert torch.equal(restored.environment.raw, scene.environment.raw)
