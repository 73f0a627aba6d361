"""A case with a glass front and a mirrored back, and a silver bowl in it: flat and curved mirrors in one place."""

from __future__ import annotations

import math

import numpy as np

from tools.pane_draws import world_from_cam
from tools.pane_tracer import Ball, Box, Place, Silver
from tools.tracer_panes import Array, Pane

SHELF, TOP = 0.7, 1.6
"""Heights of what the case stands on, and of its upper edge; it is open above and at the sides."""
FRONT, BACK = 0.1, 1.05
"""Of the case along y; the cameras are on the side of smaller y."""
HALF_WIDTH, POST = 0.8, 0.06
TOWARDS_CAMERAS, ALONG = np.array([0.0, -1.0, 0.0]), np.array([1.0, 0.0, 0.0])
BOWL = Silver((-0.05, 0.5, 1.03), (0.34, 0.34, 0.26))
SHADE = 0.6
"""Of what the case is made of: darker than the room, so that the glass shows the room."""


def case_place() -> Place:
    """The case, what is in it, and a room with things."""
    things = (
        # A bowl makes all things small: in coarse patterns there is something left to see.
        Box((-2.2, -2.2, 0.0), (2.2, 1.6, 2.6), seed=10, room=True, coarseness=2.5),
        # The case: what it stands on, its back, and its posts.
        Box((-0.9, 0.05, 0.0), (0.9, 1.2, SHELF), seed=44, shade=SHADE, coarseness=1.5),
        Box((-0.86, BACK + 0.01, SHELF), (0.86, 1.2, TOP), seed=40, shade=SHADE),
        Box((-HALF_WIDTH - POST, FRONT, SHELF), (-HALF_WIDTH, FRONT + POST, TOP), seed=61, shade=SHADE),
        Box((HALF_WIDTH, FRONT, SHELF), (HALF_WIDTH + POST, FRONT + POST, TOP), seed=65, shade=SHADE),
        # Beside the bowl, and what it stands on.
        Box((-0.17, 0.38, SHELF), (0.07, 0.62, 0.78), seed=12, shade=SHADE),
        Ball((-0.52, 0.38, 0.83), 0.13, seed=20),
        Ball((0.4, 0.3, 0.8), 0.1, seed=30),
        Box((0.45, 0.62, SHELF), (0.63, 0.8, 1.2), seed=50),
        Box((-0.6, 0.72, SHELF), (-0.42, 0.9, 1.0), seed=53),
        # The room.
        Box((-1.9, -2.1, 0.0), (-1.2, -1.6, 1.8), seed=25),
        Box((1.0, -2.1, 0.0), (1.8, -1.6, 1.1), seed=36),
        Ball((0.1, -1.9, 0.45), 0.45, seed=45),
        Ball((-1.5, 0.3, 0.45), 0.45, seed=47),
        Box((1.4, 0.2, 0.0), (1.9, 0.6, 1.5), seed=58),
    )
    middle, half_sizes = (SHELF + TOP) / 2, (HALF_WIDTH, (TOP - SHELF) / 2)
    panes = (
        Pane(1, np.array([0.0, FRONT, middle]), TOWARDS_CAMERAS, ALONG, half_sizes),
        Pane(2, np.array([0.0, BACK, middle]), TOWARDS_CAMERAS, ALONG, half_sizes, refraction=None),
    )
    return Place(things, panes, silver=(BOWL,))


def case_poses(count: int, seed: int) -> list[Array]:
    """Camera-to-world [4, 4], OpenCV axes: two of three look at the case, one of three into the room."""
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
