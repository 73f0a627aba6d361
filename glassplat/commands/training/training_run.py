"""The work of `glassplat train`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console

from glassplat.commands.console.messages import say, warn
from glassplat.commands.console.training_progress import TrainingProgress
from glassplat.commands.training.train import Train
from glassplat.data.dataset import Dataset, dataset_of
from glassplat.interface.training import Training
from glassplat.train.background import photo_background
from glassplat.train.messages import Message
from glassplat.train.run import Listener
from glassplat.train.run_directory import RunDirectory, check_output


def train(asked: Train[Any], console: Console) -> None:
    """Trains, with a progress bar or lines."""
    check_output(RunDirectory(asked.output), resume=asked.resume)
    dataset = dataset_of(asked.files, downscale=asked.downscale, background=photo_background(asked.recipe))
    describe(dataset, console)
    training = Training(
        dataset,
        asked.recipe,
        iterations=asked.iterations,
        output=asked.output,
        seed=asked.seed,
        device=asked.device,
        resume=asked.resume,
        checkpoint_every=asked.checkpoint_every,
    )
    with TrainingProgress(console, asked.iterations) as progress, _watched(asked, training, dataset, console) as watch:

        def listen(message: Message) -> None:
            progress.show(message)
            watch(message)

        scene = training.run(listen).scene
    say(
        console,
        f"trained {asked.recipe.method} for {training.step} iterations in {training.seconds:.0f} s: "
        f"{len(scene.primary)} Gaussians, {len(scene.planes)} panes -> {asked.output}",
    )
    say(console, f"next: glassplat eval {asked.output}")


@contextmanager
def _watched(asked: Train[Any], training: Training, dataset: Dataset, console: Console) -> Iterator[Listener]:
    """What else listens: the viewer, where it is asked for."""
    if not asked.view:
        yield lambda message: None
        return
    from glassplat.commands.looking.viewing import announce
    from glassplat.interface.watching import WatchedTraining
    from glassplat.viewer.ports import LOCAL, vacant_port

    watched = WatchedTraining(
        training, dataset, host=LOCAL, port=vacant_port(LOCAL), announce=lambda viewer: announce(viewer, console)
    )
    try:
        yield watched.hear
    finally:
        watched.stop()


def describe(dataset: Dataset, console: Console) -> None:
    """Says what was loaded, with the loader's warnings."""
    annotated = sum(view.is_annotated for view in dataset.train)
    given = f", {len(dataset.planes)} in planes.json" if dataset.planes is not None else ""
    say(
        console,
        f"{dataset.root}: {len(dataset.train)} training and {len(dataset.test)} test views, "
        f"{len(dataset.points.positions)} points, {annotated} annotated views with {len(dataset.pane_labels)} panes"
        f"{given}",
    )
    for warning in dataset.warnings:
        warn(console, warning)
