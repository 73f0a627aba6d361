"""Makes every test deterministic, and counts skipped tests aloud."""

from __future__ import annotations

import os

# Numba reads this once, when it is imported. Two threads are enough to find a result that depends on their number,
# which tests/kernels/threads.py looks for. All other tests run on one: threads that wait for each other on cores that
# are shared with other tests take ten times as long.
os.environ.setdefault("NUMBA_NUM_THREADS", "2")

# Before PyTorch, as the package asks: it says how threads wait.
import glassplat  # noqa: F401, I001

import contextlib
import random
import signal
from collections.abc import Iterator

import hypothesis
import numba
import numpy as np
import pytest
import torch
from _pytest.terminal import TerminalReporter

from tools.browser import CHROMIUM, running_chromium

# A shell lets what it starts in the background ignore Ctrl-C, and `nohup` the end of the terminal. The package leaves
# ignored what it finds ignored; its tests want these signals heard, here and in the processes that they start.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)

hypothesis.settings.register_profile("deterministic", derandomize=True, deadline=None, max_examples=30, database=None)
hypothesis.settings.load_profile("deterministic")


@pytest.fixture(autouse=True)
def fixed_state() -> Iterator[None]:
    """Each test starts from the same random state and thread count, whatever ran before it."""
    random.seed(0)
    np.random.seed(0)  # Third-party code may still draw from the global state.
    torch.manual_seed(0)
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.fixture(scope="module")
def one_chromium() -> Iterator[None]:
    """One Chromium, where there is one, for the pages of a module, in which no test may run an event loop."""
    with running_chromium() if CHROMIUM else contextlib.nullcontext():
        yield


def pytest_terminal_summary(terminalreporter: TerminalReporter) -> None:
    """Ends the run with the tests that did not run, so that a green line hides nothing."""
    skipped = terminalreporter.stats.get("skipped", [])
    if not skipped:
        terminalreporter.write_line("skipped tests: none", green=True)
        return
    terminalreporter.section(f"{len(skipped)} TESTS WERE SKIPPED, their subject is unchecked", yellow=True, bold=True)
    for report in skipped:
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        terminalreporter.write_line(f"  {report.nodeid}: {reason}", yellow=True)
