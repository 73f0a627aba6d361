"""`glassplat render`: layers of a run as images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
import tyro
from rich.console import Console
from rich.progress import track
from torch import Tensor

from glassplat.commands.stored_run import open_run
from glassplat.data.errors import InputError
from glassplat.evaluate.colormap import depth_colors
from glassplat.files.images import write_image
from glassplat.kernels.devices import DeviceName
from glassplat.render.frame import Frame

Layer = Literal["rgb", "transmission", "reflection", "strength", "mask", "depth", "alpha"]


@dataclass(frozen=True)
class Render:
    """Render the layers of a run from its cameras.

    Attributes:
        run_directory: the run's directory.
        output: where the images go, one folder per layer.
        layers: which layers.
        split: which cameras.
        device: where to render; auto takes an NVIDIA GPU where one can be used.
    """

    run_directory: tyro.conf.Positional[Path]
    output: Path
    layers: tuple[Layer, ...] = ("rgb",)
    split: Literal["train", "test"] = "test"
    device: DeviceName = "auto"

    def run(self, console: Console) -> None:
        """Renders."""
        stored = open_run(self.run_directory, self.device)
        views = stored.dataset.train if self.split == "train" else stored.dataset.test
        for view in track(views, "rendering", console=console):
            with torch.no_grad():
                frame = stored.renderer(stored.scene, view.camera)
            for layer in self.layers:
                file = self.output / layer / Path(view.name).with_suffix(".png")
                file.parent.mkdir(parents=True, exist_ok=True)
                write_image(file, layer_image(frame, layer, stored.recipe.method))
        console.print(f"{len(views)} views x {len(self.layers)} layers -> {self.output}")


def layer_image(frame: Frame, layer: str, method: str) -> Tensor:
    """A layer of a frame as an image in [0, 1]; depth is colour-mapped, near bright.

    Raises:
        InputError: the method has no such layer.
    """
    if layer == "rgb":
        return frame.rgb.clamp(0, 1)
    if layer not in frame.layers:
        raise InputError(f"{method} renders no layer {layer!r}; it has {['rgb', *sorted(frame.layers)]}")
    image = frame.layers[layer]
    return depth_colors(image, frame.layers["alpha"]) if layer == "depth" else image.clamp(0, 1)
