"""Adam over named tensors, with learning rates that follow the run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from glassplat.kernels.adam import Update, adam
from glassplat.train.rates import Rate

Moments = dict[str, tuple[Tensor, Tensor]]


@dataclass
class Optimizer:
    """Adam's state, keyed by the dotted parameter names of `Scene.parameters`.

    Attributes:
        moments: first and second moment of each parameter.
        updates: how often each parameter was stepped, for the bias correction.
        paused: for how many more steps a parameter is left as it is.
        hurried: by what the rate of a parameter is multiplied from now on; 1 where nothing is said.
    """

    moments: Moments = field(default_factory=dict)
    updates: dict[str, int] = field(default_factory=dict)
    paused: dict[str, int] = field(default_factory=dict)
    hurried: dict[str, float] = field(default_factory=dict)

    def step(
        self, parameters: Mapping[str, Tensor], gradients: Mapping[str, Tensor], rates: Mapping[str, float | Tensor]
    ) -> None:
        """Updates `parameters` in place for every name in `gradients`."""
        learning = [name for name in gradients if parameters[name].numel() > 0 and not self._waits(name)]
        adam([self._update(name, parameters[name], gradients[name], rates[name]) for name in learning])

    def _update(self, name: str, parameter: Tensor, gradient: Tensor, rate: float | Tensor) -> Update:
        """The next step of a parameter; counts it."""
        moments = self.moments_of(name, parameter)
        self.updates[name] = self.updates.get(name, 0) + 1
        return Update(parameter, gradient, *moments, lr=rate * self.hurried.get(name, 1.0), step=self.updates[name])

    def _waits(self, name: str) -> bool:
        """Whether a parameter is paused; counts the step."""
        left = self.paused.get(name, 0)
        if left:
            self.paused[name] = left - 1
        return left > 0

    def moments_of(self, name: str, parameter: Tensor) -> tuple[Tensor, Tensor]:
        """The moments of a parameter, zero for one that is new."""
        known = self.moments.get(name)
        if known is None or known[0].shape != parameter.shape:
            known = (torch.zeros_like(parameter), torch.zeros_like(parameter))
            self.moments[name] = known
            self.updates[name] = 0
        return known


def rate_tensor(rate: Rate, parameter: Tensor, progress: float, extent: float, iterations: int) -> float | Tensor:
    """The rate as `adam` takes it: one number, or one per column where SH bands differ."""
    value = rate.at(progress, extent, iterations)
    if rate.rest is None:
        return value
    columns = torch.full(parameter.shape[1:], value * rate.rest, dtype=parameter.dtype, device=parameter.device)
    columns[:1].fill_(value)
    return columns.flatten()
