"""A scene as one HTML file that shows it with live panes: no server, nothing loaded from anywhere.

The page's world is that of the SPZ file in it, y and z turned round. Its script and shaders lie in `web_page/` and are
written into the page as they are.
"""

from __future__ import annotations

import base64
import gzip
import html
import io
import json
from collections.abc import Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from glassplat.files.atomic import atomic_write
from glassplat.files.spz import spz_bytes
from glassplat.files.spz_sections import FLIP
from glassplat.publish.surveyed import best_view, surveyed
from glassplat.render.frame import Renderer
from glassplat.render.planar import Planar
from glassplat.render.rasterize import NEAR_PER_EXTENT
from glassplat.render.seen_panes import glass_owners
from glassplat.render.splat import Splat
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.plane import Planes
from glassplat.scene.scene import Scene

SCRIPTS = (
    "vectors.js", "data.js", "sorter.js", "cameras.js", "graphics.js", "renderer.js", "navigation.js", "panel.js",
    "pace.js", "display.js", "main.js",
)  # fmt: skip
SHADERS = ("texels.glsl", "screen.vert", "project.frag", "splat.vert", "splat.frag", "compose.frag", "copy.frag")
MOST_VIEWS = 400
MOST_PANES = 16
"""The page orders the panes of every pixel by hand."""
POSTER_WIDTH, POSTER_QUALITY = 640, 70
LEAST_OPACITY = 1 / 255


def write_page(
    path: Path | str, scene: Scene, renderer: Renderer, cameras: Sequence[tuple[str, Camera]], title: str
) -> None:
    """Writes the page, atomically.

    Args:
        path: the HTML file.
        scene: what to show.
        renderer: how; a `Planar` or a `Splat`.
        cameras: of the photographs, by name; at least one. People may look round near them.
        title: of the page.

    Raises:
        ValueError: another renderer, no camera, more panes than a page can show, or values that are not finite.
    """
    page = page_text(scene, renderer, cameras, title)
    with atomic_write(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


@torch.no_grad()
def page_text(scene: Scene, renderer: Renderer, cameras: Sequence[tuple[str, Camera]], title: str) -> str:
    """What `write_page` writes."""
    if not can_show(renderer):
        raise ValueError(f"a page cannot show what {type(renderer).__name__} renders; expected a planar or a splat run")
    if not cameras or len(scene.planes) > MOST_PANES:
        raise ValueError(
            f"there are {len(cameras)} cameras and {len(scene.planes)} panes; expected at least one camera and at most "
            f"{MOST_PANES} panes"
        )
    poster_view = best_view(scene.planes, [camera for _, camera in cameras])
    poster = jpeg(renderer(scene, poster_camera(cameras[poster_view][1])).rgb)
    scene = replace(scene, primary=drawn(scene.primary), glass=drawn(scene.glass)).to("cpu")
    channel, channel_range = channel_bytes(scene)
    description = described(scene, renderer, cameras, poster_view)
    count = len(scene.planes)
    subtitle = f"{len(scene.primary):,} Gaussians" + (f" · {count} pane{'s' if count > 1 else ''}" if count else "")
    # Glass has no colour; a constant one makes an SPZ file of it.
    glass = replace(scene.glass, sh=torch.zeros(len(scene.glass), 1, 3), channels={}, active_sh_degree=0)
    return filled(
        asset("page.html"),
        {
            "title": html.escape(title),
            "subtitle": html.escape(subtitle),
            "style": asset("style.css"),
            "poster": in_base64(poster),
            "scene": in_script(description | {"channelRange": channel_range}),
            "primary": in_base64(spz_bytes(replace(scene.primary, channels={}))),
            "glass": in_base64(spz_bytes(glass)),
            "channel": in_base64(gzip.compress(channel, 9, mtime=0)),
            "shaders": in_script({name: asset(name) for name in SHADERS}),
            "script": "\n".join(asset(name) for name in SCRIPTS),
        },
    )


def can_show(renderer: Renderer) -> TypeGuard[Planar | Splat]:
    """Whether a page can draw what a renderer draws."""
    return isinstance(renderer, Splat | Planar)


def asset(name: str) -> str:
    """A file of the page's sources."""
    return (files("glassplat") / "web_page" / name).read_text(encoding="utf-8")


def filled(template: str, values: dict[str, str]) -> str:
    """The template with each {{name}} replaced; what is put in is not looked at again."""
    parts = template.split("{{")
    text = [parts[0]]
    for part in parts[1:]:
        name, _, rest = part.partition("}}")
        text += [values[name], rest]
    return "".join(text)


def in_script(value: Any) -> str:
    """JSON that may stand inside a script: nothing in it ends one."""
    return json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def in_base64(data: bytes) -> str:
    """Bytes as text."""
    return base64.b64encode(data).decode("ascii")


def drawn(gaussians: Gaussians) -> Gaussians:
    """Those that can be seen at all."""
    return gaussians.select(torch.sigmoid(gaussians.logit_opacities) > LEAST_OPACITY)


def poster_camera(camera: Camera) -> Camera:
    """The camera, small enough for the picture that is shown while the scene is unpacked."""
    share = min(1.0, POSTER_WIDTH / camera.width)
    return camera.resized(max(1, round(share * camera.width)), max(1, round(share * camera.height)))


def jpeg(image: Tensor) -> bytes:
    """An image [H, W, 3] in [0, 1] as JPEG."""
    stream = io.BytesIO()
    pixels = torch.round(image.clamp(0, 1) * 255).to("cpu", torch.uint8).numpy()
    Image.fromarray(pixels).save(stream, "JPEG", quality=POSTER_QUALITY, optimize=True)
    return stream.getvalue()


def channel_bytes(scene: Scene) -> tuple[bytes, list[float]]:
    """Intensities of the primary Gaussians, marks of the glass and the pane that it is part of; and lowest and step."""
    logs = scene.primary.channels.get("log_intensity", torch.zeros(len(scene.primary)))
    low, high = (float(logs.min()), float(logs.max())) if len(logs) else (0.0, 0.0)
    step = (high - low) / 255
    intensities = torch.round((logs - low) / (step or 1)).clamp(0, 255)
    marks = torch.round(255 * torch.sigmoid(scene.glass.channels["logit_mark"]))
    owners = glass_owners(scene.glass, scene.planes) if len(scene.planes) else torch.zeros(len(scene.glass))
    parts = [part.to(torch.uint8).numpy().tobytes() for part in (intensities, marks, owners)]
    return b"".join(parts), [low, step]


def described(
    scene: Scene, renderer: Planar | Splat, cameras: Sequence[tuple[str, Camera]], first: int
) -> dict[str, Any]:
    """What the page has to know beside the Gaussians."""
    survey = surveyed([camera for _, camera in cameras], scene.extent)
    kept = sorted({*range(0, len(cameras), -(-len(cameras) // MOST_VIEWS)), first})
    return {
        "background": list(renderer.background),
        "fresnel": renderer.fresnel if isinstance(renderer, Planar) else "none",
        "blend": renderer.blend if isinstance(renderer, Planar) else "srgb",
        "intensity": isinstance(renderer, Planar) and renderer.intensity,
        "near": NEAR_PER_EXTENT * scene.extent,
        "panes": [described_pane(scene.planes, index) for index in range(len(scene.planes))],
        "views": [described_view(*cameras[index]) for index in kept],
        "first": kept.index(first),
        "focus": in_page(survey.focus),
        "up": in_page(survey.up),
        "reach": survey.reach,
    }


def described_pane(planes: Planes, index: int) -> dict[str, Any]:
    """One pane in the page's world."""
    tangents, bitangents = planes.axes()
    return {
        "label": int(planes.labels[index]),
        "mirror": planes.labels[index] in planes.mirrors,
        "center": in_page(planes.centers[index]),
        "normal": in_page(planes.normals[index]),
        "tangent": in_page(tangents[index]),
        "bitangent": in_page(bitangents[index]),
        "half": planes.half_sizes[index].tolist(),
        "reflectance": float(planes.base_reflectances[index]),
        "transmittance": [1, 1, 1] if planes.transmittances is None else planes.transmittances[index].tolist(),
    }


def described_view(name: str, camera: Camera) -> dict[str, Any]:
    """One photograph's camera in the page's world; the rotation by rows."""
    rotation = camera.cam_from_world[:3, :3].cpu() * torch.tensor(FLIP)
    return {
        "name": name,
        "rotation": [round(value, 6) for value in rotation.flatten().tolist()],
        "position": in_page(camera.center),
        "fx": camera.fx,
        "fy": camera.fy,
        "width": camera.width,
        "height": camera.height,
    }


def in_page(vector: Tensor) -> list[float]:
    """A point or a direction [3] of the capture in the page's world."""
    turned: list[float] = (vector.detach().cpu().double().numpy() * np.asarray(FLIP)).tolist()
    return turned
