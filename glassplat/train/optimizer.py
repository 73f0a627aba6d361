"""Adam over named tensors, with learning rates that follow the run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from glassplat.kernels.adam import Update, adam

PUBLISHED_ITERATIONS = 30_000
"""Length of the runs for which 3DGS, and TR-Gaussians after it, chose their learning rates."""
FASTEST_ITERATIONS = 3_000
"""Shorter runs learn no faster than one of this length, the shortest for which higher rates were measured."""

Moments = dict[str, tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class Rate:
    """A learning rate over the run.

    Attributes:
        start: rate at the first iteration.
        end: rate that it decays to exponentially; None keeps `start`.
        decay: share of the run at which `end` is reached.
        per_extent: multiply by the scene extent (for positions).
        rest: factor for every SH coefficient but the constant one; only for `sh`.
        short_run_power: a run of fewer iterations than the published 30,000 multiplies the rate by their ratio to this
            power (`FASTEST_ITERATIONS` at the least), because Adam moves a parameter by about its rate at every step,
            however small the gradient.
    """

    start: float
    end: float | None = None
    decay: float = 1.0
    per_extent: bool = False
    rest: float | None = None
    short_run_power: float = 0.0

    def at(self, progress: float, extent: float, iterations: int = PUBLISHED_ITERATIONS) -> float:
        """The rate at a progress in [0, 1] of a run of so many iterations."""
        length = min(max(iterations, FASTEST_ITERATIONS), PUBLISHED_ITERATIONS)
        scale = (PUBLISHED_ITERATIONS / length) ** self.short_run_power
        if self.per_extent:
            scale *= extent
        if self.end is None or self.start == 0:
            return self.start * scale
        decayed = min(progress / self.decay, 1.0)
        return float(self.start ** (1 - decayed) * self.end**decayed * scale)


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
