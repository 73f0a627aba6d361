"""Details of captures and scenes for `glassplat info` that need PyTorch."""

from __future__ import annotations

from pathlib import Path

import torch

from glassplat.captures.cameras import LEAST_SIDE
from glassplat.captures.dataset import Dataset, load_dataset, make_dataset
from glassplat.captures.files import CaptureFiles
from glassplat.captures.view import sample_evenly
from glassplat.cli.console import shell_word
from glassplat.cli.info import FEW_VIEWS, Report, describe_broken
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


def describe_capture(files: CaptureFiles, report: Report) -> None:
    """Photographs, panes and planes of a capture."""
    dataset = make_dataset(files)
    views = (*dataset.train, *dataset.test)
    sizes = sorted({f"{v.camera.width}x{v.camera.height}" for v in views})
    report.add(
        "photographs",
        f"{len(dataset.train)} to train, {len(dataset.test)} to test ({dataset.split}), {', '.join(sizes[:3])}",
    )
    report.problems += dataset.warnings
    if len(views) < FEW_VIEWS:
        report.problems.append(f"only {count_noun(len(views), 'photograph')}; 30 or more work better")
    if dataset.measured_points and len(dataset.points) < FEW_POINTS:
        report.problems.append(
            f"{count_noun(len(dataset.points), 'point')} only; more photographs with more overlap give more"
        )
    _describe_panes(files.root, dataset, report)
    if dataset.pane_labels or dataset.planes is not None:
        _describe_planes(files.root, dataset, report)
    describe_broken([view.image_path for view in views], report, LEAST_SIDE)


def write_capture_page(path: Path, target: Path) -> None:
    """Writes the report of a prepared capture, with its marked panes."""
    dataset = load_dataset(path)
    marked = bool(dataset.pane_labels) or dataset.planes is not None
    write_page(path, target, capture_planes(dataset, None, PlaneFit()) if marked else None)


def _describe_panes(path: Path, dataset: Dataset, report: Report) -> None:
    """Marked panes, and the quality of the marks."""
    if masked := [view for view in (*dataset.train, *dataset.test) if view.read_ignored is not None]:
        sampled = [view.ignored for view in sample_evenly(masked, MASKS_SAMPLED)]
        shares = [float(ignored.double().mean()) for ignored in sampled if ignored is not None]
        report.add(
            "ignored",
            f"about {sum(shares) / len(shares):.0%} of {count_noun(len(masked), 'photograph')}, by masks, "
            "transparency, or the lens",
        )
    if estimated := sum(view.read_normals is not None for view in dataset.train):
        report.add(
            "normals", f"estimated for {count_noun(estimated, 'training photograph')}; deferred and traced use them"
        )
    annotated = sum(view.is_annotated for view in dataset.train)
    if not dataset.pane_labels and dataset.planes is None:
        report.add("panes", "none marked")
        report.next.append(f"glassplat annotate {shell_word(path)}    marks panes")
        report.next.append(f"glassplat train splat --data {shell_word(path)} --output RUN    needs none")
        return
    given = () if dataset.planes is None else dataset.planes.labels
    labels = name_labels((*dataset.pane_labels, *given))
    also = f", planes.json gives {name_labels(given)}" if given else ""
    report.add("panes", f"{labels}; masks of {count_noun(annotated, 'training photograph')}{also}")
    if annotated < FEW_MASKS and not given:
        report.problems.append(
            f"{count_noun(annotated, 'mask')} only; three to ten, from positions far apart, work better"
        )


def _describe_planes(path: Path, dataset: Dataset, report: Report) -> None:
    """Planes fitted to the marked panes, and the points behind them; takes seconds."""
    try:
        planes = capture_planes(dataset, None, PlaneFit())
    except PlaneFitError as error:
        report.problems.append(str(error))
        report.next.append(f"glassplat annotate {shell_word(path)}    marks panes by their corners instead")
        return
    if dataset.measured_points:
        cameras = [view.camera for view in dataset.train]
        behind = int(virtual_points(dataset.points.positions, planes, cameras).sum())
        report.add("points behind panes", f"{behind} ({behind / max(len(dataset.points), 1):.0%})")
    report.next.append(f"glassplat train planar --data {shell_word(path)} --output RUN")


MEASURES = {"psnr": "PSNR", "pane_psnr": "PSNR over panes", "ssim": "SSIM", "lpips": "LPIPS"}
MANY_FAINT = 0.5
FAINT = 0.01


def describe_splats(path: Path, report: Report) -> None:
    """A file of Gaussians, with the panes next to it, as `load` reads them."""
    planes_path = path.with_name(PLANES)
    with convert_to_input_error():
        gaussians = read_splats(path)
        planes = read_planes(planes_path) if planes_path.is_file() else Planes.empty()
    origin = "" if path.stem == EXPORT_STEM else f", of {planes_path}"
    _describe_scene(Scene(gaussians, extent=1.0, planes=planes), report, origin)


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


def describe_trained(directory: RunDirectory, report: Report) -> None:
    """State of a training run."""
    try:
        scene, step = directory.latest_scene()
    except InputError as error:
        _describe_interrupted(directory, str(error), report)
        return
    report.add("trained to", step)
    if not (directory.path / CAMERAS).is_file():
        report.problems.append(f"{CAMERAS} is missing, which view, video and export need")
        report.next.append(resume_command(directory))
    _describe_scene(scene, report)
    _describe_results(directory, report)


def _describe_interrupted(directory: RunDirectory, problem: str, report: Report) -> None:
    """A run without a readable scene, and how to continue it."""
    try:
        reached = read_progress(directory.checkpoint).step
    except (FileNotFoundError, InputError):
        report.problems.append(problem)
        report.next.append("the train command that began it, again")
        return
    iterations = directory.settings().iterations
    is_finished = reached >= iterations
    report.problems.append(
        f"the scene is damaged, but can be written again: {problem}"
        if is_finished
        else f"interrupted at step {reached} of {iterations}"
    )
    report.next.append(resume_command(directory))


def describe_imported(directory: RunDirectory, report: Report) -> None:
    """A scene in the layout of a run, but without a capture."""
    _describe_scene(directory.latest_scene()[0], report)
    _suggest_viewing(directory.path, report)


def describe_folder(path: Path, report: Report) -> None:
    """The scene in a folder."""
    with convert_to_input_error():
        scene = read_scene(path)
    _describe_scene(scene, report)


def _describe_scene(scene: Scene, report: Report, panes_origin: str = "") -> None:
    """Gaussians, panes and surroundings; `panes_origin` is appended to the panes."""
    report.add("Gaussians", scene.num_gaussians)
    _describe_gaussians(scene.primary, report)
    if scene.num_gaussians > len(scene.primary):
        sets = (f"{len(part)} {name}" for name, part in scene.gaussian_sets().items() if len(part))
        report.add("sets of Gaussians", ", ".join(sets))
    planes = scene.planes
    if len(planes):
        descriptions = (
            f"{label}{' (mirror)' if label in planes.mirrors else f' (R0 {float(reflectance):.3f})'}"
            for label, reflectance in zip(planes.labels, planes.base_reflectances, strict=True)
        )
        report.add("panes", ", ".join(descriptions) + panes_origin)
    if len(scene.photographer):
        report.add("photographer", f"{len(scene.photographer)} Gaussians, shown by panes in photographs only")
    if not scene.environment.is_empty:
        report.add("environment", f"a cube map of {scene.environment.size} texels a side")


def _describe_gaussians(gaussians: Gaussians, report: Report) -> None:
    """Colours, extent and problems of Gaussians."""
    if not len(gaussians):
        report.problems.append("it holds no Gaussian")
        return
    if gaussians.max_sh_degree >= 0:
        report.add("SH degree", gaussians.max_sh_degree)
    finite = torch.isfinite(gaussians.means).all(dim=1)
    if not bool(finite.all()):
        report.problems.append(f"{int((~finite).sum())} Gaussians have non-finite positions; they are not drawn")
    means = gaussians.means[finite]
    if not len(means):
        return
    low, high = (torch.quantile(means[:: max(1, len(means) // 100_000)], share, dim=0) for share in (0.02, 0.98))
    spans = " x ".join(f"{float(side):.3g}" for side in high - low)
    report.add("size of the middle 96 %", f"{spans} world units")
    faint = float((torch.sigmoid(gaussians.logit_opacities) < FAINT).float().mean())
    if faint > MANY_FAINT:
        report.problems.append(f"{faint:.0%} of the Gaussians are nearly invisible")


def _describe_results(directory: RunDirectory, report: Report) -> None:
    path = directory.path
    if not directory.results.is_file():
        data = "" if Path(directory.settings().data).is_dir() else " --data CAPTURE"
        report.next.append(f"glassplat eval {shell_word(path)}{data}    evaluates it on its test views")
    else:
        try:
            results = read_json(directory.results)
            measures = [f"{label} {results[name]:.3f}" for name, label in MEASURES.items() if results.get(name)]
            report.add("measured", ", ".join(measures))
        except (ValueError, TypeError, AttributeError):
            report.problems.append(f"{directory.results} is damaged; evaluate it again")
    _suggest_viewing(path, report)


def _suggest_viewing(path: Path, report: Report) -> None:
    report.next.append(f"glassplat view {shell_word(path)}    shows it in the browser")
    report.next.append(
        f"glassplat export {shell_word(path)} --output PAGE    exports a web page and files for other programs"
    )
