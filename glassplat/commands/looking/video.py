"""`glassplat video`: a film of a scene, without a screen."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from rich.console import Console

from glassplat.commands.console.messages import say
from glassplat.commands.console.work_progress import WorkProgress
from glassplat.commands.runs.scene_edits import SceneEdits
from glassplat.data.errors import InputError, input_checked
from glassplat.data.ranges import Range
from glassplat.evaluate.layer_image import layer_image
from glassplat.evaluate.metrics import quantized
from glassplat.files.atomic import atomic_write
from glassplat.files.cameras_json import read_cameras
from glassplat.interface.layers import Layer, check_layers
from glassplat.interface.loading import load
from glassplat.interface.model import Model
from glassplat.kernels.devices import DeviceName
from glassplat.prepare.messages import Progress as Step
from glassplat.publish.camera_paths import interpolated, keyframes_of, widened
from glassplat.publish.film import check_encoder, side_by_side, wiped, write_film
from glassplat.publish.kept_pictures import KeptPictures
from glassplat.render.layers import renderer_with
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
        force: replace a film of that name, or one that was interrupted.
        resume: go on with a film that was interrupted, with the same options.
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
    resume: bool = False
    edits: Annotated[SceneEdits, tyro.conf.arg(name="")] = field(default_factory=SceneEdits)
    device: DeviceName = "auto"

    def run(self, console: Console) -> None:
        """Renders, keeping every picture, and encodes them."""
        kept = KeptPictures(self.output)
        self._check(kept)
        model = load(self.scene, device=self.device)
        check_layers(self.layers, model.recipe)
        model = model.with_scene(self.edits.applied(model.scene))
        cameras = self._cameras(model)
        described = self._described(model, cameras)
        if self.resume:
            kept.check_same(described)
        else:
            kept.begin(described)
        with WorkProgress(console) as progress:
            self._film(kept, model, cameras, progress)
            pictures = followed("encoding", kept.pictures(len(cameras)), 0, len(cameras), progress)
            with atomic_write(self.output) as temporary:
                count = write_film(temporary, pictures, self.fps)
        kept.remove()
        say(console, f"{count} pictures, {self.output.stat().st_size / 1e6:.2f} MB -> {self.output}")

    def left_behind(self) -> str:
        """What an interrupt leaves, and how to go on."""
        kept = KeptPictures(self.output)
        if kept.is_there:
            return f"{kept.count} pictures are kept in {kept.folder}: repeat the command with --resume to go on"
        return "nothing was written: repeat the command"

    def _check(self, kept: KeptPictures) -> None:
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
        if self.resume and not kept.is_there:
            raise InputError(f"no film was interrupted at {self.output}; begin without --resume")
        if kept.is_there and not self.resume and not self.force:
            raise InputError(
                f"{kept.folder} holds {kept.count} pictures of a film that was interrupted; pass --resume to go on, or "
                "--force to begin again"
            )
        if self.layout == "wipe" and len(self.layers) != 2:
            raise InputError(f"a wipe takes two --layers, not {len(self.layers)}, such as rgb transmission")
        if (self.path == "keyframes") != (self.keyframes is not None):
            raise InputError("--path keyframes and --keyframes FILE belong together; give both or neither")

    def _described(self, model: Model, cameras: Sequence[Camera]) -> dict[str, object]:
        """By the names of options, all that the pictures depend on."""
        poses = torch.stack([camera.cam_from_world for camera in cameras])
        lenses = torch.stack([camera.intrinsics for camera in cameras])
        return {
            "the scene with its edits": digest(
                model.scene.parameters(), repr((model.renderer, model.scene.planes.mirrors))
            ),
            "--layers": list(self.layers),
            "--layout": self.layout,
            "--fps": self.fps,
            "--seconds": self.seconds,
            "--width": self.width,
            "--path": self.path,
            "the cameras of the path": digest({"poses": poses, "lenses": lenses}),
        }

    def _film(self, kept: KeptPictures, model: Model, cameras: Sequence[Camera], progress: WorkProgress) -> None:
        """Renders the pictures that are not there yet."""
        done = kept.count
        indices = range(done, len(cameras))
        rendered = self._pictures(model, [(index, cameras[index]) for index in indices], len(cameras))
        for index, picture in zip(indices, followed("filming", rendered, done, len(cameras), progress), strict=True):
            kept.write(index, picture)

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

    def _pictures(
        self, model: Model, cameras: Iterable[tuple[int, Camera]], frames: int
    ) -> Iterator[NDArray[np.uint8]]:
        """One picture per numbered camera; rendered when it is asked for."""
        renderer = renderer_with(model.renderer, self.layers)
        for index, camera in cameras:
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


def followed(
    what: str, pictures: Iterable[NDArray[np.uint8]], done: int, total: int, progress: WorkProgress
) -> Iterator[NDArray[np.uint8]]:
    """The pictures, with a progress shown as they are taken, of which some are done already."""
    progress.show(Step(what, done, total))
    for number, picture in enumerate(pictures, start=done + 1):
        yield picture
        progress.show(Step(what, number, total))


def digest(tensors: Mapping[str, torch.Tensor], *more: str) -> str:
    """Changes when any value does."""
    found = hashlib.sha256("\n".join(more).encode())
    for name in sorted(tensors):
        found.update(name.encode())
        found.update(tensors[name].detach().cpu().contiguous().numpy().tobytes())
    return found.hexdigest()
