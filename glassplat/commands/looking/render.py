"""`glassplat render`: layers of a run as images."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.progress import track

from glassplat.commands.console.messages import say
from glassplat.commands.runs.output_folder import check_targets, claim_folder
from glassplat.commands.runs.scene_edits import SceneEdits
from glassplat.commands.runs.stored_run import Split, chosen_views, open_run, photographs_of, pictures_of
from glassplat.evaluate.evaluate import timed_render
from glassplat.evaluate.layer_image import layer_image
from glassplat.files.images import write_image
from glassplat.interface.layers import Layer, check_layers
from glassplat.kernels.devices import DeviceName
from glassplat.render.layers import renderer_with


@dataclass(frozen=True)
class Render:
    """Render the layers of a run from its cameras, with its panes as they are or edited.

    Attributes:
        run_directory: the run's directory.
        output: where the images go, one folder per layer; a new folder, or one that this command wrote.
        layers: which layers.
        split: which cameras.
        edits: changes to the panes.
        device: where to render; auto takes an NVIDIA GPU where one can be used.
        data: where the capture is now, if it has moved since training.
    """

    run_directory: tyro.conf.Positional[Path]
    output: Path
    layers: tuple[Layer, ...] = ("rgb",)
    split: Split = "test"
    edits: Annotated[SceneEdits, tyro.conf.arg(name="")] = field(default_factory=SceneEdits)
    device: DeviceName = "auto"
    data: Path | None = None

    def run(self, console: Console) -> None:
        """Renders."""
        stored = open_run(self.run_directory, self.device, self.data)
        check_layers(self.layers, stored.recipe)
        scene = self.edits.applied(stored.scene)
        renderer = renderer_with(stored.renderer, self.layers)
        views = chosen_views(stored.dataset, self.split)
        paths = pictures_of(stored.dataset)
        targets = [self.output / layer / paths[view.name] for layer in self.layers for view in views]
        check_targets(self.output, targets, photographs_of(stored.dataset))
        if claim_folder(self.output, "render", self.run_directory):
            say(
                console,
                f"adding to {self.output}, which `glassplat render` wrote earlier; images of one name are replaced",
            )
        for view in track(views, "rendering", console=console):
            frame, _ = timed_render(renderer, scene, view)
            for layer in self.layers:
                image = layer_image(frame, layer)
                write_image(self.output / layer / paths[view.name], image)
        say(console, f"{len(views)} views x {len(self.layers)} layers -> {self.output}")

    def left_behind(self) -> str:
        """What an interrupt leaves, and how to go on."""
        return f"images already written to {self.output} are whole: repeat the command for all of them"
