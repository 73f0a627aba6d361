"""`splat` with discs: its initial discs, the weights of its terms over time, and its learning."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from glassplat.cli.main import main
from glassplat.files.scene_folder import read_scene
from glassplat.methods.glossy_recipes import TracedRecipe
from glassplat.methods.splat_recipe import DiscTerms, SplatRecipe
from glassplat.model.run_directory import RunDirectory
from glassplat.render.splat import Splat
from glassplat.training.loop import train
from glassplat.training.losses import disc_normal_consistency
from glassplat.training.messages import StepDone
from glassplat.training.stage import TrainState
from tests.cli.tiny_run import write_capture
from tests.training.progress_of import assert_resumes, trained
from tests.training.tiny_capture import tiny_capture

DISCS = SplatRecipe(primitive="disc", sh_degree=1)


def test_the_first_discs_are_as_large_as_the_first_spheres_and_turned_at_random() -> None:
    discs, spheres = (r.initialise(tiny_capture()).primary for r in (DISCS, replace(DISCS, primitive="ellipsoid")))
    assert discs.are_discs and not spheres.are_discs
    assert torch.equal(discs.log_scales, spheres.log_scales[:, :2])
    assert torch.equal(discs.means, spheres.means)
    normals = discs.quats[:, None] * discs.quats[None]
    assert float(normals.sum(-1).abs().mean()) < 0.6


def test_terms_count_from_their_share_of_the_run_on() -> None:
    stages = DISCS.stages(0)
    assert [stage.share for stage in stages] == pytest.approx([0.1, 4 / 30, 1 - 7 / 30])
    assert [len(stage.losses) for stage in stages] == [1, 2, 3]
    renderers = [stage.renderer for stage in stages]
    assert [isinstance(renderer, Splat) and renderer.normal for renderer in renderers] == [False, False, True]
    first = replace(DISCS, discs=DiscTerms(normal_start=0.0, distortion_weight=0.0)).stages(0)
    assert [stage.share for stage in first] == [1.0]
    assert first[0].losses[-1].function is disc_normal_consistency
    assert len(replace(DISCS, discs=DiscTerms(0.0, 0.1, 0.0, 0.2)).stages(0)) == 1
    assert len(replace(DISCS, primitive="ellipsoid").stages(0)) == 1


def test_discs_are_on_surfaces_before_distortion_counts() -> None:
    def starts(iterations: int) -> list[float]:
        stages = DISCS.stages(0, iterations)
        assert sum(stage.share for stage in stages) == pytest.approx(1)
        counts = [any(term.name == "distortion" for term in stage.losses) for stage in stages]
        return [sum(s.share for s in stages[:i]) * iterations for i, has in enumerate(counts) if has][:1]

    assert starts(300) == starts(400) == []
    assert [starts(n)[0] for n in (800, 2500, 3999)] == pytest.approx([400, 400, 400])
    assert DISCS.stages(0, 4000)[0].share == DISCS.stages(0)[0].share
    matte = TracedRecipe(primitive="disc").stages(0, 800)
    assert [stage.share for stage in matte] == pytest.approx([7 / 30, 0.5 - 7 / 30, 0.5])


def short(recipe: SplatRecipe) -> SplatRecipe:
    return replace(recipe, intervals=replace(recipe.intervals, opacity=8 / 60, least=2, sh=0.1))


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_a_short_run_learns(strategy: Any) -> None:
    recipe = short(replace(DISCS, strategy=strategy, densify=replace(DISCS.densify, interval=10, whole_passes=False)))
    state = TrainState(recipe.initialise(tiny_capture()), seed=0)
    messages = [m for m in train(recipe.stages(0), tiny_capture(), state, 60) if isinstance(m, StepDone)]
    losses = [message.losses["photometric"] for message in messages]
    assert len(losses) == state.step == 60
    assert all(torch.isfinite(tensor).all() for tensor in state.scene.parameters().values())
    assert state.scene.primary.are_discs
    assert sum(losses[6:12]) < sum(losses[:6])
    assert set(messages[-1].losses) >= {"photometric", "distortion", "normals"}


def test_resuming_discs_from_a_checkpoint_gives_the_same_result(tmp_path: Path) -> None:
    recipe, dataset = short(DISCS), tiny_capture()
    resumed = assert_resumes(
        lambda state, until: trained(state, recipe.stages(0), 30, until=until),
        lambda: TrainState(recipe.initialise(dataset), seed=0),
        17,
        tmp_path,
    )
    assert resumed.scene.primary.are_discs


def test_discs_are_trained_evaluated_and_rendered_from_the_command_line(tmp_path: Path) -> None:
    write_capture(tmp_path / "capture")
    run, output = tmp_path / "run", tmp_path / "layers"
    train_it = ["train", "splat", "--primitive", "disc", "--data", str(tmp_path / "capture"), "--output", str(run)]
    assert main([*train_it, "--iterations", "24"]) == 0
    assert RunDirectory(run).recipe().primitive == "disc"
    assert read_scene(next((run / "point_cloud").iterdir())).primary.are_discs
    layers = ["rgb", "normal", "depth", "median_depth", "alpha"]
    assert main(["render", str(run), "--output", str(output), "--layers", *layers]) == 0
    assert sorted(folder.name for folder in output.iterdir() if folder.is_dir()) == sorted(layers)
    assert main(["eval", str(run)]) == 0
