"""Counts of the benchmark of kernels."""

from __future__ import annotations

import torch

from benchmarks.kernels import evaluated_pixels
from glassplat.kernels.composite.cpu_tile import LANES
from glassplat.kernels.records import Splats
from glassplat.kernels.tiles import bin_tiles


def test_a_splat_within_a_block_is_evaluated_in_all_of_its_pixels() -> None:
    means = torch.tensor([[[1.5, 1.5], [9.5, 6.5], [21.5, 2.5]]])
    conics, ones = torch.tensor([100.0, 0.0, 100.0]).repeat(1, 3, 1), torch.ones(1, 3)
    splats = Splats(means, conics, ones, ones, ones[..., None].repeat(1, 1, 2))
    assert evaluated_pixels(splats, torch.ones(1, 3, 3), bin_tiles(splats, 30, 16)) == 3 * LANES
