"""Files written by commands: layers as images, photographs without reflections, videos, other formats."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from torch import Tensor

from glassplat.captures.view import View
from glassplat.cli.console import print_line, print_warning, shell_word
from glassplat.cli.places import SceneEdits, check_targets, chosen_views, claim_folder, recorded_value
from glassplat.cli.progress import WorkProgress
from glassplat.cli.runs import StoredRun, image_names, open_run, photograph_paths
from glassplat.errors import InputError, convert_to_input_error, count_noun, join_names
from glassplat.evaluate.evaluate import time_render
from glassplat.evaluate.metrics import quantize
from glassplat.files.images import write_image
from glassplat.files.records import readable_name
from glassplat.files.sidecars import read_cameras, write_cameras
from glassplat.files.writing import OUTPUT_FORMATS, SPLAT_WRITERS, atomic_write, real_path, scene_source, write_splats
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.model import model as models
from glassplat.model.run_directory import RunDirectory
from glassplat.publish.camera_paths import fit_to_width, interpolate_cameras, select_keyframes
from glassplat.publish.film import check_size, encode_video, side_by_side, wipe_images
from glassplat.publish.web_page import MOST_GAUSSIANS, PREVIEW, Sharing, check_panes, fits_page, write_preview
from glassplat.render.frame import check_layers
from glassplat.render.layers import MEASURED, layer_image
from glassplat.render.planar import Planar, dereflected_photo
from glassplat.scene.camera import Camera
from glassplat.scene.corrections import natural_sort_key
from glassplat.scene.scene import Scene
from glassplat.training.messages import Working

if TYPE_CHECKING:
    from glassplat.cli.scene import Clean, Dereflect, Export, Render, Video

Item = TypeVar("Item")


def write_layers(command: Render, console: Console) -> None:
    """Renders every layer of every view into its image, and the values of depth and normals into an array."""
    stored = open_run(command.run_directory, command.device, command.data)
    scene = command.edits.apply(stored.scene)
    check_layers(stored.renderer, scene, command.layers, stored.recipe.method)
    renderer = stored.renderer.with_layers(command.layers)
    views = chosen_views(stored.dataset, command.split)
    paths = image_names(stored.dataset)
    images = [(layer, command.output / layer / paths[view.name]) for layer in command.layers for view in views]
    arrays = [path.with_suffix(".npy") for layer, path in images if layer in MEASURED]
    check_targets(command.output, [*(path for _, path in images), *arrays], photograph_paths(stored.dataset))
    if claim_folder(command.output, "render", command.run_directory):
        print_line(
            console,
            f"adding to {command.output}, which `glassplat render` wrote earlier; images of one name are replaced",
        )
    with WorkProgress(console) as progress:
        for view in track_progress("rendering", views, len(views), progress):
            frame, _ = time_render(renderer, scene, view)
            for layer in command.layers:
                target = command.output / layer / paths[view.name]
                write_image(target, layer_image(frame, layer))
                if layer in MEASURED:
                    with atomic_write(target.with_suffix(".npy")) as temporary:
                        np.save(temporary, frame.layers[layer].float().cpu().numpy())
    made = f"{count_noun(len(views), 'view')} x {count_noun(len(command.layers), 'layer')}"
    print_line(console, f"{made} -> {command.output}")


def write_dereflected(command: Dereflect, console: Console) -> None:
    """Writes an image for each photograph."""
    stored = open_run(command.run_directory, command.device, command.data, command.downscale)
    renderer = planar_renderer(stored)
    views = chosen_views(stored.dataset, command.split)
    paths = image_names(stored.dataset)
    targets = [command.output / paths[view.name] for view in views]
    check_targets(command.output, targets, photograph_paths(stored.dataset))
    if claim_folder(command.output, "dereflect", command.run_directory):
        print_line(console, f"replacing the images of an earlier run of this command in {command.output}")
    for label in stored.scene.planes.mirrors:
        shown = "whatever the scene has behind it, which no photograph shows"
        print_warning(console, f"pane {label} is a mirror; without its reflection, it shows {shown}")
    with WorkProgress(console) as progress:
        for view in track_progress("taking reflections off", views, len(views), progress):
            write_image(command.output / paths[view.name], dereflect_view(command, stored, renderer, view))
    print_line(console, f"{count_noun(len(views), 'image')} without reflections -> {command.output}")


def dereflect_view(command: Dereflect, stored: StoredRun, renderer: Planar, view: View) -> Tensor:
    """The photograph of a view without its reflections, or a render instead."""
    frame, _ = time_render(renderer, stored.scene, view)
    if command.source == "render":
        return quantize(frame.layers["without_panes"])
    # Not `view.photo`, which is kept in memory: a capture may be larger.
    exposures = stored.scene.exposures.to("cpu")
    return dereflected_photo(frame, view.read_photo(), renderer.blend, exposures=exposures, name=view.name)


def planar_renderer(stored: StoredRun) -> Planar:
    """The renderer of a run with reflections to remove, including that of the photographer."""
    renderer = stored.renderer
    if isinstance(renderer, Planar) and len(stored.scene.planes):
        return replace(renderer, photographer="present")
    data = "CAPTURE" if stored.directory.import_record.is_file() else shell_word(stored.directory.settings().data)
    raise InputError(
        f"{stored.directory.path} is a {stored.recipe.method} run without panes; reflections are removed from "
        f"panes only: glassplat train planar --data {data} --output RUN"
    )


WIPE_SPAN = 0.9
"""Share of the frame that the wipe covers, moving there and back."""


def write_video(command: Video, console: Console) -> None:
    """Renders the frames and encodes them one by one."""
    model = command.file.open(command.scene, command.device)
    model = model.with_scene(command.edits.apply(model.scene))
    check_layers(model.renderer, model.scene, command.layers, model.recipe.method)
    cameras = _video_cameras(command, model)
    columns = 1 if command.layout == "wipe" else len(command.layers)
    with convert_to_input_error():
        check_size(command.output, columns * cameras[0].width, cameras[0].height)
    with WorkProgress(console) as progress, atomic_write(command.output) as temporary:
        frames = track_progress("filming", _video_frames(command, model, cameras), len(cameras), progress)
        encode_video(temporary, frames, count=len(cameras), fps=command.fps)
    print_line(console, f"{len(cameras)} pictures, {command.output.stat().st_size / 1e6:.2f} MB -> {command.output}")


def _video_cameras(command: Video, model: models.Model) -> list[Camera]:
    frames = max(2, round(command.seconds * command.fps))
    with convert_to_input_error():
        if command.keyframes is not None:
            cameras = interpolate_cameras([camera for _, camera in read_cameras(command.keyframes)], frames)
        elif command.path == "interpolate":
            names = sorted(model.cameras, key=natural_sort_key)
            cameras = interpolate_cameras(select_keyframes([model.cameras[name] for name in names]), frames)
        else:
            cameras = model.orbit(frames)
    return [fit_to_width(camera, command.width + command.width % 2) for camera in cameras]


def _video_frames(command: Video, model: models.Model, cameras: Sequence[Camera]) -> Iterator[NDArray[np.uint8]]:
    """Frames, one per camera, rendered lazily."""
    renderer = model.renderer.with_layers(command.layers)
    for index, camera in enumerate(cameras):
        with torch.no_grad():
            frame = renderer(model.scene, camera)
            shown = [_quantized_image(layer_image(frame, layer)) for layer in command.layers]
        if command.layout == "wipe":
            share = 0.5 + WIPE_SPAN / 2 * math.sin(2 * math.pi * index / len(cameras))
            yield wipe_images(shown[0], shown[1], share)
        else:
            yield side_by_side(shown)


def _quantized_image(image: torch.Tensor) -> NDArray[np.uint8]:
    """A layer [H, W] or [H, W, 3] as an 8-bit image."""
    if image.dim() == 2:
        image = image[..., None].expand(-1, -1, 3)
    quantized: NDArray[np.uint8] = quantize(image).cpu().contiguous().numpy()
    return quantized


def track_progress(what: str, items: Iterable[Item], total: int, progress: WorkProgress) -> Iterator[Item]:
    """Iterates over items while showing progress."""
    progress.show(Working(what, 0, total))
    for number, item in enumerate(items, start=1):
        yield item
        progress.show(Working(what, number, total))


LARGEST_FACTOR = 1e6
"""Largest factor of `--scale` in either direction; beyond, files could not be read again."""
METRE = "metre"
"""The unit that scenes scaled by `clean` record; folders written from such a scene keep the record."""


def write_clean(command: Clean, console: Console) -> None:
    """Writes the clean scene, and reports what was removed."""
    factor, model = _scale_factor(command), command.file.open(command.scene, command.device)
    if command.output.suffix:
        models.check_replaces_nothing(model if factor is None else model.scale(factor), command.output)
    cleaned, found = model.clean(command.rules)
    summary = ", ".join(f"{count} {rule}" for rule, count in found.items() if count) or "no floaters"
    print_line(console, f"{len(cleaned.scene.primary)} of {len(model.scene.primary)} Gaussians kept; found {summary}")
    if (count := found["outside"]) > len(model.scene.primary) / 2:
        print_warning(console, f"--box removes {count} Gaussians, more than half; is it in the scene's own units?")
    if factor is not None:
        if recorded_value(RunDirectory(command.scene).import_record, "unit") == METRE:
            already = "is in metres already, as `clean --scale` wrote it"
            print_warning(console, f"{command.scene} {already}; --scale needs two points measured in this scene")
        cleaned = cleaned.scale(factor)
        print_line(console, f"one unit is now a metre; it was {factor:.4g} m")
    cleaned.save(command.output)
    written = RunDirectory(command.output)
    if factor is not None and written.import_record.is_file():
        written.record_origin(command.scene, unit=METRE)
    is_page, name = command.output.suffix.lower() == ".html", shell_word(command.output)
    print_line(console, f"next: {f'open {name} in a browser' if is_page else f'glassplat view {name}'}")


def _scale_factor(command: Clean) -> float | None:
    """Metres per unit of the scene; None if it keeps its units."""
    if command.scale is None:
        return None
    *points, metres = command.scale
    factor = metres / math.dist(points[:3], points[3:])
    if not 1 / LARGEST_FACTOR <= factor <= LARGEST_FACTOR:
        raise InputError(
            f"--scale makes the scene {factor:.3g} times as large; expected {1 / LARGEST_FACTOR:g} to "
            f"{LARGEST_FACTOR:g}: give two places in the scene's own units, and their distance in metres"
        )
    return factor


def write_files(command: Export, console: Console) -> None:
    """Writes the files, and removes those of an earlier run of the command that were not written again."""
    model = command.file.open(command.scene, command.device)
    model = _exported_model(command, model.with_scene(command.edits.apply(model.scene)))
    if "html" in command.formats:
        with convert_to_input_error():
            check_panes(model.scene)
    splats = [_splat_file(command, kind) for kind in SPLAT_WRITERS]
    sidecars = [command.output / name for name in SIDECARS]
    check_targets(command.output, [*sidecars, *splats], [])
    is_again = claim_folder(command.output, "export", command.scene)
    if is_again:
        print_line(console, f"replacing the files of an earlier run of this command in {command.output}")
    written = [*_write_sidecars(command, model.scene, console), command.output / models.CAMERAS]
    write_cameras(command.output / models.CAMERAS, model.cameras.items())
    failures = []
    for kind in (kind for kind in OUTPUT_FORMATS if kind in command.formats):
        try:
            written += _write_format(command, model, kind, console)
        except ValueError as error:
            failures.append(f"{kind}: {error}")
    if is_again:
        _remove_earlier(command, [*sidecars, *splats], written, console)
    if failures:
        raise InputError("not written: " + "; ".join(failures))


def _splat_file(command: Export, kind: str) -> Path:
    return command.output / f"{models.EXPORT_STEM}.{kind}"


def _write_format(command: Export, model: models.Model, kind: str, console: Console) -> list[Path]:
    """Writes the scene in one format, and reports what the file leaves out; returns the written files."""
    if kind == "html":
        return _write_page(command, model, console)
    path = _splat_file(command, kind)
    write_splats(kind, path, model.scene.primary, **({"version": command.spz_version} if kind == "spz" else {}))
    print_line(console, f"{path.stat().st_size / 1e6:.2f} MB -> {path}")
    if lost := models.unsaved_parts(model, kind):
        hint = f"; {command.scene} holds everything" if command.edits == SceneEdits() else ""
        print_warning(console, f"{path.name} leaves out {', '.join(lost)}{hint}")
    return [path]


SIDECARS = ("index.html", PREVIEW, models.GLASS, models.PLANES, models.ENVIRONMENT, models.PANORAMA, models.CAMERAS)
"""Files that `export` may write next to `scene.*`."""


def _remove_earlier(command: Export, targets: Sequence[Path], written: Sequence[Path], console: Console) -> None:
    """Removes files of an earlier run that were not replaced, as they may belong to another scene.

    If a folder is exported onto itself, its splats stay, since edits do not change them; without any, everything
    stays.
    """
    earlier = [path for path in targets if path not in written and os.path.lexists(path) and not path.is_dir()]
    if real_path(scene_source(command.scene)).parent == real_path(command.output):
        edited = command.edits != SceneEdits() or command.layer != "all"
        earlier = [path for path in earlier if edited and path.name in SIDECARS]
    for path in earlier:
        path.unlink()
    if earlier:
        print_line(console, f"removed {join_names([path.name for path in earlier], len(earlier))} of the earlier run")


def _exported_model(command: Export, model: models.Model) -> models.Model:
    """The model, or its transmission as plain Gaussians without reflections."""
    if command.layer == "all":
        return model
    primary = replace(model.scene.primary, channels={})
    recipe = SplatRecipe(background=model.recipe.background, primitive="disc" if primary.are_discs else "ellipsoid")
    return replace(model, scene=Scene(primary, model.scene.extent), recipe=recipe)


def _write_page(command: Export, model: models.Model, console: Console) -> list[Path]:
    """Writes the page, and its preview if it has an address; returns the written files."""
    path = command.output / "index.html"
    if not fits_page(model.scene):
        print_warning(
            console, f"a page holds {MOST_GAUSSIANS:,} Gaussians: this one shows those that cover the largest areas"
        )
    title, credit = readable_name(command.title or model.name), command.credit and readable_name(command.credit)
    models.save_page(model, path, title, sharing=Sharing(credit, command.url))
    written = [path]
    if command.url is not None:
        write_preview(command.output / PREVIEW, model.scene, model.renderer, tuple(model.cameras.items()))
        written.append(command.output / PREVIEW)
    print_line(console, f"{path.stat().st_size / 1e6:.2f} MB, open it in a browser -> {path}")
    return written


def _write_sidecars(command: Export, scene: Scene, console: Console) -> list[Path]:
    """Writes planes, glass and environment, if present; returns the written files."""
    written = models.write_sidecars(command.output, scene)
    if len(scene.planes):
        panes, whose = count_noun(len(scene.planes), "pane"), "its" if len(scene.planes) == 1 else "their"
        print_line(console, f"{panes} -> {command.output / models.PLANES}, {whose} shape -> {models.GLASS}")
    if not scene.environment.is_empty:
        print_line(console, f"its environment -> {command.output / models.ENVIRONMENT}, {models.PANORAMA}")
    return written
