"""Treatment of the virtual scene behind a pane when reflections start."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from glassplat.captures.view import PointCloud
from glassplat.methods import planar
from glassplat.methods.planar import (
    DetectMirrors,
    PaneSetup,
    TurnReflections,
    coplanar_panes,
    detected_mirrors,
    is_reflection_uncovered,
    mirror_virtual_gaussians,
    seed_reflection,
)
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.panes import PlaneFit, material
from glassplat.panes.fit import with_mirrors
from glassplat.panes.material import (
    MirrorCandidate,
    MirrorRegression,
    are_mostly_reflections,
    reflections_behind,
    virtual_points,
)
from glassplat.scene.camera import mirror_matrices
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.panes import Planes
from glassplat.scene.scene import Scene
from glassplat.training.densify import gaussians_from_points
from glassplat.training.stage import Clock, TrainState
from tests.render.tiny_scene import camera_at, concatenated, in_single_precision, joined, pane, showcase
from tests.training.progress_of import finished
from tests.training.tiny_capture import tiny_capture, true_scene

PANE = true_scene().planes


def state_of(scene: Scene) -> TrainState:
    """A state with this scene, and moments of one for its means."""
    state = TrainState(scene, seed=0)
    ones = torch.ones_like(scene.primary.means)
    state.optimizer.moments["primary.means"] = (ones, ones.clone())
    return state


def mirrored(points: torch.Tensor) -> torch.Tensor:
    matrix = mirror_matrices(PANE.centers, PANE.normals)[0]
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def test_gaussians_behind_a_mirror_move_to_its_front() -> None:
    scene = true_scene()
    state = state_of(scene)
    mirror_virtual_gaussians(state, tiny_capture(), PANE)
    means, before = state.scene.primary.means, scene.primary.means
    kept = (before[:, None] == means).all(dim=-1).any(dim=1)
    moved = int((~kept).sum())
    assert 5 < moved < len(before) and len(means) == len(before)
    assert bool((before[~kept, 2] > 1.5).all())
    torch.testing.assert_close(means[-moved:], mirrored(before[~kept]))
    first_moment = state.optimizer.moments["primary.means"][0]
    assert not bool(first_moment[-moved:].any()) and bool((first_moment[:-moved] == 1).all())


def test_no_seeds_are_added_if_the_photographs_show_the_room() -> None:
    scene = true_scene()
    room = scene.primary.with_tensors({"logit_opacities": torch.full((len(scene.primary),), 6.0)})
    room = room.with_tensors({"log_scales": torch.full((len(room), 3), 0.5)})
    state = state_of(replace(scene, primary=room))
    assert not finished(seed_reflection(state, tiny_capture(), PANE))
    assert len(state.scene.primary) == len(scene.primary)


@pytest.mark.parametrize(("second", "expected"), [(60.0, True), (95.0, False)])
def test_little_is_reflected_where_less_than_half_of_all_views_together_is_covered(
    second: float, expected: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    covered = iter([10.0, second])
    image = material.MirroredImage(torch.zeros(0), torch.zeros(0), torch.tensor(100))
    monkeypatch.setattr(material, "mirrored_image", lambda *_: image._replace(coverage=torch.tensor(next(covered))))
    assert (
        finished(is_reflection_uncovered(true_scene(), PANE, [view.camera for view in tiny_capture().train[:2]]))
        == expected
    )


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


def test_few_points_behind_a_pane_are_no_evidence() -> None:
    """Three of them would become Gaussians as large as their distances."""
    scene, capture = true_scene(), tiny_capture()
    case = scene.primary.select(scene.primary.means[:, 2] > 1.5)
    behind = virtual_points(capture.points.positions, PANE, [view.camera for view in capture.train]).nonzero()[:3, 0]
    few = replace(capture.points, positions=capture.points.positions[behind], colors=capture.points.colors[behind])
    assert not finished(seed_reflection(state_of(replace(scene, primary=case)), replace(capture, points=few), PANE))


def entered(monkeypatch: pytest.MonkeyPatch, *compared: int) -> TrainState:
    """The state after panes were set up, and after further searches, with so many pixels compared in each search."""
    scene, left = true_scene(), list(compared)
    state = state_of(replace(scene, planes=Planes.empty(), glass=scene.glass.select(torch.zeros(0).long())))

    def judged(scene: Scene, dataset: Any, labels: Any) -> Any:
        yield from ()
        aligned = material.move_pane(scene, torch.tensor([0.02, 0.01, 0.05])).planes
        return {label: MirrorCandidate(aligned, MirrorRegression(0.9, 0.9), left.pop(0), 1000) for label in labels}

    monkeypatch.setattr(planar, "mirror_candidates", judged)
    monkeypatch.setattr(planar, "capture_planes", lambda *_: PANE)
    setup = PaneSetup(PlanarRecipe(glass_count=50, seed_reflections=False), seed=0)
    finished(setup(state, tiny_capture()))
    for _ in compared[1:]:
        before, known = state.scene, state.scene.planes.mirrors
        state.optimizer.moments["glass.means"] = (torch.ones_like(before.glass.means),) * 2
        found = finished(DetectMirrors((0.5,), setup).apply(state, tiny_capture(), Clock(1, 2, 6)))
        assert found == (state.scene is not before) == (state.scene.planes.mirrors != known)
        assert found == ("glass.means" not in state.optimizer.moments)
    return state


def test_glass_lies_on_the_plane_of_an_aligned_mirror(monkeypatch: pytest.MonkeyPatch) -> None:
    state = entered(monkeypatch, 1000)
    planes, glass = state.scene.planes, state.scene.glass
    assert planes.mirrors == planes.labels
    heights = (glass.means - planes.centers[0]) @ planes.normals[0]
    assert float(heights.abs().max()) < 1e-3 * state.scene.extent


def test_a_mirror_that_is_recognised_later_is_like_one_recognised_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    unknown, later, once = (entered(monkeypatch, *compared).scene for compared in ((0, 0), (0, 0, 1000, 0), (1000, 0)))
    assert unknown.planes.mirrors == () and later.planes.mirrors == once.planes.mirrors == PANE.labels
    for name, tensor in once.parameters().items():
        assert torch.equal(tensor, later.parameters()[name]), name


@pytest.mark.parametrize(
    ("recipe", "expected"),
    [
        (PlanarRecipe(), 1),
        (PlanarRecipe.paper(), 0),
        (PlanarRecipe(detect_mirrors=False), 0),
        (PlanarRecipe(fixed_mirrors=False), 0),
        (PlanarRecipe(plane_fit=PlaneFit(mirror_labels=(1,))), 0),
    ],
)
def test_only_mirrors_that_nobody_names_are_searched_for_again(recipe: PlanarRecipe, expected: int) -> None:
    assert sum(isinstance(action, DetectMirrors) for action in recipe.stages(0)[-1].actions) == expected


def split_in_two(whole: Planes) -> Planes:
    """The pane divided into two adjacent ones."""
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
    (front,) = coplanar_panes(halves, mirrors=False)
    assert coplanar_panes(halves, mirrors=True) == []
    whole, both = state_of(case), state_of(replace(case, planes=halves))
    assert finished(seed_reflection(whole, tiny_capture(), PANE)) and finished(
        seed_reflection(both, tiny_capture(), front)
    )
    torch.testing.assert_close(both.scene.primary.means, whole.scene.primary.means)
    # Separately they would get fewer: from elsewhere, the neighbour shows objects that lie behind the other.
    cameras = [view.camera for view in tiny_capture().train]
    points = tiny_capture().points.positions
    alone = [int(virtual_points(points, halves.select([row]), cameras).sum()) for row in (0, 1)]
    assert sum(alone) < int(virtual_points(points, PANE, cameras).sum())


def test_mirrors_and_glass_in_one_plane_are_apart() -> None:
    doors = with_mirrors(split_in_two(PANE), (2,), 0.99)
    assert [panes.labels for panes in coplanar_panes(doors, mirrors=True)] == [(2,)]
    assert [panes.labels for panes in coplanar_panes(doors, mirrors=False)] == [(1,)]
    mirrors = with_mirrors(split_in_two(PANE), (1, 2), 0.99)
    assert [panes.labels for panes in coplanar_panes(mirrors, mirrors=True)] == [(1, 2)]


def test_mirrors_are_named_and_start_at_their_reflectance() -> None:
    planes = in_single_precision(showcase(joined(pane(2.0, label=1), pane(4.0, label=2)))).planes
    found = with_mirrors(planes, (2, 7), 0.99)
    assert found.mirrors == (2,)
    torch.testing.assert_close(found.base_reflectances, torch.tensor([0.3, 0.99]))


def wall(depth: float) -> Gaussians:
    """An opaque wall across the view at the given depth."""
    places = torch.linspace(-2.5, 2.5, 26)
    means = torch.cartesian_prod(places, places, torch.tensor([depth]))
    return solid(means, -1.8)


def solid(means: torch.Tensor, log_scale: float = -3.0) -> Gaussians:
    """Grey, opaque balls."""
    points = PointCloud(means, torch.full_like(means, 128).to(torch.uint8))
    gaussians = gaussians_from_points(points, sh_degree=0, opacity=0.99)
    return gaussians.with_tensors({"means": means, "log_scales": torch.full((len(means), 3), log_scale)})


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (30.0, -20.0, 50.0)], ids=["near", "far from the origin"])
def test_gaussians_behind_a_wall_are_reflections_unless_the_space_in_front_is_empty(
    origin: tuple[float, float, float],
) -> None:
    tilted, middle = in_single_precision(showcase(pane(2.0, half=0.8))), torch.tensor(origin)
    planes = replace(
        tilted.planes, centers=torch.tensor([[0.0, 0, 2]]) + middle, raw_normals=torch.tensor([[0.0, 0, -1]])
    )
    far, near, before = (torch.tensor([place]) for place in ((0.05, 0.0, 6.0), (0.05, 0.0, 3.8), (0.75, 0.0, 1.0)))
    primary = concatenated(wall(3.0), solid(far), solid(near), solid(before))
    primary = primary.with_tensors({"means": primary.means + middle})
    scene = replace(tilted, primary=primary, planes=planes)
    places = (camera_at(origin[0] + x, origin[1], origin[2] - 0.3) for x in (-0.2, 0.2))
    cameras = [replace(camera, cam_from_world=camera.cam_from_world.float()) for camera in places]
    found = reflections_behind(scene, planes, cameras)
    # The mirrored far one lies behind the cameras; the mirrored near one in front of them, where they see empty space.
    assert found.nonzero().flatten().tolist() == [len(primary) - 3]

    state = state_of(scene)
    dataset: Any = SimpleNamespace(train=[SimpleNamespace(camera=camera) for camera in cameras])
    action = TurnReflections((0.25,))
    assert action.due(Clock(25, 100, 1)) and not action.due(Clock(26, 100, 1))
    assert finished(action.apply(state, dataset, Clock(25, 100, 1)))
    torch.testing.assert_close(state.scene.primary.means[-1] - middle, torch.tensor([0.05, 0.0, -2.0]))
    assert len(state.scene.primary) == len(primary)
    assert not finished(action.apply(state, dataset, Clock(25, 100, 1)))


def test_reflections_without_a_surface_in_front_are_not_turned(monkeypatch: pytest.MonkeyPatch) -> None:
    glass = in_single_precision(showcase(pane(2.0, half=0.8)))
    planes = replace(glass.planes, centers=torch.tensor([[0.0, 0, 2]]), raw_normals=torch.tensor([[0.0, 0, -1]]))
    places = (camera_at(x, 0, -0.3) for x in (-0.2, 0.2))
    cameras = [replace(camera, cam_from_world=camera.cam_from_world.float()) for camera in places]
    # The far one's mirror image lies behind the cameras, the other's behind an object next to the pane.
    far, other, thing = (torch.tensor([place]) for place in ((0.05, 0.0, 6.0), (0.7, 0.0, 3.3), (0.45, 0.0, 0.2)))

    def found(*parts: Gaussians) -> list[int]:
        scene = replace(glass, primary=concatenated(wall(2.5), *parts), planes=planes)
        return (reflections_behind(scene, planes, cameras).nonzero().flatten() - len(wall(2.5))).tolist()

    assert found(solid(far), solid(other), solid(thing, -2.5)) == [0, 1]
    monkeypatch.setattr(material, "LEAST_ALWAYS_HIDDEN", 2.0)
    assert found(solid(far), solid(other), solid(thing, -2.5)) == []
    mirrored = torch.tensor([[0.7, 0.0, 0.7]])
    assert found(solid(far), solid(other), solid(mirrored, -2.5)) == [0, 1]
    # No view shows the far one's mirrored position: only being hidden always can tell that it is not real.
    monkeypatch.setattr(material, "MANY_ALWAYS_HIDDEN", 2.0)
    assert found(solid(far), solid(other), solid(mirrored, -2.5)) == [1]


@pytest.mark.parametrize(
    ("often", "always", "looked_at", "confirmed", "expected"),
    [
        (3670, 3360, 1735, 885, True),
        (1937, 1807, 948, 134, True),  # in front of the visible part of the room, which is small
        (1066, 635, 114, 63, True),
        (300, 280, 0, 0, True),
        (1719, 1185, 264, 6, False),
        (1802, 1501, 1413, 275, False),
        (3379, 1769, 1427, 67, False),
        (1469, 932, 1006, 220, False),
        (6365, 3256, 36, 36, False),  # a street behind a real front, with hardly any positions viewed in front of it
        (1324, 1130, 35, 34, True),  # photographed from the front
        (1321, 727, 556, 264, True),
    ],
)
def test_a_front_mirrors_what_is_behind_it_if_it_is_always_hidden_or_confirmed_in_front(
    often: int, always: int, looked_at: int, confirmed: int, expected: bool
) -> None:
    counts = map(torch.tensor, (often, always, looked_at, confirmed))
    assert bool(are_mostly_reflections(*counts)) == expected


@pytest.mark.parametrize(("slope", "expected"), [(0.42, []), (0.75, [2])])
def test_a_pane_of_a_glass_front_is_a_mirror_only_beyond_doubt(slope: float, expected: list[int]) -> None:
    one, other = pane(2.0, half=0.4), pane(2.0, half=0.4, label=2)
    beside = replace(other, centers=one.centers + one.axes()[0])
    planes = joined(one, beside)
    glass = MirrorCandidate(one, MirrorRegression(0.14, 0.2), 5000, 8000)
    alike = MirrorCandidate(beside, MirrorRegression(slope, 0.5), 5000, 8000)
    assert detected_mirrors(planes, {1: glass, 2: alike}) == expected
    unknown = glass._replace(compared=10)
    assert detected_mirrors(planes, {1: unknown, 2: alike}) == [2]
    assert detected_mirrors(planes, {2: alike}) == [2]
