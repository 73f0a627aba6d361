"""Training stages, and the state that changes during a run: the scene, and Adam over named tensors."""

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
from glassplat.training.densify import ScreenStatistics
from glassplat.training.losses import LossTerm
from glassplat.training.messages import Working
from glassplat.training.options import Rate

Moments = dict[str, tuple[Tensor, Tensor]]


BETAS = (0.9, 0.999)
"""Of Adam, for steps of one view."""


@dataclass
class Optimizer:
    """Adam's state, keyed by the dotted parameter names of `Scene.parameters`.

    Attributes:
        moments: first and second moment of each parameter.
        updates: by how many views each parameter was stepped, for the bias correction.
        paused: for how many more views a parameter is left as it is.
        raised_rates: by what the rate of a parameter is multiplied from now on; 1 where nothing is said.
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
        views: int = 1,
    ) -> None:
        """Updates `parameters` in place for every name in `gradients`, which are means over so many views.

        `decays` are those of `glassplat.kernels.adam.Update`, of the parameters that have one.

        Rates are those of a step of one view. They grow by the root of the number of views, and moments remember as
        many views as ever: so a step leads as far as so many steps would whose gradients agree on nothing (Malladi et
        al. 2022, "On the SDEs and Scaling Rules for Adaptive Gradient Algorithms").
        """
        learning = [name for name in gradients if parameters[name].numel() > 0 and not self._waits(name, views)]
        known = decays or {}
        updates = [
            self._update(name, parameters[name], gradients[name], rates[name], known.get(name), views)
            for name in learning
        ]
        adam(updates, betas=(BETAS[0] ** views, BETAS[1] ** views))

    def _update(
        self, name: str, parameter: Tensor, gradient: Tensor, rate: float | Tensor, decay: Tensor | None, views: int
    ) -> Update:
        """The next step of a parameter, which so many views have asked for; counts them."""
        moments = self.moments_of(name, parameter)
        self.updates[name] = self.updates.get(name, 0) + views
        factor = math.sqrt(views) * self.raised_rates.get(name, 1.0)
        lr = rate if factor == 1 else rate * factor
        return Update(parameter, gradient, *moments, lr=lr, step=self.updates[name] / views, decay=decay)

    def _waits(self, name: str, views: int) -> bool:
        """Return whether a parameter is paused; counts the views of the step."""
        left = self.paused.get(name, 0)
        if left:
            self.paused[name] = max(left - views, 0)
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
    return _columns(value, value * rate.rest, parameter.shape[1:], parameter.dtype, parameter.device)


def decay_tensor(rate: Rate, parameter: Tensor) -> Tensor | None:
    """The decay that gives the gradient of `Rate.penalty`; None where there is no penalty."""
    if not rate.penalty or not parameter.numel():
        return None
    rest = 2 * rate.penalty / len(parameter)
    return _columns(0.0, rest, parameter.shape[1:], parameter.dtype, parameter.device)


@lru_cache(maxsize=64)
@torch.inference_mode(False)
def _columns(constant: float, rest: float, shape: torch.Size, dtype: torch.dtype, device: torch.device) -> Tensor:
    """One number per column of spherical harmonics [N, K, 3]: of the constant one, and of all others.

    Steps share the tensor: leave it as it is.
    """
    columns = torch.full(shape, rest, dtype=dtype, device=device)
    columns[:1].fill_(constant)
    return columns.flatten()


@dataclass
class TrainState:
    """The mutable state of a run.

    Attributes:
        scene: the scene as trained so far.
        seed: fixes every random choice of the run.
        step: iterations done.
        optimizer: Adam's moments.
        statistics: screen gradients collected for densification, by scene part.
        seconds: time spent training so far, over all sessions; without compiling kernels.
        records: numbers that an action keeps from one turn to the next, and which setup was carried out last, by name.
        means: running means of the parameters over the last steps of the run, see `AverageLast`.
        method: the name of what is trained, so that a checkpoint tells whose it is; None where nobody said.
        is_whole: whether it may be saved; not in the middle of a step or an edit.
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
    is_whole: bool = True

    def generator(self, purpose: str) -> torch.Generator:
        """A random generator for one purpose at this step.

        It depends on the seed, the step and the purpose alone, so that a resumed run draws the same numbers, and is
        for tensors on the scene's device; each kind of device has numbers of its own.
        """
        key = zlib.crc32(f"{self.seed}/{self.step}/{purpose}".encode())
        return torch.Generator(self.scene.primary.means.device).manual_seed(key)

    def to(self, device: torch.device | str) -> TrainState:
        """The same state on another device."""
        moments = {
            name: (first.to(device), second.to(device)) for name, (first, second) in self.optimizer.moments.items()
        }
        statistics = {
            part: ScreenStatistics(**{name: tensor.to(device) for name, tensor in vars(known).items()})
            for part, known in self.statistics.items()
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
        """Return whether this step is one of those that lie at these shares of the run."""
        return self.step in {round(share * self.iterations) for share in shares}


@dataclass(frozen=True)
class Every:
    """A recurring moment, in shares of the run, so that shortening a run keeps its shape.

    Attributes:
        share: distance between two occurrences.
        start, stop: first and last moment at which one may happen; `start` itself is not one.
        least: smallest distance in iterations, below which results suffer however short the run.
        skip_multiples_of: leave out every n-th occurrence (for interleaving two events).
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
        """Return whether the moment is now."""
        count, remainder = divmod(clock.step, self.interval(clock))
        if remainder or not self.start * clock.iterations < clock.step <= self.stop * clock.iterations:
            return False
        if self.skip_multiples_of and count % self.skip_multiples_of == 0:
            return False
        return not self.only_multiples_of or count % self.only_multiples_of == 0


MOST_TRIED = 1000
"""Lengths that are tried when one is looked for in which every stage has a step."""

Work = Generator[Working, None, bool]
"""An edit that tells how far it is, and whether there was anything to edit in the end."""


def carried_out(edit: Work | bool | None) -> Work:
    """Follows an edit of the state that may tell how far it is, as long ones do, or be done at once."""
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
        """Edits `state`; False where there was nothing to edit. What may take seconds tells how far it is."""
        ...


@dataclass(frozen=True)
class AtMoments:
    """Base of actions that are due a few times in a run.

    Attributes:
        moments: shares of the run at which to act.
    """

    moments: tuple[float, ...]

    def due(self, clock: Clock) -> bool:
        """Return whether to act after this step."""
        return clock.is_at(self.moments)


class PostStep(Protocol):
    """A change of values that belongs to every step, like the noise of Langevin dynamics; no message reports it."""

    def __call__(self, state: TrainState, clock: Clock, visible: Tensor | None) -> None:
        """Edits `state`.

        Args:
            state: after the optimiser's step.
            clock: where the run stands.
            visible: [N] bool, which primary Gaussians the step's view showed, also as mirror images; all if None.
        """
        ...


class Setup(Protocol):
    """Prepares the state when a stage begins (fitting planes, adding an environment)."""

    def __call__(self, state: TrainState, dataset: Dataset) -> Work | None:
        """Edits `state`; what may take seconds tells how far it is."""
        ...


@dataclass(frozen=True)
class Stage:
    """One stage of a recipe.

    Attributes:
        name: for the log.
        share: length as a share of the run; a recipe's shares add up to one.
        renderer: what turns the scene into an image.
        losses: terms of the objective.
        rates: learning rate of every parameter that learns; one that is missing is frozen.
        actions: recurring edits, in the order in which they act.
        post_steps: what follows the optimiser at every step, before the actions.
        setup: what to do once when the stage begins.
        densify_until: share of the run until which screen gradients are collected, for whoever densifies by them.
        until: whether the stage is over before its share is; the next one then begins at once. Asked before every step.
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
    until: Callable[[TrainState], bool] | None = None

    def __post_init__(self) -> None:
        names = [term.name for term in self.losses]
        if len(set(names)) < len(names):
            raise ValueError(f"the stage {self.name!r} has the loss terms {names}; expected another name for each")

    def is_over(self, state: TrainState) -> bool:
        """Return whether the stage ends early."""
        return self.until is not None and self.until(state)


def stage_starts(stages: tuple[Stage, ...], iterations: int) -> list[int]:
    """The first step of each stage, and the end of the run last."""
    total = sum(stage.share for stage in stages)
    starts, passed = [], 0.0
    for stage in stages:
        starts.append(round(passed / total * iterations))
        passed += stage.share
    return [*starts, iterations]


def check_length(stages: tuple[Stage, ...], iterations: int) -> None:
    """Refuse a run in which a stage falls out, because it is too short or the stage has no share of it.

    Raises:
        InputError: names the stage, and how many iterations do.
    """
    missed = missed_stages(stages, iterations)
    if not missed:
        return
    name, share = missed[0].name, missed[0].share / sum(stage.share for stage in stages)
    if share <= 0:
        raise InputError(f"the stage {name!r} has no share of the run, but begins with what the next ones need")
    likely = itertools.islice(itertools.count(max(iterations, math.ceil(0.5 / share))), MOST_TRIED)
    enough = next((length for length in likely if not missed_stages(stages, length)), math.ceil(2 / share))
    raise InputError(f"{iterations} iterations leave no room for the stage {name!r}; expected at least {enough}")


def missed_stages(stages: tuple[Stage, ...], iterations: int) -> list[Stage]:
    """The stages without a single step; one without a share that begins with nothing is meant to have none."""
    starts = stage_starts(stages, iterations)
    spans = zip(stages, starts[:-1], starts[1:], strict=True)
    return [stage for stage, start, end in spans if start >= end and (stage.share > 0 or stage.setup is not None)]


LONGEST_SHARE = 0.1
"""Share of the run over which the mean may reach, because a short run still changes much during its last pass."""
STEPS = "averaged steps"


@dataclass(frozen=True)
class AverageLast:
    """Gives the scene, at the end of the run, the mean of its parameters over the last passes over the views.

    Each step pulls the scene towards one view, and learning rates are high to the end; the mean over a pass has no
    favourite view (averaged gradient descent: Polyak and Juditsky 1992; not in the papers).

    Attributes:
        passes: over the training views; 0 keeps the parameters of the last step.
    """

    passes: float

    def __call__(self, state: TrainState, clock: Clock, visible: Tensor | None) -> None:
        """Edits `state`; should the set of Gaussians change meanwhile, the mean begins anew."""
        length = min(round(self.passes * clock.views), int(LONGEST_SHARE * clock.iterations))
        if clock.step <= clock.iterations - length:
            return
        parameters = state.scene.parameters()
        shapes, known = ({name: t.shape for name, t in tensors.items()} for tensors in (parameters, state.means))
        if shapes != known or STEPS not in state.records:
            state.means = {name: tensor.detach().clone() for name, tensor in parameters.items()}
            state.records[STEPS] = 0
        state.records[STEPS] += 1
        for name, tensor in parameters.items():
            state.means[name].lerp_(tensor.detach(), 1 / state.records[STEPS])
        if clock.step == clock.iterations:
            state.scene, state.means = state.scene.with_parameters(state.means), {}
            del state.records[STEPS]
