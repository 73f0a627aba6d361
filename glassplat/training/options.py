"""Options that several methods share: learning rates, the schedule of densification, mirrors, photographs."""

from __future__ import annotations

import importlib
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import tyro

from glassplat.options import (
    ESSENTIAL,
    Ascending,
    Color,
    Count,
    Internal,
    LearningRate,
    NonNegative,
    OpenShare,
    Positive,
    PositiveCount,
    PositiveShare,
    Range,
    Share,
    ShDegree,
)

if TYPE_CHECKING:
    from glassplat.captures.dataset import Dataset
    from glassplat.captures.files import CaptureFiles
    from glassplat.render.frame import Renderer
    from glassplat.scene.scene import Scene
    from glassplat.training.stage import Stage

PUBLISHED_ITERATIONS = 30_000
"""Length of the runs for which 3DGS chose its learning rates, which TR-Gaussians adopted."""
FASTEST_ITERATIONS = 3_000
"""Runs shorter than this use its learning rates: higher ones were not measured."""


@dataclass(frozen=True)
class Rate:
    """A learning rate over the run.

    Attributes:
        start: rate at the first iteration.
        end: rate that it decays to exponentially; None keeps `start`.
        decay: share of the run at which `end` is reached.
        per_extent: multiply by the scene extent (for positions).
        rest: factor for every SH coefficient but the constant one; only for `sh`.
        penalty: weight in the loss of the mean square, over the Gaussians, of the coefficients that `rest` scales.
        short_run_power: in a run of n < 30,000 iterations, the rate is multiplied by (30,000 / n) to this power, with n
            at least `FASTEST_ITERATIONS`, because Adam changes a parameter by about its rate in every step, however
            small the gradient.
    """

    start: float
    end: float | None = None
    decay: float = 1.0
    per_extent: bool = False
    rest: float | None = None
    penalty: float = 0.0
    short_run_power: float = 0.0

    def at(self, progress: float, extent: float, iterations: int = PUBLISHED_ITERATIONS) -> float:
        """The rate at a progress in [0, 1] of a run of this length."""
        length = min(max(iterations, FASTEST_ITERATIONS), PUBLISHED_ITERATIONS)
        scale = (PUBLISHED_ITERATIONS / length) ** self.short_run_power
        if self.per_extent:
            scale *= extent
        if self.end is None or self.start == 0:
            return self.start * scale
        decayed = min(progress / self.decay, 1.0)
        return float(self.start ** (1 - decayed) * self.end**decayed * scale)


MEANS_END = 1.6e-6
"""Learning rate of positions at the end of a run, per scene extent."""


@dataclass(frozen=True)
class GaussianRates:
    """Learning rates of a set of Gaussians (3DGS).

    Attributes:
        means: positions, in scene extents, at the start of the run; decays to 1.6e-6.
        decay: share of the run at which that value is reached.
        sh: constant SH coefficients; a twentieth for the others.
        opacity, scale, rotation: raw values.
        intensity: logarithm of the reflection intensity.
        short_run_power: in a run of n < 30,000 iterations, the rates of position, colour, scale and rotation are
            multiplied by (30,000 / n) to this power, with n at least 3,000; 0 keeps the published rates
            (lab/training.md).
    """

    means: LearningRate = 1.6e-4
    decay: Internal[PositiveShare] = 1.0
    sh: LearningRate = 2.5e-3
    opacity: LearningRate = 5e-2
    scale: LearningRate = 5e-3
    rotation: LearningRate = 1e-3
    intensity: Internal[LearningRate] = 5e-3
    short_run_power: Internal[Annotated[float, Range(0, 2)]] = 0.5

    def of(self, part: str, view_dependence: float = 0.0) -> dict[str, Rate]:
        """The rates by dotted parameter name.

        Args:
            part: part of the scene.
            view_dependence: weight in the loss of the squared SH coefficients beyond the constant one, per Gaussian.
                Photographs from few directions do not determine them, and panes show Gaussians from other directions
                (not in the papers).
        """
        power = self.short_run_power
        return {
            f"{part}.means": Rate(self.means, MEANS_END, decay=self.decay, per_extent=True, short_run_power=power),
            f"{part}.sh": Rate(self.sh, rest=1 / 20, penalty=view_dependence, short_run_power=power),
            f"{part}.logit_opacities": Rate(self.opacity),
            f"{part}.log_scales": Rate(self.scale, short_run_power=power),
            f"{part}.quats": Rate(self.rotation, short_run_power=power),
        }


@dataclass(frozen=True)
class ReflectionRates:
    """Learning rates of reflections.

    Attributes:
        strength: logit of the reflection strength.
        environment: raw texels of the environment.
    """

    strength: LearningRate = 2e-2
    environment: LearningRate = 5e-2

    def of(self) -> dict[str, Rate]:
        """The rates by dotted parameter name."""
        return {"primary.logit_strength": Rate(self.strength), "environment.raw": Rate(self.environment)}


Strategy = Literal["default", "mcmc"]


@dataclass(frozen=True)
class Intervals:
    """Schedule of opacity changes, of the SH degree, and of the end of a run.

    Times are shares of the run (3DGS: of 30,000 iterations).

    Every third interval ends in a reset of the opacities, as in 3DGS. `planar` perturbs them after the other two, so
    that the two never coincide (TR-Gaussians, Section III-C3).

    Attributes:
        opacity: time between changes of the opacities.
        least: minimum number of iterations between them, which the scene needs to recover.
        reset_stop: time after which no reset happens. The `mcmc` strategy has none of these resets.
        sh: time between increases of the SH degree.
        averaged_passes: final passes over the views over which the parameters are averaged; 0 keeps the last step.
    """

    opacity: Internal[PositiveShare] = 1 / 30
    least: Internal[PositiveCount] = 250
    reset_stop: Internal[Share] = 0.45
    sh: Internal[PositiveShare] = 1 / 30
    averaged_passes: Annotated[float, Range(0, 1000)] = 1.0


@dataclass(frozen=True)
class DefaultDensify:
    """Options for adding and removing Gaussians as in 3DGS, with the criterion of AbsGS (arXiv 2404.10484) for splits.

    A small Gaussian whose mean screen gradient exceeds a threshold is cloned. A large one whose mean absolute gradient,
    summed over pixels without their signs, exceeds another threshold is split in two. Where a large Gaussian smears
    detail, the signed gradients of its pixels cancel, and 3DGS, which uses their sum, does not split it.
    Nearly transparent Gaussians are removed.

    Attributes:
        split_by: criterion for splitting large Gaussians: the absolute gradient `absgrad`, or, as in 3DGS, the same
            `gradient` as for cloning small ones.
        interval: steps between densifications.
        whole_passes: wait for about one pass over the views, but at most twice the interval, so that every Gaussian has
            been seen before it is judged.
        adapt_to_size: raise the thresholds if photographs are smaller than a quarter of a megapixel.
        start: share of the run after which densification begins.
        stop: share of the run after which densification ends.
        gradient_threshold: mean gradient norm, in normalised device coordinates, above which a small Gaussian is
            cloned.
        absgrad_threshold: mean absolute gradient, in the same unit, above which a large Gaussian is split.
        dense_fraction: longest axis, as a share of the scene extent, above which a Gaussian is large.
        prune_opacity: opacity below which Gaussians are removed.
        prune_large_start: share of the run after which oversized Gaussians are removed, too; 1 keeps them.
        prune_scale_fraction: longest axis, as a share of the scene extent, above which a Gaussian is oversized. 3DGS
            also states a limit of 20 pixels on screen, but clears the radii before it reads them, so that its published
            results have none.
        cap: maximum number of Gaussians, including the initial ones; by default `--densify.per-pixel` decides. 0 adds
            none.
        per_pixel: maximum number of Gaussians per pixel of all training photographs, a limit for captures whose
            photographs contradict each other (moving cars, leaves); 0 sets no limit. Unlike `cap`, it limits
            densification only: searches for missing objects and unseen reflections add up to 5 % each.
        least_contribution: contribution in pixels to every training view, directly and mirrored, below which Gaussians
            are removed; 0 keeps them.
        contribution_moments: shares of the run at which they are removed: when densification ends, when `planar` stops
            perturbing opacities, and at the end.
    """

    split_by: Internal[Literal["absgrad", "gradient"]] = "absgrad"
    interval: Internal[PositiveCount] = 100
    whole_passes: Internal[bool] = True
    adapt_to_size: Internal[bool] = True
    start: Internal[Share] = 500 / 30_000
    stop: Share = 15_000 / 30_000
    gradient_threshold: Positive = 2e-4
    absgrad_threshold: Positive = 1.2e-3
    dense_fraction: Internal[Positive] = 0.01
    prune_opacity: Share = 0.005
    prune_large_start: Internal[Share] = 1.0
    prune_scale_fraction: Internal[Positive] = 0.1
    cap: Annotated[Count | None, ESSENTIAL] = None
    per_pixel: NonNegative = 0.02
    least_contribution: NonNegative = 0.2
    contribution_moments: Internal[Annotated[tuple[Share, ...], Ascending()]] = (0.5, 0.8, 1.0)

    @staticmethod
    def published() -> DefaultDensify:
        """As in 3DGS, which removes oversized Gaussians after the first opacity reset."""
        return DefaultDensify(
            split_by="gradient",
            whole_passes=False,
            adapt_to_size=False,
            prune_large_start=3000 / 30_000,
            per_pixel=0.0,
            least_contribution=0.0,
        )


@dataclass(frozen=True)
class McmcDensify:
    """Options for relocating, adding and moving Gaussians (Kheradmand et al. 2024).

    Attributes:
        cap: maximum number of Gaussians, including the initial ones; by default half the pixels of a photograph,
            beyond which searches for missing objects and unseen reflections add up to 5 % each.
        interval: steps between relocations.
        start: share of the run after which relocation begins.
        stop: share of the run after which relocation and growth end; the noise goes on.
        growth: factor by which the number grows in every three hundredth of the run, up to the cap; in the published
            30,000 iterations, this is at every relocation. A single relocation at most doubles it.
        noise_rate: noise on the positions, as a multiple of their learning rate; 0 disables it.
        noise_units: units of variances and learning rate in their product: scene `extents`, so that the noise does not
            depend on the units of the capture, or, as published, `world` units.
        opacity_weight: lambda_o, weight of the mean opacity in the loss.
        scale_weight: lambda_Sigma, weight of the mean standard deviation in the loss.
        reach: Gaussians on which noise and regularisers act in a step: those that its view shows (`shown`; for
            regularisers, directly), or, as published, `all`.
        initial_spread: standard deviation of the first Gaussians, as a share of the distance to their neighbours. The
            published 0.1 takes a thousand steps or more to close the gaps (lab/gaussians.md). `planar` uses it only as
            published, because its first stages otherwise precede MCMC.
    """

    cap: Annotated[Count | None, ESSENTIAL, tyro.conf.arg(aliases=("--cap",))] = None
    interval: Internal[PositiveCount] = 100
    start: Internal[Share] = 500 / 30_000
    stop: Internal[Share] = 25_000 / 30_000
    growth: Internal[Annotated[float, Range(1, 100)]] = 1.05
    noise_rate: NonNegative = 5e5
    noise_units: Internal[Literal["extents", "world"]] = "extents"
    opacity_weight: NonNegative = 0.01
    scale_weight: NonNegative = 0.01
    reach: Internal[Literal["shown", "all"]] = "shown"
    initial_spread: Internal[Positive] = 1.0

    @staticmethod
    def published() -> McmcDensify:
        """As in 3DGS-MCMC."""
        return McmcDensify(reach="all", noise_units="world", initial_spread=0.1)


@dataclass(frozen=True)
class MirrorSearch:
    """Options for recognising mirrors when reflections begin.

    Attributes:
        begin_found: search for mirrors; otherwise, every strength grows from `first_strength` (the papers).
        views: number of training views to examine.
        spread: standard deviation over the views of a Gaussian's colour, sRGB, from which it counts as a mirror.
        strength: initial reflection strength of mirrors.
        least_opacity: minimum opacity of mirrors.
        flatness: maximum ratio of the shortest to the middle axis of mirrors.
        estimated_normals: take the normals of mirrors from `normals/` next to the photographs where they exist, and
            only otherwise from the depths.
    """

    begin_found: bool = True
    views: Annotated[int, Range(2, 1000)] = 24
    spread: Share = 0.03
    strength: OpenShare = 0.73
    least_opacity: OpenShare = 0.9
    flatness: OpenShare = 0.37
    estimated_normals: bool = True


@dataclass(frozen=True)
class NormalPropagation:
    """Options for growing reflective Gaussians over their neighbours and disturbing the colours of the others.

    A reflective Gaussian has a nearly correct normal. Where it overlaps another one, the blended normal is nearly
    correct, too, so that the other receives a useful gradient.

    Attributes:
        least_opacity: value to which lower opacities are raised, so that every visible Gaussian counts.
        least_strength: value to which lower reflection strengths are raised, so that they have a gradient.
        reflective: Gaussians of at least this strength grow (paper: 0.1; its code: 0.02).
        growth: factor on their two longer axes, or on both of a disc; the shortest, the normal, stays.
        sabotage: half width of the uniform noise on the constant colour (paper: 0.1; its code: 0.4 on the constant
            coefficient, which is 0.113); 0 disables it (ablation).
        sabotaged: Gaussians of at most this strength are disturbed (paper: 0.1; its code: 0.05).
    """

    least_opacity: OpenShare = 0.9
    least_strength: OpenShare = 1e-3
    reflective: OpenShare = 0.02
    growth: Annotated[float, Range(1, 100)] = 1.5
    sabotage: Share = 0.1
    sabotaged: OpenShare = 0.05


@dataclass(frozen=True)
class PhotoExposure:
    """An affine transform of colours for each photograph (3DGS's public code has one).

    Attributes:
        rate: initial learning rate; 0 assumes equal exposures.
    """

    rate: LearningRate = 0.0


@dataclass(frozen=True)
class PoseRefinement:
    """A small rigid motion of each training camera, learned by the gradient of its pose.

    Attributes:
        rate: initial learning rate, in radians and scene extents; 0 keeps the poses of the capture.
    """

    rate: LearningRate = 0.0


@dataclass(frozen=True)
class Photographer:
    """Options for the photographer in the panes: Gaussians that move with the camera.

    Attributes:
        learn: model the photographer's reflection.
        upright: keep the photographer upright when the camera is tilted; otherwise they tilt with it.
        count: number of initial Gaussians.
        sh_degree: SH degree of their colours.
        rates: learning rates.
    """

    learn: bool = False
    upright: bool = True
    count: Internal[Annotated[int, Range(1, 1_000_000)]] = 500
    sh_degree: Internal[ShDegree] = 0
    rates: Internal[GaussianRates] = field(default_factory=GaussianRates)


Texels = Annotated[int, Range(1, 2048)]


@dataclass(frozen=True)
class PropagationSchedule:
    """Schedule of propagation: at the intervals of `Intervals.opacity`, except those that reset opacities.

    Attributes:
        end: `settled` ends it when the reflective part has stopped growing (the paper's criterion), `fixed` at `stop`.
        stop: share of the run after which propagation ends.
        patience: intervals without growth after which it counts as settled; strengths take some hundred steps to show,
            however short the run. If nothing reflects or looks reflective, it ends at once.
        pause: steps for which raised opacities are frozen.
        last_reset: after the end, reset opacities only if they have been raised since the last reset; otherwise,
            regular resets continue as without propagation.
    """

    end: Internal[Literal["settled", "fixed"]] = "settled"
    stop: Share = 0.75
    patience: Internal[PositiveCount] = 5
    pause: Internal[Count] = 100
    last_reset: Internal[bool] = True


@dataclass(frozen=True)
class SurroundingsStart:
    """Options for the initial surroundings.

    Attributes:
        source: Gaussians in every cell of the scene's box (paper), copies of the scene's Gaussians that do not reflect,
            or both.
        cells: cells along an edge of the box; by default as many as give half a Gaussian per pixel, at most 32 (paper:
            32).
        per_cell: Gaussians in each cell.
        outside: share of the points left out of the box at either end of each axis.
        opacity: opacity of the Gaussians in the box.
    """

    source: Annotated[Literal["box", "scene", "both"], ESSENTIAL] = "scene"
    cells: Annotated[int, Range(1, 256)] | None = None
    per_cell: Internal[Annotated[int, Range(1, 1000)]] = 5
    outside: Internal[Annotated[float, Range(0, 0.45)]] = 0.005
    opacity: Internal[OpenShare] = 0.1


@dataclass(frozen=True)
class SurroundingsOptions:
    """Options for learning the surroundings.

    Attributes:
        start: initial surroundings.
        sh_degree: maximum SH degree of their view-dependent colour.
        rates: learning rates.
        densify: densification and pruning, by gradients in space times half of the distance.
        reset: share of the run between two resets of their opacities during densification; 0 never resets them.
    """

    start: SurroundingsStart = field(default_factory=SurroundingsStart)
    sh_degree: ShDegree = 1
    rates: Internal[GaussianRates] = field(default_factory=GaussianRates)
    densify: Internal[DefaultDensify] = field(
        default_factory=partial(
            DefaultDensify, split_by="gradient", stop=0.7, least_contribution=0.02, contribution_moments=(0.8,)
        )
    )
    reset: Internal[Share] = 0.0


@dataclass(frozen=True)
class MethodRecipe:
    """Options of all methods. A recipe imports PyTorch only when it is used.

    Attributes:
        method: name of the method on the command line.
        functions: module and prefix of its functions `*_scene`, `*_renderer` and `*_stages`.
        sh_degree: maximum SH degree of the view-dependent colour.
        ssim_weight: lambda, share of D-SSIM in the photometric loss.
        view_dependence_weight: weight of the squared SH coefficients beyond the constant one.
        background: background colour, sRGB; by default white if photographs are transparent, else black.
        rates: learning rates of the Gaussians.
        intervals: intervals of opacity resets and SH degree increases.
        strategy: strategy for adding and removing Gaussians, with its options in `densify` or `mcmc`.
        densify: densification and pruning of the `default` strategy.
        mcmc: relocation and growth of the `mcmc` strategy.
        exposure: learned exposure of each photograph.
        poses: refined camera pose of each training photograph.
    """

    method: ClassVar[str]
    functions: ClassVar[str]

    sh_degree: Annotated[ShDegree, ESSENTIAL] = 3
    ssim_weight: Share = 0.2
    view_dependence_weight: NonNegative = 0.0
    background: Annotated[Color | None, ESSENTIAL] = None
    rates: GaussianRates = field(default_factory=GaussianRates)
    intervals: Intervals = field(default_factory=Intervals)
    strategy: Annotated[Strategy, ESSENTIAL] = "default"
    densify: DefaultDensify = field(default_factory=DefaultDensify)
    mcmc: McmcDensify = field(default_factory=McmcDensify)
    exposure: PhotoExposure = field(default_factory=PhotoExposure)
    poses: PoseRefinement = field(default_factory=PoseRefinement)

    def check_capture(self, files: CaptureFiles) -> None:
        """Refuse a capture that lacks what the method needs, before photographs are read; most methods need nothing."""

    def initialise(self, dataset: Dataset) -> Scene:
        """The initial scene; raises PlaneFitError if the method needs masks of panes and these do not suffice."""
        scene: Scene = self._function("scene")(self, dataset)
        return scene

    def renderer(self) -> Renderer:
        """The renderer of the finished scene, with all its layers."""
        renderer: Renderer = self._function("renderer")(self)
        return renderer

    def stages(self, seed: int, iterations: int = PUBLISHED_ITERATIONS) -> tuple[Stage, ...]:
        """The training stages of a run of this length."""
        stages: tuple[Stage, ...] = self._function("stages")(self, seed, iterations)
        return stages

    def _function(self, name: str) -> Any:
        module, _, beginning = self.functions.partition(":")
        return getattr(importlib.import_module(module), f"{beginning}_{name}")
