"""Tries what SECURITY.md promises, by class, with cases that follow from a seed.

    python -m tools.trial CLASS --seed 3 --cases 100 [--minutes 10]

| class | what is tried |
|---|---|
| crashes | commands that are killed, interrupted, or run out of disk at any moment, and what is left of their work |
| readers | damaged files of every kind, for every reader |
| servers | strangers, nonsense, slow and many clients, at `view` and at `annotate` |
| numbers | values that nobody should give, through the Python interface |
| machines | no home, other locales, odd names, a damaged cache of kernels, two processes at once |

A case is a fault if it lets somebody in, loses work, hangs, ends in a traceback or in an error that says nothing. Every
process has 8 GiB of address space and ten minutes. Returns 1 if there is a fault.
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
    """Case that was tried, and the fault of its end; none if that is empty."""

    what: str
    fault: str = ""


class Trial(Protocol):
    """The cases of one class."""

    def __call__(self, seed: int, cases: int, place: Path) -> Iterator[Case]:
        """So many cases, tried one after the other; `place` is an empty folder."""
        ...


def trial_of(name: str) -> Trial:
    """The function `cases` of a class's module, which is imported now."""
    found: Trial = importlib.import_module(f"tools.trial_{name}").cases
    return found


def tried(name: str, seed: int, cases: int, minutes: float) -> tuple[int, list[Case]]:
    """Try as many cases as there is time for; returns their number and the faults, which are printed at once."""
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
    """Tries one class, and says how it went."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=CLASSES, metavar="CLASS", help=", ".join(CLASSES))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cases", type=int, default=100)
    parser.add_argument("--minutes", type=float, default=10.0, help="no case begins after so long")
    options = parser.parse_args()
    begun = time.monotonic()
    count, faults = tried(options.kind, options.seed, options.cases, options.minutes)
    seconds = time.monotonic() - begun
    print(f"{options.kind}, seed {options.seed}: {count} cases in {seconds:.0f} s, {len(faults)} faults")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
