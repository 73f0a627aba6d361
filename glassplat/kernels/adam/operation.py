"""Adam, in place and in one pass, with a learning rate per column where wanted."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from glassplat.kernels.devices import kernels_for
from glassplat.kernels.tensor_checks import check_tensors


@torch.no_grad()
def adam(
    parameter: Tensor,
    gradient: Tensor,
    first_moment: Tensor,
    second_moment: Tensor,
    *,
    lr: float | Tensor,
    betas: tuple[float, float] = (0.9, 0.999),
    eps: float = 1e-15,
    step: int,
) -> None:
    """Takes one Adam step with bias correction, as `torch.optim.Adam` does; changes all but the gradient in place.

    Args:
        parameter: [N, ...] float32 or float64, contiguous.
        gradient: as `parameter`.
        first_moment: running mean of the gradient, as `parameter`, contiguous.
        second_moment: running mean of the squared gradient, as `parameter`, contiguous.
        lr: learning rate, or one for each element of a row of the parameter, [columns] with columns the
            product of all dimensions after the first.
        betas: decay of the two running means.
        eps: added to the root of the second moment.
        step: number of this step, from 1; the bias correction depends on it.

    Raises:
        ValueError: shapes differ, `lr` has not one entry per column, `step` is below 1, or a tensor
            that changes in place is not contiguous.
        TypeError: floating-point types differ or are not supported, or tensors are on different devices.
    """
    columns = math.prod(parameter.shape[1:])
    _check(parameter, gradient, first_moment, second_moment, lr, columns, step)
    if parameter.numel() == 0:
        return
    flat = [t.detach().reshape(-1) for t in (parameter, gradient.contiguous(), first_moment, second_moment)]
    corrections = 1 / (1 - betas[0] ** step), 1 / math.sqrt(1 - betas[1] ** step)
    kernels_for("adam", parameter.device).adam(flat, lr, betas, eps, corrections=corrections)


def _check(
    parameter: Tensor,
    gradient: Tensor,
    first_moment: Tensor,
    second_moment: Tensor,
    lr: float | Tensor,
    columns: int,
    step: int,
) -> None:
    changed = {"parameter": parameter, "first_moment": first_moment, "second_moment": second_moment}
    shape = tuple(parameter.shape)
    check_tensors({name: (tensor, shape) for name, tensor in (changed | {"gradient": gradient}).items()})
    for name, tensor in changed.items():
        if not tensor.is_contiguous():
            raise ValueError(f"{name} is changed in place and must be contiguous; pass {name}.contiguous()")
    if isinstance(lr, Tensor) and tuple(lr.shape) != (columns,):
        raise ValueError(f"lr has shape {tuple(lr.shape)}; expected one number or one per column, ({columns},)")
    if step < 1:
        raise ValueError(f"step is {step}; steps count from 1")
