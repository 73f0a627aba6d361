"""Timing of whole steps: all numbers of threads alternate within a single run."""

from __future__ import annotations

from collections.abc import Iterator

import numba

from benchmarks.methods import doublings
from benchmarks.steps import step_clocks
from glassplat.training.messages import ActionDone, Message, StepDone


def test_every_number_of_threads_takes_its_turn() -> None:
    threads: list[int] = []
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)

    def run() -> Iterator[Message]:
        for step in range(100):
            threads.append(numba.get_num_threads())
            yield StepDone(step, "view", 0.0, {}, {})
            yield ActionDone(step, "densify", {})

    counts = doublings(numba.config.NUMBA_NUM_THREADS)
    times = step_clocks(run(), rounds=2)
    # Two rounds are reported, after a warm-up round.
    assert {count: len(known) for count, known in times.items()} == dict.fromkeys(counts, 2)
    assert threads == counts * 3
    assert numba.get_num_threads() == numba.config.NUMBA_NUM_THREADS
