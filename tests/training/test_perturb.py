"""Opacity perturbation of Gaussians seen through a pane."""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from glassplat.scene.camera import Camera, rotation_from_quat
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.panes import Planes, crosses_pane, in_image
from glassplat.scene.scene import Scene
from glassplat.training.actions import PerturbOpacity
from glassplat.training.densify import perturb_opacities
from glassplat.training.stage import Clock, Every, TrainState
from tests.training.progress_of import finished

PANE = Planes(
    centers=torch.zeros(1, 3),
    raw_normals=torch.tensor([[0.0, 0.0, -2.0]]),
    logit_reflectances=torch.zeros(1),
    tangents=torch.tensor([[1.0, 0.0, 0.0]]),
    half_sizes=torch.tensor([[1.0, 0.5]]),
    labels=(1,),
)


def camera_at(z: float, *, backwards: bool = False, focal: float = 50.0) -> Camera:
    """A camera on the z axis that looks along +z, or along -z."""
    rotation = torch.diag(torch.tensor([-1.0, 1.0, -1.0]) if backwards else torch.ones(3))
    matrix = torch.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = -rotation @ torch.tensor([0.0, 0.0, z])
    return Camera(matrix, focal, focal, 50.0, 50.0, 100, 100)


def behind_panes(points: Tensor, planes: Planes, cameras: Sequence[Camera]) -> Tensor:
    """[N] bool: points that some camera sees through some pane."""
    seen = [crosses_pane(points, planes, camera.center) & in_image(points, camera) for camera in cameras]
    return torch.stack(seen).any(dim=0)


FRONT = camera_at(-2.0)
PUBLISHED: dict[str, Any] = {"amplitude": 0.4, "bounds": (0.01, 0.99)}


@pytest.mark.parametrize(
    ("point", "selected"),
    [
        ((0.0, 0.0, 1.0), True),
        ((1.4, 0.0, 1.0), True),
        ((1.6, 0.0, 1.0), False),
        ((0.0, 0.7, 1.0), True),
        ((0.0, 0.8, 1.0), False),
        ((0.0, 0.0, -0.5), False),
        ((0.0, 0.0, -3.0), False),
    ],
    ids=["behind", "inside sideways", "beside", "inside upwards", "above", "before the pane", "behind the camera"],
)
def test_selection_follows_the_ray_through_the_rectangle(point: tuple[float, ...], selected: bool) -> None:
    assert behind_panes(torch.tensor([point]), PANE, [FRONT]).tolist() == [selected]


def test_a_pane_is_looked_through_from_either_side() -> None:
    points = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    backwards = camera_at(2.0, backwards=True)
    assert behind_panes(points, PANE, [backwards]).tolist() == [False, True]
    assert behind_panes(points, PANE, [backwards, FRONT]).all()


def test_points_outside_of_the_image_are_not_seen() -> None:
    point = torch.tensor([[1.0, 0.0, 1.0]])
    assert behind_panes(point, PANE, [FRONT]).all()
    assert not behind_panes(point, PANE, [camera_at(-2.0, focal=500.0)]).any()
    assert behind_panes(point, PANE, [camera_at(-2.0, focal=500.0), FRONT]).all()


def test_a_segment_crosses_the_rectangles_wherever_the_world_is_turned() -> None:
    panes = PANE.concat(replace(PANE, centers=torch.tensor([[1.8, 0.6, 0.5]]), labels=(2,)))
    points = torch.rand(500, 3) * torch.tensor([8.0, 4.0, 4.0]) - torch.tensor([2.0, 2.0, 1.0])
    start = FRONT.center
    shares = (panes.centers[:, 2] - start[2]) / (points[:, 2:] - start[2])
    crossings = start + shares[..., None] * (points - start)[:, None]
    inside = ((crossings - panes.centers)[..., :2].abs() <= panes.half_sizes).all(dim=-1)
    expected = ((points[:, :2] - start[:2]).abs().amax(dim=1) <= points[:, 2] - start[2]) & (
        inside & (shares > 0) & (shares < 1)
    ).any(dim=1)
    turn, shift = rotation_from_quat(torch.tensor([0.7, -0.2, 0.4, 0.5])), torch.tensor([3.0, -5.0, 2.0])
    moved = {name: panes.tensors()[name] @ turn.T for name in ("centers", "raw_normals", "tangents")}
    back = torch.eye(4)
    back[:3, :3], back[:3, 3] = turn.T, -turn.T @ shift
    camera = replace(FRONT, cam_from_world=FRONT.cam_from_world @ back)
    there = panes.with_tensors({**moved, "centers": moved["centers"] + shift})
    assert torch.equal(behind_panes(points, panes, [FRONT]), expected)
    assert torch.equal(behind_panes(points @ turn.T + shift, there, [camera]), expected)


def test_no_panes_select_nothing() -> None:
    assert not behind_panes(torch.rand(4, 3), Planes.empty(), [FRONT]).any()


def make_gaussians(count: int) -> Gaussians:
    return Gaussians(
        means=torch.tensor([0.0, 0.0, 1.0]).repeat(count, 1)
        * torch.where(torch.arange(count) % 2 == 0, 1, -0.5)[:, None],
        quats=torch.ones(count, 4),
        log_scales=torch.zeros(count, 3),
        logit_opacities=torch.zeros(count),
        sh=torch.zeros(count, 1, 3),
    )


def test_noise_is_uniform_on_the_activated_opacity_of_the_selected() -> None:
    gaussians = make_gaussians(20_000)
    selected = behind_panes(gaussians.means, PANE, [FRONT])
    after = perturb_opacities(gaussians, selected, generator=torch.Generator().manual_seed(0), **PUBLISHED)
    assert torch.equal(selected, torch.arange(20_000) % 2 == 0)
    noise = torch.sigmoid(after.logit_opacities)[selected] - 0.5
    assert noise.abs().max() <= 0.4 + 1e-6
    assert noise.mean().item() == pytest.approx(0, abs=0.01)
    assert noise.var().item() == pytest.approx(0.8**2 / 12, rel=0.05)
    assert torch.equal(after.logit_opacities[~selected], gaussians.logit_opacities[~selected])


def test_what_views_show_through_panes_is_perturbed_and_forgets_its_moments() -> None:
    state = TrainState(Scene(make_gaussians(100), 1.0, planes=PANE), seed=0)
    state.optimizer.moments = {"primary.logit_opacities": (torch.ones(100), torch.ones(100))}
    dataset: Any = SimpleNamespace(train=[SimpleNamespace(camera=camera) for camera in (FRONT, camera_at(-3.0))])
    action = PerturbOpacity(Every(0.1), **PUBLISHED)
    assert action.due(Clock(10, 100, 2)) and not action.due(Clock(11, 100, 2))
    assert finished(action.apply(state, dataset, Clock(10, 100, 2)))
    behind = torch.arange(100) % 2 == 0
    assert torch.equal(state.scene.primary.logit_opacities != 0, behind)
    assert torch.equal(state.optimizer.moments["primary.logit_opacities"][0] == 0, behind)


def test_opacities_stay_within_bounds_and_finite() -> None:
    gaussians = make_gaussians(1000)
    extreme = gaussians.with_tensors({"logit_opacities": torch.linspace(-60, 60, 1000)})
    selected = behind_panes(extreme.means, PANE, [FRONT])
    after = perturb_opacities(extreme, selected, generator=torch.Generator().manual_seed(0), **PUBLISHED)
    opacities = torch.sigmoid(after.logit_opacities)[selected]
    assert opacities.min() >= 0.01 - 1e-6
    assert opacities.max() <= 0.99 + 1e-6
    again = perturb_opacities(extreme, selected, generator=torch.Generator().manual_seed(0), **PUBLISHED)
    assert torch.equal(again.logit_opacities, after.logit_opacities)
