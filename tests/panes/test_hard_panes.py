"""Planes of panes that are hard to fit: few, ragged or oversized masks, bare frames, steep views, cut outlines."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from glassplat.panes import PlaneFit, PlaneFitError
from glassplat.panes.fit import fit_planes
from glassplat.panes.objective import JointObjective, Terms
from glassplat.scene.camera import Camera, rotation_from_quat
from tests.panes.pane_scene import (
    EYES,
    FRONT,
    Annotations,
    Pane,
    camera_from,
    covers,
    frame_and_clutter,
    framed_scene_of,
    label_image,
    normal_error,
    offset_error,
    ragged,
    scene_of,
)

QUICK = PlaneFit(hypotheses=300, refined=2)
EXTENT = 3.0
POINTS = frame_and_clutter([FRONT])
BARE = frame_and_clutter([])


def assert_found(pane: Pane, annotations: Annotations, points: torch.Tensor, *, degrees: float, percent: float) -> None:
    planes = fit_planes(points, annotations, extent=EXTENT, options=QUICK)
    assert normal_error(planes, 0, pane) < degrees
    assert offset_error(planes, 0, pane) < percent / 100 * EXTENT
    assert covers(planes, 0, pane.larger(0.95))


def roughened(annotations: Annotations, label: int, *, amplitude: float, seed: int = 0) -> Annotations:
    """The annotations with the masks of one pane made ragged."""

    def rough(number: int, labels: torch.Tensor) -> torch.Tensor:
        mask = ragged((labels == label).to(torch.uint8), amplitude=amplitude, seed=seed + number)
        return torch.where(mask == 1, label, labels * (labels != label))

    return [(camera, rough(number, labels)) for number, (camera, labels) in enumerate(annotations)]


def test_a_protruding_frame_does_not_move_the_plane() -> None:
    beyond = ((2.6, 0.0, 0.3), (-1.9, 0.4, 0.6), (0.2, 0.2, -1.2))
    assert_found(FRONT, framed_scene_of(FRONT, 0.12, beyond), BARE, degrees=1, percent=1)


@pytest.mark.parametrize("seed", [0, 1])
def test_ragged_masks_with_holes_and_specks_give_the_pane(seed: int) -> None:
    annotations = [
        (camera, ragged(labels, amplitude=1.5, seed=10 * seed + number))
        for number, (camera, labels) in enumerate(scene_of([FRONT]))
    ]
    assert_found(FRONT, annotations, POINTS, degrees=1.5, percent=1)


WALK = tuple((x, -0.1 + 0.1 * (i % 2), 0.6 - 0.1 * (i % 3)) for i, x in enumerate((-0.8, -0.4, 0.0, 0.3, 0.6, 0.9)))
"""Camera positions along a pane that no photograph shows completely."""


def walked_past(panes: list[Pane], labels: tuple[int, ...]) -> Annotations:
    """Masks of a walk past panes and other objects, each with a label; 0 is not a pane."""
    told = torch.tensor((0, *labels), dtype=torch.uint8)
    cameras = [camera_from(eye, np.array([0.8 * eye[0] + 0.2, -0.1, 2.0])) for eye in WALK]
    return [(camera, told[label_image(camera, panes).long()]) for camera in cameras]


@pytest.mark.parametrize(("depth", "half_width"), [(1.6, 0.03), (1.7, 0.03), (1.85, 0.02)])
def test_the_edges_of_a_post_before_a_pane_do_not_turn_its_plane(depth: float, half_width: float) -> None:
    pane = Pane(np.array([-0.6, -0.1, 2.0]), FRONT.normal, FRONT.tangent, (1.6, 0.6))
    post = Pane(np.array([0.3, -0.1, depth]), FRONT.normal, FRONT.tangent, (half_width, 3.0))
    planes = fit_planes(BARE, walked_past([pane, post], (1, 0)), extent=EXTENT, options=QUICK)
    assert normal_error(planes, 0, pane) < 0.5


def test_glazing_bars_determine_the_plane_of_a_window_without_visible_ends() -> None:
    window = Pane(np.array([0.0, -0.1, 2.0]), FRONT.normal, FRONT.tangent, (9.0, 9.0))
    bars = [Pane(np.array([x, -0.1, 2.0]), FRONT.normal, FRONT.tangent, (0.03, 9.0)) for x in (-0.9, -0.1, 0.7)]
    bars += [Pane(np.array([0.0, y, 2.0]), FRONT.normal, FRONT.bitangent, (0.03, 9.0)) for y in (-0.5, 0.4)]
    annotations = walked_past([*bars, window], (*(0 for _ in bars), 1))
    planes = fit_planes(BARE, annotations, extent=EXTENT, options=QUICK)
    assert normal_error(planes, 0, window) < 0.5


def test_masks_that_include_the_frame_give_the_pane() -> None:
    assert_found(FRONT, scene_of([FRONT.larger(1.06)]), POINTS, degrees=0.5, percent=0.5)


def test_cameras_close_to_the_plane_that_see_it_at_grazing_angles() -> None:
    close = ((-1.2, -0.3, 1.7), (1.5, 0.2, 1.6), (0.2, -0.9, 1.3))
    assert_found(FRONT, scene_of([FRONT], close), BARE, degrees=1, percent=1)


@pytest.mark.parametrize("quat", [(0.9, 0.3, 0.1, 0.2), (0.8, -0.4, 0.2, -0.3)])
def test_a_pane_at_any_tilt_is_found_without_points(quat: tuple[float, ...]) -> None:
    turn = rotation_from_quat(torch.tensor(quat, dtype=torch.float64)).numpy()
    tilted = Pane(FRONT.center, turn @ FRONT.normal, turn @ FRONT.tangent, FRONT.half_sizes)
    assert tilted.normal @ (np.array(EYES) - FRONT.center).mean(axis=0) > 0
    assert_found(tilted, scene_of([tilted]), BARE, degrees=1, percent=1)


def test_a_pane_that_every_image_cuts_is_found() -> None:
    targets = ((1.0, 0.4, 2.0), (1.0, -0.6, 2.0), (-0.6, 0.4, 2.0), (-0.6, -0.6, 2.0))
    eyes = ((0.4, 0.1, 0.4), (1.3, -0.6, 0.5), (-0.6, 0.5, 0.5), (-0.4, -0.6, 0.4))
    cameras = [camera_from(eye, np.array(target)) for eye, target in zip(eyes, targets, strict=True)]
    annotations = [(camera, label_image(camera, [FRONT])) for camera in cameras]
    for _, labels in annotations:
        border = torch.cat([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
        assert bool((border == 1).any())
    planes = fit_planes(POINTS, annotations, extent=EXTENT, options=QUICK)
    assert normal_error(planes, 0, FRONT) < 1
    assert offset_error(planes, 0, FRONT) < 0.01 * EXTENT


def test_two_panes_that_overlap_in_the_image_are_both_found() -> None:
    near = Pane(np.array([0.7, 0.1, 1.2]), np.array([-0.6, 0.0, -0.8]), np.array([0.8, 0.0, -0.6]), (0.4, 0.35))
    panes, eyes = [FRONT, near], (*EYES, (0.3, 0.6, -1.1))
    annotations = scene_of(panes, eyes)
    assert all(bool((label_image(camera, [FRONT]) == 1)[labels == 2].any()) for camera, labels in annotations)
    planes = fit_planes(frame_and_clutter(panes), annotations, extent=EXTENT, options=QUICK)
    for index, pane in enumerate(panes):
        assert normal_error(planes, index, pane) < 1
        assert offset_error(planes, index, pane) < 0.01 * EXTENT


@pytest.mark.parametrize("turn", [0.0, 0.6])
def test_a_pane_is_found_that_is_mostly_seen_through_another(turn: float) -> None:
    normal = np.array([np.sin(turn), 0.0, -np.cos(turn)])
    behind = Pane(np.array([0.4, -0.1, 3.0]), normal, np.array([np.cos(turn), 0.0, np.sin(turn)]), (0.8, 0.5))
    eyes = (*EYES, (-1.3, 0.2, 0.4), (0.6, 0.3, -0.2), (2.2, -0.4, 4.4), (-0.8, 0.3, 4.9))
    annotations = scene_of([FRONT, behind], eyes)
    assert sum(float((labels == 2).sum()) < float((labels == 1).sum()) for _, labels in annotations) >= 4
    planes = fit_planes(BARE, annotations, extent=EXTENT, options=QUICK)
    for index, pane in enumerate((FRONT, behind)):
        # Cameras stand on both sides.
        error = normal_error(planes, index, pane)
        assert min(error, 180 - error) < 1
        assert offset_error(planes, index, pane) < 0.01 * EXTENT
        assert covers(planes, index, pane.larger(0.95))


def test_a_capture_in_kilometres_gives_the_same_pane() -> None:
    scale = 1e-3

    def scaled(camera: Camera) -> Camera:
        matrix = camera.cam_from_world.clone()
        matrix[:3, 3] *= scale
        return replace(camera, cam_from_world=matrix)

    annotations = [(scaled(camera), labels) for camera, labels in scene_of([FRONT])]
    planes = fit_planes(scale * POINTS, annotations, extent=scale * EXTENT, options=QUICK)
    assert normal_error(planes, 0, FRONT) < 0.5
    away = torch.tensor(FRONT.center) - planes.centers[0].double() / scale
    assert abs(float(away @ planes.normals[0].double())) < 0.005 * EXTENT


def test_masks_that_fill_their_images_are_refused_with_what_to_annotate() -> None:
    annotations = [(camera, torch.ones_like(labels)) for camera, labels in scene_of([FRONT])]
    with pytest.raises(PlaneFitError, match=r"pane 1: its outline .* in 0 of 3 .* annotate views that show its border"):
        fit_planes(BARE[:0], annotations, extent=EXTENT, options=QUICK)


def test_a_plane_undetermined_by_one_edge_is_refused_with_advice() -> None:
    wide = Pane(np.array([0.0, -10.3, 2.0]), FRONT.normal, FRONT.tangent, (10.0, 10.0))
    cameras = [camera_from(eye, FRONT.center) for eye in EYES]
    annotations = [(camera, label_image(camera, [wide])) for camera in cameras]
    assert all(0.1 < float((labels == 1).float().mean()) < 0.9 for _, labels in annotations)
    with pytest.raises(
        PlaneFitError,
        match=r"determine the plane only to \d+ degrees.*annotate more views, .* that show its whole outline",
    ):
        fit_planes(BARE[:0], annotations, extent=EXTENT, options=QUICK)


def front_pane(x: float, half_width: float, degrees: float = 0.0) -> Pane:
    """A pane of a shop front, rotated about the vertical by the given angle."""
    turn = np.radians(degrees)
    normal, tangent = np.array([np.sin(turn), 0, -np.cos(turn)]), np.array([np.cos(turn), 0, np.sin(turn)])
    return Pane(np.array([x, -0.1, 2.0]), normal, tangent, (half_width, 0.5))


def test_an_ambiguous_pane_takes_the_plane_of_its_neighbour() -> None:
    panes = [front_pane(-0.5, 0.45), front_pane(0.2, 0.1)]
    annotations = scene_of(panes, (*EYES, (0.3, 0.6, -1.1)))
    coarse = roughened(annotations, 2, amplitude=1.0)
    with pytest.raises(PlaneFitError, match=r"pane 2, .* determine the plane only to"):
        fit_planes(BARE, coarse, extent=EXTENT, labels=[2], options=QUICK)
    together = fit_planes(BARE, coarse, extent=EXTENT, options=QUICK)
    assert normal_error(together, 1, panes[1]) < 1
    torch.testing.assert_close(together.normals[0], together.normals[1])


def test_an_ill_measured_pane_of_a_front_is_placed_by_all_masks_together() -> None:
    panes = [front_pane(-0.5, 0.45), front_pane(0.35, 0.15)]
    annotations = scene_of(panes, (*EYES, (0.3, 0.6, -1.1)))
    rough = roughened(annotations, 2, amplitude=1.2, seed=10)
    alone = fit_planes(BARE, rough, extent=EXTENT, labels=[2], options=QUICK)
    together = fit_planes(BARE, rough, extent=EXTENT, options=QUICK)
    assert normal_error(alone, 0, panes[1]) > 1
    assert normal_error(together, 1, panes[1]) < 0.7
    torch.testing.assert_close(together.normals[0], together.normals[1])


def muntined(columns: int, rows: int) -> list[Pane]:
    """A shop front of adjacent panes."""
    half = 0.8 / columns, 0.5 / rows
    places = [(x, y) for y in range(rows) for x in range(columns)]
    middles = [
        FRONT.at(np.array([(2 * x + 1) / columns - 1]), np.array([(2 * y + 1) / rows - 1]))[0] for x, y in places
    ]
    return [replace(FRONT, center=middle, half_sizes=half) for middle in middles]


def test_many_coplanar_panes_are_fitted_with_small_steps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    terms, work = JointObjective.terms, []

    def counted(*arguments: Any, **options: Any) -> Terms:
        found = terms(*arguments, **options)
        work.append(found.residuals.size)
        return found

    monkeypatch.setattr(JointObjective, "terms", counted)
    largest = {}
    for columns in (2, 4):
        panes = muntined(columns, 3)
        planes = fit_planes(BARE, scene_of(panes, (*EYES, (0.3, 0.6, -1.1))), extent=EXTENT, options=QUICK)
        assert max(normal_error(planes, index, FRONT) for index in range(len(panes))) < 0.5
        torch.testing.assert_close(planes.normals, planes.normals[:1].expand_as(planes.normals))
        largest[columns] = max(work)
        work.clear()
    assert largest[4] < 1.1 * largest[2]


def test_panes_that_are_turned_against_each_other_keep_planes_of_their_own() -> None:
    panes = [front_pane(-0.5, 0.45), front_pane(0.5, 0.45, degrees=5)]
    planes = fit_planes(BARE, scene_of(panes, (*EYES, (0.3, 0.6, -1.1))), extent=EXTENT, options=QUICK)
    for index, pane in enumerate(panes):
        assert normal_error(planes, index, pane) < 1.5
    assert float(torch.linalg.cross(planes.normals[0], planes.normals[1]).norm()) > np.sin(np.radians(3))


def test_a_refusal_names_photographs_that_show_the_pane_from_elsewhere() -> None:
    wide = Pane(np.array([0.0, -10.3, 2.0]), FRONT.normal, FRONT.tangent, (10.0, 10.0))
    cameras = [camera_from(eye, FRONT.center) for eye in EYES]
    annotations = [(camera, label_image(camera, [wide])) for camera in cameras]
    middle = np.array([0.0, -1.0, 2.0])
    unmarked = [
        ("away.jpg", camera_from((0.0, 0.0, -1.0), np.array([0.0, 0.0, -5.0]))),
        ("beside.jpg", camera_from((0.0, 0.05, -1.0), middle)),
        ("from-the-right.jpg", camera_from((3.0, 0.0, 0.0), middle)),
        ("from-the-left.jpg", camera_from((-3.0, 0.0, 0.0), middle)),
        ("from-below.jpg", camera_from((0.0, 3.0, -0.5), middle)),
    ]
    with pytest.raises(PlaneFitError, match=r"should show it well") as raised:
        fit_planes(BARE[:0], annotations, extent=EXTENT, options=QUICK, unmarked=unmarked)
    named = str(raised.value).partition("unoccluded")[2]
    assert all(name in named for name in ("from-the-right.jpg", "from-the-left.jpg", "from-below.jpg"))
    assert "away.jpg" not in named and "beside.jpg" not in named


def test_masks_whose_outlines_meet_on_no_plane_are_refused() -> None:
    rng = np.random.default_rng(0)
    annotations = []
    for camera, labels in scene_of([FRONT]):
        row, column = np.mgrid[: labels.shape[0], : labels.shape[1]]
        center, size = rng.uniform([60, 80], [160, 220]), rng.uniform(20, 60, 2)
        found = ((row - center[0]) / size[0]) ** 2 + ((column - center[1]) / size[1]) ** 2 < 1
        annotations.append((camera, torch.from_numpy(found.astype(np.uint8))))
    with pytest.raises(
        PlaneFitError, match=r"pane 1, .* the outlines of its masks meet on no plane.* annotate more views"
    ):
        fit_planes(BARE[:0], annotations, extent=EXTENT, options=replace(QUICK, least_agreement=0.01))


def test_views_from_one_place_are_refused_with_what_to_annotate() -> None:
    eyes = tuple((0.001 * i, 0.0, -1.0) for i in range(3))
    with pytest.raises(PlaneFitError, match=r"pane 1: its 3 annotated views .* annotate views from farther apart"):
        fit_planes(POINTS, scene_of([FRONT], eyes), extent=EXTENT, options=QUICK)


def test_masks_from_nearly_one_place_are_warned_of_with_what_to_annotate(caplog: pytest.LogCaptureFixture) -> None:
    middle = np.mean(EYES, axis=0)
    eyes = [tuple(middle + 0.25 * (np.array(eye) - middle)) for eye in EYES]
    coarse = roughened(scene_of([FRONT], eyes), 1, amplitude=1.0)
    aside = camera_from(EYES[0], FRONT.center)
    fit_planes(BARE[:0], coarse, extent=EXTENT, options=QUICK, unmarked=[("aside.jpg", aside)])
    (warning,) = (record.getMessage() for record in caplog.records if record.levelname == "WARNING")
    assert "pane 1: the masks determine the plane only to" in warning
    assert "aside.jpg should show it well" in warning


def test_a_pane_in_two_views_takes_the_plane_of_its_neighbour() -> None:
    panes = [front_pane(-0.5, 0.45), front_pane(0.35, 0.15)]
    annotations = scene_of(panes, (*EYES, (0.3, 0.6, -1.1), (0.5, 0.5, -1.0)))
    both, first = annotations[:2], [(camera, labels * (labels == 1)) for camera, labels in annotations[2:]]
    coarse = [*roughened(both, 2, amplitude=1.0, seed=10), *first]
    alone = fit_planes(BARE, coarse, extent=EXTENT, labels=[2], options=QUICK)
    assert 45 < normal_error(alone, 0, panes[1]) < 135
    together = fit_planes(BARE, coarse, extent=EXTENT, options=QUICK)
    assert normal_error(together, 1, panes[1]) < 1
