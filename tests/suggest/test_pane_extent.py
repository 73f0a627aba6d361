"""The rectangle of a suggested pane holds what is seen mirrored in it, and ends at its frame."""

from __future__ import annotations

import numpy as np

from glassplat.scene.eye import Eye
from glassplat.suggest.mirror_matches import Plane
from glassplat.suggest.pane_extent import crossings, pane_axes, pane_corners
from tests.suggest.mirror_room import Room, eye_at, things

WALL = Plane(np.array([0.0, 1.0, 0.0]), 0.0)
HALF = np.array([0.6, 0.4])


def eyes() -> list[Eye]:
    return [eye_at(np.array([x, 2.0, z]), np.zeros(3)) for x in (-0.9, -0.3, 0.3, 0.9) for z in (-0.2, 0.2)]


def seen_in_the_pane() -> tuple[Room, np.ndarray]:
    """Mirror images within a part of the pane, none in its outer tenth."""
    rng = np.random.default_rng(0)
    room = Room(eyes(), rng, noise=0.0)
    points, tips = things(rng, 400)
    for point, tip in zip(WALL.mirrored(points), WALL.mirrored(tips), strict=True):
        for view, eye in enumerate(room.eyes):
            step = eye.center[1] / (eye.center[1] - point[1])
            cross = eye.center + step * (point - eye.center)
            if (np.abs(cross[[0, 2]]) < 0.9 * HALF).all():
                room.see(point, tip, np.arange(len(room.eyes)) == view)
    return room, np.arange(len(room.rows))


def picture(eye: Eye, seed: int) -> np.ndarray:
    """[H, W] noise in the pane, which differs between views, on a wall that does not."""
    x, y = np.meshgrid(np.arange(400) + 0.5, np.arange(300) + 0.5)
    rays = eye.rays(np.stack([x, y], axis=-1))
    place = eye.center - rays * (eye.center[1] / rays[..., 1:2])
    pane = (np.abs(place[..., [0, 2]]) < HALF).all(axis=-1)
    noise = np.random.default_rng(seed).integers(0, 256, pane.shape)
    return np.where(pane, noise, 90).astype(np.uint8)


def test_sight_lines_cross_in_the_plane() -> None:
    room, numbers = seen_in_the_pane()
    places = crossings(WALL, room.seen, numbers)
    assert np.allclose(places[:, 1], 0, atol=1e-9)
    assert (np.abs(places[:, [0, 2]]) < HALF).all()


def test_the_rectangle_goes_out_to_the_frame() -> None:
    room, numbers = seen_in_the_pane()
    corners = pane_corners(WALL, room.seen, numbers, lambda view: picture(room.eyes[view], view))
    assert np.allclose(np.abs(corners[:, [0, 2]]), HALF, atol=0.06)
    assert np.allclose(corners[:, 1], 0, atol=1e-9)
    sides = np.diff(np.concatenate([corners, corners[:1]]), axis=0)
    assert np.allclose(np.sum(sides * np.roll(sides, 1, axis=0), axis=1), 0, atol=1e-9), "right angles"


def test_without_a_frame_it_holds_what_is_mirrored() -> None:
    room, numbers = seen_in_the_pane()
    noise = np.random.default_rng(1).integers(0, 256, (len(room.eyes), 300, 400)).astype(np.uint8)
    corners = pane_corners(WALL, room.seen, numbers, lambda view: noise[view])
    assert (np.abs(corners[:, [0, 2]]) < HALF).all()
    assert (np.abs(corners[:, [0, 2]]) > 0.7 * HALF).all()


def test_axes_are_level_and_upright_even_in_a_floor() -> None:
    level, upright = pane_axes(WALL, eyes())
    assert abs(level[2]) < 0.1
    assert abs(upright[2]) > 0.99
    floor = Plane(np.array([0.0, 0.0, 1.0]), -1.0)
    axes = pane_axes(floor, eyes())
    assert np.allclose(axes @ axes.T, np.eye(2), atol=1e-12)
    assert np.allclose(axes @ floor.normal, 0, atol=1e-12)
