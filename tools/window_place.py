"""A large window before a dark case, photographed from the front: where whoever takes the photographs is seen."""

from __future__ import annotations

import math

import numpy as np

from tools.pane_draws import world_from_cam
from tools.pane_tracer import Ball, Box, Place
from tools.tracer_panes import Array, Pane

WINDOW_HEIGHT = 1.25
"""Of the middle of the pane."""
DARK, PLAIN = 0.12, 0.6


def window_place() -> Place:
    """A room whose far end is a case behind glass, with things on either side."""
    things = (
        Box((-2.2, -3.4, 0.0), (2.2, 0.9, 2.6), seed=10, room=True, shade=PLAIN),
        # The case: its floor, its back, and what stands in it.
        Box((-2.3, 0.02, -0.1), (2.3, 1.0, 0.55), seed=40, shade=DARK),
        Box((-2.3, 0.8, 0.4), (2.3, 1.0, 2.7), seed=60, shade=DARK),
        Box((-2.3, 0.02, 2.0), (2.3, 1.0, 2.7), seed=65, shade=DARK),
        Ball((-0.7, 0.4, 0.8), 0.25, seed=20, shade=DARK),
        Ball((0.15, 0.5, 0.73), 0.18, seed=30, shade=PLAIN),
        Box((0.55, 0.25, 0.55), (0.9, 0.6, 1.3), seed=50, shade=DARK),
        # The room.
        Box((-2.0, -3.2, 0.0), (-1.2, -2.8, 1.9), seed=25),
        Box((1.3, -3.0, 0.0), (1.9, -2.4, 0.8), seed=35),
        Ball((0.4, -3.0, 0.35), 0.35, seed=45),
    )
    pane = Pane(1, np.array([0.0, 0.0, WINDOW_HEIGHT]), np.array([0.0, -1.0, 0.0]), np.array([1.0, 0, 0]), (1.3, 0.7))
    return Place(things, (pane,))


def window_poses(count: int, seed: int) -> list[Array]:
    """Camera-to-world [4, 4], OpenCV axes: two of three look at the window, one of three into the room."""
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
