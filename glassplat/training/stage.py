"""Training stages, and the state of a run: the scene, and Adam over named tensors."""

from __future__ import annotations

import itertools
import math
import zlib
from collections.abc import Callable, Generator, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Protocol

import torch
from torch import Tensor

from glassplat.captures.dataset import Dataset
from glassplat.errors import InputError
from glassplat.kernels.adam import Update, adam
from glassplat.render.frame import Renderer
from glassplat.scene.scene import Scene
from glassplat.training.densify import Moments, ScreenStatistics
from glassplat.training.losses import LossTerm
from glassplat.training.messages import Working
from glassplat.training.options import Rate

BETAS = (0.9, 0.999)
"""Adam's betas, for steps of one view."""


@dataclass
class Optimizer:
    """Adam's state, keyed by the dotted parameter names of `Scene.parameters`.

    Attributes:
        moments: first and second moment of each parameter.
        updates: number of views by which each parameter was stepped, for the bias correction.
        paused: number of further views for which a parameter is frozen.
        raised_rates: factors on the learning rates of parameters; 1 if absent.
    """

    moments: Moments = field(default_factory=dict)
    updates: dict[str, int] = field(default_factory=dict)
    paused: dict[str, int] = field(default_factory=dict)
    raised_rates: dict[str, float] = field(default_factory=dict)

    def step(
        self,
        parameters: Mapping[str, Tensor],
        gradients: Mapping[str, Tensor],
        rates: Mapping[str, float | Tensor],
        *,
        decays: Mapping[str, Tensor] | None = None,
        batch: int = 1,
    ) -> None:
        """Updates `parameters` in place for every name in `gradients`, which are means over a batch of views.

        `decays` are those of `glassplat.kernels.adam.Update`, for parameters that have one.

        Rates are for steps of one view. They are scaled by the square root of the number of views, and the moments
        average over as many views as before (Malladi et al. 2022, "On the SDEs and Scaling Rules for Adaptive Gradient
        Algorithms").
        """
        updates = []
        for name, gradient in gradients.items():
            parameter = parameters[name]
            if not parameter.numel() or self._wait_out_pause(name, batch):
                continue
            moments = self.moments_of(name, parameter)
            self.updates[name] = self.updates.get(name, 0) + batch
            factor = math.sqrt(batch) * self.raised_rates.get(name, 1.0)
            lr = rates[name] if factor == 1 else rates[name] * factor
            step, decay = self.updates[name] / batch, (decays or {}).get(name)
            updates.append(Update(parameter, gradient, *moments, lr, step, decay))
        adam(updates, betas=(BETAS[0] ** batch, BETAS[1] ** batch))

    def _wait_out_pause(self, name: str, batch: int) -> bool:
        """Return whether a parameter is paused at this step, whose views shorten its pause."""
        left = self.paused.get(name, 0)
        if left:
            self.paused[name] = max(left - batch, 0)
        return left > 0

    def moments_of(self, name: str, parameter: Tensor) -> tuple[Tensor, Tensor]:
        """The moments of a parameter; zero for a new one."""
        known = self.moments.get(name)
        if known is None or known[0].shape != parameter.shape:
            known = (torch.zeros_like(parameter), torch.zeros_like(parameter))
            self.moments[name] = known
            self.updates[name] = 0
        return known


def rate_tensor(rate: Rate, parameter: Tensor, progress: float, extent: float, iterations: int) -> float | Tensor:
    """The rate in the form of `adam`: one number, or one per column for SH coefficients."""
    value = rate.at(progress, extent, iterations)
    if rate.rest is None:
        return value
    return _column_values(value, value * rate.rest, parameter.shape[1:], parameter.dtype, parameter.device)


def decay_tensor(rate: Rate, parameter: Tensor) -> Tensor | None:
    """The weight decay equivalent to `Rate.penalty`; None without a penalty."""
    if not rate.penalty or not parameter.numel():
        return None
    rest = 2 * rate.penalty / len(parameter)
    return _column_values(0.0, rest, parameter.shape[1:], parameter.dtype, parameter.device)


@lru_cache(maxsize=64)
@torch.inference_mode(False)
def _column_values(constant: float, rest: float, shape: torch.Size, dtype: torch.dtype, device: torch.device) -> Tensor:
    """One number per column of SH coefficients [N, K, 3]: one value for the constant coefficient, another for the
    rest.

    The tensor is shared between steps; do not modify it.
    """
    columns = torch.full(shape, rest, dtype=dtype, device=device)
    columns[:1].fill_(constant)
    return columns.flatten()


@dataclass
class TrainState:
    """The mutable state of a run.

    Attributes:
        scene: the scene as trained so far.
        seed: random seed of the run.
        step: iterations done.
        optimizer: Adam's moments.
        statistics: screen gradients collected for densification, by scene part.
        seconds: training time so far, over all sessions, without compilation of kernels.
        records: numbers that actions keep between calls, and the last setup, by name.
        means: running means of the parameters over the last steps of the run, see `AverageLast` of `training.actions`.
        method: name of the method, for checkpoints; None if unknown.
        is_consistent: true if it can be saved; false during a step or an edit.
    """

    scene: Scene
    seed: int
    step: int = 0
    optimizer: Optimizer = field(default_factory=Optimizer)
    statistics: dict[str, ScreenStatistics] = field(default_factory=dict)
    seconds: float = 0.0
    records: dict[str, float] = field(default_factory=dict)
    means: dict[str, Tensor] = field(default_factory=dict)
    method: str | None = None
    is_consistent: bool = True

    def generator(self, purpose: str) -> torch.Generator:
        """A random generator for one purpose at this step.

        It depends only on the seed, the step and the purpose, so that a resumed run draws the same numbers. It is for
        the scene's device; different kinds of devices draw different numbers.
        """
        key = zlib.crc32(f"{self.seed}/{self.step}/{purpose}".encode())
        return torch.Generator(self.scene.primary.means.device).manual_seed(key)

    def to(self, device: torch.device | str) -> TrainState:
        """The same state on another device."""
        moments = {
            name: (first.to(device), second.to(device)) for name, (first, second) in self.optimizer.moments.items()
        }
        statistics = {
            part: ScreenStatistics(*(sums.to(device) for sums in known)) for part, known in self.statistics.items()
        }
        optimizer = replace(self.optimizer, moments=moments)
        means = {name: mean.to(device) for name, mean in self.means.items()}
        return replace(self, scene=self.scene.to(device), optimizer=optimizer, statistics=statistics, means=means)


@dataclass(frozen=True)
class Clock:
    """Position in a run.

    Attributes:
        step: iterations done so far, counting the current one; each is one view.
        iterations: length of the whole run.
        views: number of training views.
        batch: views of the step that was taken.
    """

    step: int
    iterations: int
    views: int
    batch: int = 1

    @property
    def progress(self) -> float:
        """Share of the run that is done, in [0, 1]."""
        return self.step / self.iterations

    def is_at(self, shares: Iterable[float]) -> bool:
        """Return whether this step is at one of these shares of the run."""
        return self.step in {round(share * self.iterations) for share in shares}


@dataclass(frozen=True)
class Every:
    """A recurring event, in shares of the run, so that schedules scale with its length.

    Attributes:
        share: distance between two occurrences.
        start, stop: range in which events happen, `start` excluded.
        least: minimum distance in iterations, also for short runs.
        skip_multiples_of: skip every n-th occurrence (for interleaving two events).
        only_multiples_of: keep every n-th occurrence only.
    """

    share: float
    start: float = 0.0
    stop: float = 1.0
    least: int = 1
    skip_multiples_of: int | None = None
    only_multiples_of: int | None = None

    def interval(self, clock: Clock) -> int:
        """Steps from one multiple to the next."""
        return max(round(self.share * clock.iterations), self.least, 1)

    def due(self, clock: Clock) -> bool:
        """Return whether the event happens at this step."""
        count, remainder = divmod(clock.step, self.interval(clock))
        if remainder or not self.start * clock.iterations < clock.step <= self.stop * clock.iterations:
            return False
        if self.skip_multiples_of and count % self.skip_multiples_of == 0:
            return False
        return not self.only_multiples_of or count % self.only_multiples_of == 0


RESET_TURN = 3
"""Every third time, opacities are reset; in between, they are perturbed or raised."""

MOST_TRIED_LENGTHS = 1000
"""Lengths to try in the search for one in which every stage has a step."""

Work = Generator[Working, None, bool]
"""An edit that yields its progress, and returns whether there was anything to edit."""


def run_edit(edit: Work | bool | None) -> Work:
    """Carries out an edit of the state, which may yield progress or return at once."""
    return (yield from edit) if isinstance(edit, Generator) else bool(edit)


class Action(Protocol):
    """An edit of the training state at certain moments (opacity reset, perturbation, SH growth)."""

    @property
    def name(self) -> str:
        """Name in the log."""
        ...

    def due(self, clock: Clock) -> bool:
        """Return whether to act after this step."""
        ...

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> Work | bool:
        """Edits `state`; returns False if there was nothing to edit. Long edits yield progress."""
        ...


@dataclass(frozen=True)
class AtShares:
    """Base class of actions that are due a few times in a run.

    Attributes:
        shares: shares of the run at which to act.
    """

    shares: tuple[float, ...]

    def due(self, clock: Clock) -> bool:
        """Return whether to act after this step."""
        return clock.is_at(self.shares)


class PostStep(Protocol):
    """A change of values in every step, such as the noise of Langevin dynamics; without messages."""

    def __call__(self, state: TrainState, clock: Clock, visible: Tensor | None) -> None:
        """Edits `state`.

        Args:
            state: after the optimiser's step.
            clock: position in the run.
            visible: [N] bool, primary Gaussians that the step's view showed, directly or mirrored; all if None.
        """
        ...


class Setup(Protocol):
    """Prepares the state at the start of a stage (fitting planes, adding an environment)."""

    def __call__(self, state: TrainState, dataset: Dataset) -> Work | None:
        """Edits `state`; long edits yield progress."""
        ...


@dataclass(frozen=True)
class Stage:
    """One stage of a recipe.

    Attributes:
        name: for the log.
        share: length as a share of the run; a recipe's shares add up to one.
        renderer: renderer of the training views.
        losses: loss terms.
        rates: learning rates of parameters; parameters without one are frozen.
        actions: recurring edits, in the order in which they act.
        post_steps: operations after the optimiser in every step, before the actions.
        setup: preparation at the start of the stage.
        densify_until: share of the run until which screen gradients are collected for densification.
        is_finished: ends the stage early where it returns true, before a step; the next stage then starts at once.
    """

    name: str
    share: float
    renderer: Renderer
    losses: tuple[LossTerm, ...]
    rates: Mapping[str, Rate]
    actions: tuple[Action, ...] = ()
    post_steps: tuple[PostStep, ...] = ()
    setup: Setup | None = None
    densify_until: float = 0.0
    is_finished: Callable[[TrainState], bool] | None = None

    def __post_init__(self) -> None:
        names = [term.name for term in self.losses]
        if len(set(names)) < len(names):
            raise ValueError(f"the stage {self.name!r} has the loss terms {names}; expected another name for each")


def stage_starts(stages: tuple[Stage, ...], iterations: int) -> list[int]:
    """The first step of each stage, followed by the end of the run."""
    total = sum(stage.share for stage in stages)
    passed = itertools.accumulate((stage.share for stage in stages[:-1]), initial=0.0)
    return [*(round(share / total * iterations) for share in passed), iterations]


def check_length(stages: tuple[Stage, ...], iterations: int) -> None:
    """Refuse a run in which a stage has no step, because the run is too short or the stage has no share.

    Raises:
        InputError: the message names the stage and the required number of iterations.
    """
    missed = stages_without_step(stages, iterations)
    if not missed:
        return
    name, share = missed[0].name, missed[0].share / sum(stage.share for stage in stages)
    if share <= 0:
        raise InputError(f"the stage {name!r} has no share of the run, but later stages depend on it")
    lengths = itertools.islice(itertools.count(max(iterations, math.ceil(0.5 / share))), MOST_TRIED_LENGTHS)
    enough = next((length for length in lengths if not stages_without_step(stages, length)), math.ceil(2 / share))
    raise InputError(f"{iterations} iterations are too few for the stage {name!r}; expected at least {enough}")


def stages_without_step(stages: tuple[Stage, ...], iterations: int) -> list[Stage]:
    """The stages without a step, except for those with neither a share nor a setup."""
    starts = stage_starts(stages, iterations)
    spans = zip(stages, starts[:-1], starts[1:], strict=True)
    return [stage for stage, start, end in spans if start >= end and (stage.share > 0 or stage.setup is not None)]
