"""Random points lie in the region seen by the cameras, for every kind of capture."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from glassplat.captures.transforms import points_in_box, points_in_view
from glassplat.scene.camera import Camera


def camera_at(center: np.ndarray, forward: np.ndarray) -> Camera:
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = torch.eye(4)
    pose[:3, :3] = torch.tensor(np.stack([right, np.cross(forward, right), forward]))
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor(center).float()
    return Camera(pose, 30.0, 30.0, 16.0, 12.0, 32, 24)


def ring(direction: float) -> list[Camera]:
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    rays = [np.array([np.cos(a), np.sin(a), 0.0]) for a in angles]
    return [camera_at(3 * ray + [5.0, 0.0, 1.0], direction * ray) for ray in rays]


def test_cameras_around_an_object() -> None:
    offsets = points_in_view(ring(-1.0)).positions - np.array([5.0, 0.0, 1.0])
    assert np.linalg.norm(offsets, axis=1).max() == pytest.approx(3.0, rel=0.01)
    assert np.linalg.norm(offsets.mean(0)) < 0.1


def test_cameras_that_look_outwards_get_points_beyond_them() -> None:
    offsets = points_in_view(ring(1.0)).positions - np.array([5.0, 0.0, 1.0])
    assert (np.linalg.norm(offsets, axis=1) > 3.0).mean() > 0.9


def test_cameras_side_by_side_get_points_ahead() -> None:
    cameras = [camera_at(np.array([0.1 * i, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])) for i in range(5)]
    positions = points_in_view(cameras).positions
    assert (positions[:, 1] > 0).mean() > 0.99


def test_box_is_uniform_and_repeatable() -> None:
    first, second = points_in_box(), points_in_box()
    np.testing.assert_array_equal(first.positions, second.positions)
    assert len(first) == 100_000
    np.testing.assert_allclose(first.positions.std(0), np.full(3, 1.3 / 3**0.5), rtol=0.02)
