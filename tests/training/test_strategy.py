"""The MCMC strategy in both recipes: wiring, a short run, determinism and resuming."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from glassplat.captures.view import View
from glassplat.methods.planar import TurnReflections, stage_shares
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.methods.recipe import recipe_from_json, recipe_to_json
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.scene.scene import Scene
from glassplat.training.actions import (
    AddNoise,
    AverageLast,
    Densify,
    PerturbOpacity,
    Relocate,
    ResetOpacity,
    SeedUnexplained,
    growth_per_relocation,
    mcmc_cap,
    threshold_factor,
)
from glassplat.training.loop import differentiate
from glassplat.training.losses import PhotometricLoss
from glassplat.training.messages import ActionDone, Message, StepDone
from glassplat.training.options import DefaultDensify, Intervals, McmcDensify
from glassplat.training.stage import Clock, Stage, TrainState, stage_starts
from tests.training.progress_of import assert_resumes, trained
from tests.training.tiny_capture import tiny_capture, true_scene

OFTEN = McmcDensify(interval=2, start=0.1, cap=45)
RECIPES: list[Any] = [
    SplatRecipe(sh_degree=1, strategy="mcmc", mcmc=OFTEN),
    PlanarRecipe(sh_degree=1, stage_shares=(0.2, 0.22, 0.58), strategy="mcmc", mcmc=OFTEN),
]
BOTH = pytest.mark.parametrize("recipe", RECIPES, ids=["splat", "planar"])


def place_true_planes(state: TrainState, dataset: object) -> None:
    """Stands in for the plane fit, which needs more masks than the tiny capture has."""
    truth = true_scene()
    state.scene = replace(state.scene, planes=truth.planes, glass=truth.glass)
    state.statistics.clear()


def stages_of(recipe: Any) -> tuple[Stage, ...]:
    return tuple(replace(s, setup=place_true_planes) if s.setup else s for s in recipe.stages(seed=0))


def fresh_state(recipe: Any, seed: int = 0) -> TrainState:
    scene = SplatRecipe(sh_degree=1, strategy="mcmc", mcmc=recipe.mcmc).initialise(tiny_capture())
    return TrainState(scene, seed)


def run(state: TrainState, recipe: Any, iterations: int = 20, until: int | None = None) -> list[Message]:
    return trained(state, stages_of(recipe), iterations, until=until)


def in_front(scene: Scene, view: View) -> Tensor:
    """[N] bool: the primary Gaussians in front of the tiny capture's camera."""
    return view.camera.project(scene.primary.means)[1] > 0


@BOTH
def test_a_short_run_relocates_grows_and_regularises(recipe: Any) -> None:
    state = fresh_state(recipe)
    before = len(state.scene.primary)
    messages = run(state, recipe)
    actions = [m.action for m in messages if isinstance(m, ActionDone)]
    assert "densify primary" in actions
    assert actions.count("reset opacity") == (1 if recipe.method == "planar" else 0)
    assert before < len(state.scene.primary) <= OFTEN.cap
    steps = [m for m in messages if isinstance(m, StepDone)]
    # In `planar`, MCMC begins with the last stage.
    begins = 0 if recipe.method == "splat" else round(20 * sum(recipe.stage_shares[:2]))
    assert [({"opacity", "scale"} <= set(m.losses)) for m in steps] == [m.step > begins for m in steps]
    assert all(torch.isfinite(tensor).all() for tensor in state.scene.parameters().values())


@BOTH
@pytest.mark.parametrize("pause", [3, 4, 11])
def test_resuming_continues_to_the_same_result(recipe: Any, pause: int, tmp_path: Path) -> None:
    assert_resumes(lambda state, until: run(state, recipe, until=until), lambda: fresh_state(recipe), pause, tmp_path)


@BOTH
def test_the_strategy_decides_what_happens_to_the_primary_gaussians(recipe: Any) -> None:
    *first, last = recipe.stages(seed=0)
    kinds = [type(action) for action in last.actions]
    # The last stage of `planar` contains its only reset.
    assert kinds.count(Relocate) == 1 and kinds.count(ResetOpacity) == (recipe.method == "planar")
    assert [type(post_step) for post_step in last.post_steps] == [AddNoise, AverageLast]
    assert all(action.part == "glass" for action in last.actions if isinstance(action, Densify))
    for stage in first:
        densify = [action for action in stage.actions if isinstance(action, Densify) and action.part == "primary"]
        assert [action.mcmc for action in densify] == [recipe.mcmc]
        assert not {Relocate, ResetOpacity} & {type(action) for action in stage.actions}
        assert [type(post_step) for post_step in stage.post_steps] == [AverageLast]
    for stage in replace(recipe, strategy="default").stages(seed=0):
        assert [type(post_step) for post_step in stage.post_steps] == [AverageLast]
        assert not any(isinstance(action, Relocate) for action in stage.actions)
        assert not {"opacity", "scale"} & {term.name for term in stage.losses}


def test_the_first_stages_are_a_tenth_of_a_run_and_at_most_350_steps() -> None:
    assert stage_shares(None, 1500) == stage_shares(None, 3500) == (0.1, 0.1, 0.8)
    for iterations in (3501, 7000, 30_000):
        assert stage_starts(PlanarRecipe().stages(0, iterations), iterations) == [0, 350, 700, iterations]
    assert stage_shares((0.3, 0.2, 1.0), 30_000) == (0.3, 0.2, 1.0)


def test_the_search_for_missing_objects_is_within_the_second_stage_of_long_runs() -> None:
    stages = PlanarRecipe().stages(0, 100_000)
    assert [a.shares for a in stages[1].actions if isinstance(a, SeedUnexplained)] == [(0.00525,)]


def steps_of(strategy: Any, iterations: int, *kinds: type) -> list[int]:
    """The steps of the joint stage of `planar` at which actions of some kinds act."""
    joint = PlanarRecipe(strategy=strategy).stages(0, iterations)[-1]
    acting = [action for action in joint.actions if isinstance(action, kinds)]
    clocks = (
        Clock(step, iterations, views=10) for step in range(round(iterations * (1 - joint.share)) + 1, iterations)
    )
    return [clock.step for clock in clocks if any(action.due(clock) for action in acting)]


@pytest.mark.parametrize("iterations", [251, 1234, 7_000, 30_000])
def test_mcmc_resets_opacities_after_turning_reflections(iterations: int) -> None:
    (turned,), reset = steps_of("mcmc", iterations, TurnReflections), min(0.2 * iterations, 700) + 0.02 * iterations
    assert steps_of("mcmc", iterations, ResetOpacity) == [round(reset)] and turned < reset


@pytest.mark.parametrize("iterations", [1240, 2450, 7_000, 11_000, 22_000, 30_000])
def test_no_opacity_changes_in_the_joint_stage_before_reflections_are_turned(iterations: int) -> None:
    """Perturbations came first in runs of 1240, 2450, 11,000 and 22,000 iterations."""
    (turned,) = steps_of("default", iterations, TurnReflections)
    assert turned < min(steps_of("default", iterations, ResetOpacity, PerturbOpacity))


def test_the_planar_objective_is_that_of_equation_20_but_for_what_holds_intensities_and_glass() -> None:
    recipe = RECIPES[1]
    paper = replace(recipe, weights=replace(recipe.weights, intensity=0.0, reflectance=0.0))
    *_, joint = paper.stages(seed=0)
    assert joint.losses[0].function == PhotometricLoss(ssim_weight=0.2)
    assert {term.name: term.weight for term in joint.losses} == pytest.approx(
        {"photometric": 1.0, "depth": 0.005, "conflict": 0.2, "mask": 0.5, "opacity": 0.01, "scale": 0.01}
    )


def test_the_regularisers_reach_the_gaussians() -> None:
    (stage,) = RECIPES[0].stages(seed=0)
    scene, view = fresh_state(RECIPES[0]).scene, tiny_capture().train[0]
    plain = replace(stage, losses=tuple(term for term in stage.losses if term.name not in ("opacity", "scale")))
    gradients = [differentiate(s, scene, view, with_records=False).gradients for s in (stage, plain)]
    opacities, scales = torch.sigmoid(scene.primary.logit_opacities), scene.primary.log_scales.exp()
    shown = in_front(scene, view)
    expected = {
        "primary.logit_opacities": shown * 0.01 * opacities * (1 - opacities) / shown.sum(),
        "primary.log_scales": shown[:, None] * 0.01 * scales / (3 * shown.sum()) / scene.extent,
    }
    for name, gradient in expected.items():
        assert torch.allclose(gradients[0][name] - gradients[1][name], gradient, rtol=1e-3, atol=1e-8), name


@pytest.mark.parametrize("visible", [None, [True, False, True, False]])
def test_the_noise_moves_what_the_view_shows(visible: list[bool] | None) -> None:
    recipe = RECIPES[0]
    state = fresh_state(recipe)
    faint = state.scene.primary.select(torch.arange(4))
    faint = faint.with_tensors({"logit_opacities": torch.full((4,), -9.0)})
    state.scene = replace(state.scene, primary=faint)
    (stage,) = recipe.stages(seed=0)
    explore = stage.post_steps[0]
    explore(state, Clock(1, 100, views=10), None if visible is None else torch.tensor(visible))
    moved = (state.scene.primary.means != faint.means).any(dim=1).tolist()
    assert moved == (visible or [True] * 4)


def test_a_step_passes_on_the_visible_gaussians() -> None:
    (stage,) = RECIPES[0].stages(seed=0)
    scene, view = fresh_state(RECIPES[0]).scene, tiny_capture().train[0]
    visible = differentiate(stage, scene, view, with_records=False).visible
    assert visible is not None and torch.equal(visible, in_front(scene, view))
    assert visible.any() and not visible.all()


def test_the_strategy_decides_how_the_first_gaussians_look() -> None:
    options, capture = McmcDensify(initial_spread=0.1), replace(tiny_capture(), measured_points=False)
    kinds = SplatRecipe(strategy="mcmc"), SplatRecipe(), PlanarRecipe(strategy="mcmc")
    sampled, default, later = (replace(kind, mcmc=options).initialise(capture).primary for kind in kinds)
    assert torch.sigmoid(sampled.logit_opacities).mean().item() == pytest.approx(0.5)
    assert torch.allclose(sampled.log_scales.exp(), 0.1 * default.log_scales.exp())
    assert torch.equal(later.log_scales, default.log_scales)
    assert torch.equal(later.logit_opacities, default.logit_opacities)


def test_the_default_cap_follows_the_photographs() -> None:
    camera = tiny_capture().train[0].camera
    assert mcmc_cap(McmcDensify(), tiny_capture()) == round(camera.width * camera.height / 2)
    assert mcmc_cap(McmcDensify(cap=7), tiny_capture()) == 7


def test_one_small_photograph_among_large_ones_changes_no_threshold() -> None:
    capture = tiny_capture()
    first, *others = capture.train
    mixed = replace(capture, train=(first.with_camera(first.camera.resize(4, 3)), *others))
    assert mcmc_cap(McmcDensify(), mixed) == mcmc_cap(McmcDensify(), capture)
    assert threshold_factor(mixed) == threshold_factor(capture)


@pytest.mark.parametrize("iterations", [3_000, 7_000, 30_000, 60_000])
def test_the_cap_is_reached_at_the_same_share_of_any_run(iterations: int) -> None:
    count, options = 6000.0, McmcDensify()
    action = Relocate(options)
    for step in range(1, iterations + 1):
        if action.due(Clock(step, iterations, views=10)):
            count *= growth_per_relocation(options, iterations)
        if count >= 60_000:
            break
    assert step / iterations == pytest.approx(0.17, abs=0.02)


def test_one_relocation_at_most_doubles_the_set() -> None:
    assert growth_per_relocation(McmcDensify(), 30_000) == pytest.approx(1.05)
    assert growth_per_relocation(McmcDensify(), 500) == 2.0


def test_relocation_keeps_its_share_of_the_run() -> None:
    action = Relocate(McmcDensify())
    due = [step for step in range(1, 30_001) if action.due(Clock(step, 30_000, views=10))]
    assert (due[0], due[1], due[-1]) == (600, 700, 25_000)


def test_weights_and_noise_of_zero_are_left_out() -> None:
    bare = McmcDensify(noise_rate=0.0, opacity_weight=0.0, scale_weight=0.0)
    (stage,) = SplatRecipe(strategy="mcmc", mcmc=bare, intervals=Intervals(averaged_passes=0)).stages(seed=0)
    assert not stage.post_steps and {term.name for term in stage.losses} == {"photometric"}


@BOTH
def test_a_recipe_round_trips_through_its_file(recipe: Any) -> None:
    assert recipe_from_json(recipe_to_json(recipe)) == recipe


def test_screen_gradients_are_collected_only_for_densification_by_them() -> None:
    sampled, default = (SplatRecipe(strategy=strategy).stages(seed=0)[0] for strategy in ("mcmc", "default"))
    assert sampled.densify_until == 0
    assert default.densify_until == SplatRecipe().densify.stop
    ours, published = (replace(r, strategy="mcmc").stages(seed=0) for r in (PlanarRecipe(), PlanarRecipe.paper()))
    assert published[0].densify_until == 0
    # The glass is densified with either strategy, and before MCMC begins, all are.
    later = {stage.densify_until for stage in published[1:]}
    assert later == {stage.densify_until for stage in ours} == {PlanarRecipe().densify.stop}


@pytest.mark.parametrize("method", [SplatRecipe, PlanarRecipe])
@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_a_cap_bounds_the_first_gaussians(strategy: Any, method: Any, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    # Without measured points, `planar` does not check the masks first.
    capture, many, few = replace(tiny_capture(), measured_points=False), 10**6, 7
    usual = method(strategy=strategy).initialise(capture).primary

    def capped(cap: int) -> Any:
        own = {"mcmc": McmcDensify(cap=cap)} if strategy == "mcmc" else {"densify": DefaultDensify(cap=cap)}
        return method(strategy=strategy, **own)

    assert all(torch.equal(capped(cap).initialise(capture).primary.means, usual.means) for cap in (many, 0))
    assert not caplog.messages
    first, again = (capped(few).initialise(capture).primary for _ in range(2))
    assert len(first) == few and torch.equal(first.means, again.means)
    assert all((usual.means == mean).all(dim=1).any() for mean in first.means)
    assert f"The first Gaussians are {few} of the {len(usual)} points" in caplog.text
