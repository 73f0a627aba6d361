"""Panes and curved mirrors in one scene: each pixel is shaded by what it meets."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from glassplat.render.choices import Blend
from glassplat.render.curved import before, curved_contributions, mirrored_cameras
from glassplat.render.mirror_images import half_spaces_of
from glassplat.render.planar import Planar
from glassplat.render.traced import Traced, mirrored_contributions
from glassplat.scene.environment import Environment
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.plane import Planes
from glassplat.scene.pose import mirror_matrices
from glassplat.scene.scene import Scene
from tests.render.tiny_scene import camera_at, pane, random_gaussians, showcase, shown_panes

CAMERA = camera_at(0.0, 0.0, -0.2)
CURVED = Planar(curved=Traced())


def glossy(strength: float | None = 0.4) -> Scene:
    """The showcase, in which all things on both sides of the pane mirror what is around; float64."""
    scene = showcase()
    logits = torch.full((len(scene.primary),), -200.0 if strength is None else strength).double()
    if strength is not None:
        logits = torch.logit(logits)
    primary = replace(scene.primary, channels={**scene.primary.channels, "logit_strength": logits})
    around = replace(random_gaussians(20, (0.5, -0.3, 1.0), seed=7), channels={})
    around = around.with_tensors({"means": 3 * around.means, "log_scales": around.log_scales + 1.5})
    environment = Environment.random(4, generator=torch.Generator().manual_seed(3))
    environment = replace(environment, raw=2 * environment.raw.double())
    return replace(scene, primary=primary, surroundings=around, environment=environment)


def test_where_nothing_has_a_strength_it_is_planar() -> None:
    scene = glossy(None)
    found, expected = CURVED(scene, CAMERA), Planar()(scene, CAMERA)
    torch.testing.assert_close(found.rgb, expected.rgb)
    for name, layer in expected.layers.items():
        torch.testing.assert_close(found.layers[name], layer)
    assert {"base", "normal", "curved_strength", "curved_reflection"} == set(found.layers) - set(expected.layers)
    assert float(expected.layers["reflection"].max()) > 0.1


def test_where_there_are_no_panes_it_is_traced() -> None:
    scene = replace(glossy(), planes=Planes.empty())
    found, expected = CURVED(scene, CAMERA), Traced()(scene, CAMERA)
    torch.testing.assert_close(found.rgb, expected.rgb)
    renamed = {"strength": "curved_strength", "reflection": "curved_reflection"}
    for name, layer in expected.layers.items():
        torch.testing.assert_close(found.layers[renamed.get(name, name)], layer)
    assert int(found.layers["strength"].count_nonzero()) == 0
    assert float((found.rgb - found.layers["base"]).abs().max()) > 0.05


def without_intensity(scene: Scene) -> Scene:
    """The scene with reflections as bright as what they mirror."""
    return scene.with_parameters({"primary.log_intensity": torch.zeros_like(scene.primary.means[:, 0])})


def test_a_pane_shows_what_the_mirrored_camera_sees_of_curved_mirrors() -> None:
    scene = without_intensity(glossy())
    found = CURVED(scene, CAMERA)
    # What the pane mirrors is on the camera's side of it.
    normal, center = scene.planes.normals[0], scene.planes.centers[0]
    room = (scene.primary.means - center) @ normal > 0
    assert bool(room.any()) and not bool(room.all())
    before = replace(scene, primary=scene.primary.select(room), planes=Planes.empty())
    (mirrored,) = mirrored_cameras(CAMERA, scene.planes)
    expected = Traced()(before, mirrored)
    visible = (found.layers["mask"] > 0) & shown_panes(scene.planes, CAMERA)[0]
    assert float(expected.layers["strength"][visible].max()) > 0.1
    torch.testing.assert_close(found.layers["reflection"][visible], expected.rgb[visible], atol=1e-6, rtol=1e-5)
    matte = Planar()(scene, CAMERA).layers["reflection"]
    assert float((found.layers["reflection"] - matte)[visible].abs().max()) > 0.05


def test_the_transmission_is_the_traced_image_of_what_is_behind() -> None:
    scene = glossy()
    found = CURVED(scene, CAMERA)
    expected = Traced()(replace(scene, planes=Planes.empty()), CAMERA)
    torch.testing.assert_close(found.layers["transmission"], expected.rgb)
    torch.testing.assert_close(found.layers["without_panes"], expected.rgb)


@pytest.mark.parametrize("blend", ["srgb", "linear"])
def test_mirroring_scene_and_camera_about_another_plane_mirrors_nothing_but_the_image(blend: Blend) -> None:
    """The mirrored camera of a mirrored camera is the camera: rays keep their handedness through both."""
    scene = glossy()
    other = pane(5.0)
    mirror = mirror_matrices(other.centers, other.normals)[0]
    twice = replace(CAMERA, cam_from_world=CAMERA.cam_from_world @ mirror @ mirror)
    renderer = replace(CURVED, blend=blend)
    torch.testing.assert_close(renderer(scene, twice).rgb, renderer(scene, CAMERA).rgb)


def test_moving_everything_together_changes_nothing() -> None:
    shift = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    scene = glossy()
    moved = {f"{part}.means": g.means + shift for part, g in scene.gaussian_sets().items()}
    moved["planes.centers"] = scene.planes.centers + shift
    image = CURVED(scene.with_parameters(moved), camera_at(1.0, -2.0, 0.3)).rgb
    torch.testing.assert_close(image, CURVED(scene, CAMERA).rgb)


def small_scene() -> Scene:
    """Few enough Gaussians for finite differences, smooth enough for the cut-offs not to matter."""
    scene = glossy()
    rows = torch.arange(0, len(scene.primary), 4)
    primary = scene.primary.select(rows)
    large = primary.with_tensors(
        {"log_scales": primary.log_scales + 1.2, "logit_opacities": primary.logit_opacities + 2}
    )
    around = scene.surroundings.select(torch.arange(0, 20, 3))
    return replace(scene, primary=large, surroundings=around)


NAMES = (
    "primary.sh",
    "primary.logit_strength",
    "primary.log_intensity",
    "surroundings.sh",
    "surroundings.logit_opacities",
    "environment.raw",
    "planes.logit_reflectances",
)


def test_gradients_are_those_of_finite_differences() -> None:
    scene, camera = small_scene(), camera_at(0.0, 0.0, -0.2, width=10, height=8)
    camera = replace(camera, fx=8.0, fy=8.0)
    leaves = [scene.parameters()[name].clone().requires_grad_() for name in NAMES]

    def image(*tensors: torch.Tensor) -> torch.Tensor:
        return CURVED(scene.with_parameters(dict(zip(NAMES, tensors, strict=True))), camera).rgb

    assert torch.autograd.gradcheck(image, leaves, eps=1e-6, atol=2e-5, fast_mode=True)


def test_rays_of_a_pane_move_its_plane_and_what_it_mirrors() -> None:
    scene = small_scene()
    names = ("primary.means", "primary.quats", "planes.centers", "planes.raw_normals", "surroundings.means")
    leaves = [scene.parameters()[name].clone().requires_grad_() for name in names]
    layer = CURVED(scene.with_parameters(dict(zip(names, leaves, strict=True))), CAMERA).layers["reflection"]
    for name, gradient in zip(names, torch.autograd.grad(layer.sum(), leaves), strict=True):
        assert float(gradient.abs().max()) > 0, name
        assert bool(gradient.isfinite().all()), name


def test_a_probed_frame_tells_of_both_passes_and_of_what_rays_met() -> None:
    scene = glossy()
    frame = CURVED(scene, CAMERA, probed=True)
    assert [record.part for record in frame.screen] == ["primary", "glass", "primary"]
    (record,) = frame.space
    assert record.part == "surroundings" and float(record.distances.min()) > 0
    assert CURVED(scene, CAMERA).space == ()
    assert torch.equal(frame.rgb, CURVED(scene, CAMERA).rgb)


def test_the_photographer_stands_among_what_panes_mirror() -> None:
    from tests.render.test_photographer import body

    scene = replace(glossy(), photographer=body(), up=(0.0, -1.0, 0.0))
    beside = replace(CURVED, photographer="beside")(scene, CAMERA)
    present = replace(CURVED, photographer="present")(scene, CAMERA)
    torch.testing.assert_close(beside.layers["photographed"], present.rgb)
    assert float((beside.layers["photographed"] - beside.rgb).abs().max()) > 0.01


def test_the_layer_of_the_surroundings_comes_when_asked_for() -> None:
    scene = glossy()
    asked = Planar(curved=Traced(surroundings=True))(scene, CAMERA).layers["surroundings"]
    torch.testing.assert_close(asked, Traced(surroundings=True)(scene, CAMERA).layers["surroundings"])
    assert "surroundings" not in CURVED(scene, CAMERA).layers


BARE = {"surroundings": Gaussians.empty(), "environment": Environment.empty()}


@pytest.mark.parametrize("scene", [replace(glossy(), **BARE), showcase()], ids=["nothing to mirror", "no strengths"])
def test_before_curved_mirrors_are_looked_for_things_are_matte(scene: Scene) -> None:
    CURVED.check(scene)
    frame, expected = CURVED(scene, CAMERA), Planar()(scene, CAMERA)
    assert torch.equal(frame.rgb, expected.rgb)
    assert torch.equal(frame.layers["base"], expected.layers["without_panes"])
    begun = CURVED(glossy(), CAMERA).layers.keys() | {"surroundings"}
    assert frame.layers.keys() == begun
    for name in begun:
        assert frame.layers[name].shape[:2] == (CAMERA.height, CAMERA.width)


def test_surroundings_count_by_what_is_seen_of_them_directly_or_in_a_pane() -> None:
    scene = glossy()
    direct = mirrored_contributions(scene, CAMERA)
    found = curved_contributions(scene, CAMERA)
    assert bool((found >= direct).all()) and bool((found > direct + 0.1).any())
    (mirrored,) = mirrored_cameras(CAMERA, scene.planes)
    (half,) = half_spaces_of(scene.planes, CAMERA)
    room = replace(scene, primary=before(scene.primary, half), planes=Planes.empty())
    # The pane fills the view.
    assert bool(shown_panes(scene.planes, CAMERA)[0].all())
    torch.testing.assert_close(found, torch.maximum(direct, mirrored_contributions(room, mirrored)))
