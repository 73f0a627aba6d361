"""The published recipes: the documents name the options that restore a paper's settings, and each of them does so."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch

from glassplat.cli import main
from glassplat.cli.train import SCENE
from glassplat.kernels.maths.images import linear_from_srgb
from glassplat.methods.glossy_recipes import DeferredRecipe, TracedRecipe
from glassplat.methods.mirrors import PROPAGATION_ENDED, DensifyWhilePropagating, Propagate, ResetRaised
from glassplat.methods.planar import PaneSetup
from glassplat.methods.planar_recipe import PlanarRecipe, ReflectionWeights
from glassplat.methods.recipe import RECIPES, recipe_of, recipe_to_json
from glassplat.methods.splat import strategy_of
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.render.planar import Planar
from glassplat.scene.scene import Scene
from glassplat.training.actions import AddNoise, Densify, PerturbOpacity, Relocate, ResetOpacity, mcmc_strategy
from glassplat.training.loop import differentiate, train
from glassplat.training.messages import ActionDone, StepDone
from glassplat.training.options import DefaultDensify, McmcDensify, PropagationSchedule, Rate, SurroundingsStart
from glassplat.training.stage import AtShares, Clock, Stage, TrainState, stage_starts
from tests.render.test_seen_panes import CAMERA, vitrine
from tests.training.progress_of import finished
from tests.training.test_default import edited, make_gaussians, seen
from tests.training.tiny_capture import place_true_planes, tiny_capture, true_scene
from tools.make_differences import REASONS, own_differences, with_table

DOCS = Path(__file__).parents[2] / "docs"


def parsed(arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> Any:
    """The recipe of a command line of `train`."""
    taken: list[Any] = []
    monkeypatch.setattr(main, "run", taken.append)
    assert main.main(["train", arguments[0], "--data", str(SCENE), "--output", "y", *arguments[1:]]) == 0
    return taken[0].recipe


@pytest.mark.parametrize("method", RECIPES)
def test_the_table_of_a_page_is_that_of_the_preset(method: str) -> None:
    page = (DOCS / f"{method}.md").read_text(encoding="utf-8")
    assert with_table(page, method) == page, "python -m tools.make_differences writes the tables anew"


@pytest.mark.parametrize("preset", ["glassplat", "paper"])
@pytest.mark.parametrize("method", RECIPES)
def test_trainable_tensors_stay_trainable(method: str, preset: Any) -> None:
    stages = recipe_of(method, preset).stages(0)
    for before, after in pairwise(stages):
        assert before.rates.keys() <= after.rates.keys(), after.name


@pytest.mark.parametrize("iterations", [500, 7000])
@pytest.mark.parametrize("method", RECIPES)
def test_actions_belong_to_the_stage_of_their_moment(method: str, iterations: int) -> None:
    stages = recipe_of(method).stages(0, iterations)
    starts = stage_starts(stages, iterations)
    planned, acting = set(), set()
    for stage, start, end in zip(stages, starts, starts[1:], strict=False):
        for action in (action for action in stage.actions if isinstance(action, AtShares)):
            steps = {round(moment * iterations) for moment in action.shares}
            planned |= {(action.name, step) for step in steps}
            acting |= {(action.name, step) for step in steps if start < step <= end}
    assert acting == planned


def test_panes_move_at_a_tenth_of_their_rates_in_the_joint_stage() -> None:
    _, adjustment, joint = PlanarRecipe.paper().stages(0)
    ratio = {name: joint.rates[name].at(0, 1) / rate.at(0, 1) for name, rate in adjustment.rates.items()}
    slower = {name for name, share in ratio.items() if share == pytest.approx(0.1)}
    assert slower == {"planes.centers", "planes.raw_normals"}


@pytest.mark.parametrize("method", RECIPES)
def test_a_recipe_of_a_file_gives_defaults_that_options_override(
    method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "recipe.json"
    recipe = replace(recipe_of(method, "paper"), background=(0.5, 0.5, 0.5))
    file.write_text(recipe_to_json(recipe))
    assert parsed([method, "--config", str(file)], monkeypatch) == recipe
    assert parsed([method, f"--config={file}", "--sh-degree", "1"], monkeypatch) == replace(recipe, sh_degree=1)
    other = next(name for name in RECIPES if name != method)
    assert main.main(["train", other, "--config", str(file), "--data", "x", "--output", "y"]) == 2
    assert f"is a recipe of {method}" in " ".join(capsys.readouterr().err.split())
    assert main.main(["train", method, "--config", str(tmp_path / "no.json"), "--data", "x", "--output", "y"]) == 2


def test_every_difference_has_a_reason_and_no_reason_is_idle() -> None:
    own = {method: set(own_differences(method)) for method in RECIPES}
    assert all(own[method] <= set(REASONS[method]) for method in RECIPES)
    assert {name for reasons in REASONS.values() for name in reasons} == set().union(*own.values())


@pytest.mark.parametrize("method", RECIPES)
def test_the_preset_gives_defaults_that_options_override(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    paper = recipe_of(method, "paper")
    assert parsed([method], monkeypatch) == recipe_of(method) != paper
    assert parsed([method, "--preset", "paper"], monkeypatch) == paper
    assert parsed([method, "--preset=paper"], monkeypatch) == paper
    changed = parsed([method, "--sh-degree", "1", "--preset", "paper", "--densify.stop", "0.3"], monkeypatch)
    assert changed == replace(paper, sh_degree=1, densify=replace(paper.densify, stop=0.3))


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
@pytest.mark.parametrize("method", RECIPES)
def test_a_short_run_of_a_preset_learns(method: str, strategy: Any) -> None:
    recipe = replace(recipe_of(method, "paper"), strategy=strategy, sh_degree=1)
    recipe = replace(recipe, intervals=replace(recipe.intervals, opacity=8 / 60, least=2, sh=0.1))
    if method == "deferred":
        recipe = replace(recipe, texels=8, first_texels=8, schedule=replace(recipe.schedule, stop=0.9))
    if method == "traced":
        around = replace(recipe.surroundings, start=SurroundingsStart(source="box", cells=3))
        recipe = replace(recipe, surroundings=around, schedule=replace(recipe.schedule, stop=0.9))
    stages = [
        replace(s, setup=place_true_planes if isinstance(s.setup, PaneSetup) else s.setup) for s in recipe.stages(0)
    ]
    state = TrainState(planeless(recipe) if method == "planar" else recipe.initialise(tiny_capture()), seed=0)
    messages = list(train(tuple(stages), tiny_capture(), state, 60))
    losses = [message.losses["photometric"] for message in messages if isinstance(message, StepDone)]
    assert len(losses) == state.step == 60
    assert all(torch.isfinite(tensor).all() for tensor in state.scene.parameters().values())
    # The first and the second pass over the six views, before any perturbation.
    assert sum(losses[6:12]) < sum(losses[:6])
    done = {message.action for message in messages if isinstance(message, ActionDone)}
    reflective = {"propagate normals"}
    expected = {"splat": set(), "planar": {"perturb opacity"}, "deferred": reflective, "traced": reflective}
    assert expected[method] <= done


def planeless(recipe: PlanarRecipe) -> Scene:
    """The first scene of a recipe, without the trial fit, for which the tiny capture has too few points."""
    dataset = tiny_capture()
    return Scene(strategy_of(recipe).initial_gaussians(dataset.points, recipe.sh_degree), dataset.extent)


def moments(stages: tuple[Stage, ...], kind: type, iterations: int) -> list[list[int]]:
    """The steps at which the actions of a kind are due, by stage."""
    starts = stage_starts(stages, iterations)
    return [
        [
            step
            for step in range(start + 1, end + 1)
            for action in stage.actions
            if type(action) is kind and action.due(Clock(step, iterations, views=10))
        ]
        for stage, start, end in zip(stages, starts[:-1], starts[1:], strict=True)
    ]


def test_large_gaussians_are_split_by_the_gradient_on_request() -> None:
    gaussians = make_gaussians([0.5, 0.5])
    # The gradients of the first cancel; the second has a gradient and a small absolute one.
    statistics = seen([1e-5, 1e-3], absgrads=[1e-2, 1.1e-3])
    by_absgrad, by_gradient = (
        edited(DefaultDensify(split_by=by), gaussians, statistics) for by in ("absgrad", "gradient")
    )
    assert len(by_absgrad) == len(by_gradient) == 3
    assert torch.equal(by_absgrad.means[0], gaussians.means[1]) and torch.equal(
        by_gradient.means[0], gaussians.means[0]
    )


def test_densification_can_keep_its_interval_whatever_the_views() -> None:
    def steps(densifier: DefaultDensify, views: int) -> list[int]:
        action = Densify(densifier)
        return [step for step in range(1, 1501) if action.due(Clock(step, 3000, views))]

    assert steps(DefaultDensify(whole_passes=False), 150) == list(range(100, 1501, 100))
    assert steps(DefaultDensify(), 150) == list(range(150, 1501, 150))


@pytest.mark.parametrize(("step", "left"), [(3000, 2), (3100, 1)])
def test_oversized_gaussians_are_pruned_after_the_opacity_reset(step: int, left: int) -> None:
    state = TrainState(Scene(make_gaussians([0.01, 0.5]), 2.0), seed=0)
    state.statistics["primary"] = seen([0.0, 0.0])
    Densify(DefaultDensify.published()).apply(state, tiny_capture(), Clock(step, 30_000, 6))
    assert len(state.scene.primary) == left


def test_noise_and_regularisers_of_mcmc_can_reach_everything() -> None:
    faint = make_gaussians([0.1] * 4, opacities=[0.001] * 4)
    options = McmcDensify(reach="all")
    state = TrainState(Scene(faint, 2.0), seed=0)
    AddNoise(options, Rate(1e-3))(state, Clock(1, 100, 6), torch.tensor([True, False, True, False]))
    assert bool((state.scene.primary.means != faint.means).any(dim=1).all())
    view, scene = tiny_capture().train[0], true_scene()
    frame = Planar()(scene, view.camera)
    for reach, expected in (("all", torch.ones(len(scene.primary), dtype=torch.bool)), ("shown", frame.direct)):
        raw = scene.primary.logit_opacities.clone().requires_grad_()
        learning = scene.with_parameters({"primary.logit_opacities": raw})
        opacity, _ = mcmc_strategy(replace(options, reach=reach), Rate(1e-3)).terms
        (gradient,) = torch.autograd.grad(opacity.function(frame, view, learning), raw)
        assert torch.equal(gradient != 0, expected)


def test_published_perturbations_and_resets_share_no_stage() -> None:
    stages = PlanarRecipe.paper().stages(0)
    assert moments(stages, ResetOpacity, 30_000) == [[3000], [6000], [9000, 12_000]]
    perturbed = moments(stages, PerturbOpacity, 30_000)
    assert perturbed == [[], [], [step for step in range(7000, 29_001, 1000) if step % 3000]]
    here = PlanarRecipe().stages(0)
    assert moments(here, ResetOpacity, 30_000) == [[], [], [3000, 6000, 9000, 12_000]]
    assert moments(here, PerturbOpacity, 30_000)[2][-1] == 23_000


@pytest.mark.parametrize(("recipe", "iterations"), [(DeferredRecipe.paper(), 61_000), (TracedRecipe.paper(), 40_000)])
def test_the_published_bootstrap_ends_in_a_reset_as_3dgs_has_it(
    recipe: DeferredRecipe | TracedRecipe, iterations: int
) -> None:
    assert moments(recipe.stages(0, iterations), ResetOpacity, iterations)[0] == [3000]


@pytest.mark.parametrize("iterations", [200, 999, 1500, 7000, 7001, 30_000])
def test_the_last_perturbation_leaves_time_to_settle(iterations: int) -> None:
    (steps,) = [steps for steps in moments(PlanarRecipe.paper().stages(0), PerturbOpacity, iterations) if steps] or [
        [0]
    ]
    assert iterations - steps[-1] >= iterations // 30


def test_mcmc_grows_from_the_first_stage_on_and_resets_nothing_as_published() -> None:
    recipes = (PlanarRecipe.paper(), PlanarRecipe())
    published, ours = (replace(made, strategy="mcmc").stages(0, 3000) for made in recipes)
    assert moments(published, Relocate, 3000)[0] == [100, 200, 300]
    first, second, last = moments(ours, Relocate, 3000)
    assert first == second == [] and last[0] == 700
    assert not any(moments(published, ResetOpacity, 3000)) and moments(ours, ResetOpacity, 3000) == [[], [], [660]]


def test_perturbed_opacities_stay_within_their_bounds() -> None:
    recipe = PlanarRecipe.paper()
    (action,) = [a for a in recipe.stages(0)[-1].actions if isinstance(a, PerturbOpacity)]
    state = TrainState(true_scene(), seed=0)
    finished(replace(action, amplitude=1.0).apply(state, tiny_capture(), Clock(1, 1, 6)))
    opacities = torch.sigmoid(state.scene.primary.logit_opacities)
    assert bool(((opacities < 0.001) | (opacities > 0.999)).any()) and bool(opacities.isfinite().all())


def test_only_the_nearest_pane_reflects_on_request() -> None:
    scene = vitrine(1, 2)
    nearest, every = (Planar(nearest_only=asked)(scene, CAMERA) for asked in (True, False))
    assert torch.equal(nearest.layers["transmission"], nearest.layers["without_panes"])
    assert not torch.allclose(every.layers["transmission"], every.layers["without_panes"])
    strength = nearest.layers["strength"][..., None]
    through, mirrored = (linear_from_srgb(nearest.layers[name]) for name in ("without_panes", "reflection"))
    torch.testing.assert_close(linear_from_srgb(nearest.rgb), (1 - strength) * through + strength * mirrored)
    recipe = PlanarRecipe(panes="nearest")
    assert recipe.renderer().nearest_only and all(s.renderer.nearest_only for s in recipe.stages(0)[1:])


def test_mirrors_can_learn_their_reflectance() -> None:
    def entered(fixed: bool, monkeypatch: pytest.MonkeyPatch) -> Scene:
        recipe = PlanarRecipe(fixed_mirrors=fixed, detect_mirrors=False, seed_reflections=False)
        setup = recipe.stages(0)[1].setup
        assert isinstance(setup, PaneSetup)
        mirror = replace(true_scene().planes, mirrors=(1,))
        monkeypatch.setattr("glassplat.methods.planar.fit_planes", lambda *a, **k: mirror)
        state = TrainState(Scene(true_scene().primary, true_scene().extent), seed=0)
        finished(setup(state, tiny_capture()))
        return state.scene

    with pytest.MonkeyPatch.context() as patch:
        learned, fixed = (entered(asked, patch) for asked in (False, True))
    assert learned.planes.mirrors == () and fixed.planes.mirrors == (1,)
    assert torch.equal(learned.primary.means, true_scene().primary.means)
    assert not torch.equal(fixed.primary.means, true_scene().primary.means)


def test_the_mean_depth_can_learn_from_the_deviation() -> None:
    view, scene = tiny_capture().train[0], true_scene()
    gradients = []
    for moving in (False, True):
        weights = ReflectionWeights(depth=1.0, conflict=0.0, mask=0.0, intensity=0.0)
        recipe = PlanarRecipe(moving_mean=moving, ssim_weight=0.0, weights=weights)
        stage = recipe.stages(0)[-1]
        stage = replace(stage, losses=tuple(term for term in stage.losses if term.name == "depth"))
        gradients.append(differentiate(stage, scene, view, with_records=False).gradients["primary.means"])
    assert bool(gradients[0].any()) and not torch.allclose(*gradients)


def test_all_views_and_mirror_images_can_count_alike() -> None:
    view, scene = tiny_capture().train[0], true_scene()
    direct, alike = (
        PlanarRecipe(densify_by=by).stages(0)[-1].renderer(scene, view.camera, with_records=True).screen
        for by in ("direct", "all")
    )
    assert [record.direct for record in direct] == [True, True, False]
    assert all(record.direct and record.weight == 1 for record in alike) and len(alike) == 3


def test_positions_can_stop_to_slow_down_before_the_end() -> None:
    rate = Rate(1e-2, 1e-4, decay=0.5)
    assert rate.at(0.25, 1.0) == pytest.approx(1e-3)
    assert rate.at(0.5, 1.0) == rate.at(0.9, 1.0) == pytest.approx(1e-4)


def test_the_region_is_not_searched_for_if_switched_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("glassplat.methods.surroundings.reflective_region", lambda cameras: (0.0, 0.0, 0.0, 1.0))

    def region(**options: Any) -> Any:
        recipe = DeferredRecipe(**options)
        state, setup = TrainState(recipe.initialise(tiny_capture()), seed=0), recipe.stages(0)[1].setup
        assert setup is not None
        finished(setup(state, tiny_capture()))
        return state.scene.environment.region

    assert region() == (0.0, 0.0, 0.0, 1.0)
    assert region(find_region=False) is None
    assert region(find_region=False, region=(1.0, 2.0, 3.0, 4.0)) == (1.0, 2.0, 3.0, 4.0)


def test_a_matte_scene_keeps_the_published_rates_on_request() -> None:
    def factors(asked: bool) -> Any:
        (action,) = [
            a for a in DeferredRecipe(raise_rates_matte=asked).stages(0)[1].actions if isinstance(a, Propagate)
        ]
        return action.matte_rates

    assert factors(True) and not factors(False)


def test_densification_waits_longer_while_normals_spread() -> None:
    recipe = DeferredRecipe(propagation_interval=500, densify=DefaultDensify(whole_passes=False))
    (action,) = [a for a in recipe.stages(0)[1].actions if isinstance(a, DensifyWhilePropagating)]

    def acted(ended: bool) -> list[int]:
        state = TrainState(true_scene(), seed=0, records={PROPAGATION_ENDED: 1} if ended else {})
        steps = []
        for step in range(100, 1001, 100):
            state.statistics["primary"] = seen([0.0] * len(state.scene.primary))
            clock = Clock(step, 6000, 6)
            steps += [step] if action.due(clock) and action.apply(state, tiny_capture(), clock) else []
        return steps

    assert acted(ended=False) == [500, 1000]
    assert acted(ended=True) == list(range(200, 1001, 100))
    assert not any(isinstance(a, DensifyWhilePropagating) for a in DeferredRecipe().stages(0)[1].actions)


def test_the_reset_after_propagation_can_be_left_out() -> None:
    def kinds(asked: bool) -> list[type]:
        recipe = DeferredRecipe(schedule=PropagationSchedule(last_reset=asked))
        return [type(action) for action in recipe.stages(0)[1].actions]

    assert ResetRaised in kinds(True) and ResetRaised not in kinds(False)
    assert ResetOpacity in kinds(False)


@pytest.mark.parametrize("method", RECIPES)
def test_a_preset_is_of_its_own_method(method: str) -> None:
    assert recipe_of(method, "paper").method == method
    assert SplatRecipe.paper().rates.short_run_power == 0
