"""The work of a comparison: trains and evaluates what is missing, and knows how long the rest will take."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence

from rich.console import Console
from rich.text import Text

from glassplat.commands.console.messages import complain, printable, say
from glassplat.commands.console.training_progress import in_words
from glassplat.commands.measuring.bench_runs import FinishedRun, PlannedRun
from glassplat.commands.measuring.evaluation import evaluate_run
from glassplat.commands.runs.stored_run import open_run
from glassplat.data.dataset import load_dataset
from glassplat.data.errors import InputError
from glassplat.init.plane_options import PlaneFitError
from glassplat.train.stage import check_length
from glassplat.train.trainer import TrainingDivergedError


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
