"""What is done with the virtual scene behind a pane when reflections begin."""

from __future__ import annotations

from dataclasses import replace

import torch

from glassplat.methods.planar import seed_reflection, surfaces, turn_virtual_scene_round
from glassplat.panes.fit import with_mirrors
from glassplat.panes.material import virtual_points
from glassplat.scene.camera import mirror_matrices
from glassplat.scene.panes import Planes
from glassplat.scene.scene import Scene
from glassplat.training.stage import TrainState
from tests.render.tiny_scene import in_single_precision, joined, pane, showcase
from tests.training.progress_of import finished
from tests.training.tiny_capture import tiny_capture, true_scene

PANE = true_scene().planes


def state_of(scene: Scene) -> TrainState:
    """The scene with moments of ones for its means."""
    state = TrainState(scene, seed=0)
    ones = torch.ones_like(scene.primary.means)
    state.optimizer.moments["primary.means"] = (ones, ones.clone())
    return state


def mirrored(points: torch.Tensor) -> torch.Tensor:
    matrix = mirror_matrices(PANE.centers, PANE.normals)[0]
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def test_what_is_behind_a_mirror_moves_to_its_front() -> None:
    scene = true_scene()
    state = state_of(scene)
    turn_virtual_scene_round(state, tiny_capture(), PANE)
    means, before = state.scene.primary.means, scene.primary.means
    kept = (before[:, None] == means).all(dim=-1).any(dim=1)
    moved = int((~kept).sum())
    assert 5 < moved < len(before) and len(means) == len(before)
    assert bool((before[~kept, 2] > 1.5).all())
    torch.testing.assert_close(means[-moved:], mirrored(before[~kept]))
    first_moment = state.optimizer.moments["primary.means"][0]
    assert not bool(first_moment[-moved:].any()) and bool((first_moment[:-moved] == 1).all())


def test_a_capture_that_shows_the_room_needs_no_seeds() -> None:
    scene = true_scene()
    room = scene.primary.with_tensors({"logit_opacities": torch.full((len(scene.primary),), 6.0)})
    room = room.with_tensors({"log_scales": torch.full((len(room), 3), 0.5)})
    state = state_of(replace(scene, primary=room))
    assert not finished(seed_reflection(state, tiny_capture(), PANE))
    assert len(state.scene.primary) == len(scene.primary)


def test_a_capture_from_the_front_gets_the_mirrored_points() -> None:
    scene = true_scene()
    case = scene.primary.select(scene.primary.means[:, 2] > 1.5)
    state = state_of(replace(scene, primary=case))
    assert finished(seed_reflection(state, tiny_capture(), PANE))
    added = state.scene.primary.means[len(case) :]
    assert len(added) > 5
    assert bool((added[:, 2] < 2.0).all())
    points = mirrored(tiny_capture().points.positions)
    assert bool(torch.isclose(added[:, None], points, atol=1e-5).all(dim=-1).any(dim=1).all())


def split_in_two(whole: Planes) -> Planes:
    """The pane as two, side by side."""
    tangent, quarter = whole.axes()[0], 0.5 * whole.half_sizes[:, :1]
    halves = [
        replace(
            whole,
            centers=whole.centers + side * quarter * tangent,
            half_sizes=whole.half_sizes * torch.tensor([[0.5, 1.0]]),
            labels=(label,),
        )
        for side, label in ((-1, 1), (1, 2))
    ]
    return joined(*halves)


def test_panes_side_by_side_get_the_points_of_one() -> None:
    scene = true_scene()
    case = replace(scene, primary=scene.primary.select(scene.primary.means[:, 2] > 1.5))
    halves = split_in_two(PANE)
    (front,) = surfaces(halves, mirrors=False)
    assert surfaces(halves, mirrors=True) == []
    whole, both = state_of(case), state_of(replace(case, planes=halves))
    assert finished(seed_reflection(whole, tiny_capture(), PANE)) and finished(
        seed_reflection(both, tiny_capture(), front)
    )
    torch.testing.assert_close(both.scene.primary.means, whole.scene.primary.means)
    # Each by itself would get fewer: the neighbour shows what lies behind it from elsewhere.
    cameras = [view.camera for view in tiny_capture().train]
    points = tiny_capture().points.positions
    alone = [int(virtual_points(points, halves.select([row]), cameras).sum()) for row in (0, 1)]
    assert sum(alone) < int(virtual_points(points, PANE, cameras).sum())


def test_mirrors_and_glass_in_one_plane_are_apart() -> None:
    doors = with_mirrors(split_in_two(PANE), (2,), 0.99)
    assert [panes.labels for panes in surfaces(doors, mirrors=True)] == [(2,)]
    assert [panes.labels for panes in surfaces(doors, mirrors=False)] == [(1,)]
    mirrors = with_mirrors(split_in_two(PANE), (1, 2), 0.99)
    assert [panes.labels for panes in surfaces(mirrors, mirrors=True)] == [(1, 2)]


def test_mirrors_are_named_and_start_at_their_reflectance() -> None:
    planes = in_single_precision(showcase(joined(pane(2.0, label=1), pane(4.0, label=2)))).planes
    found = with_mirrors(planes, (2, 7), 0.99)
    assert found.mirrors == (2,)
    torch.testing.assert_close(found.base_reflectances, torch.tensor([0.3, 0.99]))
