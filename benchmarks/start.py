"""Seconds to the first line of a command: python -m benchmarks.start [--run RUN].

Wall-clock time from the start of the process to its first line, which reports an error or the start of the work.
`train` and `info` print it after reading the folder of the capture, `demo` at the start of training, rendering commands
after reading the records of the run. All this happens before PyTorch is imported.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks.table import Table
from glassplat.cli.train import SCENE

ROUNDS = 3
"""Number of timed rounds, whose median is shown; one warm-up round precedes them."""
OUTPUT = "{output}"
"""Placeholder in a command line for a folder that does not exist yet."""

COMMANDS = (
    ("--help",),
    ("eval", "--help"),
    ("train", "--help"),
    ("train", "splat", "--data", "nothing-here", "--output", OUTPUT),
    ("train", "splat", "--data", str(SCENE), "--output", OUTPUT),
    ("train", "planar", "--data", str(SCENE), "--output", OUTPUT),
    ("demo", "--output", OUTPUT),
    ("info", str(SCENE / "images")),
    ("info", str(SCENE)),
)
OF_RUNS = (
    ("info", "{run}"),
    ("eval", "{run}"),
    ("view", "{run}"),
    ("render", "{run}", "--output", OUTPUT),
    ("video", "{run}", "--output", f"{OUTPUT}.mp4"),
    ("export", "{run}", "--output", OUTPUT),
    ("dereflect", "{run}", "--output", OUTPUT),
)


class FirstLine(NamedTuple):
    """First line of a process, and the seconds since its start."""

    text: str
    seconds: float


def first_line(arguments: Sequence[str]) -> FirstLine:
    """Runs `python ARGUMENTS` until it prints a line, and terminates it."""
    begin = time.perf_counter()
    with subprocess.Popen(
        [sys.executable, "-u", *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        assert process.stdout is not None
        text = process.stdout.readline()
        seconds = time.perf_counter() - begin
        if process.poll() is None:
            process.terminate()  # Not killed, because `demo` has to terminate its child.
    return FirstLine(text.strip(), seconds)


def start_times(commands: Sequence[Sequence[str]], rounds: int = ROUNDS) -> Table:
    """Median seconds for each command line of `glassplat`."""
    table = Table("Time to the first line of a command", ("glassplat ...", "seconds", "first line"))
    for command in commands:
        heard = []
        for _ in range(1 + rounds):
            with tempfile.TemporaryDirectory() as folder:
                arguments = [part.replace(OUTPUT, str(Path(folder) / "output")) for part in command]
                heard.append(first_line(["-m", "glassplat", *arguments]))
        named = " ".join(part.replace(OUTPUT, "OUTPUT").replace(str(SCENE), "SCENE") for part in command)
        table.add(f"`{named}`", statistics.median(one.seconds for one in heard[1:]), heard[-1].text[:60])
    return table


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, help="a planar run, for commands that take a run")
    run = parser.parse_args().run
    of_runs = [] if run is None else [[part.replace("{run}", str(run)) for part in command] for command in OF_RUNS]
    print(start_times([*COMMANDS, *of_runs]).markdown())


if __name__ == "__main__":
    main()
