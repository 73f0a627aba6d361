"""`python -m benchmarks [--write]`: runs all measurements; --write puts the tables into docs/performance.md."""

from __future__ import annotations

import argparse
import os
import platform
from pathlib import Path

import numba
import torch

from benchmarks.kernels import kernel_times, twin_ratios
from benchmarks.looking import looking_times
from benchmarks.methods import deferred_costs, method_costs, scaling
from benchmarks.steps import step_costs

WRITTEN = (kernel_times, method_costs)
"""Measurements whose tables the page shows."""
PAGE = Path(__file__).parent.parent / "docs" / "performance.md"
BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"


def machine() -> str:
    """Description of the machine and the versions, in one line."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        names = [
            line.partition(":")[2].strip() for line in cpuinfo.read_text().splitlines() if line.startswith("model name")
        ]
        model = names[0] if names else model
    versions = f"Python {platform.python_version()}, torch {torch.__version__}, numba {numba.__version__}"
    return f"{model}, {os.cpu_count()} cores, {versions}"


def main() -> None:
    """Measures, prints the tables, and writes them with --write."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--write", action="store_true", help="put the tables into docs/performance.md")
    arguments = parser.parse_args()
    parts = [f"Machine: {machine()}.\n"]
    print(parts[0])
    for measure in (kernel_times, twin_ratios, step_costs, method_costs, deferred_costs, scaling, looking_times):
        table = measure().markdown()
        parts += [table] if measure in WRITTEN else []
        print(table, flush=True)
    if arguments.write:
        page = PAGE.read_text()
        before, _, rest = page.partition(BEGIN)
        after = rest.partition(END)[2]
        PAGE.write_text(f"{before}{BEGIN}\n\n" + "\n".join(parts) + f"\n{END}{after}")
        print(f"written to {PAGE}")


if __name__ == "__main__":
    main()
