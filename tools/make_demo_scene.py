"""Makes the bundled demo scene: a shop window full of curiosities, which reflects a sunlit street.

    pip install -e '.[scenes]'
    python -m tools.make_demo_scene --output glassplat/demo_scene

All surfaces are matte, with path-traced light stored at vertices, so that radiance does not depend on the view and
images have no noise. A photograph is (1 - strength) * transmission + strength * reflection in linear radiance, with
Fresnel's law for a thin pane. Shapes are in `tools/demo_things.py`, textures in `tools/demo_paint.py`, lighting in
`tools/demo_light.py`.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import tyro
from numpy.typing import NDArray
from PIL import Image

from tools.demo_things import BOTTOM, FAR, LEFT, REFRACTION, RIGHT, TOP
from tools.make_pane_scene import (
    POINT_NOISE,
    TEST_EVERY,
    VIRTUAL_IN_GLASS,
    picture,
    random_rays,
    whole_labels,
    write_colmap,
)
from tools.make_scenes import as_bytes, srgb_from_linear
from tools.pane_draws import world_from_cam
from tools.pane_things import camera_rays
from tools.pane_tracer import Array, Seen, reflectance

MOST_BYTES = 8_000_000
FOCAL_PER_WIDTH = 0.9
AWAY_EVERY = 6
"""Every sixth view shows the street instead of the pane."""
EXPOSURE = 1.2
PHOTOGRAPH, LAYER = 83, 93
"""JPEG qualities."""

README = """\
# The demo scene

A shop window full of curiosities, in which a sunlit street is mirrored: {views} views of {width}x{height} pixels, with
path-traced light. Shapes, pictures and light were made for this project, by `tools/make_demo_scene.py`, and are
licensed with it (Apache-2.0). It shows the layout that `glassplat train` reads:

| | |
|---|---|
| `images/` | the photographs |
| `sparse/0/` | the COLMAP text model: cameras, poses, points |
| `panes/` | the pane in {masks} of the views; a pixel is the label of its pane, 0 where there is none |
| `gt/` | the exact layers of the test views, every {every}th by name; used by `eval` only, a real capture has none |
"""


@dataclass(frozen=True)
class Arguments:
    """Options of the scene: lighting and photographs."""

    output: Path
    """Folder to write; must not exist yet."""
    width: int = 640
    """Width of the photographs in pixels; the height is three quarters of it."""
    views: int = 64
    """Photographs; every eighth is a test view."""
    masks: int = 8
    """Annotated training views."""
    points: int = 6000
    """Sparse points."""
    paths: int = 200
    """Light paths per vertex."""
    rays: int = 3
    """Rays per pixel and axis."""
    light: Path | None = None
    """Cache file of the lighting, for rendering the same scene again."""


class Lit(Protocol):
    """A scene that can be ray-traced; see `tools.demo_light.LitScene`."""

    def seen(self, origins: Array, directions: Array) -> Seen:
        """Traces rays [N, 3] with unit directions."""
        ...


def camera_poses(views: int) -> list[Array]:
    """Camera-to-world [4, 4] of all views: x right, y down, z forward."""
    generator, made = np.random.default_rng(4), []
    for number in range(views):
        side = 2 * ((number * 0.618) % 1) - 1
        if number % AWAY_EVERY == AWAY_EVERY - 1:
            place = np.array([1.6 * side, -generator.uniform(0.5, 1.6), generator.uniform(1.3, 1.7)])
            target = np.array([3.2 * side + generator.uniform(-1.5, 1.5), FAR, generator.uniform(1.2, 2.6)])
        else:
            place = np.array([1.9 * side, -generator.uniform(1.25, 2.9), generator.uniform(1.05, 1.75)])
            target = np.array([generator.uniform(-0.5, 0.5) + 0.25 * side, 0.35, generator.uniform(1.1, 1.35)])
        made.append(world_from_cam(place, target))
    return made


def view(lit: Lit, pose: Array, width: int, rays: int) -> dict[str, Array]:
    """Layers of a view, [H, W, ...] each, averaged over the rays of each pixel."""
    height = width * 3 // 4
    directions = camera_rays(width, height, rays, FOCAL_PER_WIDTH) @ pose[:3, :3].T
    seen = lit.seen(np.broadcast_to(pose[:3, 3], directions.shape), directions)
    labels = seen.label.reshape(height, width, rays**2)
    layers = {
        name: getattr(seen, name).reshape(height, width, rays**2, -1).mean(axis=2)
        for name in ("radiance", "transmission", "reflection", "strength")
    }
    # At the edge of the pane, average over the rays that hit it.
    layers["reflection"] /= np.maximum((labels > 0).mean(axis=2), 1e-9)[..., None]
    return layers | {"label": labels[:, :, rays**2 // 2], "whole": whole_labels(labels)}


def save_jpeg(path: Path, linear: Array, quality: int) -> None:
    """Writes an image without chroma subsampling, because reflections often differ from the transmission by colour."""
    Image.fromarray(picture(linear[:, :, None])).save(path, quality=quality, subsampling=0, optimize=True)


def annotated_views(layers: list[Array], masks: int) -> set[int]:
    """Indices of the training views that get a mask, evenly spaced among those that show a large part of the pane."""
    shown = [n for n, label in enumerate(layers) if n % TEST_EVERY and label.mean() > 0.15]
    return {shown[index] for index in np.linspace(0, len(shown) - 1, masks).astype(int)}


def sparse_points(lit: Lit, poses: list[Array], count: int) -> tuple[Array, NDArray[np.uint8]]:
    """Positions and colours [P, 3] of points hit by random rays, some of them mirrored, as in structure from motion."""
    generator = np.random.default_rng(0)
    origins, directions = random_rays(poses, count, generator)
    seen = lit.seen(origins, directions)
    colors, length = seen.transmission.copy(), seen.distance.copy()
    virtual = (seen.label > 0) & (generator.random(count) < VIRTUAL_IN_GLASS)
    place = origins[virtual] + seen.to_pane[virtual, None] * directions[virtual]
    beyond = lit.seen(place - [0, 1e-4, 0], directions[virtual] * [1, -1, 1])
    # Virtual points: straight on behind the pane, at the length of the reflected path.
    colors[virtual], length[virtual] = beyond.transmission, seen.to_pane[virtual] + beyond.distance
    kept = np.isfinite(length)
    positions = origins[kept] + length[kept, None] * directions[kept]
    noise = generator.normal(scale=POINT_NOISE, size=positions.shape)
    return positions + noise, as_bytes(srgb_from_linear(np.clip(colors[kept], 0, 1)))


def write_truth(folder: Path, name: str, layers: dict[str, Array]) -> None:
    """Writes the layers of a test view, the reflectance of the pane, and its mask."""
    save_jpeg(folder / "trans" / f"{name}.jpg", layers["transmission"], LAYER)
    save_jpeg(folder / "refl" / f"{name}.jpg", layers["reflection"], LAYER)
    strength = np.round(65535 * layers["strength"][..., 0]).astype(np.uint16)
    Image.fromarray(strength).save(folder / "strength" / f"{name}.png", optimize=True)
    Image.fromarray(layers["whole"]).save(folder / "strength" / f"{name}_pane.png", optimize=True)


def write_plane(path: Path) -> None:
    """Writes the true plane of the pane."""
    entry = {
        "label": 1,
        "center": [(LEFT + RIGHT) / 2, 0.0, (BOTTOM + TOP) / 2],
        "normal": [0.0, -1.0, 0.0],
        "half_u": [(RIGHT - LEFT) / 2, 0.0, 0.0],
        "half_v": [0.0, 0.0, (TOP - BOTTOM) / 2],
        "mirror": False,
        "base_reflectance": float(reflectance(1.0, REFRACTION)),
    }
    path.write_text(json.dumps([entry], indent=1) + "\n")


def main(arguments: Arguments) -> None:
    """Makes the scene; raises ValueError if it is too large to bundle."""
    from tools.demo_light import LitScene

    folder = arguments.output
    if folder.exists():
        raise FileExistsError(f"{folder} exists; expected a new folder, so remove it first")
    lit = LitScene(arguments.paths, EXPOSURE, arguments.light)
    poses, begun = camera_poses(arguments.views), time.monotonic()
    for part in ("images", "panes", "gt/trans", "gt/refl", "gt/strength"):
        (folder / part).mkdir(parents=True)
    labels = []
    for number, pose in enumerate(poses):
        layers = view(lit, pose, arguments.width, arguments.rays)
        save_jpeg(folder / "images" / f"{number:04d}.jpg", layers["radiance"], PHOTOGRAPH)
        labels.append(layers["label"])
        if number % TEST_EVERY == 0:
            write_truth(folder / "gt", f"{number:04d}", layers)
        print(f"\rviews {number + 1}/{len(poses)}, {time.monotonic() - begun:.0f} s ", end="", flush=True)
    print()
    for number in annotated_views(labels, arguments.masks):
        Image.fromarray(labels[number]).save(folder / "panes" / f"{number:04d}.png", optimize=True)
    (folder / "sparse/0").mkdir(parents=True)
    names = [f"{number:04d}.jpg" for number in range(len(poses))]
    points = sparse_points(lit, poses, arguments.points)
    write_colmap(folder / "sparse/0", arguments.width, FOCAL_PER_WIDTH, dict(zip(names, poses, strict=True)), points)
    write_plane(folder / "gt/planes.json")
    size = {"width": arguments.width, "height": arguments.width * 3 // 4}
    counts = {"views": arguments.views, "masks": arguments.masks, "every": TEST_EVERY}
    (folder / "README.md").write_text(README.format(**size, **counts))
    total = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    print(f"{folder}: {total / 1e6:.1f} MB")
    if total > MOST_BYTES:
        raise ValueError(f"the scene takes {total} bytes; expected at most {MOST_BYTES}, so choose a smaller --width")


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
