"""Axes that point the wrong way are detected, whatever the format."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from glassplat.captures.axes import evidence_of_masks, evidence_of_points, flip_axes
from glassplat.captures.dataset import load_dataset
from glassplat.captures.view import View
from glassplat.errors import InputError

LENS = {"fl_x": 30.0, "fl_y": 30.0, "w": 32, "h": 24}


def annotated_views(capture, label: int = 1) -> list[View]:
    """The ring's views, each with a box of pixels around the image centre, where the origin is visible."""
    capture.write_colmap()
    views = load_dataset(capture.root).train
    labels = torch.zeros(24, 32, dtype=torch.uint8)
    labels[8:16, 12:20] = label
    return [View.in_memory(v.name, v.camera, photo=v.photo, pane_labels=labels) for v in views]


def test_points_determine_the_viewing_direction_of_the_cameras(capture) -> None:
    cameras = [view.camera for view in annotated_views(capture)]
    points = torch.from_numpy(capture.points).float()
    right = evidence_of_points(cameras, points)
    wrong = evidence_of_points([flip_axes(camera) for camera in cameras], points)
    assert (right.as_read, right.flipped) == (1.0, 0.0)
    assert (wrong.as_read, wrong.flipped) == (0.0, 1.0)
    assert wrong.contradicts and not right.contradicts
    many = points[:1].expand(2**24 + 4, 3)  # The last index is not a float32.
    assert evidence_of_points(cameras[:1], many) == evidence_of_points(cameras[:1], points[:1])


def test_masks_determine_the_viewing_direction_of_the_cameras(capture) -> None:
    views = annotated_views(capture)
    right = evidence_of_masks(views)
    assert right is not None and (right.as_read, right.flipped) == (1.0, 0.0)
    wrong = evidence_of_masks([replace(view, camera=flip_axes(view.camera)) for view in views])
    assert wrong is not None and (wrong.as_read, wrong.flipped) == (0.0, 1.0) and wrong.contradicts


def test_two_masks_or_parallel_rays_are_no_evidence(capture) -> None:
    views = annotated_views(capture)
    assert evidence_of_masks(views[:2]) is None
    assert evidence_of_masks([views[0]] * 5) is None
    assert evidence_of_masks([]) is None


def test_flipping_twice_is_the_identity(capture) -> None:
    camera = annotated_views(capture)[0].camera
    assert torch.equal(flip_axes(flip_axes(camera)).cam_from_world, camera.cam_from_world)


def test_transforms_in_opencv_axes_are_refused_by_points(capture) -> None:
    capture.write_images()
    frames = capture.frames()
    for frame in frames:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) * [1, -1, -1, 1]).tolist()
    capture.write_transforms({**LENS, "frames": frames})
    assert not load_dataset(capture.root).measured_points
    capture.reconstruction().export_PLY(capture.root / "points3d.ply")
    with pytest.raises(InputError, match=r"look away from the scene: 0% of the points .*turn the y and z axes"):
        load_dataset(capture.root)


def test_transforms_in_opencv_axes_are_refused_by_masks(capture) -> None:
    capture.write_images()
    frames = capture.frames()
    for frame in frames:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) * [1, -1, -1, 1]).tolist()
    capture.write_transforms({**LENS, "frames": frames})
    labels = np.zeros((24, 32), dtype=np.uint8)
    labels[8:16, 12:20] = 1
    for name in capture.names[1:6]:
        capture.write_mask(f"panes/{name}", labels)
    with pytest.raises(InputError, match="look away from the scene: 0% of the masks"):
        load_dataset(capture.root)
