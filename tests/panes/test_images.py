"""Planes estimated from measured points that are mirror images of others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from glassplat.panes.fit import fit_planes
from glassplat.panes.masks import FramedPlanes
from glassplat.panes.search import MirrorImages, _proximity_field, plane_of_mirror_images
from glassplat.scene.camera import rotation_from_quat
from tests.panes.pane_scene import EYES, FRONT, Pane, normal_error, offset_error, scene_of
from tests.panes.test_hard_panes import EXTENT, QUICK, roughened

NOISE = 0.01


def things(seed: int, *, low: tuple[float, ...], high: tuple[float, ...], count: int = 400) -> np.ndarray:
    """[count, 3] points on a dozen balls in a box."""
    rng = np.random.default_rng(seed)
    middles, ways = rng.uniform(low, high, (12, 3)), rng.normal(size=(count, 3))
    return middles[rng.integers(12, size=count)] + 0.3 * ways / np.linalg.norm(ways, axis=1, keepdims=True)


def before_the_pane(seed: int) -> np.ndarray:
    return things(seed, low=(-2, -1.2, -2), high=(2, 1.2, 0.8))


def behind_the_pane(seed: int) -> np.ndarray:
    return things(seed + 100, low=(-1, -1, 2.8), high=(1.4, 1, 5))


def images_of(points: np.ndarray, seed: int) -> np.ndarray:
    """Half of the points mirrored by the pane, as structure from motion reconstructs them."""
    chosen = points[::2]
    mirrored = chosen - 2 * ((chosen - FRONT.center) @ FRONT.normal)[:, None] * FRONT.normal
    return mirrored + np.random.default_rng(seed).normal(scale=NOISE, size=mirrored.shape)


def turned(degrees: float, shift: float) -> FramedPlanes:
    """The pane's plane, rotated about an axis in it and moved along its normal."""
    angle = np.radians(degrees)
    normal = np.cos(angle) * FRONT.normal + np.sin(angle) * np.array([0.6, 0.8, 0.0])
    return replace(FRONT, normal=normal, center=FRONT.center + shift * normal).plane


def searched(plane: FramedPlanes, behind: np.ndarray, others: np.ndarray) -> MirrorImages:
    middle = FRONT.center + (plane.offsets[0] - plane.normals[0] @ FRONT.center) * plane.normals[0]
    found = plane_of_mirror_images(plane, middle, behind, others, EXTENT)
    assert found is not None
    return found


def degrees_off(found: MirrorImages) -> float:
    return float(np.degrees(np.arccos(min(1, abs(found.plane.normals[0] @ FRONT.normal)))))


@pytest.mark.parametrize(("seed", "degrees", "shift"), [(0, 3, 0.0), (1, 9, 0.1), (2, 13, -0.1)])
def test_the_plane_that_maps_images_onto_points_is_found_from_afar(seed: int, degrees: float, shift: float) -> None:
    room = before_the_pane(seed)
    found = searched(turned(degrees, shift), images_of(room, seed), room)
    assert found.is_clear
    assert degrees_off(found) < 0.3
    assert abs(found.plane.normals[0] @ FRONT.center - found.plane.offsets[0]) < 0.005 * EXTENT


@pytest.mark.parametrize("seed", range(3))
def test_images_among_three_times_as_many_real_points_place_the_plane(seed: int) -> None:
    room = before_the_pane(seed)
    behind = np.concatenate([images_of(room, seed)[:130], behind_the_pane(seed)])
    found = searched(turned(5, 0.05), behind, room)
    assert found.is_clear
    assert degrees_off(found) < 0.5


@pytest.mark.parametrize("seed", range(3))
def test_points_without_mirror_images_determine_no_plane(seed: int) -> None:
    assert not searched(turned(0, 0), behind_the_pane(seed), before_the_pane(seed)).is_clear


def test_a_plane_that_explains_the_mirror_images_is_kept() -> None:
    room = before_the_pane(0)
    found = searched(turned(0.1, 0), images_of(room, 0), room)
    assert found.before > 0.5 * found.pairs
    assert not found.is_clear


def test_neither_units_nor_the_frame_matter() -> None:
    room = before_the_pane(1)
    behind, plane = images_of(room, 1), turned(7, 0.05)
    turn = rotation_from_quat(torch.tensor([0.8, 0.3, -0.2, 0.5], dtype=torch.float64)).numpy()
    scale, middle = 40.0, FRONT.center + 0.05 * plane.normals[0]
    moved = replace(plane, normals=plane.normals @ turn.T, offsets=scale * plane.offsets)
    first = plane_of_mirror_images(plane, middle, behind, room, EXTENT)
    elsewhere = [scale * points @ turn.T for points in (middle, behind, room)]
    second = plane_of_mirror_images(moved, *elsewhere, scale * EXTENT)
    assert first is not None
    assert second is not None
    apart = np.degrees(np.arccos(min(1, float(second.plane.normals[0] @ turn @ first.plane.normals[0]))))
    assert apart < 0.2
    assert second.pairs == pytest.approx(first.pairs, rel=0.1)


@pytest.mark.parametrize("few", [np.zeros((0, 3)), np.ones((5, 3))])
def test_too_few_points_place_nothing(few: np.ndarray) -> None:
    room = before_the_pane(0)
    assert plane_of_mirror_images(turned(0, 0), FRONT.center, few, room, EXTENT) is None
    assert plane_of_mirror_images(turned(0, 0), FRONT.center, room, few, EXTENT) is None


@pytest.mark.parametrize("seed", [0, 1])
def test_ragged_masks_of_a_mirror_give_its_plane(seed: int) -> None:
    annotations = roughened(scene_of([FRONT]), 1, amplitude=3.0, seed=seed)
    room = before_the_pane(seed)
    points = torch.tensor(np.concatenate([room, images_of(room, seed)]))
    by_masks = fit_planes(torch.tensor(room), annotations, extent=EXTENT, options=QUICK)
    planes = fit_planes(points, annotations, extent=EXTENT, options=QUICK)
    assert normal_error(by_masks, 0, FRONT) > 0.8
    assert normal_error(planes, 0, FRONT) < 0.2
    assert offset_error(planes, 0, FRONT) < 0.002 * EXTENT


def test_two_masks_are_enough_where_a_mirror_shows_points(caplog: pytest.LogCaptureFixture) -> None:
    room = before_the_pane(2)
    annotations = roughened(scene_of([FRONT], EYES[:2]), 1, amplitude=3.0, seed=2)
    points = torch.tensor(np.concatenate([room, images_of(room, 2)]))
    planes = fit_planes(points, annotations, extent=EXTENT, options=QUICK)
    assert normal_error(planes, 0, FRONT) < 0.2
    assert "two annotated views alone" not in caplog.text


def test_mirror_images_do_not_overrule_contradicting_masks() -> None:
    """Masks of a pane that is rotated by 12 degrees from the plane that mirrors the points."""
    other = rotation_from_quat(torch.tensor([0.9945, 0.0, 0.1045, 0.0], dtype=torch.float64)).numpy()
    pane: Pane = replace(FRONT, normal=other @ FRONT.normal, tangent=other @ FRONT.tangent)
    room = before_the_pane(0)
    points = torch.tensor(np.concatenate([room, images_of(room, 0)]))
    planes = fit_planes(points, scene_of([pane], (*EYES, (-1.2, 0.5, -0.4))), extent=EXTENT, options=QUICK)
    assert normal_error(planes, 0, pane) < 1


def test_proximity_falls_with_the_distance_to_the_nearest_point() -> None:
    points, tolerance = before_the_pane(0)[:60], 0.3
    field = _proximity_field(points, tolerance)
    low, high = np.percentile(points, (1, 99), axis=0)
    inner = points[((points >= low) & (points <= high)).all(axis=1)]
    occupied = np.unique(((inner - field.corner) / field.cell).astype(int), axis=0)
    cells = np.stack(np.meshgrid(*map(np.arange, field.values.shape), indexing="ij"), axis=-1)[::5, ::4, ::3]
    away = np.linalg.norm(cells[..., None, :] - occupied, axis=-1).min(axis=-1) * field.cell / tolerance
    np.testing.assert_allclose(field.values[::5, ::4, ::3], np.exp(-0.5 * away**2), rtol=1e-6)
