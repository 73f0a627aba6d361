"""Descriptors of a mirrored photograph follow from those of the photograph."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image, ImageFilter

from glassplat.data.colmap_library import quiet_pycolmap
from glassplat.suggest.features import features_of, mirrored
from glassplat.suggest.matching import nearest_pairs


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    """[H, W] blobs of many sizes."""
    quiet_pycolmap()
    rng = np.random.default_rng(0)
    noise = [Image.fromarray(rng.integers(0, 256, (12 * k, 16 * k), dtype=np.uint8)).resize((320, 240)) for k in (1, 3)]
    mixed = Image.blend(*noise, 0.4).filter(ImageFilter.GaussianBlur(1.5))
    return np.asarray(mixed)


def test_mirrored_descriptors_are_those_of_the_mirrored_picture(picture: np.ndarray) -> None:
    itself, flipped = features_of(picture), features_of(np.ascontiguousarray(picture[:, ::-1]))
    places = flipped.pixels * (-1, 1) + (picture.shape[1], 0)
    away = np.linalg.norm(places[:, None] - itself.pixels, axis=2)
    alike = mirrored(itself.descriptors) @ flipped.descriptors.T
    twins = [alike[near, number].max() for number, near in enumerate(away < 0.5) if near.any()]
    assert len(twins) > 0.9 * len(flipped) > 50
    assert np.median(twins) > 0.99
    plain = (itself.descriptors @ flipped.descriptors.T)[away.argmin(axis=1), np.arange(len(flipped))]
    assert np.median(plain) < 0.9, "without mirroring they differ"


def test_mirroring_twice_is_the_identity() -> None:
    some = np.random.default_rng(1).random((7, 128), dtype=np.float32)
    assert (mirrored(mirrored(some)) == some).all()


def test_pixels_are_those_of_the_full_size(picture: np.ndarray) -> None:
    assert np.allclose(features_of(picture, 2.0).pixels, 2 * features_of(picture).pixels)


def test_an_empty_picture_has_no_features() -> None:
    quiet_pycolmap()
    nothing = features_of(np.full((60, 80), 128, dtype=np.uint8))
    assert len(nothing) == 0
    assert nearest_pairs(nothing.descriptors, nothing.descriptors).shape == (0, 2)
