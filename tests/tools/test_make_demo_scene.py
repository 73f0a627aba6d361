"""The demo scene has surfaces that face outwards, with an image for each, on both sides of one free-standing pane."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import uniform_filter

from tools import demo_paint
from tools.demo_paint import noise, pictures
from tools.demo_things import BOTTOM, DEPTH, LEFT, RIGHT, TOP, all_shapes
from tools.make_demo_scene import annotated_views, camera_poses, sparse_points, view
from tools.pane_tracer import Array, reflectance

SHAPES = all_shapes()


def test_triangles_face_the_side_of_their_normals() -> None:
    for shape in SHAPES:
        a, b, c = np.moveaxis(shape.vertices[shape.faces], 1, 0)
        across = np.cross(b - a, c - a)
        area = np.linalg.norm(across, axis=1)
        facing = np.einsum("ni,nki->n", across, shape.normals[shape.faces]) / 3
        wrong = area[facing < -0.2 * area].sum()
        assert wrong < 0.02 * area.sum(), f"{wrong / area.sum():.0%} of {shape.paint} at {shape.vertices.mean(axis=0)}"


def test_noise_has_mean_0_and_deviation_1_and_repeats() -> None:
    smooth = noise((64, 48), (6.0, 3.0), 1)
    assert (
        smooth.shape == (48, 64) and smooth.mean() == pytest.approx(0, abs=1e-12) and smooth.std() == pytest.approx(1)
    )
    seam, step = np.abs(smooth[:, 0] - smooth[:, -1]), np.abs(np.diff(smooth, axis=1))
    assert seam.mean() < 1.5 * step.mean()


def test_every_surface_has_its_picture_and_every_picture_its_surface(monkeypatch: pytest.MonkeyPatch) -> None:
    def averaged(field: Array, sigma: tuple[float, float], mode: str) -> Array:
        """Smooth as well, at a hundredth of the time where the filter is as wide as the image."""
        return uniform_filter(field, [max(1, round(3 * one)) for one in sigma], mode=mode)

    monkeypatch.setattr(demo_paint, "gaussian_filter", averaged)
    painted = pictures()
    assert {shape.paint for shape in SHAPES} == set(painted)
    assert all(picture.min() >= 0 and picture.max() <= 1 for picture in painted.values())


def test_no_object_intersects_the_pane() -> None:
    for shape in SHAPES:
        x, y, z = shape.vertices[shape.faces].reshape(-1, 3, 3).transpose(2, 0, 1)
        over = (
            (x.max(1) > LEFT + 0.01) & (x.min(1) < RIGHT - 0.01) & (z.max(1) > BOTTOM + 0.01) & (z.min(1) < TOP - 0.01)
        )
        assert not (over & (y.min(1) < -1e-6) & (y.max(1) > 1e-6)).any()


def test_cameras_stand_before_the_pane_and_some_look_away() -> None:
    poses = camera_poses(24)
    assert all(pose[1, 3] < -0.4 for pose in poses)
    assert [pose[1, 2] < 0 for pose in poses] == [number % 6 == 5 for number in range(24)]
    np.testing.assert_allclose(np.linalg.det([pose[:3, :3] for pose in poses]), 1)


def test_masks_go_to_training_views_that_show_the_pane() -> None:
    shown = [np.full((4, 4), number % 6 != 5) for number in range(24)]
    chosen = annotated_views(shown, 5)
    assert len(chosen) == 5
    assert all(number % 8 and number % 6 != 5 for number in chosen)


@dataclass(frozen=True)
class Walls:
    """A white wall behind the pane and a grey one far in front of it, to test the tracer's part in an image."""

    def seen(self, origins: Array, directions: Array) -> SimpleNamespace:
        inwards = directions[:, 1]
        distance = np.where(inwards > 0, DEPTH - origins[:, 1], -8 - origins[:, 1]) / inwards
        to_pane = np.where(inwards > 0, -origins[:, 1] / inwards, np.inf)
        met = np.abs(origins[:, 0] + np.where(inwards > 0, to_pane, 0) * directions[:, 0]) < 0.5
        met &= inwards > 0
        transmission = np.where(inwards[:, None] > 0, 0.8, 0.2) * np.ones(3)
        reflection = np.where(met[:, None], 0.2, 0.0) * np.ones(3)
        strength = np.where(met, 0.1, 0.0)
        radiance = (1 - strength)[:, None] * transmission + strength[:, None] * reflection
        return SimpleNamespace(
            radiance=radiance, transmission=transmission, reflection=reflection, strength=strength,
            label=met.astype(np.uint8), distance=distance, to_pane=np.where(met, to_pane, np.inf),
        )  # fmt: skip


def test_layers_add_up_in_every_pixel_even_at_the_edge_of_the_pane() -> None:
    layers = view(Walls(), camera_poses(1)[0], 40, 3)
    share = np.maximum(layers["strength"], 0)
    whole = layers["whole"] > 0
    composed = (1 - share) * layers["transmission"] + share * layers["reflection"]
    np.testing.assert_allclose(composed[whole], layers["radiance"][whole])
    assert (layers["reflection"].max(axis=(0, 1)) < 0.2 + 1e-12).all()


def test_some_points_lie_behind_the_pane_at_mirror_images() -> None:
    positions, colors = sparse_points(Walls(), camera_poses(12), 2000)
    behind = positions[:, 1] > DEPTH + 0.1
    assert 0.02 < behind.mean() < 0.4
    np.testing.assert_allclose(positions[behind, 1], 8, atol=0.05)
    assert colors[behind].max() < 130 < colors[~behind & (positions[:, 1] > 0)].min()


def test_glass_returns_more_light_at_a_slant() -> None:
    values = [reflectance(cosine, 1.6) for cosine in (1.0, 0.5, 0.2)]
    assert values == sorted(values)
    assert values[0] == pytest.approx(0.101, abs=1e-3)
