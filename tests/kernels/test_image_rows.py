"""Kernels of one pass over an image or over splats, in place of many PyTorch operations: against their twins."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numba
import pytest
import torch
from torch import Tensor

from glassplat.kernels.color_and_depth import color_and_depth
from glassplat.kernels.color_and_depth.reference import color_and_depth as color_and_depth_twin
from glassplat.kernels.harmonic_energy import harmonic_energy
from glassplat.kernels.harmonic_energy.operation import _EnergyOnGpu
from glassplat.kernels.harmonic_energy.reference import harmonic_energy as harmonic_energy_twin
from glassplat.kernels.join_channels import join_channels
from glassplat.kernels.join_channels.reference import join_channels as join_channels_twin
from glassplat.kernels.pane_layers import pane_layers
from glassplat.kernels.pane_layers.reference import pane_layers as pane_layers_twin

DTYPES = [(torch.float32, 1e-5), (torch.float64, 1e-12)]


def draw(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def with_gradients(function: Callable[..., Any], leaves: tuple[Tensor, ...], *rest: Any) -> list[Tensor]:
    own = [leaf.detach().requires_grad_() for leaf in leaves]
    found = function(*own, *rest)
    outputs = [found] if isinstance(found, Tensor) else list(found)
    weights = [draw(*output.shape, seed=9 + i, dtype=output.dtype) - 0.5 for i, output in enumerate(outputs)]
    gradients = torch.autograd.grad(outputs, own, weights, allow_unused=True, materialize_grads=True)
    return [*(output.detach() for output in outputs), *gradients]


@contextmanager
def one_thread() -> Iterator[None]:
    numba.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)


def blended(dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """An image [13, 21, 4] and its coverage; a part of it shows nothing."""
    alpha = draw(13, 21, seed=1, dtype=dtype)
    alpha[:5, :7] = 0
    alpha[5, 3] = 1e-6
    return draw(13, 21, 4, dtype=dtype) * alpha[..., None], alpha


@pytest.mark.parametrize(("dtype", "tolerance"), DTYPES)
@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), (1.0, 0.5, 0.2)])
def test_colours_and_depths(background: tuple[float, ...], dtype: torch.dtype, tolerance: float) -> None:
    found, expected = (with_gradients(f, blended(dtype), background) for f in (color_and_depth, color_and_depth_twin))
    for own, wanted in zip(found, expected, strict=True):
        torch.testing.assert_close(own, wanted, rtol=tolerance, atol=tolerance)
    with one_thread():
        again = with_gradients(color_and_depth, blended(dtype), background)
    assert all(torch.equal(a, b) for a, b in zip(found, again, strict=True))


@pytest.mark.parametrize("asked", [0, 1])
def test_of_colours_and_depths_one_may_have_no_gradient(asked: int) -> None:
    image, alpha = (tensor.requires_grad_() for tensor in blended(torch.float64))
    found, wanted = (f(image, alpha, (1.0, 0.5, 0.2)) for f in (color_and_depth, color_and_depth_twin))
    found, wanted = (torch.autograd.grad((layers[asked] ** 2).sum(), (image, alpha)) for layers in (found, wanted))
    torch.testing.assert_close(found, wanted)


def test_no_gradient_of_the_coverage_is_made_up() -> None:
    """On black, colours tell nothing of it: the pass that blended them is spared a gradient."""
    image, alpha = (tensor.requires_grad_() for tensor in blended(torch.float32))
    colors, _ = color_and_depth(image, alpha, (0.0, 0.0, 0.0))
    assert torch.autograd.grad(colors.sum(), alpha, allow_unused=True) == (None,)


@pytest.mark.parametrize(("dtype", "tolerance"), DTYPES)
@pytest.mark.parametrize(("cameras", "count", "more"), [(1, 5000, 0), (2, 4100, 300), (1, 0, 3), (0, 4, 1)])
def test_channels(cameras: int, count: int, more: int, dtype: torch.dtype, tolerance: float) -> None:
    leaves = draw(cameras, count, 3, dtype=dtype), draw(cameras, count, seed=1, dtype=dtype)
    found, expected = (with_gradients(f, leaves, more) for f in (join_channels, join_channels_twin))
    assert found[0].shape == (cameras, count + more, 4)
    assert all(torch.equal(own, wanted) for own, wanted in zip(found, expected, strict=True))


@pytest.mark.parametrize("size", [(40, 53), (2, 2), (1, 7), (7, 1)])
def test_layers_of_panes(size: tuple[int, int]) -> None:
    """Patches of three panes and of none, of which a part reflects nothing."""
    pane = (4 * draw(-(-size[0] // 7), -(-size[1] // 7), seed=5)).int() - 1
    pane = pane.repeat_interleave(7, 0).repeat_interleave(7, 1)[: size[0], : size[1]].contiguous()
    strength = torch.where(draw(*size, seed=2) > 0.03, 0.1, 0.0)
    found, expected = pane_layers(pane, strength), pane_layers_twin(pane, strength)
    assert size != (40, 53) or 0.1 < float(expected[1].mean()) < 0.7
    for own, wanted in zip(found, expected, strict=True):
        assert torch.equal(own, wanted) and own.dtype == strength.dtype


@pytest.mark.parametrize(("dtype", "tolerance"), DTYPES)
@pytest.mark.parametrize("shape", [(2500, 16), (3, 1), (3, 0), (0, 4)])
def test_energy_of_harmonics(shape: tuple[int, int], dtype: torch.dtype, tolerance: float) -> None:
    sh = draw(*shape, 3, dtype=dtype) - 0.3
    found, on_gpu, expected = (
        with_gradients(f, (sh,)) for f in (harmonic_energy, _EnergyOnGpu.apply, harmonic_energy_twin)
    )
    for own, of_gpu, wanted in zip(found, on_gpu, expected, strict=True):
        torch.testing.assert_close(own, wanted, rtol=tolerance, atol=tolerance)
        torch.testing.assert_close(of_gpu, wanted, rtol=tolerance, atol=tolerance)
    with one_thread():
        again = with_gradients(harmonic_energy, (sh,))
    assert all(torch.equal(a, b) for a, b in zip(found, again, strict=True))


def test_bad_input_is_named() -> None:
    image, alpha = blended(torch.float32)
    with pytest.raises(ValueError, match="image"):
        color_and_depth(image[..., :3], alpha, (0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="colors"):
        join_channels(image, alpha)
    with pytest.raises(TypeError, match="int32"):
        pane_layers(alpha, alpha)
    with pytest.raises(ValueError, match="sh"):
        harmonic_energy(image)
