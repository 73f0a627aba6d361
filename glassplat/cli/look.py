"""`glassplat render`, `view` and `video`: layers as images, a scene in the browser, and films."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from glassplat.cli.console import import_now
from glassplat.cli.places import SceneEdits, SplatFile, Split, check_claim, check_file, check_scene, say_scene
from glassplat.errors import InputError, input_checked
from glassplat.files.writing import check_folder
from glassplat.kernels.backend.devices import DeviceName
from glassplat.model.run_directory import RunDirectory
from glassplat.options import Range
from glassplat.publish.film import check_encoder
from glassplat.viewer.render_loop import LOCAL, check_port


@dataclass(frozen=True)
class Render:
    """Render the layers of a run from its cameras, with its panes as they are or edited.

    Attributes:
        run_directory: the run's directory.
        output: where the images go, one folder per layer; a new folder, or one that this command wrote.
        layers: rgb, normal, depth, alpha and those of the method, such as transmission and reflection; a layer
            that it does not render is refused with the list of those that it does.
        split: which cameras.
        edits: changes to the panes.
        device: where to render; auto takes an NVIDIA GPU where one can be used.
        data: where the capture is now, if it has moved since training.
    """

    run_directory: tyro.conf.Positional[Path]
    output: Path
    layers: tuple[str, ...] = ("rgb",)
    split: Split = "test"
    edits: Annotated[SceneEdits, tyro.conf.arg(name="")] = field(default_factory=SceneEdits)
    device: DeviceName = "auto"
    data: Path | None = None

    def ready(self) -> None:
        """Refuses what is no run, and an output that holds something else; imports what renders."""
        RunDirectory(self.run_directory).check_begun()
        check_claim(self.output, "render")
        say_scene(self.run_directory)
        import_now("glassplat.cli.writing")

    def run(self, console: Console) -> None:
        """Renders."""
        from glassplat.cli.writing import write_layers

        write_layers(self, console)

    def left_behind(self) -> str:
        """Text after an interrupt: the state on disk, and how to go on."""
        return f"images already written to {self.output} are whole: repeat the command for all of them"


@dataclass(frozen=True)
class View:
    """Look at a scene in the browser, layer by layer, with its panes as they are or edited.

    Attributes:
        scene: a run's directory, or a splat file of any program (.ply, .spz, .glb, .splat).
        port: where the browser finds it.
        host: who may look with the link; 127.0.0.1 is this machine alone, 0.0.0.0 everybody who can reach it.
        output: folder for edited scenes and keyframes that are saved in the browser; the one that holds the scene if
            not given. Where others may look, too, nothing can be saved unless it is given.
        file: what a splat file does not say of itself.
        edits: changes to the panes.
        device: where to render; auto takes an NVIDIA GPU where one can be used.
    """

    scene: tyro.conf.Positional[Path]
    port: Annotated[int, Range(1, 65535)] = 8080
    host: str = LOCAL
    output: Path | None = None
    file: Annotated[SplatFile, tyro.conf.arg(name="")] = field(default_factory=SplatFile)
    edits: Annotated[SceneEdits, tyro.conf.arg(name="")] = field(default_factory=SceneEdits)
    device: DeviceName = "auto"

    def ready(self) -> None:
        """Refuses what is no scene, an output that cannot be written, and a port that is taken; imports the viewer."""
        check_scene(self.scene)
        self.file.check()
        if self.output is not None:
            check_folder(self.output)
        check_port(self.host, self.port)
        say_scene(self.scene)
        import_now("glassplat.cli.serving")

    def run(self, console: Console) -> None:
        """Serves until it is interrupted."""
        from glassplat.cli.serving import serve_viewer

        serve_viewer(self, console)

    def left_behind(self) -> str:
        """Text after an interrupt: the state on disk, and how to go on."""
        return "what was saved in the browser stays"


@dataclass(frozen=True)
class Video:
    """Film a scene along a path: one layer, several side by side, or one wiped over another.

    Attributes:
        scene: a run's directory, or a splat file of any program (.ply, .spz, .glb, .splat).
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
        file: what a splat file does not say of itself.
        edits: changes to the panes.
        device: where to render; auto takes an NVIDIA GPU where one can be used.
    """

    scene: tyro.conf.Positional[Path]
    output: Path
    path: Literal["orbit", "interpolate", "keyframes"] = "orbit"
    keyframes: Path | None = None
    layers: tuple[str, ...] = ("rgb",)
    layout: Literal["side-by-side", "wipe"] = "side-by-side"
    seconds: Annotated[float, Range(0.1, 3600)] = 8.0
    fps: Annotated[int, Range(1, 120)] = 30
    width: Annotated[int, Range(16, 8192)] = 960
    force: bool = False
    file: Annotated[SplatFile, tyro.conf.arg(name="")] = field(default_factory=SplatFile)
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
        self.file.check()
        if self.keyframes is not None:
            check_file(self.keyframes)
        say_scene(self.scene)
        import_now("glassplat.cli.writing")

    def run(self, console: Console) -> None:
        """Renders the pictures and encodes them."""
        from glassplat.cli.writing import film

        film(self, console)

    def left_behind(self) -> str:
        """Text after an interrupt: the state on disk, and how to go on."""
        return "nothing was written: repeat the command"
