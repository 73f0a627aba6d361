"""Gaussians that start where nothing was measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from glassplat.captures.dataset import Dataset
from glassplat.captures.view import View
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.scene.camera import NumpyCamera, rotation_from_quat
from glassplat.training.densify import with_scattered
from tests.training.test_invariance import moved_capture
from tests.training.tiny_capture import tiny_capture

SHARE = 0.5


def scattered(dataset: Dataset, share: float = SHARE) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions and colours of the points that were added."""
    points, count = with_scattered(dataset, share), len(dataset.points)
    assert torch.equal(points.positions[:count], dataset.points.positions)
    assert torch.equal(points.colors[:count], dataset.points.colors)
    return points.positions[count:], points.colors[count:]


def test_there_are_so_many_more_of_the_colours_that_photographs_show_there() -> None:
    dataset = tiny_capture()
    positions, colors = scattered(dataset)
    assert len(positions) == round(SHARE * len(dataset.points))
    hits = torch.zeros(len(positions), dtype=torch.bool)
    for view in dataset.train:
        camera = NumpyCamera.of(view.camera)
        held = camera.holds(positions.double().numpy())
        column, row = torch.from_numpy(np.floor(camera.project(positions.double().numpy()[held]))).long().T
        hits[held] |= (view.photo[row, column] == colors[held]).all(dim=1)
    assert hits.float().mean() > 0.98  # A place on the edge between two pixels may be rounded to the other one.


def test_each_lies_as_far_away_as_a_point_that_its_photograph_shows() -> None:
    dataset = tiny_capture()
    view = dataset.train[0]
    positions, _ = scattered(replace(dataset, train=(view,)))
    camera = NumpyCamera.of(view.camera)
    measured = dataset.points.positions.double().numpy()
    depths = camera.in_camera(measured[camera.holds(measured)])[:, 2]
    found = camera.in_camera(positions.double().numpy())[:, 2]
    assert np.abs(found[:, None] - depths).min(axis=1).max() < 1e-5
    assert camera.holds(positions.double().numpy(), margin=1e-3).all()


def test_ignored_pixels_give_none() -> None:
    dataset = tiny_capture()
    left = torch.zeros(dataset.train[0].photo.shape[:2], dtype=torch.bool)
    left[:, : left.shape[1] // 2] = True
    views = tuple(replace(view, read_ignored=lambda: left) for view in dataset.train)
    positions, _ = scattered(replace(dataset, train=views[:1]))
    camera = NumpyCamera.of(views[0].camera)
    assert 0.3 * SHARE * len(dataset.points) < len(positions) < 0.7 * SHARE * len(dataset.points)
    assert (camera.project(positions.double().numpy())[:, 0] >= left.shape[1] // 2 - 1e-3).all()


@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_neither_units_nor_the_frame_matter(scale: float) -> None:
    turn = rotation_from_quat(torch.tensor([0.3, -0.5, 0.7, 0.2]))
    positions, colors = scattered(tiny_capture())
    moved, same_colors = scattered(replace(moved_capture(scale, turn), measured_points=True))
    torch.testing.assert_close(moved, scale * positions @ turn.T, rtol=1e-3, atol=1e-3 * scale)
    assert (colors == same_colors).all(dim=1).float().mean() > 0.98


def test_random_points_and_views_without_points_get_none() -> None:
    dataset = tiny_capture()
    assert with_scattered(replace(dataset, measured_points=False), SHARE) is dataset.points
    assert with_scattered(dataset, 0.0) is dataset.points
    camera = dataset.train[0].camera
    pose = camera.cam_from_world.clone()
    pose[2, 3] -= 1000
    away = replace(camera, cam_from_world=pose)
    view = View.in_memory("away.png", away, photo=dataset.train[0].photo)
    positions, colors = scattered(replace(dataset, train=(view,)))
    assert positions.shape == colors.shape == (0, 3)


@pytest.mark.parametrize("recipe", [SplatRecipe(), PlanarRecipe()], ids=["splat", "planar"])
def test_methods_scatter_some_and_published_ones_none(
    recipe: SplatRecipe | PlanarRecipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("glassplat.methods.planar.fitted_planes", lambda *_: None)
    dataset = tiny_capture()
    count = len(dataset.points)
    assert len(recipe.initialise(dataset).primary) == count + round(recipe.scattered * count) > count
    assert len(type(recipe).paper().initialise(dataset).primary) == count
