"""Export of a scene as a self-contained HTML file with interactive panes, which needs no server.

The page's world is that of its embedded SPZ file, with y and z negated. Script and shaders are in `web_page/` and are
embedded verbatim.
"""

from __future__ import annotations

import base64
import gzip
import html
import io
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from glassplat.errors import InputError, count_noun
from glassplat.files.spz import HALF_TURN_X, spz_bytes
from glassplat.files.writing import write_bytes, write_text
from glassplat.kernels.environment import cube_lookup
from glassplat.render.frame import NEAR_PER_EXTENT, Renderer
from glassplat.render.layers import contributions
from glassplat.render.panes import nearest_hits, panes_in_camera
from glassplat.render.traced import traced_colors
from glassplat.scene.camera import Camera
from glassplat.scene.corrections import estimate_up
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.panes import Planes, nearest_panes
from glassplat.scene.scene import Scene, scale_scene, without_glass

CAMERA_COUNT = 24
WIDTH, HEIGHT = 960, 640
FOV_RAD = math.radians(50)
ELEVATION = 0.25
"""Height of the cameras above the middle, as a share of the radius of their circle."""
INNER_SHARE = 0.96
"""Share of the Gaussians, the inner ones, that the images should contain."""
MOST_SAMPLED = 200_000
DISTANCE_FACTOR = 1.15


def cameras_around(gaussians: Gaussians, up: Tensor) -> list[tuple[str, Camera]]:
    """Named cameras on a circle, facing the middle of the scene.

    Args:
        gaussians: at least one, all finite; on any device. The cameras are on the CPU.
        up: [3] away from the ground.
    """
    middle, radius = bounding_ball(gaussians)
    middle, up = middle.cpu(), torch.nn.functional.normalize(up.double().cpu(), dim=0)
    aside = torch.nn.functional.normalize(torch.linalg.cross(up, least_aligned_axis(up)), dim=0)
    ahead = torch.linalg.cross(up, aside)
    distance = DISTANCE_FACTOR * radius / math.tan(FOV_RAD / 2)
    cameras = []
    for index in range(CAMERA_COUNT):
        angle = 2 * math.pi * index / CAMERA_COUNT
        arm = math.cos(angle) * ahead + math.sin(angle) * aside + ELEVATION * up
        eye = middle + distance * arm
        camera = Camera.look_at(eye, middle, up=up, fov_rad=FOV_RAD, width=WIDTH, height=HEIGHT)
        cameras.append((f"{index:03d}.png", camera))
    return cameras


def bounding_ball(gaussians: Gaussians) -> tuple[Tensor, float]:
    """Centre [3] and radius of a ball around the inner Gaussians, without those of opacity below 0.5 if any is above.

    Raises:
        InputError: there are no Gaussians.
    """
    if not len(gaussians):
        raise InputError("the scene has no Gaussians; expected at least one, or cameras of the capture")
    means = gaussians.means.double()
    seen = gaussians.logit_opacities > 0
    means = means[seen] if bool(seen.any()) else means
    means = means[:: max(1, len(means) // MOST_SAMPLED)]
    rest = (1 - INNER_SHARE) / 2
    middle = (means.quantile(rest, dim=0) + means.quantile(1 - rest, dim=0)) / 2
    distances = (means - middle).norm(dim=1)
    return middle, max(float(distances.quantile(INNER_SHARE)), 1e-6)


def least_aligned_axis(up: Tensor) -> Tensor:
    """The coordinate axis with the largest angle to a direction."""
    return torch.eye(3, dtype=up.dtype)[int(up.abs().argmin())]


MIDDLE_WEIGHT = 0.02
"""Weight of a point in front of the cameras when intersecting their sight lines, which may be parallel."""
REACH_IN_SPACINGS, REACH_PER_DISTANCE = 2.5, 0.12
"""Reach around photographs: the larger of a multiple of their spacing and a share of the distance to the focus."""
FULL_SHARE = 0.55
"""Share of the image that panes should fill in the first view."""


class CaptureSurvey(NamedTuple):
    """Geometry of a capture's cameras.

    Attributes:
        focus: [3] the point nearest to the sight lines of all cameras.
        up: [3] unit vector, away from the ground, as `estimate_up` finds it.
        distance: median distance of the cameras from the focus, world units.
        reach: distance from the nearest photograph up to which the scene is known, world units.
    """

    focus: Tensor
    up: Tensor
    distance: float
    reach: float


def survey_capture(cameras: Sequence[Camera], extent: float) -> CaptureSurvey:
    """Estimates focus, up direction, distance and reach from the poses of a capture.

    Args:
        cameras: at least one.
        extent: of the scene, for captures whose cameras all face the same way.
    """
    poses = torch.stack([camera.cam_from_world for camera in cameras]).double().cpu()
    centers, forward = -(poses[:, :3, :3].mT @ poses[:, :3, 3:])[..., 0], poses[:, 2, :3]
    across = torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None, :]
    ahead = centers.mean(0) + extent * forward.mean(0)
    weight = MIDDLE_WEIGHT * len(cameras)
    total = across.sum(0) + weight * torch.eye(3, dtype=torch.float64)
    focus = torch.linalg.solve(total, (across @ centers[..., None])[..., 0].sum(0) + weight * ahead)
    distance = float((centers - focus).norm(dim=1).median())
    spacing = 0.0
    if len(cameras) > 1:
        distances = torch.cdist(centers, centers) + torch.diag(
            torch.full((len(cameras),), torch.inf, dtype=torch.float64)
        )
        spacing = float(distances.amin(dim=1).median())
    reach = max(REACH_IN_SPACINGS * spacing, REACH_PER_DISTANCE * distance, 1e-6)
    return CaptureSurvey(focus, torch.tensor(estimate_up(cameras), dtype=torch.float64), distance, reach)


@torch.no_grad()
def best_view(planes: Planes, cameras: Sequence[Camera]) -> int:
    """Index of the initial camera, where panes fill about half of the image, centred; without panes the middle one."""
    if not len(planes):
        return len(cameras) // 2
    return min(range(len(cameras)), key=lambda k: _framing_score(planes, cameras[k]))


def _framing_score(planes: Planes, camera: Camera) -> float:
    """Score of a view of the panes, lower is better: by their share of the image and their distance from its centre."""
    small = camera.resize(64, max(1, round(64 * camera.height / camera.width)))
    rows, columns = (nearest_hits(panes_in_camera(planes, small), small).pane >= 0).nonzero(as_tuple=True)
    if not len(rows):
        return math.inf
    aside = math.hypot(*(float(at.double().mean()) / size - 0.5 for at, size in ((rows, small.height), (columns, 64))))
    return abs(len(rows) / (64 * small.height) - FULL_SHARE) + 2 * aside


SCRIPTS = (
    "vectors.js", "data.js", "sorter.js", "cameras.js", "graphics.js", "renderer.js", "navigation.js", "panel.js",
    "pace.js", "display.js", "main.js",
)  # fmt: skip
SHADERS = ("texels.glsl", "screen.vert", "project.frag", "splat.vert", "splat.frag", "compose.frag", "copy.frag")
CUBE_SIZE = 128
"""Maximum texels along a side of the environment map of glossy objects."""
MOST_VIEWS = 400
MOST_PANES = 24
"""Each takes eight of the 224 uniform vectors that WebGL 2 guarantees."""
MOST_GAUSSIANS = 1_000_000
"""76 MB to load. Textures of 4096 rows, which every device supports, hold 1.4 million of SH degree 3."""
RANKING_VIEWS, RANKING_WIDTH = 64, 480
"""Views by which Gaussians are ranked, and their width in pixels."""
POSTER_WIDTH, POSTER_QUALITY = 640, 70
"""Width in pixels and JPEG quality of the small image shown while the scene is decoded."""
LEAST_OPACITY = 1 / 255
DESCRIPTION = "Look around, remove the reflections from the glass, or turn it into a mirror."
DESCRIPTIONS = ("Look around a scene of Gaussians.", "Look around, and remove reflections from glossy objects.")
"""Descriptions of scenes without panes: matte ones, and those with glossy objects."""
PREVIEW = "preview.jpg"
PREVIEW_WIDTH, PREVIEW_HEIGHT = 1200, 630
"""Size that link previews request, pixels."""
DIVIDER = 3
"""Half the width of the dividing line of a preview, pixels."""


class Sharing(NamedTuple):
    """Credit and address of a page, for its text and link previews.

    Attributes:
        credit: author and licence of the scene; plain text.
        url: the page's address; link previews show the image `PREVIEW` next to it. None disables them.
    """

    credit: str = ""
    url: str | None = None


PRIVATE = Sharing()


@torch.no_grad()
def write_preview(path: Path | str, scene: Scene, renderer: Renderer, cameras: Sequence[tuple[str, Camera]]) -> None:
    """Writes the image for link previews, atomically: the first view, with panes removed in the right half.

    Args:
        path: the JPEG file.
        scene: to be shown.
        renderer: of its images.
        cameras: as of `write_page`.
    """
    view = cameras[best_view(scene.planes, [camera for _, camera in cameras])][1]
    focal = max(view.fx * PREVIEW_WIDTH / view.width, view.fy * PREVIEW_HEIGHT / view.height)
    middle = PREVIEW_WIDTH // 2
    camera = replace(
        view, fx=focal, fy=focal, cx=float(middle), cy=PREVIEW_HEIGHT / 2, width=PREVIEW_WIDTH, height=PREVIEW_HEIGHT
    )
    image = renderer(scene, camera).rgb
    if len(scene.planes):
        without_panes = renderer(without_glass(scene), camera).rgb
        image = torch.cat([image[:, :middle], without_panes[:, middle:]], dim=1)
        image[:, middle - DIVIDER : middle + DIVIDER] = 1
    write_bytes(path, jpeg_bytes(image))


def write_page(
    path: Path | str,
    scene: Scene,
    renderer: Renderer,
    cameras: Sequence[tuple[str, Camera]],
    title: str,
    *,
    sharing: Sharing = PRIVATE,
) -> None:
    """Writes the page, atomically.

    Args:
        path: the HTML file.
        scene: to be shown.
        renderer: of its images.
        cameras: of the photographs, by name; at least one. Users can move near them.
        title: of the page.
        sharing: credit and address of the page.

    Raises:
        ValueError: no camera, more panes than a page can show, or non-finite values.
    """
    write_text(path, page_text(scene, renderer, cameras, title, sharing=sharing))


def check_panes(scene: Scene) -> None:
    """Raises ValueError if a scene has more panes than a page can show."""
    if len(scene.planes) > MOST_PANES:
        raise ValueError(
            f"the scene has {len(scene.planes)} panes, and a page shows at most {MOST_PANES}; export it without panes "
            "by --layer transmission, or without a page by --formats ply spz"
        )


LEAST_EXTENT, LARGEST_EXTENT = 0.1, 30.0
"""Extents outside which a page shows the scene in other units, because SPZ holds sizes of 4.5e-5 to 379 units only."""


@torch.no_grad()
def page_text(
    scene: Scene, renderer: Renderer, cameras: Sequence[tuple[str, Camera]], title: str, *, sharing: Sharing = PRIVATE
) -> str:
    """The HTML text of the page."""
    settings = renderer.page_settings()
    if not cameras:
        raise ValueError("there are no cameras; expected at least one")
    check_panes(scene)
    kind = scene.primary.means.dtype
    cameras = [(name, replace(camera, cam_from_world=camera.cam_from_world.to(kind))) for name, camera in cameras]
    poster_view = best_view(scene.planes, [camera for _, camera in cameras])
    poster = jpeg_bytes(renderer(scene, limit_width(cameras[poster_view][1], POSTER_WIDTH)).rgb)
    scene = replace(scene, primary=visible_gaussians(scene.primary), glass=visible_gaussians(scene.glass))
    if not LEAST_EXTENT <= scene.extent <= LARGEST_EXTENT:
        factor = 1 / scene.extent
        scene, cameras = scale_scene(scene, factor), [(name, camera.scale(factor)) for name, camera in cameras]
    drawable = len(scene.primary)
    scene = select_for_page(scene, [camera for _, camera in cameras]).to("cpu")
    mirrored = settings.get("mirrored")
    cube = b"" if mirrored is None else cube_bytes(scene, settings)
    channel, channel_range = channel_bytes(scene) if mirrored is None else (strength_bytes(scene), [0.0, 0.0])
    description = describe_scene(scene, settings, cameras, poster_view)
    count = len(scene.planes)
    kept = f"{len(scene.primary):,}" + (f" of {drawable:,}" if len(scene.primary) < drawable else "")
    subtitle = f"{kept} Gaussians" + (f" · {count_noun(count, 'pane')}" if count else "")
    # Glass has no colour, but the SPZ format needs one, so a constant is used.
    sh = torch.zeros(len(scene.glass), 1, 3, dtype=torch.float32)
    glass = replace(scene.glass, sh=sh, channels={}, active_sh_degree=0)
    return fill_template(
        read_asset("page.html"),
        {
            "title": html.escape(title),
            "subtitle": html.escape(subtitle),
            "description": html.escape(DESCRIPTION if count else DESCRIPTIONS[mirrored is not None]),
            "credit": html.escape(sharing.credit),
            "preview": preview_tags(sharing.url),
            "style": read_asset("style.css"),
            "poster": base64_text(poster),
            "scene": script_json(description | {"channelRange": channel_range}),
            "primary": base64_text(spz_bytes(replace(scene.primary, channels={}))),
            "glass": base64_text(spz_bytes(glass)),
            "channel": base64_text(gzip.compress(channel, 9, mtime=0)),
            "cube": base64_text(gzip.compress(cube, 9, mtime=0)),
            "shaders": script_json({name: read_asset(name) for name in SHADERS}),
            "script": "\n".join(read_asset(name) for name in SCRIPTS),
        },
    )


def preview_tags(url: str | None) -> str:
    """HTML tags for link previews; the address may be that of the page or of its folder. Empty without an address."""
    if url is None:
        return ""
    address = urlsplit(url)
    folder = re.sub(r"/$|/[^/]*\.html?$", "", address.path, flags=re.IGNORECASE)
    image_url = address._replace(path=f"{folder}/{PREVIEW}", query="", fragment="").geturl()
    tags = {"og:url": url, "og:image": image_url, "og:image:width": PREVIEW_WIDTH, "og:image:height": PREVIEW_HEIGHT}
    return "\n".join(f'<meta property="{name}" content="{html.escape(str(value))}">' for name, value in tags.items())


def read_asset(name: str) -> str:
    """Text of a source file of the page."""
    return (files("glassplat") / "web_page" / name).read_text(encoding="utf-8")


def fill_template(template: str, values: dict[str, str]) -> str:
    """The template with each {{name}} replaced; inserted values are not expanded."""
    parts = template.split("{{")
    text = [parts[0]]
    for part in parts[1:]:
        name, _, rest = part.partition("}}")
        text += [values[name], rest]
    return "".join(text)


def script_json(value: Any) -> str:
    """JSON escaped so that it cannot close the surrounding script element."""
    return json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def base64_text(data: bytes) -> str:
    """Bytes as base64 text."""
    return base64.b64encode(data).decode("ascii")


def visible_gaussians(gaussians: Gaussians) -> Gaussians:
    """Gaussians with an opacity above `LEAST_OPACITY`."""
    return gaussians.select(torch.sigmoid(gaussians.logit_opacities) > LEAST_OPACITY)


def fits_page(scene: Scene) -> bool:
    """Return whether a page can show all visible Gaussians."""
    return len(visible_gaussians(scene.primary)) + len(visible_gaussians(scene.glass)) <= MOST_GAUSSIANS


def select_for_page(scene: Scene, cameras: Sequence[Camera]) -> Scene:
    """The scene with as many primary Gaussians as a page can show: those that contribute most to any photograph."""
    room = max(MOST_GAUSSIANS - len(scene.glass), 0)
    if len(scene.primary) <= room:
        return scene
    most = scene.primary.means.new_zeros(len(scene.primary))
    for camera in cameras[:: -(-len(cameras) // RANKING_VIEWS)]:
        most = torch.maximum(most, contributions(scene, limit_width(camera, RANKING_WIDTH)))
    kept = torch.zeros(len(scene.primary), dtype=torch.bool, device=most.device)
    kept[torch.topk(most, room).indices] = True
    return replace(scene, primary=scene.primary.select(kept))


def limit_width(camera: Camera, most: int) -> Camera:
    """The camera resized to at most this width, in pixels."""
    width = min(most, camera.width)
    return camera.resize(width, max(1, round(width * camera.height / camera.width)))


def jpeg_bytes(image: Tensor, quality: int = POSTER_QUALITY) -> bytes:
    """An image [H, W, 3] in [0, 1] as JPEG."""
    stream = io.BytesIO()
    pixels = torch.round(image.clamp(0, 1) * 255).to("cpu", torch.uint8).numpy()
    Image.fromarray(pixels).save(stream, "JPEG", quality=quality, optimize=True)
    return stream.getvalue()


def channel_bytes(scene: Scene) -> tuple[bytes, list[float]]:
    """Intensities of the primary Gaussians, marks and pane indices of the glass; and [minimum, step] of intensities."""
    logs = scene.primary.channels.get("log_intensity", torch.zeros(len(scene.primary), dtype=torch.float32))
    low, high = (float(logs.min()), float(logs.max())) if len(logs) else (0.0, 0.0)
    step = (high - low) / 255
    intensities = torch.round((logs - low) / (step or 1)).clamp(0, 255)
    marks = torch.round(255 * torch.sigmoid(scene.glass.channels["logit_mark"]))
    owners = torch.zeros(len(scene.glass), dtype=torch.float32)
    if len(scene.planes):
        owners = nearest_panes(scene.glass.means, scene.planes)
    parts = [part.to(torch.uint8).numpy().tobytes() for part in (intensities, marks, owners)]
    return b"".join(parts), [low, step]


def strength_bytes(scene: Scene) -> bytes:
    """The reflection strength of each Gaussian, one byte each."""
    strengths = torch.round(255 * torch.sigmoid(scene.primary.channels["logit_strength"]))
    return strengths.to(torch.uint8).numpy().tobytes()


def cube_bytes(scene: Scene, settings: Mapping[str, Any]) -> bytes:
    """Environment map of glossy objects: six faces [S, S, 3] sRGB in the order and the axes of WebGL's cube maps.

    Near surroundings are rendered from the centre of the glossy objects.
    """
    near, environment = settings["mirrored"] == "near", scene.environment
    size = CUBE_SIZE if near else min(environment.size, CUBE_SIZE)
    directions = cube_directions(size).reshape(-1, 3) * torch.tensor(HALF_TURN_X, dtype=torch.float32)
    directions = directions.to(scene.primary.means)
    if near and len(scene.surroundings):
        weights = torch.sigmoid(scene.primary.logit_opacities) * torch.sigmoid(scene.primary.channels["logit_strength"])
        middle = (weights[:, None] * scene.primary.means).sum(0) / weights.sum()
        origins = middle.expand_as(directions).contiguous()
        colors = traced_colors(scene, origins, directions, NEAR_PER_EXTENT * scene.extent, settings["background"])
    else:
        colors = torch.sigmoid(cube_lookup(environment.raw, directions))
    return torch.round(255 * colors.clamp(0, 1)).to(torch.uint8).numpy().tobytes()


def cube_directions(size: int) -> Tensor:
    """Directions [6, S, S, 3] of the texels of a cube map, in the order and the axes of WebGL."""
    centers = (2 * torch.arange(size, dtype=torch.float32) + 1) / size - 1
    t, s = torch.meshgrid(centers, centers, indexing="ij")
    one = torch.ones_like(s)
    faces = [(one, -t, -s), (-one, -t, s), (s, one, t), (s, -one, -t), (s, -t, one), (-s, -t, -one)]
    return torch.stack([torch.stack(face, dim=-1) for face in faces])


def describe_scene(
    scene: Scene, settings: Mapping[str, Any], cameras: Sequence[tuple[str, Camera]], first: int
) -> dict[str, Any]:
    """Description of the scene for the page, without the Gaussians."""
    survey = survey_capture([camera for _, camera in cameras], scene.extent)
    kept = sorted({*range(0, len(cameras), -(-len(cameras) // MOST_VIEWS)), first})
    return {
        **settings,
        "near": NEAR_PER_EXTENT * scene.extent,
        "panes": [describe_pane(scene.planes, index) for index in range(len(scene.planes))],
        "views": [describe_view(*cameras[index]) for index in kept],
        "first": kept.index(first),
        "focus": to_page_axes(survey.focus),
        "up": to_page_axes(survey.up),
        "reach": survey.reach,
    }


def describe_pane(planes: Planes, index: int) -> dict[str, Any]:
    """One pane in the page's world."""
    tangents, bitangents = planes.axes()
    return {
        "label": int(planes.labels[index]),
        "mirror": planes.labels[index] in planes.mirrors,
        "center": to_page_axes(planes.centers[index]),
        "normal": to_page_axes(planes.normals[index]),
        "tangent": to_page_axes(tangents[index]),
        "bitangent": to_page_axes(bitangents[index]),
        "half": planes.half_sizes[index].tolist(),
        "reflectance": float(planes.base_reflectances[index]),
        "transmittance": [1, 1, 1] if planes.transmittances is None else planes.transmittances[index].tolist(),
    }


def describe_view(name: str, camera: Camera) -> dict[str, Any]:
    """One photograph's camera in the page's world; the rotation by rows."""
    rotation = camera.cam_from_world[:3, :3].cpu() * torch.tensor(HALF_TURN_X, dtype=torch.float32)
    return {
        "name": name,
        "rotation": [round(value, 6) for value in rotation.flatten().tolist()],
        "position": to_page_axes(camera.center),
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "width": camera.width,
        "height": camera.height,
    }


def to_page_axes(vector: Tensor) -> list[float]:
    """A point or a direction [3] of the capture in the page's world."""
    flipped: list[float] = (vector.detach().cpu().double().numpy() * np.asarray(HALF_TURN_X)).tolist()
    return flipped
