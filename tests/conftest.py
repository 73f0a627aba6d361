"""Makes every test deterministic, and reports skipped tests."""

from __future__ import annotations

import os

# Numba reads this once, when it is imported. Two threads suffice to find results that depend on their number, which
# tests/kernels/threads.py checks. All other tests run on one: threads that wait for each other on cores shared with
# other tests take ten times as long.
os.environ.setdefault("NUMBA_NUM_THREADS", "2")

# Before PyTorch, as the package requires: it sets how threads wait.
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

# A shell makes background processes ignore Ctrl-C, and `nohup` makes them ignore the end of the terminal. The package
# keeps ignoring such signals; its tests need them delivered, here and in the processes that they start.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)

hypothesis.settings.register_profile("deterministic", derandomize=True, deadline=None, max_examples=30, database=None)
hypothesis.settings.load_profile("deterministic")


@pytest.fixture(autouse=True)
def fixed_state() -> Iterator[None]:
    """Each test starts with the same random state and thread count, whichever tests ran before it."""
    random.seed(0)
    np.random.seed(0)  # Third-party code may still draw random numbers from the global state.
    torch.manual_seed(0)
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.fixture(scope="module")
def one_chromium() -> Iterator[None]:
    """One Chromium, if installed, for the pages of a module, whose tests must not run an event loop."""
    with running_chromium() if CHROMIUM else contextlib.nullcontext():
        yield


def pytest_terminal_summary(terminalreporter: TerminalReporter) -> None:
    """Lists the skipped tests at the end of the run, so that a green line hides nothing."""
    skipped = terminalreporter.stats.get("skipped", [])
    if not skipped:
        terminalreporter.write_line("skipped tests: none", green=True)
        return
    terminalreporter.section(f"{len(skipped)} TESTS WERE SKIPPED, their subject is unchecked", yellow=True, bold=True)
    for report in skipped:
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        terminalreporter.write_line(f"  {report.nodeid}: {reason}", yellow=True)
