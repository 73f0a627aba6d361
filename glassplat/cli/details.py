"""Details of captures and scenes for `glassplat info` that need PyTorch."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import torch

from glassplat.captures.cameras import LEAST_SIDE
from glassplat.captures.dataset import Dataset, load_dataset, make_dataset
from glassplat.captures.files import CaptureFiles
from glassplat.captures.view import sample_evenly
from glassplat.cli.console import shell_word
from glassplat.cli.info import FEW_VIEWS, Finding, describe_broken
from glassplat.errors import InputError, convert_to_input_error, count_noun
from glassplat.files.records import read_json
from glassplat.files.scene_folder import read_scene, read_splats
from glassplat.files.sidecars import read_planes
from glassplat.methods.planar import capture_planes
from glassplat.model.model import CAMERAS, EXPORT_STEM, PLANES
from glassplat.model.run_directory import RunDirectory, RunSettings
from glassplat.panes import PlaneFit, PlaneFitError
from glassplat.panes.material import virtual_points
from glassplat.prepare.report_page import write_page
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.panes import Planes, name_labels
from glassplat.scene.scene import Scene
from glassplat.training.checkpoint import read_progress

FEW_POINTS, FEW_MASKS = 500, 3
MASKS_SAMPLED = 16
"""Number of photographs in which the share of ignored pixels is measured."""


def remaining_parts(files: CaptureFiles) -> Iterator[Finding]:
    """Findings on a capture beyond its list of files."""
    dataset = make_dataset(files)
    finding = Finding()
    sizes = sorted({f"{v.camera.width}x{v.camera.height}" for v in (*dataset.train, *dataset.test)})
    finding.facts["photographs"] = (
        f"{len(dataset.train)} to train, {len(dataset.test)} to test ({dataset.split}), {', '.join(sizes[:3])}"
    )
    finding.problems += dataset.warnings
    if len(dataset.train) + len(dataset.test) < FEW_VIEWS:
        finding.problems.append(
            f"only {count_noun(len(dataset.train) + len(dataset.test), 'photograph')}; 30 or more work better"
        )
    if dataset.measured_points and len(dataset.points) < FEW_POINTS:
        finding.problems.append(
            f"{count_noun(len(dataset.points), 'point')} only; more photographs with more overlap give more"
        )
    yield finding
    yield _panes_part(files.root, dataset)
    yield _planes_part(files.root, dataset)
    decoded = Finding()
    describe_broken([view.image_path for view in (*dataset.train, *dataset.test)], decoded, LEAST_SIDE)
    yield decoded


def write_capture_page(path: Path, target: Path) -> None:
    """Writes the report of a prepared capture, with its marked panes."""
    dataset = load_dataset(path)
    marked = bool(dataset.pane_labels) or dataset.planes is not None
    write_page(path, target, capture_planes(dataset, None, PlaneFit()) if marked else None)


def _panes_part(path: Path, dataset: Dataset) -> Finding:
    """Marked panes, and the quality of the marks."""
    finding = Finding()
    if masked := [view for view in (*dataset.train, *dataset.test) if view.read_ignored is not None]:
        sampled = [view.ignored for view in sample_evenly(masked, MASKS_SAMPLED)]
        shares = [float(ignored.double().mean()) for ignored in sampled if ignored is not None]
        finding.facts["ignored"] = (
            f"about {sum(shares) / len(shares):.0%} of {count_noun(len(masked), 'photograph')}, by masks, "
            "transparency, or the lens"
        )
    if estimated := sum(view.read_normals is not None for view in dataset.train):
        finding.facts["normals"] = (
            f"estimated for {count_noun(estimated, 'training photograph')}; deferred and traced use them"
        )
    annotated = sum(view.is_annotated for view in dataset.train)
    if not dataset.pane_labels and dataset.planes is None:
        finding.facts["panes"] = "none marked"
        finding.next.append(f"glassplat annotate {shell_word(path)}    marks panes")
        finding.next.append(f"glassplat train splat --data {shell_word(path)} --output RUN    needs none")
        return finding
    given = () if dataset.planes is None else dataset.planes.labels
    labels = name_labels((*dataset.pane_labels, *given))
    finding.facts["panes"] = f"{labels}; masks of {count_noun(annotated, 'training photograph')}" + (
        f", planes.json gives {name_labels(given)}" if given else ""
    )
    if annotated < FEW_MASKS and not given:
        finding.problems.append(
            f"{count_noun(annotated, 'mask')} only; three to ten, from positions far apart, work better"
        )
    return finding


def _planes_part(path: Path, dataset: Dataset) -> Finding:
    """Finding on the marked panes: fitted planes and the points behind them; takes seconds."""
    finding = Finding()
    if not dataset.pane_labels and dataset.planes is None:
        return finding
    try:
        planes = capture_planes(dataset, None, PlaneFit())
    except PlaneFitError as error:
        finding.problems.append(str(error))
        finding.next.append(f"glassplat annotate {shell_word(path)}    marks panes by their corners instead")
        return finding
    if dataset.measured_points:
        cameras = [view.camera for view in dataset.train]
        behind = int(virtual_points(dataset.points.positions, planes, cameras).sum())
        finding.facts["points behind panes"] = f"{behind} ({behind / max(len(dataset.points), 1):.0%})"
    finding.next.append(f"glassplat train planar --data {shell_word(path)} --output RUN")
    return finding


MEASURES = {"psnr": "PSNR", "pane_psnr": "PSNR over panes", "ssim": "SSIM", "lpips": "LPIPS"}
MANY_FAINT = 0.5
FAINT = 0.01


def splats_part(path: Path) -> Finding:
    """Finding on a file of Gaussians, with the panes next to it, as `load` reads them."""
    planes_path = path.with_name(PLANES)
    with convert_to_input_error():
        gaussians = read_splats(path)
        planes = read_planes(planes_path) if planes_path.is_file() else Planes.empty()
    finding = Finding()
    _describe_scene(Scene(gaussians, extent=1.0, planes=planes), finding)
    if len(planes) and path.stem != EXPORT_STEM:
        finding.facts["panes"] += f", of {planes_path}"
    return finding


def resume_command(directory: RunDirectory) -> str:
    """The command that continues an interrupted run."""
    settings, defaults = directory.settings(), RunSettings("", 1)
    method, recipe = directory.recipe().method, shell_word(directory.path / "recipe.json")
    words = [f"glassplat train {method} --config {recipe} --data {shell_word(settings.data)}"]
    words += [f"--output {shell_word(directory.path)} --iterations {settings.iterations}"]
    for name in ("downscale", "seed", "mask_polarity"):
        if getattr(settings, name) != getattr(defaults, name):
            words.append(f"--{name.replace('_', '-')} {getattr(settings, name)}")
    return " ".join([*words, "--resume"])


def trained_part(directory: RunDirectory) -> Finding:
    """Finding on the state of a training run."""
    finding = Finding()
    try:
        scene, step = directory.latest_scene()
    except InputError as error:
        try:
            reached = read_progress(directory.checkpoint).step
        except (FileNotFoundError, InputError):
            finding.problems.append(str(error))
            finding.next.append("the train command that began it, again")
            return finding
        if reached < directory.settings().iterations:
            finding.problems.append(f"interrupted at step {reached} of {directory.settings().iterations}")
        else:
            finding.problems.append(f"the scene is damaged, but can be written again: {error}")
        finding.next.append(resume_command(directory))
        return finding
    finding.facts["trained to"] = step
    if not (directory.path / CAMERAS).is_file():
        finding.problems.append(f"{CAMERAS} is missing, which view, video and export need")
        finding.next.append(resume_command(directory))
    _describe_scene(scene, finding)
    _describe_results(directory, finding)
    return finding


def imported_part(directory: RunDirectory) -> Finding:
    """Finding on a scene in the layout of a run, but without a capture."""
    finding = Finding()
    _describe_scene(directory.latest_scene()[0], finding)
    _suggest_viewing(directory.path, finding)
    return finding


def scene_part(path: Path) -> Finding:
    """Finding on the scene in a folder."""
    with convert_to_input_error():
        scene = read_scene(path)
    finding = Finding()
    _describe_scene(scene, finding)
    return finding


def _describe_scene(scene: Scene, finding: Finding) -> None:
    _describe_gaussians(scene.primary, finding)
    finding.facts["Gaussians"] = scene.num_gaussians
    if scene.num_gaussians > len(scene.primary):
        sets = (f"{len(part)} {name}" for name, part in scene.gaussian_sets().items() if len(part))
        finding.facts["sets of Gaussians"] = ", ".join(sets)
    planes = scene.planes
    if len(planes):
        descriptions = (
            f"{label}{' (mirror)' if label in planes.mirrors else f' (R0 {float(reflectance):.3f})'}"
            for label, reflectance in zip(planes.labels, planes.base_reflectances, strict=True)
        )
        finding.facts["panes"] = ", ".join(descriptions)
    if len(scene.photographer):
        finding.facts["photographer"] = f"{len(scene.photographer)} Gaussians, shown by panes in photographs only"
    if not scene.environment.is_empty:
        finding.facts["environment"] = f"a cube map of {scene.environment.size} texels a side"


def _describe_gaussians(gaussians: Gaussians, finding: Finding) -> None:
    """Number, colours, extent and problems of Gaussians."""
    finding.facts["Gaussians"] = len(gaussians)
    if not len(gaussians):
        finding.problems.append("it holds no Gaussian")
        return
    if gaussians.max_sh_degree >= 0:
        finding.facts["SH degree"] = gaussians.max_sh_degree
    finite = torch.isfinite(gaussians.means).all(dim=1)
    if not bool(finite.all()):
        finding.problems.append(f"{int((~finite).sum())} Gaussians have non-finite positions; they are not drawn")
    means = gaussians.means[finite]
    if not len(means):
        return
    low, high = (torch.quantile(means[:: max(1, len(means) // 100_000)], share, dim=0) for share in (0.02, 0.98))
    spans = " x ".join(f"{float(side):.3g}" for side in high - low)
    finding.facts["size of the middle 96 %"] = f"{spans} world units"
    faint = float((torch.sigmoid(gaussians.logit_opacities) < FAINT).float().mean())
    if faint > MANY_FAINT:
        finding.problems.append(f"{faint:.0%} of the Gaussians are nearly invisible")


def _describe_results(directory: RunDirectory, finding: Finding) -> None:
    path = directory.path
    if not directory.results.is_file():
        data = "" if Path(directory.settings().data).is_dir() else " --data CAPTURE"
        finding.next.append(f"glassplat eval {shell_word(path)}{data}    evaluates it on its test views")
    else:
        try:
            results = read_json(directory.results)
            measures = [f"{label} {results[name]:.3f}" for name, label in MEASURES.items() if results.get(name)]
            finding.facts["measured"] = ", ".join(measures)
        except (ValueError, TypeError, AttributeError):
            finding.problems.append(f"{directory.results} is damaged; evaluate it again")
    _suggest_viewing(path, finding)


def _suggest_viewing(path: Path, finding: Finding) -> None:
    finding.next.append(f"glassplat view {shell_word(path)}    shows it in the browser")
    finding.next.append(
        f"glassplat export {shell_word(path)} --output PAGE    exports a web page and files for other programs"
    )
