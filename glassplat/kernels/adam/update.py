"""One tensor's share of an Adam step."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class Update(NamedTuple):
    """A parameter, what moves it and how far.

    Attributes:
        parameter: [N, ...] float32 or float64, contiguous; changed in place.
        gradient: as `parameter`.
        first_moment: running mean of the gradient, as `parameter`, contiguous; changed in place.
        second_moment: running mean of the squared gradient, as `parameter`, contiguous; changed in place.
        lr: learning rate, or one for each element of a row of the parameter, [columns] with columns the product of
            all dimensions after the first.
        step: number of this step, from 1; the bias correction depends on it.
    """

    parameter: Tensor
    gradient: Tensor
    first_moment: Tensor
    second_moment: Tensor
    lr: float | Tensor
    step: int

    def corrections(self, betas: tuple[float, float]) -> tuple[float, float]:
        """The factors on the step size and on the root of the second moment that undo the bias towards zero."""
        return 1 / (1 - betas[0] ** self.step), float((1 - betas[1] ** self.step) ** -0.5)
