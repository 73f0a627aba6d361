"""Runs, trained by `glassplat train` and opened by other commands: scene, renderer and data."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from rich.console import Console
from torch import Tensor

from glassplat.access import LOCALHOST, is_local
from glassplat.captures.dataset import TEST_EVERY, Dataset, load_dataset, make_dataset, with_corrected_cameras
from glassplat.captures.view import GIGABYTE, PointCloud, View
from glassplat.cli.console import print_line, print_warning, shell_word
from glassplat.cli.places import chosen_views
from glassplat.cli.progress import Plan, TrainingProgress
from glassplat.errors import InputError, convert_to_input_error, count_noun
from glassplat.files.images import image_paths
from glassplat.files.sidecars import read_cameras
from glassplat.kernels.backend.devices import DeviceName, chosen_device
from glassplat.methods.recipe import photo_background, resolve_background
from glassplat.model.run_directory import RunDirectory
from glassplat.model.training import Listener, Training
from glassplat.render.frame import Renderer
from glassplat.scene.scene import Scene
from glassplat.training.messages import Message
from glassplat.training.ranks import is_leader
from glassplat.training.stage import stage_starts
from glassplat.viewer.server import Viewer

if TYPE_CHECKING:
    from glassplat.cli.train import Train


def print_address(viewer: Viewer, console: Console) -> None:
    """Prints the address of the viewer."""
    print_line(console, viewer)
    if is_local(viewer.host):
        print_line(
            console,
            f"from another machine: ssh -L {viewer.port}:localhost:{viewer.port} <this machine>, then the same address",
        )


class StoredRun(NamedTuple):
    """A finished run, ready to render."""

    directory: RunDirectory
    recipe: Any
    scene: Scene
    renderer: Renderer
    dataset: Dataset
    iterations: int


def open_run(
    path: Path, device: DeviceName = "auto", data: Path | None = None, downscale: float | None = None
) -> StoredRun:
    """Opens the run in a directory, with the capture it was trained on, over the same background.

    Args:
        path: the run's directory.
        device: rendering device.
        data: location of the capture; that of the training if None.
        downscale: factor by which photographs are reduced; that of the training if None.

    Raises:
        CudaUnavailableError: a GPU was requested, but cannot be used.
        InputError: the directory has no finished run, or the capture is a different one.
        FileNotFoundError: the capture has moved.
    """
    directory = RunDirectory(path)
    recorded_recipe = directory.recipe()
    scene, iterations = directory.latest_scene()
    with convert_to_input_error():
        recorded_recipe.renderer().check(scene)
    scene = scene.to(chosen_device(device))
    dataset = load_run_dataset(directory, recorded_recipe, data, downscale)
    directory.check_photographs(dataset)
    if data is not None or not directory.import_record.is_file():  # Without a capture, cameras are written corrected.
        dataset = with_corrected_cameras(dataset, scene)
    recipe = resolve_background(recorded_recipe, dataset)
    return StoredRun(directory, recipe, scene, recipe.renderer(), dataset, iterations)


def load_run_dataset(
    directory: RunDirectory, recipe: Any, moved: Path | None = None, downscale: float | None = None
) -> Dataset:
    """The capture of a run, at its recorded or given location; only the cameras for a scene without a capture."""
    if directory.import_record.is_file() and moved is None:
        return _dataset_without_photographs(directory)
    settings = directory.settings()
    data = Path(settings.data) if moved is None else moved
    if moved is None and not data.is_dir():
        raise FileNotFoundError(
            f"the capture of {directory.path} is no longer at {data}; give its new location with --data"
        )
    return load_dataset(
        data,
        downscale=settings.downscale if downscale is None else downscale,
        background=photo_background(recipe),
        mask_polarity=settings.mask_polarity,
    )


def _dataset_without_photographs(directory: RunDirectory) -> Dataset:
    """The cameras of a scene without a capture, as views without photographs."""
    with convert_to_input_error():
        cameras = sorted(read_cameras(directory.path / "cameras.json"), key=lambda named: named[0])

    def no_photograph() -> Tensor:
        raise InputError(f"{directory.path} has no photographs, which this command needs")

    views = tuple(View(name, camera, directory.path / name, no_photograph) for name, camera in cameras)
    points = PointCloud(torch.zeros(0, 3, dtype=torch.float32), torch.zeros(0, 3, dtype=torch.uint8))
    test = views[::TEST_EVERY]
    train = tuple(view for view in views if view not in test)
    return Dataset(directory.path, train, test, points, extent=1.0)


def image_names(dataset: Dataset) -> dict[str, Path]:
    """File name of each view's image; independent of the chosen views."""
    return image_paths([view.name for view in chosen_views(dataset, "all")])


def photograph_paths(dataset: Dataset) -> list[Path]:
    """The files of all photographs."""
    return [view.image_path for view in (*dataset.train, *dataset.test)]


def train(command: Train[Any], console: Console) -> None:
    """Trains, with a progress bar or lines."""
    dataset = make_dataset(
        command.files, downscale=command.downscale, background=photo_background(command.recipe), memory=command.memory
    )
    print_summary(dataset, console)
    training = Training(
        dataset,
        command.recipe,
        iterations=command.iterations,
        output=command.output,
        seed=command.seed,
        device=command.device,
        resume=command.resume,
        checkpoint_every=command.checkpoint_every,
    )
    plan = training_plan(command)
    with TrainingProgress(console, plan) as progress, _viewer_listener(command, training, dataset, console) as watch:

        def listen(message: Message) -> None:
            progress.show(message)
            watch(message)

        scene = training.run(listen).scene
    print_line(
        console,
        f"trained {command.recipe.method} for {count_noun(training.step, 'iteration')} in {training.seconds:.0f} s: "
        f"{scene.num_gaussians} Gaussians, {count_noun(len(scene.planes), 'pane')} -> {command.output}",
    )
    print_line(console, f"next: glassplat eval {shell_word(command.output)}")


STEP_COSTS = {"Planar": 2.6, "Deferred": 1.2, "Traced": 4.5}
"""Seconds of a step with a renderer, in those of a step of `splat`; measured on two cores (docs/performance.md)."""
USUAL_ITERATIONS = 7000
"""The recommended length of a run."""


def training_plan(command: Train[Any]) -> Plan:
    """Lengths and typical costs of a run's stages, and ways to shorten it."""
    stages = command.recipe.stages(command.seed, command.iterations)
    costs = tuple(STEP_COSTS.get(type(stage.renderer).__name__, 1.0) for stage in stages)
    return Plan(tuple(stage_starts(stages, command.iterations)[1:]), costs, shortcuts(command))


def shortcuts(command: Train[Any]) -> str:
    """Ways to make a run shorter, as the end of a sentence."""
    ways = [f"--downscale {2 * command.downscale:g}, a quarter of the pixels"]
    if command.iterations > USUAL_ITERATIONS:
        ways.append(f"--iterations {USUAL_ITERATIONS}")
    if command.recipe.method == "traced":
        ways.append("--least-strength 0.1")
    if command.settings().device == "cpu":
        ways.append("an NVIDIA GPU")
    return f"shorter with {', or '.join(ways)}"


@contextmanager
def _viewer_listener(command: Train[Any], training: Training, dataset: Dataset, console: Console) -> Iterator[Listener]:
    """The viewer as a further listener, if requested; only on rank 0."""
    if not command.view or not is_leader():
        yield lambda message: None
        return
    from glassplat.model.watching import WatchedTraining
    from glassplat.viewer.render_loop import vacant_port

    port = vacant_port(LOCALHOST)
    watched = WatchedTraining(
        training, dataset, host=LOCALHOST, port=port, announce=lambda viewer: print_address(viewer, console)
    )
    try:
        yield watched.handle_message
    finally:
        watched.stop()


def print_summary(dataset: Dataset, console: Console) -> None:
    """Prints a summary of the capture, with the loader's warnings."""
    annotated = sum(view.is_annotated for view in dataset.train)
    given = f", {len(dataset.planes)} in planes.json" if dataset.planes is not None else ""
    print_line(
        console,
        f"{dataset.root}: {len(dataset.train)} training and {count_noun(len(dataset.test), 'test view')}, "
        f"{len(dataset.points.positions)} points, {count_noun(annotated, 'annotated view')} with "
        f"{count_noun(len(dataset.pane_labels), 'pane')}{given}",
    )
    needed, room = dataset.photograph_bytes, dataset.memory.budget
    if needed > room:
        print_line(
            console,
            f"the training photographs take {needed / GIGABYTE:.1f} GB: {room / GIGABYTE:.1f} GB stay in memory "
            "(--memory), the others are read in the background",
        )
    for warning in dataset.warnings:
        print_warning(console, warning)
