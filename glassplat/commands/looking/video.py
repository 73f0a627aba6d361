"""`glassplat video`: a film of a scene, without a screen."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from glassplat.commands.console.importing import import_now
from glassplat.commands.runs.scene_edits import SceneEdits
from glassplat.commands.runs.scene_place import check_file, check_scene, say_scene
from glassplat.data.errors import InputError, input_checked
from glassplat.data.ranges import Range
from glassplat.interface.layers import Layer
from glassplat.kernels.backend.devices import DeviceName
from glassplat.publish.film import check_encoder


@dataclass(frozen=True)
class Video:
    """Film a scene along a path: one layer, several side by side, or one wiped over another.

    Attributes:
        scene: a run's directory, an imported scene, or a splat file.
        output: the film: .mp4 (VP9, plays in browsers; needs glassplat[video]), .webp or .gif.
        path: once around, or in a loop before what was photographed from one side; through the photographs' cameras;
            or through those of --keyframes.
        keyframes: cameras to go through, as `export` writes cameras.json, for --path keyframes.
        layers: which layers.
        layout: side by side, or the second layer wiped over the first.
        seconds: length.
        fps: pictures per second.
        width: of one layer's picture, pixels.
        force: replace a film of that name.
        edits: changes to the panes.
        device: where to render; auto takes an NVIDIA GPU where one can be used.
    """

    scene: tyro.conf.Positional[Path]
    output: Path
    path: Literal["orbit", "interpolate", "keyframes"] = "orbit"
    keyframes: Path | None = None
    layers: tuple[Layer, ...] = ("rgb",)
    layout: Literal["side-by-side", "wipe"] = "side-by-side"
    seconds: Annotated[float, Range(0.1, 3600)] = 8.0
    fps: Annotated[int, Range(1, 120)] = 30
    width: Annotated[int, Range(16, 8192)] = 960
    force: bool = False
    edits: Annotated[SceneEdits, tyro.conf.arg(name="")] = field(default_factory=SceneEdits)
    device: DeviceName = "auto"

    def ready(self) -> None:
        """Refuses everything that can be known to be wrong before it takes long, and imports what renders."""
        try:
            with input_checked():
                check_encoder(self.output)
        except ImportError as error:
            raise InputError(
                f"{self.output.suffix} needs OpenCV ({error}); pip install 'glassplat[video]', or end --output in .webp"
            ) from error
        if os.path.lexists(self.output) and not self.force:
            raise InputError(f"{self.output} is already there; pass --force to replace it, or choose another --output")
        if self.layout == "wipe" and len(self.layers) != 2:
            raise InputError(f"a wipe takes two --layers, not {len(self.layers)}, such as rgb transmission")
        if (self.path == "keyframes") != (self.keyframes is not None):
            raise InputError("--path keyframes and --keyframes FILE belong together; give both or neither")
        check_scene(self.scene)
        if self.keyframes is not None:
            check_file(self.keyframes)
        say_scene(self.scene)
        import_now("glassplat.commands.looking.filming")

    def run(self, console: Console) -> None:
        """Renders the pictures and encodes them."""
        from glassplat.commands.looking.filming import film

        film(self, console)

    def left_behind(self) -> str:
        """What an interrupt leaves, and how to go on."""
        return "nothing was written: repeat the command"
