"""Adam, in place and in one pass over all parameters; learning rate and weight decay may differ by column."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from glassplat.kernels.backend.devices import kernels_for
from glassplat.kernels.records import check_tensors


class Update(NamedTuple):
    """A parameter with its gradient, moments and step size.

    Attributes:
        parameter: [N, ...] float32 or float64, contiguous; changed in place.
        gradient: as `parameter`.
        first_moment: running mean of the gradient, as `parameter`, contiguous; changed in place.
        second_moment: running mean of the squared gradient, as `parameter`, contiguous; changed in place.
        lr: learning rate, or one for each element of a row of the parameter, [columns] with columns the product of
            all dimensions after the first.
        step: number of this step, starting at 1, for the bias correction. It is fractional if earlier steps had other
            betas.
        decay: [columns] factors by which the parameter is added to its gradient, as of an L2 penalty of half the
            weight; None adds none.
    """

    parameter: Tensor
    gradient: Tensor
    first_moment: Tensor
    second_moment: Tensor
    lr: float | Tensor
    step: float
    decay: Tensor | None = None

    def corrections(self, betas: tuple[float, float]) -> tuple[float, float]:
        """The factors on the step size and on the root of the second moment that undo the bias towards zero."""
        return 1 / (1 - betas[0] ** self.step), float((1 - betas[1] ** self.step) ** -0.5)


TENSORS = Update._fields[:4]
CHANGED = ("parameter", "first_moment", "second_moment")


@torch.no_grad()
def adam(updates: Sequence[Update], *, betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-15) -> None:
    """Takes one Adam step with bias correction, as `torch.optim.Adam` does; changes all but the gradients in place.

    `decay` acts as that optimiser's `weight_decay`, through the gradient; AdamW instead shrinks the parameter itself.

    Args:
        updates: the parameters, all of one floating-point type and on one device, no two of them in the same memory.
        betas: decay of the two running means.
        eps: added to the root of the second moment.
    """
    for update in updates:
        _check(update, updates[0].parameter)
    flat = [_flat(update) for update in updates if update.parameter.numel()]
    if flat:
        kernels_for("adam", flat[0].parameter.device).adam(flat, betas, eps)


def _check(update: Update, like: Tensor) -> None:
    shape = tuple(update.parameter.shape)
    tensors = {name: (getattr(update, name), shape) for name in TENSORS}
    check_tensors({"the first parameter": (like, tuple(like.shape)), **tensors})
    for name in CHANGED:
        if not getattr(update, name).is_contiguous():
            raise ValueError(f"{name} is changed in place and must be contiguous; pass {name}.contiguous()")
    columns = (math.prod(shape[1:]),)
    for name, value in (("lr", update.lr), ("decay", update.decay)):
        if isinstance(value, Tensor) and tuple(value.shape) != columns:
            raise ValueError(f"{name} has shape {tuple(value.shape)}; expected one number or one per column, {columns}")
    if update.step < 1:
        raise ValueError(f"step is {update.step}; steps count from 1")


def _flat(update: Update) -> Update:
    """The same update with flattened tensors."""
    return update._replace(**{name: getattr(update, name).contiguous().view(-1) for name in TENSORS})
