"""Operations of one pass over an image or over splats that go along with blending."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from glassplat.kernels.composite import color_and_depth, join_channels
from glassplat.kernels.panes import inside_panes


def draw(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def with_gradients(function: Callable[..., Any], leaves: tuple[Tensor, ...], *rest: Any) -> list[Tensor]:
    own = [leaf.detach().requires_grad_() for leaf in leaves]
    found = function(*own, *rest)
    outputs = [found] if isinstance(found, Tensor) else list(found)
    weights = [draw(*output.shape, seed=9 + i, dtype=output.dtype) - 0.5 for i, output in enumerate(outputs)]
    gradients = torch.autograd.grad(outputs, own, weights, allow_unused=True, materialize_grads=True)
    return [*(output.detach() for output in outputs), *gradients]


def blended(dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """An image [13, 21, 4] and its coverage; a part of it shows nothing."""
    alpha = draw(13, 21, seed=1, dtype=dtype)
    alpha[:5, :7] = 0
    alpha[5, 3] = 1e-6
    return draw(13, 21, 4, dtype=dtype) * alpha[..., None], alpha


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), (1.0, 0.5, 0.2)])
def test_colours_and_depths(background: tuple[float, ...], dtype: torch.dtype) -> None:
    image, alpha = blended(dtype)
    colors, depth = color_and_depth(image, alpha, background)
    through = (1 - alpha)[..., None] * torch.tensor(background, dtype=dtype)
    torch.testing.assert_close(colors, image[..., :3] + through)
    shown = alpha > 1e-6
    assert bool((depth[~shown] == 0).all()) and int((~shown).sum()) > 30
    torch.testing.assert_close(depth[shown] * alpha[shown], image[..., 3][shown])


@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), (1.0, 0.5, 0.2)])
def test_gradients_of_colours_and_depths(background: tuple[float, ...]) -> None:
    image, alpha = blended(torch.float64)
    alpha[5, 3] = 0  # Within a finite difference of where depths end.
    leaves = image[4:7, 2:5].clone().requires_grad_(), alpha[4:7, 2:5].clone().requires_grad_()
    covered = (leaves[1] > 0).detach()

    def where_covered(image: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor]:
        colors, depth = color_and_depth(image, torch.where(covered, alpha, 0), background)
        return colors, depth

    assert torch.autograd.gradcheck(where_covered, leaves)


def test_no_gradient_of_the_coverage_is_made_up() -> None:
    """On black, colours tell nothing of it: the pass that blended them is spared a gradient."""
    image, alpha = (tensor.requires_grad_() for tensor in blended(torch.float32))
    colors, _ = color_and_depth(image, alpha, (0.0, 0.0, 0.0))
    assert torch.autograd.grad(colors.sum(), alpha, allow_unused=True) == (None,)


@pytest.mark.parametrize(("cameras", "count", "more"), [(1, 50, 0), (2, 41, 30), (1, 0, 3), (0, 4, 1)])
def test_channels(cameras: int, count: int, more: int) -> None:
    colors, values = draw(cameras, count, 3), draw(cameras, count, seed=1)
    channels, v_colors, v_values = with_gradients(join_channels, (colors, values), more)
    assert channels.shape == (cameras, count + more, 4)
    assert torch.equal(channels[:, :count, :3], colors) and torch.equal(channels[:, :count, 3], values)
    assert not channels[:, count:].any()
    weights = draw(*channels.shape, seed=9) - 0.5
    assert torch.equal(v_colors, weights[:, :count, :3]) and torch.equal(v_values, weights[:, :count, 3])


@pytest.mark.parametrize("size", [(40, 53), (2, 2), (1, 7), (7, 1)])
def test_inside_of_panes(size: tuple[int, int]) -> None:
    """Patches of three panes and of none, of which a part reflects nothing."""
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
    image, alpha = blended(torch.float32)
    with pytest.raises(ValueError, match="image"):
        color_and_depth(image[..., :3], alpha, (0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="colors"):
        join_channels(image, alpha)
    with pytest.raises(TypeError, match="int32"):
        inside_panes(alpha, alpha)
