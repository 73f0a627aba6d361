"""When stages begin and recurring moments are due."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from glassplat.train.optimizer import Rate
from glassplat.train.stage import Clock, Every, stage_starts


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


def test_a_rate_decays_exponentially_and_scales_with_the_extent() -> None:
    rate = Rate(1e-2, 1e-4, per_extent=True)
    assert rate.at(0.0, 5.0) == pytest.approx(5e-2)
    assert rate.at(0.5, 5.0) == pytest.approx(5e-3)
    assert rate.at(1.0, 5.0) == pytest.approx(5e-4)
    assert Rate(1e-3).at(0.7, 5.0) == 1e-3


def test_short_runs_raise_the_rates_that_say_so() -> None:
    rate = Rate(1e-2, 1e-4, short_run_power=0.5)
    for progress in (0.0, 0.4, 1.0):
        assert rate.at(progress, 1.0, 7500) == pytest.approx(2 * rate.at(progress, 1.0, 30_000))
    assert rate.at(0.4, 1.0, 30_000) == rate.at(0.4, 1.0, 90_000) == Rate(1e-2, 1e-4).at(0.4, 1.0, 300)
    assert rate.at(0.4, 1.0, 300) == rate.at(0.4, 1.0, 3000)
