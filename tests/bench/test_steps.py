"""The table of whole steps, on a capture of a few pixels."""

from __future__ import annotations

from typing import Any

import numba

from bench.methods import doublings
from bench.steps import step_costs
from glassplat.data.dataset import Dataset
from glassplat.train.splat_recipe import SplatRecipe
from glassplat.train.state import TrainState
from tests.train.tiny_capture import tiny_capture


def test_every_number_of_threads_takes_steps_of_the_same_run() -> None:
    recipe, dataset = SplatRecipe(sh_degree=1), tiny_capture()
    state = TrainState(recipe.initialise(dataset), seed=0)

    def begin() -> tuple[Any, Dataset, TrainState, int]:
        return recipe, dataset, state, 100

    counts = doublings(numba.config.NUMBA_NUM_THREADS)
    lines = step_costs((begin,), rounds=2).markdown().splitlines()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines if "| splat |" in line]
    assert [int(row[4]) for row in rows] == counts
    assert all(float(cell) > 0 for row in rows for cell in row[5:])
    assert state.step == 3 * len(counts)
    assert numba.get_num_threads() == numba.config.NUMBA_NUM_THREADS
