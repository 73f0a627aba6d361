"""Implementation of `glassplat eval`: metrics and comparison sheets of a run."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import count
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from glassplat.captures.dataset import Dataset
from glassplat.cli.console import print_line
from glassplat.cli.progress import WorkProgress
from glassplat.cli.runs import StoredRun, open_run
from glassplat.errors import InputError
from glassplat.evaluate import evaluate as scoring
from glassplat.evaluate.metrics import PLANE_COLUMNS, format_value, missing_reasons, partial_means, shown_metrics
from glassplat.evaluate.report import Report
from glassplat.files.writing import check_links, write_text
from glassplat.methods.planar import capture_planes
from glassplat.model.run_directory import EVALUATION_FILES
from glassplat.panes import PlaneFit, PlaneFitError
from glassplat.render.planar import Planar, with_photographer
from glassplat.training.checkpoint import read_progress
from glassplat.training.messages import Working

if TYPE_CHECKING:
    from glassplat.cli.scene import Align, Evaluate, PaneSource


def pane_regions(dataset: Dataset, source: PaneSource) -> scoring.PaneRegions:
    """Pixels that show panes, from the named source."""
    if source == "auto":
        return _best_regions(dataset)
    if source == "masks":
        return _marked_regions(dataset)
    if source == "truth" and dataset.truth is None:
        raise InputError(f"{dataset.root} has no ground truth (gt/) of its panes; use --panes masks")
    return scoring.TRUE_REGIONS if source == "truth" else scoring.RENDERED_REGIONS


def _best_regions(dataset: Dataset) -> scoring.PaneRegions:
    """Pane pixels from the most reliable source."""
    if dataset.truth is not None:
        return scoring.TRUE_REGIONS
    try:
        return _marked_regions(dataset)
    except InputError:
        return scoring.RENDERED_REGIONS


def _marked_regions(dataset: Dataset) -> scoring.PaneRegions:
    """Pane pixels from the masks and freshly fitted planes, the same for all methods."""
    if not dataset.pane_labels and dataset.planes is None:
        raise InputError(f"{dataset.root} has no pane masks; use --panes rendered, or add masks")
    try:
        # The margin of rectangles is only for training, which must not crop a pane.
        return scoring.marked_regions(capture_planes(dataset, None, PlaneFit(margin=1.0)))
    except PlaneFitError as error:
        raise InputError(
            f"the masks of {dataset.root} do not determine a plane: {error}. Use --panes rendered"
        ) from error


def evaluate_and_report(command: Evaluate, console: Console) -> None:
    """Evaluates a run and reports."""
    stored = open_run(command.run_directory, command.device, command.data)
    with WorkProgress(console) as progress:
        results = evaluate_run(stored, command.panes, align=command.align, show=progress.show)
    print_results(console, results)
    print_line(console, f"pictures: {stored.directory.path / 'index.html'}")


UNCHANGED_CAMERAS = "as the capture has them"
RENDERING_LABEL = "rendering test views"


def evaluate_run(
    stored: StoredRun,
    panes: PaneSource = "auto",
    *,
    align: Align = "auto",
    show: Callable[[Working], None] = lambda work: None,
) -> dict:
    """Evaluates a run; writes `results.json`, `per_view.json`, sheets and an overview; returns the results.

    Args:
        stored: the run.
        panes: source of pane pixels.
        align: when to align test cameras first.
        show: receives the progress.
    """
    check_links(stored.directory.path, (*EVALUATION_FILES, stored.directory.results.name))
    seconds, regions = train_seconds(stored), pane_regions(stored.dataset, panes)
    aligned = align == "always" or (align == "auto" and len(stored.scene.poses) > 0)
    if aligned:
        photographed = with_photographer(stored.renderer, "present")

        def listen(done: int, total: int) -> None:
            show(Working("aligning the cameras of test views", done, total))

        dataset = scoring.with_aligned_test_views(stored.scene, photographed, stored.dataset, listen)
        stored = stored._replace(dataset=dataset)
    settings, path = stored.directory.settings(), stored.directory.path
    blend = stored.renderer.blend if isinstance(stored.renderer, Planar) else None
    report = Report(path, stored.dataset, blend)
    views = count(1)

    def add(view: scoring.EvaluatedView) -> None:
        report.add(view)
        show(Working(RENDERING_LABEL, next(views), len(stored.dataset.test)))

    show(Working(RENDERING_LABEL, 0, len(stored.dataset.test)))
    evaluation: scoring.Evaluation = scoring.evaluate(
        stored.scene, with_photographer(stored.renderer, "separate"), stored.dataset, regions=regions, listen=add
    )
    results = {
        "method": stored.recipe.method,
        "iterations": stored.iterations,
        "seed": settings.seed,
        "downscale": settings.downscale,
        "train_seconds": seconds,
        "test_cameras": cameras_of_test_views(stored, aligned),
        **evaluation.results,
    }
    write_text(path / "results.json", json.dumps(results, indent=2) + "\n")
    write_text(path / "per_view.json", json.dumps(evaluation.per_view, indent=2) + "\n")
    report.finish(results, evaluation.per_view)
    return results


def cameras_of_test_views(stored: StoredRun, aligned: bool) -> str:
    """Description of the cameras of test views."""
    if aligned:
        return "aligned with their photographs"
    moved = stored.scene.poses.covers_any(view.name for view in stored.dataset.test)
    return "moved like those of the neighbouring photographs, by name" if moved else UNCHANGED_CAMERAS


def train_seconds(stored: StoredRun) -> float | None:
    """Training time from the checkpoint; None if there is no readable one, which evaluation does not need."""
    try:
        return read_progress(stored.directory.checkpoint).seconds
    except (FileNotFoundError, InputError):
        return None


def print_results(console: Console, *results: dict) -> None:
    """Prints the main metrics of one or several runs, side by side, and the reasons for missing values."""
    console.print(results_table(*results))
    for line in result_notes(*results):
        print_line(console, line)


def results_table(*results: dict) -> Table:
    """The main metrics of one or several runs, side by side, by their names in `results.json`."""
    table = Table("metric", *(r["method"] for r in results))
    metrics = {name: metric for r in results for name, metric in shown_metrics(r).items()}
    for name, metric in metrics.items():
        table.add_row(name, *(format_value(r.get(name), metric.pattern) for r in results))
    for result in results:
        for plane in result.get("planes") or []:
            cells = (plane_text(plane) if r is result else "" for r in results)
            table.add_row(f"pane {plane['label']}", *cells)
    return table


def plane_text(plane: dict) -> str:
    """A pane in one line: its reflectance, and its errors if the truth is known."""
    text = f"R0 {format_value(plane['base_reflectance'], PLANE_COLUMNS['base_reflectance'].pattern)}"
    if plane.get("normal_drift_deg") is not None:
        text += f", {plane['normal_drift_deg']:.2f}° from the plane of the masks"
    if plane.get("normal_error_deg") is None:
        return text
    return (
        f"{text} (error {plane['base_reflectance_error']:.3f}), normal off by {plane['normal_error_deg']:.2f}°, "
        f"centre by {100 * plane['offset_error']:.2f} % of the extent"
    )


def result_notes(*results: dict) -> list[str]:
    """One line for each change to test views, for means over some of them, and for each reason of missing metrics."""
    heads = [f"{result['method']}: " if len(results) > 1 else "" for result in results]
    changed = [
        f"{head}{name} of test views: {result[key]}"
        for head, result in zip(heads, results, strict=True)
        for name, key, default in (
            ("cameras", "test_cameras", UNCHANGED_CAMERAS),
            ("exposures", "test_exposures", scoring.SCENE_COLORS),
        )
        if result.get(key, default) != default
    ]
    partial = [
        f"{head}{', '.join(names)}: means over {count} of {result['num_test_views']} test views, see per_view.json"
        for head, result in zip(heads, results, strict=True)
        for count, names in partial_means(result).items()
    ]
    return [*changed, *partial] + [
        f"{head}no {', '.join(names)}: {reason}"
        for head, result in zip(heads, results, strict=True)
        for reason, names in missing_reasons(result).items()
    ]
