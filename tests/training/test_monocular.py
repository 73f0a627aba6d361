"""Estimated normals as a loss term."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from glassplat.render.frame import Frame
from glassplat.scene.corrections import moved_camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene
from glassplat.training.losses import MonocularNormals
from tests.captures.test_normal_maps import SIZE, all_along, view_in, write

SCENE = Scene(Gaussians.empty(1), 1.0)


def frame_of(normal: torch.Tensor, alpha: float = 1.0) -> Frame:
    normals = normal.expand(SIZE, SIZE, 3)
    return Frame(torch.zeros(SIZE, SIZE, 3), {"normal": normals, "alpha": torch.full((SIZE, SIZE), alpha)})


def test_right_normals_of_any_length_cost_nothing_and_opposite_ones_two(tmp_path: Path) -> None:
    write(tmp_path, "a.npy", all_along((0.0, 0.0, 1.0)))
    term, view = MonocularNormals(), view_in(tmp_path)
    for normal, expected in (((0.0, 0.0, -0.7), 0.0), ((0.0, 0.0, 1.0), 2.0), ((0.3, 0.0, 0.0), 1.0)):
        assert float(term(frame_of(torch.tensor(normal)), view, SCENE)) == pytest.approx(expected)
    assert float(term(frame_of(torch.tensor([0.0, 0.0, 1.0]), alpha=0.2), view, SCENE)) == 0


def test_the_gradient_turns_normals(tmp_path: Path) -> None:
    write(tmp_path, "a.npy", all_along((0.0, 0.0, 1.0)))
    normal = torch.tensor([0.1, 0.0, -0.7], requires_grad=True)
    (gradient,) = torch.autograd.grad(MonocularNormals()(frame_of(normal), view_in(tmp_path), SCENE), normal)
    assert float(gradient[0]) > 0


def test_ignored_pixels_count_as_right(tmp_path: Path) -> None:
    write(tmp_path, "a.npy", all_along((0.0, 0.0, 1.0)))
    ignored = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    ignored[3:7] = True
    view = replace(view_in(tmp_path), read_ignored=lambda: ignored)
    wrong = torch.where(ignored[..., None], torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.0, 0.0, -1.0]))
    assert float(MonocularNormals()(frame_of(wrong), view, SCENE)) == pytest.approx(0)


def test_the_normals_turn_with_a_camera_that_is_corrected(tmp_path: Path) -> None:
    write(tmp_path, "a.npy", all_along((0.0, 0.0, 1.0)))
    term, view, tilted = MonocularNormals(), view_in(tmp_path), torch.tensor([0.3, 0.0, -0.9])
    twist = torch.zeros(6, requires_grad=True)
    for _ in range(2):  # The second time, the file is not read again.
        moving = view.with_camera(moved_camera(view.camera, twist, 1.0))
        (gradient,) = torch.autograd.grad(term(frame_of(tilted), moving, SCENE), twist)
        assert bool(gradient.any())
    turned = view.with_camera(moved_camera(view.camera, torch.tensor([0.0, 0.3, 0.0, 0.0, 0.0, 0.0]), 1.0))
    to_camera = turned.camera.cam_from_world[2, :3]
    assert float(term(frame_of(-to_camera), turned, SCENE)) == pytest.approx(0, abs=1e-6)


def test_views_without_a_file_have_no_such_term(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    frame = frame_of(torch.tensor([0.0, 0.0, 1.0]))
    with caplog.at_level(logging.WARNING):
        assert MonocularNormals()(frame, view_in(tmp_path), SCENE) is None
        assert not caplog.text
        (tmp_path / "normals").mkdir()
        term = MonocularNormals()
        assert term(frame, view_in(tmp_path), SCENE) is term(frame, view_in(tmp_path), SCENE) is None
    assert caplog.text.count("no normals for a.jpg") == 1


def test_views_in_folders_are_warned_about_too(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Their folder of normals may be stored next to that of all photographs."""
    view = replace(view_in(tmp_path), name="left/a.jpg", image_path=tmp_path / "images" / "left" / "a.jpg")
    (tmp_path / "normals").mkdir()
    with caplog.at_level(logging.WARNING):
        assert MonocularNormals()(frame_of(torch.tensor([0.0, 0.0, 1.0])), view, SCENE) is None
    assert "no normals for left/a.jpg" in caplog.text
