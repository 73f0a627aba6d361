"""How far a plane may go in a run."""

from __future__ import annotations

import pytest

from glassplat.train.planar_recipe import PlanarRecipe, PlaneRates
from glassplat.train.stage import stage_starts

NAMES = ("planes.raw_normals", "planes.centers")


def ways(iterations: int, rates: PlaneRates | None = None) -> list[float]:
    """How far Adam may move normals and, in an extent of 2, centres: in the second stage, and in the third."""
    stages = PlanarRecipe(plane_rates=rates or PlaneRates()).stages(0, iterations)
    starts = stage_starts(stages, iterations)
    return [
        sum(stage.rates[name].at(step / iterations, 2.0, iterations) for step in range(start, end))
        for stage, start, end in zip(stages[1:], starts[1:-1], starts[2:], strict=True)
        for name in NAMES
    ]


@pytest.mark.parametrize("iterations", [7000, 30_000])
def test_long_runs_turn_a_plane_no_farther(iterations: int) -> None:
    assert ways(iterations) == pytest.approx(ways(3000), rel=1e-3)


def test_short_runs_keep_the_rates_of_their_options() -> None:
    assert ways(1000) == pytest.approx([way / 3 for way in ways(3000)], rel=1e-3)
    assert ways(3000) == pytest.approx([300 * 1e-4, 300 * 2e-4, 2400 * 1e-5, 2400 * 2e-5], rel=1e-6)
    assert ways(3000, PlaneRates(normal=2e-4, joint_factor=0.0))[::2] == pytest.approx([600 * 1e-4, 0.0], rel=1e-6)
