from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from glassplat.kernels.photometric import Photometric, photometric
from glassplat.kernels.photometric.cpu import COLUMNS, ROWS
from glassplat.kernels.photometric.reference import photometric as photometric_twin
from tests.kernels.threads import assert_threads_change_no_bit


def pictures(height: int, width: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """An image with structure at several scales, and a photograph of which it is a distorted copy."""
    generator = torch.Generator().manual_seed(8)
    y, x = torch.arange(height)[:, None, None] / 7, torch.arange(width)[None, :, None] / 5
    waves = 0.5 + 0.4 * torch.sin(x + torch.tensor([0.0, 1.0, 2.0])) * torch.cos(y)
    noise = torch.randn(height, width, 3, generator=generator)
    return (waves + 0.1 * noise).clamp(0, 1).to(dtype), (waves * 255).round().to(torch.uint8)


def with_gradients(
    function: Callable[[Tensor, Tensor], Photometric], image: Tensor, target: Tensor
) -> tuple[Photometric, Tensor, Tensor]:
    """The means, the gradient of L1 alone, and the gradient of a weighted sum."""
    image = image.detach().requires_grad_()
    found = function(image, target)
    (by_l1,) = torch.autograd.grad(found.l1, image, retain_graph=True)
    (by_sum,) = torch.autograd.grad(0.3 * found.l1 - 7 * found.ssim, image)
    return Photometric(found.l1.detach(), found.ssim.detach()), by_l1, by_sum


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 2e-5), (torch.float64, 1e-12)])
@pytest.mark.parametrize(
    "size", [(1, 1), (3, 20), (40, 7), (33, 80), (70, 97), (ROWS + 3, COLUMNS // 3 + 2), (2 * ROWS + 1, 172)]
)
def test_kernel_matches_the_reference(dtype: torch.dtype, tolerance: float, size: tuple[int, int]) -> None:
    image, target = pictures(*size, dtype)
    means, *gradients = with_gradients(photometric, image, target)
    expected_means, *expected_gradients = with_gradients(photometric_twin, image, target)
    assert [float(mean) for mean in means] == pytest.approx([float(mean) for mean in expected_means], abs=tolerance)
    for gradient, expected in zip(gradients, expected_gradients, strict=True):
        assert float((gradient - expected).norm()) <= tolerance * float(expected.norm())
    assert [float(mean) for mean in photometric(image, target)] == pytest.approx([float(m) for m in means], abs=1e-7)


def test_gradient_matches_finite_differences() -> None:
    image, target = pictures(5, 6, torch.float64)
    assert torch.autograd.gradcheck(lambda x: photometric(x, target), image.requires_grad_(), eps=1e-6, atol=1e-8)


def test_an_image_equal_to_the_photograph_has_no_loss_and_no_gradient() -> None:
    target = torch.arange(256, dtype=torch.uint8).reshape(16, 16, 1).expand(16, 16, 3)
    (l1, ssim), by_l1, by_sum = with_gradients(photometric, target.float() / 255, target)
    assert float(l1) == 0
    assert float(ssim) == pytest.approx(1, abs=1e-6)
    assert float(by_l1.abs().max()) == 0
    assert float(by_sum.abs().max()) < 1e-5


def test_the_number_of_threads_changes_no_bit() -> None:
    image, target = pictures(2 * ROWS + 9, 200, torch.float32)

    def everything() -> list[torch.Tensor]:
        losses, *found = with_gradients(photometric, image, target)
        return [*losses, *found]

    assert_threads_change_no_bit(everything)


def test_images_need_not_be_contiguous() -> None:
    image, target = pictures(20, 20, torch.float64)
    turned, _, turned_gradient = with_gradients(photometric, image.transpose(0, 1), target.transpose(0, 1))
    straight, _, straight_gradient = with_gradients(photometric, image, target)
    torch.testing.assert_close(turned, straight)
    torch.testing.assert_close(turned_gradient.transpose(0, 1), straight_gradient)


def test_a_pixel_that_is_not_a_number_is_not_hidden() -> None:
    image, target = pictures(20, 20, torch.float32)
    image[10, 10, 1] = torch.nan
    assert all(mean.isnan() for mean in photometric(image, target))


def test_an_infinite_pixel_spreads_only_within_the_window() -> None:
    image, target = pictures(40, 40, torch.float32)
    image[20, 20] = torch.inf
    _, _, gradient = with_gradients(photometric, image, target)
    reached = ~gradient.isfinite().all(-1)
    assert reached[10:31, 10:31].all()
    assert int(reached.sum()) == 21 * 21


def test_no_copy_of_the_photograph_is_kept() -> None:
    image, target = pictures(30, 40, torch.float32)
    found = photometric(image.requires_grad_(), target)
    kept = {tensor.data_ptr() for tensor in found.l1.grad_fn.saved_tensors}  # type: ignore[union-attr]
    assert target.data_ptr() in kept and len(kept) == 3


def test_wrong_images_are_refused() -> None:
    image = torch.rand(8, 9, 3)
    target = torch.zeros(8, 9, 3, dtype=torch.uint8)
    with pytest.raises(ValueError, match=r"got images \[8, 9, 3\] and \[9, 8, 3\]"):
        photometric(image, target.transpose(0, 1))
    with pytest.raises(ValueError, match=r"expected the same \[H, W, 3\] twice"):
        photometric(torch.rand(0, 9, 3), target[:0])
    with pytest.raises(TypeError, match=r"a target of torch\.float32; .* uint8"):
        photometric(image, image)
