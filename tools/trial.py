"""Tests the promises of SECURITY.md, by class, with random cases from a seed.

    python -m tools.trial CLASS --seed 3 --cases 100 [--minutes 10]

| class | what is tested |
|---|---|
| crashes | commands that are killed, interrupted, or run out of disk at a random moment, and the files they leave |
| readers | damaged files of every kind, for every reader |
| servers | unauthorised, malformed, slow and many clients of `view` and `annotate` |
| numbers | invalid and extreme values in the Python interface |
| machines | no home directory, other locales, unusual names, a damaged kernel cache, two processes at once |

A case is a fault if it grants unauthorised access, loses work, hangs, or ends with a traceback or an empty error. Every
process is limited to 8 GiB of address space and ten minutes. The exit code is 1 if there is a fault.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, Protocol

CLASSES = ("crashes", "readers", "servers", "numbers", "machines")


class Case(NamedTuple):
    """A tested case and its fault; an empty string means none."""

    what: str
    fault: str = ""


class Trial(Protocol):
    """Generator of the cases of one class."""

    def __call__(self, seed: int, cases: int, place: Path) -> Iterator[Case]:
        """Tests `cases` cases in order; `place` is an empty folder."""
        ...


def trial_of(name: str) -> Trial:
    """Imports the module of a class, and returns its function `cases`."""
    found: Trial = importlib.import_module(f"tools.trial_{name}").cases
    return found


def tried(name: str, seed: int, cases: int, minutes: float) -> tuple[int, list[Case]]:
    """Test cases until the time is up; returns their number and the faults, which are printed immediately."""
    end, count, faults = time.monotonic() + 60 * minutes, 0, list[Case]()
    with tempfile.TemporaryDirectory(prefix="trial-", ignore_cleanup_errors=True) as place:
        for case in trial_of(name)(seed, cases, Path(place)):
            count += 1
            if case.fault:
                faults.append(case)
                print(f"FAULT {case.what}: {case.fault}", flush=True)
            if time.monotonic() > end:
                break
    return count, faults


def main() -> int:
    """Tests one class and prints a summary."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=CLASSES, metavar="CLASS", help=", ".join(CLASSES))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cases", type=int, default=100)
    parser.add_argument("--minutes", type=float, default=10.0, help="no case starts after this time")
    options = parser.parse_args()
    begun = time.monotonic()
    count, faults = tried(options.kind, options.seed, options.cases, options.minutes)
    seconds = time.monotonic() - begun
    print(f"{options.kind}, seed {options.seed}: {count} cases in {seconds:.0f} s, {len(faults)} faults")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
