"""Captures of transparent panes in the layout of RTR: a COLMAP model and label masks of a few photographs."""

from __future__ import annotations

import numpy as np
import pytest

from glassplat.captures.dataset import load_dataset


def label_mask() -> np.ndarray:
    """Two panes side by side."""
    labels = np.zeros((24, 32), dtype=np.uint8)
    labels[6:18, 4:14], labels[6:18, 18:28] = 1, 2
    return labels


@pytest.mark.parametrize("binary", [True, False])
def test_panes_are_labelled_in_the_annotated_photographs_only(capture, binary: bool) -> None:
    capture.names = [f"IMG_{index:04d}.jpg" for index in range(10)]
    capture.write_colmap(binary=binary)
    annotated = ("IMG_0001", "IMG_0004", "IMG_0006")
    for stem in annotated:
        capture.write_mask(f"panes/{stem}.png", label_mask())
    data = load_dataset(capture.root)
    assert data.pane_labels == (1, 2)
    assert data.measured_points
    assert data.split == "every 8th image by name"
    for view in data.train:
        assert view.is_annotated == (view.name.removesuffix(".jpg") in annotated)
        if view.is_annotated:
            np.testing.assert_array_equal(view.pane_labels.numpy(), label_mask())


def test_masks_next_to_a_transforms_file_are_read_the_same(capture) -> None:
    capture.write_images()
    capture.write_transforms({"fl_x": 30.0, "w": 32, "h": 24, "frames": capture.frames()})
    capture.write_mask("panes/0003.png", label_mask())
    data = load_dataset(capture.root)
    assert [view.name for view in data.train if view.is_annotated] == ["0003.png"]
    assert data.pane_labels == (1, 2)
