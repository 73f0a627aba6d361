"""Initial surroundings: random in the box of the scene, or copied from it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from glassplat.captures.view import PointCloud
from glassplat.methods.surroundings import copied_surroundings, percentile_box, suitable_cells, surroundings_in_box
from glassplat.scene.gaussians import Gaussians
from tests.render.tiny_scene import in_single_precision, showcase


def cloud(positions: torch.Tensor) -> PointCloud:
    return PointCloud(positions, torch.zeros(len(positions), 3, dtype=torch.uint8))


def in_box(**options: int) -> Gaussians:
    box = (torch.tensor([-1.0, 0.0, 2.0]), torch.tensor([1.0, 1.0, 5.0]))
    generator = torch.Generator().manual_seed(0)
    return surroundings_in_box(
        box, opacity=0.1, sh_degree=2, generator=generator, **{"cells": 3, "per_cell": 4} | options
    )


def test_distant_outliers_do_not_enlarge_the_box() -> None:
    positions = 2 * torch.rand(2000, 3, generator=torch.Generator().manual_seed(0)) - 1
    positions[:4] *= 1e4
    middle = torch.tensor([3.0, -5.0, 0.0])
    low, high = percentile_box(cloud(positions + middle), 0.005)
    torch.testing.assert_close(torch.stack([low, high]), torch.stack([middle - 1, middle + 1]), atol=0.05, rtol=0)


def test_a_box_of_points_in_a_plane_has_a_volume() -> None:
    positions = torch.rand(100, 3)
    positions[:, 1] = 0.5
    low, high = percentile_box(cloud(positions), 0.0)
    assert float((high - low).min()) > 0


def test_every_cell_gets_as_many() -> None:
    found = in_box()
    cells = ((found.means - torch.tensor([-1.0, 0.0, 2.0])) / torch.tensor([2 / 3, 1 / 3, 1.0])).floor().long()
    assert bool(((cells >= 0) & (cells < 3)).all())
    counts = torch.bincount(cells @ torch.tensor([9, 3, 1]), minlength=27)
    assert bool((counts == 4).all()) and found.sh.shape == (108, 9, 3)


def test_their_size_is_the_distance_of_neighbours() -> None:
    found = in_box(cells=8, per_cell=6)
    distances = torch.cdist(found.means, found.means).fill_diagonal_(torch.inf).amin(dim=1)
    # Neighbours beyond the border are missing, and the density of points differs between directions.
    assert float(found.log_scales.exp().mean()) == pytest.approx(float(distances.mean()), rel=0.2)


@pytest.mark.parametrize(("pixels", "cells"), [(128 * 128, 12), (10**6, 32), (10**8, 32), (4, 2)])
def test_small_photographs_get_fewer_cells(pixels: int, cells: int) -> None:
    assert suitable_cells(pixels, 5) == cells


def test_copies_keep_as_many_harmonics_as_they_may() -> None:
    primary = in_single_precision(showcase()).primary
    chosen = torch.arange(len(primary)) >= 8
    found = copied_surroundings(primary, chosen, sh_degree=1)
    assert torch.equal(found.means, primary.means[8:]) and not found.channels
    assert torch.equal(found.sh, primary.sh[8:, :4]) and found.active_sh_degree == 1
    more = copied_surroundings(primary, chosen, sh_degree=3)
    assert torch.equal(more.sh[:, :9], primary.sh[8:]) and int(more.sh[:, 9:].count_nonzero()) == 0
    assert more.means.data_ptr() != primary.means.data_ptr()


def test_sets_are_joined_in_order() -> None:
    first, second = in_box(), in_box(cells=2)
    both = replace(first, active_sh_degree=1).concat(second)
    assert torch.equal(both.means, torch.cat([first.means, second.means])) and both.active_sh_degree == 1
