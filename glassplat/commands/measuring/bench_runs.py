"""The runs of a comparison: each trained and evaluated once, however often the command is stopped and repeated."""

from __future__ import annotations

import statistics
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.text import Text

from glassplat.commands.console.messages import complain, printable, say
from glassplat.commands.console.training_progress import in_words
from glassplat.commands.measuring.evaluation import evaluate_run
from glassplat.commands.runs.stored_run import open_run
from glassplat.commands.training.train import Train
from glassplat.data.dataset import load_dataset
from glassplat.data.errors import InputError, first_names
from glassplat.files.folders import real_path
from glassplat.files.json_text import read_json
from glassplat.init.planes import PlaneFitError
from glassplat.train.background import with_background
from glassplat.train.run_directory import RunDirectory
from glassplat.train.stage import check_length
from glassplat.train.trainer import TrainingDivergedError

RUNS = "runs"
"""Folder of a comparison's runs: `<scene>/<variant>-seed<seed>`."""


@dataclass(frozen=True)
class PlannedRun:
    """One run of a comparison.

    Attributes:
        scene: the capture's name in the tables.
        variant: what is compared, such as a method.
        train: the command that trains it; its output is the run's directory.
    """

    scene: str
    variant: str
    train: Train

    @property
    def directory(self) -> RunDirectory:
        """Where the run is."""
        return RunDirectory(self.train.output)

    @property
    def title(self) -> str:
        """What the progress calls it."""
        return f"{self.scene}, {self.variant}, seed {self.train.seed}"

    def of_length(self, iterations: int) -> PlannedRun:
        """The same run of another length."""
        return replace(self, train=replace(self.train, iterations=iterations))

    def begun(self) -> bool:
        """Whether there is something to go on from."""
        return self.directory.checkpoint.is_file() or self.directory.results.is_file()

    def check(self) -> None:
        """Refuse a directory that holds something else.

        Raises:
            InputError: the run in it was made from other data, or with another recipe, length or seed.
        """
        directory = self.directory
        if not self.begun():
            return
        # What the photographs decide is recorded, and not part of what was asked for.
        wanted = with_background(self.train.recipe, directory.recipe().background)
        if directory.settings() != self.train.settings() or not directory.was_begun_with(wanted):
            raise InputError(
                f"{directory.path} holds a run with {directory.settings()} or with another recipe; expected "
                f"{self.train.settings()} and the recipe of this version. Choose another --output, or move the run away"
            )

    def results(self) -> dict[str, Any] | None:
        """The metrics of the finished run, None before it is finished."""
        try:
            results = read_json(self.directory.results)
        except (FileNotFoundError, ValueError):
            return None
        if not isinstance(results, dict):
            return None
        made = (results.get("method"), results.get("iterations"), results.get("seed"))
        wanted = (self.train.recipe.method, self.train.iterations, self.train.seed)
        return results if made == wanted else None


@dataclass(frozen=True)
class FinishedRun:
    """A run with its metrics, as `results.json` holds them."""

    run: PlannedRun
    results: dict[str, Any]


def scene_names(captures: Sequence[Path]) -> list[str]:
    """A short name for every capture: its folder, with as many folders above as tell them apart.

    Raises:
        InputError: a capture is given twice, or none is given.
    """
    folders = [real_path(path) for path in captures]
    twice = [str(path) for path, count in Counter(folders).items() if count > 1]
    if twice or not folders:
        raise InputError(
            f"--data names {first_names(twice) or 'no capture'}{' twice' if twice else ''}; name each once"
        )
    depth = 1
    while len({path.parts[-depth:] for path in folders}) < len(folders):
        depth += 1
    return ["-".join(part.strip("/") for part in path.parts[-depth:]) for path in folders]


def earlier_runs(output: Path, recipes: Mapping[str, Any], planned: Sequence[PlannedRun]) -> list[FinishedRun]:
    """Finished runs that earlier commands left in the same output, of other captures, variants or seeds.

    They stay in the tables, which would otherwise hold the last command's runs only.

    Args:
        output: of the comparison.
        recipes: of every variant that its tables may hold.
        planned: the runs of this command.

    Raises:
        InputError: one of them cannot stand in a table with those that are planned, because its length, scale or
            recipe is another.
    """
    own, like = {real_path(run.directory.path) for run in planned}, planned[0].train
    found = []
    for path in sorted((output / RUNS).glob("*/*-seed*")):
        variant, _, seed = path.name.rpartition("-seed")
        if variant not in recipes or not seed.isdecimal() or real_path(path) in own:
            continue
        recorded = RunDirectory(path).settings()
        train = replace(
            like,
            recipe=recipes[variant],
            data=Path(recorded.data),
            output=path,
            seed=int(seed),
            iterations=recorded.iterations,
            downscale=recorded.downscale,
        )
        run = PlannedRun(path.parent.name, variant, train)
        results = run.results()
        if results is not None:
            _check_comparable(run, like)
            found.append(FinishedRun(run, results))
    return found


def _check_comparable(run: PlannedRun, like: Train) -> None:
    wanted = with_background(run.train.recipe, run.directory.recipe().background)
    alike = (run.train.iterations, run.train.downscale) == (like.iterations, like.downscale)
    if not alike or not run.directory.was_begun_with(wanted):
        raise InputError(
            f"{run.directory.path} holds a run of {run.train.iterations} iterations at downscale "
            f"{run.train.downscale}, or with another recipe; expected {like.iterations} at {like.downscale} and the "
            "recipe of this version, because one table holds both. Choose another --output, or move the run away"
        )


def execute(
    runs: Sequence[PlannedRun], console: Console, after_each: Callable[[list[FinishedRun]], None]
) -> list[FinishedRun]:
    """Trains and evaluates what is not finished yet, and returns everything in order.

    Args:
        runs: what to run.
        console: for the progress.
        after_each: gets all that is finished, at the start and after every run.

    Raises:
        InputError: a directory holds another run (before anything is started), or runs failed (after all others).
        KeyboardInterrupt: the user stopped; the same command goes on.
    """
    for run in runs:
        run.check()
        check_length(run.train.recipe.stages(run.train.seed, run.train.iterations), run.train.iterations)
    finished = _finished(runs)
    _check_captures([run for run in runs if run.results() is None])
    after_each(finished)
    if finished:
        say(console, f"{len(finished)} of {len(runs)} runs are finished already")
    clock, failures = RunClock(finished), []
    for number, run in enumerate(runs, start=1):
        if run.results() is not None:
            continue
        waiting = [other for other in runs[number - 1 :] if other.results() is None]
        console.rule(Text(f"run {number} of {len(runs)}: {printable(run.title)} ({clock.left(waiting)})"))
        try:
            clock.measure(run, lambda run=run: train_and_evaluate(run, console))  # type: ignore[misc]
        except (PlaneFitError, TrainingDivergedError) as error:
            # One scene that cannot be trained must not cost the night that the others take.
            failures.append(f"{run.title}: {error}")
            complain("failed", error)
        except KeyboardInterrupt:
            say(console, f"stopped in run {number} of {len(runs)}")
            raise
        after_each(_finished(runs))
    if failures:
        raise InputError(
            f"{len(failures)} of {len(runs)} runs failed, the tables hold the others. {' '.join(failures)}"
        )
    return _finished(runs)


def _finished(runs: Sequence[PlannedRun]) -> list[FinishedRun]:
    return [FinishedRun(run, results) for run in runs if (results := run.results()) is not None]


def _check_captures(runs: Sequence[PlannedRun]) -> None:
    """Reads every capture once: a mistyped name should end a bench in its first minute, not in its last hour."""
    for train in {run.train.data: run.train for run in runs}.values():
        load_dataset(train.data, downscale=train.downscale, mask_polarity=train.mask_polarity)


def train_and_evaluate(run: PlannedRun, console: Console) -> None:
    """What `train` and `eval` do, from the checkpoint where there is one."""
    run.train.resuming(run.directory.checkpoint.is_file()).run(console)
    with console.status("evaluating"):
        evaluate_run(open_run(run.train.output))


class RunClock:
    """How long runs take, and how long the others will, judged by the most similar ones."""

    def __init__(self, finished: Sequence[FinishedRun]) -> None:
        self._seconds: list[tuple[PlannedRun, float]] = [
            (f.run, f.results["train_seconds"]) for f in finished if f.results.get("train_seconds") is not None
        ]

    def measure(self, run: PlannedRun, work: Callable[[], None]) -> None:
        """Does the work and remembers its time, if it ends."""
        started = time.perf_counter()
        work()
        self._seconds.append((run, time.perf_counter() - started))

    def left(self, waiting: Sequence[PlannedRun]) -> str:
        """The time that some runs will take, in words."""
        if not self._seconds:
            return "time left is known after the first run"
        return f"about {in_words(sum(self._expected(run) for run in waiting))} left"

    def _expected(self, run: PlannedRun) -> float:
        """Mean time of the runs of the same scene and variant, of the same method, or of all."""
        same = [s for other, s in self._seconds if (other.scene, other.variant) == (run.scene, run.variant)]
        method = [s for other, s in self._seconds if other.train.recipe.method == run.train.recipe.method]
        return statistics.fmean(same or method or [s for _, s in self._seconds])
