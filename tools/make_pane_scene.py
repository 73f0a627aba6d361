"""Renders a capture of a room with free-standing panes, with cameras all around and exact layers.

    python -m tools.make_pane_scene --output scenes/screens
    python -m tools.make_pane_scene --output scenes/room-1 --drawn 1

The default scene `screens` has two panes of glass, of which one leans and is visible through the other, between
objects, and a mirror on a wall. `--drawn` makes random scenes (`tools/pane_draws.py`); `--window` and `--case` make the
other named scenes (`tools/pane_places.py`). docs/scenes.md describes the files. No extra dependencies are needed.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import maximum_filter
from scipy.spatial.transform import Rotation

from tools.make_scenes import as_bytes, srgb_from_linear
from tools.pane_draws import PREVIEW, DrawnPlace, draw_place
from tools.pane_places import (
    case_place,
    case_poses,
    passer_by,
    photographer,
    screens_place,
    screens_poses,
    window_place,
    window_poses,
)
from tools.pane_things import FOCAL_PER_WIDTH, SUBPIXELS, Box, Pane, Place, SecondPane
from tools.pane_tracer import Array, Seen

TEST_EVERY = 8
POINT_NOISE = 0.005
"""Standard deviation of the sparse points from the surfaces, world units."""
GAP = 0.02
"""Distance between the two panes of double glazing, world units."""
PASSERS, SENSOR = 77, 78
"""Keys that separate the random streams of passers-by and of sensor noise from all others."""
VIRTUAL_IN_GLASS, VIRTUAL_IN_MIRROR = 0.4, 1.0
"""Share of the sparse points seen in a pane that lie at mirrored positions, as structure from motion finds them."""


@dataclass(frozen=True)
class Arguments:
    """Options of the ray-traced scene."""

    output: Path
    """Folder to write; must not exist yet."""
    width: int = 256
    """Width of the photographs in pixels; the height is three quarters of it."""
    views: int = 96
    """Photographs; every eighth is a test view."""
    noise: float = 0.0
    """Standard deviation of the sensor noise in photographs, in units of 1/255."""
    masks: int = 8
    """Annotated training views."""
    points: int = 6000
    """Sparse points."""
    seed: int = 0
    """Random seed of cameras and points of `screens`, `window` and `case`."""
    drawn: int | None = None
    """Seed of a random scene instead of `screens`, and of everything random in it."""
    window: bool = False
    """Make a large window of a dark case, photographed from the front, instead of `screens`."""
    case: bool = False
    """Make a silver bowl in a case with a glass front and a mirrored back, instead of `screens`."""
    passers_by: float = 0.0
    """Share of the training views with a person in the room, each at another position."""
    photographer: bool = False
    """Add a photographer behind the camera, holding a phone, who is reflected in panes and mirrors."""
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Transmittance of the glass for red, green and blue, applied to the light that is not reflected."""
    second_pane: float | None = None
    """Make double glazing: a second pane behind each pane, tilted against it by this many degrees."""

    @property
    def any_seed(self) -> int:
        """Seed of everything random."""
        return self.seed if self.drawn is None else self.drawn


def picture(radiance: Array, noise: Array | float = 0.0) -> NDArray[np.uint8]:
    """sRGB [H, W, 3] of the radiance [H, W, S, 3] of the rays in each pixel, clipped at white."""
    return as_bytes(srgb_from_linear(np.clip(radiance.mean(axis=2), 0, 1)) + noise)


def whole_labels(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """[H, W] label shared by all rays of a pixel, else 0."""
    return np.where(labels.min(axis=2) == labels.max(axis=2), labels[:, :, 0], 0).astype(np.uint8)


def write_photograph(arguments: Arguments, number: int, seen: Seen, *, annotated: bool) -> None:
    """Writes a photograph, with its mask if it is annotated."""
    name = view_name(number)
    generator = np.random.default_rng([arguments.any_seed, number, SENSOR])
    noise = generator.normal(scale=arguments.noise / 255, size=(*seen.radiance.shape[:2], 3))
    Image.fromarray(picture(seen.radiance, noise)).save(arguments.output / "images" / name)
    if annotated:
        Image.fromarray(seen.label[:, :, SUBPIXELS**2 // 2]).save(arguments.output / "panes" / name)


def write_layers(folder: Path, name: str, seen: Seen) -> None:
    """Writes transmission and reflection of a test view."""
    for part in ("trans", "refl"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture(seen.transmission)).save(folder / "trans" / name)
    # At the edge of a pane, average over the rays that hit it.
    share = np.maximum((seen.label > 0).mean(axis=2), 1e-9)[..., None, None]
    Image.fromarray(picture(seen.reflection / share)).save(folder / "refl" / name)


def write_strength(folder: Path, name: str, seen: Seen) -> None:
    """Writes reflectance and masks of the panes of a test view."""
    strength = np.round(65535 * seen.strength.mean(axis=2)).astype(np.uint16)
    Image.fromarray(strength).save(folder / name)
    Image.fromarray(whole_labels(seen.label)).save(folder / name.replace(".png", "_pane.png"))


def write_surface(folder: Path, name: str, normals: Array) -> None:
    """Writes coverage and normals of silver objects, seen directly or through panes; writes nothing if none is visible.

    Args:
        folder: folder of the photographs.
        name: file name of the photograph.
        normals: [H, W, S, 3] normals at the ends of its rays, 0 for rays that do not end on silver.
    """
    share = (np.linalg.norm(normals, axis=-1) > 0).mean(axis=2)
    mean = normals.sum(axis=2) / np.maximum(np.linalg.norm(normals.sum(axis=2), axis=-1, keepdims=True), 1e-9)
    stem = Path(name).stem
    Image.fromarray(as_bytes(np.dstack([(mean + 1) / 2, share]))).save(folder / f"{stem}_normal.png")
    Image.fromarray(as_bytes(share)).save(folder / f"{stem}_strength.png")


def random_rays(poses: list[Array], count: int, generator: np.random.Generator) -> tuple[Array, Array]:
    """Origins and unit directions [N, 3] of rays through random pixels of random views."""
    eyes = np.stack(poses)[generator.integers(len(poses), size=count)]
    rays = np.concatenate([generator.uniform(-0.55, 0.55, (count, 2)) * [1, 0.75], np.ones((count, 1))], axis=1)
    directions = np.einsum("nij,nj->ni", eyes[:, :3, :3], rays)
    return eyes[:, :3, 3].copy(), directions / np.linalg.norm(directions, axis=1, keepdims=True)


def sparse_points(place: Place, poses: list[Array], count: int, seed: int) -> tuple[Array, NDArray[np.uint8]]:
    """Positions and colours [P, 3] of surface points hit by random camera rays, some of them mirrored."""
    generator = np.random.default_rng(seed)
    origins, directions = random_rays(poses, count, generator)
    bare, shown = place.without_panes(), place.seen(origins, directions)
    met = bare.seen(origins, directions)
    colors, length = met.radiance.copy(), met.distance.copy()
    kept = has_features(met)
    for pane in place.panes:
        share = VIRTUAL_IN_GLASS if pane.refraction else VIRTUAL_IN_MIRROR
        chosen = (shown.label == pane.label) & (generator.random(count) < share)
        along = directions[chosen] @ pane.normal
        points = origins[chosen] + shown.to_pane[chosen, None] * directions[chosen]
        beyond = bare.seen(points, directions[chosen] - 2 * along[:, None] * pane.normal)
        colors[chosen], kept[chosen] = beyond.radiance, has_features(beyond)
        # Virtual points: straight on behind the pane, at the length of the reflected path.
        length[chosen] = shown.to_pane[chosen] + beyond.distance
    noise = generator.normal(scale=POINT_NOISE, size=(count, 3))
    positions = origins + length[:, None] * directions + noise
    return positions[kept], as_bytes(srgb_from_linear(np.clip(colors[kept], 0, 1)))


def has_features(seen: Seen) -> NDArray[np.bool_]:
    """[N] bool: rays that give SfM points; not those on silver, where points slide, nor clipped ones."""
    return ~seen.normal.any(axis=1) & (seen.radiance < 1).any(axis=1)


def write_colmap(
    folder: Path, width: int, focal_per_width: float, poses: Mapping[str, Array], points: tuple[Array, Array]
) -> None:
    """Writes a COLMAP text model of one pinhole camera with images of aspect ratio 4:3.

    Args:
        folder: output folder.
        width: width of the images, pixels.
        focal_per_width: focal length, as a share of the width.
        poses: camera-to-world [4, 4] by name of the photograph.
        points: positions and colours [P, 3].
    """
    height, focal = width * 3 // 4, focal_per_width * width
    (folder / "cameras.txt").write_text(f"1 PINHOLE {width} {height} {focal} {focal} {width / 2} {height / 2}\n")
    lines = []
    for number, (name, pose) in enumerate(poses.items(), start=1):
        inverse = np.linalg.inv(pose)
        x, y, z, w = Rotation.from_matrix(inverse[:3, :3]).as_quat()
        values = " ".join(f"{value:.9f}" for value in (w, x, y, z, *inverse[:3, 3]))
        lines.append(f"{number} {values} 1 {name}\n\n")
    (folder / "images.txt").write_text("".join(lines))
    rows = [
        f"{number + 1} {x:.6f} {y:.6f} {z:.6f} {r} {g} {b} 0.5\n"
        for number, ((x, y, z), (r, g, b)) in enumerate(zip(*points, strict=True))
    ]
    (folder / "points3D.txt").write_text("".join(rows))


def write_planes(path: Path, place: Place) -> None:
    """Writes the true planes of the panes."""
    entries = [
        {
            "label": pane.label,
            "center": pane.center.tolist(),
            "normal": pane.normal.tolist(),
            "half_u": (pane.half_sizes[0] * pane.tangent).tolist(),
            "half_v": (pane.half_sizes[1] * pane.bitangent).tolist(),
            "mirror": pane.refraction is None,
            "base_reflectance": pane.base_reflectance,
            "tint": list(pane.tint),
        }
        for pane in place.panes
    ]
    path.write_text(json.dumps(entries, indent=1) + "\n")


def write_rectangles(path: Path, place: Place) -> None:
    """Writes the panes as marked by hand, for panes that are visible only through others."""
    entries = [
        {
            "label": pane.label,
            "center": pane.center.tolist(),
            "normal": pane.normal.tolist(),
            "tangent": pane.tangent.tolist(),
            "half_sizes": list(pane.half_sizes),
            "mirror": pane.refraction is None,
        }
        for pane in place.panes
    ]
    path.write_text(json.dumps(entries, indent=1) + "\n")


def view_name(number: int) -> str:
    """File name of a photograph."""
    return f"{number:04d}.png"


def annotated_views(place: Place, poses: list[Array], masks: int) -> set[int]:
    """Indices of the training views that get a mask, in which every pane is marked.

    They are chosen greedily, each for the pane that the masks show least often so far. Among the third of the views in
    which this pane is largest, the one farthest from those already chosen is taken.
    """
    training = [number for number in range(len(poses)) if number % TEST_EVERY]
    labels = np.stack([place.view(poses[number], *PREVIEW).label for number in training])
    sizes = np.stack([(labels == pane.label).sum(axis=(1, 2, 3)) for pane in place.panes], axis=1)
    centers = np.stack([poses[number][:3, 3] for number in training])
    chosen: list[int] = []
    for _ in range(masks):
        shown = (4 * sizes[chosen] > sizes.max(axis=0)).sum(axis=0)
        of_pane = sizes[:, shown.argmin()]
        largest = [view for view in np.argsort(-of_pane, kind="stable")[: len(training) // 3] if of_pane[view]]
        apart = [min([np.linalg.norm(centers[view] - centers[c]) for c in chosen], default=0.0) for view in largest]
        chosen.append(int(largest[int(np.argmax(apart))]))
    return {training[index] for index in chosen}


def with_passer_by(arguments: Arguments, place: Place, number: int, pose: Array) -> Place:
    """The scene at the time of a photograph, with a passer-by or without."""
    generator = np.random.default_rng([arguments.seed, number, PASSERS])
    if generator.random() >= arguments.passers_by:
        return place
    room = next(thing for thing in place.things if isinstance(thing, Box) and thing.room)
    return replace(place, things=(*place.things, *passer_by(room, pose[:3, 3], generator)))


def write_difference(path: Path, picture: NDArray[np.uint8], other: NDArray[np.uint8]) -> None:
    """Writes a mask of the pixels in which two images differ by more than rounding, dilated by one pixel."""
    path.parent.mkdir(parents=True, exist_ok=True)
    differs = np.abs(picture.astype(int) - other).max(axis=2) > 2
    mask = maximum_filter(255 * differs.astype(np.uint8), 3)
    Image.fromarray(mask).save(path)


def write_view(arguments: Arguments, place: Place, number: int, pose: Array, *, annotated: bool) -> None:
    """Writes all files of a view; the true layers exclude the photographer, and a second set includes them."""
    folder, name, size = arguments.output, view_name(number), (arguments.width, arguments.width * 3 // 4)
    peopled = replace(place, photographer=photographer(pose)) if arguments.photographer else place
    seen = peopled.view(pose, *size)
    if number % TEST_EVERY:
        passed = with_passer_by(arguments, peopled, number, pose)
        if passed is not peopled:
            alone, seen = seen, passed.view(pose, *size)
            write_difference(folder / "gt/passers_by" / name, picture(seen.radiance), picture(alone.radiance))
    write_photograph(arguments, number, seen, annotated=annotated)
    if number % TEST_EVERY:
        return
    write_strength(folder / "gt/strength", name, seen)
    if place.silver:
        write_surface(folder / "images", name, seen.normal)
    write_layers(folder / "gt", name, place.view(pose, *size) if arguments.photographer else seen)
    if arguments.photographer:
        write_layers(folder / "gt/with_photographer", name, seen)


def chosen_place(arguments: Arguments) -> DrawnPlace:
    """The scene and its camera poses."""
    if arguments.drawn is not None:
        return draw_place(arguments.drawn, arguments.views)
    if arguments.window:
        return DrawnPlace(window_place(), window_poses(arguments.views, arguments.seed))
    if arguments.case:
        return DrawnPlace(case_place(), case_poses(arguments.views, arguments.seed))
    return DrawnPlace(screens_place(), screens_poses(arguments.views, arguments.seed))


def with_glass(place: Place, arguments: Arguments) -> Place:
    """The scene with the tint and double glazing of the options; mirrors stay unchanged."""
    return replace(place, panes=tuple(flawed(p, arguments) if p.refraction else p for p in place.panes))


def flawed(pane: Pane, arguments: Arguments) -> Pane:
    """A pane with the tint and second pane of the options."""
    tilt = arguments.second_pane
    second = None if tilt is None else SecondPane(GAP, math.radians(tilt))
    return replace(pane, tint=arguments.tint, second=second)


def main(arguments: Arguments) -> None:
    """Renders and writes the scene."""
    folder = arguments.output
    if arguments.drawn is not None and arguments.passers_by:
        raise ValueError("random scenes have no passers-by; leave out --passers-by or --drawn")
    if folder.exists():
        raise FileExistsError(f"{folder} exists; expected a new folder, so remove it first")
    for part in ("images", "panes", "sparse/0", "gt/strength"):
        (folder / part).mkdir(parents=True)
    drawn = chosen_place(arguments)
    print(folder.name, drawn.words, flush=True)
    place, poses = with_glass(drawn.place, arguments), drawn.poses
    named = {view_name(number): pose for number, pose in enumerate(poses)}
    points = sparse_points(place, poses, arguments.points, arguments.any_seed)
    write_colmap(folder / "sparse/0", arguments.width, FOCAL_PER_WIDTH, named, points)
    write_planes(folder / "gt/planes.json", place)
    if arguments.case:
        write_rectangles(folder / "planes.json", place)
    annotated, started = annotated_views(place, poses, arguments.masks), time.monotonic()
    for number, pose in enumerate(poses):
        write_view(arguments, place, number, pose, annotated=number in annotated)
        print(f"\r{folder.name} {number + 1}/{len(poses)}, {time.monotonic() - started:.0f} s", end="", flush=True)
    print()


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
