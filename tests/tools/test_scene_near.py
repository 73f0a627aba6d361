"""Scenes with near reflections: closed, complete surfaces, and objects that stand apart on their stand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from tools.scene_draws import MATTE
from tools.scene_near import NEAR_SCENES, SHEET_SIZE, SHEET_SWING, NearScene, near_scene


@pytest.mark.parametrize("name", NEAR_SCENES)
def test_faces_turn_the_way_their_normals_point(name: NearScene) -> None:
    for body in near_scene(name).bodies:
        mesh = body.triangles
        first, second, third = (mesh.positions[mesh.faces[:, corner]] for corner in range(3))
        turned = np.cross(second - first, third - first)
        has_area = np.linalg.norm(turned, axis=-1) > 1e-12
        along = (turned * mesh.normals[mesh.faces].mean(axis=1)).sum(axis=-1)
        assert has_area.mean() > 0.9 and (along > 0)[has_area].all()


@pytest.mark.parametrize("name", NEAR_SCENES)
def test_objects_stand_on_the_ground_within_the_box_of_points(name: NearScene) -> None:
    scene = near_scene(name)
    for body in scene.bodies:
        positions = body.triangles.positions
        assert np.abs(positions).max() < 1.3
        assert positions[:, 2].min() == pytest.approx(scene.stand.z, abs=1e-9)


@pytest.mark.parametrize("name", NEAR_SCENES)
def test_the_reflective_object_comes_first(name: NearScene) -> None:
    coatings = [body.coating for body in near_scene(name).bodies]
    assert coatings[0] not in MATTE and all(coating in MATTE for coating in coatings[1:])
    assert len(coatings) > 2


@pytest.mark.parametrize("name", NEAR_SCENES)
def test_no_object_intersects_a_mirror(name: NearScene) -> None:
    mirror, *others = (body.triangles.positions for body in near_scene(name).bodies)
    known = cKDTree(mirror)
    for positions in others:
        assert known.query(positions)[0].min() > 0.02


def test_the_sheet_swings_like_a_sine() -> None:
    mesh = near_scene("sheet").bodies[0].triangles
    expected = SHEET_SWING * np.sin(2 * np.pi * mesh.positions[:, 0] / SHEET_SIZE[0])
    np.testing.assert_allclose(mesh.positions[:, 1], expected, atol=0.02)
