"""One pane in one annotated view: mask clean-up, edge, distances and candidates."""

import numpy as np
import pytest
import torch

from glassplat.panes.masks import pane_view, pane_views, plane_candidates
from glassplat.scene.camera import Camera

WIDTH, HEIGHT = 80, 60


def camera_at(x: float) -> Camera:
    """A camera at (x, 0, 0) that looks along +z."""
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[0, 3] = -x
    return Camera(matrix, 60.0, 60.0, 40.0, 30.0, WIDTH, HEIGHT)


def labels_with(top: int, bottom: int, left: int, right: int, label: int = 1) -> torch.Tensor:
    labels = torch.zeros(HEIGHT, WIDTH, dtype=torch.uint8)
    labels[top:bottom, left:right] = label
    return labels


def test_edge_runs_between_pixels_and_not_along_the_image_border() -> None:
    view = pane_view(camera_at(0), labels_with(0, 40, 20, WIDTH), 1)
    assert set(view.edge[:, 0][view.edge[:, 1] < 39.9]) == {20.0}
    assert set(view.edge[:, 1][view.edge[:, 0] > 20.1]) == {40.0}
    assert len(view.edge) == 40 + 60


def test_signed_distance_is_zero_on_the_edge_and_exact_next_to_it() -> None:
    view = pane_view(camera_at(0), labels_with(10, 50, 20, 60), 1)
    pixels = np.array([[20.0, 30.0], [23.0, 30.0], [15.5, 30.0], [40.0, 50.0], [40.0, 52.25]])
    assert view.edge_distances(pixels) == pytest.approx([0, 3, -4.5, 0, -2.25])


def test_lines_of_another_label_are_not_a_pane() -> None:
    labels = labels_with(10, 50, 20, 60, label=2)
    labels[10:50, 19] = 1
    assert pane_views([(camera_at(0), labels)], 1) == []
    labels[52:58, 4:30] = 1
    mask = pane_view(camera_at(0), labels, 1).mask
    assert mask[55, 10]
    assert not mask[:, 19][:50].any()
    assert pane_view(camera_at(0), labels, 2).mask.sum() == 40 * 40


def test_rays_through_pixels_project_back_onto_them() -> None:
    view = pane_view(camera_at(1.5), labels_with(10, 50, 20, 60), 1)
    pixels = view.pixel_grid(100)
    landed, held = view.project(view.center + 2.5 * view.directions(pixels))
    assert held.all()
    assert landed == pytest.approx(pixels)
    _, held = view.project(view.center - view.directions(pixels))
    assert not held.any()


def test_candidates_stay_on_the_edge_in_most_views() -> None:
    # A pane at z = 2 from x = -0.5 to 0.5: its edges project to 60 / 2 * (-0.5 - x) + 40 in the view from x.
    annotations = [(camera_at(x), labels_with(15, 45, int(25 - 30 * x), int(55 - 30 * x))) for x in (-0.4, 0.0, 0.4)]
    on_frame, behind_frame, middle = [-0.5, 0.1, 2.0], [-1.0, 0.1, 4.0], [0.0, 0.0, 2.0]
    points = np.array([on_frame, behind_frame, middle])
    views = pane_views(annotations, 1)
    assert plane_candidates(points, views, band=0.02).tolist() == [True, False, False]
    assert plane_candidates(points, [views[1]], band=0.02).tolist() == [True, True, False]


def test_many_annotations_are_thinned_to_views_far_apart() -> None:
    annotations = [(camera_at(0.1 * i), labels_with(10, 50, 20, 60)) for i in range(21)]
    views = pane_views(annotations, 1, most_views=3)
    assert sorted(view.center[0] for view in views) == pytest.approx([0.0, 1.0, 2.0])


def test_a_mask_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match=r"mask of shape \(60, 40\) belongs to a camera of 60 x 80"):
        pane_view(camera_at(0), torch.ones(60, 40), 1)
