"""Photographs reduced to the pixel grid of their camera."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from glassplat.captures.cameras import area_resize

PIXELS = np.random.default_rng(0).integers(0, 256, (60, 48, 3), dtype=np.uint8)


@pytest.mark.parametrize("factor", [1, 2, 3, 12])
def test_a_pixel_is_the_mean_of_those_that_it_replaces(factor: int) -> None:
    reduced = area_resize(PIXELS, 48 // factor, 60 // factor)
    means = PIXELS.reshape(60 // factor, factor, 48 // factor, factor, 3).mean(axis=(1, 3))
    assert reduced.dtype == np.uint8
    np.testing.assert_allclose(reduced, means, atol=0.5 + 1e-4)


def test_reduction_of_a_large_photograph_takes_little_more_memory_than_the_photograph() -> None:
    pixels = np.zeros((4000, 4000, 3), dtype=np.uint8)
    tracemalloc.start()
    area_resize(pixels, 1000, 1000)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 2 * pixels.nbytes  # One channel as floats takes 1.3 times as much; all three would take 4.
