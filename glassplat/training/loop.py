"""The training loop; it knows stages, losses and actions, and no method by name."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from glassplat.captures.dataset import Dataset, with_corrected_cameras
from glassplat.captures.view import View
from glassplat.kernels.screen_statistics import Views
from glassplat.render.frame import Frame, ScreenPass, SpacePass
from glassplat.scene.camera import constant
from glassplat.scene.scene import Scene
from glassplat.training.densify import ScreenStatistics
from glassplat.training.messages import ActionDone, Message, StageEntered, StepDone
from glassplat.training.stage import Clock, Stage, TrainState, carried_out, rate_tensor, stage_starts


class TrainingDivergedError(FloatingPointError):
    """A loss term became NaN or infinite."""


class NoGaussiansError(TrainingDivergedError):
    """There is nothing to train: no Gaussians, or none that a view shows."""


WHERE_TO_LOOK = (
    "Expected cameras that look at the points: check their poses and focal lengths, and whether the points are those "
    "of this capture; photographs of a few pixels (--downscale) or high learning rates end like this too"
)


class Differentiated(NamedTuple):
    """One view's losses and their gradients; of each pass on screen those of its centres and of its probe.

    `space` and `visible` are the frame's.
    """

    losses: dict[str, float]
    gradients: dict[str, Tensor]
    screen: list[tuple[ScreenPass, Tensor, Tensor]]
    space: tuple[SpacePass, ...]
    visible: Tensor | None


def train(stages: tuple[Stage, ...], dataset: Dataset, state: TrainState, iterations: int) -> Iterator[Message]:
    """Trains until `iterations`, from wherever `state` stands.

    `state` is edited in place and is consistent whenever `StepDone` or an `ActionDone` after it is out, so a consumer
    may save it or stop iterating there; training goes on later from a saved state with the same result.

    Args:
        stages: the recipe's stages.
        dataset: photographs to fit.
        state: initial or resumed state.
        iterations: length of the whole run, over which all schedules stretch.

    Yields:
        `StageEntered`, `StepDone`, `ActionDone` and `Working` messages.

    Raises:
        TrainingDivergedError: a loss is not finite; names the term, the step and the view.
        NoGaussiansError: nothing is left, or nothing is in sight of any view.
    """
    check_population(state)
    visibility = VisibilityCheck(len(dataset.train))
    starts = stage_starts(stages, iterations)
    for stage, start, end in zip(stages, starts, starts[1:], strict=False):
        if state.step >= end:
            continue
        if state.step == start:
            if stage.setup is not None:
                yield from carried_out(stage.setup(state, with_corrected_cameras(dataset, state.scene)))
            yield StageEntered(state.step, stage.name, counts_of(state.scene))
        while state.step < end:
            yield from advance(stage, dataset, state, iterations, visibility)


def advance(
    stage: Stage, dataset: Dataset, state: TrainState, iterations: int, visibility: VisibilityCheck
) -> Iterator[Message]:
    """One optimisation step and the actions that are due after it."""
    view = scheduled_view(dataset, state)
    result = differentiate(stage, state.scene, view, probed=state.step < stage.densify_until * iterations)
    check_losses(result.losses, state.step + 1, view)
    visibility.note(result.visible, state.step)
    update(stage, state, result.gradients, iterations)
    collect_statistics(state, result.screen, view)
    collect_in_space(state, result)
    state.step += 1
    clock = Clock(state.step, iterations, len(dataset.train))
    for post_step in stage.post_steps:
        post_step(state, clock, result.visible)
    done = []
    for action in stage.actions:
        if not action.due(clock):
            continue
        if (yield from carried_out(action.apply(state, with_corrected_cameras(dataset, state.scene), clock))):
            done.append(action)
    check_population(state)
    yield StepDone(state.step, view.name, sum(result.losses.values()), result.losses, counts_of(state.scene))
    for action in done:
        yield ActionDone(state.step, action.name, counts_of(state.scene))


def check_losses(losses: Mapping[str, float], step: int, view: View) -> None:
    """Ends training at the first loss that is not finite."""
    for name, value in losses.items():
        if not math.isfinite(value):
            raise TrainingDivergedError(
                f"loss term {name!r} is {value} at step {step} in view {view.name!r}; expected a finite number. Lower "
                "the learning rates, or look for broken poses or images near that view"
            )


def check_population(state: TrainState) -> None:
    """Ends training when there is nothing left to train."""
    if not len(state.scene.primary):
        raise NoGaussiansError(
            f"no Gaussians are left after step {state.step}: all have become transparent, or lie where no view shows "
            f"them. {WHERE_TO_LOOK}"
        )


class VisibilityCheck:
    """Check that the views show anything at all.

    One view that shows no Gaussian learns nothing, and the run goes on; a whole pass of them is a broken capture. That
    is asked once a pass, so that no step has to wait for a GPU's answer.
    """

    def __init__(self, views: int) -> None:
        self._views, self._watched = views, 0
        self._seen: Tensor | bool = False

    def note(self, visible: Tensor | None, step: int) -> None:
        """Notes what the view of a step showed.

        Args:
            visible: [N] bool, which primary Gaussians it showed; None if that is not known.
            step: iterations done before it, from which follows where a pass begins.

        Raises:
            NoGaussiansError: no view of a whole pass showed any.
        """
        if step % self._views == 0:
            self._watched, self._seen = 0, False
        self._watched += 1
        self._seen = self._seen | (True if visible is None else visible.any())
        if self._watched == self._views and not bool(self._seen):
            raise NoGaussiansError(
                f"none of the {self._views} training views shows a Gaussian, up to step {step + 1}. {WHERE_TO_LOOK}"
            )


def scheduled_view(dataset: Dataset, state: TrainState) -> View:
    """The view of this step: every view once per pass, in an order drawn anew for each pass."""
    number, position = divmod(state.step, len(dataset.train))
    return dataset.train[order_of_views(len(dataset.train), state.seed, number)[position]]


@lru_cache(maxsize=8)
def order_of_views(count: int, seed: int, number: int) -> list[int]:
    """The order of so many views in one pass over them."""
    generator = torch.Generator().manual_seed(seed * 1_000_003 + number)
    order: list[int] = torch.randperm(count, generator=generator).tolist()
    return order


def differentiate(stage: Stage, scene: Scene, view: View, *, probed: bool) -> Differentiated:
    """Renders a view and returns the weighted losses with the gradients of all that learns.

    Those on screen come only if the view is `probed`.
    """
    leaves = {
        name: tensor.detach().requires_grad_()
        for name, tensor in scene.parameters().items()
        if name in stage.rates and tensor.numel() > 0
    }
    learning = scene.with_parameters(leaves)
    view = seen_from(view, learning)
    frame = stage.renderer(learning, view.camera, probed=probed)
    terms, weights = loss_terms(stage, frame, view, learning)
    tracked = [record for record in frame.screen if record.means2d.requires_grad and record.means2d.numel() > 0]
    centers, probes = [record.means2d for record in tracked], [record.probe for record in tracked]
    values = torch.stack([*terms.values()]) * weights
    # Of their sum, and not of the terms with the weights as `grad_outputs`: to check these, PyTorch imports SymPy.
    sums = [values.sum()] if values.requires_grad else []
    found = torch.autograd.grad(sums, [*leaves.values(), *centers, *probes], allow_unused=True)
    gradients = {name: g for name, g in zip(leaves, found[: len(leaves)], strict=True) if g is not None}
    on_screen = found[len(leaves) :]
    pulls = zip(tracked, on_screen[: len(tracked)], on_screen[len(tracked) :], strict=True)
    screen = [(s, v_means, v_probe) for s, v_means, v_probe in pulls if v_means is not None and v_probe is not None]
    losses = dict(zip(terms, values.tolist(), strict=True))
    return Differentiated(losses, gradients, screen, frame.space, frame.visible)


def seen_from(view: View, scene: Scene) -> View:
    """The view from where the scene says that its camera is; differentiable."""
    camera = scene.poses.corrected(view.camera, view.name, scene.extent)
    return view if camera is view.camera else view.with_camera(camera)


def loss_terms(stage: Stage, frame: Frame, view: View, scene: Scene) -> tuple[dict[str, Tensor], Tensor]:
    """Every loss term that applies to the view, and the weights of these terms, in the same order."""
    values = {term.name: term.function(frame, view, scene) for term in stage.losses}
    terms = {name: value for name, value in values.items() if value is not None}
    weights = tuple(term.weight for term in stage.losses if term.name in terms)
    return terms, constant(weights, frame.rgb.dtype, frame.rgb.device)


def update(stage: Stage, state: TrainState, gradients: Mapping[str, Tensor], iterations: int) -> None:
    """Steps the optimiser at the stage's learning rates."""
    parameters = state.scene.parameters()
    progress = state.step / iterations
    extent = state.scene.extent
    rates = {n: rate_tensor(stage.rates[n], parameters[n], progress, extent, iterations) for n in gradients}
    state.optimizer.step(parameters, gradients, rates)


def collect_statistics(state: TrainState, screen: list[tuple[ScreenPass, Tensor, Tensor]], view: View) -> None:
    """Adds the step's screen gradients to the statistics that densification reads."""
    size = view.camera.width, view.camera.height
    for record, v_means, v_probe in screen:
        known = statistics_of(state, record.part, v_means.shape[1], v_means.device)
        known.add(Views(v_means, v_probe, record.radii, *size, record.weight, record.direct))


def collect_in_space(state: TrainState, result: Differentiated) -> None:
    """Adds the step's gradients in space, of what rays met, to the statistics that densification reads."""
    for record in result.space:
        gradient = result.gradients.get(f"{record.part}.means")
        if gradient is not None:
            known = statistics_of(state, record.part, gradient.shape[0], gradient.device)
            known.add_in_space(gradient, record.distances)


def statistics_of(state: TrainState, part: str, count: int, device: torch.device) -> ScreenStatistics:
    """Statistics of a part of the scene; empty ones for so many Gaussians where none exist."""
    if part not in state.statistics:
        state.statistics[part] = ScreenStatistics.zeros(count, device=device)
    return state.statistics[part]


def counts_of(scene: Scene) -> dict[str, int]:
    """Number of Gaussians in each part, and of planes."""
    return {name: len(part) for name, part in scene.gaussian_sets().items()} | {"planes": len(scene.planes)}
