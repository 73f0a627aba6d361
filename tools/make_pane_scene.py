"""Makes a capture of a room with free-standing panes, photographed all the way round, with exact layers.

    python -m tools.make_pane_scene --output scenes/screens
    python -m tools.make_pane_scene --output scenes/room-1 --drawn 1

`screens`: two panes of glass, one upright, one leaning, through which the other is seen, stand between things; a mirror
hangs on a wall. With `--drawn` everything is drawn by chance (`tools/pane_draws.py`); `--case` puts a silver bowl
behind glass (`tools/case_place.py`). docs/scenes.md describes the files. Needs nothing but glassplat's own
dependencies.
"""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import maximum_filter
from scipy.spatial.transform import Rotation

from tools.case_place import case_place, case_poses
from tools.make_demo_scene import TEST_EVERY, srgb_from_linear
from tools.make_scenes import GOLDEN_ANGLE_RAD, as_bytes
from tools.pane_draws import DrawnPlace, draw_place, standing_pane, world_from_cam
from tools.pane_tracer import Ball, Box, Place, Seen
from tools.photographer_body import passer_by, photographer
from tools.tracer_panes import Array, Pane, SecondPane, Waves
from tools.window_place import window_place, window_poses

LOOKED_AT = np.array([0.0, 0.1, 0.8])
ORBIT = (1.45, 1.75)
"""Least and largest distance of cameras from the vertical through `LOOKED_AT`, world units."""
HEIGHTS = (0.7, 1.7)
FOCAL_PER_WIDTH = 0.85
PREVIEW = (16, 12)
"""Width and height at which views are compared before they are rendered."""
SUBPIXELS = 3
"""Rays per pixel and axis."""
POINT_NOISE = 0.005
"""Standard deviation of the sparse points about the surfaces, world units."""
GAP = 0.02
"""Between the two panes of double glazing, world units."""
PASSERS = 77
"""Keeps what is drawn for those who walk by apart from all else."""
VIRTUAL_IN_GLASS, VIRTUAL_IN_MIRROR = 0.4, 1.0
"""Share of the sparse points seen in a pane that lie where it shows what it mirrors, as structure from motion finds."""


@dataclass(frozen=True)
class Arguments:
    """Ray-traces a room with free-standing panes."""

    output: Path
    """Folder to write; must not exist yet."""
    width: int = 256
    """Of the photographs, pixels; heights are three quarters of it."""
    views: int = 96
    """Photographs; every eighth is a test view."""
    masks: int = 5
    """Annotated training views of each pane."""
    points: int = 6000
    """Sparse points."""
    seed: int = 0
    """Of cameras and points of `screens`, `window` and `case`."""
    drawn: int | None = None
    """Seed of a place drawn by chance, to make in place of `screens`."""
    window: bool = False
    """Make a large window before a dark case, photographed from the front, in place of `screens`."""
    case: bool = False
    """Make a silver bowl in a case with a glass front and a mirrored back, in place of `screens`."""
    passers_by: float = 0.0
    """Share of the training views in which somebody stands somewhere in the room, in each elsewhere."""
    photographer: bool = False
    """Somebody stands behind the camera with a phone before the face, and is seen in panes and mirrors."""
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Share of red, green and blue light that panes of glass let through of what they do not reflect."""
    waves: float = 0.0
    """Unevenness of the glass: root of the mean square of the angles by which its normals are turned, degrees."""
    second_pane: float | None = None
    """Make the glass double: behind each pane is another, tilted by so many degrees against it."""


def make_place() -> Place:
    """The room, what is in it, and its panes."""
    things = (
        Box((-2.2, -2.2, 0.0), (2.2, 2.2, 2.6), seed=10, room=True),
        Ball((0.35, 0.15, 0.25), 0.25, seed=20),
        Ball((-0.6, -0.9, 0.3), 0.3, seed=30),
        Box((-0.95, 0.85, 0.0), (-0.6, 1.15, 0.9), seed=40),
        Box((0.85, -0.95, 0.0), (1.1, -0.7, 0.6), seed=50),
        Box((0.5, 1.05, 0.0), (0.85, 1.3, 0.5), seed=60),
    )
    return Place(
        things,
        (
            standing_pane(1, (0.0, -0.3, 0.85), turn_deg=10, lean_deg=0, half_sizes=(0.75, 0.55)),
            standing_pane(2, (0.1, 0.65, 0.8), turn_deg=-20, lean_deg=25, half_sizes=(0.6, 0.5)),
            standing_pane(3, (2.19, 0.0, 1.1), turn_deg=90, lean_deg=0, half_sizes=(0.7, 0.5), refraction=None),
        ),
    )


def camera_poses(count: int, seed: int) -> list[Array]:
    """Camera-to-world [4, 4]: two of three look at the panes from all around, one of three looks around in the room."""
    generator = np.random.default_rng(seed)
    poses = []
    for number in range(count):
        angle, distance = GOLDEN_ANGLE_RAD * number, generator.uniform(*ORBIT)
        around = np.array([math.cos(angle), math.sin(angle), 0.0])
        position = np.array([0.0, 0.1, generator.uniform(*HEIGHTS)]) + distance * around
        target = LOOKED_AT + generator.normal(scale=0.15, size=3)
        if number % 3 == 2:
            # Across the room, past the panes.
            turned = Rotation.from_euler("z", 180 + generator.choice([-55, 55]), degrees=True).as_matrix() @ around
            target = position + turned + [0, 0, generator.uniform(-0.35, 0.25)]
        poses.append(world_from_cam(position, target))
    return poses


def see(place: Place, pose: Array, width: int, height: int) -> Seen:
    """What the rays of an image see; [H, W, SUBPIXELS^2, ...] each."""
    fine = (np.arange(SUBPIXELS) + 0.5) / SUBPIXELS
    x, y, dx, dy = np.meshgrid(np.arange(width), np.arange(height), fine, fine, indexing="xy")
    focal = FOCAL_PER_WIDTH * width
    rays = np.stack([(x + dx - width / 2) / focal, (y + dy - height / 2) / focal, np.ones_like(dx)], axis=-1)
    directions = rays.reshape(-1, 3) @ pose[:3, :3].T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    seen = place.seen(np.broadcast_to(pose[:3, 3], directions.shape), directions)
    return Seen(*(layer.reshape(height, width, SUBPIXELS**2, *layer.shape[1:]) for layer in seen))


def picture(radiance: Array) -> NDArray[np.uint8]:
    """sRGB [H, W, 3] of the radiance [H, W, S, 3] of the rays in each pixel."""
    return as_bytes(srgb_from_linear(np.clip(radiance.mean(axis=2), 0, 1)))


def whole_labels(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """[H, W] label that all rays of a pixel agree on, else 0."""
    return np.where(labels.min(axis=2) == labels.max(axis=2), labels[:, :, 0], 0).astype(np.uint8)


def write_photograph(folder: Path, name: str, seen: Seen, *, annotated: bool) -> None:
    """Writes a photograph, with its mask if it is annotated."""
    Image.fromarray(picture(seen.radiance)).save(folder / "images" / name)
    if annotated:
        Image.fromarray(seen.label[:, :, SUBPIXELS**2 // 2]).save(folder / "masks" / name)


def write_layers(folder: Path, name: str, seen: Seen) -> None:
    """Writes what comes through the panes of a test view, and what they mirror."""
    for part in ("trans", "refl"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture(seen.transmission)).save(folder / "trans" / name)
    # Of rays that meet no pane, a pixel at the edge of one has nothing to show.
    share = np.maximum((seen.label > 0).mean(axis=2), 1e-9)[..., None, None]
    Image.fromarray(picture(seen.reflection / share)).save(folder / "refl" / name)


def write_strength(folder: Path, name: str, seen: Seen) -> None:
    """Writes how much the panes of a test view reflect, and where they are."""
    strength = np.round(65535 * seen.strength.mean(axis=2)).astype(np.uint16)
    Image.fromarray(strength).save(folder / name)
    Image.fromarray(whole_labels(seen.label)).save(folder / name.replace(".png", "_pane.png"))


def write_surface(folder: Path, name: str, normals: Array) -> None:
    """Writes where silver is seen, directly or through panes, and which way it faces; nothing where there is none.

    Args:
        folder: of the photographs.
        name: of one.
        normals: [H, W, S, 3] of its rays, 0 where they do not end on silver.
    """
    share = (np.linalg.norm(normals, axis=-1) > 0).mean(axis=2)
    mean = normals.sum(axis=2) / np.maximum(np.linalg.norm(normals.sum(axis=2), axis=-1, keepdims=True), 1e-9)
    stem = Path(name).stem
    Image.fromarray(as_bytes(np.dstack([(mean + 1) / 2, share]))).save(folder / f"{stem}_normal.png")
    Image.fromarray(as_bytes(share)).save(folder / f"{stem}_strength.png")


def sparse_points(place: Place, poses: list[Array], count: int, seed: int) -> tuple[Array, NDArray[np.uint8]]:
    """Positions and colours [P, 3] of surface points that random rays of the cameras meet, some of them mirrored."""
    generator = np.random.default_rng(seed)
    eyes = np.stack(poses)[generator.integers(len(poses), size=count)]
    rays = np.concatenate([generator.uniform(-0.55, 0.55, (count, 2)) * [1, 0.75], np.ones((count, 1))], axis=1)
    directions = np.einsum("nij,nj->ni", eyes[:, :3, :3], rays)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = eyes[:, :3, 3].copy()
    # Features slide over silver as the camera moves: no points lie there.
    plain = ~place.silver_normals(origins, directions).any(axis=1)
    origins, directions, count = origins[plain], directions[plain], int(plain.sum())
    colors, length = place.matte(origins, directions)
    for pane in place.panes:
        to_pane = pane.distances(origins, directions)
        share = VIRTUAL_IN_GLASS if pane.refraction else VIRTUAL_IN_MIRROR
        chosen = (to_pane < length) & (generator.random(count) < share)
        met = pane.meeting(origins[chosen], directions[chosen], to_pane[chosen])
        colors[chosen], beyond = place.matte(met.points, met.mirrored)
        # Straight on behind the pane, as far as the light has come.
        length[chosen] = to_pane[chosen] + beyond
    positions = origins + length[:, None] * directions + generator.normal(scale=POINT_NOISE, size=(count, 3))
    return positions, as_bytes(srgb_from_linear(colors))


def write_model(folder: Path, arguments: Arguments, poses: list[Array], place: Place) -> None:
    """Writes the COLMAP text model."""
    width, height = arguments.width, arguments.width * 3 // 4
    focal = FOCAL_PER_WIDTH * width
    (folder / "cameras.txt").write_text(f"1 PINHOLE {width} {height} {focal} {focal} {width / 2} {height / 2}\n")
    lines = []
    for number, pose in enumerate(poses):
        inverse = np.linalg.inv(pose)
        x, y, z, w = Rotation.from_matrix(inverse[:3, :3]).as_quat()
        values = " ".join(f"{value:.9f}" for value in (w, x, y, z, *inverse[:3, 3]))
        lines.append(f"{number + 1} {values} 1 {view_name(number)}\n\n")
    (folder / "images.txt").write_text("".join(lines))
    seed = arguments.seed if arguments.drawn is None else arguments.drawn
    positions, colors = sparse_points(place, poses, arguments.points, seed)
    rows = [
        f"{number + 1} {x:.6f} {y:.6f} {z:.6f} {r} {g} {b} 0.5\n"
        for number, ((x, y, z), (r, g, b)) in enumerate(zip(positions, colors, strict=True))
    ]
    (folder / "points3D.txt").write_text("".join(rows))


def write_planes(path: Path, place: Place) -> None:
    """Writes the true panes."""
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
    """Writes the panes as they would be marked by hand, for those that are seen through others only."""
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
    """Numbers of the training views that get a mask: for each pane some of the third in which it is largest."""
    training = [number for number in range(len(poses)) if number % TEST_EVERY]
    labels = np.stack([see(place, poses[number], *PREVIEW).label for number in training])
    chosen = set()
    for pane in place.panes:
        sizes = (labels == pane.label).sum(axis=(1, 2, 3))
        # A pane that few views show is not looked for in others.
        largest = [v for v in np.argsort(-sizes, kind="stable")[: len(training) // 3] if 4 * sizes[v] > sizes.max()]
        chosen |= {training[index] for index in sorted(largest)[:: max(len(largest) // masks, 1)][:masks]}
    return chosen


def with_passer_by(arguments: Arguments, place: Place, number: int, pose: Array) -> Place:
    """The place when a photograph was taken: the same, or with somebody in it."""
    generator = np.random.default_rng([arguments.seed, number, PASSERS])
    if generator.random() >= arguments.passers_by:
        return place
    room = next(thing for thing in place.things if isinstance(thing, Box) and thing.room)
    return replace(place, things=(*place.things, *passer_by(room, pose[:3, 3], generator)))


def write_difference(path: Path, picture: NDArray[np.uint8], other: NDArray[np.uint8]) -> None:
    """Writes a mask of the pixels in which two pictures differ by more than rounding, and their neighbours."""
    path.parent.mkdir(parents=True, exist_ok=True)
    differs = np.abs(picture.astype(int) - other).max(axis=2) > 2
    mask = maximum_filter(255 * differs.astype(np.uint8), 3)
    Image.fromarray(mask).save(path)


def write_view(arguments: Arguments, place: Place, number: int, pose: Array, *, annotated: bool) -> None:
    """Writes all that there is of a view; true layers are those without a photographer, and beside them with one."""
    folder, name, size = arguments.output, view_name(number), (arguments.width, arguments.width * 3 // 4)
    peopled = replace(place, photographer=photographer(pose)) if arguments.photographer else place
    seen = see(peopled, pose, *size)
    if number % TEST_EVERY:
        passed = with_passer_by(arguments, peopled, number, pose)
        if passed is not peopled:
            alone, seen = seen, see(passed, pose, *size)
            write_difference(folder / "gt/passers_by" / name, picture(seen.radiance), picture(alone.radiance))
    write_photograph(folder, name, seen, annotated=annotated)
    if number % TEST_EVERY:
        return
    write_strength(folder / "gt/strength", name, seen)
    if place.silver:
        write_surface(folder / "images", name, seen.normal)
    write_layers(folder / "gt", name, see(place, pose, *size) if arguments.photographer else seen)
    if arguments.photographer:
        write_layers(folder / "gt/with_photographer", name, seen)


def chosen_place(arguments: Arguments) -> DrawnPlace:
    """The place to photograph, and from where."""
    if arguments.drawn is not None:
        return draw_place(arguments.drawn, arguments.views)
    if arguments.window:
        return DrawnPlace(window_place(), window_poses(arguments.views, arguments.seed))
    if arguments.case:
        return DrawnPlace(case_place(), case_poses(arguments.views, arguments.seed))
    return DrawnPlace(make_place(), camera_poses(arguments.views, arguments.seed))


def with_glass(place: Place, arguments: Arguments) -> Place:
    """The place with such panes of glass as are asked for; mirrors stay as they are."""
    return replace(place, panes=tuple(flawed(p, arguments) if p.refraction else p for p in place.panes))


def flawed(pane: Pane, arguments: Arguments) -> Pane:
    """A pane in the tint, with the waves, and doubled as it is asked for."""
    waves = Waves(math.radians(arguments.waves), seed=pane.label) if arguments.waves else None
    tilt = arguments.second_pane
    second = None if tilt is None else SecondPane(GAP, math.radians(tilt))
    return replace(pane, tint=arguments.tint, waves=waves, second=second)


def main(arguments: Arguments) -> None:
    """Makes the scene."""
    folder = arguments.output
    if folder.exists():
        raise FileExistsError(f"{folder} exists; expected a new folder, so remove it first")
    for part in ("images", "masks", "sparse/0", "gt/strength"):
        (folder / part).mkdir(parents=True)
    drawn = chosen_place(arguments)
    place, poses = with_glass(drawn.place, arguments), drawn.poses
    write_model(folder / "sparse/0", arguments, poses, place)
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
