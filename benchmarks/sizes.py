"""Time and memory of operations that grow with the number of Gaussians: python -m benchmarks.sizes [--counts N ...].

The scene is a room behind a pane that covers half of an image of 960x540, SH degree 3, float32. Each size runs in its
own process, so that peak memory is measured separately. Frames and steps are medians of five; all other work runs once,
after a warm-up with few Gaussians.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch

from benchmarks.methods import frame_work, step_work, view_of
from benchmarks.scene import bench_camera, bench_scene
from benchmarks.table import Table
from benchmarks.timing import median_seconds
from glassplat.files.ply import read_gaussians, write_gaussians
from glassplat.kernels.backend.devices import chosen_device
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.publish.web_page import write_page
from glassplat.render.layers import contributions
from glassplat.render.planar import Planar
from glassplat.render.splat import Splat
from glassplat.training.actions import Densify
from glassplat.training.checkpoint import load_checkpoint, save_checkpoint
from glassplat.training.densify import ScreenStatistics, morton_order
from glassplat.training.options import DefaultDensify
from glassplat.training.stage import Clock, TrainState

WIDTH, HEIGHT, FEW = 960, 540, 2_000
COUNTS = (100_000, 1_000_000, 10_000_000)

Works = dict[str, Callable[[], Any]]


def works_of(count: int, device: torch.device, folder: Path) -> tuple[Works, Works]:
    """Repeated and single pieces of work, in the order of the table."""
    camera = bench_camera(WIDTH, HEIGHT).to(device)
    scene = bench_scene(count, 1, 0.5, bench_camera(WIDTH, HEIGHT)).to(device)
    view, state = view_of(camera), TrainState(scene, seed=0)
    for name, parameter in scene.parameters().items():
        state.optimizer.moments_of(name, parameter)
    repeated: Works = {
        "splat frame": frame_work(scene, Splat(depth=False), camera),
        "planar frame": frame_work(scene, Planar(), camera),
        "splat step": step_work(scene, SplatRecipe().stages(0)[0], view),
        "planar step": step_work(scene, PlanarRecipe().stages(0)[2], view),
    }

    def densify() -> None:
        statistics = ScreenStatistics.zeros(count, device=device)
        statistics.view_count.fill_(1)
        # Every tenth Gaussian is split or cloned.
        statistics.gradient_sum[:, ::10] = statistics.absgrad_sum[:, ::10] = 1
        grown = TrainState(scene, seed=0)
        grown.optimizer.moments, grown.statistics["primary"] = dict(state.optimizer.moments), statistics
        dataset: Any = SimpleNamespace(train=[view])
        Densify(DefaultDensify(cap=2 * count)).apply(grown, dataset, Clock(1000, 7000, 1))

    once: Works = {
        "densify": densify,
        "put in order": lambda: morton_order(scene.primary.means),
        "contribution to a view": lambda: contributions(scene, camera),
        "save checkpoint": lambda: save_checkpoint(folder / "state.safetensors", state),
        "read checkpoint": lambda: load_checkpoint(folder / "state.safetensors"),
        "write PLY": lambda: write_gaussians(folder / "scene.ply", scene.primary),
        "read PLY": lambda: read_gaussians(folder / "scene.ply"),
        "export page": lambda: write_page(folder / "page.html", scene, Planar(), [("one", camera)], "page"),
    }
    return repeated, once


def measure(count: int, device: torch.device) -> None:
    """Prints a row for each piece of work: its name, milliseconds, and the peak memory so far in MB."""

    def finished(work: Callable[[], Any]) -> None:
        with torch.no_grad() if work in once.values() else torch.enable_grad():
            work()
        if device.type == "cuda":
            torch.cuda.synchronize(device)

    with tempfile.TemporaryDirectory() as folder:
        for number in (FEW, count):
            repeated, once = works_of(number, device, Path(folder))
            for name, work in (repeated | once).items():
                if device.type == "cuda":
                    torch.cuda.reset_peak_memory_stats(device)
                begun = time.perf_counter()
                try:
                    seconds = median_seconds(lambda work=work: finished(work), 5) if name in repeated else None
                    if seconds is None:
                        finished(work)
                        seconds = time.perf_counter() - begun
                    cell = f"{1e3 * seconds:.4g}"
                except (RuntimeError, ValueError, MemoryError) as error:
                    cell = f"no: {str(error).splitlines()[0][:80]}"
                if number == count:
                    print(f"{name}\t{cell}\t{peak_megabytes(device):.0f}", flush=True)
        for file in ("state.safetensors", "scene.ply", "page.html"):
            path = Path(folder) / file
            size = f"{path.stat().st_size / 1e6:.4g}" if path.is_file() else "none"
            print(f"size of {file}\t{size} MB\t", flush=True)


def peak_megabytes(device: torch.device) -> float:
    """Peak memory: of the process so far, or of PyTorch on the GPU since the last reset."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 1e6
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def main() -> None:
    """Measures every size and prints the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.sizes", description=__doc__)
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS, help="numbers of Gaussians")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one is not None:
        measure(arguments.one, chosen_device(arguments.device))
        return
    columns: dict[int, dict[str, tuple[str, str]]] = {}
    for count in arguments.counts:
        command = [sys.executable, "-m", "benchmarks.sizes", "--one", str(count), "--device", arguments.device]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
        rows = (line.split("\t") for line in done.stdout.splitlines() if line.count("\t") == 2)
        columns[count] = {name: (cell, memory) for name, cell, memory in rows}
        if done.returncode:
            print(f"{count:,} Gaussians: ended with status {done.returncode}", file=sys.stderr, flush=True)
    headings = (f"{count:,}: {what}" for count in arguments.counts for what in ("ms", "MB"))
    table = Table("Sizes", ("what", *headings), f"On {chosen_device(arguments.device)}, {WIDTH}x{HEIGHT}.")
    for name in dict.fromkeys(name for column in columns.values() for name in column):
        table.add(name, *(cell for column in columns.values() for cell in column.get(name, ("", ""))))
    print(table.markdown())


if __name__ == "__main__":
    main()
