"""Complete training steps: python -m benchmarks.steps [--data CAPTURE] [--run RUN].

A step is the frame, its losses and gradients, Adam, and the statistics for densification.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba

from benchmarks.methods import doublings, thread_count
from benchmarks.table import Table
from benchmarks.timing import clocks_of
from glassplat.captures.dataset import Dataset, load_dataset
from glassplat.cli.runs import open_run
from glassplat.cli.train import SCENE
from glassplat.methods.recipe import photo_background, resolve_background
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.training.checkpoint import load_checkpoint
from glassplat.training.loop import train
from glassplat.training.messages import Message, StepDone
from glassplat.training.stage import TrainState, stage_starts

ITERATIONS = 7000
"""Length of the run whose first steps are timed."""

Begin = Callable[[], tuple[Any, Dataset, TrainState, int]]
"""Returns recipe, capture, state and length of a run."""


def first_steps(capture: Path) -> Begin:
    """The start of a `splat` run, with one Gaussian per point of a capture."""

    def begin() -> tuple[Any, Dataset, TrainState, int]:
        dataset = load_dataset(capture, background=photo_background(SplatRecipe()))
        recipe = resolve_background(SplatRecipe(), dataset)
        return recipe, dataset, TrainState(recipe.initialise(dataset), seed=0), ITERATIONS

    return begin


def last_stage(run: Path) -> Begin:
    """The start of the last stage of a finished run, with its final Gaussians."""

    def begin() -> tuple[Any, Dataset, TrainState, int]:
        stored = open_run(run, "cpu")
        state = load_checkpoint(stored.directory.checkpoint)
        state.step = stage_starts(stored.recipe.stages(state.seed, stored.iterations), stored.iterations)[-2] + 1
        return stored.recipe, stored.dataset, state, stored.iterations

    return begin


def step_costs(begins: tuple[Begin, ...] = (first_steps(SCENE),), rounds: int = 40) -> Table:
    """Milliseconds per step for 1, 2, 4, ... threads."""
    table = Table(
        "A step of training",
        ("run", "method", "pixels", "Gaussians", "threads", "ms", "CPU ms"),
        f"Medians over {rounds} steps for each number of threads, in turn; CPU ms are those of all threads together.",
    )
    for begin in begins:
        recipe, dataset, state, iterations = begin()
        for view in dataset.train:
            _ = view.photo  # Loads the photograph, as the first pass of training does.
        camera, count = dataset.train[0].camera, len(state.scene.primary)
        messages = train(recipe.stages(state.seed, iterations), dataset, state, iterations)
        for threads, times in step_clocks(messages, rounds).items():
            clock, processor = (statistics.median(column) for column in zip(*times, strict=True))
            pixels = f"{camera.width}x{camera.height}"
            table.add(dataset.root.name, recipe.method, pixels, f"{count:,}", threads, clock, processor)
    return table


def step_clocks(messages: Iterator[Message], rounds: int) -> dict[int, list[tuple[float, float]]]:
    """Wall-clock and CPU milliseconds of the steps of a run, by the number of threads."""
    times: dict[int, list[tuple[float, float]]] = {n: [] for n in doublings(numba.config.NUMBA_NUM_THREADS)}
    for _ in range(rounds + 1):
        for threads, known in times.items():
            with thread_count(threads):
                known.append(clocks_of(lambda: next(message for message in messages if isinstance(message, StepDone))))
    return {threads: known[1:] for threads, known in times.items()}


def main() -> None:
    """Measures and prints the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.steps", description=__doc__)
    parser.add_argument(
        "--data", type=Path, action="append", default=[], help="capture whose points `splat` starts with"
    )
    parser.add_argument("--run", type=Path, action="append", default=[], help="finished run whose last stage is timed")
    parser.add_argument("--rounds", type=int, default=40, help="steps for each number of threads")
    arguments = parser.parse_args()
    begins = (*map(first_steps, arguments.data), *map(last_stage, arguments.run))
    print(step_costs(begins or (first_steps(SCENE),), arguments.rounds).markdown())


if __name__ == "__main__":
    main()
