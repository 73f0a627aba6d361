"""What `glassplat info` says of captures once PyTorch is there: views, panes, and what lies behind them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from glassplat.commands.inspecting.finding import FEW_VIEWS, Finding
from glassplat.data.capture_files import CaptureFiles
from glassplat.data.dataset import Dataset, dataset_of, load_dataset
from glassplat.data.errors import InputError
from glassplat.data.normal_maps import normals_path
from glassplat.init.plane_options import PlaneFit, PlaneFitError
from glassplat.init.virtual_scene import virtual_points
from glassplat.prepare.report_page import PAGE, write_page
from glassplat.prepare.workplace import RECORD
from glassplat.train.plane_entry import fitted_planes

FEW_POINTS, FEW_MASKS = 500, 3


def remaining_parts(files: CaptureFiles) -> Iterator[Finding]:
    """What there is to say of a capture beside what its files say.

    Raises:
        InputError: it cannot be used.
    """
    dataset = dataset_of(files)
    finding = Finding()
    sizes = sorted({f"{v.camera.width}x{v.camera.height}" for v in (*dataset.train, *dataset.test)})
    finding.facts["photographs"] = (
        f"{len(dataset.train)} to train, {len(dataset.test)} to test ({dataset.split}), {', '.join(sizes[:3])}"
    )
    finding.problems += dataset.warnings
    if len(dataset.train) + len(dataset.test) < FEW_VIEWS:
        finding.problems.append(f"{len(dataset.train) + len(dataset.test)} photographs are few; 30 and more do better")
    if dataset.measured_points and len(dataset.points) < FEW_POINTS:
        finding.problems.append(f"{len(dataset.points)} points are few; more photographs with more overlap give more")
    yield finding
    yield _marked(files.root, dataset)
    yield _behind(files.root, dataset)


def write_capture_page(path: Path, target: Path) -> None:
    """Writes the report of a prepared capture, with the panes that are marked in it.

    Raises:
        InputError: it is no such capture, or the file is somebody's.
    """
    if not (path / RECORD).is_file():
        raise InputError(f"{path} was not made by `glassplat prepare`: there is no {RECORD} to report on")
    if target.exists() and target.resolve() != (path / PAGE).resolve():
        raise InputError(f"{target} exists; choose another name for --page")
    dataset = load_dataset(path)
    marked = bool(dataset.pane_labels) or dataset.planes is not None
    write_page(path, target, fitted_planes(dataset, None, PlaneFit()) if marked else None)


def _marked(path: Path, dataset: Dataset) -> Finding:
    """Which panes are marked, and how well."""
    finding = Finding()
    if ignoring := sum(view.read_ignored is not None for view in (*dataset.train, *dataset.test)):
        finding.facts["ignored"] = f"parts of {ignoring} photographs, marked in ignore/"
    if estimated := sum(normals_path(view.image_path) is not None for view in dataset.train):
        finding.facts["normals"] = f"estimated for {estimated} training photographs; deferred and traced heed them"
    annotated = sum(view.is_annotated for view in dataset.train)
    if not dataset.pane_labels and dataset.planes is None:
        finding.facts["panes"] = "none marked"
        finding.next.append(f"glassplat annotate {path}    marks panes")
        finding.next.append(f"glassplat train splat --data {path} --output RUN    needs none")
        return finding
    given = () if dataset.planes is None else dataset.planes.labels
    labels = sorted({*dataset.pane_labels, *given})
    finding.facts["panes"] = f"{', '.join(map(str, labels))}; masks of {annotated} training photographs" + (
        f", planes.json gives {', '.join(map(str, given))}" if given else ""
    )
    if annotated < FEW_MASKS and not given:
        finding.problems.append(f"{annotated} masks are few; three to ten, from places well apart, do better")
    return finding


def _behind(path: Path, dataset: Dataset) -> Finding:
    """Whether planes can be fitted to the panes that are marked, and what lies behind them; takes seconds."""
    finding = Finding()
    if not dataset.pane_labels and dataset.planes is None:
        return finding
    try:
        planes = fitted_planes(dataset, None, PlaneFit())
    except PlaneFitError as error:
        finding.problems.append(str(error))
        finding.next.append(f"glassplat annotate {path}    marks panes by corners instead")
        return finding
    if dataset.measured_points:
        cameras = [view.camera for view in dataset.train]
        behind = int(virtual_points(dataset.points.positions, planes, cameras).sum())
        finding.facts["points behind panes"] = f"{behind} ({behind / max(len(dataset.points), 1):.0%})"
    finding.next.append(f"glassplat train planar --data {path} --output RUN")
    return finding
