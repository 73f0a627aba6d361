"""`gradient_conflict` against its twin."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from glassplat.kernels.panes import gradient_conflict
from glassplat.kernels.panes.reference import gradient_conflict as twin
from glassplat.kernels.panes.reference import sobel
from tests.kernels.threads import assert_threads_change_no_bit


def pictures(height: int, width: int, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
    """Two images, partly flat, and a hit mask."""
    generator = torch.Generator().manual_seed(3)
    first, second = (torch.rand(height, width, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    first[:, : width // 3] = 0.5
    hit = (torch.rand(height, width, generator=generator, dtype=torch.float64) > 0.3).double()
    return first.to(dtype), second.to(dtype), hit.to(dtype)


def with_gradient(function: Callable[..., Tensor], images: tuple[Tensor, ...], cell: int = 1) -> tuple[Tensor, Tensor]:
    transmission = images[0].detach().requires_grad_()
    value = function(transmission, *images[1:], cell=cell)
    return value.detach(), torch.autograd.grad(3 * value, transmission)[0]


def test_sobel_is_the_sobel_operator() -> None:
    image = torch.rand(8, 9, 3, generator=torch.Generator().manual_seed(0))
    kernel = torch.tensor([[-1.0, 0, 1], [-2, 0, 2], [-1, 0, 1]])
    planes = image.permute(2, 0, 1)[:, None]
    horizontal, vertical = sobel(image)
    for found, weights in ((horizontal, kernel), (vertical, kernel.T)):
        expected = torch.nn.functional.conv2d(planes, weights[None, None])[:, 0].permute(1, 2, 0)
        torch.testing.assert_close(found, expected)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
@pytest.mark.parametrize("size", [(3, 3), (3, 20), (17, 4), (40, 53)])
@pytest.mark.parametrize("cell", [1, 5])
@pytest.mark.parametrize("has_strength", [False, True])
def test_kernel_matches_the_reference(
    dtype: torch.dtype, tolerance: float, size: tuple[int, int], cell: int, has_strength: bool
) -> None:
    images = (*pictures(*size, dtype), *([torch.full(size, 0.3, dtype=dtype)] if has_strength else []))
    value, gradient = with_gradient(gradient_conflict, images, cell)
    expected, expected_gradient = with_gradient(twin, images, cell)
    torch.testing.assert_close(value, expected, rtol=tolerance, atol=tolerance)
    assert float((gradient - expected_gradient).norm()) <= tolerance * max(float(expected_gradient.norm()), 1e-3)


def test_single_pixels_are_eq_15() -> None:
    transmission, reflection, hit = pictures(9, 8, torch.float64)
    (a_x, a_y), (b_x, b_y) = sobel(transmission), sobel(reflection)
    expected = (hit[1:-1, 1:-1, None] * (a_x * b_x + a_y * b_y).abs()).mean()
    torch.testing.assert_close(gradient_conflict(transmission, reflection, hit), expected)


def test_edges_that_only_happen_to_meet_count_little_in_cells() -> None:
    """And the remainder of a reflection counts as much as pixel by pixel."""
    generator = torch.Generator().manual_seed(5)
    own, reflection = torch.rand(2, 62, 62, 3, generator=generator, dtype=torch.float64)
    hit = torch.ones(62, 62, dtype=torch.float64)
    left = 0.5 + 0.1 * reflection
    by_chance, by_pixel = (float(gradient_conflict(own, reflection, hit, cell=cell)) for cell in (10, 1))
    assert by_chance < 0.2 * by_pixel
    in_cells, by_pixel = (float(gradient_conflict(left, reflection, hit, cell=cell)) for cell in (10, 1))
    assert in_cells == pytest.approx(by_pixel)


@pytest.mark.parametrize(("held", "counted"), [(0.1, 1.0), (2.0, 1.0), (3.0, 0.5), (4.0, 0.0), (10.0, 0.0)])
def test_cells_are_weighted_by_the_reflection_that_a_pane_can_leave(held: float, counted: float) -> None:
    """At a uniform brightness, where linear light is sRGB times a factor."""
    generator = torch.Generator().manual_seed(5)
    edges = 1e-4 * torch.rand(12, 12, 3, generator=generator, dtype=torch.float64)
    hit, strength = torch.ones(12, 12, dtype=torch.float64), torch.full((12, 12), 0.07, dtype=torch.float64)
    images = 0.5 + 0.07 * held * edges, 0.5 + edges, hit
    share = gradient_conflict(*images, strength, cell=5) / gradient_conflict(*images, cell=5)
    assert float(share) == pytest.approx(counted, abs=1e-3)


def test_gradient_matches_finite_differences() -> None:
    transmission, reflection, hit = pictures(6, 7, torch.float64)
    transmission = (transmission + 0.01 * torch.randn(6, 7, 3, generator=torch.Generator().manual_seed(1))).double()
    transmission.requires_grad_()
    for cell in (1, 2):
        assert torch.autograd.gradcheck(
            lambda x, cell=cell: gradient_conflict(x, reflection, hit, cell=cell), transmission, eps=1e-7, atol=1e-7
        )


def test_the_number_of_threads_changes_no_bit() -> None:
    images = (*pictures(80, 60, torch.float32), torch.full((80, 60), 0.1))
    assert_threads_change_no_bit(lambda: with_gradient(gradient_conflict, images, 7))


def test_images_without_inner_pixels_are_refused() -> None:
    with pytest.raises(ValueError, match="expected at least 3 x 3"):
        gradient_conflict(torch.zeros(2, 5, 3), torch.zeros(2, 5, 3), torch.zeros(2, 5))


def test_cells_without_pixels_are_refused() -> None:
    with pytest.raises(ValueError, match="expected at least one pixel"):
        gradient_conflict(torch.zeros(5, 5, 3), torch.zeros(5, 5, 3), torch.zeros(5, 5), cell=0)
