"""The benchmark of the GPU: the parts that can be tested without one."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks import gpu, gpu_frames
from benchmarks.gpu_roofline import Counts, Peaks, backward_demand, forward_demand
from benchmarks.gpu_training import beside_the_cpu
from glassplat.kernels.backend.devices import SIMULATED

ROOT = Path(__file__).parents[2]
ONLY_PYTORCH = """
import sys
for name in ("pycolmap", "OpenEXR", "tyro", "rich", "numba_cuda"):
    sys.modules[name] = None
sys.argv = ["benchmarks.gpu"]
from benchmarks.gpu import main
sys.exit(main())
"""


def test_the_gpu_benchmark_without_a_gpu_ends_with_one_line() -> None:
    environment = os.environ | {"CUDA_VISIBLE_DEVICES": "", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", ONLY_PYTORCH]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith("no GPU to measure: ")


def test_the_bound_is_the_scarcer_of_arithmetic_and_memory() -> None:
    counts = Counts(pairs=1000, evaluations=100_000, buckets=40, pixels=5000, channels=3)
    forward, backward = forward_demand(counts), backward_demand(counts)
    assert forward.multiply_adds == 1_800_000
    assert forward.bytes == 1000 * 40 + 40 * 256 * 16 + 5000 * 36
    assert backward.multiply_adds == 2 * forward.multiply_adds
    assert backward.bytes == forward.bytes + 1000 * 36
    assert forward.seconds_at(Peaks(multiply_adds=1e6, bytes=1e12)) == 1.8
    assert forward.seconds_at(Peaks(multiply_adds=1e12, bytes=forward.bytes / 3)) == pytest.approx(3.0)


RESULTS = {"method": "planar", "iterations": 7000, "seed": 0, "downscale": 1.0, "psnr": 30.25, "lpips": "no weights"}


def test_the_quality_is_listed_with_that_of_the_cpu_run() -> None:
    recorded = RESULTS | {"psnr": 30.3, "train_seconds": 900.0}
    text = beside_the_cpu(RESULTS, recorded, 70.0, Path("captures/showcase")).markdown()
    assert "planar on showcase, 7,000 iterations" in text
    assert "| training, s | 70 | 900 |  |" in text
    assert "| psnr | 30.250 | 30.300 | -0.050 |" in text
    assert "lpips" not in text


def test_a_missing_cpu_run_is_reported_with_the_command() -> None:
    text = beside_the_cpu(RESULTS, {}, 70.0, Path("captures/showcase")).markdown()
    assert "`glassplat train planar --data captures/showcase --output runs/cpu --iterations 7000 --device cpu`" in text
    assert "| psnr | 30.250 |  |  |" in text


def test_a_cpu_run_with_other_settings_is_refused() -> None:
    with pytest.raises(ValueError, match=r"the run on the CPU is .*'iterations': 300"):
        beside_the_cpu(RESULTS, RESULTS | {"iterations": 300}, 70.0, Path("showcase"))


@pytest.mark.skipif(SIMULATED, reason="the simulator has no compiler")
@pytest.mark.filterwarnings("ignore::numba.core.errors.NumbaPerformanceWarning")
def test_the_peak_is_measured_with_multiply_adds() -> None:
    pytest.importorskip("numba_cuda", reason="numba-cuda is not installed; `make setup` installs it")
    from benchmarks.gpu_peaks import CHAINS, multiply_adds
    from tools.compile_kernels import ptx_of

    (text,) = ptx_of(multiply_adds(np.float32), [(9, 0)])
    assert text.count("fma.rn.f32") >= CHAINS
    assert "mul.f32" not in text


def test_a_failing_or_hanging_part_does_not_affect_the_others(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    ran: list[list[str]] = []

    def run(command: list[str], **options: object) -> subprocess.CompletedProcess[str]:
        ran.append(command)
        part = command[command.index("--part") + 1]
        if part == "frames":
            raise subprocess.TimeoutExpired(command, 1)
        return subprocess.CompletedProcess(command, -11 if part == "parity" else 0)

    monkeypatch.setattr(gpu.subprocess, "run", run)
    monkeypatch.setattr(gpu, "cuda_problem", lambda: None)
    monkeypatch.setattr(gpu.torch.cuda, "get_device_name", lambda: "A GPU")
    monkeypatch.setattr(sys, "argv", ["benchmarks.gpu", "--count", "1000"])
    assert gpu.main() == 1
    assert [command[4] for command in ran] == ["launch", "parity", "frames", "operations", "training"]
    assert all(command[-2:] == ["--count", "1000"] for command in ran)
    said = capfd.readouterr()
    assert "parity: failed with status -11" in said.err
    assert "frames: stopped after" in said.err
    assert said.err.splitlines()[-1] == "failed: parity, frames"


def test_all_parts_together_stay_below_ten_minutes() -> None:
    assert set(gpu.LIMITS) == set(gpu.PARTS)
    assert sum(gpu.LIMITS.values()) < 9 * 60


def test_the_first_launch_is_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    # The CPU's optimiser kernel stands in for that of the GPU.
    monkeypatch.setattr(torch, "ones", partial(made_on_the_cpu, torch.ones))
    assert "launched" in gpu.launch(argparse.Namespace())


def made_on_the_cpu(make: Callable[..., torch.Tensor], *size: int, device: str) -> torch.Tensor:
    assert device == "cuda"
    return make(*size)


def test_timings_work_without_a_built_gsplat(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*args: object) -> None:
        raise ImportError("no module named csrc")

    monkeypatch.setattr(gpu_frames.importlib.util, "find_spec", lambda name: name)
    monkeypatch.setattr(gpu_frames, "gsplat_works", fail)
    assert gpu_frames.gsplat_if_usable(None, None) == ({}, "gsplat cannot be used: no module named csrc.")  # type: ignore[arg-type]
