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
NAMES = ("parity", "pane_parity", "disc_parity", "trace_parity", "taking_turns")
TESTS = [f"tests/kernels/cuda/test_{name}.py" for name in NAMES]


@pytest.mark.skipif(SIMULATED, reason="this process is the simulator")
def test_every_kernel_agrees_with_the_reference_in_the_simulator() -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *TESTS]
    environment = os.environ | {"NUMBA_ENABLE_CUDASIM": "1", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-8000:] + done.stderr[-2000:]
    assert " passed" in done.stdout and " skipped" not in done.stdout.splitlines()[-1]
