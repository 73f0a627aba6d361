"""Frames of a trained `deferred` run compared with `splat` on the same Gaussians: python -m benchmarks.trained RUN."""

from __future__ import annotations

import argparse
import statistics
from dataclasses import replace
from pathlib import Path

import numba

from benchmarks.methods import doublings, frame_work, thread_count
from benchmarks.table import Table
from benchmarks.timing import clocks_of
from glassplat.cli.runs import StoredRun, open_run
from glassplat.render.deferred import Deferred
from glassplat.render.splat import Splat


def frame_costs(stored: StoredRun, renderer: Deferred, rounds: int) -> Table:
    """Times frames of all test views in turn, without depths, for 1, 2, 4, ... threads."""
    splat = Splat(renderer.background, depth=False)
    methods = (splat, replace(renderer, depth=False))
    pairs = [[frame_work(stored.scene, method, view.camera) for method in methods] for view in stored.dataset.test]
    table = Table(
        f"deferred against splat, {len(stored.scene.primary):,} trained Gaussians",
        ("threads", "splat, ms", "deferred, ms", "ratio", "splat, CPU ms", "deferred, CPU ms", "CPU ratio"),
        f"Medians over {rounds} rounds of {len(pairs)} test views; ratios are medians of ratios taken view by view.",
    )
    for threads in doublings(numba.config.NUMBA_NUM_THREADS):
        with thread_count(threads):
            times = [[clocks_of(work) for work in pair] for _ in range(rounds + 1) for pair in pairs][len(pairs) :]
        cells: list[float] = []
        for clock in range(2):
            own = [[of_method[clock] for of_method in both] for both in times]
            cells += [statistics.median(both[method] for both in own) for method in range(2)]
            cells.append(statistics.median(deferred / plain for plain, deferred in own))
        table.add(threads, *cells)
    return table


def main() -> None:
    """Measures and prints the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.trained", description=__doc__)
    parser.add_argument("run", type=Path, help="directory of a `deferred` run")
    parser.add_argument("--rounds", type=int, default=9, help="number of times that each test view is rendered")
    arguments = parser.parse_args()
    stored = open_run(arguments.run, "cpu")
    if not isinstance(stored.renderer, Deferred):
        parser.error(f"{arguments.run} is a run of {stored.recipe.method}; expected one of deferred")
    print(frame_costs(stored, stored.renderer, arguments.rounds).markdown())


if __name__ == "__main__":
    main()
