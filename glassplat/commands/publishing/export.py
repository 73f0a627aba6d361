"""`glassplat export`: a scene in the formats that others read."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro
from rich.console import Console

from glassplat.commands.console.messages import say, warn
from glassplat.commands.runs.output_folder import check_targets, claim_folder
from glassplat.commands.runs.scene_edits import SceneEdits
from glassplat.data.dataset import TEST_EVERY
from glassplat.data.errors import InputError, input_checked
from glassplat.evaluate.metrics import psnr
from glassplat.files.cameras_json import write_cameras
from glassplat.files.glb import write_glb
from glassplat.files.ply import write_gaussians
from glassplat.files.spz import write_spz
from glassplat.interface.loading import load
from glassplat.interface.model import Model
from glassplat.interface.saving import ENVIRONMENT, GLASS, PLANES, save_page, write_beside
from glassplat.kernels.devices import DeviceName
from glassplat.publish.web_page import can_show
from glassplat.render.baked import baked
from glassplat.render.splat import Splat
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.plane_edits import without_glass
from glassplat.scene.scene import Scene

Format = Literal["ply", "spz", "glb", "html"]
COMPARED_VIEWS = 12


@dataclass(frozen=True)
class Export:
    """Write a scene as others read it: PLY, SPZ, GLB, a web page with live panes, and the panes beside them.

    Attributes:
        run_directory: the run's directory.
        output: where the files go; a new folder, or one that this command wrote.
        formats: which files; glb is glTF with KHR_gaussian_splatting, html a page that shows the scene in any browser,
            by itself and without a server.
        layer: all is the scene with its panes beside it, as planes.json and glass.ply; transmission is the place
            without its panes and what they reflect.
        bake_reflections: put what the panes reflect behind them, as Gaussians, for viewers that know nothing of
            panes; says how far that is from the true render.
        title: of the page; the run's name if not given.
        spz_version: 3, which every reader knows, or 4.
        edits: changes to the panes.
        device: where to render what has to be rendered; auto takes an NVIDIA GPU where one can be used.
    """

    run_directory: tyro.conf.Positional[Path]
    output: Path
    formats: tuple[Format, ...] = ("ply", "spz", "html")
    layer: Literal["all", "transmission"] = "all"
    bake_reflections: bool = False
    title: str | None = None
    spz_version: Literal[3, 4] = 3
    edits: Annotated[SceneEdits, tyro.conf.arg(name="")] = field(default_factory=SceneEdits)
    device: DeviceName = "auto"

    def run(self, console: Console) -> None:
        """Writes the files."""
        if not self.formats:
            raise InputError("nothing to write without --formats; expected ply, spz, glb or html")
        model = load(self.run_directory, device=self.device)
        model = model.with_scene(self._chosen(self.edits.applied(model.scene)))
        targets = [
            self.output / name
            for name in (
                "index.html",
                "scene.ply",
                "scene.spz",
                "scene.glb",
                "glass.ply",
                "planes.json",
                "cameras.json",
            )
        ]
        check_targets(self.output, targets, [])
        if claim_folder(self.output, "export", self.run_directory):
            say(console, f"replacing the files of an earlier run of this command in {self.output}")
        gaussians = model.scene.primary
        if self.bake_reflections:
            gaussians = self._baked(model, console)
        else:
            self._write_beside(model.scene, console)
        write_cameras(self.output / "cameras.json", model.cameras.items())
        self._write_gaussians(gaussians, console)
        if "html" in self.formats:
            self._write_page(model, console)

    def left_behind(self) -> str:
        """What an interrupt leaves, and how to go on."""
        return f"files already written to {self.output} are whole: repeat the command for all of them"

    def _chosen(self, scene: Scene) -> Scene:
        if self.layer == "all":
            return scene
        if self.bake_reflections:
            raise InputError("--layer transmission has no reflections to bake; give one of the two")
        bare = without_glass(scene)
        return replace(bare, primary=replace(bare.primary, channels={}))

    def _baked(self, model: Model, console: Console) -> Gaussians:
        if not len(model.scene.planes):
            raise InputError(f"{model.path} has no panes whose reflections could be baked")
        say(console, "rendering the panes to bake what they reflect")
        gaussians = baked(model.scene, model.renderer, cameras_of(model, "train"))
        before, after = baking_errors(model, gaussians)
        say(
            console,
            f"{len(gaussians) - len(model.scene.primary)} Gaussians added behind the panes; of the true render's "
            f"panes they show {after:.1f} dB over the test views, the scene without them {before:.1f} dB",
        )
        return replace(gaussians, channels={})

    def _write_gaussians(self, gaussians: Gaussians, console: Console) -> None:
        if "ply" in self.formats:
            write_gaussians(self.output / "scene.ply", gaussians)
            say(console, f"{len(gaussians)} Gaussians -> {self.output / 'scene.ply'}")
        if "spz" in self.formats:
            path = self.output / "scene.spz"
            write_spz(path, gaussians, self.spz_version)
            say(console, f"{path.stat().st_size / 1e6:.2f} MB, version {self.spz_version} -> {path}")
        if "glb" in self.formats:
            path = self.output / "scene.glb"
            with input_checked():
                write_glb(path, gaussians)
            say(console, f"{path.stat().st_size / 1e6:.2f} MB -> {path}")

    def _write_page(self, model: Model, console: Console) -> None:
        """The page shows the panes themselves, so that it needs nothing baked."""
        path = self.output / "index.html"
        if not can_show(model.renderer):
            warn(console, f"no page was written: it does not show {model.recipe.method} runs of this kind")
            return
        save_page(model, path, self.title or model.name)
        say(console, f"{path.stat().st_size / 1e6:.2f} MB, open it in a browser -> {path}")

    def _write_beside(self, scene: Scene, console: Console) -> None:
        """Planes, glass and environment, where there are any."""
        write_beside(self.output, scene)
        if len(scene.planes):
            say(console, f"{len(scene.planes)} panes -> {self.output / PLANES}, their shape -> {GLASS}")
        if not scene.environment.is_empty:
            warn(console, f"other viewers show this scene without what it mirrors; that is in {ENVIRONMENT}")


@torch.no_grad()
def baking_errors(model: Model, gaussians: Gaussians) -> tuple[float, float]:
    """PSNR over the pixels of panes, against the true render, without baked reflections and with them."""
    chosen = cameras_of(model, "test")
    bare, full = Scene(model.scene.primary, model.scene.extent), Scene(gaussians, model.scene.extent)
    images: dict[str, list[torch.Tensor]] = {"truth": [], "bare": [], "full": []}
    for camera in chosen[:: max(1, len(chosen) // COMPARED_VIEWS)]:
        frame = model.renderer(model.scene, camera)
        hit = frame.layers["strength"] > 0
        images["truth"].append(frame.rgb[hit])
        images["bare"].append(Splat()(bare, camera).rgb[hit])
        images["full"].append(Splat()(full, camera).rgb[hit])
    truth, without, with_images = (torch.cat(images[name]) for name in ("truth", "bare", "full"))
    if not len(truth):
        raise InputError(f"no view of {model.path} shows a pane; there is nothing to bake")
    return psnr(without, truth), psnr(with_images, truth)


def cameras_of(model: Model, split: Literal["train", "test"]) -> list[Camera]:
    """The cameras of a split, by name: every eighth is of the test views; all of them, where there are few."""
    cameras = [model.cameras[name] for name in sorted(model.cameras)]
    if len(cameras) < TEST_EVERY:
        return cameras
    return [camera for index, camera in enumerate(cameras) if (index % TEST_EVERY == 0) == (split == "test")]
