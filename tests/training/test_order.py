"""Morton order: its definition, its completeness, and its robustness to values that are not finite."""

from __future__ import annotations

import pytest
import torch

from glassplat.kernels.trace.bvh import MORTON_BITS, morton_codes
from glassplat.training.densify import morton_order


def test_the_corners_of_a_cube_come_in_the_order_of_the_curve() -> None:
    corners = torch.tensor([[x, y, z] for z in (0.0, 1.0) for y in (0.0, 1.0) for x in (0.0, 1.0)])
    shuffled = torch.randperm(8, generator=torch.Generator().manual_seed(0))
    order = morton_order(corners[shuffled])
    assert torch.equal(corners[shuffled][order.source], corners)
    assert not bool(order.fresh.any())


def test_codes_interleave_the_bits_of_the_axes() -> None:
    generator = torch.Generator().manual_seed(1)
    cells = torch.randint(0, 2**MORTON_BITS, (40, 3), generator=generator)
    cells[0], cells[1] = 0, 2**MORTON_BITS - 1
    expected = [
        sum(((int(cell[axis]) >> bit) & 1) << (3 * bit + axis) for bit in range(MORTON_BITS) for axis in range(3))
        for cell in cells
    ]
    # An offset of half a cell keeps the conversion from rounding across a border.
    means = (cells.double() + torch.where((cells > 0) & (cells < 2**MORTON_BITS - 1), 0.5, 0.0)) * 0.25 - 7
    assert morton_codes(means).tolist() == expected


def test_neighbours_in_memory_are_near_each_other() -> None:
    means = torch.rand(4000, 3, generator=torch.Generator().manual_seed(2))
    ordered = means[morton_order(means).source]
    steps, random_steps = (m.diff(dim=0).norm(dim=1).mean() for m in (ordered, means))
    assert float(steps) < 0.2 * float(random_steps)


@pytest.mark.parametrize("poison", [float("nan"), float("inf"), -float("inf")])
def test_values_that_are_not_finite_are_sorted_last(poison: float) -> None:
    means = torch.rand(50, 3, generator=torch.Generator().manual_seed(3))
    expected = morton_order(means).source
    beside = morton_order(torch.cat([torch.full((1, 3), poison), means])).source
    assert torch.equal(beside[:-1] - 1, expected)
    assert int(beside[-1]) == 0


@pytest.mark.parametrize("means", [torch.zeros(0, 3), torch.ones(5, 3), torch.full((4, 3), float("nan"))])
def test_without_extent_the_order_stays(means: torch.Tensor) -> None:
    assert morton_order(means).source.tolist() == list(range(len(means)))
