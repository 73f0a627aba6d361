"""Planes through random triplets."""

import numpy as np
import pytest

from glassplat.init.ransac import PlaneEquations, random_planes, support


def test_every_plane_passes_through_three_of_the_points() -> None:
    points = np.random.default_rng(0).standard_normal((20, 3))
    planes = random_planes(points, np.ones(20), 50, np.random.default_rng(1))
    assert len(planes) > 30
    assert np.linalg.norm(planes.normals, axis=1) == pytest.approx(1)
    assert ((np.abs(planes.distances(points)) < 1e-9).sum(axis=1) >= 3).all()


def test_points_on_a_line_or_all_the_same_give_no_plane() -> None:
    line = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    assert len(random_planes(line, np.ones(5), 40, np.random.default_rng(0))) == 0
    assert len(random_planes(np.ones((5, 3)), np.ones(5), 40, np.random.default_rng(0))) == 0


def test_points_without_weight_are_never_drawn() -> None:
    rng = np.random.default_rng(0)
    flat = rng.standard_normal((10, 3)) * [1, 1, 0]
    points = np.concatenate([flat, rng.standard_normal((10, 3)) + 5])
    weights = np.concatenate([np.ones(10), np.zeros(10)])
    planes = random_planes(points, weights, 40, rng)
    assert np.abs(planes.normals[:, 2]) == pytest.approx(1)
    assert support(planes, points, weights, distance=1e-6) == pytest.approx(1)


def test_support_is_the_weight_of_the_inliers() -> None:
    plane = PlaneEquations(np.array([[0.0, 0.0, 1.0]]), np.array([2.0]))
    points = np.array([[0.0, 0.0, 2.0], [5.0, 1.0, 2.09], [0.0, 0.0, 1.8], [0.0, 0.0, -2.0]])
    assert support(plane, points, np.array([1.0, 2.0, 3.0, 4.0]), distance=0.1) == pytest.approx([0.3])
