"""Commands that take a scene: `glassplat eval`, `render`, `dereflect`, `clean`, `view`, `video` and `export`."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from glassplat.cli.console import Command
from glassplat.cli.places import SceneEdits, SplatFile, Split, check_claim, check_file, check_scene, say_scene
from glassplat.errors import InputError, input_checked
from glassplat.files.writing import FORGED_SUFFIXES, WRITTEN, check_folder
from glassplat.kernels.backend.devices import DeviceName
from glassplat.model.run_directory import RunDirectory
from glassplat.options import Cleaning, Downscale, Finite, Positive, Range
from glassplat.publish.film import check_encoder
from glassplat.viewer.render_loop import LOCAL, check_port

PaneSource = Literal["auto", "truth", "masks", "rendered"]
Align = Literal["auto", "always", "never"]
"""Whether test cameras are moved before they are scored."""


@dataclass(frozen=True)
class Evaluate(Command):
    """Measure a run on its test views and write comparison sheets.

    Attributes:
        run_directory: the run's directory.
        device: where to render; auto takes an NVIDIA GPU where one can be used.
        data: where the capture is now, if it has moved since training.
        panes: where views show panes, for the metric over them: what the ground truth says, the masks and the planes
            that are fitted to them, or the mask that the run renders; auto takes the first of these that there is.
            Runs of different methods compare over the same pixels with the first two.
        align: move the camera of each test view to where its photograph agrees best with the scene, before it is
            scored; auto does so for runs that refined the cameras of training views.
    """

    work = "evaluation:evaluate_and_report"
    left = "{run_directory} itself is as it was: repeat the command to evaluate it"

    run_directory: tyro.conf.Positional[Path]
    device: DeviceName = "auto"
    data: Path | None = None
    panes: PaneSource = "auto"
    align: Align = "auto"

    def check(self) -> None:
        """Refuses what is no run."""
        RunDirectory(self.run_directory).check_begun()
        check_folder(self.run_directory)
        say_scene(self.run_directory)


@dataclass(frozen=True)
class Render(Command):
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

    work = "writing:write_layers"
    left = "images already written to {output} are whole: repeat the command for all of them"

    run_directory: tyro.conf.Positional[Path]
    output: Path
    layers: tuple[str, ...] = ("rgb",)
    split: Split = "test"
    edits: Annotated[SceneEdits, tyro.conf.arg(name="")] = field(default_factory=SceneEdits)
    device: DeviceName = "auto"
    data: Path | None = None

    def check(self) -> None:
        """Refuses what is no run, and an output that holds something else."""
        RunDirectory(self.run_directory).check_begun()
        check_claim(self.output, "render")
        say_scene(self.run_directory)


@dataclass(frozen=True)
class View(Command):
    """Look at a scene in the browser, layer by layer, with its panes as they are or edited.

    Attributes:
        scene: a run's directory, an exported folder, or a splat file (.ply, .spz, .glb, .splat, .sog, .ksplat).
        port: where the browser finds it; 0 takes any that is free.
        host: who may look with the link; 127.0.0.1 is this machine alone, 0.0.0.0 everybody who can reach it.
        output: folder for edited scenes and keyframes that are saved in the browser; the one that holds the scene if
            not given. Where others may look, too, nothing can be saved unless it is given.
        file: what a splat file does not say of itself.
        edits: changes to the panes.
        device: where to render; auto takes an NVIDIA GPU where one can be used.
    """

    work = "serving:serve_viewer"
    left = "what was saved in the browser stays"

    scene: tyro.conf.Positional[Path]
    port: Annotated[int, Range(0, 65535)] = 8080
    host: str = LOCAL
    output: Path | None = None
    file: Annotated[SplatFile, tyro.conf.arg(name="")] = field(default_factory=SplatFile)
    edits: Annotated[SceneEdits, tyro.conf.arg(name="")] = field(default_factory=SceneEdits)
    device: DeviceName = "auto"

    def check(self) -> None:
        """Refuses what is no scene, an output that cannot be written, and a port that is taken."""
        check_scene(self.scene)
        self.file.check()
        if self.output is not None:
            check_folder(self.output)
        check_port(self.host, self.port)
        say_scene(self.scene)


@dataclass(frozen=True)
class Video(Command):
    """Film a scene along a path: one layer, several side by side, or one wiped over another.

    Attributes:
        scene: a run's directory, an exported folder, or a splat file (.ply, .spz, .glb, .splat, .sog, .ksplat).
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

    work = "writing:film"
    left = "nothing was written: repeat the command"

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

    def check(self) -> None:
        """Refuses everything that can be known to be wrong before it takes long."""
        try:
            with input_checked():
                check_encoder(self.output, self.fps)
        except ImportError as error:
            raise InputError(
                f"{self.output.suffix} needs OpenCV ({error}); pip install 'glassplat[video]', or end --output in .webp"
            ) from error
        if self.output.is_dir():
            raise InputError(f"{self.output} is a folder; expected a name for a film as --output")
        if os.path.lexists(self.output) and not self.force:
            raise InputError(f"{self.output} is already there; pass --force to replace it, or choose another --output")
        check_folder(self.output.parent)
        if self.layout == "wipe" and len(self.layers) != 2:
            raise InputError(f"a wipe takes two --layers, not {len(self.layers)}, such as rgb transmission")
        if (self.path == "keyframes") != (self.keyframes is not None):
            raise InputError("--path keyframes and --keyframes FILE belong together; give both or neither")
        check_scene(self.scene)
        self.file.check()
        if self.keyframes is not None:
            check_file(self.keyframes)
        say_scene(self.scene)


if TYPE_CHECKING:
    Format = str
else:
    Format = Literal[WRITTEN]


@dataclass(frozen=True)
class Clean(Command):
    """Take floaters out of a scene, and give it metres; writes another scene.

    Attributes:
        scene: a run's directory, an exported folder, or a splat file (.ply, .spz, .glb, .splat, .sog, .ksplat).
        output: where the clean scene goes, a new folder; `glassplat view` and `export` read it like a run.
        rules: what goes.
        scale: two points, x y z each in world units, and how many metres apart they are; `view` measures points.
        file: what a splat file does not say of itself.
        device: where to work; auto takes an NVIDIA GPU where one can be used.
    """

    work = "writing:write_clean"
    left = "{scene} is as it was; remove {output} and repeat the command"

    scene: tyro.conf.Positional[Path]
    output: Path
    rules: Annotated[Cleaning, tyro.conf.arg(name="")] = field(default_factory=Cleaning)
    scale: tuple[Finite, Finite, Finite, Finite, Finite, Finite, Positive] | None = None
    file: Annotated[SplatFile, tyro.conf.arg(name="")] = field(default_factory=SplatFile)
    device: DeviceName = "auto"

    def check(self) -> None:
        """Refuses what is no scene, points that do not differ, and an output that is there."""
        check_scene(self.scene)
        self.file.check()
        if self.scale is not None and self.scale[:3] == self.scale[3:6]:
            raise InputError(f"--scale got the point {self.scale[:3]} twice; expected two points that are apart")
        check_folder(self.output)
        if os.path.lexists(self.output) and any(self.output.iterdir()):
            raise InputError(f"{self.output} is not empty; nothing was written. Choose a new folder for --output")
        say_scene(self.scene)


@dataclass(frozen=True)
class Export(Command):
    """Write a scene as others read it: PLY, SPZ, GLB, a web page with live panes, and the panes next to them.

    Attributes:
        scene: a run's directory, an exported folder, or a splat file (.ply, .spz, .glb, .splat, .sog, .ksplat).
        output: where the files go; a new folder, or one that this command wrote: what it does not write again there
            is removed.
        formats: which files; glb is glTF with KHR_gaussian_splatting, html a page that shows the scene in any browser,
            by itself and without a server.
        layer: all is the scene with its panes next to it, as planes.json and glass.ply; transmission is the place
            without its panes and what they and glossy things reflect.
        title: of the page; the run's name if not given.
        credit: shown on the page: who made the scene, and its licence.
        url: where the page will lie on the web. Previews of links to it show preview.jpg, which then lies next to it.
        spz_version: 3, which every reader knows, or 4.
        file: what a splat file does not say of itself.
        edits: changes to the panes.
        device: where to render what has to be rendered; auto takes an NVIDIA GPU where one can be used.
    """

    work = "writing:write_files"
    left = "files already written to {output} are whole: repeat the command for all of them"

    scene: tyro.conf.Positional[Path]
    output: Path
    formats: tuple[Format, ...] = ("ply", "spz", "html")
    layer: Literal["all", "transmission"] = "all"
    title: str | None = None
    credit: str = ""
    url: str | None = None
    spz_version: Literal[3, 4] = 3
    file: Annotated[SplatFile, tyro.conf.arg(name="")] = field(default_factory=SplatFile)
    edits: Annotated[SceneEdits, tyro.conf.arg(name="")] = field(default_factory=SceneEdits)
    device: DeviceName = "auto"

    def check(self) -> None:
        """Refuses what contradicts itself, what is no scene, and an output that holds something else."""
        if not self.formats:
            raise InputError(f"nothing to write without --formats; expected some of {', '.join(WRITTEN)}")
        if {f".{kind}" for kind in self.formats} & {*FORGED_SUFFIXES} and find_spec("gaussforge") is None:
            raise InputError("--formats sog and ksplat need gaussforge; pip install 'glassplat[formats]'")
        if self.url is not None and not self.url.startswith(("https://", "http://")):
            raise InputError(f"--url is {self.url}; expected an address that begins with https://")
        check_scene(self.scene)
        self.file.check()
        check_claim(self.output, "export")
        say_scene(self.scene)


@dataclass(frozen=True)
class Dereflect(Command):
    """Take the reflections out of a planar run's photographs; one PNG per photograph, under its name.

    Attributes:
        run_directory: the run's directory.
        output: where the images go; a new folder, or one that this command wrote.
        split: which photographs.
        source: photo keeps the photograph, and takes the rendered reflection off it where a pane is; render shows
            the rendered scene without its panes.
        downscale: factor by which the images are smaller than the photographs, whatever it was in training.
        device: where to render; auto takes an NVIDIA GPU where one can be used.
        data: where the capture is now, if it has moved since training.
    """

    work = "writing:write_dereflected"
    left = "images already written to {output} are whole: repeat the command for all of them"

    run_directory: tyro.conf.Positional[Path]
    output: Path
    split: Split = "all"
    source: Literal["photo", "render"] = "photo"
    downscale: Downscale = 1.0
    device: DeviceName = "auto"
    data: Path | None = None

    def check(self) -> None:
        """Refuses what is no run, and an output that holds something else."""
        RunDirectory(self.run_directory).check_begun()
        check_claim(self.output, "dereflect")
        say_scene(self.run_directory)
