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
from glassplat.panes.material import virtual_points
from glassplat.scene.camera import NumpyCamera, rotation_from_quat
from glassplat.training.densify import scattered_points
from tests.training.test_invariance import moved_capture
from tests.training.tiny_capture import tiny_capture, true_scene

SHARE = 0.5


def scattered(dataset: Dataset, share: float = SHARE) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions and colours of the points that are scattered."""
    points = scattered_points(dataset, share)
    return points.positions, points.colors


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
    assert len(scattered_points(replace(dataset, measured_points=False), SHARE)) == 0
    assert len(scattered_points(dataset, 0.0)) == 0
    camera = dataset.train[0].camera
    pose = camera.cam_from_world.clone()
    pose[2, 3] -= 1000
    away = replace(camera, cam_from_world=pose)
    view = View.in_memory("away.png", away, photo=dataset.train[0].photo)
    positions, colors = scattered(replace(dataset, train=(view,)))
    assert positions.shape == colors.shape == (0, 3)


def first_points(recipe: SplatRecipe | PlanarRecipe) -> int:
    return len(recipe.initialise(tiny_capture()).primary) - len(tiny_capture().points)


def test_splat_starts_with_some_and_the_published_one_with_none() -> None:
    assert first_points(SplatRecipe()) == round(SplatRecipe().scattered * len(tiny_capture().points)) > 0
    assert first_points(SplatRecipe.paper()) == 0


def test_planar_starts_with_those_that_are_not_seen_through_panes(monkeypatch: pytest.MonkeyPatch) -> None:
    planes = true_scene().planes
    monkeypatch.setattr("glassplat.methods.planar.fitted_planes", lambda *_: planes)
    recipe, dataset = PlanarRecipe(scattered=1.0), tiny_capture()
    more = scattered_points(dataset, 1.0)
    behind = virtual_points(more.positions, planes, [view.camera for view in dataset.train])
    assert 0 < behind.sum() < len(more)
    assert first_points(recipe) == (~behind).sum()
    means = recipe.initialise(dataset).primary.means
    assert not (means[:, None] == more.positions[behind]).all(dim=2).any()
    assert first_points(PlanarRecipe.paper()) == 0
