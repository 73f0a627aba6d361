"""The runs of a comparison: each trained and evaluated once, however often the command is stopped and repeated."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from glassplat.commands.console.messages import say
from glassplat.commands.training.train import Train
from glassplat.data.errors import InputError, first_names
from glassplat.files.folders import real_path
from glassplat.files.json_text import read_json
from glassplat.train.background import with_background
from glassplat.train.run_directory import RunDirectory

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


def say_captures(runs: Sequence[PlannedRun], console: Console) -> None:
    """Reads what the folders of the captures hold, and says it: a mistyped name should end a bench at once.

    Args:
        runs: those that are finished need no capture any more.
        console: for a line on each capture.

    Raises:
        InputError, FileNotFoundError: a capture that is needed cannot be used, or a directory holds another run.
    """
    for run in runs:
        run.check()
    for train in {run.train.data: run.train for run in runs if run.results() is None}.values():
        say(console, train.files)
