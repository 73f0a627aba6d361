"""The smallest rectangle that encloses points."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from glassplat.panes.masks import min_area_rectangle

CORNERS = np.array([[-2.0, -0.5], [2.0, -0.5], [2.0, 0.5], [-2.0, 0.5]])


def turned(points: np.ndarray, angle: float) -> np.ndarray:
    cos, sin = math.cos(angle), math.sin(angle)
    return points @ np.array([[cos, sin], [-sin, cos]])


@given(angle=st.floats(-4, 4), x=st.floats(-100, 100), y=st.floats(-100, 100))
def test_finds_a_turned_rectangle_among_points_inside(angle: float, x: float, y: float) -> None:
    inside = CORNERS[0] + np.random.default_rng(0).random((50, 2)) * [4, 1]
    points = turned(np.concatenate([inside, CORNERS]), angle) + np.array([x, y])
    rectangle = min_area_rectangle(points)
    assert rectangle.center == pytest.approx([x, y], abs=1e-6)
    assert rectangle.half_sizes == pytest.approx([2, 0.5], abs=1e-6)
    assert abs(rectangle.axis @ [math.cos(angle), math.sin(angle)]) == pytest.approx(1)


def test_no_orientation_gives_a_smaller_rectangle() -> None:
    points = np.random.default_rng(1).standard_normal((200, 2)) @ np.array([[2.0, 0.3], [0.0, 0.7]])
    rectangle = min_area_rectangle(points)
    extents = [np.ptp(turned(points, angle), axis=0) for angle in np.linspace(0, math.pi, 721)]
    assert 4 * np.prod(rectangle.half_sizes) <= min(np.prod(extent) for extent in extents) + 1e-9


def test_holds_every_point() -> None:
    points = np.random.default_rng(2).standard_normal((30, 2))
    rectangle = min_area_rectangle(points)
    across = np.array([-rectangle.axis[1], rectangle.axis[0]])
    away = np.abs((points - rectangle.center) @ np.stack([rectangle.axis, across], axis=1))
    assert (away <= rectangle.half_sizes + 1e-9).all()


@pytest.mark.parametrize("points", [np.zeros((0, 2)), np.ones((2, 2)), np.arange(8.0).reshape(4, 2)])
def test_points_without_an_area_are_refused(points: np.ndarray) -> None:
    with pytest.raises(ValueError, match="do not span an area"):
        min_area_rectangle(points)
