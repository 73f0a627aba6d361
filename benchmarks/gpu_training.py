"""A complete run of `planar` on a capture, and its quality compared with the same run on the CPU."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.table import Table
from glassplat.cli.evaluation import evaluate_run
from glassplat.cli.runs import open_run
from glassplat.cli.train import Train
from glassplat.kernels.backend.devices import DeviceName
from glassplat.methods.planar_recipe import PlanarRecipe

METRICS = ("psnr", "ssim", "lpips", "pane_psnr", "transmission_psnr", "reflection_psnr")
SAME = ("method", "iterations", "seed", "downscale")
"""Fields that must be equal for two runs to be comparable."""


def training(
    data: Path, iterations: int, output: Path, *, cpu_run: Path | None, device: DeviceName = "cuda", seed: int = 0
) -> Table:
    """Trains and evaluates `planar`, and compares the metrics with those of a run on the CPU.

    Args:
        data: directory of the capture.
        iterations: length of the run.
        output: new directory of the run.
        cpu_run: directory of the evaluated run on the CPU; None leaves its column empty.
        device: device to train on.
        seed: random seed.

    Raises:
        ValueError: the run on the CPU has other settings.
    """
    recorded = {} if cpu_run is None else json.loads((cpu_run / "results.json").read_text())
    console = Console(quiet=True)
    started = time.perf_counter()
    Train(PlanarRecipe(), data, output, iterations, seed=seed, device=device).run(console)
    seconds = time.perf_counter() - started
    return beside_the_cpu(evaluate_run(open_run(output, device)), recorded, seconds, data)


def beside_the_cpu(found: Mapping[str, Any], recorded: Mapping[str, Any], seconds: float, data: Path) -> Table:
    """Table of one run; `recorded` are the results on the CPU, or empty."""
    if recorded and (other := {name: recorded.get(name) for name in SAME}) != {name: found[name] for name in SAME}:
        raise ValueError(f"the run on the CPU is {other}; expected { {name: found[name] for name in SAME} }")
    iterations = found["iterations"]
    note = "" if recorded else "For the other column train and evaluate on the CPU, and pass the folder as --cpu-run: "
    if not recorded:
        note += f"`glassplat train planar --data {data} --output runs/cpu --iterations {iterations} --device cpu` "
        note += "and `glassplat eval runs/cpu`."
    table = Table(
        f"planar on {data.resolve().name}, {iterations:,} iterations", ("what", "GPU", "CPU", "difference"), note
    )
    table.add("training, s", seconds, recorded.get("train_seconds") or "", "")
    table.add("iterations/s", iterations / seconds, "", "")
    for name in METRICS:
        own, other = found.get(name), recorded.get(name)
        if isinstance(own, float):
            both = isinstance(other, float)
            table.add(name, f"{own:.3f}", f"{other:.3f}" if both else "", f"{own - other:+.3f}" if both else "")
    return table
