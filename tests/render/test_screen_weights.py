"""Weights of views in densification: a reflection or transmission counts by the share of light that a pane leaves."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from glassplat.render.frame import ScreenPass
from glassplat.render.planar import Planar
from glassplat.scene.camera import Camera
from glassplat.scene.scene import Scene
from tests.render.tiny_scene import camera_at, pane, showcase

CAMERA = camera_at(0.0, 0.0, -0.2)


def primary_and_mirrored(scene: Scene, camera: Camera) -> tuple[ScreenPass, ScreenPass]:
    screen = Planar(blend="srgb")(scene, camera, with_records=True).screen
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


@pytest.mark.parametrize("half", [50.0, 0.6])
def test_a_mirror_image_counts_by_the_root_of_its_share_of_the_panes(half: float) -> None:
    scene = replace(showcase(), planes=pane(2.0, half, base_reflectance=1 - 1e-9))
    layers = Planar(blend="srgb")(scene, CAMERA).layers
    direct, mirrored = primary_and_mirrored(scene, CAMERA)
    share = float(layers["mask"][layers["pane"] >= 0].mean())
    assert float(mirrored.weight) == pytest.approx(share**0.5, rel=1e-6)
    columns, rows = direct.means2d[0].floor().long().unbind(-1)
    inside = (columns >= 0) & (columns < CAMERA.width) & (rows >= 0) & (rows < CAMERA.height)
    hidden = inside & (direct.radii[0] > 0).all(dim=-1)
    assert int(hidden.sum()) > 3
    covered = (layers["mask"] * (layers["pane"] >= 0))[rows[hidden], columns[hidden]]
    torch.testing.assert_close(torch.as_tensor(direct.weight)[0, hidden], 1 - covered)


def test_without_absgrad_there_is_no_record() -> None:
    assert Planar()(showcase(), CAMERA).screen == ()
