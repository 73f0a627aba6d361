"""`glassplat bench seconds`: what methods reach in a given time."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from rich.console import Console
from rich.text import Text

from glassplat.commands.console.messages import say
from glassplat.commands.measuring.bench_runs import RUNS, PlannedRun, scene_names
from glassplat.commands.measuring.seconds_chart import Curve, chart
from glassplat.commands.runs.output_folder import check_targets
from glassplat.commands.training.train import Train
from glassplat.data.errors import InputError
from glassplat.data.masks import Polarity
from glassplat.data.ranges import Downscale, Range, Seed, Several
from glassplat.files.folders import check_folder, real_path
from glassplat.files.markdown_table import Table
from glassplat.train.recipe import recipe_of
from glassplat.train.run_directory import write_text

Method = Literal["splat", "planar", "deferred", "traced"]
Seconds = Annotated[float, Range(1, 1_000_000)]
PILOT = "pilot"
FIRST_POWER = 1.2
"""Of the iterations, to which time grows as long as a single run has been timed: Gaussians become more."""
POWERS = (1.0, 2.0)
"""Between which the power is believed that two runs give: what a run begins with makes that of short ones too small."""
METRICS = ("psnr", "pane_psnr", "transmission_psnr", "reflection_psnr")
NOTE = (
    "Each row is a run of its own, whose schedules stretch over its iterations. Their number is chosen by the times of "
    "the runs before it, so that it takes about as long as was asked for. Seconds are those of training, whatever else "
    "the machine did."
)


class Timed(NamedTuple):
    """A finished run: for how many seconds it was asked (0 for the pilot), its length, and what it reached."""

    scene: str
    method: str
    asked: float
    iterations: int
    results: dict[str, Any]

    @property
    def seconds(self) -> float:
        """How long it was trained."""
        return float(self.results["train_seconds"])


@dataclass(frozen=True)
class BenchSeconds:
    """Train methods for given times and draw what they reach; repeat the command to go on after an interrupt.

    Attributes:
        data: directories of the captures.
        output: where table, chart and one directory per run go.
        methods: which methods.
        seconds: of training, a run for each.
        pilot: iterations of the first run of a method on a scene, from whose time the others' lengths follow.
        seed: of every run.
        downscale: shrink the photographs by this factor.
        mask_polarity: which value of black-and-white masks is the pane.
    """

    data: tuple[Path, ...]
    output: Path
    methods: tuple[Method, ...] = ("splat", "planar")
    seconds: tuple[Seconds, ...] = (60.0, 120.0, 240.0)
    pilot: Several = 300
    seed: Seed = 0
    downscale: Downscale = 1.0
    mask_polarity: Polarity = "auto"

    def planned(self) -> list[PlannedRun]:
        """The runs that are asked for; those that are not begun get their lengths from those before them.

        Raises:
            InputError: options that name nothing, or an output that no run can be written to.
        """
        self._check()
        return [
            self._planned(scene, data, method, asked, [])
            for scene, data in zip(scene_names(self.data), self.data, strict=True)
            for method in dict.fromkeys(self.methods)
            for asked in (0.0, *sorted(set(self.seconds)))
        ]

    def _check(self) -> None:
        check_folder(self.output)
        check_targets(self.output, [self.output / name for name in (RUNS, "seconds.md", "seconds.json")], [])
        if not self.methods or not self.seconds:
            raise InputError("--methods or --seconds names nothing; expected at least one of each")

    def run(self, console: Console) -> None:
        """Runs what is missing and writes `seconds.md`, `seconds.json` and a chart for each scene."""
        self._check()
        finished: list[Timed] = []
        for scene, data in zip(scene_names(self.data), self.data, strict=True):
            for method in dict.fromkeys(self.methods):
                finished += self._curve(scene, data, method, console)
                write_seconds(self.output, finished)
        say(console, f"table and charts: {self.output / 'seconds.md'}")

    def _curve(self, scene: str, data: Path, method: Method, console: Console) -> list[Timed]:
        """The pilot and a run for each time, in the order of their length."""
        from glassplat.commands.measuring.bench_execution import train_and_evaluate

        found: list[Timed] = []
        for asked in (0.0, *sorted(set(self.seconds))):
            planned = self._planned(scene, data, method, asked, found)
            results = planned.results()
            if results is None:
                console.rule(Text(f"{planned.title}, {planned.train.iterations} iterations"))
                planned.check()
                train_and_evaluate(planned, console)
                results = planned.results()
            if results is None or results.get("train_seconds") is None:
                raise InputError(f"{planned.directory.path} does not say how long it was trained; move it away")
            found.append(Timed(scene, method, asked, planned.train.iterations, results))
        return found

    def _planned(self, scene: str, data: Path, method: Method, asked: float, found: Sequence[Timed]) -> PlannedRun:
        """The next run; one that was begun keeps its length."""
        name = f"{asked:g} s" if asked else PILOT
        folder = self.output / RUNS / scene / f"{method}-{name.replace(' ', '')}"
        train = Train(
            recipe_of(method),
            real_path(data),
            folder,
            iterations=iterations_for(asked, [(run.iterations, run.seconds) for run in found]) if found else self.pilot,
            downscale=self.downscale,
            seed=self.seed,
            mask_polarity=self.mask_polarity,
        )
        planned = PlannedRun(scene, f"{method} {name}", train)
        if not planned.begun():
            return planned
        return planned.of_length(planned.directory.settings().iterations)


def iterations_for(seconds: float, timed: Sequence[tuple[int, float]]) -> int:
    """How many iterations take so long, by a power law through the last two runs.

    Args:
        seconds: the time wanted.
        timed: iterations and seconds of runs, the longest one last; at least one.
    """
    iterations, taken = timed[-1]
    power = FIRST_POWER
    if len(timed) > 1 and timed[-2][0] != iterations:
        before, taken_before = timed[-2]
        power = math.log(taken / taken_before) / math.log(iterations / before)
        power = min(max(power, POWERS[0]), POWERS[1])
    wanted = iterations * (seconds / taken) ** (1 / power)
    return max(round(wanted / 10) * 10, timed[0][0])


def write_seconds(output: Path, finished: Sequence[Timed]) -> None:
    """Writes what is finished."""
    table = Table("Quality against seconds", ("scene", "method", "iterations", "seconds", *METRICS, "Gaussians"), NOTE)
    for run in finished:
        cells = [run.results.get(name) for name in METRICS]
        values = ("-" if value is None else f"{value:.2f}" for value in cells)
        count = run.results.get("num_gaussians")
        table.add(run.scene, run.method, run.iterations, f"{run.seconds:.0f}", *values, count)
    charts = {scene: f"seconds-{scene}.svg" for scene in dict.fromkeys(run.scene for run in finished)}
    for scene, file in charts.items():
        drawn = curves([run for run in finished if run.scene == scene])
        write_text(output / file, chart(f"{scene}: PSNR of the test views", drawn))
    pictures = "".join(f"\n![{scene}]({file})\n" for scene, file in charts.items())
    write_text(output / "seconds.md", table.markdown() + pictures)
    plain = [{"scene": run.scene, "asked": run.asked, **run.results} for run in finished]
    write_text(output / "seconds.json", json.dumps({"runs": plain}, indent=2))


def curves(finished: Sequence[Timed]) -> list[Curve]:
    """A curve for each method."""
    methods = dict.fromkeys(run.method for run in finished)
    return [
        Curve(m, tuple((r.seconds, r.results["psnr"]) for r in finished if r.method == m and r.results.get("psnr")))
        for m in methods
    ]
