"""The viewer draws the same images of the edited scene as the renderer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from glassplat.render.deferred import Deferred
from glassplat.render.planar import Planar
from glassplat.scene.camera import rigid_transform
from glassplat.scene.corrections import Exposures
from glassplat.scene.scene import Environment, PaneMove, Scene, as_mirrors, move_panes, with_reflectance, without_glass
from glassplat.viewer.drawing import Viewpoints, ViewRequest, draw_error_map, draw_image, edit_scene, matrix_of
from tests.training.tiny_capture import tiny_capture, true_scene

POSE = tiny_capture().train[1].camera.cam_from_world
REQUEST = ViewRequest(POSE, fov_rad=0.9, aspect=1.4)
EDITS = {
    "as it is": (REQUEST, true_scene()),
    "mirror": (replace(REQUEST, glass="mirror"), as_mirrors(true_scene(), [1])),
    "none": (replace(REQUEST, glass="none"), without_glass(true_scene())),
    "moved": (
        replace(REQUEST, moves=(PaneMove(1, (1.0, 0.0, 0.1, 0.0), (0.0, 0.2, 0.0)),)),
        move_panes(true_scene(), [PaneMove(1, (1.0, 0.0, 0.1, 0.0), (0.0, 0.2, 0.0))]),
    ),
    "reflectance": (replace(REQUEST, reflectances=((1, 0.9),)), with_reflectance(true_scene(), 1, 0.9)),
}


@pytest.mark.parametrize(("asked", "scene"), EDITS.values(), ids=EDITS)
def test_a_request_renders_the_edited_scene(asked: ViewRequest, scene: object) -> None:
    picture = draw_image(true_scene(), Planar(), asked, 40)
    with torch.no_grad():
        truth = Planar()(scene, asked.camera(40)).rgb
    assert picture.shape == (40, 56, 3)
    assert torch.equal(torch.from_numpy(picture), torch.round(truth.clamp(0, 1) * 255).to(torch.uint8))


@pytest.mark.parametrize("layer", ["transmission", "reflection", "strength", "depth", "mask", "no such layer"])
def test_every_layer_is_a_picture(layer: str) -> None:
    assert draw_image(true_scene(), Planar(), replace(REQUEST, layer=layer), 24).shape == (24, 34, 3)


def test_edits_that_are_not_requested_change_no_bit() -> None:
    for name, tensor in edit_scene(true_scene(), REQUEST).parameters().items():
        assert torch.equal(tensor, true_scene().parameters()[name]), name


def test_a_layer_that_is_drawn_on_request_is_drawn() -> None:
    primary = true_scene().primary
    scene = Scene(
        replace(primary, channels={"logit_strength": torch.zeros(len(primary))}),
        true_scene().extent,
        environment=Environment.random(8, generator=torch.Generator().manual_seed(2)),
    )
    surroundings = draw_image(scene, Deferred(), replace(REQUEST, layer="environment"), 24)
    with torch.no_grad():
        truth = Deferred(environment=True)(scene, REQUEST.camera(24)).layers["environment"]
    assert np.abs(surroundings / 255 - truth.clamp(0, 1).numpy()).max() < 0.003


def test_the_error_layer_is_black_for_an_exact_render_and_follows_edits() -> None:
    view = tiny_capture().train[1]
    wide = replace(REQUEST, aspect=3.0)
    same = draw_error_map(true_scene(), Planar(), wide, 4000, view.camera, view.photo, name=view.name)
    assert same.shape == (28, 84, 3)
    assert same[..., 0].max() <= 5 and not same[:, :22].any() and not same[:, 62:].any()
    elsewhere = draw_error_map(
        true_scene(), Planar(), replace(wide, glass="mirror"), 28, view.camera, view.photo, name=view.name
    )
    assert elsewhere[:, 22:62, 0].max() > 100
    narrow = replace(REQUEST, aspect=0.5)
    assert draw_error_map(true_scene(), Planar(), narrow, 20, view.camera, view.photo, name=view.name).shape == (
        20,
        10,
        3,
    )


def test_the_error_is_in_the_colours_of_the_photograph() -> None:
    first, view, last = tiny_capture().train[:3]
    affine = torch.cat([-0.3 * torch.eye(3), torch.zeros(3, 1)], dim=1).expand(2, 3, 4)
    scene = replace(true_scene(), exposures=Exposures(affine, (first.name, last.name)))
    dark = (0.7 * view.photo.float()).round().to(torch.uint8)
    same = draw_error_map(scene, Planar(), REQUEST, 28, view.camera, dark, name=view.name)
    assert same[..., 0].max() <= 5


def test_the_nearest_photograph_is_near_in_place_and_direction() -> None:
    cameras = [view.camera for view in tiny_capture().train]
    turned = replace(cameras[2], cam_from_world=torch.diag(torch.tensor([-1.0, 1, -1, 1])) @ cameras[2].cam_from_world)
    viewpoints = Viewpoints([*cameras, turned], extent=1.0)
    for index, camera in enumerate([*cameras, turned]):
        center, forward = camera.center.double().numpy(), camera.cam_from_world[2, :3].double().numpy()
        assert viewpoints.nearest(center + 0.05, forward) == index


def test_gain_brightens_what_is_mirrored() -> None:
    brighter = edit_scene(true_scene(), replace(REQUEST, gain=2.0)).primary.channels["log_intensity"]
    torch.testing.assert_close(brighter.exp(), 2 * true_scene().primary.channels["log_intensity"].exp())


def test_the_camera_of_the_browser_converts_exactly() -> None:
    rotation, center = POSE[:3, :3].double().numpy(), tiny_capture().train[1].camera.center.double().numpy()
    x, y, z, w = Rotation.from_matrix(rotation.T).as_quat()
    torch.testing.assert_close(rigid_transform(matrix_of(np.array([w, x, y, z])).T, center), POSE, atol=1e-6, rtol=0)
