"""`glassplat video`: a film of a scene, without a screen."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from glassplat.commands.messages import say
from glassplat.commands.scene_edits import SceneEdits
from glassplat.data.errors import InputError, input_checked
from glassplat.data.ranges import Range
from glassplat.evaluate.layer_image import layer_image
from glassplat.evaluate.metrics import quantized
from glassplat.files.atomic import atomic_write
from glassplat.files.cameras_json import read_cameras
from glassplat.interface.layers import Layer, check_layers, renderer_with
from glassplat.interface.loading import load
from glassplat.interface.model import Model
from glassplat.kernels.devices import DeviceName
from glassplat.publish.camera_paths import interpolated, keyframes_of, widened
from glassplat.publish.film import check_encoder, side_by_side, wiped, write_film
from glassplat.scene.camera import Camera

WIPE_SPAN = 0.9
"""Part of the picture that a wipe goes over, there and back."""


@dataclass(frozen=True)
class Video:
    """Film a scene along a path: one layer, several side by side, or one wiped over another.

    Attributes:
        scene: a run's directory, an imported scene, or a splat file.
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
        edits: changes to the panes.
        device: where to render; auto takes an NVIDIA GPU where one can be used.
    """

    scene: tyro.conf.Positional[Path]
    output: Path
    path: Literal["orbit", "interpolate", "keyframes"] = "orbit"
    keyframes: Path | None = None
    layers: tuple[Layer, ...] = ("rgb",)
    layout: Literal["side-by-side", "wipe"] = "side-by-side"
    seconds: Annotated[float, Range(0.1, 3600)] = 8.0
    fps: Annotated[int, Range(1, 120)] = 30
    width: Annotated[int, Range(16, 8192)] = 960
    force: bool = False
    edits: Annotated[SceneEdits, tyro.conf.arg(name="")] = field(default_factory=SceneEdits)
    device: DeviceName = "auto"

    def run(self, console: Console) -> None:
        """Renders and encodes."""
        self._check()
        model = load(self.scene, device=self.device)
        check_layers(self.layers, model.recipe)
        model = model.with_scene(self.edits.applied(model.scene))
        cameras = self._cameras(model)
        pictures = self._pictures(model, track(cameras, "filming", console=console))
        with atomic_write(self.output) as temporary:
            count = write_film(temporary, pictures, self.fps)
        say(console, f"{count} pictures, {self.output.stat().st_size / 1e6:.1f} MB -> {self.output}")

    def left_behind(self) -> str:
        """What an interrupt leaves, and how to go on."""
        return "nothing was written: repeat the command"

    def _check(self) -> None:
        """Everything that can be known to be wrong before it takes long."""
        try:
            with input_checked():
                check_encoder(self.output)
        except ImportError as error:
            raise InputError(
                f"{self.output.suffix} needs OpenCV ({error}); pip install 'glassplat[video]', or end --output in .webp"
            ) from error
        if self.output.exists() and not self.force:
            raise InputError(f"{self.output} is already there; pass --force to replace it, or choose another --output")
        if self.layout == "wipe" and len(self.layers) != 2:
            raise InputError(f"a wipe takes two --layers, not {len(self.layers)}, such as rgb transmission")
        if (self.path == "keyframes") != (self.keyframes is not None):
            raise InputError("--path keyframes and --keyframes FILE belong together; give both or neither")

    def _cameras(self, model: Model) -> list[Camera]:
        frames = max(2, round(self.seconds * self.fps))
        with input_checked():
            if self.keyframes is not None:
                cameras = interpolated([camera for _, camera in read_cameras(self.keyframes)], frames)
            elif self.path == "interpolate":
                cameras = interpolated(keyframes_of([model.cameras[name] for name in sorted(model.cameras)]), frames)
            else:
                cameras = model.orbit(frames)
        return [widened(camera, self.width + self.width % 2) for camera in cameras]

    def _pictures(self, model: Model, cameras: Iterable[Camera]) -> Iterator[NDArray[np.uint8]]:
        """One picture per camera; rendered when the encoder asks for it."""
        frames = max(2, round(self.seconds * self.fps))
        renderer = renderer_with(model.renderer, self.layers)
        for index, camera in enumerate(cameras):
            with torch.no_grad():
                frame = renderer(model.scene, camera)
                shown = [self._picture(layer_image(frame, layer)) for layer in self.layers]
            if self.layout == "wipe":
                share = 0.5 + WIPE_SPAN / 2 * math.sin(2 * math.pi * index / frames)
                yield wiped(shown[0], shown[1], share)
            else:
                yield side_by_side(shown)

    def _picture(self, image: torch.Tensor) -> NDArray[np.uint8]:
        """A layer [H, W] or [H, W, 3] as a picture."""
        if image.dim() == 2:
            image = image[..., None].expand(-1, -1, 3)
        picture: NDArray[np.uint8] = quantized(image).cpu().contiguous().numpy()
        return picture
