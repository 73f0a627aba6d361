"""Reflective scenes: cameras, shapes and surroundings as documented; the small scene in the tree obeys optics."""

from __future__ import annotations

import json
import shutil
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from glassplat.captures.dataset import load_dataset
from glassplat.kernels.maths.images import linear_from_srgb
from tools.make_scenes import (
    BALL_RADIUS,
    Arguments,
    camera_positions,
    main,
    srgb_from_linear,
    world_from_opengl,
    write_points,
)
from tools.scene_draws import COATINGS, SHAPES, DrawnScene, draw_scene
from tools.scene_environment import directions, make_environment
from tools.scene_surfaces import Array, Triangles, disc, ground_texture, placed, star_shaped, torus, torus_depth

BALL = Path(__file__).parent.parent / "data_files" / "ball"
TEST_FRAMES = json.loads((BALL / "transforms_test.json").read_text())["frames"]
TRAIN, TEST, SIZE = 24, 6, 96


def test_srgb_and_linear_are_inverses() -> None:
    values = np.linspace(0, 1, 101)
    np.testing.assert_allclose(linear_from_srgb(torch.from_numpy(srgb_from_linear(values))), values, atol=1e-7)


def unit_pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.array(image) / 255.0


def linear_pixels(path: Path) -> np.ndarray:
    return linear_from_srgb(torch.from_numpy(unit_pixels(path)[..., :3])).numpy()


def environment_along(direction: np.ndarray) -> np.ndarray:
    """Nearest pixel of the ball's surroundings, linear radiance [..., 3], by the documented convention."""
    panorama = linear_pixels(BALL / "environment.png")
    height, width = panorama.shape[:2]
    column = (0.5 - np.arctan2(direction[..., 1], direction[..., 0]) / (2 * np.pi)) * width
    row = np.arccos(np.clip(direction[..., 2], -1, 1)) / np.pi * height
    return panorama[np.clip(row.astype(int), 0, height - 1), column.astype(int) % width]


def ball_points(frame: dict) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays [S, S, 3] through the pixel centres, unit normals where they hit the ball, and a mask of clear hits."""
    pose = np.array(frame["transform_matrix"])
    focal = 0.5 * SIZE / np.tan(json.loads((BALL / "transforms_test.json").read_text())["camera_angle_x"] / 2)
    x, y = np.meshgrid((np.arange(SIZE) + 0.5 - SIZE / 2) / focal, -(np.arange(SIZE) + 0.5 - SIZE / 2) / focal)
    rays = np.stack([x, y, -np.ones_like(x)], axis=-1) @ pose[:3, :3].T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    origin = pose[:3, 3]
    along = rays @ origin
    root = along**2 - origin @ origin + BALL_RADIUS**2
    distance = -along - np.sqrt(np.maximum(root, 0))
    normals = (origin + distance[..., None] * rays) / BALL_RADIUS
    return rays, normals, (root > 0) & (-(normals * rays).sum(axis=-1) > 0.4)


def test_cameras_look_at_the_object_from_above() -> None:
    for position in camera_positions(50, 0.3):
        pose = world_from_opengl(position)
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
        ahead = position - 4 * pose[:3, 2]
        np.testing.assert_allclose(ahead, [0, 0, -0.15], atol=1e-12)
        assert pose[2, 1] > 0 and pose[2, 0] == pytest.approx(0)


def ellipsoid_radius(directions: Array) -> Array:
    return np.asarray(np.sum((directions / [0.3, 0.5, 0.7]) ** 2, axis=-1) ** -0.5)


MESHES = [
    disc(1.2, -0.5),
    torus(0.6, 0.25, 40.0, rings=24, segments=16),
    star_shaped(ellipsoid_radius, rings=48, segments=24),
    placed(star_shaped(ellipsoid_radius, rings=48, segments=24), np.diag([-1.0, 1.0, -1.0]), np.array([1.0, 2.0, 3.0])),
]


@pytest.mark.parametrize("triangles", MESHES, ids=["disc", "torus", "ellipsoid", "turned and moved"])
def test_faces_turn_the_way_their_normals_point(triangles: Triangles) -> None:
    first, second, third = (triangles.positions[triangles.faces[:, corner]] for corner in range(3))
    turned = np.cross(second - first, third - first)
    normals = triangles.normals[triangles.faces].mean(axis=1)
    # At a pole all but one of a quad's corners coincide, so that one of its two triangles has no area.
    has_area = np.linalg.norm(turned, axis=-1) > 1e-12
    assert has_area.mean() > 0.9
    assert ((turned * normals).sum(axis=-1) > 0)[has_area].all()
    np.testing.assert_allclose(np.linalg.norm(triangles.normals, axis=-1), 1)


def test_a_torus_stands_on_its_lowest_point() -> None:
    lowest = torus(0.6, 0.25, 40.0).positions[:, 2].min()
    assert lowest == pytest.approx(-torus_depth(0.6, 0.25, 40.0), abs=1e-3)


def test_a_star_shaped_surface_has_the_normals_of_its_equation() -> None:
    mesh = star_shaped(ellipsoid_radius, rings=24, segments=12)
    gradient = mesh.positions / np.array([0.3, 0.5, 0.7]) ** 2
    expected = gradient / np.linalg.norm(gradient, axis=-1, keepdims=True)
    np.testing.assert_allclose(mesh.normals, expected, atol=1e-5)
    assert mesh.coordinates.min() >= 0 and mesh.coordinates.max() <= 1


def drawn_values(scene: DrawnScene) -> list:
    meshes = [body.triangles.positions.tobytes() for body in scene.bodies]
    looks = [(body.shape, body.coating, body.tint, body.refraction) for body in scene.bodies]
    return [meshes, looks, scene.stand, scene.surroundings]


def test_a_seed_is_a_scene() -> None:
    assert drawn_values(draw_scene(7)) == drawn_values(draw_scene(7))
    assert drawn_values(draw_scene(7)) != drawn_values(draw_scene(8))


SEEDS = range(40)
drawn = cache(draw_scene)


def test_all_shapes_and_coatings_are_drawn() -> None:
    bodies = [body for seed in SEEDS for body in drawn(seed).bodies]
    assert {body.shape for body in bodies} == set(SHAPES)
    assert {body.coating for body in bodies} == set(COATINGS)


def test_drawn_objects_stand_side_by_side() -> None:
    for seed in SEEDS:
        scene = drawn(seed)
        points = [body.triangles.positions for body in scene.bodies]
        assert all(np.abs(positions).max() < 1.3 for positions in points) and scene.stand.radius < 1.3, seed
        assert all(positions[:, 2].min() == pytest.approx(scene.stand.z) for positions in points), seed
        middles = [(positions.max(axis=0) + positions.min(axis=0)) / 2 for positions in points]
        assert all(np.linalg.norm(middle[:2]) < scene.stand.radius for middle in middles), seed
        if len(points) == 2:
            apart = middles[1] - middles[0]
            assert (points[0] @ apart).max() < (points[1] @ apart).min(), seed


def test_drawn_surroundings_can_be_rendered() -> None:
    pictures = [make_environment(32, drawn(seed).surroundings) for seed in (1, 2)]
    assert all(picture.min() >= 0 and picture.max() <= 1.2 + 1e-6 for picture in pictures)
    assert np.abs(pictures[0] - pictures[1]).mean() > 0.05
    assert all(picture.std() > 0.05 for picture in pictures)


def test_points_are_written_with_a_scene_on_request(tmp_path: Path) -> None:
    folder = tmp_path / "ball"
    shutil.copytree(BALL, folder)
    write_points(500, folder)
    dataset = load_dataset(folder)
    assert len(dataset.points) == 500 and float(dataset.points.positions.abs().max()) <= 1.3


def test_a_panorama_is_seen_from_inside() -> None:
    direction = directions(64)
    np.testing.assert_allclose(direction[:, 63:65].mean(axis=1)[32], [1, 0, 0], atol=0.05)
    np.testing.assert_allclose(direction[32, 32], [0, 1, 0], atol=0.05)
    np.testing.assert_allclose(direction[0, :, 2], 1, atol=0.01)


def test_surroundings_and_textures_hardly_leave_what_eight_bits_hold() -> None:
    environment = make_environment(64)
    assert environment.shape == (64, 128, 3)
    assert environment.min() >= 0 and environment.max() <= 1.2 + 1e-6
    assert (environment > 1).mean() < 0.1
    ground = ground_texture(1.2, 64)
    assert ground.min() > 0 and ground.max() < 1


def test_no_scene_is_overwritten(tmp_path: Path) -> None:
    (tmp_path / "torus").mkdir()
    with pytest.raises(FileExistsError, match=r"torus exist; expected new folders"):
        main(Arguments(output=tmp_path))


def test_the_small_ball_is_small_and_read_like_shiny_blender() -> None:
    assert sum(path.stat().st_size for path in BALL.rglob("*") if path.is_file()) < 3_000_000
    dataset = load_dataset(BALL)
    assert (len(dataset.train), len(dataset.test)) == (TRAIN, TEST)
    assert not dataset.measured_points and not dataset.pane_labels
    assert dataset.test[0].photo.shape == (SIZE, SIZE, 3)


@pytest.mark.parametrize("frame", TEST_FRAMES, ids=lambda frame: frame["file_path"])
def test_the_small_ball_has_the_normals_of_a_sphere(frame: dict) -> None:
    _, normals, hit = ball_points(frame)
    stored = 2 * unit_pixels(BALL / f"{frame['file_path']}_normal.png")[..., :3] - 1
    error = np.linalg.norm(stored - normals, axis=-1)[hit]
    assert error.max() < np.radians(1.0)


@pytest.mark.parametrize("frame", TEST_FRAMES, ids=lambda frame: frame["file_path"])
def test_the_small_ball_mirrors_its_surroundings(frame: dict) -> None:
    rays, normals, hit = ball_points(frame)
    assert (unit_pixels(BALL / f"{frame['file_path']}_strength.png")[hit] == 1).all()
    mirrored = rays - 2 * (rays * normals).sum(axis=-1, keepdims=True) * normals
    # Below the horizon the ball reflects the ground, which is near.
    sky = hit & (mirrored[..., 2] > 0.05)
    shown = linear_pixels(BALL / f"{frame['file_path']}.png")
    difference = np.abs(shown - environment_along(mirrored))[sky]
    assert sky.sum() > 100
    assert np.median(difference) < 0.01


def test_a_missing_mitsuba_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(SystemExit, match=r"Mitsuba 3 cannot be imported .*pip install -e '\.\[scenes\]'"):
        main(Arguments(tmp_path))
