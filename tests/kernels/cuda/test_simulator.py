"""Runs the parity tests in Numba's CUDA simulator, in a separate process: it is chosen when Numba is imported."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from glassplat.kernels.backend.devices import SIMULATED

pytest.importorskip("numba_cuda", reason="numba-cuda is not installed; `make setup` installs it")

ROOT = Path(__file__).parents[3]


@pytest.mark.skipif(SIMULATED, reason="this process is the simulator")
@pytest.mark.parametrize(
    "tests",
    [
        ("test_parity.py", "test_pane_parity.py"),
        ("test_disc_parity.py", "test_trace_parity.py", "test_taking_turns.py"),
    ],
    ids=" ".join,
)
def test_every_kernel_agrees_with_the_reference_in_the_simulator(tests: tuple[str, ...]) -> None:
    files = [f"tests/kernels/cuda/{name}" for name in tests]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *files]
    environment = os.environ | {"NUMBA_ENABLE_CUDASIM": "1", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-8000:] + done.stderr[-2000:]
    assert " passed" in done.stdout and " skipped" not in done.stdout.splitlines()[-1]
