"""Compare methods and their variants over scenes: train, evaluate, and write the tables of docs/results.md.

    python -m benchmarks.compare rooms/1 rooms/2 --methods splat planar --iterations 7000 --output runs/rooms
    python -m benchmarks.compare rooms/* --variant no-conflict="--weights.conflict 0" --variant mcmc="--strategy mcmc"
    python -m benchmarks.compare rooms/* --variant planar:paper="--preset paper" --options "--downscale 2" --table

Every run calls `glassplat train` and `glassplat eval` in its own process, and writes to OUTPUT/SCENE/NAME-seedN. Repeat
the command to continue after an interrupt: finished runs are skipped, unfinished ones continue from their checkpoint. A
run that fails does not stop the others. The tables are printed and saved in OUTPUT/tables.md, all results in
OUTPUT/results.json.

Several of these commands may share one OUTPUT, on one or several machines. Each run is claimed by a lock on its folder,
which is released when the process ends: no run is done twice, and the run of a dead process is taken over. Under Slurm:

    sbatch --array 0-7 --wrap 'python -m benchmarks.compare rooms/* --task $SLURM_ARRAY_TASK_ID --of 8'
"""

from __future__ import annotations

import argparse
import json
import shlex
import signal
import statistics
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from filelock import FileLock, Timeout

from glassplat.errors import InputError
from glassplat.files.writing import write_text
from glassplat.model.run_directory import check_unlocked

BASELINE = "splat"
COMMAND, LOG, RESULTS = "command.json", "output.log", "results.json"
CLAIM, FAILED = "claim.lock", "failed.txt"
PATIENCE = 2.0
"""Seconds between checks of the runs of other processes."""


class Column(NamedTuple):
    """A metric: its title, its name in `results.json`, its number format, and the way in which two runs are compared.

    `of_panes` marks means over the panes of a scene. `is_ratio` marks metrics that are compared as ratios, because
    absolute values differ between scenes and machines.
    """

    title: str
    name: str
    style: str
    of_panes: bool = False
    is_ratio: bool = False


COLUMNS = (
    Column("image", "psnr", ".2f"),
    Column("ssim", "ssim", ".4f"),
    Column("lpips", "lpips", ".4f"),
    Column("pane", "pane_psnr", ".2f"),
    Column("transmission", "transmission_psnr", ".2f"),
    Column("reflection", "reflection_psnr", ".2f"),
    Column("reflective", "reflective_psnr", ".2f"),
    Column("normal error, deg", "normal_error_deg", ".2f"),
    Column("reflective normal error, deg", "reflective_normal_error_deg", ".2f"),
    Column("strength error", "strength_error", ".3f"),
    Column("environment", "environment_psnr", ".2f"),
    Column("R0 error", "base_reflectance_error", ".3f", of_panes=True),
    Column("pane normal error, deg", "normal_error_deg", ".2f", of_panes=True),
    Column("offset error", "offset_error", ".2%", of_panes=True),
    Column("Gaussians", "num_gaussians", ",.0f", is_ratio=True),
    Column("training, s", "train_seconds", ".0f", is_ratio=True),
    Column("frame, s", "seconds_per_frame", ".4f", is_ratio=True),
)
IMAGE, PANE = COLUMNS[0], COLUMNS[3]
GAINED, REACHED = (IMAGE, PANE, COLUMNS[4]), (COLUMNS[5], COLUMNS[11])
"""Metrics compared with the baseline, and metrics that the baseline lacks: reflections and R0."""


@dataclass(frozen=True)
class Run:
    """One training and its evaluation.

    Attributes:
        scene: name of the capture in the tables.
        name: method, or method and variant: `planar`, `planar:no-conflict`.
        seed: random seed of the training.
        directory: directory of the run.
        train: arguments of `glassplat train`, without the output.
    """

    scene: str
    name: str
    seed: int
    directory: Path
    train: tuple[str, ...]

    @property
    def title(self) -> str:
        """Name in messages."""
        return f"{self.scene}, {self.name}, seed {self.seed}"

    def results(self) -> dict[str, Any] | None:
        """Metrics of the run; None until it is finished.

        Raises:
            SystemExit: the folder holds a run with other options.
        """
        self.check()
        file = self.directory / RESULTS
        return json.loads(file.read_text(encoding="utf-8")) if file.is_file() else None

    def check(self) -> None:
        """Raise SystemExit if the folder holds a run with other options."""
        file = self.directory / COMMAND
        if file.is_file() and (begun := json.loads(file.read_text(encoding="utf-8"))) != list(self.train):
            raise SystemExit(
                f"{self.directory} holds a run of `{shlex.join(begun)}`; expected `{shlex.join(self.train)}`. Choose "
                "another --output, or move the run away"
            )

    def claimed(self) -> FileLock | None:
        """Acquires the lock on this run; None if another process, or a training that it left running, works on it."""
        self.directory.mkdir(parents=True, exist_ok=True)
        lock = FileLock(self.directory / CLAIM, blocking=False, mode=0o666)
        try:
            lock.acquire()
        except Timeout:
            return None
        try:
            check_unlocked(self.directory)
        except InputError:
            lock.release()
            return None
        return lock

    def failed_since(self, moment: float) -> str | None:
        """Message of a failure after `moment`, in seconds since the epoch; None if there was none."""
        file = self.directory / FAILED
        try:
            return file.read_text(encoding="utf-8") if file.stat().st_mtime >= moment else None
        except FileNotFoundError:
            return None

    def start(self) -> subprocess.Popen[bytes]:
        """Starts the training, or resumes it."""
        self.directory.mkdir(parents=True, exist_ok=True)
        # Written atomically, because other processes read it.
        write_text(self.directory / COMMAND, json.dumps(self.train, indent=2) + "\n")
        begun = ["--resume"] if (self.directory / "checkpoint.safetensors").is_file() else []
        return self._glassplat("train", *self.train, "--output", str(self.directory), *begun)

    def evaluate(self) -> subprocess.Popen[bytes]:
        """Starts the evaluation of the trained run."""
        return self._glassplat("eval", str(self.directory))

    def said(self) -> str:
        """Last lines of the output of its commands, without the frame of a message."""
        file = self.directory / LOG
        lines = file.read_text(encoding="utf-8", errors="replace").split("\n") if file.is_file() else []
        words = [line.strip("│╭╮╰╯─ \r") for line in lines]
        return " ".join([line for line in words if line][-3:]) or "no output"

    def _glassplat(self, *arguments: str) -> subprocess.Popen[bytes]:
        # A new session: Ctrl-C reaches only this process, which then terminates the others.
        with (self.directory / LOG).open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-m", "glassplat", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )


def planned_runs(arguments: argparse.Namespace) -> list[Run]:
    """Runs for each combination of scene, seed, and method or variant, scene by scene."""
    common = ("--iterations", str(arguments.iterations), *shlex.split(arguments.options))
    scenes = zip(scene_names(arguments.scenes), arguments.scenes, strict=True)
    named = named_options(arguments.methods, arguments.variant)
    return [
        Run(
            scene,
            name,
            seed,
            arguments.output / scene / f"{name.replace(':', '-')}-seed{seed}",
            (method, "--data", str(data.resolve()), "--seed", str(seed), *common, *options),
        )
        for (scene, data), seed, (name, method, options) in product(scenes, arguments.seeds, named)
    ]


def named_options(methods: Sequence[str], variants: Sequence[str]) -> list[tuple[str, str, list[str]]]:
    """Name, method and options of everything compared: the plain methods, and their variants.

    Args:
        methods: names of the methods.
        variants: `[METHOD:]NAME=OPTIONS`; without METHOD, the variant applies to every method except `splat`.
    """
    named: list[tuple[str, str, list[str]]] = [(method, method, []) for method in methods]
    for variant in variants:
        title, is_given, options = variant.partition("=")
        method, colon, name = title.rpartition(":")
        if not (name and is_given) or (colon and method not in methods):
            raise SystemExit(f"--variant {variant!r}: expected [METHOD:]NAME=OPTIONS, METHOD one of {list(methods)}")
        chosen = [method] if colon else [one for one in methods if one != BASELINE]
        named += [(f"{one}:{name}", one, shlex.split(options)) for one in chosen]
    if len({name for name, _, _ in named}) < len(named):
        raise SystemExit("a method or variant is named twice")
    return named


def scene_names(captures: Sequence[Path]) -> list[str]:
    """Short names of the captures: the folder name, preceded by as many parent folders as make the names unique."""
    folders = [path.resolve() for path in captures]
    missing = [str(path) for path in captures if not path.is_dir()]
    if missing or len(set(folders)) < len(folders):
        raise SystemExit(f"no such folder: {', '.join(missing)}" if missing else "a scene is named twice")
    depth = 1
    while len({path.parts[-depth:] for path in folders}) < len(folders):
        depth += 1
    return ["-".join(part.strip("/") for part in path.parts[-depth:]) for path in folders]


class Working(NamedTuple):
    """A run in progress: its command, start time, process and lock."""

    command: str
    since: float
    process: subprocess.Popen[bytes]
    lock: FileLock


def execute(runs: Sequence[Run], jobs: int, after_each: Callable[[], object], first: int = 0) -> list[str]:
    """Trains and evaluates unfinished runs, `jobs` at a time; returns messages of failures, here or in other processes.

    Args:
        runs: all runs; other processes may work on the same ones.
        jobs: number of runs at a time.
        after_each: called after each finished run.
        first: index of the first run to try, so that processes started together take different ones.
    """
    begun, failures = time.time(), []
    waiting = deque(run for run in (*runs[first:], *runs[:first]) if run.results() is None)
    print(f"{len(runs) - len(waiting)} of {len(runs)} runs are finished", flush=True)
    running: dict[Run, Working] = {}
    try:
        while waiting or running:
            for _ in range(len(waiting)):
                if len(running) == jobs:
                    break
                run = waiting.popleft()
                if run.results() is not None:
                    continue
                if (failure := run.failed_since(begun)) is not None:
                    failures.append(failure)
                elif (lock := run.claimed()) is None:
                    waiting.append(run)
                elif run.results() is not None:
                    lock.release()  # Another process has just finished it.
                else:
                    try:
                        running[run] = Working("train", time.monotonic(), run.start(), lock)
                    except OSError as error:
                        failures.append(f"{run.title}: train could not begin: {error}")
                        print(f"failed: {failures[-1]}", flush=True)
                        lock.release()
            time.sleep(0.1 if running else PATIENCE if waiting else 0)
            for run, work in list(running.items()):
                if (code := work.process.poll()) is None:
                    continue
                if code == 0 and work.command == "train":
                    running[run] = work._replace(command="eval", process=run.evaluate())
                    continue
                del running[run]
                if code:
                    failures.append(f"{run.title}: {work.command} ended with {code}: {run.said()}")
                    (run.directory / FAILED).write_text(failures[-1], encoding="utf-8")
                    print(f"failed: {failures[-1]}", flush=True)
                else:
                    print(f"{run.title}: {described(run, time.monotonic() - work.since)}", flush=True)
                    after_each()
                work.lock.release()
    finally:
        for work in running.values():
            work.process.terminate()  # Like Ctrl-C, so that a checkpoint is written.
        for work in running.values():
            work.process.wait()
            work.lock.release()
    return failures


def described(run: Run, seconds: float) -> str:
    """Image and pane metrics of a run that has just ended, and its duration."""
    values = values_of(run.results() or {})
    shown = [f"{column.title} {values[column]:.2f}" for column in (IMAGE, PANE) if values[column] is not None]
    return ", ".join([*shown, f"{seconds:.0f} s"])


Values = Mapping[Column, float | None]
Measured = dict[tuple[str, str, int], Values]
"""Values by scene, name and seed."""


def values_of(results: Mapping[str, Any]) -> dict[Column, float | None]:
    """Values of the columns in `results.json`."""
    panes = results.get("planes") or []
    return {
        column: mean([pane.get(column.name) for pane in panes]) if column.of_panes else results.get(column.name)
        for column in COLUMNS
    }


def mean(values: Iterable[float | None], column: Column = IMAGE) -> float | None:
    """Mean of the known values, None without any; geometric for ratios, so that twice and half average to 1."""
    known = [value for value in values if value is not None]
    of_known = statistics.geometric_mean if column.is_ratio else statistics.fmean
    return of_known(known) if known else None


def compared(measured: Measured, name: str, baseline: str) -> dict[str, list[Values]]:
    """Gains of `name` over `baseline`, as differences or ratios, by scene; runs of equal seeds are compared."""
    found: dict[str, list[Values]] = {}
    for (scene, other, seed), values in measured.items():
        if other == name and (scene, baseline, seed) in measured:
            found.setdefault(scene, []).append(difference(values, measured[scene, baseline, seed]))
    return found


def difference(mine: Values, other: Values) -> dict[Column, float | None]:
    """Differences, or ratios of `is_ratio` columns; None if either value is missing."""
    result: dict[Column, float | None] = {}
    for column in COLUMNS:
        a, b = mine[column], other[column]
        if a is None or b is None or (column.is_ratio and 0 in (a, b)):
            result[column] = None
        else:
            result[column] = a / b if column.is_ratio else a - b
    return result


def tables(measured: Measured) -> str:
    """All tables as Markdown."""
    names = list(dict.fromkeys(name for _, name, _ in measured))
    parts = ["### Scenes", "", *value_table(measured), ""]
    above = [name for name in names if name != BASELINE and compared(measured, name, BASELINE)]
    if above:
        parts += [f"### Gain over {BASELINE}", "", *gain_table(measured, above), ""]
    pairs = [(name, name.partition(":")[0]) for name in names if ":" in name]
    pairs = [(name, plain) for name, plain in pairs if compared(measured, name, plain)]
    if pairs:
        parts += ["### Variants, minus the method as it is", "", *variant_table(measured, pairs), ""]
    return "\n".join(parts)


def value_table(measured: Measured) -> list[str]:
    """Means over seeds for each run, with their standard deviation."""
    rows = {
        key: [v for (s, n, _), v in measured.items() if (s, n) == key] for key in dict.fromkeys(k[:2] for k in measured)
    }
    used = [column for column in COLUMNS if any(v[column] is not None for values in rows.values() for v in values)]
    return markdown(
        ["scene", "method", *(column.title for column in used)],
        [[*key, *(spread([v[column] for v in values], column) for column in used)] for key, values in rows.items()],
    )


def gain_table(measured: Measured, names: Sequence[str]) -> list[str]:
    """Mean gains of methods over scenes, their worst scene, and the number of scenes below the baseline.

    For reflections and R0, which the baseline lacks, the value itself is shown.
    """
    rows = []
    for name in names:
        gains = compared(measured, name, BASELINE)
        own = [values for (scene, other, _), values in measured.items() if other == name and scene in gains]
        cells = [written(mean(mean(v[c] for v in values) for values in gains.values()), c, "+") for c in GAINED]
        cells += [written(mean(values[c] for values in own), c) for c in REACHED]
        images = {scene: value for scene, v in gains.items() if (value := mean(one[IMAGE] for one in v)) is not None}
        worst = min(images, key=lambda scene: images[scene]) if images else ""
        below = sum(value < 0 for value in images.values())
        cells += [f"{worst} {written(images.get(worst), IMAGE, '+')}", f"{below} of {len(images)}"]
        rows.append([name, str(len(gains)), *cells])
    titles = [*(f"{c.title} gain" for c in GAINED), *(c.title for c in REACHED), "worst scene", f"below {BASELINE}"]
    return markdown(["method", "scenes", *titles], rows)


def variant_table(measured: Measured, pairs: Sequence[tuple[str, str]]) -> list[str]:
    """Mean differences, or geometric means of ratios, between a variant and its method, over scenes."""
    found = {name: compared(measured, name, plain) for name, plain in pairs}
    used = [c for c in COLUMNS if any(v[c] is not None for by in found.values() for vs in by.values() for v in vs)]
    rows = []
    for name, by_scene in found.items():
        images = [mean(v[IMAGE] for v in values) for values in by_scene.values()]
        worst = min((value for value in images if value is not None), default=None)
        means = [mean((mean((v[c] for v in values), c) for values in by_scene.values()), c) for c in used]
        cells = [
            written(value, column._replace(style=".3f")) if column.is_ratio else written(value, column, "+")
            for column, value in zip(used, means, strict=True)
        ]
        rows.append([name, str(len(by_scene)), *cells, written(worst, IMAGE, "+")])
    titles = [f"{c.title.partition(',')[0]}, ratio" if c.is_ratio else c.title for c in used]
    return markdown(["variant", "scenes", *titles, "image, worst scene"], rows)


def spread(values: Sequence[float | None], column: Column) -> str:
    """The mean, with the standard deviation if there are several values."""
    known = [value for value in values if value is not None]
    deviation = f" ± {statistics.stdev(known):{column.style}}" if len(known) > 1 else ""
    return written(mean(known), column) + deviation


def written(value: float | None, column: Column, sign: str = "") -> str:
    """A value in the format of its column; a dash if it is missing."""
    return "-" if value is None else f"{value:{sign}{column.style}}"


def markdown(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table."""
    return [f"| {' | '.join(cells)} |" for cells in (titles, ["---"] * len(titles), *rows)]


def write_tables(output: Path, runs: Sequence[Run]) -> str:
    """Writes tables and results of all finished runs; returns the tables."""
    finished = [(run, results) for run in runs if (results := run.results()) is not None]
    if not finished:
        return "no run is finished"
    text = tables({(run.scene, run.name, run.seed): values_of(results) for run, results in finished})
    text += camera_note(finished)
    kept = [{"scene": r.scene, "name": r.name, "train": r.train} | results for r, results in finished]
    for name, content in ((RESULTS, json.dumps(kept, indent=2) + "\n"), ("tables.md", text)):
        write_text(output / name, content)
    return text


def camera_note(finished: Sequence[tuple[Run, Mapping[str, Any]]]) -> str:
    """A note if only some test cameras were aligned, as by default after pose refinement, which raises their scores."""
    by_cameras: dict[str, list[str]] = {}
    for run, results in finished:
        by_cameras.setdefault(results.get("test_cameras") or "not recorded", []).append(run.title)
    if len(by_cameras) == 1:
        return ""
    lines = [f"- {cameras}: {'; '.join(titles)}" for cameras, titles in by_cameras.items()]
    note = "**Test cameras differ**, so runs are not comparable; repeat `glassplat eval RUN --align always` for all:"
    return "\n".join([note, "", *lines, ""])


def parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parses the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+", help="folders of captures")
    parser.add_argument("--methods", nargs="+", default=["splat", "planar"])
    parser.add_argument(
        "--variant", action="append", default=[], metavar="[METHOD:]NAME=OPTIONS", help="may be given several times"
    )
    parser.add_argument("--iterations", type=int, default=7000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--options", default="", help='options of every training, such as "--downscale 2"')
    parser.add_argument("--output", type=Path, default=Path("runs/compare"))
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time; set NUMBA_NUM_THREADS with it")
    parser.add_argument("--task", type=int, default=0, help="number of this process among those that share the output")
    parser.add_argument("--of", type=int, default=1, help="number of these processes")
    parser.add_argument("--table", action="store_true", help="only write the tables of finished runs")
    options = parser.parse_args(arguments)
    if not 0 <= options.task < options.of:
        parser.error(f"--task is {options.task}, of {options.of}; expected a number from 0 on, below --of")
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Executes unfinished runs and prints the tables; returns the exit code."""
    options = parsed(arguments)
    runs = planned_runs(options)
    first = options.task * len(runs) // options.of
    failures = [] if options.table else execute(runs, options.jobs, lambda: write_tables(options.output, runs), first)
    print(write_tables(options.output, runs))
    for failure in failures:
        print(f"failed: {failure}", file=sys.stderr)
    return int(bool(failures))


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit("interrupted: repeat the command to continue")
