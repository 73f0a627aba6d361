"""Start of stages, and steps at which recurring actions are due."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from glassplat.errors import InputError
from glassplat.methods.glossy_recipes import DeferredRecipe
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.training.messages import Working
from glassplat.training.options import Rate
from glassplat.training.stage import Clock, Every, Work, check_length, stage_starts, stages_without_step
from tests.training.progress_of import followed


def moments(every: Every, iterations: int) -> list[int]:
    return [step for step in range(1, iterations + 1) if every.due(Clock(step, iterations, views=10))]


def test_stages_stretch_with_the_run() -> None:
    stages: Any = tuple(SimpleNamespace(share=share) for share in (0.1, 0.1, 0.8))
    assert stage_starts(stages, 30_000) == [0, 3000, 6000, 30_000]
    assert stage_starts(stages, 2000) == [0, 200, 400, 2000]
    assert stage_starts(stages, 3) == [0, 0, 1, 3]


@pytest.mark.parametrize("iterations", [3000, 30_000])
def test_a_recurring_moment_keeps_its_share_of_the_run(iterations: int) -> None:
    assert moments(Every(0.1, start=0.2, stop=0.5), iterations) == [round(s * iterations) for s in (0.3, 0.4, 0.5)]


def test_a_short_run_keeps_the_least_distance() -> None:
    assert moments(Every(0.1, least=250), 1000) == [250, 500, 750, 1000]


def test_two_moments_interleave() -> None:
    perturbed = moments(Every(0.1, skip_multiples_of=3), 100)
    reset = moments(Every(0.1, only_multiples_of=3), 100)
    assert perturbed == [10, 20, 40, 50, 70, 80, 100] and reset == [30, 60, 90]


def test_a_learning_rate_decays_exponentially_and_scales_with_the_extent() -> None:
    rate = Rate(1e-2, 1e-4, per_extent=True)
    assert rate.at(0.0, 5.0) == pytest.approx(5e-2)
    assert rate.at(0.5, 5.0) == pytest.approx(5e-3)
    assert rate.at(1.0, 5.0) == pytest.approx(5e-4)
    assert Rate(1e-3).at(0.7, 5.0) == 1e-3


def test_short_runs_raise_only_the_marked_rates() -> None:
    rate = Rate(1e-2, 1e-4, short_run_power=0.5)
    for progress in (0.0, 0.4, 1.0):
        assert rate.at(progress, 1.0, 7500) == pytest.approx(2 * rate.at(progress, 1.0, 30_000))
    assert rate.at(0.4, 1.0, 30_000) == rate.at(0.4, 1.0, 90_000) == Rate(1e-2, 1e-4).at(0.4, 1.0, 300)
    assert rate.at(0.4, 1.0, 300) == rate.at(0.4, 1.0, 3000)


@pytest.mark.parametrize("recipe", [SplatRecipe(), PlanarRecipe(), DeferredRecipe()], ids=lambda recipe: recipe.method)
def test_the_minimum_length_of_a_run_fits_every_stage(recipe: Any) -> None:
    stages = recipe.stages(seed=0)
    for iterations in range(1, 40):
        if not stages_without_step(stages, iterations):
            check_length(stages, iterations)
            continue
        with pytest.raises(InputError, match=f"^{iterations} iterations are too few") as caught:
            check_length(stages, iterations)
        least = int(str(caught.value).rpartition(" ")[2])
        check_length(stages, least)
        assert all(stages_without_step(stages, shorter) for shorter in range(iterations, least))


def test_a_stage_without_a_share_is_missed_only_for_what_it_begins_with() -> None:
    def stages(setup: Any) -> Any:
        shares = (0.5, 0.0, 0.5)
        return tuple(SimpleNamespace(name=f"{k}", share=s, setup=k == 1 and setup) for k, s in enumerate(shares))

    check_length(stages(None), 2)
    with pytest.raises(InputError, match="the stage '1' has no share"):
        check_length(stages(print), 2)


def test_the_minimum_length_for_a_tiny_stage_is_found_quickly() -> None:
    stages: Any = tuple(SimpleNamespace(name=f"{share}", share=share, setup=None) for share in (0.5, 1e-12, 0.5))
    with pytest.raises(InputError, match="are too few for the stage '1e-12'; expected at least") as caught:
        check_length(stages, 1000)
    assert int(str(caught.value).rpartition(" ")[2]) > 1e11


def slow_edit(found: bool) -> Work:
    yield Working("editing", 0, 2)
    yield Working("editing", 1, 2)
    return found


@pytest.mark.parametrize("found", [True, False])
def test_an_edit_reports_progress_or_returns_at_once(found: bool) -> None:
    assert followed(slow_edit(found)) == ([Working("editing", 0, 2), Working("editing", 1, 2)], found)
    assert followed(found) == ([], found)
    assert followed(None) == ([], False)
