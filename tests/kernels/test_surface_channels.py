"""`surface_channels` against its twin."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from glassplat.kernels.environment import surface_channels
from glassplat.kernels.environment.reference import surface_channels as twin
from glassplat.kernels.records import NORMAL_AT, STRENGTH_AT, SURFACE_CHANNELS
from tests.kernels.threads import assert_threads_change_no_bit

COLORS, RADII, QUATS, LOG_SCALES, MEANS, STRENGTHS, EYE, EXTRA = range(8)
DIFFERENTIABLE = (COLORS, QUATS, STRENGTHS, EXTRA)


def gaussians(count: int, dtype: torch.dtype, extra: int = 2) -> list[Tensor]:
    """The arguments of the operation; some scales are equal, and a quarter of the Gaussians are not visible."""
    generator = torch.Generator().manual_seed(1)
    colors, quats, log_scales, means, others = (
        torch.randn(count, width, generator=generator, dtype=torch.float64) for width in (3, 4, 3, 3, extra)
    )
    log_scales[: count // 4] = -1
    log_scales[count // 4 : count // 2, 0] = 2
    log_scales[count // 4 : count // 2, 1:] = -2
    radii = (torch.rand(count, 1, generator=generator) < 0.75).repeat(1, 2)
    strengths, eye = torch.randn(count, generator=generator), torch.tensor([0.2, 0.1, -0.3])
    case = (colors, radii, 3 * quats, log_scales, means, strengths, eye, others)
    return [tensor.to(dtype) for tensor in case]


def with_gradients(function: Callable[..., Tensor], case: list[Tensor]) -> list[Tensor]:
    leaves = [tensor.detach().requires_grad_(i in DIFFERENTIABLE) for i, tensor in enumerate(case)]
    found = function(*leaves)
    weights = torch.randn(found.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    return [
        found.detach(),
        *torch.autograd.grad((found * weights.to(found)).sum(), [leaves[i] for i in DIFFERENTIABLE]),
    ]


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 2e-6), (torch.float64, 1e-13)])
@pytest.mark.parametrize("count", [0, 1, 400])
@pytest.mark.parametrize("extra", [0, 2])
def test_channels_and_gradients_match_the_reference(
    dtype: torch.dtype, tolerance: float, count: int, extra: int
) -> None:
    case = gaussians(count, dtype, extra)
    for tensor, other in zip(with_gradients(surface_channels, case), with_gradients(twin, case), strict=True):
        torch.testing.assert_close(tensor, other, rtol=tolerance, atol=tolerance)


def test_gradients_match_finite_differences() -> None:
    case = gaussians(20, torch.float64)

    def of_leaves(*leaves: Tensor) -> Tensor:
        return surface_channels(
            *(leaves[DIFFERENTIABLE.index(i)] if i in DIFFERENTIABLE else case[i] for i in range(8))
        )

    leaves = [case[i].requires_grad_() for i in DIFFERENTIABLE]
    assert torch.autograd.gradcheck(of_leaves, leaves, eps=1e-7, atol=1e-6, fast_mode=True)


def test_normals_are_unit_shortest_axes_towards_the_eye() -> None:
    case = gaussians(300, torch.float64)
    seen = case[RADII][:, 0] > 0
    normals = surface_channels(*case)[seen, NORMAL_AT:STRENGTH_AT]
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(len(normals), dtype=torch.float64))
    assert bool(((case[EYE] - case[MEANS][seen]) * normals).sum(-1).ge(0).all())


def test_channels_lie_where_shading_reads_them() -> None:
    case = gaussians(50, torch.float64)
    case[RADII][:] = 1
    channels = surface_channels(*case)
    assert torch.equal(channels[:, :NORMAL_AT], case[COLORS])
    torch.testing.assert_close(channels[:, STRENGTH_AT], torch.sigmoid(case[STRENGTHS]))
    assert torch.equal(channels[:, SURFACE_CHANNELS:], case[EXTRA])
    assert torch.equal(channels[:, :SURFACE_CHANNELS], surface_channels(*case[:EXTRA]))


def test_hidden_gaussians_add_nothing() -> None:
    case = gaussians(100, torch.float32)
    hidden = case[RADII][:, 0] == 0
    assert bool(hidden.any())
    case[QUATS][hidden] = float("nan")
    for tensor in with_gradients(surface_channels, case):
        assert tensor[hidden].count_nonzero() == 0


def test_the_first_of_equally_short_axes_is_taken() -> None:
    for scales, expected in (
        ([-1.0, -1.0, -1.0], [1.0, 0.0, 0.0]),
        ([0.0, -1.0, -1.0], [0.0, 1.0, 0.0]),
        ([0.0, 0.0, -1.0], [0.0, 0.0, -1.0]),
    ):
        case = gaussians(1, torch.float32)
        case[RADII], case[QUATS] = torch.ones(1, 2), torch.tensor([[1.0, 0.0, 0.0, 0.0]])
        case[LOG_SCALES], case[MEANS], case[EYE] = torch.tensor([scales]), torch.zeros(1, 3), torch.tensor([1, 2, -3.0])
        assert surface_channels(*case)[0, NORMAL_AT:STRENGTH_AT].tolist() == expected


@pytest.mark.parametrize("poison", [0.0, float("nan"), float("inf")])
def test_a_quaternion_without_direction_gives_no_normal_and_no_gradient(poison: float) -> None:
    case = gaussians(5, torch.float32)
    case[RADII][:], case[QUATS][2] = 1, poison
    for function in (surface_channels, twin):
        channels, _, v_quats, *_ = with_gradients(function, case)
        assert channels[2, NORMAL_AT:STRENGTH_AT].tolist() == [0.0, 0.0, 0.0] and v_quats[2].tolist() == [0.0] * 4
        assert bool(channels.isfinite().all()) and bool(v_quats.isfinite().all())


def test_threads_do_not_change_a_bit() -> None:
    case = gaussians(1000, torch.float32)
    assert_threads_change_no_bit(lambda: with_gradients(surface_channels, case))


@pytest.mark.parametrize(("which", "name"), [(LOG_SCALES, "log_scales"), (RADII, "radii"), (EXTRA, "extra")])
def test_shapes_that_disagree_are_named(which: int, name: str) -> None:
    case = gaussians(5, torch.float32)
    case[which] = case[which][:4]
    with pytest.raises(ValueError, match=f"{name} has shape"):
        surface_channels(*case)


def test_types_that_disagree_are_named() -> None:
    case = gaussians(5, torch.float32)
    case[MEANS] = case[MEANS].double()
    with pytest.raises(TypeError, match=r"means is torch\.float64"):
        surface_channels(*case)
