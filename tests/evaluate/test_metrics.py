import math

import numpy as np
import pytest
import torch

from glassplat.evaluate.metrics import correct_colors, psnr, quantize, reflection_gain, ssim

GENERATOR = torch.Generator().manual_seed(0)
IMAGE = torch.rand(20, 30, 3, generator=GENERATOR)
OTHER = (IMAGE + 0.1 * torch.randn(20, 30, 3, generator=GENERATOR)).clamp(0, 1)


def test_psnr_is_that_of_the_stored_images() -> None:
    a, b = (np.round(image.numpy() * 255) for image in (IMAGE, OTHER))
    expected = 20 * math.log10(255) - 10 * math.log10(np.mean((a - b) ** 2))
    assert psnr(IMAGE, OTHER) == pytest.approx(expected, abs=1e-4)


def test_psnr_of_a_known_difference() -> None:
    dark = torch.zeros(4, 4, 3, dtype=torch.uint8)
    assert psnr(dark, dark + 1) == pytest.approx(48.1308, abs=1e-4)
    assert psnr(dark, dark + 255) == 0.0


def test_equal_images_have_no_error() -> None:
    assert psnr(IMAGE, IMAGE.clone()) == math.inf
    assert ssim(IMAGE, IMAGE.clone()) == pytest.approx(1.0, abs=1e-6)


def test_values_outside_the_range_are_stored_clamped() -> None:
    assert quantize(torch.tensor([-1.0, 0.4999 / 255, 0.5001 / 255, 2.0])).tolist() == [0, 0, 1, 255]


def test_only_the_region_counts() -> None:
    region = torch.zeros(20, 30, dtype=torch.bool)
    region[3:9, 4:17] = True
    broken_outside = torch.where(region[..., None], OTHER, torch.zeros(3))
    assert psnr(IMAGE, broken_outside, region) == psnr(IMAGE, OTHER, region)
    assert psnr(IMAGE, OTHER, region) == pytest.approx(psnr(IMAGE[3:9, 4:17], OTHER[3:9, 4:17]))


def test_a_worse_image_scores_lower() -> None:
    worse = (OTHER + 0.1).clamp(0, 1)
    assert psnr(worse, IMAGE) < psnr(OTHER, IMAGE)
    assert ssim(worse, IMAGE) < ssim(OTHER, IMAGE) < 1


def test_ssim_is_that_of_3dgs_with_zeros_around_the_images() -> None:
    profile = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    profile /= profile.sum()

    def blurred(pixels: np.ndarray) -> np.ndarray:
        padded = np.pad(pixels, ((5, 5), (5, 5), (0, 0)))
        rows = sum(w * padded[i : i + pixels.shape[0]] for i, w in enumerate(profile))
        return sum(w * rows[:, i : i + pixels.shape[1]] for i, w in enumerate(profile))

    x, y = (quantize(image).double().numpy() / 255 for image in (IMAGE, OTHER))
    a, b = blurred(x), blurred(y)
    covariance, variances = blurred(x * y) - a * b, blurred(x * x + y * y) - a * a - b * b
    similarity = (2 * a * b + 1e-4) * (2 * covariance + 9e-4) / ((a * a + b * b + 1e-4) * (variances + 9e-4))
    assert ssim(IMAGE, OTHER) == pytest.approx(similarity.mean(), abs=1e-5)


def test_gain_recovers_the_factor() -> None:
    targets = [IMAGE.reshape(-1, 3), OTHER.reshape(-1, 3)[:50]]
    assert reflection_gain([0.4 * target for target in targets], targets) == pytest.approx(2.5)


def test_gain_is_the_least_squares_one() -> None:
    image, target = IMAGE.reshape(-1, 3), OTHER.reshape(-1, 3)
    gain = reflection_gain([image], [target])
    errors = [((g * image - target) ** 2).sum().item() for g in (gain - 0.01, gain, gain + 0.01)]
    assert errors[1] < min(errors[0], errors[2])


def test_overexposed_lamps_do_not_bias_the_reflection_gain() -> None:
    light = 0.5 * IMAGE.reshape(-1, 3)
    light[:7] = 20.0
    assert reflection_gain([light], [light.clamp(0, 1)]) == pytest.approx(1.0)


def test_gain_of_what_is_all_white_is_large_enough() -> None:
    images = torch.tensor([0.5, 0.4, 0.3, 0.6, 0.9])[:, None].expand(5, 3)
    gain = reflection_gain([images], [torch.ones(5, 3)])
    assert float((gain * images).clamp(max=1).min()) > 0.9


def test_gain_of_nothing_is_one() -> None:
    assert reflection_gain([], []) == 1.0
    assert reflection_gain([torch.zeros(5, 3)], [torch.ones(5, 3)]) == 1.0


def test_bad_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="one shape"):
        psnr(IMAGE, OTHER[1:])
    with pytest.raises(ValueError, match="boolean region"):
        psnr(IMAGE, OTHER, torch.ones(20, 30))
    with pytest.raises(ValueError, match="no pixels to compare"):
        psnr(IMAGE, OTHER, torch.zeros(20, 30, dtype=torch.bool))
    with pytest.raises(ValueError, match="non-finite"):
        quantize(torch.tensor([math.nan]))
    with pytest.raises(TypeError, match=r"got torch\.int64"):
        quantize(torch.tensor([1]))


def test_an_exposure_correction_matches_the_photograph() -> None:
    image = torch.rand(12, 20, 3, generator=torch.Generator().manual_seed(4)) * 0.5 + 0.2
    photo = image @ torch.tensor([[1.2, 0.0, 0.1], [0.0, 0.9, 0.0], [0.05, 0.0, 1.0]]) + 0.02
    assert psnr(image, photo) < 30 < 45 < psnr(correct_colors(image, photo), photo)
    assert psnr(correct_colors(image, photo, slice(0, 10)), photo) > 45


def test_a_correction_from_one_colour_stays_finite() -> None:
    grey = torch.full((4, 4, 3), 0.5)
    corrected = correct_colors(grey, grey + 0.1)
    assert bool(torch.isfinite(corrected).all())
    assert psnr(corrected, grey + 0.1) > 40
