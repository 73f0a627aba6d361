"""`facing_normals` against its twin."""

from __future__ import annotations

from collections.abc import Callable

import numba
import pytest
import torch
from torch import Tensor

from glassplat.kernels.facing_normals import facing_normals
from glassplat.kernels.reference.facing_normals import facing_normals as twin


def gaussians(count: int, dtype: torch.dtype) -> list[Tensor]:
    """Quaternions, log scales (some equal), means and an eye among them."""
    generator = torch.Generator().manual_seed(1)
    quats, log_scales, means = (torch.randn(count, k, generator=generator, dtype=torch.float64) for k in (4, 3, 3))
    log_scales[: count // 4] = -1
    log_scales[count // 4 : count // 2, 0] = 2
    log_scales[count // 4 : count // 2, 1:] = -2
    return [tensor.to(dtype) for tensor in (3 * quats, log_scales, means, torch.tensor([0.2, 0.1, -0.3]))]


def with_gradient(function: Callable[..., Tensor], case: list[Tensor]) -> list[Tensor]:
    quats = case[0].detach().requires_grad_()
    found = function(quats, *case[1:])
    weights = torch.randn(found.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    return [found.detach(), torch.autograd.grad((found * weights.to(found)).sum(), quats)[0]]


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 2e-6), (torch.float64, 1e-13)])
@pytest.mark.parametrize("count", [0, 1, 400])
def test_normals_match_their_twin(dtype: torch.dtype, tolerance: float, count: int) -> None:
    case = gaussians(count, dtype)
    for tensor, other in zip(with_gradient(facing_normals, case), with_gradient(twin, case), strict=True):
        torch.testing.assert_close(tensor, other, rtol=tolerance, atol=tolerance)


def test_gradient_matches_finite_differences() -> None:
    quats, *others = gaussians(20, torch.float64)
    assert torch.autograd.gradcheck(
        lambda q: facing_normals(q, *others), quats.requires_grad_(), eps=1e-7, atol=1e-6, fast_mode=True
    )


def test_normals_are_unit_shortest_axes_towards_the_eye() -> None:
    quats, log_scales, means, eye = gaussians(300, torch.float64)
    normals = facing_normals(quats, log_scales, means, eye)
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(300, dtype=torch.float64))
    assert bool(((eye - means) * normals).sum(-1).ge(0).all())


def test_the_first_of_equally_short_axes_is_taken() -> None:
    quats, eye = torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.tensor([1.0, 2.0, -3.0])
    means = torch.zeros(1, 3)
    for scales, expected in (
        ([-1.0, -1.0, -1.0], [1.0, 0.0, 0.0]),
        ([0.0, -1.0, -1.0], [0.0, 1.0, 0.0]),
        ([0.0, 0.0, -1.0], [0.0, 0.0, -1.0]),
    ):
        assert facing_normals(quats, torch.tensor([scales]), means, eye).tolist() == [expected]


@pytest.mark.parametrize("poison", [0.0, float("nan"), float("inf")])
def test_a_quaternion_without_direction_gives_no_normal_and_no_gradient(poison: float) -> None:
    case = gaussians(5, torch.float32)
    case[0][2] = poison
    for function in (facing_normals, twin):
        normals, gradient = with_gradient(function, case)
        assert normals[2].tolist() == [0.0, 0.0, 0.0] and gradient[2].tolist() == [0.0, 0.0, 0.0, 0.0]
        assert bool(normals.isfinite().all()) and bool(gradient.isfinite().all())


def test_threads_do_not_change_a_bit() -> None:
    case = gaussians(1000, torch.float32)
    many = with_gradient(facing_normals, case)
    numba.set_num_threads(1)
    one = with_gradient(facing_normals, case)
    assert all(torch.equal(a, b) for a, b in zip(many, one, strict=True))


def test_bad_input_is_named() -> None:
    quats, log_scales, means, eye = gaussians(5, torch.float32)
    with pytest.raises(ValueError, match="log_scales has shape"):
        facing_normals(quats, log_scales[:4], means, eye)
    with pytest.raises(ValueError, match="eye has shape"):
        facing_normals(quats, log_scales, means, eye[:2])
    with pytest.raises(TypeError, match=r"means is torch\.float64"):
        facing_normals(quats, log_scales, means.double(), eye)
