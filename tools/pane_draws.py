"""Rooms with panes drawn by chance: size, things, panes, tilt, refractive index and paths of cameras, from a seed.

What a method was tuned on says little about what it does elsewhere. These captures have what `screens` has, glass and
mirrors in a room of luminous matte things, and share nothing else with it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from tools.make_scenes import GOLDEN_ANGLE_RAD, world_from_opengl
from tools.pane_tracer import Ball, Box, Lamp, Place, Thing
from tools.tracer_panes import Array, Pane

Generator = np.random.Generator

OPENGL_FROM_CAM = np.diag([1.0, -1.0, -1.0, 1.0])
HALF_WIDTHS, CEILINGS = (1.8, 2.8), (2.3, 3.2)
"""Of rooms, world units."""
SIZES = (0.15, 0.35)
"""Radii of balls, and half the widths of boxes."""
PANE_HALF_SIZES = ((0.65, 1.0), (0.45, 0.7))
"""Along the lower side, and upwards."""
LEANS_DEG, REFRACTIONS = (-28.0, 28.0), (1.4, 1.75)
REACHES = (0.8, 1.8)
"""Of lamps, world units."""
POST = 0.08
"""Between two panes in one plane."""
EYES, STANDS = (0.8, 1.7), (0.9, 1.8)
"""Heights of cameras, and distances from the first pane's middle."""
ARC_DEG = 70.0
"""How far to either side of a pane's normal a path goes that stays on one side."""
CLEARANCE = 0.25
"""Between a camera and anything else."""
LOOK_AROUND = 3
"""One view of so many looks past the panes."""
TRIES = 1000


@dataclass(frozen=True)
class DrawnPlace:
    """A place and where it is photographed from: camera-to-world [4, 4] each, x right, y down, z forward."""

    place: Place
    poses: list[Array]


def draw_place(seed: int, views: int) -> DrawnPlace:
    """The place of a seed, the same one wherever it is drawn, with so many views."""
    generator = np.random.default_rng(seed)
    room = _draw_room(generator)
    panes = _draw_panes(generator, room)
    things = _draw_things(generator, room, panes[0])
    place = Place((room, *things), panes, _draw_lamp(generator, room))
    all_around = generator.random() < 0.5
    poses = [_draw_pose(generator, place, all_around, number) for number in range(views)]
    return DrawnPlace(place, poses)


def world_from_cam(position: Array, target: Array) -> Array:
    """Camera-to-world [4, 4], OpenCV axes, of an upright camera at `position` [3] that looks at `target` [3]."""
    return world_from_opengl(position, target) @ OPENGL_FROM_CAM


def standing_pane(
    label: int,
    center: tuple[float, float, float],
    *,
    turn_deg: float,
    lean_deg: float,
    half_sizes: tuple[float, float],
    refraction: float | None = 1.5,
) -> Pane:
    """A pane whose lower side is level: turned about the vertical from facing -y, then leaning back."""
    axes = Rotation.from_euler("xz", [-lean_deg, turn_deg], degrees=True).as_matrix()
    return Pane(label, np.array(center), -axes[:, 1], axes[:, 0], half_sizes, refraction)


def _draw_room(generator: Generator) -> Box:
    width, depth = generator.uniform(*HALF_WIDTHS, 2).tolist()
    high = (width, depth, float(generator.uniform(*CEILINGS)))
    return Box((-width, -depth, 0.0), high, seed=_texture(generator), room=True)


def _draw_panes(generator: Generator, room: Box) -> tuple[Pane, ...]:
    """Glass near the middle of the room; by chance a second pane beside it in its plane, and a mirror on a wall."""
    pair = generator.random() < 0.4
    half_sizes = (
        float(generator.uniform(*PANE_HALF_SIZES[0])) / (1 + 0.5 * pair),
        float(generator.uniform(*PANE_HALF_SIZES[1])),
    )
    x, y, lift = generator.uniform([-0.3, -0.3, 0.25], [0.3, 0.3, 0.5]).tolist()
    first = standing_pane(
        1,
        (x, y, lift + half_sizes[1]),
        turn_deg=float(generator.uniform(0, 360)),
        lean_deg=float(generator.uniform(*LEANS_DEG)),
        half_sizes=half_sizes,
        refraction=float(generator.uniform(*REFRACTIONS)),
    )
    panes = [first]
    if pair:
        beside = first.center + (2 * half_sizes[0] + POST) * first.tangent
        panes.append(Pane(2, beside, first.normal, first.tangent, half_sizes, first.refraction))
    if generator.random() < 0.3:
        panes.append(_draw_mirror(generator, room, label=len(panes) + 1))
    return tuple(panes)


def _draw_mirror(generator: Generator, room: Box, label: int) -> Pane:
    """On one of the four walls."""
    wall = int(generator.integers(4))
    turned = Rotation.from_euler("z", 90 * wall, degrees=True).as_matrix()
    # The wall that a pane facing -y hangs on is at +y.
    to_wall = room.high[1 - wall % 2] - 0.01
    x, y, z = (turned @ [generator.uniform(-0.6, 0.6), to_wall, generator.uniform(1.0, 1.3)]).tolist()
    half_sizes = (float(generator.uniform(0.5, 0.8)), float(generator.uniform(0.35, 0.55)))
    return standing_pane(label, (x, y, z), turn_deg=90 * wall, lean_deg=0, half_sizes=half_sizes, refraction=None)


def _draw_lamp(generator: Generator, room: Box) -> Lamp:
    """Somewhere in the upper half of the room, so that one side of a pane is darker than the other."""
    center = generator.uniform([0.9 * room.low[0], 0.9 * room.low[1], 0.5 * room.high[2]], 0.9 * np.array(room.high))
    x, y, z = center.tolist()
    return Lamp((x, y, z), reach=float(generator.uniform(*REACHES)))


def _draw_things(generator: Generator, room: Box, pane: Pane) -> list[Thing]:
    """Three near the pane, on either side of it, and a few anywhere on the floor."""
    near = [pane.center[:2] + _sideways(generator, pane) for _ in range(3)]
    low, high = np.array(room.low[:2]) + 0.3, np.array(room.high[:2]) - 0.3
    far = list(generator.uniform(low, high, (int(generator.integers(2, 6)), 2)))
    return [_draw_thing(generator, where) for where in (*near, *far)]


def _sideways(generator: Generator, pane: Pane) -> Array:
    """A step from the pane's middle that ends clear of it, on the floor."""
    away = generator.choice([-1, 1]) * generator.uniform(0.55, 0.9)
    level = pane.normal[:2] / np.linalg.norm(pane.normal[:2])
    return away * level + generator.uniform(-0.6, 0.6) * pane.tangent[:2]


def _draw_thing(generator: Generator, where: Array) -> Thing:
    """A ball on a floor, or a box as high as a table or a cupboard."""
    size, (x, y) = float(generator.uniform(*SIZES)), where.tolist()
    if generator.random() < 0.4:
        return Ball((x, y, float(generator.uniform(1, 3)) * size), size, seed=_texture(generator))
    other, height = float(generator.uniform(*SIZES)), float(generator.uniform(0.3, 1.1))
    return Box((x - size, y - other, 0.0), (x + size, y + other, height), seed=_texture(generator))


def _texture(generator: Generator) -> int:
    return int(generator.integers(10_000))


def _draw_pose(generator: Generator, place: Place, all_around: bool, number: int) -> Array:
    """Camera-to-world: two of three look at a pane, one of three past all of them, as level as people do."""
    position, pane = _draw_position(generator, place, all_around), place.panes[number % len(place.panes)]
    target = pane.center + generator.normal(scale=0.15, size=3)
    if number % LOOK_AROUND == LOOK_AROUND - 1:
        azimuth = generator.uniform(0, 2 * math.pi)
        target = position + np.array([math.cos(azimuth), math.sin(azimuth), generator.uniform(-0.4, 0.2)])
    return world_from_cam(position, target)


def _draw_position(generator: Generator, place: Place, all_around: bool) -> Array:
    """Somewhere about the first pane, clear of everything."""
    pane = place.panes[0]
    facing = math.atan2(pane.normal[1], pane.normal[0])
    spread = math.pi if all_around else math.radians(ARC_DEG)
    for _ in range(TRIES):
        angle, distance = facing + generator.uniform(-spread, spread), generator.uniform(*STANDS)
        step = distance * np.array([math.cos(angle), math.sin(angle)])
        position = np.array([*(pane.center[:2] + step), generator.uniform(*EYES)])
        if is_clear(place, position):
            return position
    raise RuntimeError(f"no free position for a camera found in {TRIES} tries; take another seed")


def is_clear(place: Place, position: Array) -> bool:
    """Whether nothing is nearer to a position [3] than `CLEARANCE`, panes included, and no thing is around it."""
    z = np.linspace(-1, 1, 64)
    turn = GOLDEN_ANGLE_RAD * np.arange(64)
    flat = np.sqrt(1 - z**2)
    directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)
    origins = np.broadcast_to(position, directions.shape)
    inside = any(_holds(thing, position) for thing in place.things)
    return not inside and all(
        surface.distances(origins, directions).min() > CLEARANCE for surface in (*place.things, *place.panes)
    )


def _holds(thing: Thing, position: Array) -> bool:
    if isinstance(thing, Ball):
        return bool(np.linalg.norm(position - thing.center) < thing.radius)
    assert isinstance(thing, Box)
    return bool(np.all((position > thing.low) & (position < thing.high))) != thing.room
