"""Commands that take a scene: `glassplat eval`, `render`, `dereflect`, `clean`, `view`, `video` and `export`."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from glassplat.access import LOCALHOST
from glassplat.cli.console import Command
from glassplat.cli.places import SceneEdits, SplatFile, Split, check_claim, check_file, check_scene, print_scene
from glassplat.errors import InputError, convert_to_input_error
from glassplat.files.writing import OUTPUT_FORMATS, check_folder, check_scene_name
from glassplat.kernels.backend.devices import DeviceName
from glassplat.model.run_directory import RunDirectory
from glassplat.options import Cleaning, Coordinate, Downscale, Positive, Range
from glassplat.publish.film import check_encoder
from glassplat.viewer.render_loop import check_port

PaneSource = Literal["auto", "truth", "masks", "rendered"]
Align = Literal["auto", "always", "never"]
"""When to move test cameras before scoring."""


@dataclass(frozen=True)
class Evaluate(Command):
    """Evaluate a run on its test views and write comparison sheets.

    Attributes:
        run_directory: directory of the run.
        device: rendering device; auto uses an NVIDIA GPU if available.
        data: location of the capture, if it has moved since training.
        panes: source of the pixels of panes, for the metrics over panes: the ground truth, the masks (by the planes
            fitted to them), or the mask that the run renders; auto uses the first available. Only with the first two
            are the pixels the same for all methods.
        align: before scoring, move each test camera to where its photograph best matches the scene; auto does so for
            runs that refined the cameras of training views.
    """

    entry_point = "evaluation:evaluate_and_report"
    interrupt_hint = "{run_directory} itself is unchanged: repeat the command to evaluate it"

    run_directory: tyro.conf.Positional[Path]
    device: DeviceName = "auto"
    data: Path | None = None
    panes: PaneSource = "auto"
    align: Align = "auto"

    def check(self) -> None:
        """Checks that the path is a run."""
        RunDirectory(self.run_directory).check_begun()
        check_folder(self.run_directory)
        print_scene(self.run_directory)


@dataclass(frozen=True)
class Render(Command):
    """Render the layers of a run from its cameras, with original or edited panes.

    Attributes:
        run_directory: directory of the run.
        output: output folder, with a folder per layer; new, or written by this command before.
        layers: rgb, normal, depth, alpha and the layers of the method, such as transmission and reflection; an unknown
            layer is refused with a list of those available. Depth (camera z, world units) and normals are also written
            as .npy files.
        split: cameras to render.
        edits: changes to the panes.
        device: rendering device; auto uses an NVIDIA GPU if available.
        data: location of the capture, if it has moved since training.
    """

    entry_point = "writing:write_layers"
    interrupt_hint = "images already written to {output} are complete: repeat the command to write all of them"

    run_directory: tyro.conf.Positional[Path]
    output: Path
    layers: tuple[str, ...] = ("rgb",)
    split: Split = "test"
    edits: Annotated[SceneEdits, tyro.conf.arg(name="")] = field(default_factory=SceneEdits)
    device: DeviceName = "auto"
    data: Path | None = None

    def check(self) -> None:
        """Checks that the path is a run, and that the output may be written."""
        RunDirectory(self.run_directory).check_begun()
        check_claim(self.output, "render")
        print_scene(self.run_directory)


@dataclass(frozen=True)
class View(Command):
    """View a scene in the browser, layer by layer, with original or edited panes.

    Attributes:
        scene: directory of a run, exported folder, or splat file (.ply, .spz, .glb, .splat, .sog, .ksplat).
        port: port of the viewer; 0 picks a free one.
        host: address to listen on; 127.0.0.1 is for this machine only, 0.0.0.0 for the whole network.
        output: folder for edited scenes and keyframes saved in the browser; by default the folder of the scene. If
            others can connect, nothing can be saved without this option.
        file: properties that a splat file does not record.
        edits: changes to the panes.
        device: rendering device; auto uses an NVIDIA GPU if available.
    """

    entry_point = "serving:serve_viewer"
    interrupt_hint = "everything saved in the browser is kept"

    scene: tyro.conf.Positional[Path]
    port: Annotated[int, Range(0, 65535)] = 8080
    host: str = LOCALHOST
    output: Path | None = None
    file: Annotated[SplatFile, tyro.conf.arg(name="")] = field(default_factory=SplatFile)
    edits: Annotated[SceneEdits, tyro.conf.arg(name="")] = field(default_factory=SceneEdits)
    device: DeviceName = "auto"

    def check(self) -> None:
        """Checks the scene, the output folder and the port."""
        check_scene(self.scene)
        self.file.check()
        if self.output is not None:
            check_folder(self.output)
        check_port(self.host, self.port)
        print_scene(self.scene)


@dataclass(frozen=True)
class Video(Command):
    """Render a video along a camera path: one layer, several side by side, or a wipe between two.

    Attributes:
        scene: directory of a run, exported folder, or splat file (.ply, .spz, .glb, .splat, .sog, .ksplat).
        output: video file: .mp4 (VP9, plays in browsers; needs glassplat[video]), .webp or .gif.
        path: orbit around the scene (a loop in front of it if it was photographed from one side), the cameras of the
            photographs, or those of --keyframes.
        keyframes: camera file for --path keyframes, in the format of the cameras.json that `export` writes.
        layers: layers to show.
        layout: side by side, or the second layer wiped over the first.
        seconds: duration.
        fps: frames per second.
        width: width of one layer in pixels.
        force: overwrite an existing video.
        file: properties that a splat file does not record.
        edits: changes to the panes.
        device: rendering device; auto uses an NVIDIA GPU if available.
    """

    entry_point = "writing:write_video"
    interrupt_hint = "nothing was written: repeat the command"

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
        """Checks the video file, the options and the scene."""
        try:
            with convert_to_input_error():
                check_encoder(self.output, self.fps)
        except ImportError as error:
            raise InputError(
                f"{self.output.suffix} needs OpenCV ({error}); pip install 'glassplat[video]', or end --output in .webp"
            ) from error
        if self.output.is_dir():
            raise InputError(f"{self.output} is a folder; expected a video file as --output")
        if os.path.lexists(self.output) and not self.force:
            raise InputError(f"{self.output} already exists; pass --force to overwrite it, or choose another --output")
        check_folder(self.output.parent)
        if self.layout == "wipe" and len(self.layers) != 2:
            raise InputError(f"--layout wipe needs two --layers, not {len(self.layers)}, such as rgb transmission")
        if (self.path == "keyframes") != (self.keyframes is not None):
            raise InputError("--path keyframes and --keyframes FILE belong together; give both or neither")
        check_scene(self.scene)
        self.file.check()
        if self.keyframes is not None:
            check_file(self.keyframes, "cameras as in the cameras.json that `glassplat export` writes")
        print_scene(self.scene)


if TYPE_CHECKING:
    Format = str
else:
    Format = Literal[OUTPUT_FORMATS]


@dataclass(frozen=True)
class Clean(Command):
    """Remove floaters from a scene and scale it to metres; writes a new scene.

    Attributes:
        scene: directory of a run, exported folder, or splat file (.ply, .spz, .glb, .splat, .sog, .ksplat).
        output: new folder for the cleaned scene, which `glassplat view` and `export` read like a run; or a new splat
            file.
        rules: rules for removal.
        scale: two points, x y z each in world units, and their distance in metres; `view` measures points.
        file: properties that a splat file does not record.
        device: device to use; auto uses an NVIDIA GPU if available.
    """

    entry_point = "writing:write_clean"

    scene: tyro.conf.Positional[Path]
    output: Path
    rules: Annotated[Cleaning, tyro.conf.arg(name="")] = field(default_factory=Cleaning)
    scale: tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Positive] | None = None
    file: Annotated[SplatFile, tyro.conf.arg(name="")] = field(default_factory=SplatFile)
    device: DeviceName = "auto"

    def check(self) -> None:
        """Checks the scene, the two points and the output."""
        check_scene_name(self.output)
        check_scene(self.scene)
        self.file.check()
        if self.scale is not None and self.scale[:3] == self.scale[3:6]:
            raise InputError(f"--scale has the point {self.scale[:3]} twice; expected two different points")
        if os.path.isfile(self.output) or (self.output.suffix and self.output.exists()):
            raise InputError(f"{self.output} already exists; nothing was written. Choose another --output")
        check_folder(self.output)
        if os.path.lexists(self.output) and any(self.output.iterdir()):
            raise InputError(f"{self.output} is not empty; nothing was written. Choose a new folder for --output")
        print_scene(self.scene)

    def interrupt_message(self) -> str:
        """Message after an interrupt: the state on disk, and how to continue."""
        begun = f"remove {self.output} and " if os.path.lexists(self.output) else ""
        return f"{self.scene} is as it was; {begun}repeat the command"


@dataclass(frozen=True)
class Export(Command):
    """Export a scene to PLY, SPZ, GLB or a web page with live panes, along with its panes.

    Attributes:
        scene: directory of a run, exported folder, or splat file (.ply, .spz, .glb, .splat, .sog, .ksplat).
        output: output folder; new, or written by this command before, in which case its old files are removed.
        formats: files to write; glb is glTF with KHR_gaussian_splatting, html a self-contained page that shows the
            scene in any browser without a server.
        layer: all writes the scene along with its panes, as planes.json and glass.ply; transmission writes the scene
            without panes and without reflections of panes and glossy objects.
        title: title of the page; by default the name of the run.
        credit: author and licence to show on the page.
        url: address at which the page will be published, for link previews; also writes preview.jpg.
        spz_version: version of the SPZ file: 3, which every reader supports, or 4.
        file: properties that a splat file does not record.
        edits: changes to the panes.
        device: rendering device; auto uses an NVIDIA GPU if available.
    """

    entry_point = "writing:write_files"
    interrupt_hint = "files already written to {output} are complete: repeat the command to write all of them"

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
        """Checks the options, the scene and the output folder."""
        if not self.formats:
            raise InputError(f"nothing to write without --formats; expected some of {', '.join(OUTPUT_FORMATS)}")
        for kind in self.formats:
            check_scene_name(Path(f"scene.{kind}"))
        if "html" not in self.formats and (self.title or self.credit or self.url):
            raise InputError("--title, --credit and --url are for the page; add html to --formats")
        if "spz" not in self.formats and self.spz_version != 3:
            raise InputError("--spz-version is for SPZ; add spz to --formats")
        if self.url is not None and not self.url.startswith(("https://", "http://")):
            raise InputError(f"--url is {self.url}; expected an address that begins with https://")
        check_scene(self.scene)
        self.file.check()
        check_claim(self.output, "export")
        print_scene(self.scene)


@dataclass(frozen=True)
class Dereflect(Command):
    """Remove the reflections from the photographs of a planar run; writes one PNG per photograph.

    Attributes:
        run_directory: directory of the run.
        output: output folder; new, or written by this command before.
        split: photographs to process.
        source: photo subtracts the rendered reflection from the photograph; render renders the scene without panes.
        downscale: factor by which the images are smaller than the photographs, independent of training.
        device: rendering device; auto uses an NVIDIA GPU if available.
        data: location of the capture, if it has moved since training.
    """

    entry_point = "writing:write_dereflected"
    interrupt_hint = "images already written to {output} are complete: repeat the command to write all of them"

    run_directory: tyro.conf.Positional[Path]
    output: Path
    split: Split = "all"
    source: Literal["photo", "render"] = "photo"
    downscale: Downscale = 1.0
    device: DeviceName = "auto"
    data: Path | None = None

    def check(self) -> None:
        """Checks that the path is a run, and that the output may be written."""
        RunDirectory(self.run_directory).check_begun()
        check_claim(self.output, "dereflect")
        print_scene(self.run_directory)
