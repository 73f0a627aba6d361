"""What `glassplat dereflect` does: renders a run's reflections and takes them off its photographs."""

from __future__ import annotations

from dataclasses import replace

from rich.console import Console
from rich.progress import track
from torch import Tensor

from glassplat.commands.console.messages import say, warn
from glassplat.commands.publishing.dereflect import Dereflect
from glassplat.commands.runs.output_folder import check_targets, claim_folder
from glassplat.commands.runs.splits import chosen_views
from glassplat.commands.runs.stored_run import StoredRun, open_run, photographs_of, pictures_of
from glassplat.data.errors import InputError
from glassplat.data.view import View
from glassplat.evaluate.evaluate import timed_render
from glassplat.evaluate.metrics import quantized
from glassplat.files.images import write_image
from glassplat.render.dereflect import dereflected_photo
from glassplat.render.planar import Planar


def write_dereflected(command: Dereflect, console: Console) -> None:
    """Writes an image for each photograph."""
    stored = open_run(command.run_directory, command.device, command.data)
    renderer = planar_renderer(stored)
    views = chosen_views(stored.dataset, command.split)
    paths = pictures_of(stored.dataset)
    check_targets(command.output, [command.output / paths[view.name] for view in views], photographs_of(stored.dataset))
    if claim_folder(command.output, "dereflect", command.run_directory):
        say(console, f"replacing the images of an earlier run of this command in {command.output}")
    for warning in mirror_warnings(stored):
        warn(console, warning)
    for view in track(views, "taking reflections off", console=console):
        write_image(command.output / paths[view.name], dereflected(command, stored, renderer, view))
    say(console, f"{len(views)} images without reflections -> {command.output}")


def dereflected(command: Dereflect, stored: StoredRun, renderer: Planar, view: View) -> Tensor:
    """The photograph of a view without its reflections, or the render in its place."""
    frame, _ = timed_render(renderer, stored.scene, view)
    if command.source == "render":
        return quantized(frame.layers["without_panes"])
    # Not `view.photo`, which stays in memory: a capture may be larger than that.
    exposures = stored.scene.exposures.to("cpu")
    return dereflected_photo(frame, view.read_photo(), renderer.blend, exposures=exposures, name=view.name)


def planar_renderer(stored: StoredRun) -> Planar:
    """The renderer of a run that has reflections to take off, that of the photographer among them.

    Raises:
        InputError: it has none.
    """
    renderer = stored.renderer
    if isinstance(renderer, Planar) and len(stored.scene.planes):
        return replace(renderer, photographer="present")
    raise InputError(
        f"{stored.directory.path} is a {stored.recipe.method} run without panes, so it knows no reflection; train one "
        f"that does, with pane masks: glassplat train planar --data {stored.directory.settings().data} --output RUN"
    )


def mirror_warnings(stored: StoredRun) -> list[str]:
    """What to expect of panes that transmit nothing."""
    return [
        f"pane {label} is a mirror, and nothing is seen through it; without its reflection it shows what the scene "
        "happens to hold behind it"
        for label in stored.scene.planes.mirrors
    ]
