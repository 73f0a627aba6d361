"""Panes seen through one another: the optics of several panes along a ray, tested by their properties."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from glassplat.kernels.maths.images import linear_from_srgb
from glassplat.options import Blend
from glassplat.render.layers import contributions
from glassplat.render.panes import LEAST_VISIBILITY, blend_conversions, nearest_hits, panes_in_camera, seen_panes
from glassplat.render.planar import Planar
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.panes import Planes, nearest_panes
from glassplat.scene.scene import Scene
from glassplat.training.losses import gradient_conflict
from tests.render.tiny_scene import (
    CAMERA,
    assert_gradient_matches,
    camera_at,
    concatenated,
    joined,
    pane,
    random_gaussians,
    showcase,
)

WIDE = camera_at(0.0, 0.0, -0.2, width=88, height=60)
FRONT, BACK = pane(2.0, label=1), pane(4.0, label=2, base_reflectance=0.4)


def glass_at(z: float, seed: int) -> Gaussians:
    """A dozen glass Gaussians close to z."""
    glass = random_gaussians(12, (0.0, 0.0, z), seed=seed, glass=True)
    return glass.with_tensors({"means": glass.means * torch.tensor([1.0, 1.0, 0.2]) + torch.tensor([0, 0, 0.8 * z])})


def vitrine(*labels: int, front: Planes = FRONT) -> Scene:
    """`showcase` with objects between its two panes, and with the panes of the given labels and their glass."""
    between = random_gaussians(10, (0.1, -0.1, 3.0), seed=7)
    planes = {1: front, 2: BACK}
    glass = {1: glass_at(2.0, 3), 2: glass_at(4.0, 4)}
    scene = showcase(joined(*(planes[label] for label in labels)))
    return replace(
        scene,
        primary=concatenated(scene.primary, between),
        glass=concatenated(*(glass[label] for label in labels)),
    )


def panes_in_a_row(count: int) -> Scene:
    """The objects of `vitrine` with so many large panes, one behind another."""
    depths = [1.5 + 0.5 * k for k in range(count)]
    planes = joined(*(pane(depth, label=k + 1) for k, depth in enumerate(depths)))
    glass = concatenated(*(glass_at(depth, 20 + k) for k, depth in enumerate(depths)))
    return replace(vitrine(1, 2), planes=planes, glass=glass)


def light(image: Tensor) -> Tensor:
    return linear_from_srgb(image)


@pytest.mark.parametrize(
    ("half", "shift", "least"), [(50.0, 0.0, 0.03), (0.25, 0.4, 0.015)], ids=["everywhere", "on a few tiles"]
)
def test_each_pane_lays_its_reflection_over_what_is_behind_it(half: float, shift: float, least: float) -> None:
    front_pane = pane(2.0, half=half, label=1)
    front_pane = front_pane.with_tensors({"centers": front_pane.centers + torch.tensor([shift, 0.0, 0.0])})
    both, front, back = (Planar()(vitrine(*labels, front=front_pane), WIDE) for labels in ((1, 2), (1,), (2,)))
    near, far = (frame.layers["strength"][..., None] for frame in (front, back))
    expected = (1 - far) * light(back.layers["transmission"]) + far * light(back.layers["reflection"])
    expected = (1 - near) * expected + near * light(front.layers["reflection"])
    assert float((near * far).max()) > least
    two = nearest_hits(panes_in_camera(front_pane, WIDE), WIDE).pane >= 0
    torch.testing.assert_close(light(both.rgb)[two], expected[two], rtol=1e-4, atol=2e-5)


def test_the_layers_are_those_of_the_nearest_pane() -> None:
    both, front, back = (Planar()(vitrine(*labels), CAMERA) for labels in ((1, 2), (1,), (2,)))
    seen = front.layers["mask"] >= LEAST_VISIBILITY
    assert bool(seen.any()) and not bool(seen.all())
    for name in ("strength", "reflection"):
        torch.testing.assert_close(both.layers[name][seen], front.layers[name][seen])
    # Reflections of the farther pane are transmitted by the nearer one.
    torch.testing.assert_close(both.layers["transmission"][seen], back.rgb[seen])


def test_layers_skip_an_invisible_nearest_pane() -> None:
    scene = vitrine(1, 2)
    unmarked = scene.glass.channels["logit_mark"].clone()
    unmarked[:12] = -80
    invisible = replace(scene, glass=scene.glass.with_tensors({"logit_mark": unmarked}))
    both, back = (Planar()(of, CAMERA) for of in (invisible, vitrine(2)))
    torch.testing.assert_close(both.rgb, back.rgb)
    where = back.layers["strength"] > 0
    assert bool(where.any())
    for name in ("transmission", "strength", "reflection"):
        torch.testing.assert_close(both.layers[name][where], back.layers[name][where], rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("faint", [(1,), (0, 1), (0,)], ids=["the second", "the first two", "the first"])
def test_the_layers_of_three_panes_are_those_of_the_visible_ones(faint: tuple[int, ...]) -> None:
    scene = panes_in_a_row(3)
    hidden = torch.isin(nearest_panes(scene.glass.means, scene.planes), torch.tensor(faint))
    marks = torch.where(hidden, -80.0, scene.glass.channels["logit_mark"])
    rows = [k for k in range(3) if k not in faint]
    visible = replace(scene, planes=scene.planes.select(rows), glass=scene.glass.select(~hidden))
    scene = replace(scene, glass=scene.glass.with_tensors({"logit_mark": marks}))
    three, fewer = (Planar()(of, CAMERA).layers for of in (scene, visible))
    where = fewer["strength"] > 0
    assert bool(where.any())
    for name in ("transmission", "strength", "reflection"):
        torch.testing.assert_close(three[name][where], fewer[name][where], rtol=1e-6, atol=1e-7)


TINT = ((0.5, 0.9, 0.6), (0.7, 0.6, 0.9), (0.8, 0.5, 0.7))


@pytest.mark.parametrize("tint", [None, TINT], ids=["clear", "tinted"])
@pytest.mark.parametrize("blend", ["linear", "srgb"])
def test_the_layers_recombine_to_the_image(blend: Blend, tint: tuple[tuple[float, ...], ...] | None) -> None:
    scene, logarithms = panes_in_a_row(3), None if tint is None else torch.tensor(tint, dtype=torch.float64).log()
    frame = Planar(blend=blend)(replace(scene, planes=replace(scene.planes, log_transmittances=logarithms)), CAMERA)
    decode, _ = blend_conversions(blend)
    share = frame.layers["strength"][..., None]
    expected = (1 - share) * decode(frame.layers["transmission"]) + share * decode(frame.layers["reflection"])
    torch.testing.assert_close(decode(frame.rgb), expected, rtol=1e-4, atol=2e-5)


def test_all_panes_together_recombine_with_the_image_without_panes() -> None:
    both, front, back = (Planar()(vitrine(*labels), CAMERA).layers for labels in ((1, 2), (1,), (2,)))
    torch.testing.assert_close(both["without_panes"], back["transmission"])
    torch.testing.assert_close(1 - both["share"], (1 - front["strength"]) * (1 - back["strength"]))
    torch.testing.assert_close(front["share"], front["strength"])


def test_the_order_in_which_panes_are_listed_does_not_matter() -> None:
    frames = [Planar()(vitrine(*labels), CAMERA) for labels in ((1, 2), (2, 1))]
    torch.testing.assert_close(frames[0].rgb, frames[1].rgb)
    for name, layer in frames[0].layers.items():
        if name == "pane":
            continue
        torch.testing.assert_close(frames[1].layers[name], layer)


def test_the_order_of_panes_depends_on_the_side_of_the_camera() -> None:
    half_turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64))
    half_turn[2, 3] = 6.0
    other = replace(CAMERA, cam_from_world=half_turn)
    both, front, back = (Planar()(vitrine(*labels), other).layers for labels in ((1, 2), (1,), (2,)))
    assert float((front["strength"] * back["strength"]).max()) > 0.02
    seen = back["mask"] >= LEAST_VISIBILITY
    assert bool(seen.any())
    for name in ("strength", "reflection"):
        torch.testing.assert_close(both[name][seen], back[name][seen])


def test_a_mirror_behind_glass_shows_the_room(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("glassplat.render.panes.LEAST_VISIBILITY", 0.0)
    mirror = pane(4.0, label=2, base_reflectance=1 - 1e-9)
    scene = replace(vitrine(1, 2), planes=joined(FRONT, mirror))
    room = scene.primary.select(scene.primary.means[:, 2] < 1.0)
    frames = [Planar()(replace(scene, primary=primary), CAMERA) for primary in (scene.primary, room)]
    through_glass = frames[1].layers["transmission"] - frames[1].layers["without_panes"]
    assert float(through_glass.abs().max()) > 0.05
    assert float(frames[0].layers["share"].max()) > 0.5


@pytest.mark.parametrize("count", [3, 5])
def test_any_number_of_panes_may_stand_one_behind_another(count: int) -> None:
    scene = panes_in_a_row(count)
    share = Planar()(scene, CAMERA).layers["share"]
    passed = torch.ones_like(share)
    for k in range(count):
        own = scene.glass.select(nearest_panes(scene.glass.means, scene.planes) == k)
        alone = replace(scene, planes=scene.planes.select([k]), glass=own)
        passed = passed * (1 - Planar()(alone, CAMERA).layers["strength"])
    torch.testing.assert_close(1 - share, passed)


def test_panes_next_to_each_other_share_a_layer() -> None:
    left, right = (pane(2.0, half=0.4, label=label) for label in (1, 2))
    right = right.with_tensors({"centers": right.centers + torch.tensor([1.2, 0.0, 0.0])})
    seen = seen_panes(planes := joined(left, right), CAMERA, nearest_hits(panes_in_camera(planes, CAMERA), CAMERA))
    assert len(seen.order) == 1


def test_the_panes_on_a_ray_come_in_the_order_of_their_depths() -> None:
    planes = joined(*(pane(z, half=half, label=k + 1) for k, (z, half) in enumerate([(4, 3), (2, 0.6), (3, 1)])))
    seen = seen_panes(planes, CAMERA, nearest_hits(panes_in_camera(planes, CAMERA), CAMERA))
    nearness = torch.tensor([1.0, 3.0, 2.0, 0.0])
    assert len(seen.order) == 3 and bool((seen.order[2] >= 0).any())
    for before, after in pairwise(seen.order):
        there = after >= 0
        assert bool((nearness[before.long()] > nearness[after.long()])[there].all())
        assert bool((before[there] >= 0).all())


def test_panes_that_no_pixel_shows_are_left_out() -> None:
    planes = joined(pane(-3.0, label=1), pane(2.0, label=2), pane(4.0, label=3))
    seen = seen_panes(planes, CAMERA, nearest_hits(panes_in_camera(planes, CAMERA), CAMERA))
    assert seen.planes.labels == (2, 3) and seen.rows.tolist() == [1, 2]
    assert [int(pane.max()) for pane in seen.order] == [0, 1]
    assert seen.windows.tolist() == [[0.0, 0.0, 40.0, 28.0]] * 2


def test_glass_belongs_to_the_pane_it_lies_on() -> None:
    beside = FRONT.with_tensors({"centers": torch.tensor([[5.0, 0.0, 2.0]]), "half_sizes": torch.tensor([[1.0, 1.0]])})
    glass = concatenated(glass_at(2.0, 3), glass_at(4.0, 4))
    planes = joined(BACK, pane(2.0, half=3.0), replace(beside, labels=(3,)))
    assert nearest_panes(glass.means, planes).tolist() == [1] * 12 + [0] * 12


@pytest.mark.parametrize("name", ["planes.centers", "planes.logit_reflectances", "glass.logit_mark", "glass.means"])
def test_gradients_match_finite_differences(name: str) -> None:
    assert_gradient_matches(Planar(), vitrine(1, 2), name)


def test_objects_reflected_through_another_pane_count_as_visible() -> None:
    scene = vitrine(1, 2)
    both, front = (contributions(scene_of, CAMERA) for scene_of in (scene, replace(scene, planes=FRONT)))
    between = slice(30, None)
    assert float((both - front)[between].max()) > 0.5


def test_edge_conflict_ignores_the_farther_reflection(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("glassplat.render.panes.LEAST_VISIBILITY", 0.0)
    scene = vitrine(1, 2)
    frame = Planar()(scene, CAMERA)
    alone = Planar()(vitrine(1), CAMERA)
    losses = [gradient_conflict(f, None, scene) for f in (frame, alone)]  # type: ignore[arg-type]
    torch.testing.assert_close(*losses)
