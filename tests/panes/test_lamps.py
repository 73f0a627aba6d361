"""Lamps found by their reflections, and objects reflected by panes that no photograph shows directly."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from glassplat.captures.dataset import Dataset
from glassplat.captures.view import PointCloud, View
from glassplat.methods.planar import FillUnseen, LightLamps
from glassplat.panes.material import (
    CLIPPED,
    Photograph,
    _ends_of_rays,
    mirrored_image,
    mirrored_lamps,
    reduced_photographs,
    unseen_positions,
)
from glassplat.render.planar import Planar
from glassplat.scene.camera import Camera, mirror_matrices
from glassplat.scene.corrections import Exposures
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.panes import Planes
from glassplat.scene.scene import Scene, glass_gaussians
from glassplat.training.actions import Densify
from glassplat.training.densify import ScreenStatistics, gaussians_from_points
from glassplat.training.options import DefaultDensify
from glassplat.training.stage import Clock, TrainState
from tests.panes.test_material import CountedElements
from tests.render.tiny_scene import concatenated
from tests.training.progress_of import finished

LAMP = (0.9, 0.0, 1.0)
IMAGE = (0.9, 0.0, 3.0)
RADIANCE = 6.0
RED = (255, 60, 60)
DEFAULT = Planar()


def camera(x: float) -> Camera:
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([-x, 0.0, 0.3])
    return Camera(pose, 100.0, 100.0, 80.0, 60.0, 160, 120)


CAMERAS = [camera(x) for x in (-0.3, -0.1, 0.0, 0.1, 0.3)]


def gaussians(means: Tensor, color: int | tuple[int, int, int], log_scale: float) -> Gaussians:
    colors = torch.tensor(color, dtype=torch.uint8).expand(means.shape).clone()
    made = gaussians_from_points(PointCloud(means, colors), sh_degree=0, opacity=0.99)
    return made.with_tensors({"means": means, "log_scales": torch.full((len(means), 3), log_scale)})


def panel(center: tuple[float, float, float], color: int | tuple[int, int, int] = 255) -> Gaussians:
    side = torch.linspace(-0.2, 0.2, 9)
    means = torch.tensor(center) + torch.cartesian_prod(side, side, torch.zeros(1))
    return gaussians(means, color, math.log(0.03))


def wall(depth: float, color: int = 40) -> Gaussians:
    side = torch.linspace(-5, 5, 61)
    return gaussians(torch.cartesian_prod(side, side, torch.tensor([depth])), color, math.log(0.13))


def scene_of(*parts: Gaussians) -> Scene:
    planes = Planes.rectangle((0.0, 0.0, 2.0), (0.0, 0.0, -1.0), (0.8, 0.8))
    planes = planes.with_tensors({"logit_reflectances": torch.logit(torch.tensor([0.1]))})
    return Scene(concatenated(*parts), 2.0, glass=glass_gaussians(planes, opacity=0.9), planes=planes)


def shining(lamp: Gaussians) -> Gaussians:
    return lamp.with_tensors({"log_intensity": torch.full((len(lamp),), math.log(RADIANCE))})


def photographs_of(scene: Scene, renderer: Planar = DEFAULT) -> list[Photograph]:
    return [
        Photograph(view, rgb, torch.ones_like(rgb[..., 0], dtype=torch.bool), None, rgb.amin(dim=-1) > CLIPPED)
        for view in CAMERAS
        for rgb in [renderer(scene, view).rgb.clamp(0, 1)]
    ]


@pytest.mark.parametrize("ignored", [0, 2])
def test_the_image_of_a_lamp_is_found_and_the_lamp_gets_its_radiance(ignored: int) -> None:
    photographs = photographs_of(scene_of(wall(4.0), shining(panel(LAMP))))
    for number in range(5 - ignored, 5):
        black = torch.zeros_like(photographs[number].pixels)
        photographs[number] = photographs[number]._replace(pixels=black, valid=torch.zeros_like(black[..., 0]).bool())
    first = scene_of(wall(4.0), panel(LAMP), panel(IMAGE))
    with CountedElements():
        lamps = mirrored_lamps(first, first.planes, photographs, renderer=DEFAULT)
    assert lamps is not None
    before, lamp = len(wall(4.0)), len(panel(LAMP))
    assert bool(lamps.images[before + lamp :].float().mean() > 0.7) and not bool(lamps.images[: before + lamp].any())
    gains = lamps.gains[before : before + lamp]
    assert bool((gains > 1).float().mean() > 0.5) and not bool((lamps.gains[:before] != 1).any())
    assert 0.7 * RADIANCE < float(gains[gains > 1].median()) < 1.3 * RADIANCE


@pytest.mark.parametrize("renderer", [Planar((0.5, 0.5, 0.5)), Planar(blend="srgb")], ids=["background", "blend"])
def test_lamps_get_their_radiance_as_the_run_renders_them(renderer: Planar) -> None:
    first, lit = scene_of(panel(LAMP), panel(IMAGE)), scene_of(shining(panel(LAMP)))
    lamps = mirrored_lamps(first, first.planes, photographs_of(lit, renderer), renderer=renderer)
    assert lamps is not None
    gains = lamps.gains[: len(panel(LAMP))]
    assert 0.85 * RADIANCE < float(gains[gains > 1].median()) < 1.15 * RADIANCE


@pytest.mark.parametrize(
    ("photographed", "first"),
    [
        pytest.param([panel(LAMP, 200), panel(IMAGE)], [panel(LAMP, 200), panel(IMAGE)], id="grey where it is seen"),
        pytest.param(
            [panel(LAMP), panel((0.5, 0.4, 3.0))], [panel(LAMP), panel((0.5, 0.4, 3.0))], id="as bright as white"
        ),
        pytest.param([shining(panel(LAMP))], [shining(panel(LAMP)), panel((0.2, 0.3, 3.0))], id="an image elsewhere"),
        pytest.param([panel(LAMP, RED), panel(IMAGE)], [panel(LAMP, RED), panel(IMAGE)], id="red where it is seen"),
    ],
)
def test_no_lamp_is_found_without_need(photographed: list[Gaussians], first: list[Gaussians]) -> None:
    scene = scene_of(wall(4.0), *first)
    assert (
        mirrored_lamps(scene, scene.planes, photographs_of(scene_of(wall(4.0), *photographed)), renderer=DEFAULT)
        is None
    )


@pytest.mark.parametrize(
    ("early", "count"),
    [([panel(LAMP, 200), shining(panel(IMAGE))], 4), ([panel(LAMP)], 3)],
    ids=["grey where it is seen", "dark in the glass"],
)
def test_a_lamp_is_one_in_most_photographs(early: list[Gaussians], count: int) -> None:
    first = scene_of(wall(4.0), panel(LAMP), panel(IMAGE))
    late = photographs_of(scene_of(wall(4.0), shining(panel(LAMP))))
    photographs = photographs_of(scene_of(wall(4.0), *early))[:count] + late[count:]
    assert mirrored_lamps(first, first.planes, photographs, renderer=DEFAULT) is None


@pytest.mark.parametrize("ignored", [(True, True), (True, False), (False, True)], ids=["all", "past", "in the glass"])
def test_ignored_pixels_make_no_lamp(ignored: tuple[bool, bool]) -> None:
    lit, first = scene_of(wall(4.0), shining(panel(LAMP))), scene_of(wall(4.0), panel(LAMP), panel(IMAGE))
    in_glass = [Planar()(lit, view).layers["strength"] > 0 for view in CAMERAS]
    hidden = [
        one._replace(valid=~torch.where(glass, ignored[1], ignored[0]))
        for one, glass in zip(photographs_of(lit), in_glass, strict=True)
    ]
    assert mirrored_lamps(first, first.planes, hidden, renderer=DEFAULT) is None


def test_what_stands_before_the_glass_is_not_the_image_of_a_lamp() -> None:
    photographs = photographs_of(scene_of(wall(4.0), shining(panel(LAMP))))
    haze = panel((0.57, 0.0, 1.9))
    haze = haze.with_tensors({"logit_opacities": torch.full((len(haze),), -4.0)})
    first = scene_of(wall(4.0), panel(LAMP), panel(IMAGE), haze)
    lamps = mirrored_lamps(first, first.planes, photographs, renderer=DEFAULT)
    assert lamps is not None and not bool(lamps.images[-len(haze) :].any())


def test_places_are_found_where_a_pane_mirrors_nothing_and_nowhere_else() -> None:
    half = wall(-3.0, 120)
    half = half.select(half.means[:, 0] < 0)
    empty, closed = scene_of(wall(4.0), half), scene_of(wall(4.0), wall(-3.0, 120))
    found = unseen_positions(empty, empty.planes, CAMERAS)
    assert len(found.positions) > 10
    assert bool((found.positions[:, 2] < 2).all()) and float((found.positions[:, 0] > -0.5).float().mean()) == 1
    torch.testing.assert_close(found.color, torch.full((3,), 120 / 255), atol=0.02, rtol=0)
    assert len(unseen_positions(closed, closed.planes, CAMERAS).positions) == 0


def test_unseen_positions_lie_at_the_end_of_the_room_behind_the_hole() -> None:
    pane = Planes.rectangle((0.1, 0.0, 2.0), (0.2, -0.1, -1.0), (0.8, 0.6))
    view, hole, middle = camera(0.3), torch.zeros(120, 160, dtype=torch.bool), torch.tensor([0.1, 0.2, -0.3])
    hole[30:70, 60:140] = True
    places = _ends_of_rays(pane, view, hole, middle, torch.tensor(5.0))
    torch.testing.assert_close((places - middle).norm(dim=1), torch.full((len(places),), 5.0))
    mirrored = replace(view, cam_from_world=view.cam_from_world @ mirror_matrices(pane.centers, pane.normals)[0])
    pixels, depths = mirrored.project(places)
    row, column = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
    expected = torch.stack([column, row], dim=-1)[::4, ::4][hole[::4, ::4]] + 0.5
    torch.testing.assert_close(pixels, expected, atol=1e-3, rtol=0)
    assert len(places) == 200 and bool((depths > 2).all())


def state_of(scene: Scene) -> TrainState:
    state, ones = TrainState(scene, seed=0), torch.ones_like(scene.primary.means)
    state.optimizer.moments["primary.means"] = (ones, ones.clone())
    return state


def capture_of(scene: Scene) -> Dataset:
    views = []
    for number, view in enumerate(CAMERAS):
        photo = (255 * Planar()(scene, view).rgb.clamp(0, 1)).to(torch.uint8)
        views.append(View.in_memory(f"{number}.png", view, photo=photo))
    points = PointCloud(scene.primary.means, torch.full_like(scene.primary.means, 128).to(torch.uint8))
    return Dataset(Path("made"), tuple(views), (), points, scene.extent, pane_labels=(1,))


def test_lamps_are_brightened_at_their_moments_and_their_images_removed() -> None:
    capture = capture_of(scene_of(wall(4.0), shining(panel(LAMP))))
    state, action = state_of(scene_of(wall(4.0), panel(LAMP), panel(IMAGE))), LightLamps((0.4, 0.6), DEFAULT)
    assert [step for step in range(101) if action.due(Clock(step, 100, 5))] == [40, 60]
    before = len(state.scene.primary)
    assert finished(action.apply(state, capture, Clock(40, 100, 5)))
    gone = before - len(state.scene.primary)
    assert 0 < gone <= len(panel(IMAGE)) == before - len(wall(4.0)) - len(panel(LAMP))
    assert len(state.optimizer.moments["primary.means"][0]) == len(state.scene.primary)
    assert float(state.scene.primary.channels["log_intensity"].max()) > math.log(0.5 * RADIANCE)
    mirrors = scene_of(wall(4.0), panel(LAMP), panel(IMAGE))
    mirrors = replace(mirrors, planes=replace(mirrors.planes, mirrors=(1,)))
    assert not finished(action.apply(state_of(mirrors), capture, Clock(40, 100, 5)))


@pytest.mark.parametrize("change", [0.1, -0.1])
def test_lamps_are_clipped_in_the_colours_of_their_photographs(change: float) -> None:
    """White of a brighter photograph is grey in the scene's colours, and grey of a darker one is white."""
    capture = capture_of(scene_of(wall(4.0), shining(panel(LAMP))))
    exposed = [
        replace(view, read_photo=lambda photo=view.photo: ((1 + change) * photo.float()).clamp(max=255).to(torch.uint8))
        for view in capture.train
    ]
    affine = change * torch.eye(3, 4).repeat(len(exposed), 1, 1)
    exposures = Exposures(affine, tuple(view.name for view in exposed))
    first = replace(scene_of(wall(4.0), panel(LAMP), panel(IMAGE)), exposures=exposures)
    lamps = mirrored_lamps(first, first.planes, reduced_photographs(first, exposed), renderer=DEFAULT)
    assert (lamps is not None) == (change > 0)


def test_brightening_lamps_does_not_prevent_densification() -> None:
    capture = capture_of(scene_of(wall(4.0), shining(panel(LAMP))))
    state = state_of(scene_of(wall(4.0), panel(LAMP), panel(IMAGE)))
    state.statistics["primary"] = ScreenStatistics(*torch.ones(3, 2, len(state.scene.primary)))
    assert finished(LightLamps((0.5,), DEFAULT).apply(state, capture, Clock(50, 100, 5)))
    left = len(state.scene.primary)
    eager = DefaultDensify(gradient_threshold=0.1, absgrad_threshold=0.1, per_pixel=0)
    assert Densify(eager).apply(state, capture, Clock(50, 100, 5))
    assert len(state.scene.primary) > 1.5 * left


def test_unseen_reflected_parts_are_filled_once() -> None:
    scene = scene_of(wall(4.0), wall(-3.0, 120).select(wall(-3.0).means[:, 0] < 1))
    state, action = state_of(scene), FillUnseen((0.5,))
    state.statistics["primary"] = ScreenStatistics(*torch.ones(3, 2, len(scene.primary)))
    full = replace(action, cap=len(scene.primary))
    assert not finished(full.apply(state, capture_of(scene), Clock(50, 100, 5)))
    assert finished(action.apply(state, capture_of(scene), Clock(50, 100, 5)))
    added = len(state.scene.primary) - len(scene.primary)
    for sums in state.statistics["primary"]:
        assert bool((sums[:, :-added] == 1).all()) and not bool(sums[:, -added:].any())
    size = 0.7 * unseen_positions(scene, scene.planes, CAMERAS).cell
    assert bool(torch.isclose(state.scene.primary.log_scales[-added:].exp(), torch.tensor(size)).all())
    assert added > 10 and not bool(state.optimizer.moments["primary.means"][0][-added:].any())
    images = [mirrored_image(one, CAMERAS[2]) for one in (scene, state.scene)]
    holes = [int((image.seen & (image.coverage < 0.5)).sum()) for image in images]
    assert holes[1] < 0.5 * holes[0]
