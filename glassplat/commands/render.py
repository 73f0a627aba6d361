"""`glassplat render`: layers of a run as images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.progress import track
from torch import Tensor

from glassplat.commands.messages import say
from glassplat.commands.output_folder import check_targets, claim_folder
from glassplat.commands.scene_edits import SceneEdits
from glassplat.commands.stored_run import Split, chosen_views, open_run, photographs_of, pictures_of
from glassplat.data.errors import InputError
from glassplat.evaluate.colormap import depth_colors, normal_colors
from glassplat.evaluate.evaluate import timed_render
from glassplat.files.images import write_image
from glassplat.kernels.devices import DeviceName
from glassplat.render.deferred import Deferred
from glassplat.render.frame import Frame, Renderer
from glassplat.render.planar import with_photographer
from glassplat.render.traced import Traced

Layer = Literal[
    "rgb",
    "transmission",
    "without_panes",
    "reflection",
    "strength",
    "mask",
    "depth",
    "alpha",
    "base",
    "normal",
    "environment",
    "surroundings",
    "median_depth",
    "photographed",
]

LAYERS: dict[str, tuple[Layer, ...]] = {
    "splat": ("rgb", "depth", "alpha"),
    "planar": (
        "rgb",
        "transmission",
        "without_panes",
        "reflection",
        "strength",
        "mask",
        "depth",
        "alpha",
        "photographed",
    ),
    "deferred": ("rgb", "base", "reflection", "strength", "normal", "environment", "depth", "alpha"),
    "traced": ("rgb", "base", "reflection", "strength", "normal", "surroundings", "depth", "alpha"),
}
"""What each method renders that is worth looking at; its frames hold more for the losses."""

DISC_LAYERS: tuple[Layer, ...] = ("rgb", "normal", "depth", "median_depth", "alpha")
"""What `splat` renders of discs."""

PHOTOGRAPHED: Layer = "photographed"
"""The image with whom the panes of a photograph show, of runs that looked for somebody."""


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
        renderer = with_layers(stored.renderer, self.layers)
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


def with_layers(renderer: Renderer, layers: Sequence[str]) -> Renderer:
    """The renderer, which also renders those layers that cost more than an image."""
    if "environment" in layers and isinstance(renderer, Deferred):
        return replace(renderer, environment=True)
    if "surroundings" in layers and isinstance(renderer, Traced):
        return replace(renderer, surroundings=True)
    return with_photographer(renderer, "beside") if PHOTOGRAPHED in layers else renderer


def layers_of(recipe: Any) -> tuple[Layer, ...]:
    """What a run renders that is worth looking at."""
    return DISC_LAYERS if getattr(recipe, "primitive", None) == "disc" else LAYERS[recipe.method]


def check_layers(layers: Sequence[str], recipe: Any) -> None:
    """Refuses layers that a method does not render, before anything is rendered.

    Raises:
        InputError: there are such, or none is asked for.
    """
    known, method = layers_of(recipe), recipe.method
    if method == "planar" and recipe.photographer.learn:
        known = (*known, PHOTOGRAPHED)
    foreign = [layer for layer in layers if layer not in known]
    if foreign or not layers:
        asked = f"renders no layer {', '.join(foreign)}" if foreign else "renders nothing without --layers"
        raise InputError(f"{method} {asked}; expected --layers out of {', '.join(known)}")


def layer_image(frame: Frame, layer: str) -> Tensor:
    """A layer of a frame as an image in [0, 1]; depth is colour-mapped, near bright, normals are (n + 1) / 2."""
    if layer in ("rgb", PHOTOGRAPHED):
        return getattr(frame, layer).clamp(0, 1)
    image = frame.layers[layer]
    if layer == "normal":
        return normal_colors(image)
    if layer in ("depth", "median_depth"):
        return depth_colors(image, frame.layers["alpha"])
    return image.clamp(0, 1)
