"""Random rooms with panes: geometry, contents and camera poses, generated from a seed.

Scenes on which a method was tuned say little about its generality. Seeds cycle through three settings: free-standing
panes in a room, a shop window of coplanar panes with posts, and windows in a wall in front of a room or a street. They
also cycle through the camera walks: from the front, all around, and along a line. Number and size of panes, glass,
mirrors, objects, paints and lamps are random.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from tools.make_scenes import GOLDEN_ANGLE_RAD, world_from_opengl
from tools.pane_things import PATTERNS, Ball, Box, Carried, Cylinder, Lamp, Paint, Pane, Place, Thing, standing_pane
from tools.pane_tracer import Array

Generator = np.random.Generator
Setting = Literal["screens", "shop", "windows"]
Walk = Literal["front", "around", "line"]
SETTINGS: tuple[Setting, ...] = ("screens", "shop", "windows")
WALKS: dict[Setting, tuple[Walk, ...]] = {
    "screens": ("around", "front", "around", "line"),
    "shop": ("front", "line"),
    "windows": ("front", "line"),
}

OPENGL_FROM_CAM = np.diag([1.0, -1.0, -1.0, 1.0])
HALF_WIDTHS, DEPTHS, CEILINGS = (1.9, 2.7), (2.6, 3.8), (2.3, 3.0)
"""Dimensions of rooms, world units."""
REFRACTIONS, LEANS_DEG = (1.45, 1.8), (-28.0, 28.0)
POSTS, PIERS = (0.05, 0.12), (0.3, 0.7)
"""Widths between the panes of a shop window, and between windows."""
EYES, STANDS, LINES = (0.9, 1.7), (1.0, 1.9), (1.1, 1.7)
"""Heights of cameras, and their distances from the panes in walks from the front or around, and along a line."""
ARC_DEG = 60.0
"""Largest angle to the normal of a pane in walks that stay on one side."""
CLEARANCE = 0.25
"""Minimum distance between a camera and anything else."""
FREE_VIEW = 1.8
"""Minimum depth at the centre of views that face away from the panes."""
LOOK_AROUND = 3
"""One view in three faces away from the panes."""
ODDS, WALL_ODDS = (0.45, 0.2, 0.2, 0.15), (0.6, 0.07, 0.08, 0.25)
"""Probabilities of the paint patterns of objects, and of walls."""
THICK = 0.1
"""Thickness of walls."""
TRIES, REDRAWS = 200, 200
LEAST_LARGEST, LEAST_SEEN, LEAST_VIEWS = 0.06, 0.015, 0.3
"""Each pane has to cover the first share of some photograph, and the second in this part of all photographs."""
LEAST_CLIPPED = 0.002
"""Minimum mean share of clipped pixels, which show lamps."""
PREVIEW = (16, 12)
"""Width and height of previews for checking views."""


@dataclass(frozen=True)
class DrawnPlace:
    """A scene and its camera poses.

    Attributes:
        place: the scene.
        poses: camera-to-world [4, 4] each, x right, y down, z forward.
        words: description of the scene.
        room: [2, 3] lowest and highest corner of the region of the cameras; None for named scenes.
    """

    place: Place
    poses: list[Array]
    words: str = ""
    room: Array | None = None


@dataclass(frozen=True)
class _Stage:
    """A scene without cameras: its contents, and the room in which the cameras stay.

    Attributes:
        things: objects without posters and lamps.
        panes: panes of glass.
        low: lowest corner of the room of the cameras.
        high: highest corner.
        words: description of the setting.
        lamps: lamps behind the glass.
    """

    things: tuple[Thing, ...]
    panes: tuple[Pane, ...]
    low: Array
    high: Array
    words: str
    lamps: tuple[Lamp, ...] = ()


def draw_place(seed: int, views: int) -> DrawnPlace:
    """The scene of a seed with `views` views, deterministic; redrawn until its panes are visible enough.

    Raises:
        RuntimeError: no draw was successful.
    """
    for attempt in range(REDRAWS):
        drawn = _draw_once(np.random.default_rng([seed, attempt]), seed, views)
        if drawn is not None and is_shown(drawn):
            return drawn
    raise RuntimeError(f"seed {seed} gave no place whose panes can be seen in {REDRAWS} draws; take another one")


def is_shown(drawn: DrawnPlace) -> bool:
    """Return whether the photographs show enough of each pane, and lamps."""
    seen = [drawn.place.view(pose, *PREVIEW) for pose in drawn.poses]
    labels = np.stack([view.label for view in seen])
    shares = np.stack([(labels == pane.label).mean(axis=(1, 2, 3)) for pane in drawn.place.panes])
    clipped = np.stack([(view.radiance >= 1).all(axis=-1).mean() for view in seen])
    return bool(
        (shares.max(axis=1) > LEAST_LARGEST).all()
        and ((shares > LEAST_SEEN).mean(axis=1) > LEAST_VIEWS).all()
        and clipped.mean() > LEAST_CLIPPED
    )


def world_from_cam(position: Array, target: Array) -> Array:
    """Camera-to-world [4, 4], OpenCV axes, of an upright camera at `position` [3] that looks at `target` [3]."""
    return world_from_opengl(position, target) @ OPENGL_FROM_CAM


def _draw_once(generator: Generator, seed: int, views: int) -> DrawnPlace | None:
    """A scene in the setting and with the walk of a seed; None if no valid position of a mirror or camera was found."""
    setting = SETTINGS[seed % len(SETTINGS)]
    stage = _draw_screens(generator) if setting == "screens" else _draw_glass_wall(generator, setting)
    panes = stage.panes
    if len(panes) < 4 and generator.random() < 0.5:
        panes = (*panes, _draw_mirror(generator, stage, free=setting == "screens" and generator.random() < 0.4))
    if any(_touch(panes[-1], other) for other in panes[:-1] if panes[-1].refraction is None):
        return None
    lamps, lights = _draw_lamps(generator, stage)
    sky = float(generator.uniform(0.7, 1.2))
    outside = Box((-12.0, -12.0, -2.0), (12.0, 12.0, 10.0), Paint(glow=(0.85 * sky, 0.95 * sky, sky)), room=True)
    things = (outside, *stage.things, *_draw_posters(generator, stage), *lamps)
    ambient = float(generator.uniform(0.35, 0.65))
    place = Place(things, panes, (*stage.lamps, *lights), ambient)
    walk = WALKS[setting][seed // len(SETTINGS) % len(WALKS[setting])]
    turns = walk != "front" or bool(generator.random() < 0.5)
    poses = _draw_poses(generator, place, stage, walk=walk, turns=turns, views=views)
    glass = ", ".join("mirror" if pane.refraction is None else f"index {pane.refraction:.2f}" for pane in panes)
    words = f"{stage.words}; {glass}; walk {walk}{'' if turns else ', never turned round'}"
    return DrawnPlace(place, poses, words, np.array([stage.low, stage.high])) if poses else None


def _between(generator: Generator, limits: tuple[float, float]) -> float:
    return float(generator.uniform(*limits))


def _draw_paint(
    generator: Generator, coarseness: tuple[float, float], shade: float, odds: tuple[float, ...] = ODDS
) -> Paint:
    pattern = PATTERNS[generator.choice(len(PATTERNS), p=odds)]
    scale = math.exp(generator.uniform(*np.log(coarseness)))
    return Paint(int(generator.integers(10_000)), shade * _between(generator, (0.75, 1.1)), scale, pattern)


def _draw_walls(generator: Generator, low: Array, high: Array, *, shade: float, missing: str = "") -> list[Box]:
    """Floor, ceiling and four walls around a room, each in its own paint; `missing` names a side to leave out."""
    sides = {"west": (0, 0), "east": (0, 1), "near": (1, 0), "far": (1, 1), "floor": (2, 0), "ceiling": (2, 1)}
    boxes = []
    for name, (axis, side) in sides.items():
        paint = _draw_paint(generator, (0.8, 2.5), shade, WALL_ODDS)
        first, last = low - THICK, high + THICK
        (first if side else last)[axis] = high[axis] if side else low[axis]
        if name != missing:
            boxes.append(Box(tuple(first.tolist()), tuple(last.tolist()), paint))
    return boxes


def _draw_screens(generator: Generator) -> _Stage:
    """One to three free-standing panes near the middle of a room, some of them coplanar neighbours."""
    half_x, half_y = generator.uniform(*HALF_WIDTHS, 2)
    low, high = np.array([-half_x, -half_y, 0.0]), np.array([half_x, half_y, _between(generator, CEILINGS)])
    things: list[Thing] = [*_draw_walls(generator, low, high, shade=1.0)]
    first = _draw_screen(generator, 1, (0.0, 0.0))
    panes, words = [first], "1 free-standing pane"
    extra = int(generator.integers(3))
    if extra and generator.random() < 0.5:
        post = _between(generator, POSTS)
        things += [_draw_post(generator, first, post, number) for number in range(1, extra + 1)]
        for number in range(1, extra + 1):
            beside = first.center + number * (2 * first.half_sizes[0] + post) * first.tangent
            panes.append(Pane(1 + number, beside, first.normal, first.tangent, first.half_sizes, first.refraction))
        words = f"{1 + extra} free-standing coplanar panes"
    elif extra:
        for _ in range(10):
            other = _draw_screen(generator, len(panes) + 1, tuple(generator.uniform(-1.1, 1.1, 2).tolist()))
            if len(panes) <= extra and not any(_touch(other, pane) for pane in panes):
                panes.append(other)
        words = f"{len(panes)} free-standing panes"
    low_xy, high_xy = low[:2] + 0.3, high[:2] - 0.3
    for _ in range(int(generator.integers(6, 11))):
        where = generator.uniform(low_xy, high_xy)
        if all(_distance_to_pane(pane, where) > 0.45 for pane in panes):
            things += _draw_thing(generator, where, 0.0, (0.15, 0.33), 1.0)
    return _Stage(tuple(things), tuple(panes), low, high, words)


def _draw_screen(generator: Generator, label: int, near: tuple[float, ...]) -> Pane:
    half_sizes = (_between(generator, (0.4, 0.8)), _between(generator, (0.4, 0.65)))
    x, y = (np.array(near) + generator.uniform(-0.3, 0.3, 2)).tolist()
    return standing_pane(
        label,
        (x, y, _between(generator, (0.25, 0.5)) + half_sizes[1]),
        turn_deg=_between(generator, (0, 360)),
        lean_deg=_between(generator, LEANS_DEG) * bool(generator.random() < 0.6),
        half_sizes=half_sizes,
        refraction=_between(generator, REFRACTIONS),
    )


def _draw_post(generator: Generator, pane: Pane, width: float, number: int) -> Carried:
    """The post between the neighbours `number` - 1 and `number` of `pane` in its plane."""
    frame = np.eye(4)
    frame[:3, :3] = np.stack([pane.tangent, pane.bitangent, np.cross(pane.tangent, pane.bitangent)], axis=1)
    frame[:3, 3] = pane.center + ((2 * number - 1) * pane.half_sizes[0] + (number - 0.5) * width) * pane.tangent
    up, deep = pane.half_sizes[1] + 0.05, 0.04
    paint = _draw_paint(generator, (0.3, 1.0), 0.7)
    return Carried(Box((-width / 2, -up, -deep), (width / 2, up, deep), paint), frame)


def _draw_glass_wall(generator: Generator, setting: Setting) -> _Stage:
    """A wall at y = 0 with panes, the room of the cameras in front of it, and a shop, a room or a street behind it."""
    shop, street = setting == "shop", bool(generator.random() < 0.5)
    half, depth, ceiling = (_between(generator, limits) for limits in (HALF_WIDTHS, DEPTHS, CEILINGS))
    low, high = np.array([-half, -depth, 0.0]), np.array([half, 0.0, ceiling])
    count = int(generator.integers(2, 5) if shop else generator.integers(1, 4))
    gap = _between(generator, POSTS if shop else PIERS)
    sill, top = _between(generator, (0.35, 0.8)), min(ceiling - 0.25, _between(generator, (1.7, 2.2)))
    width = min((_between(generator, (0.75, 0.95)) * 2 * half - (count - 1) * gap) / count, 1.6)
    starts = [(number - count / 2) * (width + gap) + gap / 2 for number in range(count)]
    refraction = _between(generator, REFRACTIONS)
    panes = tuple(
        Pane(
            number + 1,
            np.array([start + width / 2, 0.0, (sill + top) / 2]),
            np.array([0.0, -1.0, 0.0]),
            np.array([1.0, 0.0, 0.0]),
            (width / 2, (top - sill) / 2),
            refraction,
        )
        for number, start in enumerate(starts)
    )
    walls = _draw_walls(generator, low, high - [0, THICK / 2, 0], shade=1.0, missing="far")
    pierced = _draw_pierced_wall(generator, (-half, half, ceiling), (sill, top), [(s, s + width) for s in starts])
    if shop:
        behind, lamps = _draw_shop(generator, half, sill, ceiling)
    else:
        behind, lamps = _draw_street(generator) if street else _draw_other_room(generator, half, ceiling)
    words = (
        f"a shop window of {count} panes" if shop else f"{count} in a wall before a {'street' if street else 'room'}"
    )
    furniture: list[Thing] = []
    for _ in range(int(generator.integers(4, 8))):
        # Along the walls, out of the way of the cameras.
        x, y = generator.uniform(0.4, half - 0.3), generator.uniform(-depth + 0.3, -0.7)
        x, y = (half - 0.35, y) if generator.random() < 0.5 else (x, -depth + 0.35)
        side = generator.choice([-1, 1])
        furniture += _draw_thing(generator, np.array([side * x, y]), 0.0, (0.15, 0.33), 1.0)
    things = (*walls, *pierced, *behind, *furniture)
    return _Stage(things, panes, low, high, words, lamps)


def _draw_pierced_wall(
    generator: Generator,
    wall: tuple[float, float, float],
    heights: tuple[float, float],
    holes: Sequence[tuple[float, float]],
) -> list[Box]:
    """The wall at y = 0 between two x and up to a height, with holes between two heights."""
    paint, other = _draw_paint(generator, (0.8, 2.5), 1.0, WALL_ODDS), _draw_paint(generator, (0.3, 1.0), 0.7)
    left, right, ceiling = wall
    sill, top = heights
    ends = [left, *(edge for hole in holes for edge in hole), right]
    solid = list(zip(ends[::2], ends[1::2], strict=True))
    half = THICK / 2
    posts = [
        Box((first, -half, sill), (last, half, top), paint if number in (0, len(holes)) else other)
        for number, (first, last) in enumerate(solid)
    ]
    return [
        Box((left, -half, 0.0), (right, half, sill), paint),
        Box((left, -half, top), (right, half, ceiling), paint),
        *posts,
    ]


def _draw_shop(generator: Generator, half: float, sill: float, ceiling: float) -> tuple[list[Thing], tuple[Lamp, ...]]:
    """A dim shallow room behind glass, with objects on a podium."""
    shade, deep = _between(generator, (0.2, 0.6)), _between(generator, (0.9, 1.7))
    low, high = np.array([-half, THICK / 2, 0.0]), np.array([half, deep, ceiling])
    things: list[Thing] = [*_draw_walls(generator, low, high, shade=shade, missing="near")]
    podium = Box((-half, 0.2, 0.0), (half, deep, sill), _draw_paint(generator, (0.6, 1.5), shade))
    things.append(podium)
    for x in np.linspace(-half + 0.35, half - 0.35, int(generator.integers(4, 8))):
        where = np.array([x + generator.uniform(-0.15, 0.15), generator.uniform(0.45, deep - 0.25)])
        things += _draw_thing(generator, where, sill, (0.1, 0.22), shade * _between(generator, (1.0, 2.0)))
    if generator.random() < 0.5:
        return things, ()
    x, level = generator.uniform(-0.6, 0.6) * half, _between(generator, (1.5, 4.0))
    bulb = Ball((x, 0.5 * deep, ceiling - 0.5), 0.09, Paint(glow=(level, 0.9 * level, 0.7 * level)))
    return [*things, bulb], (Lamp(bulb.center, 0.8, _between(generator, (0.5, 1.5))),)


def _draw_other_room(generator: Generator, half: float, ceiling: float) -> tuple[list[Thing], tuple[Lamp, ...]]:
    """A room behind windows, with objects on its floor."""
    shade, deep = _between(generator, (0.4, 1.0)), _between(generator, (1.8, 3.0))
    low, high = np.array([-half, THICK / 2, 0.0]), np.array([half, deep, ceiling])
    things: list[Thing] = [*_draw_walls(generator, low, high, shade=shade, missing="near")]
    for _ in range(int(generator.integers(5, 9))):
        where = generator.uniform([-half + 0.4, 0.5], [half - 0.4, deep - 0.3])
        things += _draw_thing(generator, where, 0.0, (0.15, 0.35), shade)
    return things, (Lamp((0.0, 0.5 * deep, 0.8 * ceiling), 1.5, _between(generator, (0.3, 1.0))),)


def _draw_street(generator: Generator) -> tuple[list[Thing], tuple[Lamp, ...]]:
    """A street behind windows: houses under a bright sky, with objects in front of them."""
    road = Box((-9.0, THICK / 2, -0.3), (9.0, 9.0, -0.1), _draw_paint(generator, (1.5, 3.0), 1.0))
    things: list[Thing] = [road]
    left = -7.0
    while left < 7.0:
        width, near = _between(generator, (1.2, 2.8)), _between(generator, (3.5, 5.0))
        height = _between(generator, (1.6, 4.5))
        paint = _draw_paint(generator, (1.0, 2.5), 1.1)
        things.append(Box((left, near, -0.1), (left + width, near + 2.0, height), paint))
        left += width + _between(generator, (0.0, 0.6))
    for _ in range(int(generator.integers(4, 8))):
        where = generator.uniform([-2.5, 0.9], [2.5, 3.0])
        things += _draw_thing(generator, where, -0.1, (0.2, 0.45), 1.1)
    return things, (Lamp((0.0, 1.0, 6.0), 6.0, _between(generator, (0.6, 1.2))),)


def _draw_thing(
    generator: Generator, where: Array, floor: float, sizes: tuple[float, float], shade: float
) -> list[Thing]:
    """A ball, an egg, a box, a cylinder, or a table with something on it, on a floor."""
    size, (x, y) = _between(generator, sizes), where.tolist()
    paint = _draw_paint(generator, (0.35, 1.5), shade)
    kind = generator.choice(["ball", "egg", "box", "cylinder", "table"])
    if kind in ("ball", "egg"):
        stretch = 1.0 if kind == "ball" else _between(generator, (1.2, 2.2))
        return [Ball((x, y, floor + size * stretch), size, paint, stretch)]
    height = size * _between(generator, (1.2, 4.5))
    frame = np.eye(4)
    frame[:3, :3] = Rotation.from_euler("z", generator.uniform(0, 90), degrees=True).as_matrix()
    frame[:3, 3] = x, y, floor
    deep = size * _between(generator, (0.5, 1.0))
    if kind == "cylinder":
        return [Cylinder((x - size, y - size, floor), (x + size, y + size, floor + height), paint)]
    if kind == "box":
        return [Carried(Box((-size, -deep, 0.0), (size, deep, height), paint), frame)]
    top = Carried(Box((-size, -size, 0.9 * height), (size, size, height), paint), frame)
    leg = Carried(Box((-0.2 * size, -0.2 * size, 0.0), (0.2 * size, 0.2 * size, 0.9 * height), paint), frame)
    small = _between(generator, (0.3, 0.6)) * size
    on_it = Ball((x, y, floor + height + small), small, _draw_paint(generator, (0.3, 0.8), shade))
    return [top, leg, on_it]


def _draw_posters(generator: Generator, stage: _Stage) -> list[Thing]:
    """Posters on the side walls and the wall behind the cameras."""
    posters: list[Thing] = []
    for _ in range(int(generator.integers(3, 8))):
        axis, side = int(generator.integers(2)), bool(generator.random() < 0.5)
        # At y = 0 there is only the wall with panes, unless the panes are free-standing.
        side = side and not (axis == 1 and stage.high[1] == 0)
        middle = generator.uniform(stage.low + np.array([0.5, 0.5, 1.0]), stage.high - np.array([0.5, 0.5, 0.7]))
        half = np.append(generator.uniform(0.15, 0.45, 2), generator.uniform(0.15, 0.4))
        middle[axis], half[axis] = (stage.high if side else stage.low)[axis], 0.02
        posters.append(
            Box(
                tuple((middle - half).tolist()),
                tuple((middle + half).tolist()),
                _draw_paint(generator, (0.25, 0.8), 1.0),
            )
        )
    return posters


def _draw_lamps(generator: Generator, stage: _Stage) -> tuple[list[Thing], tuple[Lamp, ...]]:
    """One to three lamps brighter than white: balls on cables, shades on stands, panels under the ceiling."""
    things: list[Thing] = []
    lights = []
    ceiling = float(stage.high[2])
    for _ in range(int(generator.integers(1, 4))):
        x, y = generator.uniform(stage.low[:2] + 0.4, stage.high[:2] - 0.4).tolist()
        level, kind = _between(generator, (2.0, 6.0)), generator.choice(["ball", "shade", "panel"])
        glow = Paint(glow=(level, _between(generator, (0.85, 1.0)) * level, _between(generator, (0.6, 1.0)) * level))
        if kind == "ball":
            z, radius = _between(generator, (1.5, 2.0)), _between(generator, (0.09, 0.18))
            things += [Ball((x, y, z), radius, glow), _rod(x, y, (z + radius, ceiling))]
        elif kind == "shade":
            z, radius = _between(generator, (1.0, 1.6)), _between(generator, (0.12, 0.2))
            things += [
                Cylinder((x - radius, y - radius, z), (x + radius, y + radius, z + 0.3), glow),
                _rod(x, y, (0.0, z)),
            ]
        else:
            wide, deep, z = *generator.uniform(0.15, 0.5, 2).tolist(), ceiling - 0.02
            things.append(Box((x - wide, y - deep, z), (x + wide, y + deep, ceiling), glow))
        lights.append(Lamp((x, y, z), reach=_between(generator, (0.8, 1.8)), power=_between(generator, (0.6, 1.4))))
    return things, tuple(lights)


def _rod(x: float, y: float, heights: tuple[float, float]) -> Cylinder:
    """A vertical rod: a cable or a stand."""
    return Cylinder(
        (x - 0.015, y - 0.015, heights[0]), (x + 0.015, y + 0.015, heights[1]), Paint(shade=0.2, pattern="plain")
    )


def _draw_mirror(generator: Generator, stage: _Stage, *, free: bool) -> Pane:
    """A mirror, free-standing if `free`, else on a side wall."""
    label = len(stage.panes) + 1
    half_sizes = (_between(generator, (0.4, 0.7)), _between(generator, (0.4, 0.6)))
    height = _between(generator, (1.0, 1.3))
    if free:
        x, y = (generator.uniform(0.9, 1.2) * stage.high[:2] * generator.choice([-0.6, 0.6], 2)).tolist()
        turn = _between(generator, (0, 360))
        return standing_pane(label, (x, y, height), turn_deg=turn, lean_deg=0, half_sizes=half_sizes, refraction=None)
    side = int(generator.choice([-1, 1]))
    x, y = side * (float(stage.high[0]) - 0.03), _between(generator, (-1.3, -0.8))
    turn = 90 * -side
    return standing_pane(label, (x, y, height), turn_deg=turn, lean_deg=0, half_sizes=half_sizes, refraction=None)


def _distance_to_pane(pane: Pane, where: Array) -> float:
    """Distance on the floor plan from a point to the footprint of a pane, including its lean."""
    level = np.array([pane.tangent[0], pane.tangent[1]])
    offset = where - pane.center[:2]
    along = float(np.clip(offset @ level, -pane.half_sizes[0], pane.half_sizes[0]))
    leaning = pane.half_sizes[1] * float(np.linalg.norm(pane.bitangent[:2]))
    return float(np.linalg.norm(offset - along * level)) - leaning


def _touch(pane: Pane, other: Pane) -> bool:
    """Return whether two panes are closer to each other on the floor plan than a step."""
    steps = np.linspace(-1, 1, 9)[:, None] * pane.half_sizes[0] * pane.tangent[:2]
    return min(_distance_to_pane(other, pane.center[:2] + step) for step in steps) < 0.3


def _draw_poses(
    generator: Generator, place: Place, stage: _Stage, *, walk: Walk, turns: bool, views: int
) -> list[Array]:
    """Upright camera-to-world poses; two in three face a pane, one in three faces elsewhere if `turns`.

    Args:
        generator: random generator.
        place: the photographed scene.
        stage: the room in which the camera stays.
        walk: kind of the walk.
        turns: whether some views face away from the panes; otherwise all views face a pane.
        views: number of views.
    """
    course = (_between(generator, LINES), generator.uniform(-0.2, 0.2), _between(generator, (1.1, 1.6)))
    poses = []
    for number in range(views):
        position = _draw_position(generator, place, stage, (walk, number / max(views - 1, 1), course))
        if position is None:
            return []
        pane = place.panes[number % len(place.panes)]
        target = pane.center + generator.normal(scale=0.2, size=3)
        if turns and number // len(place.panes) % LOOK_AROUND == LOOK_AROUND - 1:
            target = _draw_target(generator, place, position)
        poses.append(world_from_cam(position, target))
    return poses


def _draw_target(generator: Generator, place: Place, position: Array) -> Array:
    """A target in a random direction with enough free depth: nobody photographs a bare wall at close range."""
    azimuths = generator.uniform(0, 2 * math.pi, 8)
    rises = generator.uniform(-0.35, 0.25, 8)
    directions = np.stack([np.cos(azimuths), np.sin(azimuths), rises], axis=1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    free = place.seen(np.broadcast_to(position, directions.shape), directions, reflections=1).distance
    far = np.flatnonzero(free > FREE_VIEW)
    return np.asarray(position + directions[far[0] if len(far) else free.argmax()])


def _draw_position(
    generator: Generator, place: Place, stage: _Stage, course: tuple[Walk, float, tuple[float, float, float]]
) -> Array | None:
    """A camera position in front of the panes, around them, or on a line past them; None if no free one was found."""
    kind, progress, (distance, slope, height) = course
    glass = [pane for pane in place.panes if pane.refraction]
    first, middle = glass[0], np.mean([pane.center for pane in glass], axis=0)[:2]
    facing = math.atan2(first.normal[1], first.normal[0])
    ahead, aside = np.array([math.cos(facing), math.sin(facing)]), np.array([-math.sin(facing), math.cos(facing)])
    half = max(abs(float((pane.center[:2] - middle) @ aside)) for pane in glass) + 0.6
    for attempt in range(TRIES):
        wander = generator.normal(scale=0.05 + 0.3 * attempt / TRIES, size=3)
        if kind == "line":
            along = (2 * progress - 1) * half
            position = np.append(middle + (distance + slope * along) * ahead + along * aside, height) + wander
        else:
            spread = math.pi if kind == "around" else math.radians(ARC_DEG)
            angle, stand = facing + generator.uniform(-spread, spread), generator.uniform(*STANDS)
            start = middle + (generator.uniform(-0.6, 0.6) * half * aside if kind == "front" else 0)
            step = stand * np.array([math.cos(angle), math.sin(angle)])
            position = np.append(start + step, generator.uniform(*EYES))
        indoors = np.all((position > stage.low) & (position < stage.high))
        if indoors and is_clear(place, position):
            return position
    return None


def is_clear(place: Place, position: Array) -> bool:
    """Return whether a position [3] is outside all objects, and at least `CLEARANCE` away from them and from panes."""
    z = np.linspace(-1, 1, 64)
    turn = GOLDEN_ANGLE_RAD * np.arange(64)
    flat = np.sqrt(1 - z**2)
    directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)
    seen = place.seen(np.broadcast_to(position, directions.shape), directions, reflections=1)
    inside = any(_holds(thing, position) for thing in place.things)
    return not inside and float(np.minimum(seen.distance, seen.to_pane).min()) > CLEARANCE


def _holds(thing: Thing, position: Array) -> bool:
    """Return whether a position is inside the bounding box of an object, or outside a room."""
    room = isinstance(thing, Box) and thing.room
    if isinstance(thing, Carried):
        position, thing = (np.linalg.inv(thing.world_from_thing) @ [*position, 1.0])[:3], thing.thing
    low, high = thing.span
    return bool(np.all((position > low) & (position < high))) != room
