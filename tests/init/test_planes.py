"""Planes from masks and points, on panes whose geometry is known."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from glassplat.init.annotation import pane_views
from glassplat.init.consistency import edge_cost, mask_agreement
from glassplat.init.plane_search import planes_nearby
from glassplat.init.planes import PlaneFit, PlaneFitError, fit_planes
from glassplat.init.ransac import PlaneEquations
from glassplat.scene.camera import Camera
from glassplat.scene.plane import Planes
from glassplat.scene.pose import rotation_from_quat

QUICK = PlaneFit(hypotheses=300, refined=2)
EXTENT = 3.0


@dataclass(frozen=True)
class Pane:
    """A rectangle in the world."""

    center: np.ndarray
    normal: np.ndarray
    tangent: np.ndarray
    half_sizes: tuple[float, float]

    @property
    def bitangent(self) -> np.ndarray:
        return np.cross(self.normal, self.tangent)

    def at(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """World points at coordinates in [-1, 1]."""
        half_u, half_v = self.half_sizes
        return self.center + np.outer(u * half_u, self.tangent) + np.outer(v * half_v, self.bitangent)


FRONT = Pane(np.array([0.2, -0.1, 2.0]), np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0]), (0.8, 0.5))
SIDE = Pane(np.array([-1.5, 0.0, 1.5]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), (0.6, 0.4))
EYES = ((0.0, 0.0, -1.0), (1.2, 0.3, -0.6), (-0.4, -0.6, -0.8))


def camera_from(eye: Sequence[float], target: np.ndarray) -> Camera:
    eye = np.asarray(eye)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    matrix[:3, 3] = -matrix[:3, :3] @ eye
    return Camera(torch.tensor(matrix), 240.0, 240.0, 150.0, 110.0, 300, 220)


def label_image(camera: Camera, panes: Sequence[Pane]) -> torch.Tensor:
    """[H, W] number of the nearest pane through each pixel, counted from 1; 0 where there is none."""
    rays, eye = camera.ray_directions().numpy(), camera.center.numpy()
    labels, nearest = np.zeros(rays.shape[:2], dtype=np.uint8), np.full(rays.shape[:2], np.inf)
    for number, pane in enumerate(panes, start=1):
        slope = rays @ pane.normal
        depth = ((pane.center - eye) @ pane.normal) / np.where(slope == 0, 1e-12, slope)
        away = eye + depth[..., None] * rays - pane.center
        inside = (np.abs(away @ pane.tangent) <= pane.half_sizes[0]) & (
            np.abs(away @ pane.bitangent) <= pane.half_sizes[1]
        )
        found = inside & (depth > 0) & (depth < nearest)
        labels[found], nearest[found] = number, depth[found]
    return torch.from_numpy(labels)


def scene_of(panes: Sequence[Pane], eyes: Sequence[Sequence[float]] = EYES) -> list[tuple[Camera, torch.Tensor]]:
    target = np.mean([pane.center for pane in panes], axis=0)
    cameras = [camera_from(eye, target) for eye in eyes]
    return [(camera, label_image(camera, panes)) for camera in cameras]


def frame_and_clutter(panes: Sequence[Pane], *, noise: float = 0.01, frame: int = 80, wall: int = 2000) -> torch.Tensor:
    """Noisy points on the frames, and many more on a wall behind and in the air."""
    rng = np.random.default_rng(0)
    points = []
    for pane in panes:
        along, side = rng.uniform(-1.05, 1.05, frame), rng.choice([-1.03, 1.03], frame)
        upright = rng.random(frame) < 0.5
        points.append(pane.at(np.where(upright, side, along), np.where(upright, along, side)))
    points.append(rng.uniform([-3, -2, 3.5], [3, 2, 3.5], (wall, 3)))
    points.append(rng.uniform([-3, -2, -1], [3, 2, 3.5], (300, 3)))
    positions = np.concatenate(points)
    return torch.tensor(positions + noise * rng.standard_normal(positions.shape))


def normal_error(planes: Planes, index: int, pane: Pane) -> float:
    """Degrees between signed normals."""
    cosine = float(planes.normals[index].double() @ torch.tensor(pane.normal))
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def offset_error(planes: Planes, index: int, pane: Pane) -> float:
    away = torch.tensor(pane.center) - planes.centers[index].double()
    return abs(float(away @ planes.normals[index].double()))


def covers(planes: Planes, index: int, pane: Pane) -> bool:
    corners = torch.tensor(pane.at(np.array([-1, -1, 1, 1]), np.array([-1, 1, -1, 1]))) - planes.centers[index]
    along = [float((corners @ axis[index].double()).abs().max()) for axis in planes.axes()]
    return all(reach <= half for reach, half in zip(along, planes.half_sizes[index].tolist(), strict=True))


def test_three_masks_and_a_sparse_frame_give_the_pane() -> None:
    planes = fit_planes(frame_and_clutter([FRONT]), scene_of([FRONT]), extent=EXTENT, options=QUICK)
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
    assert planes.base_reflectances.tolist() == pytest.approx([0.2, 0.99])


def test_a_pane_photographed_all_the_way_round_is_found() -> None:
    behind = ((0.4, 0.2, 4.6), (-0.9, -0.3, 4.2))
    annotations = scene_of([FRONT], (*EYES, *behind))
    assert all(bool((labels == 1).any()) for _, labels in annotations)
    planes = fit_planes(frame_and_clutter([FRONT]), annotations, extent=EXTENT, options=QUICK)
    assert normal_error(planes, 0, FRONT) < 0.5
    assert offset_error(planes, 0, FRONT) < 0.01
    assert covers(planes, 0, FRONT)


def test_scale_and_rotation_of_the_world_change_nothing() -> None:
    points, annotations = frame_and_clutter([FRONT]), scene_of([FRONT])
    first = fit_planes(points, annotations, extent=EXTENT, options=QUICK)
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
    points, annotations = frame_and_clutter([FRONT]), scene_of([FRONT])
    first = fit_planes(points, annotations, extent=EXTENT, options=QUICK)
    poisoned = torch.cat([points, torch.full((3, 3), torch.nan)])
    second = fit_planes(poisoned, annotations, extent=EXTENT, options=QUICK)
    transparent = torch.cat([points, points.flip(0) + 0.1])
    weights = (torch.arange(len(transparent)) < len(points)).float()
    third = fit_planes(transparent, annotations, extent=EXTENT, weights=weights, options=QUICK)
    for name, tensor in first.tensors().items():
        assert torch.equal(tensor, second.tensors()[name])
        assert torch.equal(tensor, third.tensors()[name])


def test_masks_agree_on_the_true_plane_and_on_no_other() -> None:
    views = pane_views(scene_of([FRONT]), 1)
    truth = PlaneEquations(FRONT.normal[None], np.array([FRONT.normal @ FRONT.center]))
    around = planes_nearby(truth, FRONT.center, 100, tilt=0.2, shift=0.2, rng=np.random.default_rng(0))
    agreement = mask_agreement(around, views)
    assert agreement[0] > 0.97
    assert (agreement[1:] < agreement[0]).all()
    cost = edge_cost(around, views, tolerance=0.004)
    assert cost[0] < 0.1
    assert (cost[1:] > cost[0]).all()
    behind = PlaneEquations(truth.normals, truth.offsets + 5)
    assert mask_agreement(behind, views)[0] < 0.01


def test_one_view_is_too_few() -> None:
    with pytest.raises(PlaneFitError, match=r"pane 1 is annotated in 1 view.*annotate at least two more"):
        fit_planes(frame_and_clutter([FRONT]), scene_of([FRONT])[:1], extent=EXTENT, options=QUICK)


def test_two_views_are_enough_but_not_without_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    planes = fit_planes(frame_and_clutter([FRONT]), scene_of([FRONT])[:2], extent=EXTENT, options=QUICK)
    assert normal_error(planes, 0, FRONT) < 2
    assert "annotated in two views only" in caplog.text


def test_without_points_on_the_frame_the_error_says_what_to_annotate() -> None:
    wall = frame_and_clutter([])[:5]
    with pytest.raises(PlaneFitError, match=r"pane 1: \d of 5 points lie along its edge in the 3 annotated views"):
        fit_planes(wall, scene_of([FRONT]), extent=EXTENT, options=QUICK)


def test_masks_of_different_things_are_refused() -> None:
    annotations = scene_of([FRONT])
    shuffled = [
        (camera, labels.roll(shift, dims=1))
        for (camera, labels), shift in zip(annotations, (0, 110, -110), strict=True)
    ]
    with pytest.raises(PlaneFitError, match=r"pane 1.*label 1 means the same flat pane"):
        fit_planes(frame_and_clutter([FRONT], wall=20_000), shuffled, extent=EXTENT, options=QUICK)


def test_masks_without_any_pane_are_refused() -> None:
    annotations = [(camera, torch.zeros_like(labels)) for camera, labels in scene_of([FRONT])]
    with pytest.raises(PlaneFitError, match="none of the 3 masks names a pane"):
        fit_planes(frame_and_clutter([FRONT]), annotations, extent=EXTENT, options=QUICK)
