"""How much densification counts a view in or through a pane: as much as the pane leaves of it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from glassplat.render.frame import ScreenPass
from glassplat.render.glazing import Glazed, curves, layer_slopes
from glassplat.render.planar import Planar
from glassplat.scene.camera import Camera
from glassplat.scene.scene import Scene
from tests.render.tiny_scene import camera_at, pane, showcase

CAMERA = camera_at(0.0, 0.0, -0.2)


def grey_layers() -> Glazed:
    layers = torch.rand(3, 5, 7, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    transmission, reflection = (layer[..., None].expand(-1, -1, 3) for layer in layers[:2])
    return Glazed(transmission, transmission, reflection, 0.5 * layers[2], layers[2])


def test_slopes_are_finite_differences_of_the_image() -> None:
    result, (decode, encode), step = grey_layers(), curves("linear"), 1e-6

    def image(transmission: Tensor, reflection: Tensor) -> Tensor:
        strength = result.strength[..., None]
        return encode((1 - strength) * decode(transmission) + strength * decode(reflection))

    through, mirrored = layer_slopes(result, torch.ones(5, 7, dtype=torch.bool), "linear")
    behind, reflected = result.transmission, result.reflection
    by_behind = (image(behind + step, reflected) - image(behind - step, reflected)) / (2 * step)
    by_reflected = (image(behind, reflected + step) - image(behind, reflected - step)) / (2 * step)
    torch.testing.assert_close(through, by_behind[..., 0], rtol=1e-6, atol=0)
    torch.testing.assert_close(mirrored, by_reflected[..., 0], rtol=1e-6, atol=0)
    assert float(torch.stack([through, mirrored]).amax()) < 1


def test_slopes_in_srgb_are_the_strength_and_its_rest() -> None:
    result, where = grey_layers(), torch.rand(5, 7, generator=torch.Generator().manual_seed(2)) > 0.5
    through, mirrored = layer_slopes(result, where, "srgb")
    torch.testing.assert_close(through, torch.where(where, 1 - result.strength, 1.0))
    torch.testing.assert_close(mirrored, torch.where(where, result.strength, 0.0))


def test_a_reflection_weighs_more_the_darker_it_is_behind_the_pane() -> None:
    grey, where = torch.linspace(0.1, 0.9, 9, dtype=torch.float64)[None], torch.ones(1, 9, dtype=torch.bool)
    layers = grey[..., None].expand(-1, -1, 3)
    strength = torch.full_like(grey, 0.1)
    through, mirrored = layer_slopes(
        Glazed(layers, layers, torch.full_like(layers, 0.5), strength, strength), where, "linear"
    )
    assert bool((mirrored.diff() < 0).all())
    assert bool((through.diff() > 0).all())
    assert mirrored[0, 4] == pytest.approx(0.1)  # As bright as each other.


def primary_and_mirrored(scene: Scene, camera: Camera) -> tuple[ScreenPass, ScreenPass]:
    screen = Planar(blend="srgb")(scene, camera, probed=True).screen
    assert [(record.part, record.direct) for record in screen] == [
        ("primary", True),
        ("glass", True),
        ("primary", False),
    ]
    assert screen[1].weight == 1
    return screen[0], screen[2]


def test_only_what_is_behind_the_pane_counts_by_what_comes_through() -> None:
    scene, camera = replace(showcase(), planes=pane(2.0, base_reflectance=0.3)), camera_at(0.0, 0.0, -6.0)
    direct, _ = primary_and_mirrored(scene, camera)
    seen = (direct.radii > 0).all(dim=-1)[0]
    weight, behind = torch.as_tensor(direct.weight)[0][seen], scene.primary.means[seen, 2] > 2.5
    assert 3 < int(behind.sum()) < len(behind) - 3
    assert bool((weight[~behind] == 1).all())
    assert 0.65 < float(weight[behind].min()) < 0.9


def test_a_mirror_counts_for_what_it_shows() -> None:
    scene = replace(showcase(), planes=pane(2.0, base_reflectance=1 - 1e-9))
    layers = Planar(blend="srgb")(scene, CAMERA).layers
    direct, mirrored = primary_and_mirrored(scene, CAMERA)
    assert mirrored.weight == pytest.approx(float(layers["mask"][layers["hit"] > 0].mean()), rel=1e-6)
    columns, rows = direct.means2d[0].floor().long().unbind(-1)
    inside = (columns >= 0) & (columns < CAMERA.width) & (rows >= 0) & (rows < CAMERA.height)
    hidden = inside & (direct.radii[0] > 0).all(dim=-1)
    assert int(hidden.sum()) > 3
    covered = layers["mask"][rows[hidden], columns[hidden]]
    torch.testing.assert_close(torch.as_tensor(direct.weight)[0, hidden], 1 - covered)


def test_what_is_not_probed_has_no_record() -> None:
    assert Planar()(showcase(), CAMERA).screen == ()
