"""The training loop, independent of methods: it only uses stages, losses and actions."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from glassplat.captures.dataset import Dataset, with_corrected_cameras
from glassplat.captures.view import View
from glassplat.errors import join_names
from glassplat.kernels.screen_statistics import Views
from glassplat.render.frame import Frame, ScreenPass, TracedPass
from glassplat.scene.camera import constant, to_device
from glassplat.scene.panes import PANE_TENSORS, nearest_pixels
from glassplat.scene.scene import PARTS, Scene
from glassplat.training.densify import ScreenStatistics
from glassplat.training.messages import ActionDone, Message, StageEntered, StepDone
from glassplat.training.ranks import Ranks
from glassplat.training.stage import Clock, Stage, TrainState, decay_tensor, rate_tensor, run_edit, stage_starts


class TrainingDivergedError(FloatingPointError):
    """A loss term became NaN or infinite."""


class NoGaussiansError(TrainingDivergedError):
    """There are no Gaussians, or none that a view shows."""


ENTERED_STAGE = "set up"
"""Key of `TrainState.records`: the scheduled first step of the last stage that was set up or began early."""
CAMERA_ADVICE = (
    "Expected cameras that look at the points: check their poses and focal lengths, and whether the points are those "
    "of this capture; photographs of a few pixels (--downscale) or high learning rates end like this too"
)


class ViewGradients(NamedTuple):
    """Losses of a view and their gradients. Screen passes have those of the centres and of `absgrad`, ray-traced
    passes those of `contributions`. `visible` is that of the frame.
    """

    losses: dict[str, float]
    gradients: dict[str, Tensor]
    screen: list[tuple[ScreenPass, Tensor, Tensor]]
    traced: list[tuple[TracedPass, Tensor]]
    visible: Tensor | None


class StepGradients(NamedTuple):
    """Losses, gradients and statistics of all views of a step, from all ranks.

    Attributes:
        losses: losses of each view.
        gradients: means over the views.
        statistics: sums over the views, by scene part; empty for a view alone.
        visible: [N] bool, primary Gaussians that any view showed; None if unknown.
    """

    losses: list[dict[str, float]]
    gradients: dict[str, Tensor]
    statistics: dict[str, ScreenStatistics]
    visible: Tensor | None


def train(
    stages: tuple[Stage, ...], dataset: Dataset, state: TrainState, iterations: int, *, ranks: Ranks | None = None
) -> Iterator[Message]:
    """Trains from the step of `state` to `iterations`.

    `state` is edited in place. It is consistent after each `StageEntered`, `StepDone` and `ActionDone`, where a
    consumer may save it or stop iterating; training can continue later with the same result.

    Args:
        stages: the recipe's stages.
        dataset: photographs to fit.
        state: initial or resumed state.
        iterations: length of the whole run in views, with which all schedules scale.
        ranks: processes that train together with the same state; by default only this one.

    Yields:
        `StageEntered`, `StepDone`, `ActionDone` and `Working` messages.

    Raises:
        TrainingDivergedError: a loss is not finite; the message names term, step and view.
        NoGaussiansError: no Gaussians are left, or none are visible in any view.
        RankLostError: another rank has ended; the state is that after the last `StepDone`, or `ActionDone` after it.
    """
    ranks = ranks or Ranks()
    check_has_gaussians(state)
    visibility = VisibilityCheck(len(dataset.train))
    starts, ended_early = stage_starts(stages, iterations), False
    for stage, start, end in zip(stages, starts, starts[1:], strict=False):
        if state.step >= end:
            continue
        is_new = state.records.get(ENTERED_STAGE) != start
        if state.step == start or (ended_early and is_new):
            if is_new and (ended_early or stage.setup is not None):
                state.is_consistent = False
                if stage.setup is not None:
                    yield from run_edit(stage.setup(state, with_corrected_cameras(dataset, state.scene)))
                state.records[ENTERED_STAGE] = start
                state.is_consistent = True
                ranks.synchronise(state)
            check_rates(stage, state.scene)
            yield StageEntered(state.step, stage.name, counts_of(state.scene))
        while state.step < end and not (stage.is_finished is not None and stage.is_finished(state)):
            upcoming = scheduled_views(dataset, state, (1 + dataset.memory.ahead) * ranks.batch)
            for view in upcoming[ranks.rank :: ranks.count]:
                view.read_ahead()
            views = scheduled_views(dataset, state, min(ranks.batch, end - state.step))
            yield from run_step(stage, dataset, state, iterations, views, ranks, visibility)
        ended_early = state.step < end


def run_step(
    stage: Stage,
    dataset: Dataset,
    state: TrainState,
    iterations: int,
    views: Sequence[View],
    ranks: Ranks,
    visibility: VisibilityCheck,
) -> Iterator[Message]:
    """One optimisation step of a batch of views, and the actions due after it."""
    losses, visible = take_step(stage, state, iterations, views, ranks, visibility)
    clocks = [
        Clock(step + 1, iterations, len(dataset.train), batch=len(views))
        for step in range(state.step, state.step + len(views))
    ]
    state.step += len(views)
    for post_step in stage.post_steps:
        post_step(state, clocks[-1], visible)
    due = [(clock, action) for clock, action in itertools.product(clocks, stage.actions) if action.due(clock)]
    done = []
    for clock, action in due:
        if (yield from run_edit(action.apply(state, with_corrected_cameras(dataset, state.scene), clock))):
            done.append(action)
    check_has_gaussians(state)
    state.is_consistent = True
    names = ", ".join(view.name for view in views)
    yield StepDone(state.step, names, sum(losses.values()), losses, counts_of(state.scene))
    for action in done:
        yield ActionDone(state.step, action.name, counts_of(state.scene))
    if due:
        # Even if nothing was done: another rank may have rounded differently.
        ranks.synchronise(state)


def take_step(
    stage: Stage, state: TrainState, iterations: int, views: Sequence[View], ranks: Ranks, visibility: VisibilityCheck
) -> tuple[dict[str, float], Tensor | None]:
    """Updates parameters and statistics by a batch of views, of which each rank renders its own.

    Returns the mean losses, and [N] bool: primary Gaussians that any view showed, None if unknown. Until all checks are
    passed, `state` is unchanged; from then on it is inconsistent.
    """
    with_records = state.step < stage.densify_until * iterations
    own = views[ranks.rank :: ranks.count]
    results = [differentiate(stage, state.scene, view, with_records=with_records) for view in own]
    is_alone = len(views) == ranks.count == 1
    if is_alone:
        step = StepGradients([results[0].losses], results[0].gradients, {}, results[0].visible)
    else:
        step = sum_views(state.scene, views, results, ranks)
    for number, (view, losses) in enumerate(zip(views, step.losses, strict=True), 1):
        check_losses(losses, state.step + number, view)
    visibility.record(step.visible, state.step, len(views))
    state.is_consistent = False
    update_parameters(stage, state, step.gradients, iterations, batch=len(views))
    if is_alone:  # Added directly, without separate sums.
        collect_statistics(state.statistics, results[0], own[0])
    for part, added in step.statistics.items():
        statistics_of(state.statistics, part, added.view_count.shape[1], added.view_count.device).merge(added)
    return mean_losses(step.losses), step.visible


def sum_views(scene: Scene, views: Sequence[View], results: Sequence[ViewGradients], ranks: Ranks) -> StepGradients:
    """Losses, gradients and statistics of all views of a step; `results` are those of the views of this rank."""
    statistics: dict[str, ScreenStatistics] = {}
    for view, result in zip(views[ranks.rank :: ranks.count], results, strict=True):
        collect_statistics(statistics, result, view)
    exchanged = ranks.exchange((list(statistics), [(r.losses, set(r.gradients), r.visible is None) for r in results]))
    # Rank r renders the views r, r + count, ...
    of_views = [exchanged[i % ranks.count][1][i // ranks.count] for i in range(len(views))]
    parts = dict.fromkeys(part for known, _ in exchanged for part in known)
    names = [name for name in scene.parameters() if any(name in learning for _, learning, _ in of_views)]
    step = sum_over_ranks(scene, results, {part: statistics.get(part) for part in parts}, names, ranks)
    gradients = {name: gradient / len(views) for name, gradient in step.gradients.items()}
    visible = None if any(unknown for _, _, unknown in of_views) else step.visible
    return StepGradients([losses for losses, _, _ in of_views], gradients, step.statistics, visible)


def sum_over_ranks(
    scene: Scene,
    results: Sequence[ViewGradients],
    statistics: Mapping[str, ScreenStatistics | None],
    names: Sequence[str],
    ranks: Ranks,
) -> StepGradients:
    """Sums over all ranks of the gradients and statistics of the named parameters and parts."""
    parameters, sets = scene.parameters(), scene.gaussian_sets()
    gradients = [sum_gradients([r.gradients[n] for r in results if n in r.gradients], parameters[n]) for n in names]
    empty = {part: ScreenStatistics.zeros(len(sets[part]), device=sets[part].means.device) for part in statistics}
    known = [of_part or empty[part] for part, of_part in statistics.items()]
    shown = torch.zeros_like(scene.primary.logit_opacities)
    for result in results:
        shown = shown if result.visible is None else torch.maximum(shown, result.visible.to(shown.dtype))
    sums = ranks.reduce("SUM", [*gradients, *(total for one in known for total in one)])
    (shown,) = ranks.reduce("MAX", [shown])
    of_parts = iter(sums[len(names) :])
    found = {part: ScreenStatistics(next(of_parts), next(of_parts), next(of_parts)) for part in statistics}
    return StepGradients([], dict(zip(names, sums[: len(names)], strict=True)), found, shown > 0)


def sum_gradients(gradients: Sequence[Tensor], parameter: Tensor) -> Tensor:
    """Sum of a parameter's gradients over views, possibly none."""
    return sum(gradients[1:], gradients[0]) if gradients else torch.zeros_like(parameter)


def mean_losses(losses: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Mean of each term over the views of a step; terms that do not apply to a view count as 0."""
    names = dict.fromkeys(name for of_view in losses for name in of_view)
    return {name: sum(of_view.get(name, 0.0) for of_view in losses) / len(losses) for name in names}


def check_losses(losses: Mapping[str, float], step: int, view: View) -> None:
    """Ends training at the first loss that is not finite."""
    for name, value in losses.items():
        if not math.isfinite(value):
            raise TrainingDivergedError(
                f"loss term {name!r} is {value} at step {step} in view {view.name!r}; expected a finite number. Lower "
                "the learning rates, or look for broken poses or images near that view"
            )


def check_has_gaussians(state: TrainState) -> None:
    """Ends training when there is nothing left to train."""
    if not len(state.scene.primary):
        raise NoGaussiansError(
            f"no Gaussians are left after step {state.step}: all have become transparent, or lie where no view shows "
            f"them. {CAMERA_ADVICE}"
        )


class VisibilityCheck:
    """Check that the views show any Gaussians.

    A single view without Gaussians is tolerated; a whole pass of them means a broken capture. This is checked once per
    pass, so that steps need not synchronise with the GPU.
    """

    def __init__(self, views: int) -> None:
        self._views, self._recorded, self._pass = views, 0, -1
        self._is_any_visible: Tensor | bool = False

    def record(self, visible: Tensor | None, step: int, count: int = 1) -> None:
        """Records what the views of a step showed.

        Args:
            visible: [N] bool, primary Gaussians that they showed; None if unknown.
            step: iterations done before it, which determine the start of a pass.
            count: number of views.

        Raises:
            NoGaussiansError: no view of a whole pass showed any.
        """
        if step // self._views != self._pass:
            self._recorded, self._is_any_visible, self._pass = 0, False, step // self._views
        self._recorded += count
        self._is_any_visible = self._is_any_visible | (True if visible is None else visible.any())
        if self._recorded >= self._views and not bool(self._is_any_visible):
            raise NoGaussiansError(
                f"none of the {self._views} training views shows a Gaussian, up to step {step + count}. {CAMERA_ADVICE}"
            )


def scheduled_views(dataset: Dataset, state: TrainState, count: int) -> list[View]:
    """The next views: every view once per pass, in a new random order for each pass."""
    views = dataset.train
    positions = (divmod(step, len(views)) for step in range(state.step, state.step + count))
    return [views[view_order(len(views), state.seed, passes)[position]] for passes, position in positions]


@lru_cache(maxsize=8)
def view_order(count: int, seed: int, passes: int) -> list[int]:
    """Random order of the views in the pass after `passes` others."""
    generator = torch.Generator().manual_seed(seed * 1_000_003 + passes)
    order: list[int] = torch.randperm(count, generator=generator).tolist()
    return order


def differentiate(stage: Stage, scene: Scene, view: View, *, with_records: bool) -> ViewGradients:
    """Renders a view; returns the weighted losses and the gradients of all learned parameters.

    Gradients of passes are included only `with_records`.
    """
    leaves = {
        name: tensor.detach().requires_grad_()
        for name, tensor in scene.parameters().items()
        if name in stage.rates and tensor.numel() > 0
    }
    learning = scene.with_parameters(leaves)
    camera = learning.poses.correct(view.camera, view.name, learning.extent)
    view = view if camera is view.camera else view.with_camera(camera)
    frame = stage.renderer(learning, view.camera, with_records=with_records)
    terms, weights = loss_terms(stage, frame, view, learning)
    tracked = [record for record in frame.screen if record.means2d.requires_grad and record.means2d.numel() > 0]
    centers, absgrads = [record.means2d for record in tracked], [record.absgrad for record in tracked]
    values = torch.stack([*terms.values()]) * weights
    # Of their sum, not of the terms with weights as `grad_outputs`, for which PyTorch imports SymPy.
    sums = [values.sum()] if values.requires_grad else []
    inputs = ([*leaves.values()], centers, absgrads, [record.contributions for record in frame.traced])
    gradient = iter(torch.autograd.grad(sums, [*itertools.chain(*inputs)], allow_unused=True))
    v_leaves, v_centers, v_absgrads, v_contributions = ([*itertools.islice(gradient, len(some))] for some in inputs)
    gradients = {name: g for name, g in zip(leaves, v_leaves, strict=True) if g is not None}
    passes = zip(tracked, v_centers, v_absgrads, strict=True)
    screen = [(record, v_means, v) for record, v_means, v in passes if v_means is not None and v is not None]
    traced = [(record, v) for record, v in zip(frame.traced, v_contributions, strict=True) if v is not None]
    losses = dict(zip(terms, values.tolist(), strict=True))
    return ViewGradients(losses, gradients, screen, traced, frame.visible)


def loss_terms(stage: Stage, frame: Frame, view: View, scene: Scene) -> tuple[dict[str, Tensor], Tensor]:
    """All loss terms that apply to the view, and their weights, in the same order."""
    values = {term.name: term.function(frame, view, scene) for term in stage.losses}
    terms = {name: value for name, value in values.items() if value is not None}
    for name, value in terms.items():
        if not isinstance(value, Tensor) or value.dim():
            found = f"shape {list(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
            raise ValueError(f"the loss term {name!r} gave {found}; expected a tensor of one number, or None")
    weights = tuple(term.weight for term in stage.losses if term.name in terms)
    return terms, constant(weights, frame.rgb.dtype, frame.rgb.device)


def update_parameters(
    stage: Stage, state: TrainState, gradients: Mapping[str, Tensor], iterations: int, *, batch: int = 1
) -> None:
    """Steps the optimiser at the stage's learning rates, with gradients averaged over the batch."""
    parameters = state.scene.parameters()
    progress = state.step / iterations
    extent = state.scene.extent
    rates = {n: rate_tensor(stage.rates[n], parameters[n], progress, extent, iterations) for n in gradients}
    decays = {n: decay for n in gradients if (decay := decay_tensor(stage.rates[n], parameters[n])) is not None}
    state.optimizer.step(parameters, gradients, rates, decays=decays, batch=batch)


def collect_statistics(statistics: dict[str, ScreenStatistics], result: ViewGradients, view: View) -> None:
    """Adds a view's screen gradients, and those of ray-traced Gaussians, to the densification statistics."""
    size = view.camera.width, view.camera.height
    for record, v_means, v_absgrad in result.screen:
        known = statistics_of(statistics, record.part, v_means.shape[1], v_means.device)
        known.add(Views(v_means, v_absgrad, valid_radii(record, view), *size, record.weight, record.direct))
    for traced, v_contributions in result.traced:
        gradient = result.gradients.get(f"{traced.part}.means")
        if gradient is not None:
            known = statistics_of(statistics, traced.part, gradient.shape[0], gradient.device)
            known.add_traced(gradient, v_contributions)


def valid_radii(record: ScreenPass, view: View) -> Tensor:
    """The radii [C, N, 2] of a pass, 0 if the centre is on an ignored pixel."""
    if view.ignored is None:
        return record.radii
    pixels = nearest_pixels(record.means2d.detach().flatten(0, 1), view.camera)
    ignored = to_device(view.ignored, record.radii.device)[pixels].view(record.radii.shape[:2])
    return record.radii.masked_fill(ignored[..., None], 0)


def statistics_of(
    statistics: dict[str, ScreenStatistics], part: str, count: int, device: torch.device
) -> ScreenStatistics:
    """Statistics of a part of the scene; new, empty ones if none exist."""
    if part not in statistics:
        statistics[part] = ScreenStatistics.zeros(count, device=device)
    return statistics[part]


def check_rates(stage: Stage, scene: Scene) -> None:
    """Check that a stage has learning rates of parameters of the scene only; a part that it lacks may appear later.

    Raises:
        ValueError: a name is unknown, and what it is meant for would not be learned.
    """
    known = [*scene.parameters(), *(f"planes.{name}" for name in PANE_TENSORS)]
    absent = set(PARTS) - {name.partition(".")[0] for name in known}
    wrong = [name for name in stage.rates if name not in known and name.partition(".")[0] not in absent]
    if wrong:
        raise ValueError(f"stage {stage.name} has rates of {join_names(wrong)}; expected some of {', '.join(known)}")


def counts_of(scene: Scene) -> dict[str, int]:
    """Number of Gaussians in each part, and of planes."""
    return {name: len(part) for name, part in scene.gaussian_sets().items()} | {"planes": len(scene.planes)}
