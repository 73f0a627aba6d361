"""Panes that may be tinted start clear, learn their transmittance, and keep it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch

from glassplat.captures.dataset import Dataset
from glassplat.captures.view import View
from glassplat.files.scene_folder import read_scene, write_scene
from glassplat.methods.planar import PaneSetup
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.render.planar import Planar
from glassplat.scene.scene import Scene
from glassplat.training.loop import train
from glassplat.training.stage import Clock, Stage, TrainState
from tests.render.tiny_scene import in_single_precision, pane, showcase
from tests.training.tiny_capture import tiny_capture

TRUTH = (0.6, 0.9, 0.7)
GLASS = replace(pane(2.0, half=0.8), log_transmittances=torch.tensor([TRUTH], dtype=torch.float64).log())


@cache
def captured(*, tinted: bool) -> Dataset:
    """The tiny capture through tinted or clear glass, rounded without clipping, as the scene is dark."""
    planes = GLASS if tinted else replace(GLASS, log_transmittances=None)
    scene, views = in_single_precision(showcase(planes)), []
    for view in tiny_capture().train:
        with torch.no_grad():
            photo = (255 * Planar()(scene, view.camera).rgb.clamp(0, 1)).round().to(torch.uint8)
        views.append(View.in_memory(view.name, view.camera, photo=photo, pane_labels=view.pane_labels))
    return replace(tiny_capture(), train=tuple(views))


def panes_alone(stage: Stage) -> Stage:
    """A stage in which only the tint of the panes learns, from the photographs."""
    rates = {"planes.log_transmittances": replace(stage.rates["planes.log_transmittances"], start=0.02)}
    losses = tuple(term for term in stage.losses if term.name in ("photometric", "tint"))
    return replace(stage, rates=rates, losses=losses, setup=None, actions=(), post_steps=stage.post_steps[:1])


def clear_state() -> TrainState:
    scene = in_single_precision(showcase(replace(GLASS, log_transmittances=None)))
    return TrainState(replace(scene, planes=scene.planes.that_may_tint()), 0)


def transmittances(scene: Scene) -> torch.Tensor:
    found = scene.planes.transmittances
    assert found is not None
    return found


def test_the_colour_is_found_where_the_rest_is_known(tmp_path: Path) -> None:
    state = clear_state()
    stage = panes_alone(PlanarRecipe(tint=True, tint_weight=0.0).stages(0)[-1])
    for _ in train((stage,), captured(tinted=True), state, 120):
        pass
    torch.testing.assert_close(transmittances(state.scene)[0], torch.tensor(TRUTH), atol=0.05, rtol=0)
    write_scene(tmp_path / "scene", state.scene)
    assert torch.equal(transmittances(read_scene(tmp_path / "scene")), transmittances(state.scene))


def test_clear_glass_stays_clear() -> None:
    state = clear_state()
    stage = panes_alone(PlanarRecipe(tint=True).stages(0)[-1])
    for _ in train((stage,), captured(tinted=False), state, 60):
        pass
    found = transmittances(state.scene)
    assert float(found.min()) > 0.98 and float(found.max()) <= 1


def test_glass_adds_no_light() -> None:
    """Photographs brighter than the scene leave the glass clear, and free to darken again."""
    state = clear_state()
    planes = replace(state.scene.planes, log_transmittances=torch.tensor([[0.3, -0.3, 0.0]]))
    state.scene = replace(state.scene, planes=planes)
    (post_step,) = panes_alone(PlanarRecipe(tint=True).stages(0)[-1]).post_steps
    post_step(state, Clock(1, 10, 6), None)
    kept = state.scene.planes.log_transmittances
    assert kept is not None and kept.tolist() == [[0.0, pytest.approx(-0.3), 0.0]]


def test_only_recipes_with_tint_learn_it() -> None:
    for recipe in (PlanarRecipe(), PlanarRecipe(tint=True)):
        stages = recipe.stages(0)
        entries = [stage.setup for stage in stages if isinstance(stage.setup, PaneSetup)]
        assert [setup.recipe.tint for setup in entries] == [recipe.tint]
        assert any(term.name == "tint" for stage in stages for term in stage.losses) == recipe.tint
