"""What `glassplat render` does: layers of a run, as images."""

from __future__ import annotations

from rich.console import Console
from rich.progress import track

from glassplat.commands.console.messages import say
from glassplat.commands.looking.render import Render
from glassplat.commands.runs.output_folder import check_targets, claim_folder
from glassplat.commands.runs.splits import chosen_views
from glassplat.commands.runs.stored_run import open_run, photographs_of, pictures_of
from glassplat.evaluate.evaluate import timed_render
from glassplat.evaluate.layer_image import layer_image
from glassplat.files.images import write_image
from glassplat.interface.layers import check_layers
from glassplat.render.layers import renderer_with


def write_layers(command: Render, console: Console) -> None:
    """Renders every layer of every view into its file."""
    stored = open_run(command.run_directory, command.device, command.data)
    check_layers(command.layers, stored.recipe)
    scene = command.edits.applied(stored.scene)
    renderer = renderer_with(stored.renderer, command.layers)
    views = chosen_views(stored.dataset, command.split)
    paths = pictures_of(stored.dataset)
    targets = [command.output / layer / paths[view.name] for layer in command.layers for view in views]
    check_targets(command.output, targets, photographs_of(stored.dataset))
    if claim_folder(command.output, "render", command.run_directory):
        say(
            console,
            f"adding to {command.output}, which `glassplat render` wrote earlier; images of one name are replaced",
        )
    for view in track(views, "rendering", console=console):
        frame, _ = timed_render(renderer, scene, view)
        for layer in command.layers:
            image = layer_image(frame, layer)
            write_image(command.output / layer / paths[view.name], image)
    say(console, f"{len(views)} views x {len(command.layers)} layers -> {command.output}")
