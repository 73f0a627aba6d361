"""The units and the orientation of a capture's coordinates are arbitrary and must not affect the result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from glassplat.captures.dataset import Dataset
from glassplat.captures.view import PointCloud, View
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.scene.camera import rotation_from_quat
from glassplat.scene.scene import Scene
from glassplat.training.loop import train
from glassplat.training.stage import TrainState
from tests.render.tiny_scene import quat_product
from tests.training.tiny_capture import tiny_capture, true_scene

ITERATIONS = 60
QUAT = torch.tensor([0.3, -0.5, 0.7, 0.2])
TURN = rotation_from_quat(QUAT)
RECIPES_TRIED = {"splat": SplatRecipe(sh_degree=1), "planar": PlanarRecipe(sh_degree=1)}


def moved_view(view: View, scale: float, turn: torch.Tensor) -> View:
    pose = view.camera.cam_from_world.clone()
    pose[:3, :3] = pose[:3, :3] @ turn.T
    pose[:3, 3] *= scale
    camera = replace(view.camera, cam_from_world=pose)
    return View.in_memory(view.name, camera, photo=view.photo, pane_labels=view.pane_labels)


def moved_capture(scale: float, turn: torch.Tensor) -> Dataset:
    """The tiny capture in other units, seen from another frame."""
    original = tiny_capture()
    views = tuple(moved_view(view, scale, turn) for view in original.train)
    points = PointCloud(scale * original.points.positions @ turn.T, original.points.colors)
    # The planes are set by hand below: there are too few masks to fit them, and the check before a run is skipped.
    extent = scale * original.extent
    return replace(original, train=views, test=views[:1], points=points, extent=extent, measured_points=False)


def place_true_planes(scale: float, turn: torch.Tensor) -> Callable[[TrainState, object], None]:
    truth = true_scene()
    planes, glass = truth.planes, truth.glass
    planes = replace(
        planes,
        centers=scale * planes.centers @ turn.T,
        raw_normals=planes.raw_normals @ turn.T,
        tangents=planes.tangents @ turn.T,
        half_sizes=scale * planes.half_sizes,
    )
    glass = replace(glass, means=scale * glass.means @ turn.T, log_scales=glass.log_scales + torch.tensor(scale).log())
    if not torch.equal(turn, torch.eye(3)):
        glass = replace(glass, quats=quat_product(QUAT / QUAT.norm(), glass.quats))

    def enter(state: TrainState, dataset: object) -> None:
        state.scene = replace(state.scene, planes=planes, glass=glass)

    return enter


def trained(recipe: SplatRecipe | PlanarRecipe, scale: float, turn: torch.Tensor) -> tuple[Scene, list[float]]:
    """The scene, and the loss at every step."""
    dataset = moved_capture(scale, turn)
    stages = tuple(
        replace(stage, setup=place_true_planes(scale, turn)) if stage.setup else stage
        for stage in recipe.stages(0, ITERATIONS)
    )
    state = TrainState(recipe.initialise(dataset), 0)
    losses = [m.loss for m in train(stages, dataset, state, ITERATIONS) if hasattr(m, "loss")]
    return state.scene, losses


@cache
def reference(method: str) -> tuple[Scene, list[float]]:
    """Result of training in the capture's own units and frame."""
    return trained(RECIPES_TRIED[method], 1.0, torch.eye(3))


def means_of_tens(losses: list[float]) -> np.ndarray:
    """Mean losses of consecutive groups of ten steps."""
    return np.array(losses).reshape(-1, 10).mean(axis=1)


@pytest.mark.parametrize("method", RECIPES_TRIED)
@pytest.mark.parametrize(("scale", "turn"), [(1000.0, torch.eye(3)), (0.001, torch.eye(3)), (1.0, TURN)])
def test_units_and_orientation_do_not_matter(method: str, scale: float, turn: torch.Tensor) -> None:
    scene, losses = reference(method)
    other, other_losses = trained(RECIPES_TRIED[method], scale, turn)
    assert losses[-1] < 0.8 * losses[0]
    # Adam steps along the axes of the frame, so a rotated run is similar but not identical, above all in single steps.
    assert np.array(other_losses) == pytest.approx(np.array(losses), rel=0.3)
    assert means_of_tens(other_losses) == pytest.approx(means_of_tens(losses), rel=0.05)
    assert len(other.primary) == pytest.approx(len(scene.primary), rel=0.1)
    torch.testing.assert_close(other.extent, scale * scene.extent)
