"""Edits of panes, checked by their effect on the image and the plane."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from glassplat.render.planar import Planar
from glassplat.scene.camera import rotation_from_quat
from glassplat.scene.panes import Planes
from glassplat.scene.scene import (
    PaneMove,
    Scene,
    as_mirrors,
    glass_of_pane,
    move_panes,
    shift_pane,
    tilt_pane,
    with_pane,
    with_reflectance,
    without_glass,
)
from tests.render.tiny_scene import (
    camera_at,
    concatenated,
    in_single_precision,
    joined,
    pane,
    random_gaussians,
    showcase,
)

CAMERA = camera_at(0.0, 0.0, -0.2)
SMALL_PANE = pane(2.0, half=0.8)


def assert_same(first: Scene, second: Scene) -> None:
    for name, tensor in first.parameters().items():
        assert torch.equal(tensor, second.parameters()[name]), name
    assert torch.equal(first.planes.tangents, second.planes.tangents)


def two_panes() -> Scene:
    """Adds a second pane, labelled 7, with its own glass, far to the side."""
    scene = showcase()
    other = replace(SMALL_PANE, centers=SMALL_PANE.centers + torch.tensor([20.0, 0, 0]), labels=(7,))
    glass = concatenated(scene.glass, random_gaussians(5, (20.0, 0.0, 2.0), seed=9, glass=True))
    return replace(scene, glass=glass, planes=joined(SMALL_PANE, other))


def test_removing_the_glass_gives_the_transmission() -> None:
    scene = showcase()
    frame, bare = Planar()(scene, CAMERA), Planar()(without_glass(scene), CAMERA)
    assert float(frame.layers["strength"].max()) > 0.1
    assert torch.equal(bare.rgb, frame.layers["transmission"])
    assert float(bare.layers["strength"].max()) == float(bare.layers["mask"].max()) == 0


def test_a_mirror_hides_what_is_behind_it() -> None:
    scene = as_mirrors(showcase(), [1])
    assert scene.planes.mirrors == (1,)
    assert scene.planes.base_reflectances.tolist() == [1.0]
    assert as_mirrors(in_single_precision(showcase()), [1]).planes.base_reflectances.tolist() == [1.0]
    frame = Planar(blend="srgb")(scene, CAMERA)
    share = frame.layers["mask"][..., None]
    torch.testing.assert_close(frame.layers["strength"], frame.layers["mask"])
    expected = share * frame.layers["reflection"] + (1 - share) * frame.layers["transmission"]
    torch.testing.assert_close(frame.rgb, expected)


@pytest.mark.parametrize("reflectance", [0.0, 0.25, 1.0])
def test_the_reflectance_is_set_as_requested(reflectance: float) -> None:
    edited = with_reflectance(two_panes(), 7, reflectance)
    assert edited.planes.base_reflectances.tolist() == pytest.approx([0.3, reflectance], abs=1e-12)
    assert bool(torch.isfinite(edited.planes.logit_reflectances).all())


def test_a_mirror_with_a_lower_reflectance_becomes_glass() -> None:
    mirrors = as_mirrors(two_panes(), [1, 7])
    edited = with_reflectance(mirrors, 7, 0.25)
    logits = edited.planes.logit_reflectances.clone().requires_grad_()
    edited.planes.with_tensors({"logit_reflectances": logits}).base_reflectances.sum().backward()
    assert edited.planes.mirrors == (1,)
    assert logits.grad is not None and float(logits.grad[1]) == pytest.approx(0.25 * 0.75)
    assert with_reflectance(mirrors, 7, 1.0).planes.mirrors == (1, 7)


@pytest.mark.parametrize("label", [2, 3])
def test_another_pane_has_the_precision_of_the_scene(label: int) -> None:
    before = showcase() if label == 2 else without_glass(showcase())
    scene = with_pane(before, Planes.rectangle((0, 0, 1), (0, 0, -1), (0.5, 0.5), label=label))
    assert {tensor.dtype for tensor in scene.tensors().values()} == {torch.float64}
    assert float(Planar()(scene, CAMERA).layers["mask"].max()) > 0.9


def test_no_motion_changes_no_bit() -> None:
    scene = showcase()
    assert_same(tilt_pane(scene, 1, 0.0, 0.0), scene)
    assert_same(shift_pane(scene, 1, 0.0), scene)
    assert_same(move_panes(scene, [PaneMove(1, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))]), scene)
    assert torch.equal(Planar()(tilt_pane(scene, 1, 0, 0), CAMERA).rgb, Planar()(scene, CAMERA).rgb)


def test_a_quarter_turn_about_a_side_turns_the_normal_into_the_other_side() -> None:
    scene = showcase()
    (tangent,), (bitangent,) = scene.planes.axes()
    (normal,) = scene.planes.normals
    about_tangent, about_bitangent = tilt_pane(scene, 1, 90.0, 0.0).planes, tilt_pane(scene, 1, 0.0, 90.0).planes
    torch.testing.assert_close(about_tangent.normals[0], -bitangent)
    torch.testing.assert_close(about_tangent.axes()[0][0], tangent)
    torch.testing.assert_close(about_bitangent.normals[0], tangent)
    torch.testing.assert_close(about_bitangent.axes()[0][0], -normal)
    torch.testing.assert_close(about_tangent.centers, scene.planes.centers)


def test_a_turn_and_a_step_are_a_tilt_and_a_shift() -> None:
    scene = two_panes()
    half = math.radians(30.0) / 2
    tangent, normal = scene.planes.axes()[0][1], scene.planes.normals[1]
    turn = (2 * math.cos(half), *(2 * math.sin(half) * tangent).tolist())
    expected = tilt_pane(shift_pane(scene, 7, 0.5), 7, 30.0, 0.0)
    edited = move_panes(scene, [PaneMove(7, turn, (0.5 * normal).tolist())])
    for name, tensor in edited.parameters().items():
        torch.testing.assert_close(tensor, expected.parameters()[name])
    assert torch.equal(edited.glass.means[:12], scene.glass.means[:12])


def test_the_round_trip_is_the_identity() -> None:
    scene = showcase()
    back = shift_pane(shift_pane(tilt_pane(tilt_pane(scene, 1, 12.0, -5.0), 1, -12.0, 5.0), 1, 0.3), 1, -0.3)
    torch.testing.assert_close(back.planes.raw_normals, scene.planes.raw_normals)
    torch.testing.assert_close(back.glass.means, scene.glass.means)
    before, after = Planar()(scene, CAMERA), Planar()(back, CAMERA)
    torch.testing.assert_close(after.rgb, before.rgb, rtol=1e-6, atol=1e-8)


def test_a_shift_goes_along_the_normal_in_world_units() -> None:
    scene = showcase()
    step = shift_pane(scene, 1, 0.25).planes.centers - scene.planes.centers
    torch.testing.assert_close(step, 0.25 * scene.planes.normals)


@pytest.mark.parametrize("move", [lambda s: tilt_pane(s, 7, 30.0, 0.0), lambda s: shift_pane(s, 7, 0.5)])
def test_a_pane_moves_with_its_own_glass_and_no_other(move: Callable[[Scene], Scene]) -> None:
    scene = two_panes()
    own = glass_of_pane(scene, 1)
    assert own.tolist() == [False] * 12 + [True] * 5
    edited = move(scene)
    assert torch.equal(edited.glass.means[~own], scene.glass.means[~own])
    assert torch.equal(edited.planes.raw_normals[0], scene.planes.raw_normals[0])
    assert not torch.equal(edited.glass.means[own], scene.glass.means[own])

    assert torch.equal(edited.glass.quats[~own], scene.glass.quats[~own])

    def in_pane(glass_of: Scene) -> tuple[torch.Tensor, torch.Tensor]:
        """Positions and axes of the pane's glass in the pane's frame."""
        frame = torch.stack([*(axis[1] for axis in glass_of.planes.axes()), glass_of.planes.normals[1]])
        places = (glass_of.glass.means[own] - glass_of.planes.centers[1]) @ frame.T
        return places, frame @ rotation_from_quat(glass_of.glass.quats[own])

    torch.testing.assert_close(in_pane(edited), in_pane(scene))


def test_panes_that_change_places_take_their_own_glass_along() -> None:
    """Even where one pane passes through the other, whose glass is then nearer to it."""
    scene = two_panes()
    own = glass_of_pane(scene, 1)
    (first, second), turn = scene.planes.centers, (1.0, 0.0, 0.0, 0.0)
    step = (second - first).tolist()
    moves = [PaneMove(scene.planes.labels[0], turn, step), PaneMove(7, turn, [-along for along in step])]
    edited = move_panes(scene, moves)
    torch.testing.assert_close(edited.planes.centers, scene.planes.centers.flip(0))
    moved = torch.where(own[:, None], first - second, second - first)
    torch.testing.assert_close(edited.glass.means, scene.glass.means + moved)


def test_edits_do_not_change_the_original_scene() -> None:
    scene, untouched = showcase(), showcase()
    for edit in (lambda: as_mirrors(scene, [1]), lambda: tilt_pane(scene, 1, 5, 5), lambda: shift_pane(scene, 1, 1.0)):
        edit()
        assert_same(scene, untouched)


@pytest.mark.parametrize(
    "edit",
    [
        lambda s: as_mirrors(s, [3]),
        lambda s: with_reflectance(s, 3, 0.5),
        lambda s: tilt_pane(s, 3, 1.0, 0.0),
        lambda s: shift_pane(s, 3, 1.0),
        lambda s: move_panes(s, [PaneMove(3, (1, 0, 0, 0), (0, 0, 1))]),
    ],
)
def test_an_unknown_label_lists_those_there_are(edit: Callable[[Scene], Scene]) -> None:
    with pytest.raises(ValueError, match="no pane 3; the panes are 1, 7"):
        edit(two_panes())
    with pytest.raises(ValueError, match="no pane 3; it has no panes"):
        edit(replace(showcase(), planes=Planes.empty()))


@pytest.mark.parametrize("reflectance", [-0.1, 1.5, float("nan")])
def test_an_impossible_reflectance_is_refused(reflectance: float) -> None:
    with pytest.raises(ValueError, match=r"expected a number in \[0, 1\]"):
        with_reflectance(showcase(), 1, reflectance)


def test_an_infinite_motion_is_refused() -> None:
    with pytest.raises(ValueError, match="expected finite numbers"):
        shift_pane(showcase(), 1, float("inf"))
    with pytest.raises(ValueError, match="expected finite numbers"):
        tilt_pane(showcase(), 1, float("nan"), 0.0)
    with pytest.raises(ValueError, match="expected finite numbers"):
        move_panes(showcase(), [PaneMove(1, (1, 0, 0, 0), (0, float("nan"), 0))])
    with pytest.raises(ValueError, match="quaternion of no length"):
        move_panes(showcase(), [PaneMove(1, (0, 0, 0, 0), (0, 0, 0))])


def test_a_label_names_one_pane() -> None:
    twice = Planes.rectangle((0.0, 0.0, 2.0), (0.0, 0.0, -1.0), (0.5, 0.5))
    with pytest.raises(ValueError, match=r"labels \(1, 1\); expected another one for each plane"):
        twice.concat(twice)


def test_a_rectangle_has_the_reflectance_that_it_is_given() -> None:
    given = [Planes.rectangle((0, 0, 2), (0, 0, -1), (1, 1), **r) for r in ({}, {"base_reflectance": 0.08})]
    assert [float(plane.base_reflectances) for plane in given] == pytest.approx([0.5, 0.08])
    with pytest.raises(ValueError, match=r"an R0 of 1\.0; expected a number between 0 and 1"):
        Planes.rectangle((0, 0, 2), (0, 0, -1), (1, 1), base_reflectance=1.0)


def test_a_number_is_read_from_a_tensor_once() -> None:
    focal = torch.tensor(50.0)
    camera = replace(CAMERA, fx=focal, fy=focal)
    focal += 30
    assert camera.intrinsics[0] == 50 and replace(CAMERA, fx=focal).intrinsics[0] == 80


@pytest.mark.parametrize("name", ["planes", "reflection"])
def test_only_sets_of_gaussians_are_replaced_by_gaussians(name: str) -> None:
    with pytest.raises(ValueError, match=f"unknown set of Gaussians '{name}'; expected one of .*'primary'"):
        showcase().with_gaussians(name, showcase().glass)


@pytest.mark.parametrize("extent", [0.0, -1.0, float("nan"), float("inf")])
def test_an_extent_is_a_length(extent: float) -> None:
    with pytest.raises(ValueError, match=f"the extent is {extent}; expected the radius of the capture"):
        replace(two_panes(), extent=extent)
