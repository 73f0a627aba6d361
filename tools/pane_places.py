"""Named scenes for the pane tracer, with their camera poses and people.

`screens`: two panes of glass between objects, one upright and one leaning, which are visible through each other, and a
mirror on a wall. `window`: a large window of a dark case, photographed from the front, which reflects the photographer.
`case`: a case with a glass front and a mirrored back that contains a silver bowl, so flat and curved mirrors in one
scene.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from tools.make_scenes import GOLDEN_ANGLE_RAD
from tools.pane_draws import world_from_cam
from tools.pane_things import Ball, Box, Carried, Paint, Pane, Place, Silver, Thing, standing_pane
from tools.pane_tracer import Array

LOOKED_AT = np.array([0.0, 0.1, 0.8])
ORBIT = (1.45, 1.75)
"""Smallest and largest distance of cameras from the vertical axis through `LOOKED_AT`, world units."""
HEIGHTS = (0.7, 1.7)
SHELF, TOP = 0.7, 1.6
"""Heights of the base of the case and of its upper edge; it is open at the top and at the sides."""
FRONT, BACK = 0.1, 1.05
"""Extent of the case along y; the cameras are on the side of smaller y."""
HALF_WIDTH, POST = 0.8, 0.06
TOWARDS_CAMERAS, ALONG = np.array([0.0, -1.0, 0.0]), np.array([1.0, 0.0, 0.0])
BOWL = Silver((-0.05, 0.5, 1.03), (0.34, 0.34, 0.26))
SHADE = 0.6
"""Shade of the case: darker than the room, so that reflections of the room are visible."""
WINDOW_HEIGHT = 1.25
"""Height of the centre of the pane."""
DARK, PLAIN = 0.12, 0.6
PHONE = Box((-0.08, -0.04, -0.02), (0.08, 0.04, -0.01), Paint(70, shade=0.1))
# In dark clothes, as most people are; face and hands are bright.
HEAD = Ball((0.0, 0.03, -0.2), 0.11, Paint(80))
TORSO = Box((-0.23, 0.18, -0.32), (0.23, 0.8, -0.1), Paint(90, shade=0.2))
HANDS = (Ball((-0.09, 0.05, -0.05), 0.045, Paint(80)), Ball((0.09, 0.05, -0.05), 0.045, Paint(80)))
LEG_TOP, LEG_WIDTH = 0.8, 0.18
UP = np.array([0.0, 0.0, 1.0])
EYES = (1.5, 1.75)
"""Heights of passers-by, world units."""
FROM_WALLS, FROM_CAMERA = 0.4, 0.7


def screens_place() -> Place:
    """The scene `screens`: a room with objects and panes."""
    things = (
        Box((-2.2, -2.2, 0.0), (2.2, 2.2, 2.6), Paint(10), room=True),
        Ball((0.35, 0.15, 0.25), 0.25, Paint(20)),
        Ball((-0.6, -0.9, 0.3), 0.3, Paint(30)),
        Box((-0.95, 0.85, 0.0), (-0.6, 1.15, 0.9), Paint(40)),
        Box((0.85, -0.95, 0.0), (1.1, -0.7, 0.6), Paint(50)),
        Box((0.5, 1.05, 0.0), (0.85, 1.3, 0.5), Paint(60)),
    )
    return Place(
        things,
        (
            standing_pane(1, (0.0, -0.3, 0.85), turn_deg=10, lean_deg=0, half_sizes=(0.75, 0.55)),
            standing_pane(2, (0.1, 0.65, 0.8), turn_deg=-20, lean_deg=25, half_sizes=(0.6, 0.5)),
            standing_pane(3, (2.19, 0.0, 1.1), turn_deg=90, lean_deg=0, half_sizes=(0.7, 0.5), refraction=None),
        ),
    )


def screens_poses(count: int, seed: int) -> list[Array]:
    """Camera-to-world [4, 4]: two in three face the panes from all around, one in three faces the room."""
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


def window_place() -> Place:
    """The scene `window`: a room with a case behind glass at its far end, and objects on both sides."""
    things = (
        Box((-2.2, -3.4, 0.0), (2.2, 0.9, 2.6), Paint(10, shade=PLAIN), room=True),
        # The case: its floor, its back, and its contents.
        Box((-2.3, 0.02, -0.1), (2.3, 1.0, 0.55), Paint(40, shade=DARK)),
        Box((-2.3, 0.8, 0.4), (2.3, 1.0, 2.7), Paint(60, shade=DARK)),
        Box((-2.3, 0.02, 2.0), (2.3, 1.0, 2.7), Paint(65, shade=DARK)),
        Ball((-0.7, 0.4, 0.8), 0.25, Paint(20, shade=DARK)),
        Ball((0.15, 0.5, 0.73), 0.18, Paint(30, shade=PLAIN)),
        Box((0.55, 0.25, 0.55), (0.9, 0.6, 1.3), Paint(50, shade=DARK)),
        # The room.
        Box((-2.0, -3.2, 0.0), (-1.2, -2.8, 1.9), Paint(25)),
        Box((1.3, -3.0, 0.0), (1.9, -2.4, 0.8), Paint(35)),
        Ball((0.4, -3.0, 0.35), 0.35, Paint(45)),
    )
    pane = Pane(1, np.array([0.0, 0.0, WINDOW_HEIGHT]), np.array([0.0, -1.0, 0.0]), np.array([1.0, 0, 0]), (1.3, 0.7))
    return Place(things, (pane,))


def window_poses(count: int, seed: int) -> list[Array]:
    """Camera-to-world [4, 4], OpenCV axes: two in three face the window, one in three the room."""
    generator = np.random.default_rng(seed)
    poses = []
    for number in range(count):
        position = generator.uniform((-1.2, -2.2, 1.1), (1.2, -0.9, 1.7))
        if number % 3 == 2:
            angle = math.radians(generator.uniform(180, 360))
            target = position + np.array([math.cos(angle), math.sin(angle), generator.uniform(-0.3, 0.2)])
        else:
            target = np.array([generator.uniform(-0.6, 0.6), 0.0, generator.uniform(0.85, 1.4)])
        poses.append(world_from_cam(position, target))
    return poses


def case_place() -> Place:
    """The scene `case`: the case with its contents, in a room with objects."""
    things = (
        # A coarse pattern, because the bowl shows everything reduced in size.
        Box((-2.2, -2.2, 0.0), (2.2, 1.6, 2.6), Paint(10, coarseness=2.5), room=True),
        # The case: its base, its back, and its posts.
        Box((-0.9, 0.05, 0.0), (0.9, 1.2, SHELF), Paint(44, shade=SHADE, coarseness=1.5)),
        Box((-0.86, BACK + 0.01, SHELF), (0.86, 1.2, TOP), Paint(40, shade=SHADE)),
        Box((-HALF_WIDTH - POST, FRONT, SHELF), (-HALF_WIDTH, FRONT + POST, TOP), Paint(61, shade=SHADE)),
        Box((HALF_WIDTH, FRONT, SHELF), (HALF_WIDTH + POST, FRONT + POST, TOP), Paint(65, shade=SHADE)),
        # Objects next to the bowl, and its stand.
        Box((-0.17, 0.38, SHELF), (0.07, 0.62, 0.78), Paint(12, shade=SHADE)),
        Ball((-0.52, 0.38, 0.83), 0.13, Paint(20)),
        Ball((0.4, 0.3, 0.8), 0.1, Paint(30)),
        Box((0.45, 0.62, SHELF), (0.63, 0.8, 1.2), Paint(50)),
        Box((-0.6, 0.72, SHELF), (-0.42, 0.9, 1.0), Paint(53)),
        # The room.
        Box((-1.9, -2.1, 0.0), (-1.2, -1.6, 1.8), Paint(25)),
        Box((1.0, -2.1, 0.0), (1.8, -1.6, 1.1), Paint(36)),
        Ball((0.1, -1.9, 0.45), 0.45, Paint(45)),
        Ball((-1.5, 0.3, 0.45), 0.45, Paint(47)),
        Box((1.4, 0.2, 0.0), (1.9, 0.6, 1.5), Paint(58)),
    )
    middle, half_sizes = (SHELF + TOP) / 2, (HALF_WIDTH, (TOP - SHELF) / 2)
    panes = (
        Pane(1, np.array([0.0, FRONT, middle]), TOWARDS_CAMERAS, ALONG, half_sizes),
        Pane(2, np.array([0.0, BACK, middle]), TOWARDS_CAMERAS, ALONG, half_sizes, refraction=None),
    )
    return Place(things, panes, silver=(BOWL,))


def case_poses(count: int, seed: int) -> list[Array]:
    """Camera-to-world [4, 4], OpenCV axes: two in three face the case, one in three the room."""
    generator = np.random.default_rng(seed)
    poses = []
    for number in range(count):
        position = generator.uniform((-1.3, -1.3, 1.0), (1.3, -0.4, 1.7))
        target = np.array([0.0, 0.5, 1.05]) + generator.normal(scale=(0.15, 0.1, 0.08))
        if number % 3 == 2:
            angle = math.radians(generator.uniform(150, 390))
            target = position + np.array([math.cos(angle), math.sin(angle), generator.uniform(-0.35, 0.2)])
        poses.append(world_from_cam(position, target))
    return poses


def photographer(world_from_cam: Array) -> tuple[Thing, ...]:
    """The photographer, in a room with the floor at z = 0.

    The body follows the height and azimuth of the camera, but stays upright when the camera is tilted.

    Args:
        world_from_cam: [4, 4] pose of the photograph, OpenCV axes, world units in metres.
    """
    frame, height = upright_frame(world_from_cam), float(world_from_cam[2, 3])
    parts: list[Ball | Box] = [PHONE, HEAD, TORSO, *HANDS]
    if height > LEG_TOP:
        for side in (-1, 1):
            low, high = sorted((side * 0.04, side * (0.04 + LEG_WIDTH)))
            parts.append(Box((low, LEG_TOP, -0.3), (high, height, -0.12), Paint(100, shade=0.12)))
    return tuple(Carried(part, frame) for part in parts)


def passer_by(room: Box, camera: Array, generator: np.random.Generator) -> tuple[Thing, ...]:
    """A person at a random position and azimuth in a room, at a distance from the camera.

    Args:
        room: room with the floor at z = 0.
        camera: [3] position of the camera.
        generator: random generator.
    """
    low, high = np.array(room.low)[:2] + FROM_WALLS, np.array(room.high)[:2] - FROM_WALLS
    place = generator.uniform(low, high)
    while np.linalg.norm(place - camera[:2]) < FROM_CAMERA:
        place = generator.uniform(low, high)
    pose = np.eye(4)
    angle = generator.uniform(0, 2 * np.pi)
    ahead = np.array([np.cos(angle), np.sin(angle), 0.0])
    pose[:3] = np.stack([np.cross(-UP, ahead), -UP, ahead, [*place, generator.uniform(*EYES)]], axis=1)
    return photographer(pose)


def upright_frame(world_from_cam: Array) -> Array:
    """[4, 4] camera frame, rotated so that its y axis points straight down and its x axis is level."""
    forward = world_from_cam[:3, 2] - (world_from_cam[:3, 2] @ UP) * UP
    forward /= np.linalg.norm(forward)
    frame = np.eye(4)
    frame[:3, :3] = np.stack([np.cross(-UP, forward), -UP, forward], axis=1)
    frame[:3, 3] = world_from_cam[:3, 3]
    return frame
