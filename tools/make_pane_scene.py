"""Makes a capture of a room with free-standing panes, photographed all the way round, with exact layers.

    python -m tools.make_pane_scene --output scenes/screens
    python -m tools.make_pane_scene --output scenes/room-1 --drawn 1

`screens`: two panes of glass, one upright, one leaning, through which the other is seen, stand between things; a mirror
hangs on a wall. With `--drawn` everything is drawn by chance (`tools/pane_draws.py`); `--window` and `--case` make
other places with names (`tools/pane_places.py`). docs/scenes.md describes the files. Needs nothing but glassplat's own
dependencies.
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
"""Standard deviation of the sparse points about the surfaces, world units."""
GAP = 0.02
"""Between the two panes of double glazing, world units."""
PASSERS, SENSOR = 77, 78
"""Keep what is drawn for those who walk by, and for the sensor, apart from all else."""
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
    noise: float = 0.0
    """Standard deviation of the sensor's noise in photographs, of 255."""
    masks: int = 8
    """Annotated training views."""
    points: int = 6000
    """Sparse points."""
    seed: int = 0
    """Of cameras and points of `screens`, `window` and `case`."""
    drawn: int | None = None
    """Seed of a place drawn by chance, to make in place of `screens`; of all that is random in it, too."""
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
    second_pane: float | None = None
    """Make the glass double: behind each pane is another, tilted by so many degrees against it."""

    @property
    def any_seed(self) -> int:
        """Of all that is random."""
        return self.seed if self.drawn is None else self.drawn


def picture(radiance: Array, noise: Array | float = 0.0) -> NDArray[np.uint8]:
    """sRGB [H, W, 3] of the radiance [H, W, S, 3] of the rays in each pixel; brighter than white is white."""
    return as_bytes(srgb_from_linear(np.clip(radiance.mean(axis=2), 0, 1)) + noise)


def whole_labels(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """[H, W] label that all rays of a pixel agree on, else 0."""
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


def random_rays(poses: list[Array], count: int, generator: np.random.Generator) -> tuple[Array, Array]:
    """Origins and unit directions [N, 3] of rays through random places of random views."""
    eyes = np.stack(poses)[generator.integers(len(poses), size=count)]
    rays = np.concatenate([generator.uniform(-0.55, 0.55, (count, 2)) * [1, 0.75], np.ones((count, 1))], axis=1)
    directions = np.einsum("nij,nj->ni", eyes[:, :3, :3], rays)
    return eyes[:, :3, 3].copy(), directions / np.linalg.norm(directions, axis=1, keepdims=True)


def sparse_points(place: Place, poses: list[Array], count: int, seed: int) -> tuple[Array, NDArray[np.uint8]]:
    """Positions and colours [P, 3] of surface points that random rays of the cameras meet, some of them mirrored."""
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
        # Straight on behind the pane, as far as the light has come.
        length[chosen] = shown.to_pane[chosen] + beyond.distance
    noise = generator.normal(scale=POINT_NOISE, size=(count, 3))
    positions = origins + length[:, None] * directions + noise
    return positions[kept], as_bytes(srgb_from_linear(np.clip(colors[kept], 0, 1)))


def has_features(seen: Seen) -> NDArray[np.bool_]:
    """[N] whether structure from motion finds points: not on silver, where they slide, nor where pictures clip."""
    return ~seen.normal.any(axis=1) & (seen.radiance < 1).any(axis=1)


def write_colmap(
    folder: Path, width: int, focal_per_width: float, poses: Mapping[str, Array], points: tuple[Array, Array]
) -> None:
    """Writes a COLMAP text model of one pinhole camera, whose pictures are three quarters as high as wide.

    Args:
        folder: to write to.
        width: of the pictures, pixels.
        focal_per_width: focal length, as a share of the width.
        poses: camera-to-world [4, 4] by the name of the photograph.
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
    """Numbers of the training views that get a mask, in which every pane is marked.

    One after the other, for the pane that the masks show least often: of the third of views in which it is largest the
    one farthest from those chosen before.
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
    """Writes all that there is of a view; true layers are those without a photographer, and next to them with one."""
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
    """The place to photograph, and from where."""
    if arguments.drawn is not None:
        return draw_place(arguments.drawn, arguments.views)
    if arguments.window:
        return DrawnPlace(window_place(), window_poses(arguments.views, arguments.seed))
    if arguments.case:
        return DrawnPlace(case_place(), case_poses(arguments.views, arguments.seed))
    return DrawnPlace(screens_place(), screens_poses(arguments.views, arguments.seed))


def with_glass(place: Place, arguments: Arguments) -> Place:
    """The place with such panes of glass as are asked for; mirrors stay as they are."""
    return replace(place, panes=tuple(flawed(p, arguments) if p.refraction else p for p in place.panes))


def flawed(pane: Pane, arguments: Arguments) -> Pane:
    """A pane in the tint, and doubled as it is asked for."""
    tilt = arguments.second_pane
    second = None if tilt is None else SecondPane(GAP, math.radians(tilt))
    return replace(pane, tint=arguments.tint, second=second)


def main(arguments: Arguments) -> None:
    """Makes the scene."""
    folder = arguments.output
    if arguments.drawn is not None and arguments.passers_by:
        raise ValueError("nobody walks by in drawn places; leave out --passers-by or --drawn")
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
