"""`python -m benchmarks.gpu`: checks the CUDA kernels on this GPU, times them and gsplat, and trains `planar`.

Each part runs in its own process with a time limit, because a CUDA error makes the process unusable: if one part fails,
the others still run. The limits add up to less than nine minutes. gsplat is optional (`pip install gsplat==1.5.3`), and
compiles itself on its first call.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch

from glassplat.kernels.backend.devices import cuda_problem

ROOT = Path(__file__).parent.parent
COUNT = 560_000
CHECKS = [
    f"tests/kernels/cuda/test_{name}.py"
    for name in ("parity", "pane_parity", "disc_parity", "trace_parity", "on_a_gpu")
]
DATA, ITERATIONS = ROOT / "glassplat" / "demo_scene", 7000
LIMITS = {"launch": 60, "parity": 165, "frames": 100, "operations": 60, "training": 150}
"""Parts in their order, and the time limit of each in seconds."""


def main() -> int:
    """Runs all parts, or the one given by --part; returns 1 without a GPU or if a part fails."""
    arguments = parsed()
    problem = cuda_problem()
    if problem is not None:
        print(f"no GPU to measure: {problem}", file=sys.stderr)
        return 1
    if arguments.part is not None:
        print(PARTS[arguments.part](arguments), flush=True)
        return 0
    print(
        f"Machine: {torch.cuda.get_device_name()}, torch {torch.__version__}, CUDA {torch.version.cuda}.\n", flush=True
    )
    parts = [part for part in LIMITS if part != "training" or arguments.iterations]
    failed = [part for part in parts if not succeeds(part, sys.argv[1:])]
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


def parsed() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu", description=__doc__)
    parser.add_argument("--count", type=int, default=COUNT, help="number of Gaussians in the timings")
    parser.add_argument("--data", type=Path, default=DATA, help="capture to train on; default: the bundled one")
    parser.add_argument(
        "--iterations", type=int, default=ITERATIONS, help="length of the training run; 0 trains nothing"
    )
    parser.add_argument("--cpu-run", type=Path, help="evaluated run of the same training on the CPU, to compare with")
    parser.add_argument("--part", choices=tuple(LIMITS), help="run only this part, in this process")
    return parser.parse_args()


def succeeds(part: str, options: list[str]) -> bool:
    """Runs a part in its own process, which prints its results; reports failures and timeouts."""
    command, started = [sys.executable, "-m", "benchmarks.gpu", "--part", part, *options], time.perf_counter()
    try:
        status = subprocess.run(command, cwd=ROOT, timeout=LIMITS[part], check=False).returncode
    except subprocess.TimeoutExpired:
        print(f"{part}: stopped after {LIMITS[part]} s", file=sys.stderr, flush=True)
        return False
    if status:
        print(f"{part}: failed with status {status}", file=sys.stderr, flush=True)
    print(f"({part}: {time.perf_counter() - started:.0f} s)\n", flush=True)
    return status == 0


def launch(arguments: argparse.Namespace) -> str:
    """Minimal check: one kernel is compiled, loaded and launched, and its result is correct."""
    from glassplat.kernels.adam import Update, adam

    parameter = torch.ones(1000, 3, device="cuda")
    gradient, first, second = torch.ones_like(parameter), torch.zeros_like(parameter), torch.zeros_like(parameter)
    adam([Update(parameter, gradient, first, second, 0.25, 1)])
    torch.testing.assert_close(parameter, torch.full_like(parameter, 0.75))
    return "A kernel was compiled, loaded and launched."


def parity(arguments: argparse.Namespace) -> str:
    """Checks every kernel against its twin, and float32 against float64 at sizes too large for the twins."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *CHECKS]
    status = subprocess.run(command, cwd=ROOT, env=os.environ | {"PYTHONUNBUFFERED": "1"}, check=False).returncode
    if status:
        raise SystemExit("the kernels disagree with their twins")
    return "The kernels agree with their twins."


def frames(arguments: argparse.Namespace) -> str:
    """Times frames, gradients and steps of both methods and of gsplat."""
    from benchmarks.gpu_frames import measured

    return measured(arguments.count).markdown()


def operations(arguments: argparse.Namespace) -> str:
    """Times each operation, forward and backward."""
    from benchmarks.gpu_operations import kernel_times

    return kernel_times(arguments.count).markdown()


def train(arguments: argparse.Namespace) -> str:
    """Trains a complete `planar` run and evaluates it."""
    from benchmarks.gpu_training import training

    with tempfile.TemporaryDirectory() as folder:
        table = training(arguments.data, arguments.iterations, Path(folder) / "planar", cpu_run=arguments.cpu_run)
    return table.markdown()


# Each part imports its own modules, so that a missing package does not affect the others.
PARTS: dict[str, Callable[[argparse.Namespace], str]] = {
    "launch": launch,
    "parity": parity,
    "frames": frames,
    "operations": operations,
    "training": train,
}

if __name__ == "__main__":
    sys.exit(main())
