"""Distribution of a run's time: kernels, the time between them, and the work of a stage before its first step."""

from __future__ import annotations

import time
from collections.abc import Iterator

from benchmarks.parts import BEFORE, BETWEEN, STEPS, TOTAL, costs_of, parts_table
from glassplat.kernels.backend.cpu import Kernel
from glassplat.training.messages import ActionDone, Message, StageEntered, StepDone, Working


def busy(seconds: float) -> None:
    """Computes for the given processor time."""
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass


def run() -> Iterator[Message]:
    fit, blend = (Kernel(busy, name, parallel=False) for name in ("fit_float32", "blend_float32"))
    fit(0.01)
    yield Working("fitting", 1, 1)
    yield StageEntered(0, "only", {})
    for step in (1, 2):
        blend(0.01)
        busy(0.005)
        yield StepDone(step, "view", 0.0, {}, {})
        yield ActionDone(step, "densify", {})


def test_every_second_belongs_to_one_part() -> None:
    (costs,) = costs_of(run()).values()
    assert costs[STEPS] == 2
    assert costs[BEFORE] >= 0.01
    assert costs["blend_float32"] >= 0.02
    assert costs[BETWEEN] >= 0.01
    # The stage's work before its first step does not belong to a step.
    assert "fit_float32" not in costs
    assert abs(costs[TOTAL] - costs[BETWEEN] - costs["blend_float32"]) < 1e-9


def test_the_table_lists_the_mean_duration_of_a_step() -> None:
    table = parts_table({"only": {STEPS: 2, BEFORE: 3.0, TOTAL: 0.4, BETWEEN: 0.1, "blend_float32": 0.3}}, "A run")
    assert table.rows == [
        ("steps", "2"),
        ("before its first step, seconds in all", "3"),
        ("all of it", "200"),
        ("between kernels", "50"),
        ("blend", "150"),
    ]
