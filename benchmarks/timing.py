"""Robust timing on a noisy machine: interleaved repetitions, medians and paired ratios."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping

Work = Callable[[], object]


def interleaved_seconds(
    works: Mapping[str, Work], repeats: int = 7, clock: Callable[[], float] = time.perf_counter
) -> dict[str, list[float]]:
    """Seconds of each piece of work, run in turn A B C A B C ... after one warm-up round."""
    for work in works.values():
        work()
    seconds: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(repeats):
        for name, work in works.items():
            start = clock()
            work()
            seconds[name].append(clock() - start)
    return seconds


def median_seconds(work: Work, repeats: int = 7) -> float:
    """Median seconds of one piece of work."""
    return statistics.median(interleaved_seconds({"work": work}, repeats)["work"])


def paired_ratio(seconds: Mapping[str, list[float]], over: str, under: str) -> float:
    """Median of the ratios round by round, which is insensitive to slow drift of the machine."""
    return statistics.median(a / b for a, b in zip(seconds[over], seconds[under], strict=True))


def clocks_of(work: Work) -> tuple[float, float]:
    """Milliseconds of wall-clock time, and of CPU time of all threads together."""
    start, processor = time.perf_counter(), time.process_time()
    work()
    return 1e3 * (time.perf_counter() - start), 1e3 * (time.process_time() - processor)
