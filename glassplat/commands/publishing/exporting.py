"""What `glassplat export` does: writes a scene in the formats that others read."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import torch
from rich.console import Console

from glassplat.commands.console.messages import say, warn
from glassplat.commands.publishing.export import Export
from glassplat.commands.runs.output_folder import check_targets, claim_folder
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
from glassplat.publish.web_page import can_show
from glassplat.render.baked import baked
from glassplat.render.splat import Splat
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.plane_edits import without_glass
from glassplat.scene.scene import Scene

COMPARED_VIEWS = 12


def write_files(command: Export, console: Console) -> None:
    """Writes the files."""
    model = load(command.run_directory, device=command.device)
    model = model.with_scene(_chosen(command, command.edits.applied(model.scene)))
    if command.bake_reflections and not len(model.scene.planes):
        raise InputError(f"{model.path} has no panes whose reflections could be baked")
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
    gaussians = model.scene.primary
    if command.bake_reflections:
        gaussians = _baked(command, model, console)
    else:
        _write_beside(command, model.scene, console)
    write_cameras(command.output / "cameras.json", model.cameras.items())
    _write_gaussians(command, gaussians, console)
    if "html" in command.formats:
        _write_page(command, model, console)


def _chosen(command: Export, scene: Scene) -> Scene:
    if command.layer == "all":
        return scene
    bare = without_glass(scene)
    return replace(bare, primary=replace(bare.primary, channels={}))


def _baked(command: Export, model: Model, console: Console) -> Gaussians:
    say(console, "rendering the panes to bake what they reflect")
    gaussians = baked(model.scene, model.renderer, cameras_of(model, "train"))
    before, after = baking_errors(model, gaussians)
    say(
        console,
        f"{len(gaussians) - len(model.scene.primary)} Gaussians added behind the panes; of the true render's "
        f"panes they show {after:.1f} dB over the test views, the scene without them {before:.1f} dB",
    )
    return replace(gaussians, channels={})


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
    """The page shows the panes themselves, so that it needs nothing baked."""
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
