"""Opening a finished run: its scene, renderer and data."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, NamedTuple

from glassplat.data.dataset import Dataset, View, load_dataset
from glassplat.data.errors import InputError, input_checked
from glassplat.kernels.devices import DeviceName, chosen_device
from glassplat.render.frame import Renderer
from glassplat.scene.scene import Scene
from glassplat.train.background import photo_background, settled
from glassplat.train.run_directory import RunDirectory

Split = Literal["train", "test", "all"]


class StoredRun(NamedTuple):
    """A finished run, ready to render."""

    directory: RunDirectory
    recipe: Any
    scene: Scene
    renderer: Renderer
    dataset: Dataset
    iterations: int


def open_run(path: Path, device: DeviceName = "auto") -> StoredRun:
    """Opens the run in a directory, with the capture it was trained on, over the same background.

    Args:
        path: the run's directory.
        device: where to render.

    Raises:
        CudaUnavailableError: the GPU was asked for and cannot be used.
        InputError: the directory holds no finished run.
        FileNotFoundError: the capture is no longer where it was.
    """
    directory = RunDirectory(path)
    recorded, settings = directory.recipe(), directory.settings()
    scene, iterations = directory.latest_scene()
    with input_checked():
        recorded.renderer().check(scene)
    scene = scene.to(chosen_device(device))
    dataset = load_dataset(
        Path(settings.data),
        downscale=settings.downscale,
        background=photo_background(recorded),
        mask_polarity=settings.mask_polarity,
    )
    recipe = settled(recorded, dataset)
    return StoredRun(directory, recipe, scene, recipe.renderer(), dataset, iterations)


def chosen_views(dataset: Dataset, split: Split) -> tuple[View, ...]:
    """The views of a split, by name.

    Raises:
        InputError: there are none.
    """
    parts = {"train": dataset.train, "test": dataset.test, "all": (*dataset.train, *dataset.test)}
    if not parts[split]:
        raise InputError(f"{dataset.root} has no {split} views; choose another --split")
    return tuple(sorted(parts[split], key=lambda view: view.name))
