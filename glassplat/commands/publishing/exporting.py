"""What `glassplat export` does: writes a scene in the formats that others read."""

from __future__ import annotations

from dataclasses import replace

from rich.console import Console

from glassplat.commands.console.messages import say, warn
from glassplat.commands.publishing.export import Export
from glassplat.commands.runs.output_folder import check_targets, claim_folder
from glassplat.data.errors import input_checked
from glassplat.files.cameras_json import write_cameras
from glassplat.files.glb import write_glb
from glassplat.files.ply import write_gaussians
from glassplat.files.spz import write_spz
from glassplat.interface.loading import load
from glassplat.interface.model import Model
from glassplat.interface.saving import ENVIRONMENT, GLASS, PLANES, save_page, write_beside
from glassplat.publish.web_page import can_show
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.plane_edits import without_glass
from glassplat.scene.scene import Scene


def write_files(command: Export, console: Console) -> None:
    """Writes the files."""
    model = load(command.run_directory, device=command.device)
    model = model.with_scene(_chosen(command, command.edits.applied(model.scene)))
    targets = [
        command.output / name
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
    check_targets(command.output, targets, [])
    if claim_folder(command.output, "export", command.run_directory):
        say(console, f"replacing the files of an earlier run of this command in {command.output}")
    _write_beside(command, model.scene, console)
    write_cameras(command.output / "cameras.json", model.cameras.items())
    _write_gaussians(command, model.scene.primary, console)
    if "html" in command.formats:
        _write_page(command, model, console)


def _chosen(command: Export, scene: Scene) -> Scene:
    if command.layer == "all":
        return scene
    bare = without_glass(scene)
    return replace(bare, primary=replace(bare.primary, channels={}))


def _write_gaussians(command: Export, gaussians: Gaussians, console: Console) -> None:
    if "ply" in command.formats:
        write_gaussians(command.output / "scene.ply", gaussians)
        say(console, f"{len(gaussians)} Gaussians -> {command.output / 'scene.ply'}")
    if "spz" in command.formats:
        path = command.output / "scene.spz"
        write_spz(path, gaussians, command.spz_version)
        say(console, f"{path.stat().st_size / 1e6:.2f} MB, version {command.spz_version} -> {path}")
    if "glb" in command.formats:
        path = command.output / "scene.glb"
        with input_checked():
            write_glb(path, gaussians)
        say(console, f"{path.stat().st_size / 1e6:.2f} MB -> {path}")


def _write_page(command: Export, model: Model, console: Console) -> None:
    path = command.output / "index.html"
    if not can_show(model.renderer):
        warn(console, f"no page was written: it does not show {model.recipe.method} runs of this kind")
        return
    save_page(model, path, command.title or model.name)
    say(console, f"{path.stat().st_size / 1e6:.2f} MB, open it in a browser -> {path}")


def _write_beside(command: Export, scene: Scene, console: Console) -> None:
    """Planes, glass and environment, where there are any."""
    write_beside(command.output, scene)
    if len(scene.planes):
        say(console, f"{len(scene.planes)} panes -> {command.output / PLANES}, their shape -> {GLASS}")
    if not scene.environment.is_empty:
        warn(console, f"other viewers show this scene without what it mirrors; that is in {ENVIRONMENT}")
