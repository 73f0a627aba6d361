"""Bodies for synthetic captures: who stands upright behind the camera, holding it before the face; and who walks by."""

from __future__ import annotations

import numpy as np

from tools.pane_tracer import Ball, Box, Carried, Thing
from tools.tracer_panes import Array

PHONE = Box((-0.08, -0.04, -0.02), (0.08, 0.04, -0.01), seed=70, shade=0.1)
# In dark clothes, as most people are; face and hands are bright.
HEAD = Ball((0.0, 0.03, -0.2), 0.11, seed=80)
TORSO = Box((-0.23, 0.18, -0.32), (0.23, 0.8, -0.1), seed=90, shade=0.2)
HANDS = (Ball((-0.09, 0.05, -0.05), 0.045, seed=80), Ball((0.09, 0.05, -0.05), 0.045, seed=80))
LEG_TOP, LEG_WIDTH = 0.8, 0.18
UP = np.array([0.0, 0.0, 1.0])
EYES = (1.5, 1.75)
"""Heights of those who walk by, world units."""
FROM_WALLS, FROM_CAMERA = 0.4, 0.7


def photographer(world_from_cam: Array) -> tuple[Thing, ...]:
    """Who took a photograph of a room with the floor at z = 0.

    The body is as high as the camera needs it and turns with it, but stands upright however the camera is tilted.

    Args:
        world_from_cam: [4, 4] of the photograph, OpenCV axes, world units as metres.
    """
    frame, height = upright_frame(world_from_cam), float(world_from_cam[2, 3])
    parts: list[Thing] = [PHONE, HEAD, TORSO, *HANDS]
    if height > LEG_TOP:
        for side in (-1, 1):
            low, high = sorted((side * 0.04, side * (0.04 + LEG_WIDTH)))
            parts.append(Box((low, LEG_TOP, -0.3), (high, height, -0.12), seed=100, shade=0.12))
    return tuple(Carried(part, frame) for part in parts)


def passer_by(room: Box, camera: Array, generator: np.random.Generator) -> tuple[Thing, ...]:
    """Somebody who stands anywhere in a room, turned anywhere, but not where the camera is.

    Args:
        room: with the floor at z = 0.
        camera: [3] its place.
        generator: where the place comes from.
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
    """[4, 4] the camera's frame, turned so that its y axis points straight down; its x axis stays level."""
    forward = world_from_cam[:3, 2] - (world_from_cam[:3, 2] @ UP) * UP
    forward /= np.linalg.norm(forward)
    frame = np.eye(4)
    frame[:3, :3] = np.stack([np.cross(-UP, forward), -UP, forward], axis=1)
    frame[:3, 3] = world_from_cam[:3, 3]
    return frame
