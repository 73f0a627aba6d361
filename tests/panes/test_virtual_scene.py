from __future__ import annotations

import torch

from glassplat.panes.material import virtual_points
from glassplat.scene.panes import Planes
from tests.render.tiny_scene import camera_at, pane

CAMERAS = [camera_at(0.0, 0.0, -0.2), camera_at(0.3, 0.0, 0.1), camera_at(-0.3, 0.1, 0.0)]


def test_only_what_is_seen_through_the_mirror_is_virtual() -> None:
    points = torch.tensor([[0.1, 0.0, 3.0], [0.1, 0.0, 1.0], [1.8, 0.0, 3.0], [0.0, 0.0, -4.0]], dtype=torch.float64)
    assert virtual_points(points, pane(2.0, half=0.5), CAMERAS).tolist() == [True, False, False, False]


def test_points_visible_past_the_mirror_are_kept() -> None:
    point = torch.tensor([[0.1, 0.0, 3.0]], dtype=torch.float64)
    beside = [camera_at(1.4, 0.0, 0.0), camera_at(1.5, 0.1, 0.0)]
    assert virtual_points(point, pane(2.0, half=0.3), CAMERAS[:2] + beside[:1]).tolist() == [True]
    assert virtual_points(point, pane(2.0, half=0.3), CAMERAS[:1] + beside).tolist() == [False]


def test_without_mirrors_nothing_is_virtual() -> None:
    assert not bool(virtual_points(torch.ones(3, 3), Planes.empty(), CAMERAS).any())
