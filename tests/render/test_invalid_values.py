"""Invalid parameter values: a renderer either names the parameter, or its image is finite."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from glassplat.render.planar import Planar
from tests.training.tiny_capture import tiny_capture
from tools.trial_numbers import METHODS, POISON, rendered

UNDRAWABLE = [
    ("planar", "primary.log_intensity", (math.nan, math.inf, 1e30, 100.0)),
    ("planar", "glass.logit_mark", (math.nan,)),
    ("planar", "planes.logit_reflectances", (math.nan,)),
    ("deferred", "primary.logit_strength", (math.nan,)),
    ("deferred", "environment.raw", (math.nan, math.inf, -math.inf)),
    ("traced", "primary.logit_strength", (math.nan,)),
]


@pytest.mark.parametrize(
    ("method", "name", "value"), [(m, n, value) for m, n, values in UNDRAWABLE for value in values]
)
def test_a_value_that_cannot_be_drawn_is_refused_by_its_name(method: str, name: str, value: float) -> None:
    renderer, scene = rendered(method)
    changed = scene.parameters()[name].detach().clone()
    changed.view(-1)[0] = value
    with pytest.raises(ValueError, match=name.split(".")[-1]):
        renderer(scene.with_parameters({name: changed}), tiny_capture().train[1].camera)


@pytest.mark.parametrize("method", METHODS)
def test_other_invalid_values_leave_a_finite_image(method: str) -> None:
    renderer, scene = rendered(method)
    refused = {name for other, name, _ in UNDRAWABLE if other == method}
    for name, tensor in scene.parameters().items():
        if name in refused or not tensor.numel():
            continue
        for value in POISON:
            changed = tensor.detach().clone()
            changed.view(-1)[0] = value
            frame = renderer(scene.with_parameters({name: changed}), tiny_capture().train[1].camera)
            assert bool(torch.isfinite(frame.rgb).all()), (name, value)


def test_a_value_that_becomes_invalid_later_is_refused() -> None:
    renderer, scene = rendered("planar")
    camera = tiny_capture().train[1].camera
    changed = scene.primary.channels["log_intensity"].detach().clone()
    scene = scene.with_parameters({"primary.log_intensity": changed})
    renderer(scene, camera)
    scene.primary.channels["log_intensity"].view(-1)[0] = math.inf
    with pytest.raises(ValueError, match="log_intensity"):
        renderer(scene, camera)


def test_a_tint_that_cannot_be_drawn_is_refused() -> None:
    _, scene = rendered("planar")
    tinted = replace(scene, planes=replace(scene.planes, log_transmittances=torch.full((len(scene.planes), 3), 1e30)))
    with pytest.raises(ValueError, match="log_transmittances"):
        Planar()(tinted, tiny_capture().train[1].camera)


@pytest.mark.parametrize("name", ["fx", "fy", "width", "height"])
def test_a_camera_without_a_size_or_a_focal_length_is_refused(name: str) -> None:
    for value in (0, -1, math.nan, math.inf):
        with pytest.raises(ValueError, match="expected finite numbers, sizes and focal lengths above 0"):
            replace(tiny_capture().train[1].camera, **{name: value})


def test_a_camera_needs_a_pose_and_whole_pixels() -> None:
    camera = tiny_capture().train[1].camera
    for pose in (camera.cam_from_world.numpy(), camera.cam_from_world.tolist(), camera.cam_from_world[:3]):
        with pytest.raises(ValueError, match=r"expected a tensor \[4, 4\]"):
            replace(camera, cam_from_world=pose)
    with pytest.raises(ValueError, match=r"20\.5x15 pixels; expected whole numbers"):
        camera.resize(20.5, 15)  # type: ignore[arg-type]
    halved = camera.resize(camera.width / 2, camera.height / 2)  # type: ignore[arg-type]
    assert (type(halved.width), type(halved.height)) == (int, int)


@pytest.mark.parametrize("name", ["cx", "cy"])
def test_a_principal_point_that_is_not_finite_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="expected finite numbers"):
        replace(tiny_capture().train[1].camera, **{name: math.nan})
