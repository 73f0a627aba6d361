"""`gradient_conflict` against its twin."""

from __future__ import annotations

from collections.abc import Callable

import numba
import pytest
import torch
from torch import Tensor

from glassplat.kernels.gradient_conflict import gradient_conflict, sobel
from glassplat.kernels.gradient_conflict import gradient_conflict_in_torch as twin


def pictures(height: int, width: int, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
    """Two images, partly flat, and a hit mask."""
    generator = torch.Generator().manual_seed(3)
    first, second = (torch.rand(height, width, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    first[:, : width // 3] = 0.5
    hit = (torch.rand(height, width, generator=generator, dtype=torch.float64) > 0.3).double()
    return first.to(dtype), second.to(dtype), hit.to(dtype)


def with_gradient(function: Callable[..., Tensor], images: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    transmission = images[0].detach().requires_grad_()
    value = function(transmission, *images[1:])
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
def test_kernel_matches_its_twin(dtype: torch.dtype, tolerance: float, size: tuple[int, int]) -> None:
    images = pictures(*size, dtype)
    value, gradient = with_gradient(gradient_conflict, images)
    expected, expected_gradient = with_gradient(twin, images)
    torch.testing.assert_close(value, expected, rtol=tolerance, atol=tolerance)
    assert float((gradient - expected_gradient).norm()) <= tolerance * max(float(expected_gradient.norm()), 1e-3)


def test_gradient_matches_finite_differences() -> None:
    transmission, reflection, hit = pictures(6, 7, torch.float64)
    transmission = (transmission + 0.01 * torch.randn(6, 7, 3, generator=torch.Generator().manual_seed(1))).double()
    transmission.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: gradient_conflict(x, reflection, hit), transmission, eps=1e-7, atol=1e-7)


def test_the_number_of_threads_changes_no_bit() -> None:
    images = pictures(80, 60, torch.float32)
    both = with_gradient(gradient_conflict, images)
    numba.set_num_threads(1)
    one = with_gradient(gradient_conflict, images)
    assert torch.equal(both[0], one[0]) and torch.equal(both[1], one[1])


def test_images_without_inner_pixels_are_refused() -> None:
    with pytest.raises(ValueError, match="expected at least 3 x 3"):
        gradient_conflict(torch.zeros(2, 5, 3), torch.zeros(2, 5, 3), torch.zeros(2, 5))
