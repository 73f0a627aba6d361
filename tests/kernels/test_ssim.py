from __future__ import annotations

import numba
import pytest
import torch
from torch import Tensor

from glassplat.kernels.reference.ssim import ssim as ssim_twin
from glassplat.kernels.reference.ssim import ssim_map as ssim_map_twin
from glassplat.kernels.ssim import ssim, ssim_map


def pictures(height: int, width: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """An image with structure at several scales, and a disturbed copy."""
    generator = torch.Generator().manual_seed(8)
    y, x = torch.arange(height)[:, None, None] / 7, torch.arange(width)[None, :, None] / 5
    waves = 0.5 + 0.4 * torch.sin(x + torch.tensor([0.0, 1.0, 2.0])) * torch.cos(y)
    noise = torch.randn(height, width, 3, generator=generator)
    return (waves + 0.1 * noise).clamp(0, 1).to(dtype), waves.to(dtype)


def with_gradient(function: object, image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Mean similarity and three times its gradient."""
    image = image.detach().requires_grad_()
    mean = function(image, target)  # type: ignore[operator]
    return mean.detach(), torch.autograd.grad(3 * mean, image)[0]


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 2e-5), (torch.float64, 1e-12)])
@pytest.mark.parametrize("size", [(1, 1), (3, 20), (40, 7), (33, 80), (70, 97)])
def test_kernel_matches_its_twin(dtype: torch.dtype, tolerance: float, size: tuple[int, int]) -> None:
    image, target = pictures(*size, dtype)
    mean, gradient = with_gradient(ssim, image, target)
    expected_mean, expected_gradient = with_gradient(ssim_twin, image, target)
    assert float(mean) == pytest.approx(float(expected_mean), abs=tolerance)
    assert float((gradient - expected_gradient).norm()) <= tolerance * float(expected_gradient.norm())
    torch.testing.assert_close(ssim_map(image, target), ssim_map_twin(image, target), atol=10 * tolerance, rtol=0)


def test_gradient_matches_finite_differences() -> None:
    image, target = pictures(5, 6, torch.float64)
    assert torch.autograd.gradcheck(lambda x: ssim(x, target), image.requires_grad_(), eps=1e-6, atol=1e-8)


def test_a_photograph_in_bytes_is_scaled() -> None:
    image, target = pictures(20, 30, torch.float32)
    photograph = (target * 255).round().to(torch.uint8)
    torch.testing.assert_close(ssim(image, photograph), ssim(image, photograph.float() / 255))
    assert float(ssim(photograph.float() / 255, photograph)) == pytest.approx(1, abs=1e-6)


def test_equal_images_are_perfectly_similar_and_nothing_pulls() -> None:
    image, _ = pictures(30, 40, torch.float64)
    mean, gradient = with_gradient(ssim, image, image)
    assert float(mean) == pytest.approx(1, abs=1e-12)
    assert float(gradient.abs().max()) < 1e-12


def test_the_number_of_threads_changes_no_bit() -> None:
    image, target = pictures(150, 100, torch.float32)
    both = with_gradient(ssim, image, target)
    numba.set_num_threads(1)
    one = with_gradient(ssim, image, target)
    assert torch.equal(both[0], one[0])
    assert torch.equal(both[1], one[1])


def test_images_need_not_be_contiguous() -> None:
    image, target = pictures(20, 20, torch.float64)
    turned = with_gradient(ssim, image.transpose(0, 1), target.transpose(0, 1))
    straight = with_gradient(ssim, image, target)
    torch.testing.assert_close(turned[0], straight[0])
    torch.testing.assert_close(turned[1].transpose(0, 1), straight[1])


def test_a_pixel_that_is_not_a_number_is_not_hidden() -> None:
    image, target = pictures(20, 20, torch.float32)
    image[10, 10, 1] = torch.nan
    assert ssim(image, target).isnan()


def test_wrong_images_are_refused() -> None:
    image = torch.rand(8, 9, 3)
    with pytest.raises(ValueError, match=r"got images \[8, 9, 3\] and \[9, 8, 3\]"):
        ssim(image, image.transpose(0, 1))
    with pytest.raises(ValueError, match=r"expected the same \[H, W, 3\] twice"):
        ssim(torch.rand(0, 9, 3), torch.rand(0, 9, 3))
    with pytest.raises(TypeError, match=r"a target of torch\.float64"):
        ssim(image, image.double())
