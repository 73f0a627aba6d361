"""Planes through random triplets."""

import numpy as np
import pytest

from glassplat.panes.masks import FramedPlanes, random_planes
from glassplat.panes.objective import Objective


def test_every_plane_passes_through_three_of_the_points() -> None:
    points = np.random.default_rng(0).standard_normal((20, 3))
    planes = random_planes(points, 50, np.random.default_rng(1))
    assert len(planes) > 30
    assert np.linalg.norm(planes.normals, axis=1) == pytest.approx(1)
    assert ((np.abs(planes.distances(points)) < 1e-9).sum(axis=1) >= 3).all()


def test_points_on_a_line_or_all_the_same_give_no_plane() -> None:
    line = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    assert len(random_planes(line, 40, np.random.default_rng(0))) == 0
    assert len(random_planes(np.ones((5, 3)), 40, np.random.default_rng(0))) == 0


def test_support_is_the_share_of_the_inliers() -> None:
    plane = FramedPlanes(np.array([[0.0, 0.0, 1.0]]), np.array([2.0]), np.zeros(1))
    points = np.array([[0.0, 0.0, 2.0], [5.0, 1.0, 2.09], [0.0, 0.0, 1.8], [0.0, 0.0, -2.0]])
    assert Objective([], points, 1.0, 0.1).inlier_share(plane) == pytest.approx([0.5])
