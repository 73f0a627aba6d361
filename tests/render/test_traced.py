"""Traced reflections: flat mirrors compared with mirrored cameras, gradients, and limits."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from glassplat.render.deferred import INVISIBLE, Deferred, view_directions
from glassplat.render.splat import Splat
from glassplat.render.traced import START_PER_EXTENT, Traced, mirrored_contributions, traced_surroundings
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Environment, Scene
from tests.render.tiny_scene import camera_at, random_gaussians


def mirror_wall(strength: float = 1 - 1e-9) -> Gaussians:
    """One huge, flat, opaque Gaussian in the plane z = 3, dark and reflective; float64.

    Its depth is that of its centre, and so only exact where the camera looks straight at it.
    """
    return Gaussians(
        means=torch.tensor([[0.0, 0.0, 3.0]], dtype=torch.float64),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64),
        log_scales=torch.log(torch.tensor([[50.0, 50.0, 1e-6]], dtype=torch.float64)),
        logit_opacities=torch.full((1,), 30.0, dtype=torch.float64),
        sh=torch.full((1, 1, 3), -0.5 / 0.28209479177387814, dtype=torch.float64),
        channels={"logit_strength": torch.logit(torch.tensor([strength], dtype=torch.float64))},
    )


def surroundings(count: int = 16) -> Gaussians:
    """Objects behind the camera that the wall reflects."""
    found = replace(random_gaussians(count, (0.2, 0.1, -1.5), seed=2), channels={})
    return found.with_tensors({"log_scales": found.log_scales + 1.0})


def glossy(strength: float = 0.3) -> Scene:
    """Random Gaussians in front of the camera that reflect random ones behind it; float64."""
    primary = random_gaussians(14, (0.0, 0.0, 3.0), seed=4)
    strengths = torch.full((14,), math.log(strength / (1 - strength)), dtype=torch.float64)
    return Scene(replace(primary, channels={"logit_strength": strengths}), extent=2.0, surroundings=surroundings())


def mirrored(camera: Camera) -> Camera:
    """The camera mirrored about the plane z = 3."""
    reflection = torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0], dtype=torch.float64))
    reflection[2, 3] = 6.0
    return replace(camera, cam_from_world=camera.cam_from_world @ reflection)


def test_a_flat_mirror_shows_what_the_mirrored_camera_sees() -> None:
    camera, scene = camera_at(0.1, -0.2, 0.0), Scene(mirror_wall(), extent=0.01, surroundings=surroundings())
    frame = Traced()(scene, camera)
    expected = Traced(surroundings=True)(scene, mirrored(camera)).layers["surroundings"]
    torch.testing.assert_close(frame.layers["reflection"], expected)
    assert float(expected.max()) > 0.3


@pytest.mark.parametrize("extent", [1.0, 4.0])
@pytest.mark.parametrize("share", [0.9, 1.1])
def test_a_reflected_ray_does_not_hit_its_own_surface(extent: float, share: float) -> None:
    """A white sheet in front of the mirror stands for the mirror's own copy in the surroundings."""
    distance = share * START_PER_EXTENT * extent
    shift = torch.tensor([0.0, 0.0, -distance], dtype=torch.float64)
    sheet = replace(mirror_wall(), means=mirror_wall().means + shift, sh=torch.ones(1, 1, 3).double(), channels={})
    camera = camera_at(0.0, 0.0, 0.0)
    shown = Traced()(Scene(mirror_wall(), extent, surroundings=sheet), camera).layers["reflection"]
    # At the centre, where the wall's depth is exact and rays leave it at normal incidence.
    assert bool(shown[14, 20].any()) == (share > 1)


def flattened(gaussians: Gaussians) -> Gaussians:
    return replace(gaussians, log_scales=gaussians.log_scales[:, :2].contiguous())


def test_a_mirror_of_discs_shows_what_the_mirrored_camera_sees() -> None:
    """The depth of discs is exact wherever the camera looks, not only at normal incidence."""
    around = flattened(surroundings())
    scene = Scene(flattened(mirror_wall()), extent=0.01, surroundings=around)
    for camera in (camera_at(0.1, -0.2, 0.0), turned(camera_at(0.1, -0.2, 0.0))):
        frame = Traced()(scene, camera)
        expected = Traced(surroundings=True)(scene, mirrored(camera)).layers["surroundings"]
        torch.testing.assert_close(frame.layers["reflection"], expected, atol=1e-5, rtol=0)
        assert float(expected.max()) > 0.3


def turned(camera: Camera, angle_rad: float = 0.3) -> Camera:
    """The camera rotated to the right about its own centre."""
    cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
    turn = torch.eye(4, dtype=torch.float64)
    turn[0, 0], turn[0, 2], turn[2, 0], turn[2, 2] = cosine, -sine, sine, cosine
    return replace(camera, cam_from_world=turn @ camera.cam_from_world)


def test_zero_strength_equals_the_base_bit_for_bit() -> None:
    scene = glossy()
    dull = replace(
        scene, primary=replace(scene.primary, channels={"logit_strength": torch.full((14,), -800.0).double()})
    )
    frame = Traced()(dull, camera_at(0.0, 0.0, 0.0))
    assert torch.equal(frame.rgb, frame.layers["base"])
    assert torch.equal(frame.rgb, Splat()(dull, camera_at(0.0, 0.0, 0.0)).rgb)


def test_layers_recombine() -> None:
    frame = Traced()(glossy(), camera_at(0.0, 0.0, 0.0))
    strength = frame.layers["strength"][..., None]
    found = (1 - strength) * frame.layers["base"] + strength * frame.layers["reflection"]
    torch.testing.assert_close(found, frame.rgb)
    assert float(frame.layers["reflection"].max()) > 0.05


def test_densification_receives_the_distances_of_ray_hits() -> None:
    """On a wide mirror, the mean position of reflecting pixels does not show where a single object is reflected."""
    origins = torch.tensor([[-5.0, 0, 0], [5.0, 0, 0], [5.0, 0, 1.0]], dtype=torch.float64)
    directions = torch.tensor([[0.0, 0, 1.0]] * 3, dtype=torch.float64)
    small = Gaussians(
        means=torch.tensor([[-5.0, 0.01, 2.0], [5.0, 0.0, 3.0], [0.0, 0, 4.0]], dtype=torch.float64),
        quats=torch.tensor([[1.0, 0, 0, 0]] * 3, dtype=torch.float64),
        log_scales=torch.full((3, 3), -2.0, dtype=torch.float64),
        logit_opacities=torch.zeros(3, dtype=torch.float64),
        sh=torch.zeros(3, 1, 3, dtype=torch.float64),
        channels={},
    )
    contributions = torch.zeros(3, 2, dtype=torch.float64, requires_grad=True)
    found = traced_surroundings(small, origins, directions, 0.0, contributions)
    weights, products = torch.autograd.grad(found.colors.sum(), contributions)[0].unbind(dim=1)
    torch.testing.assert_close(weights[1:], torch.tensor([1.0, 0.0], dtype=torch.float64))
    torch.testing.assert_close(products[:2] / weights[:2], torch.tensor([2.0, 2.5], dtype=torch.float64))


def test_pixels_below_the_minimum_strength_keep_their_base_colour() -> None:
    frame = Traced(least_strength=0.2)(glossy(), camera_at(0.0, 0.0, 0.0))
    faint = frame.layers["strength"] <= 0.2
    assert bool(faint.any()) and not bool(faint.all())
    assert torch.equal(frame.rgb[faint], frame.layers["base"][faint])
    assert int(frame.layers["reflection"][faint].count_nonzero()) == 0


def leaves_of(scene: Scene) -> dict[str, torch.Tensor]:
    return {name: t.clone().requires_grad_() for name, t in scene.parameters().items() if t.numel()}


@pytest.mark.parametrize("are_discs", [False, True])
def test_gradients_reach_surfaces_and_surroundings(are_discs: bool) -> None:
    scene, camera = glossy(), camera_at(0.0, 0.0, 0.0)
    if are_discs:
        scene = replace(scene, primary=flattened(scene.primary), surroundings=flattened(scene.surroundings))
    leaves = leaves_of(scene)
    frame = Traced()(scene.with_parameters(leaves), camera)
    gradients = torch.autograd.grad(frame.rgb.square().sum(), leaves.values())
    assert all(bool(g.isfinite().all()) and float(g.abs().max()) > 0 for g in gradients)
    assert ({"distortion", "median_depth"} <= frame.layers.keys()) == are_discs


def test_gradients_match_finite_differences() -> None:
    scene, camera = glossy(), camera_at(0.0, 0.0, 0.0, width=12, height=9)
    names = ("primary.quats", "primary.means", "primary.logit_strength", "surroundings.means", "surroundings.sh")
    parameters = scene.parameters()

    def image(*tensors: torch.Tensor) -> torch.Tensor:
        return Traced()(scene.with_parameters(dict(zip(names, tensors, strict=True))), camera).layers["reflection"]

    leaves = [parameters[name].clone().requires_grad_() for name in names]
    assert torch.autograd.gradcheck(image, leaves, eps=1e-7, atol=2e-4, fast_mode=True)


@pytest.mark.parametrize("part", ["surroundings", "environment"])
def test_reflections_can_be_kept_from_moving_surfaces(part: str) -> None:
    scene, camera = glossy(), camera_at(0.0, 0.0, 0.0)
    if part == "environment":
        scene = lit(replace(scene, surroundings=Gaussians.empty()))
    leaves = leaves_of(scene)
    layer = Traced(joint=False)(scene.with_parameters(leaves), camera).layers["reflection"]
    gradients = torch.autograd.grad(layer.sum(), leaves.values(), allow_unused=True)
    reached = {name for name, g in zip(leaves, gradients, strict=True) if g is not None and float(g.abs().max()) > 0}
    assert reached and all(name.startswith(f"{part}.") for name in reached)


def test_moving_scene_and_camera_together_changes_nothing() -> None:
    scene, shift = glossy(), torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    means = {f"{part}.means": g.means + shift for part, g in scene.gaussian_sets().items() if len(g)}
    moved = Traced()(scene.with_parameters(means), camera_at(1.0, -2.0, 0.5))
    torch.testing.assert_close(moved.rgb, Traced()(scene, camera_at(0.0, 0.0, 0.0)).rgb)


def test_reflected_rays_see_the_background_where_nothing_is() -> None:
    scene = Scene(mirror_wall(), extent=0.01, surroundings=surroundings())
    frame = Traced(background=(1.0, 1.0, 1.0))(scene, camera_at(0.0, 0.0, 0.0))
    away = Traced()(scene, camera_at(0.0, 0.0, 0.0)).layers["reflection"].sum(-1) == 0
    assert bool(away.any())
    assert bool((frame.layers["reflection"][away] == 1).all())


def test_a_scene_without_surroundings_is_refused() -> None:
    scene = glossy()
    with pytest.raises(ValueError, match="has no surroundings; expected one trained with `traced`"):
        Traced()(replace(scene, surroundings=Gaussians.empty()), camera_at(0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="expected logit_strength"):
        Traced()(replace(scene, primary=replace(scene.primary, channels={})), camera_at(0.0, 0.0, 0.0))


def test_directions_go_through_pixel_centres() -> None:
    camera = camera_at(0.0, 0.0, 0.0)
    assert view_directions(camera)[0, 0].tolist() == pytest.approx([(0.5 - 20.3) / 30, (0.5 - 13.8) / 31, 1.0])


def lit(scene: Scene) -> Scene:
    environment = Environment.random(4, generator=torch.Generator().manual_seed(3))
    return replace(scene, environment=replace(environment, raw=2 * environment.raw.double()))


def test_the_environment_is_behind_the_surroundings() -> None:
    scene, camera = lit(glossy()), camera_at(0.1, -0.1, 0.0)
    frame = Traced(surroundings=True)(scene, camera)
    transparent = scene.surroundings.with_tensors({"logit_opacities": torch.full((16,), -30.0, dtype=torch.float64)})
    distant = Deferred(environment=True)(scene, camera)
    without = Traced(surroundings=True)(replace(scene, surroundings=transparent), camera)
    for traced, shaded in (("reflection", "reflection"), ("surroundings", "environment")):
        # `deferred` finds no direction where coverage is close to zero.
        seen = frame.layers["alpha"] > 0.01
        torch.testing.assert_close(without.layers[traced][seen], distant.layers[shaded][seen], atol=1e-6, rtol=0)
    assert not torch.allclose(frame.layers["reflection"], distant.layers["reflection"], atol=0.05)


def test_an_environment_of_one_colour_is_a_background() -> None:
    scene, camera = glossy(), camera_at(0.1, -0.1, 0.0)
    light = (0.2, 0.7, 0.4)
    even = Environment(torch.logit(torch.tensor(light, dtype=torch.float64)).expand(6, 2, 2, 3).contiguous())
    plain = Traced(light, surroundings=True)(scene, camera)
    found = Traced(light, surroundings=True)(replace(scene, environment=even), camera)
    seen = plain.layers["alpha"] > 0.01
    torch.testing.assert_close(found.layers["surroundings"], plain.layers["surroundings"])
    torch.testing.assert_close(found.layers["reflection"][seen], plain.layers["reflection"][seen])
    torch.testing.assert_close(found.rgb, plain.rgb, atol=1e-3, rtol=0)


def test_pixels_without_a_traced_ray_reflect_the_environment() -> None:
    scene, camera = lit(glossy()), camera_at(0.0, 0.0, 0.0)
    some, every = Traced(least_strength=0.2)(scene, camera), Traced()(scene, camera)
    distant = Deferred()(scene, camera)
    faint = some.layers["strength"] <= 0.2
    seen = faint & (some.layers["strength"] > 0.01)
    assert bool(seen.any()) and not bool(faint.all())
    assert torch.equal(some.rgb[~faint], every.rgb[~faint])
    torch.testing.assert_close(some.rgb[seen], distant.rgb[seen], atol=1e-6, rtol=0)


def test_a_frame_with_records_has_distances_of_the_surroundings() -> None:
    scene, camera = glossy(), camera_at(0.0, 0.0, 0.0)
    assert Traced()(scene, camera).traced == ()
    frame = Traced()(scene, camera, with_records=True)
    (record,) = frame.traced
    weights, products = torch.autograd.grad(frame.rgb.sum(), record.contributions)[0].unbind(dim=1)
    # Objects are three units in front of the camera, and the surroundings one and a half behind it.
    expected = (scene.surroundings.means - torch.tensor([0.0, 0.0, 3.0])).norm(dim=1)
    met = weights > 0.02  # Excludes Gaussians that are only grazed at one end.
    assert int(met.sum()) > 5
    torch.testing.assert_close((products / weights)[met], expected[met], atol=0.7, rtol=0)
    assert record.part == "surroundings"


def test_contributions_of_surroundings_are_their_share_of_the_image() -> None:
    scene, camera = glossy(), camera_at(0.0, 0.0, 0.0)
    found = mirrored_contributions(scene, camera)
    white = scene.surroundings.with_tensors({"sh": torch.zeros_like(scene.surroundings.sh)})
    frame = Traced()(replace(scene, surroundings=replace(white, active_sh_degree=0)), camera)
    mirrored = frame.layers["strength"] * frame.layers["reflection"][..., 0] / 0.5
    assert float(found.sum()) == pytest.approx(float(mirrored[frame.layers["strength"] > INVISIBLE].sum()), rel=1e-6)
    assert bool((found >= 0).all()) and float(found.max()) > 0.01


def test_an_empty_view_has_no_reflection() -> None:
    scene = glossy()
    away = replace(camera_at(0.0, 0.0, 0.0), cam_from_world=torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])).double())
    for each in (scene, lit(scene)):
        frame = Traced(background=(0.2, 0.3, 0.4))(
            each, replace(away, cam_from_world=away.cam_from_world), with_records=True
        )
        assert bool(frame.rgb.isfinite().all()) and int(frame.layers["reflection"].count_nonzero()) == 0
        (met,) = torch.autograd.grad(frame.rgb.sum(), frame.traced[0].contributions)
        assert int(met.count_nonzero()) == 0
