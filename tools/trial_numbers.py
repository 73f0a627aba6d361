"""Invalid values in the Python interface, which must give a finite image or an error that explains the problem.

Every field of a scene and a camera is set to NaN, infinities, zeros and 1e30. Cameras are inside Gaussians and on
panes, a million Gaussians lie in one tile, and trainings use degenerate photographs.
"""

from __future__ import annotations

import math
import random
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

import glassplat
from glassplat import Camera, Dataset, Scene, Training, View
from glassplat.captures.view import PointCloud
from glassplat.render.frame import Renderer
from tests.render.tiny_scene import camera_at, in_single_precision, pane
from tests.training.tiny_capture import tiny_capture, true_scene
from tools.trial import Case

POISON = (math.nan, math.inf, -math.inf, 0.0, 1e30, -1e30, 1e-30, 3e38)
MOST_SECONDS = 60.0
"""Limit of CPU time per case."""
METHODS = ("splat", "planar", "deferred", "traced")


def cases(seed: int, cases: int, place: Path) -> Iterator[Case]:
    """Nine of ten cases are frames, the tenth is a training of a few steps."""
    warnings.simplefilter("ignore")
    for method in METHODS:
        with torch.no_grad():
            renderer, scene = rendered(method)
            renderer(scene, tiny_capture().train[1].camera)  # Compiles the kernels.
    for number in range(cases):
        draw = random.Random(f"{seed} {number}")
        what, work = training(draw) if number % 10 == 9 else picture(draw)
        yield Case(f"{number} {what}", fault_of(work))


def fault_of(work: Callable[[], Any]) -> str:
    """Fault of the work; none if it succeeds, or raises an expected error with a message."""
    begun = time.process_time()
    try:
        work()
    except (ValueError, glassplat.InputError) as error:
        return "" if str(error).strip() else "an error without a message"
    except Exception as error:  # noqa: BLE001 - Any other error is a fault.
        return f"{type(error).__name__}: {str(error)[:300]}"
    seconds = time.process_time() - begun
    return f"it took {seconds:.0f} s" if seconds > MOST_SECONDS else ""


def picture(draw: random.Random) -> tuple[str, Callable[[], None]]:
    """A frame of a poisoned scene, or from a poisoned camera."""
    renderer, scene = rendered(draw.choice(METHODS))
    camera, changes = tiny_capture().train[1].camera, dict[str, Any]()
    kind = draw.choice(("scene", "scene", "camera", "inside", "pane", "crowd"))
    if kind == "scene":
        name, scene = poisoned(scene, draw)
    elif kind == "camera":
        name, changes = poisoned_camera(camera, draw)
    elif kind == "inside":
        name, camera = "inside", at(scene.primary.means[draw.randrange(len(scene.primary))])
    elif kind == "pane":
        name = draw.choice(("in the pane", "edge on"))
        planes = pane(2.0, half=0.5)
        normal = planes.raw_normals[0] / planes.raw_normals[0].norm()
        across = planes.tangents[0] - (planes.tangents[0] @ normal) * normal
        camera = at(planes.centers[0] + (2.0 if name == "edge on" else 0.0) * across / across.norm())
        scene = in_single_precision(replace(scene, planes=planes))
    else:
        name, scene = crowded(scene, draw)

    def work() -> None:
        with torch.no_grad():
            rgb = renderer(scene, replace(camera, **changes)).rgb
        if not bool(torch.isfinite(rgb).all()):
            raise ArithmeticError("the image is not finite")

    return f"{type(renderer).__name__} {kind} {name}", work


def rendered(method: str) -> tuple[Renderer, Scene]:
    """The renderer of a method, and a tiny scene with the fields that it needs."""
    scene = true_scene()
    if method == "planar":
        return glassplat.Planar(), scene
    count = len(scene.primary)
    if method == "splat":
        return glassplat.Splat(), Scene(scene.primary, scene.extent)
    primary = replace(scene.primary, channels={"logit_strength": torch.zeros(count)})
    if method == "traced":
        return glassplat.Traced(), Scene(primary, scene.extent, surroundings=replace(scene.primary, channels={}))
    distant = glassplat.Environment.random(8, generator=torch.Generator().manual_seed(2))
    return glassplat.Deferred(), Scene(primary, scene.extent, environment=distant)


def poisoned(scene: Scene, draw: random.Random) -> tuple[str, Scene]:
    """Replaces one, some or all values of a field."""
    name, tensor = draw.choice([(name, tensor) for name, tensor in scene.parameters().items() if tensor.numel()])
    value, changed = draw.choice(POISON), tensor.detach().clone()
    flat = changed.view(-1)
    chosen = range(len(flat)) if draw.random() < 0.2 else [draw.randrange(len(flat))]
    flat[list(chosen)] = value
    return f"{name} {value} x{len(chosen)}", scene.with_parameters({name: changed})


def poisoned_camera(camera: Camera, draw: random.Random) -> tuple[str, dict[str, Any]]:
    """Changes of one value of a camera."""
    value = draw.choice(POISON)
    if draw.random() < 0.5:
        pose, row, column = camera.cam_from_world.clone(), draw.randrange(3), draw.randrange(4)
        pose[row, column] = value
        return f"pose {row} {column} {value}", {"cam_from_world": pose}
    name = draw.choice(("fx", "fy", "cx", "cy"))
    return f"{name} {value}", {name: value}


def at(place: torch.Tensor) -> Camera:
    """A camera at a position."""
    camera = camera_at(*place.tolist())
    return replace(camera, cam_from_world=camera.cam_from_world.float())


def crowded(scene: Scene, draw: random.Random) -> tuple[str, Scene]:
    """A hundred thousand or a million Gaussians at one position."""
    count = draw.choice((100_000, 1_000_000))
    times = count // len(scene.primary)
    tensors = {
        name: tensor.repeat(times, *[1] * (tensor.dim() - 1)) for name, tensor in scene.primary.tensors().items()
    }
    tensors["means"] = torch.zeros_like(tensors["means"]) + torch.tensor([0.0, 0.0, draw.uniform(1, 4)])
    return f"{count} in one place", replace(scene, primary=scene.primary.with_tensors(tensors))


def training(draw: random.Random) -> tuple[str, Callable[[], None]]:
    """A few training steps on degenerate photographs."""
    method, kind = (
        draw.choice(METHODS),
        draw.choice(("8x8", "one", "equal cameras", "black", "masked", "unmasked", "far")),
    )
    views = list(tiny_capture().train)
    points = tiny_capture().points
    if kind == "8x8":
        views = [
            changed(view, camera=view.camera.resize(8, 8), photo=view.photo[:8, :8].contiguous()) for view in views
        ]
    elif kind == "one":
        views = views[:1]
    elif kind == "equal cameras":
        views = [changed(view, camera=views[0].camera) for view in views]
    elif kind == "black":
        views = [changed(view, photo=torch.zeros_like(view.photo)) for view in views]
    elif kind in ("masked", "unmasked"):
        views = [changed(view, fill=int(kind == "masked")) for view in views]
    else:
        points = PointCloud(points.positions * 1e12, points.colors)
    data = Dataset(Path("trial"), tuple(views), tuple(views[:1]), points, 2.0, pane_labels=(1,))

    def work() -> None:
        Training(data, method, iterations=20, device="cpu").run()

    return f"training {method} {kind}", work


def changed(view: View, *, camera: Camera | None = None, photo: Any = None, fill: int | None = None) -> View:
    """A view with another camera or photograph, or a mask of one label."""
    photo = view.photo if photo is None else photo
    labels = None if fill is None else torch.full(photo.shape[:2], fill, dtype=torch.uint8)
    return View.in_memory(view.name, camera or view.camera, photo=photo, pane_labels=labels)
