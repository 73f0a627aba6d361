"""Removing a reflection from a photograph, and turning a pane into a mirror."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from glassplat.kernels.maths.images import linear_from_srgb, srgb_from_linear
from glassplat.options import Blend
from glassplat.render.frame import Frame
from glassplat.render.planar import Planar, as_mirror_image, dereflected_photo
from glassplat.scene.corrections import Exposures
from glassplat.scene.scene import as_mirrors
from tests.render.tiny_scene import camera_at, in_single_precision, pane, showcase

SIZE = (24, 32)
BLENDS: tuple[Blend, ...] = ("srgb", "linear")


def uint8(image: torch.Tensor) -> torch.Tensor:
    return torch.round(image.clamp(0, 1) * 255).to(torch.uint8)


CLEAR = torch.ones(3)


def mixed(
    behind: torch.Tensor, mirrored: torch.Tensor, share: torch.Tensor, blend: Blend, tint: torch.Tensor = CLEAR
) -> torch.Tensor:
    if blend == "srgb":
        return (1 - share) * tint * behind + share * mirrored
    return srgb_from_linear((1 - share) * tint * linear_from_srgb(behind) + share * linear_from_srgb(mirrored))


def model(
    behind: torch.Tensor, mirrored: torch.Tensor, share: torch.Tensor, blend: Blend, tint: torch.Tensor = CLEAR
) -> Frame:
    """A rendered view [H, W, 3] of a transmission behind panes that add a share [H, W] of reflected light."""
    layers = {"without_panes": behind, "share": share} | ({} if tint is CLEAR else {"tint": tint})
    return Frame(mixed(behind, mirrored, share[..., None], blend, tint), layers)


def case(
    strength: float, blend: Blend, reflection: float = 0.3, glass: torch.Tensor = CLEAR
) -> tuple[Frame, torch.Tensor, torch.Tensor]:
    """A blurred model of a pane in the left half, a photograph, and the true transmission behind the pane."""
    truth, mirrored = 0.3 + 0.4 * torch.rand(*SIZE, 3), torch.full((*SIZE, 3), reflection)
    share = torch.where(torch.arange(SIZE[1]) < 16, strength, 0.0).expand(*SIZE)
    tint = CLEAR if glass is CLEAR else torch.where(share[..., None] > 0, glass, CLEAR)
    frame = model(truth.mean(dim=(0, 1), keepdim=True).expand(*SIZE, 3), mirrored, share, blend, tint)
    return frame, uint8(mixed(truth, mirrored, share[..., None], blend, tint)), truth


@pytest.mark.parametrize("glass", [CLEAR, torch.tensor([0.6, 0.9, 0.7])], ids=["clear", "tinted"])
@pytest.mark.parametrize("blend", BLENDS)
def test_detail_missing_from_the_scene_is_kept(blend: Blend, glass: torch.Tensor) -> None:
    frame, photo, truth = case(0.1, blend, glass=glass)
    result = dereflected_photo(frame, photo, blend).float() / 255
    torch.testing.assert_close(result, truth, rtol=0, atol=2.5 / 255)
    assert float((photo.float() / 255 - truth).abs().max()) > 4 / 255


def test_without_a_pane_the_photograph_stays_bit_for_bit() -> None:
    frame, photo, _ = case(0.1, "linear")
    result = dereflected_photo(frame, photo, "linear")
    assert result.dtype == torch.uint8
    assert torch.equal(result[:, 16:], photo[:, 16:])
    assert not torch.equal(result[:, :16], photo[:, :16])


@pytest.mark.parametrize("reflection", [0.0, 0.3], ids=["of a dark room", "of a bright one"])
def test_the_render_replaces_photographs_under_strong_reflections(reflection: float) -> None:
    frame, photo, _ = case(0.95, "linear", reflection)
    result = dereflected_photo(frame, photo, "linear")
    assert torch.equal(result[:, :12], uint8(frame.layers["without_panes"])[:, :12])


def test_the_render_replaces_photographs_clipped_by_a_reflection() -> None:
    frame, photo, _ = case(0.1, "linear", reflection=1.0)
    white = torch.full_like(photo, 255)
    result = dereflected_photo(frame, white, "linear")
    assert torch.equal(result[:, :12], uint8(frame.layers["without_panes"])[:, :12])
    assert torch.equal(result[:, 16:], white[:, 16:])


def test_a_clipped_pixel_without_visible_reflection_is_kept() -> None:
    frame, photo, _ = case(0.05, "linear", reflection=0.1)
    result = dereflected_photo(frame, torch.full_like(photo, 255), "linear")
    assert int(result.min()) == 255


def test_an_overestimated_reflection_leaves_no_black_pixels() -> None:
    frame, photo, _ = case(0.3, "linear", reflection=0.3)
    glaring = model(frame.layers["without_panes"], torch.ones(*SIZE, 3), frame.layers["share"], "linear")
    result = dereflected_photo(glaring, photo // 2, "linear")
    torch.testing.assert_close(
        result[:, :12].float(), uint8(frame.layers["without_panes"])[:, :12].float(), rtol=0, atol=12
    )


def test_dereflection_changes_smoothly_with_the_strength() -> None:
    frame, photo, _ = case(0.1, "linear")
    rising = torch.linspace(0.01, 0.99, SIZE[1]).expand(*SIZE)
    flat = torch.full_like(photo, 120)
    frame = model(frame.layers["without_panes"], torch.full((*SIZE, 3), 0.3), rising, "linear")
    result = dereflected_photo(frame, flat, "linear")
    assert int(result.int().diff(dim=1).abs().max()) < 16


def test_a_photograph_of_another_size_is_refused() -> None:
    frame, photo, _ = case(0.1, "linear")
    with pytest.raises(ValueError, match="expected one size"):
        dereflected_photo(frame, photo[1:], "linear")


@pytest.mark.parametrize("half", [50.0, 0.4])
@pytest.mark.parametrize("blend", BLENDS)
def test_the_mirror_made_of_layers_is_the_mirror_rendered(blend: Blend, half: float) -> None:
    scene, camera = in_single_precision(showcase(pane(2.0, half))), camera_at(0.0, 0.0, -0.2)
    camera = replace(camera, cam_from_world=camera.cam_from_world.float())
    renderer = Planar(blend=blend)
    rendered = renderer(as_mirrors(scene, [1]), camera).rgb
    torch.testing.assert_close(as_mirror_image(renderer(scene, camera), blend), rendered, rtol=1e-3, atol=1e-4)


DARK = Exposures(
    torch.tensor([[[-0.3, 0.0, 0.0, 0.02], [0.0, -0.2, 0.0, 0.0], [0.0, 0.0, -0.25, -0.01]]]), ("dark.png",)
)


@pytest.mark.parametrize("strength", [0.1, 0.95], ids=["photograph", "render"])
@pytest.mark.parametrize("blend", BLENDS)
def test_the_background_of_an_object_keeps_its_colour(blend: Blend, strength: float) -> None:
    """The object half covers its background, white or black, in front of which is a pane."""
    scenes, half = [], torch.full(SIZE, 0.5)
    for color in ((1.0, 1.0, 1.0), (0.0, 0.0, 0.0)):
        backdrop = 0.5 * torch.tensor(color).expand(*SIZE, 3)
        frame = model(torch.full((*SIZE, 3), 0.2) + backdrop, torch.full((*SIZE, 3), 0.3), half * 2 * strength, blend)
        frame = replace(frame, layers={**frame.layers, "alpha": half}, background=color)
        photo = uint8(frame.exposed(DARK, "dark.png"))
        scenes.append(dereflected_photo(frame, photo, blend, exposures=DARK, name="dark.png") / 255 - backdrop)
    torch.testing.assert_close(*scenes, rtol=0, atol=2.5 / 255)
    exposed = DARK.apply(torch.full((*SIZE, 3), 0.2), "dark.png") - 0.5 * DARK.values[0, :, 3]
    torch.testing.assert_close(scenes[1], exposed, rtol=0, atol=2.5 / 255)


def test_dereflected_photographs_keep_their_exposure() -> None:
    frame, photo, truth = case(0.1, "linear")
    frame = replace(frame, layers={**frame.layers, "alpha": torch.ones(*SIZE)})
    exposures, affine = DARK, DARK.values
    dark = uint8(exposures.apply(photo.float() / 255, "dark.png"))
    result = dereflected_photo(frame, dark, "linear", exposures=exposures, name="dark.png")
    expected = exposures.apply(truth, "dark.png")
    torch.testing.assert_close(result.float() / 255, expected, rtol=0, atol=4 / 255)
    assert torch.equal(result[:, 16:], dark[:, 16:])
    # A held-out photograph has the exposure of its neighbours.
    neighbours = Exposures(affine.expand(2, 3, 4), ("a.png", "c.png"))
    held_out = dereflected_photo(frame, dark, "linear", exposures=neighbours, name="b.png")
    assert torch.equal(held_out, result)
    unaware = dereflected_photo(frame, dark, "linear").float() / 255
    assert float((unaware - expected)[:, :16].abs().mean()) > 0.005


def test_the_photographer_is_removed_too() -> None:
    frame, photo, truth = case(0.1, "linear", reflection=0.6)
    room = torch.full((*SIZE, 3), 0.2)
    nobody = model(frame.layers["without_panes"], room, frame.layers["share"], "linear")
    beside = replace(nobody, layers={**nobody.layers, "photographed": frame.rgb})
    result = dereflected_photo(beside, photo, "linear").float() / 255
    torch.testing.assert_close(result, truth, rtol=0, atol=2.5 / 255)
