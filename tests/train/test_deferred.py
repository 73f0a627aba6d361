"""The `deferred` recipe: its stages, when propagation ends, a short run, and resuming."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from glassplat.densify.propagate import NormalPropagation
from glassplat.train.actions import ResetOpacity
from glassplat.train.checkpoint import load_checkpoint, save_checkpoint
from glassplat.train.deferred_recipe import DeferredRecipe
from glassplat.train.messages import ActionDone, Message, StepDone
from glassplat.train.propagation import (
    ENDED,
    Propagate,
    PropagationSchedule,
    RefineEnvironment,
    ResetAfterPropagation,
)
from glassplat.train.recipe import recipe_from_json, recipe_to_json
from glassplat.train.stage import Clock, Every
from glassplat.train.state import TrainState
from glassplat.train.strategy import Rhythm
from glassplat.train.trainer import train
from tests.train.tiny_capture import tiny_capture

RECIPE = DeferredRecipe(
    sh_degree=1,
    bootstrap=0.2,
    texels=4,
    first_texels=2,
    refinements=(0.4, 0.6),
    region=(0.0, 0.0, 3.5, 1.0),
    rhythm=Rhythm(beat=0.1, least=2, sh=0.1),
    schedule=PropagationSchedule(end="fixed", stop=0.7, pause=2),
)


def fresh_state(recipe: DeferredRecipe = RECIPE) -> TrainState:
    return TrainState(recipe.initialise(tiny_capture()), seed=0)


def run(state: TrainState, recipe: DeferredRecipe = RECIPE, until: int | None = None) -> list[Message]:
    messages = []
    for message in train(recipe.stages(seed=0), tiny_capture(), state, iterations=20):
        messages.append(message)
        if isinstance(message, StepDone) and message.step == until:
            break
    return messages


def test_a_short_run_learns_strength_and_environment() -> None:
    state = fresh_state()
    first = {name: tensor.clone() for name, tensor in state.scene.parameters().items()}
    steps = [m for m in run(state, until=4) if isinstance(m, StepDone)]
    # Nothing reflects during the bootstrap.
    assert torch.equal(state.scene.environment.raw, first["environment.raw"])
    assert not any("outside" in step.losses for step in steps)
    steps = [m for m in run(state) if isinstance(m, StepDone)]
    assert not torch.equal(state.scene.environment.raw, first["environment.raw"])
    assert all("outside" in step.losses for step in steps)
    assert all(torch.isfinite(tensor).all() for tensor in state.scene.parameters().values())


def test_colours_turn_with_the_view_only_after_propagation() -> None:
    state, degrees = fresh_state(), {}
    for message in train(RECIPE.stages(seed=0), tiny_capture(), state, iterations=20):
        degrees[message.step] = state.scene.primary.active_sh_degree
    assert degrees[13] == 0 and degrees[20] == 1


def test_the_log_tells_only_of_what_was_done() -> None:
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
    ("ended", "resets"),
    [(None, []), (10, []), (41, [60]), (70, [90]), (91, [])],
    ids=["never", "before a regular reset", "after the last one", "late", "too late"],
)
def test_opacities_are_reset_once_after_propagation(ended: int | None, resets: list[int]) -> None:
    regular = ResetOpacity(Every(0.1, stop=0.4, only_multiples_of=3))
    state, action, done = fresh_state(), ResetAfterPropagation.following(regular), []
    for step in range(1, 101):
        clock = Clock(step, 100, 5)
        if step == ended:
            state.records[ENDED] = step
        if action.due(clock) and action.apply(state, tiny_capture(), clock):
            done.append(step)
    assert done == resets
    assert (float(state.scene.primary.logit_opacities.max()) < -4) == bool(resets)


@pytest.mark.parametrize("pause", [3, 9, 15])
def test_resuming_continues_to_the_same_result(pause: int, tmp_path: Path) -> None:
    whole, interrupted = fresh_state(), fresh_state()
    run(whole)
    run(interrupted, until=pause)
    save_checkpoint(tmp_path / "checkpoint.safetensors", interrupted)
    resumed = load_checkpoint(tmp_path / "checkpoint.safetensors")
    assert resumed.scene.environment.region == RECIPE.region
    run(resumed)
    assert whole.records == resumed.records
    for name, tensor in whole.scene.parameters().items():
        assert torch.equal(tensor, resumed.scene.parameters()[name]), name


def test_raised_opacities_are_held_for_a_while() -> None:
    state = fresh_state()
    propagate = Propagate(Every(0.1), NormalPropagation(), RECIPE.schedule)
    propagate.apply(state, tiny_capture(), Clock(8, 20, 5))
    raised = state.scene.primary.logit_opacities.clone()
    assert bool((raised.sigmoid() >= 0.9 - 1e-6).all())
    gradients = {"primary.logit_opacities": torch.ones_like(raised)}
    for _ in range(RECIPE.schedule.pause):
        state.optimizer.step(state.scene.parameters(), gradients, {"primary.logit_opacities": 0.1})
        assert torch.equal(state.scene.primary.logit_opacities, raised)
    state.optimizer.step(state.scene.parameters(), gradients, {"primary.logit_opacities": 0.1})
    assert not torch.equal(state.scene.primary.logit_opacities, raised)


def with_reflective(state: TrainState, count: int) -> None:
    """Makes the first `count` Gaussians reflect, and no others."""
    strengths = torch.full((len(state.scene.primary),), -7.0)
    strengths[:count] = 3.0
    state.scene = replace(state.scene, primary=state.scene.primary.with_tensors({"logit_strength": strengths}))


@pytest.mark.parametrize(
    ("end", "counts", "ended"),
    [
        ("settled", [1, 2, 4, 8, 16], None),
        ("settled", [1, 4, 4, 4, 4], 40),
        ("settled", [4, 3, 2, 4, 8], 30),
        ("settled", [0, 0, 0, 0, 0], 30),
        ("fixed", [4, 4, 4, 4, 4], None),
        ("fixed", [1, 2, 4, 8, 16, 17], 60),
    ],
    ids=["grows", "stays", "falls", "nothing reflects", "fixed goes on", "fixed stops"],
)
def test_propagation_ends_when_no_more_reflectors_are_found(end: str, counts: list[int], ended: int | None) -> None:
    schedule = PropagationSchedule(end=end, stop=0.6, patience=0.2)  # type: ignore[arg-type]
    state, action = fresh_state(), Propagate(Every(0.1, stop=0.6), NormalPropagation(), schedule)
    for turn, count in enumerate(counts, start=1):
        with_reflective(state, count)
        clock = Clock(10 * turn, 100, 5)
        if action.due(clock):
            action.apply(state, tiny_capture(), clock)
    assert state.records.get(ENDED) == ended


def test_a_few_reflectors_among_many_gaussians_do_not_keep_propagation_going() -> None:
    schedule = PropagationSchedule(stop=0.6, patience=0.2)
    state, action = fresh_state(), Propagate(Every(0.1, stop=0.6), NormalPropagation(), schedule)
    primary = state.scene.primary
    repeats = -(-1000 // len(primary))
    many = {name: torch.cat([tensor] * repeats) for name, tensor in primary.tensors().items()}
    state.scene = replace(state.scene, primary=primary.with_tensors(many))
    for turn, count in enumerate([1, 4, 8], start=1):
        with_reflective(state, count)
        action.apply(state, tiny_capture(), Clock(10 * turn, 100, 5))
    assert state.records.get(ENDED) == 30


def test_the_environment_is_refined_up_to_its_size() -> None:
    state, sizes = fresh_state(), {}
    for message in train(RECIPE.stages(seed=0), tiny_capture(), state, iterations=20):
        sizes[message.step] = state.scene.environment.size
    assert [sizes[step] for step in (4, 7, 8, 12, 20)] == [2, 2, 4, 4, 4]
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
    state, reached = fresh_state(recipe), {}
    (action,) = [a for a in recipe.stages(seed=0)[1].actions if isinstance(a, RefineEnvironment)]
    for step in range(1, 101):
        clock = Clock(step, 100, views=6)
        if action.due(clock):
            action.apply(state, tiny_capture(), clock)
        reached.setdefault(state.scene.environment.size, step)
    assert list(reached) == sizes
    assert len(sizes) == 1 or list(reached.values())[1] == 45
    assert len(sizes) < 3 or list(reached.values())[-1] == 65


@pytest.mark.parametrize("iterations", [1, 3, 10])
def test_the_shortest_run_refines_its_environment_in_full(iterations: int) -> None:
    recipe = DeferredRecipe(texels=256)
    state = fresh_state(recipe)
    (action,) = [a for a in recipe.stages(seed=0)[1].actions if isinstance(a, RefineEnvironment)]
    for step in range(iterations + 1):
        clock = Clock(step, iterations, views=6)
        if action.due(clock):
            action.apply(state, tiny_capture(), clock)
    assert state.scene.environment.size == 256


@pytest.mark.parametrize("iterations", [20, 23, 7001])
def test_propagation_ends_in_runs_of_any_length(iterations: int) -> None:
    schedule = PropagationSchedule(end="fixed", stop=0.61)
    state, action = fresh_state(), Propagate(Every(1 / 3, stop=0.61), NormalPropagation(), schedule)
    for step in range(1, iterations + 1):
        clock = Clock(step, iterations, 5)
        if action.due(clock):
            action.apply(state, tiny_capture(), clock)
    assert state.records[ENDED] == pytest.approx(0.61 * iterations, abs=0.5)


def test_the_recipe_survives_json() -> None:
    assert recipe_from_json(recipe_to_json(RECIPE)) == RECIPE
