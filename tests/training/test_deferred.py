"""The `deferred` recipe: its stages, the end of propagation, a short run, and resuming."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import pytest
import torch

from glassplat.methods.glossy_recipes import DeferredRecipe, TracedRecipe
from glassplat.methods.mirrors import (
    OPACITIES_RAISED,
    PROPAGATION_ENDED,
    Propagate,
    RefineEnvironment,
    ResetRaised,
)
from glassplat.methods.recipe import recipe_from_json, recipe_to_json
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.model.run_directory import RunDirectory, RunSettings
from glassplat.model.training import Run
from glassplat.render.deferred import Deferred
from glassplat.scene import logit
from glassplat.scene.scene import Environment, Scene
from glassplat.training.actions import ResetOpacity
from glassplat.training.checkpoint import load_checkpoint, save_checkpoint
from glassplat.training.loop import train
from glassplat.training.messages import ActionDone, Message, StepDone
from glassplat.training.options import (
    GaussianRates,
    Intervals,
    MirrorSearch,
    PropagationSchedule,
    Strategy,
)
from glassplat.training.stage import Clock, Every, TrainState
from tests.training.progress_of import assert_resumes, finished, trained
from tests.training.tiny_capture import tiny_capture

RECIPE = DeferredRecipe(
    sh_degree=1,
    bootstrap=0.2,
    texels=4,
    first_texels=2,
    search=MirrorSearch(begin_found=False),
    region=(0.0, 0.0, 3.5, 1.0),
    intervals=Intervals(opacity=0.1, least=2, sh=0.1),
    schedule=PropagationSchedule(end="fixed", stop=0.7, pause=2),
)


def fresh_state(recipe: DeferredRecipe = RECIPE) -> TrainState:
    return TrainState(recipe.initialise(tiny_capture()), seed=0)


def surrounded_state(recipe: DeferredRecipe) -> TrainState:
    """A state at the start of the second stage."""
    state, setup = fresh_state(recipe), recipe.stages(seed=0)[1].setup
    assert setup is not None
    finished(setup(state, tiny_capture()))
    return state


def run(state: TrainState, recipe: DeferredRecipe = RECIPE, until: int | None = None) -> list[Message]:
    return trained(state, recipe.stages(seed=0), 20, until=until)


def test_a_short_run_learns_strength_and_environment() -> None:
    state = fresh_state()
    steps = [m for m in run(state, until=4) if isinstance(m, StepDone)]
    # Nothing reflects during the bootstrap.
    assert state.scene.environment.is_empty
    assert not any("outside" in step.losses for step in steps)
    run(state, until=5)
    first = state.scene.environment.raw.clone()
    steps = [m for m in run(state) if isinstance(m, StepDone)]
    assert not torch.equal(state.scene.environment.raw, first)
    assert all("outside" in step.losses for step in steps)
    assert all(torch.isfinite(tensor).all() for tensor in state.scene.parameters().values())


def test_the_first_environment_depends_on_the_seed() -> None:
    def first(seed: int) -> torch.Tensor:
        state = TrainState(RECIPE.initialise(tiny_capture()), seed)
        for message in train(RECIPE.stages(seed), tiny_capture(), state, iterations=20):
            if message.step == 4 and not state.scene.environment.is_empty:
                break
        return state.scene.environment.raw

    assert torch.equal(first(0), first(0))
    assert not torch.equal(first(0), first(1))


def test_colours_turn_with_the_view_only_after_propagation() -> None:
    state, degrees = fresh_state(), {}
    for message in train(RECIPE.stages(seed=0), tiny_capture(), state, iterations=20):
        if isinstance(message, StepDone):
            degrees[message.step] = state.scene.primary.active_sh_degree
    assert degrees[13] == 0 and degrees[20] == 1


def test_the_log_lists_only_completed_actions() -> None:
    done = [(m.step, m.action) for m in run(fresh_state()) if isinstance(m, ActionDone)]
    grown = [step for step, action in done if action == "grow SH"]
    propagated = [step for step, action in done if action == "propagate normals"]
    assert len(grown) == RECIPE.sh_degree and propagated and max(propagated) < min(grown)


def test_propagation_and_resets_never_meet() -> None:
    done = [m for m in run(fresh_state()) if isinstance(m, ActionDone)]
    raised = {m.step for m in done if m.action == "propagate normals"}
    lowered = {m.step for m in done if m.action == "reset opacity"}
    assert raised and lowered and not raised & lowered


@pytest.mark.parametrize(
    ("raised", "ended", "resets"),
    [
        (80, None, [30]),
        (25, 28, [30]),
        (0, 10, []),
        (20, 41, [30]),
        (40, 41, [30, 60]),
        (58, 59, [30, 60]),
        (69, 70, [30]),
    ],
    ids=["no end", "before a regular reset", "nothing raised", "lowered", "after the last one", "late", "too late"],
)
def test_opacities_are_reset_once_after_propagation(raised: int, ended: int | None, resets: list[int]) -> None:
    action = ResetRaised.replacing(ResetOpacity(Every(0.1, stop=0.4, only_multiples_of=3)))
    state, done = fresh_state(), []
    for step in range(1, 101):
        clock = Clock(step, 100, 5)
        state.records |= {OPACITIES_RAISED: step} if step == raised else {}
        state.records |= {PROPAGATION_ENDED: step} if step == ended else {}
        if action.due(clock) and action.apply(state, tiny_capture(), clock):
            done.append(step)
    assert done == resets
    assert (float(state.scene.primary.logit_opacities.max()) < -4) == bool(resets)


@pytest.mark.parametrize("pause", [3, 9, 15])
def test_resuming_continues_to_the_same_result(pause: int, tmp_path: Path) -> None:
    resumed = assert_resumes(lambda state, until: run(state, until=until), fresh_state, pause, tmp_path)
    assert resumed.scene.environment.region == RECIPE.region


def test_raised_opacities_are_held_for_a_while() -> None:
    state = fresh_state()
    propagate = Propagate(RECIPE, Deferred())
    propagate.apply(state, tiny_capture(), Clock(8, 20, 5))
    raised = state.scene.primary.logit_opacities.clone()
    assert bool((raised.sigmoid() >= 0.9 - 1e-6).all())
    gradients = {"primary.logit_opacities": torch.ones_like(raised)}
    for _ in range(RECIPE.schedule.pause):
        state.optimizer.step(state.scene.parameters(), gradients, {"primary.logit_opacities": 0.1})
        assert torch.equal(state.scene.primary.logit_opacities, raised)
    state.optimizer.step(state.scene.parameters(), gradients, {"primary.logit_opacities": 0.1})
    assert not torch.equal(state.scene.primary.logit_opacities, raised)


@contextmanager
def told(*reflects: float, turns: float = 0.0) -> Iterator[None]:
    """Replaces the measures of reflection by the given shares, in this order, and the view-dependent share."""
    shares = itertools.chain(reflects, itertools.repeat(reflects[-1]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("glassplat.methods.mirrors.reflective_share", lambda scene, views: next(shares))
        patch.setattr("glassplat.methods.mirrors.view_dependent_share", lambda scene, views, renderer: turns)
        yield


def propagated(
    schedule: PropagationSchedule, *, raise_rates_found: bool = False, state: TrainState | None = None
) -> tuple[TrainState, list[int]]:
    """A state after a run of a hundred steps with intervals of ten, and the steps of propagation."""
    state, done = state or fresh_state(), []
    often = Intervals(opacity=0.1, least=1)
    recipe = DeferredRecipe(schedule=schedule, intervals=often, raise_rates_found=raise_rates_found)
    action = Propagate(recipe, Deferred())
    for step in range(10, 101, 10):
        clock = Clock(step, 100, 5)
        if action.due(clock) and action.apply(state, tiny_capture(), clock):
            done.append(clock.step)
    return state, done


RAISED = dict.fromkeys((f"primary.{name}" for name in ("means", "sh", "log_scales", "quats")), math.sqrt(10))
"""Factors on learning rates in the shortest runs."""


@pytest.mark.parametrize(
    ("end", "shares", "turns", "ended"),
    [
        ("settled", [0.1, 0.2, 0.4, 0.6, 0.6], 0.0, 80),
        ("settled", [0.0, 0.1, 0.1, 0.1], 0.5, 60),
        ("settled", [0.3, 0.2, 0.1, 0.4], 0.0, 50),
        ("settled", [0.300, 0.305, 0.309, 0.5], 0.0, 50),
        ("settled", [0.0], 0.0, 30),
        ("settled", [0.02], 0.0, 30),
        ("settled", [0.0], 0.15, 30),
        ("settled", [0.0], 0.5, 50),
        ("settled", [0.0, 0.2, 0.4, 0.6], 0.5, 80),
        ("fixed", [0.4], 0.0, 90),
    ],
    ids=[
        "grows for long",
        "stays",
        "falls",
        "hardly grows",
        "nothing reflects",
        "hardly anything reflects",
        "hardly anything looks like it",
        "nothing reflects, but looks like it",
        "found",
        "fixed",
    ],
)
def test_propagation_ends_when_no_more_reflectors_are_found(
    end: Literal["settled", "fixed"], shares: list[float], turns: float, ended: int
) -> None:
    schedule = PropagationSchedule(end=end, stop=0.9, patience=2)
    with told(*shares, turns=turns):
        state, done = propagated(schedule)
    assert state.records[PROPAGATION_ENDED] == ended
    # Starting at the first reset, at the intervals not used by resets, until the end.
    assert done == [step for step in (40, 50, 70, 80) if step < ended]


@pytest.mark.parametrize(
    ("share", "turns", "said"),
    [
        (0.4, 0.0, None),
        (0.0, 0.12, "at most 12 % of the visible scene .* --region"),
        (0.004, 0.3, "30 % of the visible scene .* --iterations"),
    ],
)
def test_scenes_without_reflections_raise_the_rates_with_a_log_message(
    share: float, turns: float, said: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level("INFO", logger="glassplat.training"), told(share, turns=turns):
        state, _ = propagated(PropagationSchedule(patience=2))
    warnings = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert state.optimizer.raised_rates == pytest.approx({} if said is None else RAISED)
    _, reflection, refinement = DeferredRecipe().stages(seed=0)
    assert reflection.is_finished is not None and reflection.is_finished(state) == (said is not None)
    assert {term.name for term in reflection.losses} - {term.name for term in refinement.losses} == {"consistency"}
    assert len(warnings) == (said is not None)
    if said is not None:
        assert re.search(rf"nothing reflective was found.*{said}", warnings[0])
    else:
        assert "40 % of the visible scene is reflection" in caplog.messages[-1]


def test_a_region_without_gaussians_is_named(caplog: pytest.LogCaptureFixture) -> None:
    state = fresh_state()
    environment = Environment(torch.zeros(6, 1, 1, 3), region=(50.0, 0.0, 0.5, 2.0))
    state.scene = replace(state.scene, environment=environment)
    propagated(PropagationSchedule(patience=2), state=state)
    (warning,) = [record.getMessage() for record in caplog.records]
    assert "uses the learning rates of splat" in warning
    assert "no Gaussian lies in the sphere outside which nothing reflects, of radius 2 around (50, 0, 0.5)" in warning


def test_unchanged_rates_are_not_logged(caplog: pytest.LogCaptureFixture) -> None:
    schedule = PropagationSchedule(end="fixed", stop=0.5)
    action = Propagate(DeferredRecipe(schedule=schedule, raise_rates_matte=False), Deferred())
    with told(0.0):
        action.apply(fresh_state(), tiny_capture(), Clock(50, 100, 5))
    assert "little or nothing reflective" in caplog.text and "the learning rates of splat" not in caplog.text


@pytest.mark.parametrize("recipe", [DeferredRecipe(), TracedRecipe(), TracedRecipe(raise_rates_found=False)])
def test_scenes_with_reflections_raise_the_rates_on_request(
    recipe: DeferredRecipe | TracedRecipe,
) -> None:
    (action,) = (action for action in recipe.stages(seed=0)[1].actions if isinstance(action, Propagate))
    with told(0.4):
        state, _ = propagated(PropagationSchedule(patience=2), raise_rates_found=action.recipe.raise_rates_found)
    assert state.optimizer.raised_rates == pytest.approx(RAISED if recipe.raise_rates_found else {})
    assert state.records[PROPAGATION_ENDED] > 10


def test_scenes_without_reflections_use_the_rates_of_splat() -> None:
    own, splat = DeferredRecipe(), SplatRecipe()
    reflection = own.stages(seed=0)[1]
    (action,) = (action for action in reflection.actions if isinstance(action, Propagate))
    for name, rate in splat.stages(seed=0)[0].rates.items():
        for iterations in (500, 3000, 7000, 30_000):
            factor = action.matte_rates[name].at(0.4, 1.0, iterations) if name in action.matte_rates else 1.0
            expected = rate.at(0.4, 1.0, iterations)
            assert reflection.rates[name].at(0.4, 1.0, iterations) * factor == pytest.approx(expected)


def scene_after(recipe: Any, iterations: int, directory: Path) -> Scene:
    settings = RunSettings("tiny", iterations=iterations)
    Run(recipe, settings, RunDirectory(directory), tiny_capture(), resume=False).run_to_end(lambda message: None)
    return load_checkpoint(directory / "checkpoint.safetensors").scene


@pytest.mark.parametrize(("strategy", "iterations"), [("default", 760), ("mcmc", 120)])
def test_a_run_too_short_for_normals_trains_as_splat_with_a_message(
    strategy: Strategy, iterations: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    # Only the longer run includes an opacity reset, the first one.
    choices: dict[str, Any] = {"sh_degree": 1, "strategy": strategy, "intervals": Intervals(reset_stop=1.0)}
    matte = DeferredRecipe(**choices, least_iterations=iterations + 1, region=(0.0, 0.0, 3.5, 1.0))
    plain = scene_after(SplatRecipe(**choices), iterations, tmp_path / "splat")
    assert not caplog.records
    found = scene_after(matte, iterations, tmp_path / "deferred")
    (warning,) = [record.getMessage() for record in caplog.records]
    assert f"{iterations} iterations are too few" in warning
    assert f"need {iterations + 1} --iterations" in warning and "--least-iterations 1" in warning
    for name in ("means", "sh", "log_scales", "quats", "logit_opacities"):
        assert torch.equal(getattr(found.primary, name), getattr(plain.primary, name)), name
    camera = tiny_capture().test[0].camera
    seen = matte.renderer()(found, camera).rgb, SplatRecipe(**choices).renderer()(plain, camera).rgb
    torch.testing.assert_close(*seen, rtol=0, atol=1e-6)
    assert found.environment.region == matte.region


def test_a_run_long_enough_for_normals_has_all_stages(tmp_path: Path) -> None:
    recipe = replace(RECIPE, least_iterations=20)
    assert len(recipe.stages(0, 19)) == 1 and len(recipe.stages(0, 20)) == len(recipe.stages(0)) == 3
    strengths = scene_after(recipe, 20, tmp_path).primary.channels["logit_strength"]
    assert bool((strengths != logit(recipe.first_strength)).any())


def test_short_runs_use_the_rates_of_splat_by_default() -> None:
    def rates(recipe: Any) -> Any:
        return recipe.stages(0, 3000)[0].rates

    assert rates(DeferredRecipe()) == rates(SplatRecipe())
    assert rates(DeferredRecipe(raise_rates_matte=False)) == rates(
        SplatRecipe(rates=GaussianRates(short_run_power=0.0))
    )


def test_a_parameter_with_a_raised_rate_moves_as_much_faster_also_when_resumed(tmp_path: Path) -> None:
    steps = []
    for raised_rates in ({}, {"primary.means": 3.0}):
        state = fresh_state()
        state.optimizer.raised_rates = dict(raised_rates)
        save_checkpoint(tmp_path / "checkpoint.safetensors", state)
        resumed = load_checkpoint(tmp_path / "checkpoint.safetensors")
        before = resumed.scene.primary.means.clone()
        gradients = {"primary.means": torch.ones_like(before)}
        resumed.optimizer.step(resumed.scene.parameters(), gradients, {"primary.means": 0.1})
        steps.append(resumed.scene.primary.means - before)
    torch.testing.assert_close(steps[1], 3 * steps[0])


LENGTHS = [*range(1, 3000, 61), 900, 1350, 1800, 3000, 7000, 15_000, 30_000]


@pytest.mark.parametrize("end", ["settled", "fixed"])
@pytest.mark.parametrize("iterations", LENGTHS)
def test_a_reset_leaves_the_steps_to_recover(iterations: int, end: Literal["settled", "fixed"]) -> None:
    actions = DeferredRecipe(schedule=PropagationSchedule(end=end)).stages(seed=0)[1].actions
    resets = [action for action in actions if isinstance(action, ResetOpacity)]
    (propagate,) = (action for action in actions if isinstance(action, Propagate))
    clocks = [Clock(step, iterations, 80) for step in range(1, iterations + 1)]
    ends = [clock.step for clock in clocks if propagate.due(clock)]
    moments = [(clock, reset) for clock in clocks for reset in resets if reset.due(clock)]
    state, capture = fresh_state(), tiny_capture()
    for ended in ends if end == "settled" else ends[-1:]:
        done = []
        state.records = {}
        for clock, reset in moments:
            if clock.step >= ended:
                state.records |= {PROPAGATION_ENDED: ended, OPACITIES_RAISED: ended - 1}
            if reset.apply(state, capture, clock):
                done.append(clock.step)
        assert all(iterations - step >= 450 for step in done), ended
        # If time permits, the opacities raised by propagation are reset once more.
        assert max(done, default=0) >= ended or iterations - ended < 2 * 450 + iterations / 15


def test_the_environment_is_refined_up_to_its_size() -> None:
    state, sizes = fresh_state(), {}
    for message in train(RECIPE.stages(seed=0), tiny_capture(), state, iterations=20):
        if isinstance(message, StepDone):
            sizes[message.step] = state.scene.environment.size
    assert [sizes[step] for step in (4, 5, 8, 9, 12, 20)] == [0, 2, 2, 4, 4, 4]
    assert state.scene.environment.region == RECIPE.region


@pytest.mark.parametrize(
    ("first", "last", "sizes"),
    [
        (16, 256, [16, 32, 64, 128, 256]),
        (16, 64, [16, 32, 64]),
        (16, 32, [16, 32]),
        (16, 40, [16, 32, 40]),
        (64, 64, [64]),
        (64, 16, [16]),
        (1, 1000, [1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1000]),
    ],
)
def test_the_environment_reaches_any_size_between_its_first_and_last_refinement(
    first: int, last: int, sizes: list[int]
) -> None:
    recipe = DeferredRecipe(first_texels=first, texels=last)
    state, reached = surrounded_state(recipe), {}
    (action,) = [a for a in recipe.stages(seed=0)[1].actions if isinstance(a, RefineEnvironment)]
    for step in range(1, 101):
        clock = Clock(step, 100, views=6)
        if action.due(clock):
            action.apply(state, tiny_capture(), clock)
        reached.setdefault(state.scene.environment.size, step)
    assert list(reached) == sizes
    assert len(sizes) == 1 or list(reached.values())[1] == 45
    assert len(sizes) < 3 or list(reached.values())[-1] == 65


@pytest.mark.parametrize("bootstrap", [0.0, 0.45, 0.5, 0.7])
def test_the_environment_reaches_its_size_after_a_bootstrap_of_any_length(bootstrap: float) -> None:
    recipe = replace(RECIPE, bootstrap=bootstrap, texels=8, schedule=PropagationSchedule(stop=0.9))
    state = fresh_state()
    for _ in train(recipe.stages(seed=0), tiny_capture(), state, iterations=40):
        pass
    assert state.scene.environment.size == 8


@pytest.mark.parametrize("iterations", [1, 3, 10])
def test_the_shortest_run_refines_its_environment_in_full(iterations: int) -> None:
    recipe = DeferredRecipe(texels=256)
    state = surrounded_state(recipe)
    (action,) = [a for a in recipe.stages(seed=0)[1].actions if isinstance(a, RefineEnvironment)]
    for step in range(iterations + 1):
        clock = Clock(step, iterations, views=6)
        if action.due(clock):
            action.apply(state, tiny_capture(), clock)
    assert state.scene.environment.size == 256


@pytest.mark.parametrize("iterations", [20, 23, 7001])
def test_propagation_ends_in_runs_of_any_length(iterations: int) -> None:
    schedule = PropagationSchedule(end="fixed", stop=0.61)
    recipe, state = DeferredRecipe(schedule=schedule, intervals=Intervals(opacity=0.1, least=1)), fresh_state()
    action = Propagate(recipe, Deferred())
    with told(0.5):
        for step in range(1, iterations + 1):
            clock = Clock(step, iterations, 5)
            if action.due(clock):
                action.apply(state, tiny_capture(), clock)
    assert state.records[PROPAGATION_ENDED] == pytest.approx(0.61 * iterations, abs=0.5)


def test_the_recipe_round_trips_through_json() -> None:
    assert recipe_from_json(recipe_to_json(RECIPE)) == RECIPE


@pytest.mark.parametrize("recipe", [DeferredRecipe(), TracedRecipe()], ids=["deferred", "traced"])
def test_estimated_normals_count_from_when_things_reflect(recipe: DeferredRecipe | TracedRecipe) -> None:
    def weights(one: DeferredRecipe | TracedRecipe) -> list[list[float]]:
        terms = [stage.losses for stage in one.stages(0, 7000)]
        return [[term.weight for term in losses if term.name == "monocular normals"] for losses in terms]

    assert weights(recipe) == [[], [0.5], [0.5]]
    assert weights(replace(recipe, monocular_weight=0.0)) == [[], [], []]


def test_mirrors_are_searched_for_after_a_minimum_of_steps() -> None:
    def steps(recipe: DeferredRecipe | TracedRecipe, iterations: int) -> int:
        stages = recipe.stages(0, iterations)
        assert sum(stage.share for stage in stages) == pytest.approx(1)
        return round(stages[0].share * iterations)

    short = replace(DeferredRecipe(), least_iterations=1)
    assert [steps(short, iterations) for iterations in (700, 1000, 4999, 7000)] == [262, 300, 300, 420]
    assert [steps(TracedRecipe(least_iterations=1), iterations) for iterations in (1000, 2000)] == [300, 500]
    assert steps(DeferredRecipe.paper(), 1000) == round(1000 * DeferredRecipe.paper().bootstrap)
    assert short.stages(0, 5000)[0].share == short.bootstrap
