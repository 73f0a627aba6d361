"""`python -m benchmarks.parts METHOD [--data CAPTURE] [--iterations N]`: profile of a training run by stage.

Trains, and times every kernel launch; the rest of a step is Python and PyTorch between the launches. Times are CPU time
on one thread, so that other programs hardly matter.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import numba
import torch

from benchmarks.table import Table
from glassplat.captures.dataset import load_dataset
from glassplat.cli.train import DEMO_DOWNSCALE, SCENE
from glassplat.kernels.backend.cpu import Kernel
from glassplat.methods.recipe import RECIPES, photo_background, recipe_of, resolve_background
from glassplat.training.loop import train
from glassplat.training.messages import Message, StageEntered, StepDone
from glassplat.training.stage import TrainState

BEFORE, BETWEEN, TOTAL, STEPS = "before its first step", "between kernels", "all of it", "steps"
LEAST_SHARE = 0.005
"""Share of a stage; kernels below it have no row."""

Seconds = defaultdict[str, float]
Costs = dict[str, Seconds]
"""Seconds by stage and part, and the number of steps."""


@contextmanager
def timed_kernels(seconds: Seconds) -> Iterator[None]:
    """Adds the CPU time of each launch to the total of its kernel."""
    launch = Kernel.__call__

    def timed(kernel: Kernel, *arguments: Any) -> Any:
        started = time.process_time()
        try:
            return launch(kernel, *arguments)
        finally:
            seconds[kernel.name] += time.process_time() - started

    with mock.patch.object(Kernel, "__call__", timed):
        yield


def costs_of(messages: Iterator[Message]) -> Costs:
    """Costs of the stages of a run; the preparation of a stage is counted separately from its steps."""
    costs: Costs = {}
    seconds: Seconds = defaultdict(float)
    with timed_kernels(seconds):
        started = time.process_time()
        for message in messages:
            if not isinstance(message, StageEntered | StepDone):
                continue
            taken = time.process_time() - started
            if isinstance(message, StageEntered):
                stage = costs.setdefault(message.stage, defaultdict(float))
                stage[BEFORE] += taken
            else:
                add_step(stage, seconds, taken)
            seconds.clear()
            started = time.process_time()
    return costs


def add_step(stage: Seconds, kernels: Seconds, taken: float) -> None:
    """Adds a step that took `taken` seconds in all and `kernels` in each kernel."""
    stage[STEPS] += 1
    stage[TOTAL] += taken
    stage[BETWEEN] += taken - sum(kernels.values())
    for name, seconds in kernels.items():
        stage[name] += seconds


def parts_table(costs: Mapping[str, Mapping[str, float]], title: str) -> Table:
    """Milliseconds per step by part, for each stage."""
    note = "Milliseconds of CPU time per step on one thread, unless the row says otherwise."
    table, stages = Table(title, ("part", *costs), note), list(costs.values())
    table.add("steps", *(round(stage.get(STEPS, 0)) for stage in stages))
    table.add(f"{BEFORE}, seconds in all", *(stage.get(BEFORE, 0.0) for stage in stages))
    kernels = {part for stage in stages for part in stage} - {STEPS, BEFORE, TOTAL, BETWEEN}
    shares = {k: max(stage.get(k, 0.0) / max(stage.get(TOTAL, 0.0), 1e-9) for stage in stages) for k in kernels}
    shown = sorted((k for k in kernels if shares[k] >= LEAST_SHARE), key=shares.__getitem__, reverse=True)
    for part in (TOTAL, BETWEEN, *shown):
        means = (1e3 * stage.get(part, 0.0) / max(1.0, stage.get(STEPS, 0)) for stage in stages)
        table.add(part.removesuffix("_float32"), *means)
    return table


def main() -> None:
    """Trains, measures and prints the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.parts", description=__doc__)
    parser.add_argument("method", choices=list(RECIPES))
    parser.add_argument("--data", type=Path, default=SCENE, help="capture; default: the bundled one")
    parser.add_argument("--downscale", type=float, default=DEMO_DOWNSCALE, help="reduction factor of photographs")
    parser.add_argument("--iterations", type=int, default=3000, help="length of the run")
    arguments = parser.parse_args()
    numba.set_num_threads(1)
    torch.set_num_threads(1)
    recipe = recipe_of(arguments.method)
    dataset = load_dataset(arguments.data, downscale=arguments.downscale, background=photo_background(recipe))
    recipe = resolve_background(recipe, dataset)
    state = TrainState(recipe.initialise(dataset), seed=0)
    stages = recipe.stages(state.seed, arguments.iterations)
    costs = costs_of(train(stages, dataset, state, arguments.iterations))
    title = f"A run of `{arguments.method}`: {arguments.data.name}, {arguments.iterations} iterations"
    print(parts_table(costs, title).markdown())


if __name__ == "__main__":
    main()
