"""What `glassplat video` does: renders the pictures of a film and encodes them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console

from glassplat.commands.console.messages import say
from glassplat.commands.console.work_progress import WorkProgress
from glassplat.commands.looking.video import Video
from glassplat.data.errors import input_checked
from glassplat.evaluate.layer_image import layer_image
from glassplat.evaluate.metrics import quantized
from glassplat.files.atomic import atomic_write
from glassplat.files.cameras_json import read_cameras
from glassplat.interface.layers import check_layers
from glassplat.interface.loading import load
from glassplat.interface.model import Model
from glassplat.prepare.messages import Progress as Step
from glassplat.publish.camera_paths import interpolated, keyframes_of, widened
from glassplat.publish.film import side_by_side, wiped, write_film
from glassplat.render.layers import renderer_with
from glassplat.scene.camera import Camera

WIPE_SPAN = 0.9
"""Part of the picture that a wipe goes over, there and back."""


def film(command: Video, console: Console) -> None:
    """Renders the pictures and encodes them one by one."""
    model = load(command.scene, device=command.device)
    check_layers(command.layers, model.recipe)
    model = model.with_scene(command.edits.applied(model.scene))
    cameras = _cameras(command, model)
    with WorkProgress(console) as progress, atomic_write(command.output) as temporary:
        pictures = followed("filming", _pictures(command, model, cameras), len(cameras), progress)
        count = write_film(temporary, pictures, command.fps)
    say(console, f"{count} pictures, {command.output.stat().st_size / 1e6:.2f} MB -> {command.output}")


def _cameras(command: Video, model: Model) -> list[Camera]:
    frames = max(2, round(command.seconds * command.fps))
    with input_checked():
        if command.keyframes is not None:
            cameras = interpolated([camera for _, camera in read_cameras(command.keyframes)], frames)
        elif command.path == "interpolate":
            cameras = interpolated(keyframes_of([model.cameras[name] for name in sorted(model.cameras)]), frames)
        else:
            cameras = model.orbit(frames)
    return [widened(camera, command.width + command.width % 2) for camera in cameras]


def _pictures(command: Video, model: Model, cameras: Sequence[Camera]) -> Iterator[NDArray[np.uint8]]:
    """One picture per camera; rendered when it is asked for."""
    renderer = renderer_with(model.renderer, command.layers)
    for index, camera in enumerate(cameras):
        with torch.no_grad():
            frame = renderer(model.scene, camera)
            shown = [_picture(layer_image(frame, layer)) for layer in command.layers]
        if command.layout == "wipe":
            share = 0.5 + WIPE_SPAN / 2 * math.sin(2 * math.pi * index / len(cameras))
            yield wiped(shown[0], shown[1], share)
        else:
            yield side_by_side(shown)


def _picture(image: torch.Tensor) -> NDArray[np.uint8]:
    """A layer [H, W] or [H, W, 3] as a picture."""
    if image.dim() == 2:
        image = image[..., None].expand(-1, -1, 3)
    picture: NDArray[np.uint8] = quantized(image).cpu().contiguous().numpy()
    return picture


def followed(
    what: str, pictures: Iterable[NDArray[np.uint8]], total: int, progress: WorkProgress
) -> Iterator[NDArray[np.uint8]]:
    """The pictures, with a progress shown as they are taken."""
    progress.show(Step(what, 0, total))
    for number, picture in enumerate(pictures, start=1):
        yield picture
        progress.show(Step(what, number, total))
