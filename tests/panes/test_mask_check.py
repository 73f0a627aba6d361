"""Masks that belong to another photograph are reported by name."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest

from glassplat.panes import PlaneFit
from glassplat.panes.fit import fit_planes, matching_outline_shares, outlier_masks, report_masks
from glassplat.panes.masks import pane_views
from tests.panes.pane_scene import EYES, FRONT, Annotations, Pane, frame_and_clutter, scene_of

QUICK = PlaneFit(hypotheses=300, refined=2)
EXTENT = 3.0
PLACES = (*EYES, (0.9, -0.5, -1.2), (-0.9, 0.4, -0.5), (0.3, 0.5, -0.7))
NAMES = [f"photo{number}.jpg" for number in range(len(PLACES))]


def warnings_of(annotations: Annotations, caplog: pytest.LogCaptureFixture) -> list[str]:
    with caplog.at_level(logging.DEBUG, "glassplat.panes"):
        fit_planes(frame_and_clutter([FRONT]), annotations, extent=EXTENT, names=NAMES, options=QUICK)
    assert "outlines of the masks" in caplog.text
    assert all(name in caplog.text for name in NAMES)
    return [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]


def test_consistent_masks_are_logged_without_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    assert warnings_of(scene_of([FRONT], PLACES), caplog) == []


def test_masks_that_changed_places_are_named(caplog: pytest.LogCaptureFixture) -> None:
    annotations = scene_of([FRONT], PLACES)
    (first, one), (second, other) = annotations[1], annotations[4]
    annotations[1], annotations[4] = (first, other), (second, one)
    (warning,) = warnings_of(annotations, caplog)
    assert "2 of its 6 masks do not fit" in warning
    assert "photo1.jpg" in warning and "photo4.jpg" in warning and "photo0.jpg" not in warning


def test_a_post_in_front_of_the_pane_is_not_reported(caplog: pytest.LogCaptureFixture) -> None:
    post = Pane(np.array([0.7, -0.1, 1.3]), FRONT.normal, FRONT.tangent, (0.08, 2.0))
    annotations = [(camera, labels.where(labels == 1, 0)) for camera, labels in scene_of([FRONT, post], PLACES)]
    assert warnings_of(annotations, caplog) == []


@pytest.mark.parametrize(("offset", "count"), [(0.0, 0), (1e4, 1), (2e6, 0)])
def test_masks_are_not_called_wrong_where_poses_are_imprecise(
    offset: float, count: int, caplog: pytest.LogCaptureFixture
) -> None:
    views = pane_views(scene_of([FRONT], PLACES), 1)
    for view in views[:3]:
        view.cam_from_world[:3, 3] += 0.3 * (offset > 0)
    for view in views:
        view.cam_from_world[:3, 3] -= view.cam_from_world[:3, :3] @ [0, 0, offset]
    report_masks(1, replace(FRONT, center=FRONT.center + np.array([0, 0, offset])).plane, views)
    assert caplog.text.count("do not fit") == count


def test_views_without_an_outline_are_no_evidence() -> None:
    (camera, labels), *others = scene_of([FRONT])
    views = pane_views([(camera, labels.new_ones(labels.shape)), *others], 1)
    assert not outlier_masks(matching_outline_shares(FRONT.plane, views)[1:]).any()


def test_outliers_are_distinguished_from_masks_without_comparison() -> None:
    assert outlier_masks(np.array([0.9, 0.1, np.nan, 0.8])).tolist() == [False, True, False, False]
    assert outlier_masks(np.array([0.2, 0.1, 0.1])).all()
    assert not outlier_masks(np.full(3, np.nan)).any()
