"""Recurring edits of the training state, and the strategies that combine them."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from glassplat.captures.dataset import Dataset
from glassplat.captures.view import PointCloud, View, sample_evenly
from glassplat.render.frame import Renderer
from glassplat.render.layers import contributions, window_means
from glassplat.scene.camera import Camera, to_device
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.panes import crosses_pane, in_image, nearest_pixels
from glassplat.scene.scene import Scene
from glassplat.training import densify, losses
from glassplat.training.messages import Working
from glassplat.training.options import DefaultDensify, Intervals, McmcDensify, Rate
from glassplat.training.stage import RESET_TURN, Action, AtShares, Clock, Every, PostStep, TrainState, Work

log = logging.getLogger("glassplat.training")

PUBLISHED_THRESHOLD_PIXELS = 250_000
"""Size of photographs, in pixels, above which the published densification thresholds apply (lab/gaussians.md)."""
GAUSSIANS_PER_PIXEL = 0.5
"""Default cap of `McmcDensify`, in Gaussians per pixel; at 400x300, default densification ends near one."""
GROWTH_SHARE = 1 / 300
"""Share of the run over which `McmcDensify` grows by its factor: 100 of the published 30,000 iterations."""
PRUNE_LARGE_PARTS = ("primary", "surroundings")
"""Sets whose oversized Gaussians are removed; glass Gaussians may be as large as their pane."""
MOST_GROWTH = 2.0
"""Largest factor of one relocation, however short the run."""


@dataclass(frozen=True)
class GrowSh:
    """Raises the active SH degree by one, up to the stored degree."""

    when: Every
    part: str = "primary"
    name: str = "grow SH"

    def due(self, clock: Clock) -> bool:
        """Return whether to act after this step."""
        return self.when.due(clock)

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Edits `state` if necessary."""
        gaussians = state.scene.gaussian_sets().get(self.part)
        if gaussians is None or gaussians.active_sh_degree == gaussians.max_sh_degree:
            return False
        raised = replace(gaussians, active_sh_degree=gaussians.active_sh_degree + 1)
        state.scene = state.scene.with_gaussians(self.part, raised)
        return True


def threshold_factor(dataset: Dataset) -> float:
    """Factor on the densification threshold for small photographs; 1 from `PUBLISHED_THRESHOLD_PIXELS` on.

    The published threshold was chosen for photographs of about a megapixel. The loss is a mean over pixels, so a
    Gaussian a few pixels wide has a larger gradient in a smaller image; at 400x300, there would be twice as many
    Gaussians as pixels (lab/gaussians.md).
    """
    return max(1.0, math.sqrt(PUBLISHED_THRESHOLD_PIXELS / dataset.photograph_pixels))


def densify_cap(densifier: DefaultDensify, dataset: Dataset) -> int | None:
    """Maximum number of Gaussians: the requested one, or one that suits the photographs."""
    if densifier.cap is not None or densifier.per_pixel == 0:
        return densifier.cap
    return round(densifier.per_pixel * sum(view.camera.width * view.camera.height for view in dataset.train))


@dataclass(frozen=True)
class Densify:
    """Clones, splits and prunes one set of Gaussians by its screen gradients.

    Attributes:
        densifier: options.
        part: the set.
        mcmc: options of `mcmc`, if it follows and its cap already holds.
    """

    densifier: DefaultDensify
    part: str = "primary"
    mcmc: McmcDensify | None = None

    @property
    def name(self) -> str:
        """Name in the log."""
        return f"densify {self.part}"

    def due(self, clock: Clock) -> bool:
        """Return whether to act after this step."""
        least = self.densifier.interval
        if self.densifier.whole_passes:
            least = max(least, min(clock.views, 2 * least))
        return Every(0.0, self.densifier.start, self.densifier.stop, least).due(clock)

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Edits `state` if necessary."""
        statistics = state.statistics.pop(self.part, None)
        gaussians = state.scene.gaussian_sets().get(self.part)
        if statistics is None or gaussians is None or len(gaussians) == 0:
            return False
        factor = threshold_factor(dataset) if self.densifier.adapt_to_size else 1.0
        densifier = replace(
            self.densifier,
            cap=mcmc_cap(self.mcmc, dataset) if self.mcmc else densify_cap(self.densifier, dataset),
            gradient_threshold=self.densifier.gradient_threshold * factor,
            absgrad_threshold=self.densifier.absgrad_threshold * factor,
        )
        edited, moments = densify.densify(
            densifier,
            gaussians,
            state.optimizer.moments,
            statistics,
            extent=state.scene.extent,
            generator=state.generator(self.name),
            part=self.part,
            prune_large=self.part in PRUNE_LARGE_PARTS and clock.progress > self.densifier.prune_large_start,
        )
        replace_sorted(state, edited, moments, self.part)
        return True


LEAST_MIDAIR_SHARE = 1e-4
"""Minimum contribution, as a share of a view's pixels, of a Gaussian in mid-air or large for a camera."""


@dataclass(frozen=True)
class PruneIdle:
    """Removes the Gaussians of one set that contribute almost nothing to any training view, or surround a camera. The
    former include Gaussians behind a pane whose reflection is now explained by the mirrored image. Those in mid-air in
    front of a camera, or large for its distance, must contribute more to some view; see `gaussians_near_cameras`.

    Attributes:
        densifier: holds the threshold and the times.
        part: the set.
        measure: [N] contribution of each of its Gaussians to a view, in pixels.
    """

    densifier: DefaultDensify
    part: str = "primary"
    measure: Callable[[Scene, Camera], Tensor] = contributions

    @property
    def name(self) -> str:
        """Name in the log."""
        return f"prune idle {self.part}"

    def due(self, clock: Clock) -> bool:
        """Return whether to act after this step."""
        return self.densifier.least_contribution > 0 and clock.is_at(self.densifier.contribution_moments)

    @torch.no_grad()
    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> Work:
        """Edits `state` if necessary, and yields its progress."""
        gaussians = state.scene.gaussian_sets().get(self.part)
        if gaussians is None:
            return False
        largest, largest_share = (torch.zeros_like(gaussians.logit_opacities) for _ in range(2))
        for done, view in enumerate(dataset.train):
            yield Working("searching for unnecessary Gaussians", done, len(dataset.train))
            contribution = self.measure(state.scene, view.camera)
            largest = torch.maximum(largest, contribution)
            largest_share = torch.maximum(largest_share, contribution / (view.camera.width * view.camera.height))
        contributing = largest >= self.densifier.least_contribution
        if self.part == "primary":
            positions = torch.stack([view.camera.center for view in dataset.train])
            points = dataset.points.positions if dataset.measured_points else positions[:0]
            obstructing, suspect = densify.gaussians_near_cameras(gaussians, positions, points)
            contributing &= ~obstructing & (~suspect | (largest_share >= LEAST_MIDAIR_SHARE))
        # A scene without Gaussians is an error; surroundings that nothing reflects yet may still be needed.
        if bool(contributing.all()) or (self.part != "primary" and not bool(contributing.any())):
            return False
        keep_gaussians(state, contributing, self.part)
        return True


def replace_sorted(state: TrainState, gaussians: Gaussians, moments: densify.Moments, part: str = "primary") -> None:
    """Replaces a part of the scene and its moments, sorted in Morton order."""
    order = densify.morton_order(gaussians.means)
    ordered, moments = densify.apply_edit(gaussians, moments, order, part=part)
    state.scene = state.scene.with_gaussians(part, ordered)
    # An empty set has no parameters.
    known = state.scene.parameters()
    state.optimizer.moments = {name: pair for name, pair in moments.items() if name in known}
    state.means = {}  # The rows have changed, even if their number has not.


def mcmc_cap(densifier: McmcDensify, dataset: Dataset) -> int:
    """The cap: the requested number of Gaussians, or one that suits the photographs."""
    if densifier.cap is not None:
        return densifier.cap
    return round(GAUSSIANS_PER_PIXEL * dataset.photograph_pixels)


def growth_per_relocation(densifier: McmcDensify, iterations: int) -> float:
    """Growth factor per relocation, such that any run reaches its cap after the same share."""
    factor: float = densifier.growth ** (densifier.interval / (GROWTH_SHARE * iterations))
    return min(factor, MOST_GROWTH)


@dataclass(frozen=True)
class Relocate:
    """Moves dead primary Gaussians onto live ones and adds new ones (3DGS-MCMC)."""

    densifier: McmcDensify
    name: str = "densify primary"

    def due(self, clock: Clock) -> bool:
        """Return whether to act after this step."""
        return Every(0.0, self.densifier.start, self.densifier.stop, self.densifier.interval).due(clock)

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Edits `state` if necessary."""
        densifier = replace(self.densifier, growth=growth_per_relocation(self.densifier, clock.iterations))
        edited, moments = densify.relocate_and_grow(
            densifier,
            state.scene.primary,
            state.optimizer.moments,
            cap=mcmc_cap(self.densifier, dataset),
            generator=state.generator(self.name),
        )
        replace_sorted(state, edited, moments)
        # MCMC does not use screen gradients, but the statistics no longer match the rows.
        state.statistics.pop("primary", None)
        return True


@dataclass(frozen=True)
class AddNoise:
    """Adds noise to the positions of the primary Gaussians in view, most to transparent ones (3DGS-MCMC).

    The paper moves all Gaussians in every step (`densifier.reach`). Nothing pulls those outside the view back, so
    Gaussians that few views show would drift away.

    Attributes:
        densifier: holds the amplitude and the reach of the noise.
        rate: learning rate of the positions, to which the noise is proportional; both grow with the views per step.
    """

    densifier: McmcDensify
    rate: Rate

    def __call__(self, state: TrainState, clock: Clock, visible: Tensor | None) -> None:
        """Edits `state`."""
        primary, extent = state.scene.primary, state.scene.extent
        rate = self.rate.at(clock.progress, 1.0, clock.iterations) * math.sqrt(clock.batch)
        offsets = densify.sgld_noise(
            self.densifier, primary, rate=rate, extent=extent, generator=state.generator("explore")
        )
        if visible is not None and self.densifier.reach == "shown":
            offsets *= visible[:, None]
        state.scene = replace(state.scene, primary=primary.with_tensors({"means": primary.means + offsets}))


MOST_AVERAGED_SHARE = 0.1
"""Maximum share of the run to average over, because short runs still change much during their last pass."""
AVERAGED_STEPS = "averaged steps"


@dataclass(frozen=True)
class AverageLast:
    """Replaces the parameters at the end of the run by their mean over the last passes over the views.

    Each step pulls the scene towards one view, and learning rates are high to the end; the mean over a pass favours
    none (Polyak and Juditsky 1992; not in the papers).

    Attributes:
        passes: number of passes over the training views; 0 keeps the parameters of the last step.
    """

    passes: float

    def __call__(self, state: TrainState, clock: Clock, visible: Tensor | None) -> None:
        """Edits `state`; the mean restarts if the set of Gaussians changes."""
        length = min(round(self.passes * clock.views), int(MOST_AVERAGED_SHARE * clock.iterations))
        if clock.step <= clock.iterations - length:
            return
        parameters = state.scene.parameters()
        shapes, known = ({name: t.shape for name, t in tensors.items()} for tensors in (parameters, state.means))
        if shapes != known or AVERAGED_STEPS not in state.records:
            state.means = {name: tensor.detach().clone() for name, tensor in parameters.items()}
            state.records[AVERAGED_STEPS] = 0
        state.records[AVERAGED_STEPS] += 1
        for name, tensor in parameters.items():
            state.means[name].lerp_(tensor.detach(), 1 / state.records[AVERAGED_STEPS])
        if clock.step == clock.iterations:
            state.scene, state.means = state.scene.with_parameters(state.means), {}
            del state.records[AVERAGED_STEPS]


@dataclass(frozen=True)
class ResetOpacity:
    """Lowers the opacity of a set of Gaussians to a ceiling (3DGS)."""

    when: Every
    ceiling: float = 0.01
    part: str = "primary"
    name: str = "reset opacity"

    def due(self, clock: Clock) -> bool:
        """Return whether to act after this step."""
        return self.when.due(clock)

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Edits `state` if necessary."""
        gaussians = state.scene.gaussian_sets().get(self.part)
        if gaussians is None:
            return False
        lowered, state.optimizer.moments = densify.reset_opacity(
            gaussians, state.optimizer.moments, ceiling=self.ceiling, part=self.part
        )
        state.scene = state.scene.with_gaussians(self.part, lowered)
        return True


@dataclass(frozen=True)
class PerturbOpacity:
    """Adds noise to the opacities of Gaussians visible through a pane (TR-Gaussians, Section III-C3)."""

    when: Every
    amplitude: float
    bounds: tuple[float, float]
    name: str = "perturb opacity"

    def due(self, clock: Clock) -> bool:
        """Return whether to act after this step."""
        return self.amplitude > 0 and self.when.due(clock)

    @torch.no_grad()
    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> Work:
        """Edits `state` if necessary, and yields its progress."""
        means, planes = state.scene.primary.means, state.scene.planes
        selected = torch.zeros(len(means), dtype=torch.bool, device=means.device)
        for done, view in enumerate(dataset.train):
            yield Working("finding what is visible through panes", done, len(dataset.train))
            camera = view.camera.to(means.device)
            selected |= crosses_pane(means, planes, camera.center) & in_image(means, camera)
        perturbed = densify.perturb_opacities(
            state.scene.primary,
            selected,
            amplitude=self.amplitude,
            bounds=self.bounds,
            generator=state.generator(self.name),
        )
        state.scene = replace(state.scene, primary=perturbed)
        state.optimizer.moments = densify.zero_moments(state.optimizer.moments, ("primary.logit_opacities",), selected)
        return bool(selected.any())


@dataclass(frozen=True)
class DensificationStrategy:
    """Contribution of a strategy to every stage of a recipe.

    Attributes:
        opacity: opacity of the initial Gaussians.
        spread: standard deviation of the initial Gaussians, as a share of the distance to their neighbours.
        edits: actions that change the number of primary Gaussians.
        resets: opacity resets, in the stages that the recipe chooses.
        post_steps: operations after the optimiser in every step.
        terms: regularisers of the objective.
        densify_until: share of the run until which `edits` read screen gradients.
        cap: maximum number of initial Gaussians; None or 0 for no limit.
    """

    opacity: float = 0.1
    spread: float = 1.0
    edits: tuple[Action, ...] = ()
    resets: tuple[ResetOpacity, ...] = ()
    post_steps: tuple[PostStep, ...] = ()
    terms: tuple[losses.LossTerm, ...] = ()
    densify_until: float = 0.0
    cap: int | None = None

    def initial_gaussians(self, points: PointCloud, sh_degree: int) -> Gaussians:
        """Initial primary Gaussians, one per point; with a cap, a random subset that is the same in every run."""
        if self.cap and len(points) > self.cap:
            log.info("The first Gaussians are %d of the %d points, as many as the cap allows", self.cap, len(points))
            generator = torch.Generator().manual_seed(0)
            kept = torch.randperm(len(points), generator=generator)[: self.cap].to(points.colors.device)
            points = PointCloud(points.positions[kept], points.colors[kept])
        return densify.gaussians_from_points(points, sh_degree=sh_degree, opacity=self.opacity, spread=self.spread)


def default_strategy(densifier: DefaultDensify, intervals: Intervals) -> DensificationStrategy:
    """3DGS: clone, split, prune and reset opacities; finally remove Gaussians that contribute to no view."""
    reset = ResetOpacity(
        Every(intervals.opacity, 0.0, intervals.reset_stop, intervals.least, only_multiples_of=RESET_TURN)
    )
    edits = (Densify(densifier), PruneIdle(densifier))
    return DensificationStrategy(edits=edits, resets=(reset,), densify_until=densifier.stop, cap=densifier.cap)


MCMC_OPACITY = 0.5
"""Opacity of the initial Gaussians with `mcmc`."""


def mcmc_strategy(densifier: McmcDensify, means_rate: Rate) -> DensificationStrategy:
    """3DGS-MCMC: relocate, add, add noise, and regularise opacities and scales; opacities are never reset.

    The regularisers are those of TR-Gaussians, Eq. 20. They act on Gaussians that a step's view shows directly, and
    the noise also on those that it shows as mirror images. In the papers, both act on all Gaussians (`reach`). This
    hardly matters if every view shows most of the scene; in a room photographed all around, Gaussians that few views
    show would fade and drift.
    """

    def regulariser(term: losses.LossFunction) -> losses.LossFunction:
        if densifier.reach == "shown":
            return term
        return lambda frame, view, scene: term(replace(frame, direct=None), view, scene)

    terms = losses.weighted_terms(
        losses.LossTerm("opacity", densifier.opacity_weight, regulariser(losses.mean_opacity)),
        losses.LossTerm("scale", densifier.scale_weight, regulariser(losses.mean_scale)),
    )
    return DensificationStrategy(
        opacity=MCMC_OPACITY,
        spread=densifier.initial_spread,
        edits=(Relocate(densifier),),
        post_steps=(AddNoise(densifier, means_rate),) if densifier.noise_rate != 0 else (),
        terms=terms,
        cap=densifier.cap,
    )


LEAST_UNEXPLAINED, RESIDUAL_WINDOW = 0.1, 0.03
"""Mean residual, sRGB, above which more than detail is missing, and the side of its window as a share of the width."""
GRID_CELLS = 96
"""Grid cells along the longest side of the searched box."""
MOST_SEARCHED_PHOTOGRAPHS = 100
"""Maximum number of photographs used for the search."""
FEWEST_AGREEING_VIEWS, LEAST_AGREEING_SHARE, MOST_COLOR_DEVIATION, MOST_MEAN_DIRECTION = 5, 0.7, 0.08, 0.98
"""Minimum number of photographs with a residual at a cell; their minimum share of all that see it directly; maximum
standard deviation of its colour; and maximum length of the mean viewing direction, 1 if all are equal."""

MOST_ADDED_SHARE = 0.05
"""Maximum share of Gaussians to add; if more is missing, the scene has hardly been learned yet."""


@dataclass(frozen=True)
class SeedUnexplained(AtShares):
    """Adds Gaussians where several photographs agree on an object that the scene lacks.

    Densification only moves and copies existing Gaussians. A textureless object in open space, such as a lamp, has no
    points, and is found late or by chance (lab/gaussians.md). It is found here as the visual hull of the residuals.

    Attributes:
        renderer: renders the scene as in the photographs.
        cap: maximum number of Gaussians, beyond which none are added; None for no limit.
    """

    renderer: Renderer
    cap: int | None = None
    name: str = "seed unexplained"

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> Work:
        """Edits `state` if necessary, and yields its progress."""
        cloud, size = yield from unexplained_positions(state.scene, dataset.train, self.renderer)
        primary = state.scene.primary
        if not may_add(len(cloud), primary, self.cap):
            return False
        add_primary_gaussians(state, make_seeds(primary, cloud, opacity=0.5, size=size))
        log.info("Gaussians added where photographs agree on a missing object: %d", len(cloud))
        return True


def may_add(count: int, primary: Gaussians, cap: int | None) -> bool:
    """Return whether to add a number of Gaussians: some, few for a scene that is learned, and within the cap if any."""
    total = len(primary) + count
    return 0 < count < MOST_ADDED_SHARE * len(primary) and (cap is None or total <= cap)


def make_seeds(primary: Gaussians, points: PointCloud, *, opacity: float = 0.1, size: float | None = None) -> Gaussians:
    """Gaussians from points, like the primary ones; other channels get the median of these.

    Args:
        primary: the existing Gaussians.
        points: at least one.
        opacity: opacity of each.
        size: standard deviation of each; the distance between points if None.
    """
    seeds = densify.gaussians_from_points(points, sh_degree=primary.max_sh_degree, opacity=opacity)
    if size is not None:
        seeds = seeds.with_tensors({"log_scales": torch.full_like(seeds.log_scales, math.log(size))})
    seeds = seeds.to(primary.means.device)
    usual = {name: values.median().expand(len(seeds)).clone() for name, values in primary.channels.items()}
    channels = {name: seeds.channels.get(name, values) for name, values in usual.items()}
    return replace(seeds, active_sh_degree=primary.active_sh_degree, channels=channels)


def add_primary_gaussians(state: TrainState, seeds: Gaussians) -> None:
    """Adds Gaussians to the primary ones, whose moments and statistics are kept."""
    primary, state.optimizer.moments = densify.append(state.scene.primary, state.optimizer.moments, seeds)
    state.scene = replace(state.scene, primary=primary)
    if "primary" in state.statistics:
        state.statistics["primary"] = state.statistics["primary"].with_empty_rows(len(seeds))


def keep_gaussians(state: TrainState, kept: Tensor, part: str = "primary") -> None:
    """Removes the Gaussians where `kept` [N] is false; moments and statistics of the others are kept. Otherwise, a
    removal at the step of a densification would cancel it (lab/gaussians.md).
    """
    gaussians = state.scene.gaussian_sets()[part]
    gaussians, state.optimizer.moments = densify.apply_edit(
        gaussians, state.optimizer.moments, densify.keep(kept), part=part
    )
    state.scene = state.scene.with_gaussians(part, gaussians)
    if part in state.statistics:
        state.statistics[part] = state.statistics[part].select(kept)


@torch.no_grad()
def unexplained_positions(
    scene: Scene, views: Sequence[View], renderer: Renderer
) -> Generator[Working, None, tuple[PointCloud, float]]:
    """Positions where photographs agree on something that the scene lacks, and the size of Gaussians there.

    The search uses a grid around the cameras. Panes count as opaque, because their reflections would be found behind
    them.
    """
    views = sample_evenly(views, MOST_SEARCHED_PHOTOGRAPHS)
    device = scene.primary.means.device
    positions, cell = grid_around_cameras([view.camera for view in views], scene.extent)
    positions = positions.to(device)
    seeing_views, agreeing_views = positions.new_zeros(2, len(positions))
    color_sums, square_sums, direction_sums = positions.new_zeros(3, len(positions), 3)
    for done, view in enumerate(views):
        yield Working("searching for missing objects", done, len(views))
        camera = view.camera.to(device)
        rows = in_image(positions, camera).nonzero()[:, 0]
        in_view = positions[rows]
        pixels = nearest_pixels(camera.project(in_view)[0], camera)
        frame = renderer(scene, camera)
        visible = losses.valid_pixels(view, device)
        if (strength := frame.layers.get("strength")) is not None:
            visible = visible & (strength <= 0)
        visible = visible[pixels]
        visible &= ~crosses_pane(in_view, scene.planes, camera.center)
        error = losses.residual(frame, view, scene)
        reach = max(round(RESIDUAL_WINDOW / 2 * camera.width), 1)
        mean_error = window_means(error, torch.ones_like(error[..., 0]), reach)
        missing = (mean_error.abs().mean(dim=-1) > LEAST_UNEXPLAINED)[pixels] & visible
        photographed = scene.exposures.apply_inverse(to_device(view.photo, device)[pixels].float() / 255, view.name)
        color = photographed.clamp(0, 1) * missing[:, None]
        seeing_views[rows] += visible
        agreeing_views[rows] += missing
        color_sums[rows] += color
        square_sums[rows] += color.square()
        direction_sums[rows] += torch.nn.functional.normalize(camera.center - in_view, dim=1) * missing[:, None]
    mean = color_sums / agreeing_views.clamp(min=1)[:, None]
    spread = (square_sums / agreeing_views.clamp(min=1)[:, None] - mean.square()).clamp(min=0).mean(dim=1).sqrt()
    found = (agreeing_views >= FEWEST_AGREEING_VIEWS) & (agreeing_views >= LEAST_AGREEING_SHARE * seeing_views)
    found &= (spread < MOST_COLOR_DEVIATION) & (direction_sums.norm(dim=1) < MOST_MEAN_DIRECTION * agreeing_views)
    cloud = PointCloud(positions[found].cpu(), (255 * mean[found]).round().to(torch.uint8).cpu())
    return cloud, 0.6 * cell


def grid_around_cameras(cameras: Sequence[Camera], extent: float) -> tuple[Tensor, float]:
    """[P, 3] centres of the cells of a grid over a box around the cameras, one extent larger, and a cell's side.

    Its axes are those of the first camera, so that the result does not depend on the orientation of the world.
    """
    axes = cameras[0].cam_from_world[:3, :3].cpu()
    centers = torch.stack([camera.center.cpu() for camera in cameras]) @ axes.T
    low, high = centers.amin(dim=0) - extent, centers.amax(dim=0) + extent
    cell = float((high - low).amax()) / GRID_CELLS
    numbers = ((high - low) / cell).round().clamp(min=1).int().tolist()
    along = [
        start + cell * (torch.arange(number, dtype=torch.float32) + 0.5)
        for start, number in zip(low, numbers, strict=True)
    ]
    return torch.stack(torch.meshgrid(*along, indexing="ij"), dim=-1).reshape(-1, 3) @ axes, cell
