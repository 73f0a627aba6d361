"""`glassplat dereflect`: the photographs without what the panes reflect."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console
from rich.progress import track
from torch import Tensor

from glassplat.commands.console.messages import say, warn
from glassplat.commands.runs.output_folder import check_targets, claim_folder
from glassplat.commands.runs.stored_run import Split, StoredRun, chosen_views, open_run, photographs_of, pictures_of
from glassplat.data.errors import InputError
from glassplat.data.view import View
from glassplat.evaluate.evaluate import timed_render
from glassplat.evaluate.metrics import quantized
from glassplat.files.images import write_image
from glassplat.kernels.devices import DeviceName
from glassplat.render.dereflect import dereflected_photo
from glassplat.render.planar import Planar


@dataclass(frozen=True)
class Dereflect:
    """Take the reflections out of a planar run's photographs; one PNG per photograph, under its name.

    Attributes:
        run_directory: the run's directory.
        output: where the images go; a new folder, or one that this command wrote.
        split: which photographs.
        source: photo keeps the photograph, and takes the rendered reflection off it where a pane is; render shows
            the rendered scene without its panes.
        device: where to render; auto takes an NVIDIA GPU where one can be used.
        data: where the capture is now, if it has moved since training.
    """

    run_directory: tyro.conf.Positional[Path]
    output: Path
    split: Split = "all"
    source: Literal["photo", "render"] = "photo"
    device: DeviceName = "auto"
    data: Path | None = None

    def run(self, console: Console) -> None:
        """Writes the images."""
        stored = open_run(self.run_directory, self.device, self.data)
        renderer = planar_renderer(stored)
        views = chosen_views(stored.dataset, self.split)
        paths = pictures_of(stored.dataset)
        check_targets(self.output, [self.output / paths[view.name] for view in views], photographs_of(stored.dataset))
        if claim_folder(self.output, "dereflect", self.run_directory):
            say(console, f"replacing the images of an earlier run of this command in {self.output}")
        for warning in mirror_warnings(stored):
            warn(console, warning)
        for view in track(views, "taking reflections off", console=console):
            write_image(self.output / paths[view.name], self._image(stored, renderer, view))
        say(console, f"{len(views)} images without reflections -> {self.output}")

    def left_behind(self) -> str:
        """What an interrupt leaves, and how to go on."""
        return f"images already written to {self.output} are whole: repeat the command for all of them"

    def _image(self, stored: StoredRun, renderer: Planar, view: View) -> Tensor:
        frame, _ = timed_render(renderer, stored.scene, view)
        if self.source == "render":
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
