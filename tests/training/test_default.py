"""Adaptive density control: statistics, growth, pruning and the opacity reset."""

import math

import pytest
import torch

from glassplat.kernels.screen_statistics import Views
from glassplat.scene.gaussians import Gaussians
from glassplat.training.densify import ScreenStatistics, densify, reset_opacity
from glassplat.training.options import DefaultDensify

EXTENT = 2.0


def make_gaussians(scales: list[float], opacities: list[float] | None = None) -> Gaussians:
    """Needles of the given lengths, 50 times as long as thick."""
    count = len(scales)
    return Gaussians(
        means=torch.arange(3.0 * count).reshape(count, 3),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        log_scales=torch.tensor(scales).log()[:, None] - math.log(50) * torch.tensor([0.0, 1.0, 1.0]),
        logit_opacities=torch.logit(torch.tensor(opacities or [0.5] * count)),
        sh=torch.zeros(count, 1, 3),
    )


def seen(gradients: list[float], absgrads: list[float] | None = None) -> ScreenStatistics:
    """Statistics of one view; the absolute gradient is six times the gradient unless given."""
    count = len(gradients)
    absgrads = absgrads or [6 * gradient for gradient in gradients]
    return ScreenStatistics(*(torch.tensor(values).expand(2, -1) for values in (gradients, absgrads, [1.0] * count)))


def edited(options: DefaultDensify, gaussians: Gaussians, statistics: ScreenStatistics, **extra: bool) -> Gaussians:
    rng = torch.Generator().manual_seed(0)
    return densify(options, gaussians, {}, statistics, extent=EXTENT, generator=rng, **extra)[0]


def test_views_and_mirror_images_count_apart_and_the_larger_mean_decides() -> None:
    statistics, radii = ScreenStatistics.zeros(5), torch.full((1, 5, 2), 6.0)
    direct = ([8.0, 8.0, 0.0, 8.0, 0.0], [4.0, 4.0, 0.0, 4.0, 0.0])
    mirrored = ([2.0, 6.0, 3.0, 0.0, 2.0], [3.0, 8.0, 3.0, 0.0, 0.0], [1.0, 7.0, 3.0, 0.0, 0.0])
    for weight, gradients in (*((1.0, row) for row in direct), *((0.5, row) for row in mirrored)):
        gradient = torch.tensor(gradients)[None, :, None] * torch.tensor([0.01, 0.0])
        seen_here = radii * (gradient != 0).any(dim=-1, keepdim=True)
        statistics.add(Views(gradient, 2 * gradient, seen_here, 200, 100, weight, direct=weight == 1))
    assert statistics.view_count.tolist() == [[3.5, 3.5, 1.5, 2, 0.5], [2, 2, 0, 2, 0]]
    # Two views see the first, second and fourth directly: a mean of 6. Three mirror images of weight 0.5 show the first
    # three. They are averaged over two if there are two direct views; the single mirror image of the last, over one.
    assert statistics.mean_gradient.tolist() == pytest.approx([6, 10.5, 6, 6, 2])
    assert statistics.mean_absgrad.tolist() == pytest.approx([12, 21, 12, 12, 4])


def test_statistics_do_not_depend_on_the_resolution() -> None:
    gradient, radii = torch.rand(1, 5, 2), torch.full((1, 5, 2), 6.0)
    small, large = ScreenStatistics.zeros(5), ScreenStatistics.zeros(5)
    small.add(Views(gradient, gradient, radii, 100, 80))
    large.add(Views(gradient / 2, gradient / 2, radii * 2, 200, 160))
    assert torch.allclose(small.gradient_sum, large.gradient_sum)


def test_small_ones_are_cloned_large_ones_split_and_the_rest_kept() -> None:
    options, (small, large) = DefaultDensify(), (0.99 * 0.01 * EXTENT, 1.01 * 0.01 * EXTENT)
    gaussians = make_gaussians([small, large, small, large])
    much, little = 1.01 * options.gradient_threshold, 0.99 * options.gradient_threshold
    after = edited(options, gaussians, seen([much, much, little, little], [1.0, 1.0, 0.0, 0.0]))
    assert len(after) == 6
    sizes = after.log_scales[:, 0].exp()
    assert sizes.tolist() == pytest.approx([small, small, large, large / 1.6, large / 1.6, small])
    assert torch.equal(after.means[5], gaussians.means[0])
    after = edited(options, make_gaussians([large, small]), seen([little, much], [0.0, 1.0]))
    assert after.log_scales[:, 0].exp().tolist() == pytest.approx([large, small, small])


def test_pixels_whose_gradients_cancel_split_what_is_large_only() -> None:
    gaussians, statistics = make_gaussians([0.001, 0.5, 0.4]), seen([0.0, 0.0, 1e-3], absgrads=[1e-2, 1e-2, 1e-4])
    after = edited(DefaultDensify(split_by="absgrad"), gaussians, statistics)
    assert after.log_scales[:, 0].exp().tolist() == pytest.approx([0.001, 0.4, 0.5 / 1.6, 0.5 / 1.6])
    after = edited(DefaultDensify(split_by="gradient"), gaussians, statistics)
    assert after.log_scales[:, 0].exp().tolist() == pytest.approx([0.001, 0.5, 0.4 / 1.6, 0.4 / 1.6])


def test_transparent_gaussians_are_pruned_together_with_their_moments() -> None:
    gaussians = make_gaussians([0.001] * 3, [0.5, 0.004, 0.5])
    moments = {"primary.means": (gaussians.means + 1, gaussians.means + 2)}
    rng = torch.Generator().manual_seed(0)
    statistics = seen([0.0, 1.0, 0.0])
    after, moments = densify(DefaultDensify(), gaussians, moments, statistics, extent=EXTENT, generator=rng)
    assert torch.equal(after.means, gaussians.means[[0, 2]])
    assert torch.equal(moments["primary.means"][0], gaussians.means[[0, 2]] + 1)


def test_large_gaussians_are_pruned_only_on_request() -> None:
    gaussians = make_gaussians([0.21, 0.19])
    assert len(edited(DefaultDensify(), gaussians, seen([0.0, 0.0]))) == 2
    after = edited(DefaultDensify(), gaussians, seen([0.0, 0.0]), prune_large=True)
    assert torch.equal(after.means, gaussians.means[1:])


def test_cap_lets_the_largest_gradients_grow() -> None:
    gaussians = make_gaussians([0.001] * 4)
    after = edited(DefaultDensify(cap=6), gaussians, seen([3e-4, 9e-4, 8e-4, 0.0]))
    assert after.means[4:].tolist() == gaussians.means[[1, 2]].tolist()
    assert len(edited(DefaultDensify(cap=3), gaussians, seen([1.0] * 4))) == 4
    assert len(edited(DefaultDensify(cap=100), gaussians, seen([1.0, 0.0, 0.0, 0.0]))) == 5


def test_same_seed_same_bits() -> None:
    gaussians, statistics = make_gaussians([0.5] * 8), seen([1.0] * 8)
    first = edited(DefaultDensify(), gaussians, statistics)
    second = edited(DefaultDensify(), gaussians, statistics)
    assert torch.equal(first.means, second.means)


def test_stale_statistics_are_refused() -> None:
    with pytest.raises(ValueError, match="3 columns for 2 Gaussians"):
        edited(DefaultDensify(), make_gaussians([0.1, 0.1]), ScreenStatistics.zeros(3))


def test_reset_lowers_high_opacities_and_forgets_their_moments() -> None:
    gaussians = make_gaussians([0.1] * 3, [0.9, 0.008, 0.01])
    ones = torch.ones(3)
    after, moments = reset_opacity(gaussians, {"primary.logit_opacities": (ones, ones), "primary.sh": (ones, ones)})
    assert torch.sigmoid(after.logit_opacities).tolist() == pytest.approx([0.01, 0.008, 0.01])
    assert not moments["primary.logit_opacities"][0].any()
    assert moments["primary.sh"][0].all()
    assert after.logit_opacities.max() <= math.log(0.01 / 0.99) + 1e-6
