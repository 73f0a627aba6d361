"""The `traced` recipe: its stages, initialisation, growth and pruning of surroundings, a short run, and resuming."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import pytest
import torch

from glassplat.methods.glossy_recipes import TracedRecipe
from glassplat.methods.mirrors import GrowShAfterPropagation, Propagate, RefineEnvironment
from glassplat.methods.recipe import recipe_from_json, recipe_to_json
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.methods.surroundings import add_surroundings
from glassplat.render.traced import Traced, mirrored_contributions
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Environment, Scene
from glassplat.training.actions import Densify, GrowSh, PruneIdle, ResetOpacity, SeedUnexplained
from glassplat.training.checkpoint import load_checkpoint, save_checkpoint
from glassplat.training.densify import ScreenStatistics
from glassplat.training.loop import differentiate, train
from glassplat.training.messages import ActionDone, Message, StageEntered, StepDone
from glassplat.training.options import (
    DefaultDensify,
    Intervals,
    MirrorSearch,
    PropagationSchedule,
    SurroundingsOptions,
    SurroundingsStart,
)
from glassplat.training.stage import Clock, Every, Stage, TrainState, stage_starts
from tests.training.progress_of import assert_resumes, finished, trained
from tests.training.tiny_capture import tiny_capture

RECIPE = TracedRecipe(
    sh_degree=1,
    least_strength=0.0,
    least_iterations=1,
    first_strength=0.3,
    search=MirrorSearch(begin_found=False, spread=1.0),
    bootstrap=0.2,
    surroundings=SurroundingsOptions(
        start=SurroundingsStart("both", cells=2),
        densify=DefaultDensify(split_by="gradient", interval=5, whole_passes=False, stop=0.6, gradient_threshold=1e-7),
    ),
    texels=4,
    first_texels=2,
    region=(0.0, 0.0, 3.5, 1.0),
    intervals=Intervals(opacity=0.1, least=2, sh=0.1),
    schedule=PropagationSchedule(end="fixed", stop=0.7, pause=2),
)
PAPER = replace(RECIPE, mirrors="surroundings")


def fresh_state(recipe: TracedRecipe = RECIPE) -> TrainState:
    return TrainState(recipe.initialise(tiny_capture()), seed=0)


def surrounded_state(start: SurroundingsStart | None = None) -> TrainState:
    """A state with surroundings, as at the start of their stage but without the preceding training."""
    state = fresh_state()
    matte = torch.ones(len(state.scene.primary), dtype=torch.bool)
    add_surroundings(SurroundingsOptions(start or RECIPE.surroundings.start), state, tiny_capture(), matte)
    return state


def run(recipe: TracedRecipe, state: TrainState, iterations: int = 40) -> list[Message]:
    return list(train(recipe.stages(seed=0), tiny_capture(), state, iterations))


def losses(messages: Sequence[Message]) -> list[float]:
    return [m.losses["photometric"] for m in messages if isinstance(m, StepDone)]


DISCS = replace(RECIPE, primitive="disc")
EVERY = [RECIPE, PAPER, replace(RECIPE, mirrors="environment"), DISCS, replace(DISCS, mirrors="environment")]


@pytest.mark.parametrize("recipe", EVERY, ids=lambda recipe: f"{recipe.mirrors} {recipe.primitive}")
def test_a_short_run_learns(recipe: TracedRecipe) -> None:
    state = fresh_state(recipe)
    found = losses(run(recipe, state))
    assert len(found) == 40 and sum(found[6:8]) < sum(found[:2])
    assert all(torch.isfinite(tensor).all() for tensor in state.scene.parameters().values())
    assert bool(len(state.scene.surroundings)) == (recipe.mirrors != "environment")
    assert state.scene.environment.is_empty == (recipe.mirrors == "surroundings")
    recipe.renderer().check(state.scene)
    assert {len(part) and part.are_discs for part in (state.scene.primary, state.scene.surroundings)} <= {
        0,
        recipe.primitive == "disc",
    }


def test_near_and_distant_reflections_start_at_the_same_step() -> None:
    messages = run(RECIPE, fresh_state())
    entered = {m.stage: m.counts.get("surroundings", 0) for m in messages if isinstance(m, StageEntered)}
    assert list(entered) == ["1 bootstrap", "2 reflection", "3 refinement"]
    assert entered["1 bootstrap"] == 0 < entered["2 reflection"]
    assert all(isinstance(stage.renderer, Traced) for stage in RECIPE.stages(0)[1:])
    assert sum(stage.share for stage in RECIPE.stages(0)) == pytest.approx(1)


def test_surroundings_alone_need_no_refinement_of_an_environment() -> None:
    actions = [action for stage in PAPER.stages(0) for action in stage.actions]
    assert not any(isinstance(action, RefineEnvironment) for action in actions)
    (propagate,) = [action for action in PAPER.stages(0)[1].actions if isinstance(action, Propagate)]
    assert isinstance(propagate.renderer, Traced)


def test_only_what_is_in_the_region_may_reflect_without_an_environment_too(tmp_path: Path) -> None:
    state = fresh_state(PAPER)
    steps = [message for message in run(PAPER, state) if isinstance(message, StepDone)]
    assert PAPER.outside_weight > 0 and "outside" in steps[-1].losses
    assert state.scene.environment.is_empty and state.scene.environment.region == PAPER.region
    save_checkpoint(tmp_path / "checkpoint.safetensors", state)
    assert load_checkpoint(tmp_path / "checkpoint.safetensors").scene.environment.region == PAPER.region


def test_surroundings_learn_grow_and_are_pruned() -> None:
    state = fresh_state()
    messages = run(RECIPE, state)
    done = [m.action for m in messages if isinstance(m, ActionDone)]
    assert {"densify surroundings", "propagate normals", "prune idle surroundings"} <= set(done)
    steps = [m for m in messages if isinstance(m, StepDone)]
    counts = [m.counts["surroundings"] for m in steps if "surroundings" in m.counts]
    assert max(counts) > counts[0] and min(counts) < max(counts)
    assert bool(state.scene.surroundings.sh[:, 0].any())


def test_a_resumed_run_ends_in_the_same_scene(tmp_path: Path) -> None:
    def run_until(state: TrainState, until: int | None) -> None:
        trained(state, RECIPE.stages(seed=0), 40, until=until)
        assert until is None or (len(state.scene.surroundings) and "surroundings" in state.statistics)

    assert_resumes(run_until, fresh_state, 17, tmp_path)


def test_a_short_run_trains_as_splat() -> None:
    recipe = replace(RECIPE, least_iterations=41)
    state = fresh_state(recipe)
    messages = list(train(recipe.stages(0, 40), tiny_capture(), state, 40))
    assert [m.stage for m in messages if isinstance(m, StageEntered)] == ["as splat"]
    assert not len(state.scene.surroundings)
    recipe.renderer().check(state.scene)


def test_recipes_round_trip_as_json() -> None:
    for recipe in (RECIPE, TracedRecipe.paper()):
        assert recipe_from_json(recipe_to_json(recipe)) == recipe


def test_surroundings_are_copied_spread_or_both() -> None:
    copied, spread, both = (
        surrounded_state(SurroundingsStart(source, cells=2)).scene.surroundings for source in ("scene", "box", "both")
    )
    assert len(spread) == 40 and len(copied) > 10 and len(both) == 40 + len(copied)
    assert set(copied.means[:, 0].tolist()) <= set(fresh_state().scene.primary.means[:, 0].tolist())


@pytest.mark.parametrize("source", ["box", "both"])
def test_mirrors_are_searched_for_only_if_needed(source: Literal["box", "both"]) -> None:
    start = replace(RECIPE.surroundings.start, source=source)
    recipe = replace(RECIPE, surroundings=replace(RECIPE.surroundings, start=start))
    state, setup = fresh_state(), recipe.stages(seed=0)[1].setup
    assert setup is not None
    assert len(list(setup(state, tiny_capture()))) == (source == "both")  # type: ignore[call-overload]
    assert len(state.scene.surroundings)


def test_copies_keep_their_harmonics_outside_the_box() -> None:
    state = fresh_state()
    primary = replace(state.scene.primary, active_sh_degree=1)
    state.scene = replace(state.scene, primary=primary)
    everything = torch.ones(len(primary), dtype=torch.bool)
    start = SurroundingsStart("both", cells=2)
    add_surroundings(SurroundingsOptions(start), state, tiny_capture(), everything)
    assert len(state.scene.surroundings) == 40 + len(primary) and state.scene.surroundings.active_sh_degree == 1


def test_a_fully_reflective_scene_has_no_surroundings_to_copy() -> None:
    state = fresh_state()
    nothing = torch.zeros(len(state.scene.primary), dtype=torch.bool)
    start = SurroundingsStart("scene", cells=2)
    add_surroundings(SurroundingsOptions(start), state, tiny_capture(), nothing)
    assert len(state.scene.surroundings) == 40


def test_gradients_in_space_count_by_half_the_distance() -> None:
    statistics = ScreenStatistics.zeros(3)
    gradient = torch.tensor([[0.0, 3.0, 4.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    for _ in range(2):
        statistics.add_traced(gradient, torch.tensor([[0.5, 1.0], [0.0, 0.0], [3.0, 12.0]]))
    assert statistics.mean_gradient.tolist() == [5.0, 0.0, 2.0]
    assert statistics.view_count.tolist() == [[2.0, 0.0, 2.0]] * 2


def test_a_step_accumulates_gradients_of_hit_gaussians() -> None:
    state = surrounded_state()
    strong = {"logit_strength": torch.full((len(state.scene.primary),), 1.0)}
    state.scene = replace(state.scene, primary=replace(state.scene.primary, channels=strong))
    stage = RECIPE.stages(0)[2]
    result = differentiate(stage, state.scene, tiny_capture().train[0], with_records=True)
    ((record, met),) = result.traced
    assert record.part == "surroundings"
    reached = result.gradients["surroundings.means"].any(dim=1)
    assert bool(reached.any()) and bool((met[reached] > 0).all())
    assert not differentiate(stage, state.scene, tiny_capture().train[0], with_records=False).traced


def test_surroundings_never_reflected_are_pruned() -> None:
    state = surrounded_state()
    strong = {"logit_strength": torch.full((len(state.scene.primary),), 1.0)}
    state.scene = replace(state.scene, primary=replace(state.scene.primary, channels=strong))
    hidden = state.scene.surroundings.means.clone()
    hidden[:7] += 1e3
    state.scene = state.scene.with_parameters({"surroundings.means": hidden})
    before = len(state.scene.surroundings)
    densifier = DefaultDensify(least_contribution=1e-9, contribution_moments=(0.5,))
    action = PruneIdle(densifier, "surroundings", mirrored_contributions)
    assert action.due(Clock(20, 40, 6)) and finished(action.apply(state, tiny_capture(), Clock(20, 40, 6)))
    assert 0 < len(state.scene.surroundings) <= before - 7
    assert float(state.scene.surroundings.means.abs().max()) < 100
    dull = {"logit_strength": torch.full((len(state.scene.primary),), -20.0)}
    state.scene = replace(state.scene, primary=replace(state.scene.primary, channels=dull))
    assert not finished(action.apply(state, tiny_capture(), Clock(20, 40, 6)))


def test_opacities_of_surroundings_alone_are_reset() -> None:
    state = surrounded_state()
    before = state.scene.primary
    ResetOpacity(Every(0.1), part="surroundings").apply(state, tiny_capture(), Clock(4, 40, 6))
    assert torch.equal(state.scene.primary.logit_opacities, before.logit_opacities)
    assert float(torch.sigmoid(state.scene.surroundings.logit_opacities).max()) <= 0.0101


def test_the_preset_resets_surroundings_where_it_resets_the_scene() -> None:
    def parts(recipe: TracedRecipe) -> set[str]:
        return {a.part for s in recipe.stages(0) for a in s.actions if isinstance(a, ResetOpacity | Densify)}

    assert parts(TracedRecipe.paper()) == {"primary", "surroundings"}
    resets = [a for s in RECIPE.stages(0) for a in s.actions if isinstance(a, ResetOpacity)]
    assert {a.part for a in resets} == {"primary"}


def test_the_preset_is_that_of_the_public_configuration() -> None:
    recipe = TracedRecipe.paper()
    stages = recipe.stages(0, 40_000)

    def steps(kind: type, part: str) -> list[int]:
        starts = stage_starts(stages, 40_000)
        return [
            step
            for stage, start, end in zip(stages, starts, starts[1:], strict=False)
            for step in range(start + 1, end + 1)
            for action in stage.actions
            if isinstance(action, kind) and getattr(action, "part", "primary") == part
            if action.due(Clock(step, 40_000, 100))
        ]

    assert steps(ResetOpacity, "surroundings") == [6000, 12_000, 18_000]
    assert steps(Densify, "surroundings")[0] == 3500 and steps(Densify, "surroundings")[-1] == 21_000
    assert steps(Densify, "primary")[-1] == 21_000
    assert steps(GrowSh, "primary")[:4] == [1000, 2000, 3000, 4000]
    assert steps(Propagate, "primary")[-1] <= 18_000 < steps(Propagate, "primary")[-1] + 2000
    assert not any(isinstance(a, GrowShAfterPropagation) for stage in stages for a in stage.actions)
    assert recipe.surroundings.densify.prune_opacity == 0.05
    for stage in stages:
        assert {"consistency", "monocular normals"} <= {term.name for term in stage.losses}


def test_a_short_run_of_discs_learns_as_splat_does_with_discs() -> None:
    stages, plain = TracedRecipe(primitive="disc").stages(0, 1000), SplatRecipe(primitive="disc").stages(0, 1000)
    assert [stage.name for stage in stages] == [f"as {stage.name}" for stage in plain]
    assert [[term.name for term in stage.losses] for stage in stages] == [
        [term.name for term in stage.losses] for stage in plain
    ]
    assert not any(isinstance(action, SeedUnexplained) for stage in stages for action in stage.actions)
    assert stages[0].setup is not None and all(stage.setup is None for stage in stages[1:])


def test_normals_of_discs_can_learn_from_the_first_step_on() -> None:
    recipe = replace(DISCS, normals_throughout=True, consistency_weight=1.0)
    scene = fresh_state(recipe).scene
    # Depths count only where most of a pixel is covered.
    scene = scene.with_parameters({"primary.logit_opacities": torch.full((len(scene.primary),), 3.0)})
    found = differentiate(recipe.stages(0)[0], scene, tiny_capture().train[0], with_records=False)
    assert found.losses["consistency"] > 0 and bool(found.gradients["primary.quats"].any())


def test_surroundings_that_are_too_large_are_pruned() -> None:
    state = surrounded_state()
    large = state.scene.surroundings.log_scales.clone()
    large[:3] = math.log(2.5 * state.scene.extent)
    state.scene = state.scene.with_parameters({"surroundings.log_scales": large})
    count = len(state.scene.surroundings)
    state.statistics["surroundings"] = ScreenStatistics.zeros(count)
    densifier = DefaultDensify(prune_large_start=0.1, prune_scale_fraction=2.0, prune_opacity=1e-6)
    Densify(densifier, "surroundings").apply(state, tiny_capture(), Clock(20, 40, 6))
    assert len(state.scene.surroundings) == count - 3


def test_what_hardly_reflects_learns_to_without_an_environment() -> None:
    recipe = replace(RECIPE, mirrors="surroundings", least_strength=0.02)
    state = surrounded_state()
    faint = {"logit_strength": torch.full((len(state.scene.primary),), -6.0)}
    scene = replace(state.scene, primary=replace(state.scene.primary, channels=faint))
    for stage in recipe.stages(0)[1:]:
        assert learns_to_reflect(stage, scene)
    assert recipe.renderer().least_strength == 0.02


def test_faint_surfaces_learn_to_reflect_an_environment() -> None:
    state = surrounded_state()
    faint = {"logit_strength": torch.full((len(state.scene.primary),), -7.0)}
    primary = replace(state.scene.primary, channels=faint)
    environment = Environment.random(4, generator=torch.Generator().manual_seed(0))
    scene = replace(state.scene, primary=primary, environment=environment, surroundings=Gaussians.empty())
    for stage in RECIPE.stages(0)[1:]:
        assert learns_to_reflect(stage, scene)


def learns_to_reflect(stage: Stage, scene: Scene) -> bool:
    """Returns True if the photometric loss alone, without penalties on strength, gives strengths a gradient."""
    photometric = replace(stage, losses=stage.losses[:1])
    found = differentiate(photometric, scene, tiny_capture().train[0], with_records=False)
    return "primary.logit_strength" in found.gradients and bool(found.gradients["primary.logit_strength"].any())


def test_actions_ignore_removed_surroundings() -> None:
    state = surrounded_state()
    state.scene = replace(state.scene, surroundings=Gaussians.empty())
    part, clock = "surroundings", Clock(32, 40, 6)
    prune = PruneIdle(DefaultDensify(), part, mirrored_contributions)
    for action in (GrowSh(Every(0.1), part), ResetOpacity(Every(0.1), part=part)):
        assert not action.apply(state, tiny_capture(), clock)
    assert not finished(prune.apply(state, tiny_capture(), clock))


def test_a_scene_without_surroundings_is_refused() -> None:
    scene = replace(surrounded_state().scene, surroundings=Gaussians.empty(), environment=Environment.empty())
    with pytest.raises(ValueError, match="has no surroundings; expected one trained with `traced`"):
        RECIPE.renderer().check(scene)
