"""The fused Adam step agrees with torch.optim.Adam and with its twin."""

from __future__ import annotations

import math

import pytest
import torch

from glassplat.kernels.adam import Update, adam
from glassplat.kernels.adam.reference import adam as reference_adam
from tests.kernels.threads import assert_threads_change_no_bit

BETAS = (0.8, 0.99)


def draws(*shape: int, dtype: torch.dtype = torch.float32, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_several_steps_agree_with_torch(dtype: torch.dtype, tolerance: float) -> None:
    parameter = draws(3001, 4, dtype=dtype)
    first, second = torch.zeros_like(parameter), torch.zeros_like(parameter)
    theirs = parameter.clone().requires_grad_()
    optimizer = torch.optim.Adam([theirs], lr=0.05, betas=BETAS, eps=1e-15)
    for step in range(1, 6):
        gradient = draws(3001, 4, dtype=dtype, seed=step) * 10.0 ** -(step * 2)
        theirs.grad = gradient.clone()
        optimizer.step()
        adam([Update(parameter, gradient, first, second, 0.05, step)], betas=BETAS)
    torch.testing.assert_close(parameter, theirs.detach(), rtol=tolerance, atol=tolerance)


def test_decay_is_the_weight_decay_of_torch() -> None:
    parameter = draws(3001, 4)
    first, second = torch.zeros_like(parameter), torch.zeros_like(parameter)
    theirs = parameter.clone().requires_grad_()
    optimizer = torch.optim.Adam([theirs], lr=0.05, eps=1e-15, weight_decay=0.3)
    for step in range(1, 4):
        theirs.grad = draws(3001, 4, seed=step)
        optimizer.step()
        adam([Update(parameter, draws(3001, 4, seed=step), first, second, 0.05, step, torch.full((4,), 0.3))])
    torch.testing.assert_close(parameter, theirs.detach(), rtol=1e-5, atol=1e-5)


def test_each_column_has_its_own_rate() -> None:
    start = draws(700, 16, 3)
    rates = torch.linspace(0.0, 0.1, 48)
    ours, theirs = start.clone(), start.clone()
    moments = [torch.zeros_like(start) for _ in range(4)]
    for step in (1, 2, 3):
        gradient = draws(700, 16, 3, seed=step)
        adam([Update(ours, gradient, moments[0], moments[1], rates, step)])
        reference_adam([Update(theirs, gradient, moments[2], moments[3], rates, step)])
    torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(moments[0], moments[2])
    torch.testing.assert_close(moments[1], moments[3])
    assert torch.equal(ours[:, 0, 0], start[:, 0, 0])
    assert not torch.equal(ours[:, 0, 1], start[:, 0, 1])


def test_more_columns_than_a_block_holds() -> None:
    ours, theirs = draws(3, 5000), draws(3, 5000)
    gradient, rates = draws(3, 5000, seed=1), draws(5000, seed=2).abs()
    moments = [torch.zeros_like(ours) for _ in range(4)]
    adam([Update(ours, gradient, moments[0], moments[1], rates, 1)])
    reference_adam([Update(theirs, gradient, moments[2], moments[3], rates, 1)])
    torch.testing.assert_close(ours, theirs)


def test_a_vector_is_rows_of_one_column() -> None:
    parameter, gradient = torch.tensor([1.0]), torch.tensor([3.0])
    adam([Update(parameter, gradient, torch.zeros(1), torch.zeros(1), torch.tensor([0.25]), 1)])
    assert parameter.item() == pytest.approx(0.75)


def several(dtype: torch.dtype) -> list[Update]:
    """Tensors smaller than a task, of several tasks, and empty, whose steps, rates and decays differ."""
    shapes = ((5,), (3000, 4), (0, 3), (700, 16, 3), (1, 3))
    updates = []
    for i, shape in enumerate(shapes):
        tensors = (draws(*shape, dtype=dtype, seed=4 * i + k) for k in range(3))
        rates = torch.linspace(0.0, 0.1, 48) if len(shape) == 3 else 0.02 * (i + 1)
        decay = torch.linspace(0.5, 0.0, math.prod(shape[1:])) if i % 3 else None
        squares = draws(*shape, dtype=dtype, seed=4 * i + 3).square()
        updates.append(Update(*tensors, squares, rates, step=i + 1, decay=decay))
    return updates


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_many_parameters_take_their_own_steps(dtype: torch.dtype, tolerance: float) -> None:
    ours, theirs = several(dtype), several(dtype)
    adam(ours)
    reference_adam(theirs)
    for own, expected in zip(ours, theirs, strict=True):
        for found, wanted in zip(own[:4], expected[:4], strict=True):
            torch.testing.assert_close(found, wanted, rtol=tolerance, atol=tolerance)


def test_the_number_of_threads_changes_no_bit() -> None:
    def everything() -> list[torch.Tensor]:
        updates = several(torch.float32)
        adam(updates)
        return [tensor for update in updates for tensor in update[:4]]

    assert_threads_change_no_bit(everything)


def test_no_parameters_take_no_step() -> None:
    adam([])


def test_parameters_of_different_types_are_refused() -> None:
    single, double = (torch.zeros(3, dtype=dtype) for dtype in (torch.float32, torch.float64))
    with pytest.raises(TypeError, match=r"parameter is torch\.float64 and the first parameter is torch\.float32"):
        adam([Update(*[single] * 4, 0.1, 1), Update(*[double] * 4, 0.1, 1)])


@pytest.mark.parametrize("shape", [(0,), (0, 3), (5, 0, 3)])
def test_nothing_to_do(shape: tuple[int, ...]) -> None:
    empty = torch.zeros(shape)
    adam([Update(empty, empty, empty, empty, 0.1, 1)])
    assert empty.shape == shape


def test_zero_gradients_leave_a_fresh_parameter_alone() -> None:
    parameter = draws(40)
    kept = parameter.clone()
    adam([Update(parameter, torch.zeros(40), torch.zeros(40), torch.zeros(40), 0.1, 1)])
    assert torch.equal(parameter, kept)


def test_a_parameter_that_requires_grad_is_updated_in_place() -> None:
    parameter = torch.ones(3, requires_grad=True)
    adam([Update(parameter, torch.ones(3), torch.zeros(3), torch.zeros(3), 0.5, 1)])
    assert parameter.tolist() == pytest.approx([0.5, 0.5, 0.5])


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"gradient": torch.zeros(3, 2)}, ValueError, r"gradient has shape \(3, 2\); expected \(4, 2\)"),
        ({"second_moment": torch.zeros(2, 4).T}, ValueError, "second_moment is changed in place"),
        ({"lr": torch.zeros(3)}, ValueError, r"lr has shape \(3,\); expected one number or one per column, \(2,\)"),
        ({"decay": torch.zeros(4)}, ValueError, r"decay has shape \(4,\); expected one number or one per column"),
        ({"step": 0}, ValueError, "steps count from 1"),
        ({"gradient": torch.zeros(4, 2, dtype=torch.float64)}, TypeError, "gradient is torch.float64"),
    ],
)
def test_bad_input_is_refused(change: dict[str, object], error: type[Exception], message: str) -> None:
    names = ("parameter", "gradient", "first_moment", "second_moment")
    arguments = {name: torch.zeros(4, 2) for name in names} | {"lr": 0.1, "step": 1} | change
    with pytest.raises(error, match=message):
        adam([Update(**arguments)])
