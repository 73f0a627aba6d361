"""`glassplat eval`: metrics and pictures of a run."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console
from rich.table import Table

from glassplat.commands.messages import say
from glassplat.commands.stored_run import StoredRun, open_run
from glassplat.evaluate.evaluate import Evaluation, evaluate
from glassplat.evaluate.report import SURFACE_METRICS, Report
from glassplat.kernels.devices import DeviceName
from glassplat.render.planar import Planar
from glassplat.train.checkpoint import recorded_seconds
from glassplat.train.run_directory import write_text

SHOWN = (
    "psnr",
    "ssim",
    "lpips",
    "pane_psnr",
    "transmission_psnr",
    "reflection_psnr",
    "normal_error_deg",
    "reflective_normal_error_deg",
    "strength_error",
    "environment_psnr",
    "environment_lpips",
    "num_gaussians",
    "seconds_per_frame",
)


@dataclass(frozen=True)
class Evaluate:
    """Measure a run on its test views and write comparison sheets.

    Attributes:
        run_directory: the run's directory.
        device: where to render; auto takes an NVIDIA GPU where one can be used.
        data: where the capture is now, if it has moved since training.
    """

    run_directory: tyro.conf.Positional[Path]
    device: DeviceName = "auto"
    data: Path | None = None

    def run(self, console: Console) -> None:
        """Evaluates and reports."""
        stored = open_run(self.run_directory, self.device, self.data)
        with console.status(f"rendering {len(stored.dataset.test)} test views"):
            results = evaluate_run(stored)
        console.print(results_table(results))
        say(console, f"pictures: {stored.directory.path / 'index.html'}")


def evaluate_run(stored: StoredRun) -> dict:
    """Evaluates a run, writes `results.json`, `per_view.json`, sheets and overview; returns the results."""
    settings, path = stored.directory.settings(), stored.directory.path
    blend = stored.renderer.blend if isinstance(stored.renderer, Planar) else None
    report = Report(path, stored.dataset, blend)
    evaluation: Evaluation = evaluate(stored.scene, stored.renderer, stored.dataset, listen=report.add)
    results = {
        "method": stored.recipe.method,
        "iterations": stored.iterations,
        "seed": settings.seed,
        "downscale": settings.downscale,
        "train_seconds": train_seconds(stored),
        **evaluation.results,
    }
    write_text(path / "results.json", json.dumps(results, indent=2))
    write_text(path / "per_view.json", json.dumps(evaluation.per_view, indent=2))
    report.finish(results, evaluation.per_view)
    return results


def train_seconds(stored: StoredRun) -> float | None:
    """Training time as the checkpoint recorded it."""
    file = stored.directory.checkpoint
    return recorded_seconds(file) if file.is_file() else None


def results_table(*results: dict) -> Table:
    """The main metrics of one or several runs, side by side."""
    table = Table("metric", *(r["method"] for r in results))
    for name in SHOWN:
        if name in SURFACE_METRICS and all(r.get(name) is None for r in results):
            continue
        table.add_row(name, *(shown(r.get(name)) for r in results))
    for result in results:
        for plane in result.get("planes") or []:
            if plane.get("normal_error_deg") is not None:
                table.add_row(
                    f"pane {plane['label']}",
                    *(plane_text(plane) if r is result else "" for r in results),
                )
    return table


def plane_text(plane: dict) -> str:
    """A plane's errors in one line."""
    return (
        f"normal {plane['normal_error_deg']:.2f} deg, offset {100 * plane['offset_error']:.2f} %, "
        f"R0 {plane['base_reflectance']:.3f} (error {plane['base_reflectance_error']:.3f})"
    )


def shown(value: float | int | None) -> str:
    """A metric for the table."""
    if value is None:
        return "-"
    return str(value) if isinstance(value, int) else f"{value:.4g}"
