"""Corners and edges marked by hand in a few photographs determine the pane's plane and outline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from glassplat.annotate.fit import (
    Marks,
    TooFewMarksError,
    corner_information,
    fit_pane,
    polygon_pane,
    rectangle_pane,
    tilt_deviation,
)
from glassplat.scene.camera import NumpyCamera
from tests.panes.pane_scene import EYES, FRONT, SIDE, Pane, camera_from

U, V = np.array([-1.0, 1, 1, -1]), np.array([-1.0, -1, 1, 1])


def cameras_on(pane: Pane, places: Sequence[Sequence[float]] = EYES) -> list[NumpyCamera]:
    return [NumpyCamera.from_camera(camera_from(place, pane.center)) for place in places]


def corner_marks(pane: Pane, cameras: Sequence[NumpyCamera], *, noise: float = 0.0, seed: int = 0) -> Marks:
    """Every corner marked in every view."""
    rng = np.random.default_rng(seed)
    corners = pane.at(U, V)
    return Marks(
        [
            {view: camera.project(corner) + noise * rng.standard_normal(2) for view, camera in enumerate(cameras)}
            for corner in corners
        ]
    )


def normal_off(frame: np.ndarray, pane: Pane) -> float:
    """Angle in degrees between planes, whichever way they face."""
    return float(np.degrees(np.arccos(min(abs(frame[2] @ pane.normal), 1.0))))


@pytest.mark.parametrize("pane", [FRONT, SIDE], ids=["front", "side"])
@pytest.mark.parametrize("shape", ["rectangle", "polygon"])
def test_exact_marks_give_the_pane(pane: Pane, shape: str) -> None:
    cameras = cameras_on(pane)
    fit = fit_pane(corner_marks(pane, cameras), cameras, shape)  # type: ignore[arg-type]
    np.testing.assert_allclose(fit.shape.corners(), pane.at(U, V), atol=1e-4)
    assert fit.error < 1e-2 and normal_off(fit.shape.axes, pane) < 1e-2
    np.testing.assert_allclose(fit.shape.axes @ fit.shape.axes.T, np.eye(3), atol=1e-9)


@pytest.mark.parametrize("count", [2, 3])
def test_the_error_of_the_plane_matches_its_uncertainty(count: int) -> None:
    cameras = cameras_on(FRONT, EYES[:count])
    fits = [fit_pane(corner_marks(FRONT, cameras, noise=0.37, seed=seed), cameras, "rectangle") for seed in range(30)]
    errors = np.array([normal_off(fit.shape.axes, FRONT) for fit in fits])
    uncertainty = np.median([fit.uncertainty for fit in fits])
    assert 0.3 * uncertainty < np.sqrt((errors**2).mean()) < 2 * uncertainty


def test_marking_the_suggested_view_lowers_the_uncertainty_as_predicted() -> None:
    cameras = cameras_on(FRONT)
    two = fit_pane(corner_marks(FRONT, cameras[:2], noise=0.2), cameras[:2], "rectangle")
    three = fit_pane(corner_marks(FRONT, cameras, noise=0.2), cameras, "rectangle")
    foretold = tilt_deviation(two.information + corner_information(cameras[2], two.shape))
    assert three.uncertainty < two.uncertainty
    assert foretold == pytest.approx(three.uncertainty, rel=0.3)


def test_a_corner_outside_of_the_image_may_be_marked() -> None:
    wide = FRONT.larger(2.5)
    cameras = cameras_on(wide)
    assert not all(camera.contains(wide.at(U, V)).all() for camera in cameras)
    fit = fit_pane(corner_marks(wide, cameras), cameras, "rectangle")
    np.testing.assert_allclose(fit.shape.corners(), wide.at(U, V), atol=1e-3)


@pytest.mark.parametrize("shape", ["rectangle", "polygon"])
def test_one_wrong_mark_moves_the_plane_little(shape: str) -> None:
    cameras = cameras_on(FRONT, [*EYES, (0.6, 0.7, -0.5)])
    marks = corner_marks(FRONT, cameras)
    marks.corners[1][2] = marks.corners[1][2] + 30.0
    fit = fit_pane(marks, cameras, shape)  # type: ignore[arg-type]
    assert normal_off(fit.shape.axes, FRONT) < 0.5
    assert max(fit.errors, key=fit.errors.__getitem__) == 2


def test_a_fourth_corner_may_be_marked_in_one_view_only() -> None:
    cameras = cameras_on(FRONT)
    marks = corner_marks(FRONT, cameras)
    kept = {1: marks.corners[3][1]}
    fit = fit_pane(Marks([*marks.corners[:3], kept]), cameras, "polygon")
    np.testing.assert_allclose(fit.shape.corners(), FRONT.at(U, V), atol=1e-3)
    hidden = fit_pane(Marks([*marks.corners[:3], {}]), cameras, "rectangle")
    np.testing.assert_allclose(hidden.shape.corners(), FRONT.at(U, V), atol=1e-3)


def edge_marks(pane: Pane, cameras: Sequence[NumpyCamera], edges: Sequence[int], reach: float = 0.7) -> Marks:
    """Two points on some edges in every view, without any corners."""
    corners = pane.at(U, V)
    found: list[dict[int, np.ndarray]] = [{} for _ in range(4)]
    for number in edges:
        one, other = corners[number], corners[(number + 1) % 4]
        ends = np.stack([one + (1 - reach) * (other - one), one + reach * (other - one)])
        found[number] = {view: camera.project(ends) for view, camera in enumerate(cameras)}
    return Marks([{}, {}, {}, {}], found)


def test_all_edges_without_a_corner_give_the_pane() -> None:
    cameras = cameras_on(FRONT)
    fit = fit_pane(edge_marks(FRONT, cameras, range(4)), cameras, "rectangle")
    np.testing.assert_allclose(fit.shape.corners(), FRONT.at(U, V), atol=1e-3)


def test_two_edges_give_the_plane_and_as_much_of_the_pane_as_was_marked() -> None:
    cameras = cameras_on(FRONT)
    fit = fit_pane(edge_marks(FRONT, cameras, (1, 3)), cameras, "rectangle")
    assert normal_off(fit.shape.axes, FRONT) < 0.1
    assert fit.uncertainty < 5
    sizes = np.linalg.norm(np.diff(fit.shape.corners()[:3], axis=0), axis=1)
    assert sizes[0] == pytest.approx(1.6, rel=0.02)


def test_the_ends_of_a_long_front_may_be_marked_in_one_photograph_only() -> None:
    """As on a walk along a facade: only one photograph shows its near end."""
    front = Pane(np.array([0.0, 0, 0]), np.array([0.0, 0, 1.0]), np.array([1.0, 0, 0]), (7.0, 1.7))
    walk = {-1.5: -5.5, -2.5: -6.5, -4.0: -7.0, 1.5: -4.0, 5.5: 2.5}
    cameras = [
        NumpyCamera.from_camera(camera_from((x, 0.2, 5.0 - 0.2 * x), np.array([target, 0, 0])))
        for x, target in walk.items()
    ]
    corners = front.at(U, V)
    pieces = {0: (0.0, 0.2), 1: (0.0, 0.15), 3: (0.1, 0.3), 4: (0.45, 0.9)}
    rng = np.random.default_rng(0)

    def seen(view: int, begin: int, end: int, piece: Sequence[float] = (0.0, 1.0)) -> np.ndarray:
        ends = [corners[begin] + share * (corners[end] - corners[begin]) for share in piece]
        return np.stack([cameras[view].project(one) + 0.3 * rng.standard_normal(2) for one in ends])

    edges: list[dict[int, np.ndarray]] = [
        {view: seen(view, 0, 1, piece) for view, piece in pieces.items()},
        {4: seen(4, 1, 2)},
        {view: seen(view, 3, 2, piece) for view, piece in pieces.items()},
        {view: seen(view, 3, 0) for view in (0, 2)},
    ]
    places: list[dict[int, np.ndarray]] = [{}, {}, {}, {view: cameras[view].project(corners[3]) for view in (0, 1, 2)}]
    fit = fit_pane(Marks(places, edges), cameras, "rectangle")
    assert normal_off(fit.shape.axes, front) < 2 * fit.uncertainty < 4
    np.testing.assert_allclose(fit.shape.corners(), corners, atol=0.5)


def test_a_corner_marked_in_one_photograph_bounds_the_pane() -> None:
    """Three sides are marked in every photograph, the fourth by a corner in one of them, far from the first guess."""
    wide = replace(FRONT, half_sizes=(2.5, 0.8))
    cameras, corners = cameras_on(wide), wide.at(U, V)
    rng = np.random.default_rng(0)

    def seen(begin: int, end: int, piece: Sequence[float]) -> dict[int, np.ndarray]:
        ends = [corners[begin] + reach * (corners[end] - corners[begin]) for reach in piece]
        return {
            view: np.stack([camera.project(one) + 3 * rng.standard_normal(2) for one in ends])
            for view, camera in enumerate(cameras)
        }

    edges = [seen(0, 1, (0.0, 1.0)), seen(1, 2, (0.0, 0.1)), {}, seen(3, 0, (0.9, 1.0))]
    fit = fit_pane(Marks([{}, {}, {0: cameras[0].project(corners[2])}, {}], edges), cameras, "rectangle")
    np.testing.assert_allclose(fit.shape.corners()[2], corners[2], atol=0.1)
    assert fit.error < 4


@pytest.mark.parametrize("elsewhere", [0, 1, 3])
def test_a_swapped_corner_gives_a_poor_fit_without_an_error(elsewhere: int) -> None:
    cameras = cameras_on(FRONT)
    places = list(corner_marks(FRONT, cameras).corners)
    places[2] = {0: places[elsewhere][0]}
    fit = fit_pane(Marks(places), cameras, "rectangle")
    assert fit.error > 10 and fit.uncertainty > 10


def test_edges_of_five_corners_are_fitted_too() -> None:
    cameras = cameras_on(FRONT)
    outline = FRONT.at(np.array([-1, 1, 1, 0.2, -1.0]), np.array([-1, -1, 1, 0.4, 1.0]))
    marks = Marks([{view: camera.project(corner) for view, camera in enumerate(cameras)} for corner in outline])
    fit = fit_pane(marks, cameras, "rectangle")  # Five corners do not form a rectangle.
    np.testing.assert_allclose(fit.shape.corners(), outline, atol=1e-3)


@pytest.mark.parametrize(
    ("kept", "expected"),
    [
        ({0: 4}, "a second photograph, taken from another position"),
        ({0: 4, 1: 1}, "1 corner is known from two positions"),
        ({0: 4, 1: 2}, "2 corners are known from two positions, expected at least 3"),
    ],
)
def test_too_few_marks_are_refused_with_what_is_missing(kept: dict[int, int], expected: str) -> None:
    cameras = cameras_on(FRONT)
    marks = corner_marks(FRONT, cameras)
    some = Marks(
        [
            {view: place for view, place in places.items() if number < kept.get(view, 0)}
            for number, places in enumerate(marks.corners)
        ]
    )
    with pytest.raises(TooFewMarksError, match=expected):
        fit_pane(some, cameras, "rectangle")


def test_a_corner_that_no_photograph_shows_is_named() -> None:
    cameras = cameras_on(FRONT)
    marks = Marks([*corner_marks(FRONT, cameras).corners, {}])
    with pytest.raises(TooFewMarksError, match="mark corner 5 too, in at least one photograph"):
        fit_pane(marks, cameras, "polygon")


def test_views_from_one_place_are_not_enough() -> None:
    cameras = cameras_on(FRONT, [EYES[0], EYES[0]])
    with pytest.raises(TooFewMarksError, match="taken farther apart"):
        fit_pane(corner_marks(FRONT, cameras), cameras, "rectangle")


def test_the_rectangle_of_a_polygon_keeps_its_order_and_hand() -> None:
    for corners in (FRONT.at(U, V), FRONT.at(U, V)[::-1]):
        rectangle = rectangle_pane(polygon_pane(corners))
        np.testing.assert_allclose(rectangle.corners(), corners, atol=1e-9)
        assert np.linalg.det(rectangle.axes) == pytest.approx(1)


@pytest.mark.parametrize("step", [1.0, 0.0], ids=["line", "place"])
def test_corners_on_a_line_are_no_outline(step: float) -> None:
    with pytest.raises(ValueError, match="are collinear"):
        polygon_pane(step * np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]]))
