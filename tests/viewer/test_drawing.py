"""What the viewer draws is what the renderer draws of the edited scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from glassplat.render.planar import Planar
from glassplat.scene.plane_edits import as_mirrors, with_reflectance, without_glass
from glassplat.viewer.drawing import Wish, drawn, edited
from glassplat.viewer.server import cam_from_world
from tests.train.tiny_capture import tiny_capture, true_scene

POSE = tiny_capture().train[1].camera.cam_from_world
WISH = Wish(POSE, fov_rad=0.9, aspect=1.4)
EDITS = {
    "as it is": (WISH, true_scene()),
    "mirror": (replace(WISH, glass="mirror"), as_mirrors(true_scene(), [1])),
    "none": (replace(WISH, glass="none"), without_glass(true_scene())),
    "reflectance": (replace(WISH, reflectances=((1, 0.9),)), with_reflectance(true_scene(), 1, 0.9)),
}


@pytest.mark.parametrize(("wish", "scene"), EDITS.values(), ids=EDITS)
def test_a_wish_is_the_render_of_the_edited_scene(wish: Wish, scene: object) -> None:
    picture = drawn(true_scene(), Planar(), wish, 40)
    with torch.no_grad():
        truth = Planar()(scene, wish.camera(40)).rgb
    assert picture.shape == (40, 56, 3)
    assert torch.equal(torch.from_numpy(picture), torch.round(truth.clamp(0, 1) * 255).to(torch.uint8))


@pytest.mark.parametrize("layer", ["transmission", "reflection", "strength", "depth", "mask", "no such layer"])
def test_every_layer_is_a_picture(layer: str) -> None:
    assert drawn(true_scene(), Planar(), replace(WISH, layer=layer), 24).shape == (24, 34, 3)


def test_gain_brightens_what_is_mirrored() -> None:
    brighter = edited(true_scene(), replace(WISH, gain=2.0)).primary.channels["log_intensity"]
    torch.testing.assert_close(brighter.exp(), 2 * true_scene().primary.channels["log_intensity"].exp())


def test_the_browser_s_camera_is_ours() -> None:
    rotation, center = POSE[:3, :3].double().numpy(), tiny_capture().train[1].camera.center.double().numpy()
    x, y, z, w = Rotation.from_matrix(rotation.T).as_quat()
    torch.testing.assert_close(cam_from_world(np.array([w, x, y, z]), center), POSE, atol=1e-6, rtol=0)
