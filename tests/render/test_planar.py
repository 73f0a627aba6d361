"""The optics of `planar`, tested by their properties."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest
import torch

from glassplat.kernels import Fresnel
from glassplat.kernels.maths.images import linear_from_srgb
from glassplat.kernels.maths.pane import LAWS
from glassplat.kernels.panes.reference import REFLECTANCE
from glassplat.options import Blend
from glassplat.render.deferred import view_directions
from glassplat.render.planar import Planar, detach_gaussians
from glassplat.render.splat import Splat
from glassplat.scene.camera import Camera, mirror_matrices, rotation_from_quat
from glassplat.scene.panes import Planes
from glassplat.scene.scene import Scene
from tests.render.tiny_scene import (
    CAMERA,
    assert_gradient_matches,
    camera_at,
    in_single_precision,
    joined,
    pane,
    quat_product,
    showcase,
    shown_panes,
)


def test_layers_recombine_to_the_image_in_srgb() -> None:
    layers = (frame := Planar(blend="srgb")(showcase(), CAMERA)).layers
    strength = layers["strength"][..., None]
    recombined = (1 - strength) * layers["transmission"] + strength * layers["reflection"]
    assert float(strength.max()) > 0.1
    torch.testing.assert_close(recombined, frame.rgb)


def test_layers_recombine_to_the_image_in_linear_radiance() -> None:
    layers = (frame := Planar(blend="linear")(showcase(), CAMERA)).layers
    strength = layers["strength"][..., None]
    behind, reflected = (linear_from_srgb(layers[name]) for name in ("transmission", "reflection"))
    expected = (1 - strength) * behind + strength * reflected
    assert float(strength.max()) > 0.1
    torch.testing.assert_close(linear_from_srgb(frame.rgb), expected, rtol=1e-4, atol=2e-5)


def test_the_reflection_shows_the_room_and_not_what_is_behind_the_pane() -> None:
    scene = showcase()
    reflection = Planar()(scene, CAMERA).layers["reflection"]
    assert float(reflection.abs().max()) > 0.1
    room = replace(scene, primary=scene.primary.select(scene.primary.means[:, 2] < 1.5))
    without_case = Planar()(room, CAMERA)
    visible = (without_case.layers["mask"] > 0) & (Planar()(scene, CAMERA).layers["mask"] > 0)
    torch.testing.assert_close(without_case.layers["reflection"][visible], reflection[visible])


@pytest.mark.parametrize("fresnel", ["pane", "none"])
@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0)])
def test_zero_reflectance_is_splat_bit_for_bit(fresnel: Fresnel, background: tuple[float, float, float]) -> None:
    scene = in_single_precision(showcase())
    scene = replace(scene, planes=scene.planes.with_tensors({"logit_reflectances": torch.tensor([-200.0])}))
    camera = replace(CAMERA, cam_from_world=CAMERA.cam_from_world.float())
    planar, splat = Planar(background, fresnel=fresnel)(scene, camera), Splat(background)(scene, camera)
    assert torch.equal(planar.rgb, splat.rgb)
    assert torch.equal(planar.layers["depth"], splat.layers["depth"])


def test_a_scene_without_planes_is_splat_bit_for_bit() -> None:
    scene = replace(showcase(), planes=Planes.empty())
    assert torch.equal(Planar()(scene, CAMERA).rgb, Splat()(scene, CAMERA).rgb)


def test_a_perfect_mirror_hides_what_is_behind_it() -> None:
    scene = replace(showcase(), planes=pane(2.0, base_reflectance=1 - 1e-12))
    frame = Planar(blend="srgb")(scene, CAMERA)
    expected = frame.layers["mask"][..., None] * frame.layers["reflection"]
    expected = expected + (1 - frame.layers["mask"][..., None]) * frame.layers["transmission"]
    torch.testing.assert_close(frame.rgb, expected)


BACKGROUNDS = [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.2, 0.5, 0.0)]


@pytest.mark.parametrize("blend", ["srgb", "linear"])
@pytest.mark.parametrize("background", BACKGROUNDS)
def test_a_pane_with_nothing_before_it_reflects_the_background(
    background: tuple[float, float, float], blend: Blend
) -> None:
    scene = showcase()
    bare = replace(scene, primary=scene.primary.select(scene.primary.means[:, 2] > 1.5))
    layers = Planar(background, blend=blend)(bare, CAMERA).layers
    reflection = layers["reflection"][layers["strength"] > 0]
    assert len(reflection) > 100
    torch.testing.assert_close(reflection, torch.tensor(background).double().expand_as(reflection), atol=1e-6, rtol=0)


@pytest.mark.parametrize("blend", ["srgb", "linear"])
@pytest.mark.parametrize("background", BACKGROUNDS)
def test_gaussians_of_intensity_one_are_mirrored_unchanged(
    background: tuple[float, float, float], blend: Blend
) -> None:
    scene = showcase()
    plain = scene.primary.with_tensors({"log_intensity": torch.zeros_like(scene.primary.means[:, 0])})
    scene = replace(scene, primary=plain)
    with_intensity = Planar(background, blend=blend)(scene, CAMERA).rgb
    without = Planar(background, blend=blend, intensity=False)(scene, CAMERA).rgb
    torch.testing.assert_close(with_intensity, without, atol=1e-5, rtol=1e-5)


def test_channels_required_by_panes_are_named_if_missing() -> None:
    scene = showcase()
    for part, channel in (("primary", "log_intensity"), ("glass", "logit_mark")):
        lacking = scene.with_gaussians(part, replace(scene.gaussian_sets()[part], channels={}))
        with pytest.raises(ValueError, match=rf"the channels \[\]; expected {channel}"):
            Planar()(lacking, CAMERA)


def test_moving_everything_together_changes_nothing() -> None:
    scene = showcase()
    turn = rotation_from_quat(torch.tensor([0.8, 0.3, -0.4, 0.2], dtype=torch.float64))
    shift = torch.tensor([3.0, -2.0, 5.0], dtype=torch.float64)
    before, after = Planar()(lambertian(scene), CAMERA), Planar()(*moved(lambertian(scene), CAMERA, turn, shift))
    for name, layer in before.layers.items():
        torch.testing.assert_close(after.layers[name], layer, rtol=1e-7, atol=1e-9)
    torch.testing.assert_close(after.rgb, before.rgb, rtol=1e-7, atol=1e-9)


def lambertian(scene: Scene) -> Scene:
    """The scene without view dependence, so that no SH need rotating."""
    return replace(scene, primary=replace(scene.primary, active_sh_degree=0))


def moved(scene: Scene, camera: Camera, turn: torch.Tensor, shift: torch.Tensor) -> tuple[Scene, Camera]:
    """Scene, planes and camera after a common rigid motion."""
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3], motion[:3, 3] = turn, shift
    quat = torch.tensor([0.8, 0.3, -0.4, 0.2], dtype=torch.float64)
    quat = quat / quat.norm()
    parts = {}
    for name, part in scene.gaussian_sets().items():
        parts[name] = part.with_tensors({"means": part.means @ turn.T + shift, "quats": quat_product(quat, part.quats)})
    planes = scene.planes.with_tensors(
        {
            "centers": scene.planes.centers @ turn.T + shift,
            "raw_normals": scene.planes.raw_normals @ turn.T,
            "tangents": scene.planes.tangents @ turn.T,
        }
    )
    pose = camera.cam_from_world @ torch.linalg.inv(motion)
    return replace(scene, **parts, planes=planes), replace(camera, cam_from_world=pose)


def test_mirroring_twice_is_the_identity() -> None:
    matrix = mirror_matrices(showcase().planes.centers, showcase().planes.normals)[0]
    torch.testing.assert_close(matrix @ matrix, torch.eye(4, dtype=torch.float64))


def test_the_sign_of_the_normal_does_not_matter() -> None:
    scene = showcase()
    flipped = replace(scene, planes=scene.planes.with_tensors({"raw_normals": -scene.planes.raw_normals}))
    torch.testing.assert_close(Planar()(flipped, CAMERA).rgb, Planar()(scene, CAMERA).rgb)


def test_gaussians_seen_directly_or_mirrored_are_visible() -> None:
    scene, away = showcase(), camera_at(0.0, 0.0, 10.0)
    depths = CAMERA.project(scene.primary.means)[1]
    frame, without_panes, nothing = (
        Planar()(scene, CAMERA),
        Planar()(replace(scene, planes=Planes.empty()), CAMERA),
        Planar()(scene, away),
    )
    assert frame.direct is not None and frame.mirrored is not None and frame.visible is not None
    assert torch.equal(frame.direct, depths > 0)
    assert frame.mirrored.any() and not frame.mirrored[depths > 0].any()
    assert torch.equal(frame.visible, frame.direct | frame.mirrored)
    assert without_panes.visible is not None and torch.equal(without_panes.visible, depths > 0)
    assert nothing.visible is not None and not nothing.visible.any()


def test_a_pane_reflects_for_cameras_on_either_side() -> None:
    scene = showcase()
    half_turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64))
    shift = torch.eye(4, dtype=torch.float64)
    shift[2, 3] = -6.0
    from_behind = replace(CAMERA, cam_from_world=half_turn @ shift)
    frame = Planar()(scene, from_behind)
    in_case = replace(scene, primary=scene.primary.select(scene.primary.means[:, 2] > 2.5))
    alone = Planar()(in_case, from_behind)
    both = (frame.layers["mask"] > 0) & (alone.layers["mask"] > 0)
    assert float(frame.layers["reflection"][both].abs().max()) > 0.05
    torch.testing.assert_close(alone.layers["reflection"][both], frame.layers["reflection"][both])


def test_the_nearest_pane_wins() -> None:
    planes = joined(pane(4.0, label=1), pane(2.0, half=0.5, label=2))
    hits = shown_panes(planes, CAMERA)
    assert bool(hits[0].any()) and bool(hits[1].any())
    assert not bool((hits[0] & hits[1]).any())
    alone = shown_panes(pane(2.0, half=0.5, label=2), CAMERA)
    assert torch.equal(hits[1], alone[0])
    assert bool((hits[0] | hits[1]).all())


def test_a_pane_behind_the_camera_is_not_hit() -> None:
    assert not bool(shown_panes(pane(-3.0), CAMERA).any())


@pytest.mark.parametrize("fresnel", LAWS)
def test_the_strength_of_each_pixel_is_that_of_its_angle(fresnel: Fresnel) -> None:
    scene = showcase(planes := pane(2.0, base_reflectance=0.2))
    layers = Planar(fresnel=fresnel)(scene, CAMERA).layers
    rays = torch.nn.functional.normalize(view_directions(CAMERA), dim=-1)
    cosine = (rays @ planes.normals[0]).abs()
    expected = REFLECTANCE[fresnel](planes.base_reflectances[0], cosine)
    torch.testing.assert_close(layers["strength"], layers["mask"] * expected)
    assert float(layers["mask"].max()) > 0.5


def test_two_panes_keep_their_own_reflections() -> None:
    left, right = pane(2.0, half=0.5, label=1), pane(4.0, label=2)
    both = Planar()(showcase(joined(left, right)), CAMERA).layers["reflection"]
    hits = shown_panes(joined(left, right), CAMERA)
    for k, planes in enumerate((left, right)):
        alone = Planar()(showcase(planes), CAMERA).layers["reflection"]
        torch.testing.assert_close(both[hits[k]], alone[hits[k]])


@pytest.mark.parametrize("name", ["centers", "raw_normals", "logit_reflectances"])
@pytest.mark.parametrize("fresnel", LAWS)
def test_plane_gradients_match_finite_differences_through_the_whole_renderer(name: str, fresnel: Fresnel) -> None:
    assert_gradient_matches(Planar(fresnel=fresnel), showcase(), f"planes.{name}")


def test_blocked_reflection_gradient_reaches_the_plane_and_not_the_gaussians() -> None:
    scene = showcase()
    centers = scene.planes.centers.clone().requires_grad_()
    means = scene.primary.means.clone().requires_grad_()
    trainable = scene.with_parameters({"planes.centers": centers, "primary.means": means})
    blocked = Planar(reflection_gradient="planes")(trainable, CAMERA)
    to_means, to_centers = torch.autograd.grad(blocked.layers["reflection"].sum(), [means, centers])
    assert not bool(to_means.any()) and float(to_centers.abs().sum()) > 0
    free = Planar()(trainable, CAMERA).layers["reflection"].sum()
    assert float(torch.autograd.grad(free, means)[0].abs().sum()) > 0


def test_a_mirror_keeps_its_reflectance() -> None:
    scene = showcase(joined(pane(2.0, half=0.5, label=1), pane(4.0, label=2)))
    logits = scene.planes.logit_reflectances.clone().requires_grad_()
    planes = replace(scene.planes, logit_reflectances=logits, mirrors=(2,))
    rgb = Planar()(replace(scene, planes=planes), CAMERA).rgb
    (gradient,) = torch.autograd.grad(rgb.square().sum(), logits)
    assert gradient[0] != 0 and gradient[1] == 0
    assert torch.equal(rgb, Planar()(scene, CAMERA).rgb)


def test_switches_change_what_they_name() -> None:
    scene = showcase()
    constant = Planar(fresnel="none")(scene, CAMERA).layers
    torch.testing.assert_close(constant["strength"], scene.planes.base_reflectances * constant["mask"])
    assert not torch.equal(Planar(intensity=False)(scene, CAMERA).rgb, Planar()(scene, CAMERA).rgb)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_reflections_are_the_layers_before_each_background_wherever_panes_have_moved_to(count: int) -> None:
    panes = [pane(2.0, half=0.5, label=1), pane(4.0, label=2)]
    scene = showcase(joined(*panes[:count])) if count else replace(showcase(), planes=Planes.empty())
    first = Planar().direct_pass(scene, CAMERA)
    turned = scene.planes.raw_normals + torch.tensor([0.02, 0.01, 0.0])
    there = replace(scene, planes=replace(scene.planes, raw_normals=turned))
    backgrounds = ((0.0, 0.0, 0.0), (1.0, 0.5, 0.25))
    for found, color in zip(Planar().reflections(there, CAMERA, backgrounds, first), backgrounds, strict=True):
        assert torch.equal(found, Planar(background=color)(there, CAMERA).layers["reflection"])
        assert bool(found.any()) == (count > 0)


def test_the_deviation_is_computed_on_request() -> None:
    frame = Planar(deviation=True)(showcase(), CAMERA)
    assert float(frame.layers["deviation"].sum()) > 0
    assert "deviation" not in Planar()(showcase(), CAMERA).layers


def test_detached_cuts_every_tensor_off() -> None:
    scene = showcase()
    trainable = scene.primary.with_tensors({"means": scene.primary.means.clone().requires_grad_()})
    assert not detach_gaussians(trainable).means.requires_grad


@pytest.mark.parametrize("mode", ["fresnel", "blend", "reflection_gradient", "photographer"])
def test_an_unknown_mode_is_refused(mode: str) -> None:
    with pytest.raises(ValueError, match=f"{mode} is 'Linear'; expected one of"):
        replace(Planar(), **{mode: "Linear"})  # type: ignore[arg-type]


def test_a_renderer_may_extend_planar_by_fields_of_types_of_its_own() -> None:
    @dataclass(frozen=True)
    class Extended(Planar):
        own: Own | None = None  # type: ignore[name-defined] # noqa: F821 - As if imported for type checkers only.

    assert Extended().own is None
    with pytest.raises(ValueError, match="blend is 'Linear'; expected one of"):
        Extended(blend="Linear")  # type: ignore[arg-type]
