"""Mask edges on planes: parts hidden by a frame, and the sides of a rectangle."""

from dataclasses import replace

import numpy as np
import pytest

from glassplat.panes.masks import PaneView, pane_views
from glassplat.panes.objective import Objective, edge_matches, move_planes
from glassplat.panes.search import refine_planes, tilt_uncertainty
from tests.panes.pane_scene import EYES, FRONT, framed_scene_of, scene_of

TRUTH = FRONT.plane
BEYOND = ((2.6, 0.0, 0.3), (-1.9, 0.4, 0.6), (0.2, 0.2, -1.2))
HEIGHT = 0.12
PIXEL = 1 / np.hypot(220, 300)


def test_edges_meet_on_the_true_plane() -> None:
    views = pane_views(scene_of([FRONT]), 1)
    matches = edge_matches(TRUTH, views, edges_per_view=100)
    assert matches.compared.sum() > 300
    assert np.abs(matches.distances[matches.compared]).max() < 1.5 * PIXEL
    assert np.median(np.abs(matches.misalignments)) < 0.1


def test_a_frame_explains_edges_that_do_not_meet() -> None:
    views = pane_views(framed_scene_of(FRONT, HEIGHT, BEYOND), 1)
    matches = edge_matches(TRUTH, views, edges_per_view=100)
    hidden = np.abs(matches.shifts) * HEIGHT > 4 * PIXEL
    assert hidden.sum() > 100
    assert np.median(np.abs(matches.distances[hidden])) > 4 * PIXEL
    explained = matches.distances - HEIGHT * matches.shifts
    assert np.median(np.abs(explained[hidden])) < PIXEL


def test_refinement_measures_the_frame() -> None:
    views = pane_views(framed_scene_of(FRONT, HEIGHT, BEYOND), 1)
    objective = Objective(views, np.zeros((0, 3)), 3.0, 0.03)
    start = replace(TRUTH, offsets=TRUTH.offsets + 0.01, frames=np.array([0.06]))
    found = refine_planes(start, objective, (0.01, 0.004))
    assert found.frames[0] == pytest.approx(HEIGHT, rel=0.15)
    assert found.offsets[0] == pytest.approx(TRUTH.offsets[0], abs=0.01)
    assert found.normals[0] @ TRUTH.normals[0] > np.cos(np.radians(0.5))


def upper(view: PaneView) -> np.ndarray:
    """[E] bool: the edge points on the upper side of the mask."""
    steep: np.ndarray = view.outward[:, 1] < -0.9
    return steep


def test_doubt_is_small_where_all_sides_are_seen_and_large_where_one_is() -> None:
    views = pane_views(scene_of([FRONT]), 1)
    nothing = (np.zeros((0, 3)), 3.0, 0.03)
    assert tilt_uncertainty(TRUTH, Objective(views, *nothing), 0.004)[0] < np.radians(1)
    level = [
        replace(view, edge=view.edge[sides], outward=view.outward[sides]) for view in views for sides in [upper(view)]
    ]
    assert tilt_uncertainty(TRUTH, Objective(level, *nothing), 0.004)[0] > np.radians(10)


def test_edges_cut_by_the_image_border_do_not_reduce_the_uncertainty() -> None:
    views = pane_views(scene_of([FRONT], [*EYES, (0.9, -0.5, 0.9), (-0.5, 0.4, 1.0)]), 1)
    steps = 1e-3 * np.random.default_rng(0).standard_normal((40, 3))
    around = move_planes(TRUTH.select(np.zeros(40, dtype=np.int64)), np.tile(FRONT.center, (40, 1)), steps)
    doubts = tilt_uncertainty(around, Objective(views, np.zeros((0, 3)), 2.0, 0.02), 0.004)
    assert doubts.max() < 1.1 * doubts.min()


def test_the_sign_of_rotated_edges_does_not_depend_on_the_axes_of_the_plane() -> None:
    views = pane_views(scene_of([FRONT]), 1)
    # The axes of a plane rotate by a right angle where another axis of the world becomes the nearest to its normal.
    tilts = 1e-3 * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    around = move_planes(TRUTH.select(np.zeros(5, dtype=np.int64)), np.tile(FRONT.center, (5, 1)), tilts)
    turns = edge_matches(around, views, edges_per_view=100).misalignments
    assert np.abs(turns - turns[0]).max() < 0.05 < np.abs(turns[0]).max()
