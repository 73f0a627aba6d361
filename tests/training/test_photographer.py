"""The photographer is placed behind the camera once panes are known, learned, stored and restored."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from glassplat.captures.dataset import Dataset
from glassplat.captures.view import View
from glassplat.files.scene_folder import read_scene, write_scene
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.render.panes import nearest_hits, panes_in_camera
from glassplat.render.planar import Planar
from glassplat.render.splat import Splat
from glassplat.scene.panes import Planes
from glassplat.scene.scene import Scene
from glassplat.training.actions import Densify
from glassplat.training.checkpoint import load_checkpoint, save_checkpoint
from glassplat.training.corrections import AddPhotographer, distance_to_panes, initial_photographer
from glassplat.training.densify import ScreenStatistics
from glassplat.training.loop import train
from glassplat.training.messages import StepDone
from glassplat.training.options import Photographer
from glassplat.training.stage import Clock, Stage, TrainState, run_edit
from tests.render.test_photographer import body
from tests.render.tiny_scene import in_single_precision, joined, pane
from tests.training.progress_of import assert_resumes, trained
from tests.training.tiny_capture import tiny_capture, true_scene

LEARNED = Photographer(learn=True, count=60)
UP = (0.0, -1.0, 0.0)


MIRROR = pane(2.0, half=2.5, base_reflectance=0.9)


def half_of_corner(side: int) -> Planes:
    """A mirror left or right of the z axis, facing it."""
    return replace(
        pane(2.0, half=1.0, label=1 if side < 0 else 2, base_reflectance=0.9),
        centers=torch.tensor([[side * 1.0, 0.0, 2.0]], dtype=torch.float64),
        raw_normals=torch.tensor([[-side * 0.2, 0.05, -1.0]], dtype=torch.float64),
    )


CORNER = joined(half_of_corner(-1), half_of_corner(1))


def peopled_capture(planes: Planes = MIRROR) -> Dataset:
    """The capture with the photographer reflected in its panes."""
    scene, views = peopled_scene(planes), []
    for view in tiny_capture().train:
        with torch.no_grad():
            image = Planar(photographer="present")(scene, view.camera).rgb
        photo = (255 * image.clamp(0, 1)).to(torch.uint8)
        views.append(View.in_memory(view.name, view.camera, photo=photo, pane_labels=view.pane_labels))
    return replace(tiny_capture(), train=tuple(views))


def peopled_scene(planes: Planes = MIRROR) -> Scene:
    return in_single_precision(replace(true_scene(), planes=planes, photographer=body(), up=UP))


def begun(options: Photographer = LEARNED, scene: Scene | None = None) -> TrainState:
    state = TrainState(scene or true_scene(), 0)
    for _ in run_edit(AddPhotographer(options, 0, None)(state, tiny_capture())):
        pass
    return state


def test_the_first_cloud_is_behind_the_camera_within_reach_of_the_panes() -> None:
    cameras = [view.camera for view in tiny_capture().train]
    planes = true_scene().planes
    distance = distance_to_panes(planes, cameras)
    assert 2.3 < distance < 2.6
    cloud = initial_photographer(planes, cameras, count=300, sh_degree=0, seed=1)
    assert bool((cloud.means[:, 2] < 0).all())
    radii = cloud.means.norm(dim=1) / distance
    assert 0.02 < float(radii.min()) < 0.05 and 0.5 < float(radii.max()) <= 0.601
    again = initial_photographer(planes, cameras, count=300, sh_degree=0, seed=1)
    assert torch.equal(again.means, cloud.means)


def test_stages_with_panes_show_and_teach_the_photographer() -> None:
    stages = PlanarRecipe(photographer=LEARNED).stages(0)
    assert isinstance(stages[0].renderer, Splat) and not any("photographer" in name for name in stages[0].rates)
    for stage in stages[1:]:
        assert isinstance(stage.renderer, Planar) and stage.renderer.photographer == "present"
        assert "photographer.means" in stage.rates
        assert any(isinstance(action, Densify) and action.part == "photographer" for action in stage.actions)
    assert isinstance(stages[1].setup, AddPhotographer) and not isinstance(stages[2].setup, AddPhotographer)
    assert PlanarRecipe(photographer=LEARNED).renderer().photographer == "absent"


def test_no_photographer_is_stored_if_switched_off() -> None:
    for stage in PlanarRecipe().stages(0):
        assert not any("photographer" in name for name in stage.rates)
        assert not isinstance(stage.setup, AddPhotographer)
        assert not isinstance(stage.renderer, Planar) or stage.renderer.photographer == "absent"


def test_each_mirror_of_a_corner_shows_the_photographer() -> None:
    scene, shown = peopled_scene(CORNER), torch.zeros(2)
    for view in tiny_capture().train:
        present, absent = (Planar(photographer=mode)(scene, view.camera) for mode in ("present", "absent"))  # type: ignore[arg-type]
        differs = (present.rgb - absent.rgb).abs().amax(dim=-1) > 0.02
        pane_of_pixel = nearest_hits(panes_in_camera(scene.planes, view.camera), view.camera).pane
        shown += torch.stack([(differs & (pane_of_pixel == pane)).sum() for pane in range(2)])
    assert float(shown.min()) > 30


@pytest.mark.parametrize("planes", [MIRROR, CORNER])
def test_the_photographer_is_learned_from_the_photographs(planes: Planes) -> None:
    """With the true room and panes fixed, the cloud takes the shape of the photographer."""
    dataset, state = peopled_capture(planes), begun(scene=peopled_scene(planes))
    frozen = [
        replace(
            stage,
            rates={name: rate for name, rate in stage.rates.items() if name.startswith("photographer")},
            setup=None,
            actions=(),
            post_steps=(),
            losses=stage.losses[:1],
        )
        for stage in PlanarRecipe(photographer=LEARNED).stages(0)[2:]
    ]
    before, after = [], []
    for message in train(tuple(frozen), dataset, state, 180):
        loss = getattr(message, "loss", None)
        if loss is not None:
            (before if state.step <= 6 else after).append(loss)
    assert sum(after[-6:]) < 0.6 * sum(before)


def test_the_photographer_is_stored_with_the_scene_and_in_checkpoints(tmp_path: Path) -> None:
    state = TrainState(peopled_scene(), 0)
    write_scene(tmp_path / "scene", state.scene)
    save_checkpoint(tmp_path / "checkpoint.safetensors", state)
    for scene in (read_scene(tmp_path / "scene"), load_checkpoint(tmp_path / "checkpoint.safetensors").scene):
        assert scene.up == UP and scene.photographer.active_sh_degree == 0
        for name, tensor in state.scene.parameters().items():
            assert torch.equal(scene.parameters()[name], tensor), name


def test_a_removed_photographer_has_no_effect(tmp_path: Path) -> None:
    state = begun()
    faint = state.scene.photographer.with_tensors({"logit_opacities": torch.full((60,), -9.0)})
    state.scene = replace(state.scene, photographer=faint)
    moments = {name: (torch.zeros_like(t), torch.zeros_like(t)) for name, t in state.scene.parameters().items()}
    state.optimizer.moments, state.optimizer.updates = moments, dict.fromkeys(moments, 1)
    densify = Densify(PlanarRecipe().densify, part="photographer")
    state.statistics["photographer"] = ScreenStatistics.zeros(60)
    assert densify.apply(state, tiny_capture(), Clock(100, 1000, 6))
    assert len(state.scene.photographer) == 0 and not any("photographer" in name for name in state.optimizer.moments)
    assert not densify.apply(state, tiny_capture(), Clock(200, 1000, 6))
    save_checkpoint(tmp_path / "checkpoint.safetensors", state)
    assert len(load_checkpoint(tmp_path / "checkpoint.safetensors").scene.photographer) == 0


def planar_stages() -> tuple[Stage, ...]:
    """All three stages, with the true planes in place of fitted ones."""

    def place_true_planes(state: TrainState, dataset: Dataset) -> None:
        truth = true_scene()
        state.scene = replace(state.scene, planes=truth.planes, glass=truth.glass)

    densify = replace(PlanarRecipe().densify, interval=8, start=0.0, stop=1.0, whole_passes=False)
    densify = replace(densify, gradient_threshold=1e-8, absgrad_threshold=1e-8)
    recipe = PlanarRecipe(sh_degree=1, stage_shares=(0.2, 0.3, 0.5), photographer=LEARNED, densify=densify)
    return tuple(
        replace(s, setup=replace(s.setup, after=place_true_planes)) if isinstance(s.setup, AddPhotographer) else s
        for s in recipe.stages(seed=0)
    )


def test_a_run_that_was_interrupted_ends_as_one_that_was_not(tmp_path: Path) -> None:
    dataset, sizes, ups = peopled_capture(), set(), set()

    def run_until(state: TrainState, until: int | None) -> None:
        for message in trained(state, planar_stages(), 40, until=until, dataset=dataset):
            if isinstance(message, StepDone):
                sizes.add(message.counts.get("photographer", 0))
        ups.add(state.scene.up)

    assert_resumes(run_until, lambda: TrainState(SplatRecipe(sh_degree=1).initialise(dataset), 0), 21, tmp_path)
    assert len(sizes) > 2  # Zero, the first cloud, and the sizes after densification.
    assert len(ups) == 1 and None not in ups
