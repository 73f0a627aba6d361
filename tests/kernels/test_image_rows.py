"""Operations in one pass over an image or over splats that accompany blending."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from glassplat.kernels.composite import mean_depth
from glassplat.kernels.panes import inside_panes
from glassplat.render.frame import over_background

BACKGROUNDS = [(0.0, 0.0, 0.0), (1.0, 0.5, 0.2)]


def draw(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def blended(dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """An image [13, 21, 4] of colours and depths, and its coverage; part of it is empty."""
    alpha = draw(13, 21, seed=1, dtype=dtype)
    alpha[:5, :7] = 0
    alpha[5, 3] = 1e-6
    return draw(13, 21, 4, dtype=dtype) * alpha[..., None], alpha


def test_depths_are_means_in_covered_pixels() -> None:
    image, alpha = blended()
    depth, shown = mean_depth(image[..., 3], alpha), alpha > 1e-6
    assert bool((depth[~shown] == 0).all()) and int((~shown).sum()) > 30
    torch.testing.assert_close(depth[shown] * alpha[shown], image[..., 3][shown])


@pytest.mark.parametrize("background", BACKGROUNDS)
def test_gradients_of_colours_and_depths(background: tuple[float, ...]) -> None:
    image, alpha = blended()
    leaves = image[4:7, 2:5].clone().requires_grad_(), alpha[4:7, 2:5].clone().requires_grad_()
    covered = (leaves[1] > 1e-5).detach()  # Elsewhere finite differences cross the coverage below which depth is 0.

    def where_covered(image: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor]:
        alpha = torch.where(covered, alpha, 0)
        return over_background(image[..., :3], alpha, background), mean_depth(image[..., 3], alpha)

    assert torch.autograd.gradcheck(where_covered, leaves)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("background", BACKGROUNDS)
def test_the_background_is_seen_through_what_is_before_it(background: tuple[float, ...], dtype: torch.dtype) -> None:
    image, alpha = blended(dtype)
    through = (1 - alpha)[..., None] * torch.tensor(background, dtype=dtype)
    torch.testing.assert_close(over_background(image[..., :3], alpha, background), image[..., :3] + through)


def test_coverage_has_no_gradient_over_black() -> None:
    """On black, colours do not depend on coverage: the pass that blended them is spared a gradient."""
    image, alpha = (tensor.requires_grad_() for tensor in blended())
    colors = over_background(image[..., :3], alpha, (0.0, 0.0, 0.0))
    assert torch.autograd.grad(colors.sum(), alpha, allow_unused=True) == (None,)


@pytest.mark.parametrize("size", [(40, 53), (2, 2), (1, 7), (7, 1)])
def test_inside_of_panes(size: tuple[int, int]) -> None:
    """Patches of three panes and of no pane, part of which reflects nothing."""
    pane = (4 * draw(-(-size[0] // 7), -(-size[1] // 7), seed=5)).int() - 1
    pane = pane.repeat_interleave(7, 0).repeat_interleave(7, 1)[: size[0], : size[1]].contiguous()
    strength = torch.where(draw(*size, seed=2) > 0.03, 0.1, 0.0)
    inner = inside_panes(pane, strength)
    shown = torch.where(strength > 0, pane, -1)
    expected = torch.zeros_like(strength)
    for y in range(size[0]):
        for x in range(size[1]):
            around = shown[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
            expected[y, x] = float(shown[y, x] >= 0 and bool((around == shown[y, x]).all()))
    assert torch.equal(inner, expected) and inner.dtype == strength.dtype
    assert size != (40, 53) or 0.1 < float(expected.mean()) < 0.7


def test_bad_input_is_named() -> None:
    with pytest.raises(TypeError, match="int32"):
        inside_panes(torch.zeros(2, 3), torch.zeros(2, 3))
