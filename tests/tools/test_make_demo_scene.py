"""Shrinking a capture keeps what its pixels mean."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tools.make_demo_scene import (
    Arguments,
    linear_from_srgb,
    main,
    shrink_camera,
    shrink_mask,
    shrink_pane,
    shrink_picture,
    shrink_strength,
    srgb_from_linear,
)


def test_srgb_and_linear_are_inverses() -> None:
    values = np.linspace(0, 1, 101)
    np.testing.assert_allclose(linear_from_srgb(srgb_from_linear(values)), values, atol=1e-7)


def test_pictures_are_averaged_as_light() -> None:
    checkers = np.zeros((4, 6, 3), np.uint8)
    checkers[::2, ::2] = checkers[1::2, 1::2] = 255
    # Half of the light of white is 188 in sRGB, not 128.
    np.testing.assert_array_equal(shrink_picture(checkers, 2), np.full((2, 3, 3), 188))


def test_a_pane_covers_only_pixels_that_lie_in_it_entirely() -> None:
    labels = np.array([[1, 1, 1, 0], [1, 1, 1, 1], [2, 2, 1, 1], [2, 2, 2, 2]], np.uint8)
    np.testing.assert_array_equal(shrink_pane(labels, 2), [[1, 0], [2, 0]])


def test_masks_keep_their_labels_and_strengths_their_mean() -> None:
    labels = np.array([[0, 3], [3, 3]], np.uint8)
    assert shrink_mask(labels, 2).tolist() == [[3]]
    strength = np.array([[0, 65535], [65535, 65535]], np.uint16)
    assert shrink_strength(strength, 2).tolist() == [[49151]]


def test_a_factor_that_does_not_divide_the_image_is_refused() -> None:
    with pytest.raises(ValueError, match="5x4 cannot be shrunk by 2"):
        shrink_picture(np.zeros((4, 5, 3), np.uint8), 2)


def test_the_camera_covers_the_same_view() -> None:
    assert shrink_camera("1 PINHOLE 400 300 332.8 331.6 200.0 150.0", 2) == (
        "1 PINHOLE 200 150 166.400000 165.800000 100.000000 75.000000"
    )
    with pytest.raises(ValueError, match="OPENCV; expected PINHOLE"):
        shrink_camera("1 OPENCV 400 300 332.8 331.6 200.0 150.0 0 0 0 0", 2)


def test_an_existing_directory_is_left_alone(tmp_path: Path) -> None:
    precious = tmp_path / "precious.png"
    Image.new("RGB", (2, 2)).save(precious)
    with pytest.raises(FileExistsError, match="remove it first"):
        main(Arguments(source=tmp_path, output=tmp_path))
    assert precious.is_file()
