"""Choice between planes where Gaussians and measured points indicate different ones."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
import torch

from glassplat.panes import PlaneFit
from glassplat.panes.fit import fit_planes
from glassplat.panes.masks import pane_views
from glassplat.panes.objective import Objective
from glassplat.panes.search import PlaneCandidate, first_hypotheses, highest_scoring_plane, score
from tests.panes.pane_scene import FRONT, Pane, camera_from, frame_and_clutter, label_image, normal_error, scene_of

QUICK = PlaneFit(hypotheses=300, refined=2)
EXTENT = 3.0
CLOSE = ((-0.15, 0.0, -1.0), (0.15, 0.05, -1.0), (0.0, -0.1, -0.9))
"""Positions so close together that masks determine the plane only to within some degrees."""


def turned(pane: Pane, degrees: float) -> Pane:
    """The pane rotated about the vertical axis through its centre."""
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    rotation = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
    return replace(pane, normal=rotation @ pane.normal, tangent=rotation @ pane.tangent)


MEASURED = frame_and_clutter([FRONT], frame=60, wall=200)
MISLEADING = frame_and_clutter([turned(FRONT, 10)], frame=400, wall=200)


def test_the_measured_points_win_where_gaussians_mislead(caplog: pytest.LogCaptureFixture) -> None:
    annotations = scene_of([FRONT], CLOSE)
    misled = fit_planes(MISLEADING, annotations, extent=EXTENT, options=QUICK)
    assert normal_error(misled, 0, FRONT) > 3
    caplog.clear()
    with caplog.at_level(logging.DEBUG, "glassplat.panes"):
        planes = fit_planes(MISLEADING, annotations, extent=EXTENT, measured=MEASURED, options=QUICK)
    assert normal_error(planes, 0, FRONT) < 1.5
    assert "fitted to the measured points scores" in caplog.text
    assert "fitted to the Gaussians scores" in caplog.text
    assert caplog.text.count("; kept") == 1


def test_gaussians_determine_the_plane_if_measured_points_do_not(caplog: pytest.LogCaptureFixture) -> None:
    annotations = scene_of([FRONT], CLOSE)
    with caplog.at_level(logging.DEBUG, "glassplat.panes"):
        planes = fit_planes(MEASURED, annotations, extent=EXTENT, measured=torch.zeros(0, 3), options=QUICK)
    assert normal_error(planes, 0, FRONT) < 3
    assert "of 0 points along its edge" in caplog.text


@pytest.mark.parametrize("degrees", [1.0, 5.0, 40.0])
def test_the_better_plane_is_kept_in_either_order(degrees: float) -> None:
    views = pane_views(scene_of([FRONT]), 1)
    evidence = Objective(views, np.zeros((0, 3)), EXTENT, 0.01 * EXTENT)
    fits = [PlaneCandidate("one", FRONT.plane), PlaneCandidate("other", turned(FRONT, degrees).plane)]
    assert highest_scoring_plane(1, fits, evidence) is fits[0].plane
    assert highest_scoring_plane(1, fits[::-1], evidence) is fits[0].plane


def test_a_plane_behind_an_impossible_frame_is_kept_only_where_there_is_no_other() -> None:
    views = pane_views(scene_of([FRONT]), 1)
    evidence = Objective(views, np.zeros((0, 3)), EXTENT, 0.01 * EXTENT)
    high = replace(FRONT.plane, frames=np.array([0.3 * EXTENT]))
    fits = [PlaneCandidate("one", high), PlaneCandidate("other", turned(FRONT, 40.0).plane)]
    assert score(high, evidence) > score(fits[1].plane, evidence)
    assert highest_scoring_plane(1, fits, evidence) is fits[1].plane
    assert highest_scoring_plane(1, fits[:1], evidence) is high


def test_virtual_points_behind_a_mirror_do_not_contradict_its_plane() -> None:
    """There are no points on the mirror, and all points measured through it lie behind it."""
    views = pane_views(scene_of([FRONT]), 1)
    virtual = np.random.default_rng(0).uniform([-2, -1, 2.5], [2, 1, 6], (5000, 3))
    evidence = Objective(views, virtual, EXTENT, 0.01 * EXTENT)
    wall = replace(FRONT, center=FRONT.center + np.array([0, 0, 0.6]))
    assert score(FRONT.plane, evidence) > score(wall.plane, evidence) + 0.2


def test_the_score_does_not_depend_on_the_unit_of_length() -> None:
    def scaled(factor: float) -> float:
        annotations = [
            (replace(camera, cam_from_world=with_translation(camera.cam_from_world, factor)), labels)
            for camera, labels in scene_of([FRONT])
        ]
        points = factor * frame_and_clutter([FRONT], wall=0).numpy()
        evidence = Objective(pane_views(annotations, 1), points, factor * EXTENT, 0.01 * factor * EXTENT)
        pane = replace(turned(FRONT, 2), center=factor * FRONT.center)
        return score(pane.plane, evidence)

    assert scaled(1000.0) == pytest.approx(scaled(1.0), rel=1e-9)


def with_translation(matrix: torch.Tensor, factor: float) -> torch.Tensor:
    scaled = matrix.clone()
    scaled[:3, 3] *= factor
    return scaled


def test_a_pane_that_fills_the_photographs_is_among_the_first_hypotheses() -> None:
    """Its masks overlap on almost any plane, so that ranking by overlap kept only planes that were 24 degrees off."""
    wide = Pane(np.array([0.5, 0.0, 2.0]), FRONT.normal, FRONT.tangent, (2.2, 0.8))
    eyes = [(-2.0 + 0.5 * number, 0.05 * (-1) ** number, 0.3 + 0.1 * (number % 3)) for number in range(7)]
    cameras = [
        camera_from(eye, np.array([0.6 * eye[0] + 0.4, 0.15 * (-1) ** number, 2.0])) for number, eye in enumerate(eyes)
    ]
    views = pane_views([(camera, label_image(camera, [wide])) for camera in cameras], 1)
    evidence = Objective(views, np.zeros((0, 3)), EXTENT, 0.01 * EXTENT)
    for seed in range(8):
        followed = first_hypotheses(evidence, 300, np.random.default_rng((seed, 1)))
        cosines = np.abs(followed.normals @ wide.normal)
        assert np.degrees(np.arccos(cosines.max())) < 15
