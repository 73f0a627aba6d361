"""From photographs to suggested panes: a room is drawn with a mirror in it, and without."""

from __future__ import annotations

import numpy as np
import torch

from glassplat.data.view import View
from glassplat.scene.camera import Camera
from glassplat.suggest.suggestion import Suggestion, suggested_panes
from tests.suggest.mirror_room import eye_at

WIDTH, HEIGHT, FOCAL = 240, 180, 200.0
HALF = np.array([0.65, 0.5])


def texture() -> np.ndarray:
    """[T, T] blobs, none of which is like its own mirror image."""
    rng = np.random.default_rng(3)
    fine = np.kron(rng.integers(0, 256, (45, 45)), np.ones((8, 8)))
    coarse = np.kron(rng.integers(0, 256, (15, 15)), np.ones((24, 24)))
    return 0.5 * fine + 0.5 * coarse


TEXTURE = texture()


def drawn(center: np.ndarray, target: np.ndarray, *, mirror: bool) -> View:
    """A photograph of the wall y = 0, grey but for its mirror, or of the wall y = 3 opposite."""
    eye = eye_at(center, target)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(x - WIDTH / 2) / FOCAL, (y - HEIGHT / 2) / FOCAL, np.ones_like(x)], axis=-1) @ eye.rotation
    wall = center - rays * (center[1] / rays[..., 1:2])
    in_mirror = (rays[..., 1] < 0) & (np.abs(wall[..., [0, 2]]) < HALF).all(axis=-1)
    shows = in_mirror if mirror else np.zeros_like(in_mirror)
    away = np.where(rays[..., 1] > 0, (3 - center[1]) / rays[..., 1], (3 + center[1]) / -rays[..., 1])
    place = center[[0, 2]] + away[..., None] * rays[..., [0, 2]]
    column, row = (np.floor((place + 3) * 60).astype(np.int64) % 360).transpose(2, 0, 1)
    grey = np.where(shows | (rays[..., 1] > 0), TEXTURE[row, column], 100).astype(np.uint8)
    pose = torch.eye(4)
    pose[:3, :3] = torch.tensor(eye.rotation)
    pose[:3, 3] = torch.tensor(-eye.rotation @ center)
    camera = Camera(pose, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, width=WIDTH, height=HEIGHT)
    photo = torch.from_numpy(np.repeat(grey[..., None], 3, axis=2))
    return View.in_memory(f"{center.tolist()}.png", camera, photo=photo)


def photographs(*, mirror: bool) -> list[View]:
    places = [np.array([x, 1.3, z]) for x in (-0.6, -0.2, 0.2, 0.6) for z in (-0.15, 0.15)]
    to_wall = [drawn(place, np.zeros(3), mirror=mirror) for place in places]
    return to_wall + [drawn(place, place * (0.5, 0, 1) + (0, 3.0, 0), mirror=mirror) for place in places]


def suggested(*, mirror: bool) -> list[Suggestion]:
    return suggested_panes(photographs(mirror=mirror), 1.0, lambda what, done, count: None)


def test_a_mirror_is_suggested() -> None:
    (found,) = suggested(mirror=True)
    assert found.normal[1] > np.cos(np.radians(1)), "towards the cameras"
    assert np.abs(found.corners[:, 1]).max() < 0.03
    assert np.allclose(np.abs(found.corners[:, [0, 2]]), HALF, atol=0.1)
    assert "things are seen in it and directly too, in 8 photographs" in found.described()


def test_a_room_without_a_mirror_has_no_suggestion() -> None:
    assert suggested(mirror=False) == []
