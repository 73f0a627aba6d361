"""Edits of the training state that are not covered by the tests of a recipe."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from glassplat.captures.dataset import Dataset
from glassplat.captures.view import PointCloud, View
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.render.frame import Renderer
from glassplat.render.layers import contributions
from glassplat.render.planar import Planar
from glassplat.render.splat import Splat
from glassplat.scene import SH_ZERO
from glassplat.scene.camera import Camera
from glassplat.scene.corrections import Exposures
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.panes import Planes
from glassplat.scene.scene import Scene, glass_gaussians, without_glass
from glassplat.training.actions import Densify, PruneIdle, SeedUnexplained, densify_cap, unexplained_positions
from glassplat.training.densify import (
    ScreenStatistics,
    gaussians_from_points,
    gaussians_near_cameras,
)
from glassplat.training.options import DefaultDensify, McmcDensify
from glassplat.training.stage import Clock, TrainState
from tests.panes.test_material import CountedElements
from tests.render.tiny_scene import concatenated
from tests.training.progress_of import finished
from tests.training.tiny_capture import tiny_capture


def state_with_one_out_of_sight() -> TrainState:
    scene: Scene = SplatRecipe(sh_degree=1).initialise(tiny_capture())
    means = scene.primary.means.clone()
    means[3] = 1000.0
    state = TrainState(replace(scene, primary=scene.primary.with_tensors({"means": means})), seed=0)
    rows = torch.arange(len(means), dtype=torch.float32)[:, None].expand(-1, 3).contiguous()
    state.optimizer.moments["primary.means"] = (rows.clone(), rows.clone())
    return state


def test_unneeded_gaussians_are_removed_with_their_moments() -> None:
    state, action = state_with_one_out_of_sight(), PruneIdle(DefaultDensify(least_contribution=1e-3))
    before = state.scene.primary.means
    gathered = torch.arange(2 * len(before), dtype=torch.float32).reshape(2, -1)
    state.statistics["primary"] = ScreenStatistics(gathered, 2 * gathered, 3 * gathered)
    assert finished(action.apply(state, tiny_capture(), Clock(50, 100, 5)))
    kept = state.optimizer.moments["primary.means"][0][:, 0].long()
    assert 0 < len(kept) < len(before) and 3 not in kept.tolist()
    assert torch.equal(state.scene.primary.means, before[kept])
    for times, sums in enumerate(state.statistics["primary"], start=1):
        assert torch.equal(sums, times * gathered[:, kept])
    assert not finished(action.apply(state, tiny_capture(), Clock(80, 100, 5)))


def one_gaussian(
    scales: tuple[float, float, float], opacity: float, quat: tuple[float, ...] = (1, 0, 0, 0)
) -> Gaussians:
    """One Gaussian at (1, 0, 0)."""
    return Gaussians(
        means=torch.tensor([[1.0, 0.0, 0.0]]),
        quats=torch.tensor([quat], dtype=torch.float32),
        log_scales=torch.tensor([scales]).log(),
        logit_opacities=torch.logit(torch.tensor([opacity])),
        sh=torch.zeros(1, 1, 3),
    )


NO_POINTS = torch.empty(0, 3)


@pytest.mark.parametrize(
    ("gaussian", "expected"),
    [
        (one_gaussian((1.0, 0.1, 0.1), 0.9), True),
        (one_gaussian((0.1, 1.0, 1.0), 0.9), False),
        (one_gaussian((0.1, 1.0, 0.1), 0.9, quat=(1, 0, 0, 1)), True),
        (one_gaussian((1.0, 0.1, 0.1), 0.1), False),
        (one_gaussian((0.5, 0.5, 0.5), 0.99), True),
        (one_gaussian((0.4, 0.4, 0.4), 0.99), False),
        (one_gaussian((0.5, 1.0, 1.0), 0.9), True),
        (one_gaussian((0.45, 1.0, 1.0), 0.9), False),
    ],
)
def test_fog_is_what_is_opaque_where_a_camera_stands(gaussian: Gaussians, expected: bool) -> None:
    far, here = torch.tensor([[9.0, 9.0, 9.0]]), torch.zeros(1, 3)
    assert gaussians_near_cameras(gaussian, torch.cat([far, here]), NO_POINTS)[0].tolist() == [expected]
    assert not gaussians_near_cameras(gaussian, far, NO_POINTS)[0].any()


def test_gaussians_around_a_camera_are_removed_even_if_others_see_them() -> None:
    state, capture = state_with_one_out_of_sight(), tiny_capture()
    row = int(contributions(state.scene, capture.train[0].camera).argmax())
    means = state.scene.primary.means.clone()
    # Between the last camera and its target, so that the others see it at the border of their images.
    means[row] = capture.train[5].camera.center - torch.tensor([0.0, 0.0, 0.3])
    log_scales = state.scene.primary.log_scales.clone()
    log_scales[row] = math.log(0.4)
    primary = state.scene.primary.with_tensors({"means": means, "log_scales": log_scales})
    state.scene = replace(state.scene, primary=primary)
    state.optimizer.moments["primary.means"] = (torch.arange(len(means)).float()[:, None].repeat(1, 3),) * 2
    assert finished(PruneIdle(DefaultDensify(least_contribution=1e-3)).apply(state, capture, Clock(50, 100, 5)))
    assert row not in state.optimizer.moments["primary.means"][0][:, 0].long().tolist()


def test_gaussians_nearer_to_a_camera_than_any_surface_are_in_mid_air() -> None:
    means = torch.tensor([[0.0, 0.0, 0.1], [0.0, 0.0, 0.4], [5.0, 0.0, 0.0]])
    gaussians = one_gaussian((1e-3, 1e-3, 1e-3), 0.5).select(torch.zeros(3, dtype=torch.long))
    gaussians = gaussians.with_tensors({"means": means})
    places = torch.tensor([[0.0, 0.0, 0.0], [0.0, 9.0, 0.0]])
    # One point in front of the first camera is wrong.
    points = torch.tensor([[0.0, 0.0, 0.01], [0.0, 0.1, 2.0], [0.1, 0.0, 2.0], [0.0, 0.0, 30.0]])
    assert gaussians_near_cameras(gaussians, places, points)[1].tolist() == [True, False, False]
    assert not gaussians_near_cameras(gaussians, places, points[:2])[1].any()


def test_the_nearest_camera_decides_how_large_a_gaussian_may_be() -> None:
    places = torch.tensor([[1.0, 0.0, 2.0], [0.0, 0.0, -9.0]])
    for longest, expected in ((0.79, False), (0.81, True)):
        suspicious = gaussians_near_cameras(one_gaussian((0.01, longest, 0.1), 0.5), places, NO_POINTS)[1]
        assert suspicious.tolist() == [expected]


@pytest.mark.parametrize(
    ("needed", "measured", "large", "stays"),
    [
        (0.0005, True, False, True),
        (0.00005, True, False, False),
        (0.00005, False, False, True),
        (0.00005, False, True, False),
        (0.0005, False, True, True),
    ],
)
def test_gaussians_in_front_of_a_camera_stay_only_if_needed(
    needed: float, measured: bool, large: bool, stays: bool
) -> None:
    state, capture = state_with_one_out_of_sight(), tiny_capture()
    means = state.scene.primary.means.clone()
    means[5] = capture.train[5].camera.center - torch.tensor([0.0, 0.0, 0.01])
    log_scales = state.scene.primary.log_scales.clone()
    log_scales[5] = torch.tensor([0.005 if large else 0.003, 1e-4, 1e-4]).log()
    primary = state.scene.primary.with_tensors({"means": means, "log_scales": log_scales})
    state.scene = replace(state.scene, primary=primary)
    state.optimizer.moments["primary.means"] = (torch.arange(len(means)).float()[:, None].repeat(1, 3),) * 2

    def added(scene: Scene, camera: Camera) -> torch.Tensor:
        share = torch.ones(len(means))
        share[3], share[5] = 0, needed
        return share * camera.width * camera.height

    action = PruneIdle(DefaultDensify(least_contribution=1e-3), measure=added)
    assert finished(action.apply(state, replace(capture, measured_points=measured), Clock(50, 100, 5)))
    assert (5 in state.optimizer.moments["primary.means"][0][:, 0].long().tolist()) == stays


def test_idle_gaussians_are_pruned_at_the_configured_moments() -> None:
    def due(densifier: DefaultDensify) -> list[int]:
        return [step for step in range(1, 101) if PruneIdle(densifier).due(Clock(step, 100, 5))]

    assert due(DefaultDensify()) == [50, 80, 100]
    assert due(DefaultDensify(contribution_moments=(0.5, 0.8))) == [50, 80]
    assert due(DefaultDensify(least_contribution=0)) == []


@pytest.mark.parametrize(
    ("densifier", "limit"),
    [
        (DefaultDensify(per_pixel=0.01), 0.01),
        (DefaultDensify(per_pixel=0.01, cap=5), None),
        (DefaultDensify(per_pixel=0.0), None),
        (DefaultDensify.published(), None),
    ],
)
def test_photographs_limit_the_number_of_gaussians(densifier: DefaultDensify, limit: float | None) -> None:
    capture = tiny_capture()
    pixels = sum(view.camera.width * view.camera.height for view in capture.train)
    assert densify_cap(densifier, capture) == (densifier.cap if limit is None else round(limit * pixels))


@pytest.mark.parametrize("by", ["its own cap", "the cap of mcmc"])
def test_a_set_grows_up_to_its_cap(by: str) -> None:
    state, capture = TrainState(SplatRecipe(sh_degree=1).initialise(tiny_capture()), seed=0), tiny_capture()
    count = len(state.scene.primary)
    ones = torch.ones(2, count)
    state.statistics["primary"] = ScreenStatistics(ones, ones, ones)
    share = (count + 2) / sum(view.camera.width * view.camera.height for view in capture.train)
    own = by == "its own cap"
    densify = Densify(DefaultDensify(per_pixel=share if own else 0.0), mcmc=None if own else McmcDensify(cap=count + 2))
    densify.apply(state, capture, Clock(10, 100, 5))
    assert len(state.scene.primary) == count + 2


@pytest.mark.parametrize("adapts", [True, False])
def test_thresholds_rise_for_small_photographs(adapts: bool) -> None:
    state, capture = TrainState(SplatRecipe(sh_degree=1).initialise(tiny_capture()), seed=0), tiny_capture()
    count, options = len(state.scene.primary), DefaultDensify(adapt_to_size=adapts)
    gradients, absgrads = torch.ones(2, 2, count) * 1.5
    gradients, absgrads = options.gradient_threshold * gradients, options.absgrad_threshold * absgrads
    state.statistics["primary"] = ScreenStatistics(gradients, absgrads, torch.ones(2, count))
    Densify(options).apply(state, capture, Clock(10, 100, 5))
    assert (len(state.scene.primary) > count) != adapts


def views_of(scene: Scene) -> Dataset:
    """Ten views of a scene from a half circle, without test views."""
    views = []
    for index in range(10):
        angle = math.pi * (index - 4.5) / 10
        place = (2.5 * math.sin(angle), 0.2 * (-1) ** index, -2.5 * math.cos(angle))
        camera = Camera.look_at(place, (0, 0, 0), up=(0, -1, 0), width=80, height=60)
        photo = (255 * Splat()(scene, camera).rgb.clamp(0, 1)).to(torch.uint8)
        views.append(View.in_memory(f"{index}.png", camera, photo=photo))
    points = PointCloud(scene.primary.means, torch.full_like(scene.primary.means, 128).to(torch.uint8))
    return Dataset(Path("made"), tuple(views), (), points, scene.extent)


def balls(centers: list[tuple[float, float, float]], colors: list[int], log_scale: float) -> Gaussians:
    points = PointCloud(torch.tensor(centers), torch.tensor(colors)[:, None].repeat(1, 3).to(torch.uint8))
    made = gaussians_from_points(points, sh_degree=0, opacity=0.99)
    return made.with_tensors({"log_scales": torch.full((len(centers), 3), log_scale)})


def test_an_object_without_points_is_found_by_its_photographs() -> None:
    side = torch.linspace(-1.5, 1.5, 50).tolist()
    ground = balls([(x, 1.0, z) for x in side for z in side], [90] * 2500, -3.0)
    lamp = balls([(0.3, -0.2, 0.1)], [250], -1.8)
    whole = Scene(concatenated(ground, lamp), 2.0)
    state, capture = TrainState(Scene(ground, 2.0), seed=0), views_of(whole)
    means = torch.ones_like(ground.means)
    state.optimizer.moments["primary.means"] = (means, means.clone())
    full = SeedUnexplained((0.2,), Splat(), cap=len(ground) + 5)
    assert not finished(full.apply(state, capture, Clock(20, 100, 10))) and len(state.scene.primary) == len(ground)
    action = SeedUnexplained((0.2,), Splat(), cap=2 * len(ground))
    assert action.due(Clock(20, 100, 10)) and not action.due(Clock(21, 100, 10))
    assert finished(action.apply(state, capture, Clock(20, 100, 10)))
    added = state.scene.primary.means[len(ground) :]
    assert len(added) > 5 and float((added - torch.tensor([0.3, -0.2, 0.1])).norm(dim=1).max()) < 0.5
    assert float((state.scene.primary.sh[len(ground) :, 0] * SH_ZERO + 0.5).mean()) > 0.3
    assert not bool(state.optimizer.moments["primary.means"][0][len(ground) :].any())
    before = float(
        (Splat()(Scene(ground, 2.0), capture.train[4].camera).rgb - capture.train[4].photo / 255).abs().mean()
    )
    after = float((Splat()(state.scene, capture.train[4].camera).rgb - capture.train[4].photo / 255).abs().mean())
    assert after < 0.5 * before


def missing_in(scene: Scene, views: Sequence[View], renderer: Renderer) -> torch.Tensor:
    """[P, 3] positions of objects that views show and a scene lacks."""
    search = unexplained_positions(scene, views, renderer)
    while True:
        try:
            next(search)
        except StopIteration as end:
            return end.value[0].positions


def test_views_that_ignore_a_position_are_no_evidence_against_missing_objects() -> None:
    whole = Scene(balls([(0.3, -0.2, 0.1), (0.0, 0.4, 0.0)], [250, 30], -1.8), 2.0)
    ground = Scene(whole.primary.select(torch.tensor([False, True])), 2.0)
    views = list(views_of(whole).train)
    found = missing_in(ground, views, Splat())
    everything = torch.ones(views[0].photo.shape[:2], dtype=torch.bool)
    for number in (0, 3, 6, 9):
        views[number] = replace(views[number], read_ignored=lambda: everything)
    assert len(missing_in(ground, views, Splat())) > 0.9 * len(found) > 5


def test_photographs_from_one_side_do_not_locate_missing_objects() -> None:
    whole = Scene(balls([(0.3, -0.2, 0.1), (0.0, 0.4, 0.0)], [250, 30], -1.8), 2.0)
    ground = Scene(whole.primary.select(torch.tensor([False, True])), 2.0)
    around = views_of(whole).train[2:7]
    assert len(missing_in(ground, around, Splat())) > 5
    assert len(missing_in(ground, around[:1] * 5, Splat())) == 0


def test_missing_objects_are_found_with_window_sums() -> None:
    """On photographs of two megapixels, summing every window separately took half a minute for each."""
    whole = Scene(balls([(0.3, -0.2, 0.1), (0.0, 0.4, 0.0)], [250, 30], -1.8), 2.0)
    ground = Scene(whole.primary.select(torch.tensor([False, True])), 2.0)
    with CountedElements():
        assert len(missing_in(ground, views_of(whole).train, Splat())) > 5


def test_exposures_do_not_hide_what_photographs_agree_on() -> None:
    whole = Scene(balls([(0.3, -0.2, 0.1), (0.0, 0.4, 0.0)], [180, 30], -1.8), 2.0)
    ground = Scene(whole.primary.select(torch.tensor([False, True])), 2.0)
    views = list(views_of(whole).train)
    found = missing_in(ground, views, Splat())
    exposures = Exposures.neutral(tuple(view.name for view in views))
    exposures.values[:, :, :3] = torch.tensor([-0.25, 0.25]).repeat(5)[:, None, None] * torch.eye(3)
    for number, view in enumerate(views):
        brightened = (exposures.apply(view.photo / 255, view.name).clamp(0, 1) * 255).round().to(torch.uint8)
        views[number] = View.in_memory(view.name, view.camera, photo=brightened)
    assert len(missing_in(replace(ground, exposures=exposures), views, Splat())) > 0.9 * len(found) > 5


def test_nothing_is_added_where_the_scene_explains_the_photographs() -> None:
    whole = Scene(balls([(0.0, 0.0, 0.0), (0.5, 0.2, 0.3)], [200, 90], -1.8), 2.0)
    state = TrainState(whole, seed=0)
    assert len(missing_in(whole, views_of(whole).train, Splat())) == 0
    assert not finished(SeedUnexplained((0.2,), Splat()).apply(state, views_of(whole), Clock(20, 100, 10)))
    assert state.scene is whole


def test_nothing_is_added_to_a_scene_that_is_mostly_missing() -> None:
    whole = Scene(balls([(0.3, -0.2, 0.1), (0.0, 0.4, 0.0)], [250, 200], -1.8), 2.0)
    state = TrainState(Scene(whole.primary.select(torch.tensor([False, True])), 2.0), seed=0)
    assert len(missing_in(state.scene, views_of(whole).train, Splat())) > 5
    assert not finished(SeedUnexplained((0.2,), Splat()).apply(state, views_of(whole), Clock(20, 100, 10)))


def test_reflections_are_not_found_as_missing_objects_behind_a_pane() -> None:
    planes = Planes.rectangle((0.0, 0.0, 0.5), (0.0, 0.0, -1.0), (3.0, 3.0))
    room = balls([(0.0, 0.0, -1.2)], [250], -1.5)
    mirror = planes.with_tensors({"logit_reflectances": torch.logit(torch.tensor([0.9]))})
    whole = Scene(room, 2.0, glass=glass_gaussians(mirror, opacity=0.9), planes=mirror)
    plain = replace(whole, planes=mirror.with_tensors({"logit_reflectances": torch.logit(torch.tensor([0.01]))}))
    shown = [
        View.in_memory(
            view.name, view.camera, photo=(255 * Planar()(whole, view.camera).rgb.clamp(0, 1)).to(torch.uint8)
        )
        for view in views_of(whole).train
    ]
    assert not bool((missing_in(plain, shown, Planar())[:, 2] > 0.5).any())
    assert bool((missing_in(without_glass(plain), shown, Planar())[:, 2] > 0.5).any())
