"""Planes from masks and points, on panes whose geometry is known."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from glassplat.panes import PlaneFit, PlaneFitError
from glassplat.panes.fit import fit_planes
from glassplat.panes.masks import mask_agreement, pane_views
from glassplat.panes.objective import Objective, sample_nearby
from glassplat.scene.camera import Camera, rotation_from_quat
from glassplat.scene.panes import Planes
from tests.panes.pane_scene import (
    EYES,
    FRONT,
    SIDE,
    Pane,
    covers,
    frame_and_clutter,
    normal_error,
    offset_error,
    scene_of,
)

QUICK = PlaneFit(hypotheses=300, refined=2)
EXTENT = 3.0


SURFACE = ((1.52 - 1) / (1.52 + 1)) ** 2
"""Reflectance of one surface of clear glass at normal incidence."""


@cache
def fitted_front() -> Planes:
    """The plane that three masks of a pane and the points of its frame give."""
    return fit_planes(frame_and_clutter([FRONT]), scene_of([FRONT]), extent=EXTENT, options=QUICK)


def test_three_masks_and_a_sparse_frame_give_the_pane() -> None:
    planes = fitted_front()
    assert planes.labels == (1,)
    assert normal_error(planes, 0, FRONT) < 0.5
    assert offset_error(planes, 0, FRONT) < 0.005 * EXTENT
    assert covers(planes, 0, FRONT)
    assert float(planes.half_sizes[0].prod()) < 1.3 * np.prod(FRONT.half_sizes)


def test_every_label_gets_its_own_pane() -> None:
    panes = [SIDE, FRONT]
    eyes = [*EYES, (0.6, -0.3, -1.2)]
    options = replace(QUICK, mirror_labels=(2,))
    planes = fit_planes(frame_and_clutter(panes), scene_of(panes, eyes), extent=EXTENT, options=options)
    assert planes.labels == (1, 2)
    for index, pane in enumerate(panes):
        assert normal_error(planes, index, pane) < 1
        assert offset_error(planes, index, pane) < 0.01 * EXTENT
        assert covers(planes, index, pane)
    assert planes.base_reflectances.tolist() == pytest.approx([2 * SURFACE / (1 + SURFACE), 0.999], rel=1e-3)


def test_a_pane_photographed_from_all_sides_is_found() -> None:
    behind = ((0.4, 0.2, 4.6), (-0.9, -0.3, 4.2))
    annotations = scene_of([FRONT], (*EYES, *behind))
    assert all(bool((labels == 1).any()) for _, labels in annotations)
    planes = fit_planes(frame_and_clutter([FRONT]), annotations, extent=EXTENT, options=QUICK)
    assert normal_error(planes, 0, FRONT) < 0.5
    assert offset_error(planes, 0, FRONT) < 0.01
    assert covers(planes, 0, FRONT)


def test_scale_and_rotation_of_the_world_change_nothing() -> None:
    points, annotations, first = frame_and_clutter([FRONT]), scene_of([FRONT]), fitted_front()
    scale, shift = 1000.0, torch.tensor([3.0, -200.0, 40.0], dtype=torch.float64)
    rotation = rotation_from_quat(torch.tensor([0.3, -0.5, 0.7, 0.2], dtype=torch.float64))

    def moved(camera: Camera) -> Camera:
        matrix = torch.eye(4, dtype=torch.float64)
        matrix[:3, :3] = camera.cam_from_world[:3, :3] @ rotation.T
        matrix[:3, 3] = scale * camera.cam_from_world[:3, 3] - matrix[:3, :3] @ shift
        return replace(camera, cam_from_world=matrix)

    second = fit_planes(
        scale * points @ rotation.T + shift,
        [(moved(camera), labels) for camera, labels in annotations],
        extent=scale * EXTENT,
        options=QUICK,
    )
    assert second.normals[0].tolist() == pytest.approx((rotation @ first.normals[0].double()).tolist(), abs=2e-3)
    centers = scale * rotation @ first.centers[0].double() + shift
    assert second.centers[0].tolist() == pytest.approx(centers.tolist(), abs=5e-3 * scale)
    assert second.half_sizes[0].tolist() == pytest.approx((scale * first.half_sizes[0]).tolist(), rel=1e-2)


def test_an_occluder_before_the_pane_does_not_move_the_plane() -> None:
    post = Pane(np.array([0.7, -0.1, 1.3]), FRONT.normal, FRONT.tangent, (0.08, 2.0))
    annotations = [(c, torch.where(labels == 2, 0, labels)) for c, labels in scene_of([FRONT, post])]
    annotations.append(scene_of([FRONT], [(0.5, 0.4, -1.0)])[0])
    planes = fit_planes(frame_and_clutter([FRONT]), annotations, extent=EXTENT, options=QUICK)
    assert normal_error(planes, 0, FRONT) < 1
    assert offset_error(planes, 0, FRONT) < 0.01 * EXTENT
    assert covers(planes, 0, FRONT)


def test_same_seed_same_planes_and_bad_points_are_passed_over() -> None:
    points, annotations, first = frame_and_clutter([FRONT]), scene_of([FRONT]), fitted_front()
    poisoned = torch.cat([points, torch.full((3, 3), torch.nan)])
    second = fit_planes(poisoned, annotations, extent=EXTENT, options=QUICK)
    for name, tensor in first.tensors().items():
        assert torch.equal(tensor, second.tensors()[name])


def test_masks_agree_on_the_true_plane_and_on_no_other() -> None:
    views = pane_views(scene_of([FRONT]), 1)
    around = sample_nearby(FRONT.plane, FRONT.center[None], 100, tilt=0.2, shift=0.2, rng=np.random.default_rng(0))
    agreement = mask_agreement(around, views)
    assert agreement[0] > 0.97
    assert (agreement[1:] < agreement[0]).all()
    objective = Objective(views, np.zeros((0, 3)), EXTENT, 0.01 * EXTENT)
    cost = objective.terms(around, 0.004).cost
    assert cost[0] < 0.1
    assert (cost[1:] > cost[0]).all()
    behind = replace(FRONT.plane, offsets=FRONT.plane.offsets + 5)
    assert mask_agreement(behind, views)[0] < 0.01


def test_one_view_is_too_few() -> None:
    with pytest.raises(PlaneFitError, match=r"pane 1 is annotated in 1 view.*annotate at least two more"):
        fit_planes(frame_and_clutter([FRONT]), scene_of([FRONT])[:1], extent=EXTENT, options=QUICK)


def test_among_several_panes_one_may_be_done_without() -> None:
    annotations = scene_of([FRONT])
    camera, image = annotations[0]
    annotations[0] = camera, torch.where(image == 1, 2, image)
    with pytest.raises(PlaneFitError, match=r"pane 2 is annotated in 1 view.* erase label 2 from the masks"):
        fit_planes(frame_and_clutter([FRONT]), annotations, extent=EXTENT, options=QUICK)
    with pytest.raises(PlaneFitError, match="pane 1 is annotated in 1 view") as one:
        fit_planes(frame_and_clutter([FRONT]), scene_of([FRONT])[:1], extent=EXTENT, options=QUICK)
    assert "erased" not in str(one.value)


def test_two_views_are_enough_but_not_without_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    planes = fit_planes(frame_and_clutter([FRONT]), scene_of([FRONT])[:2], extent=EXTENT, options=QUICK)
    assert normal_error(planes, 0, FRONT) < 2
    assert "two annotated views alone" in caplog.text


def test_no_points_on_the_frame_are_needed() -> None:
    wall = frame_and_clutter([])[:5]
    planes = fit_planes(wall, scene_of([FRONT]), extent=EXTENT, options=QUICK)
    assert normal_error(planes, 0, FRONT) < 0.5
    assert offset_error(planes, 0, FRONT) < 0.005 * EXTENT


def test_masks_of_different_things_are_refused() -> None:
    annotations = scene_of([FRONT])
    shuffled = [
        (camera, labels.roll(shift, dims=1))
        for (camera, labels), shift in zip(annotations, (0, 110, -110), strict=True)
    ]
    with pytest.raises(PlaneFitError, match=r"pane 1.*label 1 is the same flat pane"):
        fit_planes(frame_and_clutter([FRONT], wall=20_000), shuffled, extent=EXTENT, options=QUICK)


def test_masks_without_any_pane_are_refused() -> None:
    annotations = [(camera, torch.zeros_like(labels)) for camera, labels in scene_of([FRONT])]
    with pytest.raises(PlaneFitError, match="no mask names a pane"):
        fit_planes(frame_and_clutter([FRONT]), annotations, extent=EXTENT, options=QUICK)
