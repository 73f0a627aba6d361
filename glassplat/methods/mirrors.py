"""Mirrors found in a matte scene, and normals propagated from them (3DGS-DR, Section 3.3).

3DGS-DR and EnvGS begin with hardly any reflection, and let it spread from where it happens to explain something. What
mirrors its neighbourhood has become a picture of it by then. But a mirror betrays itself earlier, by looking different
from every side, and depths tell coarsely which way it faces: from there its normals find their way.

How much reflects is counted over what the views show. The paper counts reflective Gaussians. But a mirror ball that
fills a third of the images may be a hundredth of the Gaussians, of which most stand in empty space at first, and in a
matte scene as many reflect a little.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from glassplat.captures.dataset import Dataset
from glassplat.captures.view import View, estimated_normals, evenly
from glassplat.render.deferred import cell_side, depth_normals, resize_environment, seen_surface, view_directions
from glassplat.render.frame import Renderer
from glassplat.render.layers import contributions, gather_pixels
from glassplat.scene import SH_ZERO, logit
from glassplat.scene.camera import Camera, quat_product, rotation_from_quat, to_device
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene
from glassplat.training.actions import Densify, GrowSh, ResetOpacity
from glassplat.training.densify import Moments, forget
from glassplat.training.losses import counted_pixels, residual
from glassplat.training.options import MirrorSearch, NormalPropagation, PropagationSchedule, Rate
from glassplat.training.stage import AtMoments, Clock, Every, TrainState

LEAST_SHOWN = 0.1
"""Pixels, of all views together, below which a Gaussian is not seen."""


@dataclass(frozen=True)
class Search:
    """Search for what reflects, by what the views show of the region in which anything may.

    A Gaussian's residual in a view is the mean difference between photograph and render over its pixels, by its
    blending weights. Detail that is not resolved yet is the same in all views; a reflection is another in each. So it
    is the residual's spread over the views that tells them apart.

    Attributes:
        views: how many training views to look at.
        strength: Gaussians of more than this strength cannot have been overlooked (the paper's "reflective").
        spread: standard deviation of the residual over the views, sRGB, from which it turns with the view.
    """

    views: int = 12
    strength: float = 0.1
    spread: float = 0.04

    @torch.no_grad()
    def reflective(self, scene: Scene, views: Sequence[View]) -> float:
        """Share of what is seen that is reflection: the mean strength."""
        shown = sum(
            (contributions(scene, view.camera) for view in evenly(views, self.views)),
            torch.zeros((), dtype=torch.float32),
        )
        return mean_in_region(scene, shown, torch.sigmoid(scene.primary.channels["logit_strength"]))

    @torch.no_grad()
    def turning(self, scene: Scene, views: Sequence[View], renderer: Renderer) -> float:
        """Share of what is seen that does not reflect, although its residual turns with the view."""
        shown, spreads = residual_spreads(scene, evenly(views, self.views), renderer)
        reflects = scene.primary.channels["logit_strength"] > logit(self.strength)
        return mean_in_region(scene, shown, ~reflects & (spreads > self.spread))


def mean_in_region(scene: Scene, shown: Tensor, values: Tensor) -> float:
    """Mean of values [N] over what is shown [N] of the Gaussians in the region; 0 where nothing is."""
    shown = torch.where(in_region(scene), shown, 0)
    return float((shown * values).sum() / shown.sum().clamp(min=1e-6))


def in_region(scene: Scene) -> Tensor:
    """[N] bool: which primary Gaussians lie where something may reflect."""
    means = scene.primary.means
    if scene.environment.region is None:
        return torch.ones(len(means), dtype=torch.bool, device=means.device)
    *center, radius = scene.environment.region
    return (means - means.new_tensor(center)).norm(dim=1) <= radius


def residual_spreads(scene: Scene, views: Sequence[View], renderer: Renderer) -> tuple[Tensor, Tensor]:
    """Of each primary Gaussian what the views show, in pixels, and how its residual spreads over them; [N] each.

    Pixels that a view ignores say nothing: a residual of 0 there would look like one that turns with the view.
    """
    count, device = len(scene.primary), scene.primary.means.device
    shown, squares = torch.zeros(2, count, device=device, dtype=torch.float32)
    sums = torch.zeros(count, 3, device=device, dtype=torch.float32)
    for view in views:
        counted = counted_pixels(view, device).to(shown.dtype)
        weights = gather_pixels(scene, view.camera, counted[..., None])[:, 0]
        residuals = residual_sums(scene, view, renderer)
        shown += weights
        sums += residuals
        squares += residuals.square().sum(dim=1) / weights.clamp(min=1e-6)
    shown_or_one = shown.clamp(min=1e-6)
    variance = squares / shown_or_one - (sums / shown_or_one[:, None]).square().sum(dim=1)
    return shown, (variance.clamp(min=0) / 3).sqrt()


def residual_sums(scene: Scene, view: View, renderer: Renderer) -> Tensor:
    """[N, 3] photograph minus render, summed over the pixels of each primary Gaussian by its blending weights.

    That is the gradient with respect to its colour of the sum over pixels of residual times render.
    """
    with torch.enable_grad():
        sh = scene.primary.sh.detach().requires_grad_()
        frame = renderer(scene.with_parameters({"primary.sh": sh}), view.camera)
        (gradient,) = torch.autograd.grad(
            (residual(frame, view, scene) * frame.layers.get("base", frame.rgb)).sum(), sh
        )
    return gradient[:, 0] / SH_ZERO


COLOR_NEIGHBOURS, NORMAL_NEIGHBOURS = 16, 4
"""Gaussians, itself among them, over which the spread of colours and the normals are averaged."""
FACING = 1e-3
"""Length of a sum of normals, in pixels, from which it tells a direction."""


@torch.no_grad()
def mirror_lookalikes(
    options: MirrorSearch, scene: Scene, views: Sequence[View], renderer: Renderer
) -> tuple[Tensor, Tensor]:
    """[N] bool each: which primary Gaussians the views show, and which of these look like mirrors.

    That is a Gaussian of the region whose pixels, but for one constant colour, differ from view to view. One by
    itself may lie where a pattern is not resolved yet; so its neighbours count as well.

    Args:
        options: what looks like one.
        scene: with an environment of which the region is known, or everywhere is.
        views: those that are trained on.
        renderer: draws the primary Gaussians.
    """
    plain = replace(scene, primary=replace(scene.primary, active_sh_degree=0))
    shown, spreads = residual_spreads(plain, evenly(views, options.views), renderer)
    seen = shown > LEAST_SHOWN
    rows = seen.nonzero().squeeze(1)
    variances = torch.zeros_like(spreads)
    near = neighbours(scene.primary.means[rows], COLOR_NEIGHBOURS)
    weights, values = shown[rows][near], spreads[rows].square()[near]
    variances[rows] = (weights * values).sum(1) / weights.sum(1)
    return seen, seen & (variances > options.spread**2) & in_region(scene)


@torch.no_grad()
def made_mirrors(options: MirrorSearch, scene: Scene, views: Sequence[View], chosen: Tensor) -> Gaussians:
    """The primary Gaussians, the chosen [N] ones as mirrors that face as the views say (`seen_normals`).

    Their colours stay, but for what turns with the view: what the reflection explains, it takes from them.
    """
    gaussians = scene.primary
    looked_at = evenly(views, options.views)
    normals = seen_normals(scene, looked_at, options.estimated_normals)
    turned = chosen & (normals.norm(dim=1) > FACING)
    rows = turned.nonzero().squeeze(1)
    near = neighbours(gaussians.means[rows], NORMAL_NEIGHBOURS)
    normals[rows] = normals[rows][near].sum(1)
    quats, log_scales = facing(gaussians, normalize(normals, dim=1), math.log(options.flatness))
    sh = gaussians.sh.clone()
    sh[chosen, 1:] = 0
    strengths, opacities = gaussians.channels["logit_strength"], gaussians.logit_opacities
    return gaussians.with_tensors(
        {
            "quats": torch.where(turned[:, None], quats, gaussians.quats),
            "log_scales": torch.where(turned[:, None], log_scales, gaussians.log_scales),
            "logit_strength": strengths.masked_fill(chosen, logit(options.strength)),
            "logit_opacities": torch.where(chosen, opacities.clamp(min=logit(options.least_opacity)), opacities),
            "sh": sh,
        }
    )


def neighbours(points: Tensor, count: int) -> Tensor:
    """[N, count] rows of the nearest of points [N, 3], each its own first neighbour; fewer where there are fewer."""
    if not len(points):
        return torch.zeros(0, 1, dtype=torch.int64, device=points.device)
    from scipy.spatial import cKDTree  # Takes long to import, and most commands never need it.

    places = points.detach().cpu().numpy()
    _, rows = cKDTree(places).query(places, k=range(1, min(count, len(places)) + 1), workers=-1)
    return torch.from_numpy(rows).to(points.device)


def seen_normals(scene: Scene, views: Sequence[View], estimated: bool = False) -> Tensor:
    """[N, 3] normals that the views show, summed over the pixels of each primary Gaussian, world axes.

    A surface that is seen at a grazing angle counts by the cosine.

    Args:
        scene: with primary Gaussians.
        views: those that are looked at.
        estimated: take normals that were estimated from a photograph where they lie next to it; all others are those of
            the depth maps.
    """
    normals = torch.zeros_like(scene.primary.means)
    for view in views:
        camera = view.camera.to(normals.device)
        known = estimated_normals(view) if estimated else None
        image = slopes_of_depths(scene, camera) if known is None else to_device(known, normals.device)
        cosines = -(image * normalize(view_directions(camera), dim=-1)).sum(-1, keepdim=True)
        normals += gather_pixels(scene, camera, image * cosines.clamp(min=0))
    return normals


def slopes_of_depths(scene: Scene, camera: Camera) -> Tensor:
    """[H, W, 3] normals of a camera's depth map, world axes; zero where they cannot be trusted."""
    surface = seen_surface(scene, camera, background=(0.0, 0.0, 0.0))
    cells, trusted = depth_normals(surface.depth, surface.alpha, camera)
    return _whole_size(cells * trusted[..., None], cell_side(camera), surface.depth.shape)


def _whole_size(cells: Tensor, side: int, size: Sequence[int]) -> Tensor:
    """[H, W, 3] unit vectors between those of cells [h, w, 3] of so many pixels, and zero where these are."""
    height, width = (side * count for count in cells.shape[:2])
    large = interpolate(cells.permute(2, 0, 1)[None], (height, width), mode="bilinear")[0].permute(1, 2, 0)
    image = cells.new_zeros(*size, 3)
    image[:height, :width] = normalize(large, dim=-1)
    return image


def facing(gaussians: Gaussians, normals: Tensor, log_flatness: float) -> tuple[Tensor, Tensor]:
    """Orientations [N, 4] and log scales of Gaussians whose normals are turned to others [N, 3], on the shortest way.

    Ellipsoids become flat; a disc is as flat as can be.
    """
    axes, log_scales = rotation_from_quat(gaussians.quats), gaussians.log_scales
    shortest = torch.full_like(log_scales[:, 0], 2).long() if gaussians.are_discs else log_scales.argmin(dim=1)
    now = axes.gather(2, shortest[:, None, None].expand(-1, 3, 1))[..., 0]
    # A normal and its opposite are the same.
    wanted = torch.where((now * normals).sum(1, keepdim=True) < 0, -normals, normals)
    half_turn = torch.cat([1 + (now * wanted).sum(1, keepdim=True), torch.linalg.cross(now, wanted)], dim=1)
    quats = quat_product(normalize(half_turn, dim=1), normalize(gaussians.quats, dim=1))
    if gaussians.are_discs:
        return quats, log_scales
    least, middle = log_scales.sort(dim=1).values[:, :2].unbind(1)
    flat = torch.minimum(least, middle + log_flatness)
    return quats, log_scales.scatter(1, shortest[:, None], flat[:, None])


@torch.no_grad()
def normals_propagated(
    options: NormalPropagation, gaussians: Gaussians, moments: Moments
) -> tuple[Gaussians, dict[str, tuple[Tensor, Tensor]]]:
    """Raised opacities and strengths, and reflective Gaussians grown; what changed forgets its moments."""
    opacities = gaussians.logit_opacities.clamp(min=logit(options.least_opacity))
    strengths = gaussians.channels["logit_strength"].clamp(min=logit(options.least_strength))
    grows = strengths >= logit(options.reflective)
    log_scales = gaussians.log_scales + math.log(options.growth) * (grows[:, None] & _within_surface(gaussians))
    changed = {"logit_opacities": opacities, "logit_strength": strengths, "log_scales": log_scales}
    everything = torch.ones_like(grows)
    return gaussians.with_tensors(changed), forget(moments, [f"primary.{name}" for name in changed], everything)


@torch.no_grad()
def colors_disturbed(
    options: NormalPropagation, gaussians: Gaussians, moments: Moments, generator: torch.Generator
) -> tuple[Gaussians, dict[str, tuple[Tensor, Tensor]]]:
    """Noise on the constant colour of what does not reflect yet, which hinders it from explaining reflections."""
    if options.sabotage == 0:
        return gaussians, dict(moments)
    unit = torch.rand(gaussians.sh[:, 0].shape, generator=generator, device=gaussians.sh.device, dtype=torch.float32)
    dull = gaussians.channels["logit_strength"] <= logit(options.sabotaged)
    sh = gaussians.sh.clone()
    sh[:, 0] += torch.where(dull[:, None], options.sabotage * (2 * unit - 1) / SH_ZERO, 0)
    return gaussians.with_tensors({"sh": sh}), forget(moments, ["primary.sh"], dull)


def _within_surface(gaussians: Gaussians) -> Tensor:
    """[N, 3] or of discs [N, 2] bool: which axes lie within the surface, all but the shortest and all of a disc's."""
    if gaussians.are_discs:
        return torch.ones_like(gaussians.log_scales, dtype=torch.bool)
    return ~torch.nn.functional.one_hot(gaussians.log_scales.argmin(dim=1), 3).bool()


log = logging.getLogger("glassplat.training")

ENDED, MOST, GREW, TURNS = "propagation ended", "most reflective", "reflective grew", "turns with the view"
"""Names in `TrainState.records`: the step of the end, the largest share of reflection, the step of its growth, and the
share that does not reflect, but turns with the view."""
RAISED, LOWERED = "opacities raised", "opacities lowered"
"""The same: the last step at which each was done."""
GROWTH = 0.01
"""By how much the share has to rise to count as growing; a ratio would let the little that noise makes of it in a matte
scene go on for ever."""
FOUND = 0.03
"""Share from which on something reflective has been found."""
LOOKS_REFLECTIVE = 0.16
"""Share that turns with the view, below which propagation would cost more than it finds: two metal eggs with 0.07 lost
1.3 dB by it at 7000 iterations, a mirror ball with 0.30 gained (lab/glossy.md)."""
NOTHING_FOUND = "step %d: little or nothing reflective was found, so that normals are not propagated any further%s; %s"
AS_SPLAT = " and the rest of the run learns as fast as splat"
MATTE = (
    "no more than %.0f %% of what is seen looks different from different sides. If something reflects anyway, "
    "--region X Y Z RADIUS names its place"
)
EMPTY = (
    "no Gaussian lies in the sphere in which anything may reflect, of radius %.3g around (%.3g, %.3g, %.3g). "
    "--region X Y Z RADIUS names another, in the units of the capture's poses"
)
OVERLOOKED = (
    "but %.0f %% of what is seen looks different from different sides. More --iterations give normals more time to "
    "spread, and --region X Y Z RADIUS names the place where something reflects"
)


@dataclass(frozen=True)
class Propagate:
    """Propagates normals and disturbs the colours of what does not reflect, until no more reflectors are found.

    Where none has been found, the run goes on like one of `splat`, and the log says what may help.

    Attributes:
        when: the intervals at which it happens; whether to go on is asked at those that it skips, too.
        propagation: what it does.
        schedule: when it ends.
        renderer: that of the stage; its frames have a layer `base`.
        matte_rates: factors on learning rates after the end where nothing reflective was found, by dotted parameter
            name; of them the value for a run of this length is taken.
        search: what tells how much reflects.
        raises_rates_found: they count after the end where something was found, too.
    """

    when: Every
    propagation: NormalPropagation
    schedule: PropagationSchedule
    renderer: Renderer
    matte_rates: Mapping[str, Rate] = field(default_factory=dict)
    search: Search = field(default_factory=Search)
    raises_rates_found: bool = False
    name: str = "propagate normals"

    def due(self, clock: Clock) -> bool:
        """Return whether to act after this step."""
        return replace(self.when, skip_multiples_of=None).due(clock) or clock.step == self._last(clock)

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Edits `state`, until propagation has ended."""
        if has_ended(state):
            return False
        if clock.step < min(self._first(clock), self._last(clock)):
            return False
        if clock.step >= self._last(clock) or self._settles(state, dataset, clock):
            self._end(state, dataset, clock)
            return False
        if not self.when.due(clock):
            return False
        primary, moments = normals_propagated(self.propagation, state.scene.primary, state.optimizer.moments)
        primary, moments = colors_disturbed(self.propagation, primary, moments, state.generator(self.name))
        state.scene, state.optimizer.moments = replace(state.scene, primary=primary), moments
        state.optimizer.paused["primary.logit_opacities"] = self.schedule.pause
        state.records[RAISED] = clock.step
        return True

    def _first(self, clock: Clock) -> int:
        """The first step that is left to a reset.

        Before it, what random points became is still in the way everywhere; made opaque, it hides the surfaces.
        """
        return self.when.interval(clock) * (self.when.skip_multiples_of or 1)

    def _last(self, clock: Clock) -> int:
        """The step at which it ends at the latest."""
        return round(self.schedule.stop * clock.iterations)

    def _settles(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Return whether what reflects has not grown for long enough; keeps the records."""
        if self.schedule.end == "fixed":
            return False
        share = self.search.reflective(state.scene, dataset.train)
        if GREW not in state.records or share > state.records[MOST] + GROWTH:
            state.records |= {MOST: share, GREW: clock.step}
        waited = (clock.step - state.records[GREW]) / self.when.interval(clock)
        return waited >= self.schedule.patience or self._looks_matte(state, dataset, clock)

    def _looks_matte(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Return whether nothing reflects nor turns with the view; keeps the record.

        That is asked before opacities are raised for the first time, and one interval after a reset. At others,
        whatever stands in the way turns with the view.
        """
        if state.records[MOST] >= FOUND:
            return False
        if TURNS not in state.records or clock.step % self._first(clock) == self.when.interval(clock):
            state.records[TURNS] = self.search.turning(state.scene, dataset.train, self.renderer)
        return state.records[TURNS] < LOOKS_REFLECTIVE

    def _end(self, state: TrainState, dataset: Dataset, clock: Clock) -> None:
        """Notes the end and says what was found."""
        state.records[ENDED] = clock.step
        share = max(self.search.reflective(state.scene, dataset.train), state.records.get(MOST, 0.0))
        state.records[MOST] = share
        if share < FOUND or self.raises_rates_found:
            # Faster where there is no normal that this would spoil.
            state.optimizer.raised_rates = {
                name: rate.at(0.0, 1.0, clock.iterations) for name, rate in self.matte_rates.items()
            }
        if share >= FOUND:
            log.info(
                "step %d: normal propagation has ended, %.0f %% of what is seen is reflection", clock.step, 100 * share
            )
            return
        region = state.scene.environment.region
        if region is not None and not bool(in_region(state.scene).any()):
            *center, radius = region
            advice = EMPTY % (radius, *center)
        else:
            turns = state.records.get(TURNS)
            if turns is None:
                turns = self.search.turning(state.scene, dataset.train, self.renderer)
            advice = (MATTE if turns < LOOKS_REFLECTIVE else OVERLOOKED) % (100 * turns)
        log.warning(NOTHING_FOUND, clock.step, AS_SPLAT if self.matte_rates else "", advice)


@dataclass(frozen=True)
class GrowShAfterPropagation(GrowSh):
    """Raises the SH degree, but not while normals are propagated: colours that turn with the view would explain
    what reflects.
    """

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Edits `state`, once propagation has ended."""
        return has_ended(state) and super().apply(state, dataset, clock)


@dataclass(frozen=True)
class ResetRaised(ResetOpacity):
    """Resets opacities regularly while normals are propagated, and once more afterwards if they have been raised since.

    Propagation raises every opacity, also of what only stands in the way, as in the hole of a ring. Most of that is
    never lowered again without a reset. A scene whose opacities have not come back is worse than one in which something
    stands in the way: the rest of the run has to be as long as the time between two resets.

    Attributes:
        when: its moments, to the end of the run.
        regular: those of them at which resets happen while normals are propagated.
    """

    regular: Every = field(kw_only=True)

    @staticmethod
    def instead_of(reset: ResetOpacity) -> ResetRaised:
        """The one that takes the place of regular resets, at the same moments and those at which they would go on."""
        return ResetRaised(replace(reset.when, stop=1.0), reset.ceiling, regular=reset.when)

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Edits `state`, where something is to be lowered and there is time to recover."""
        raised = state.records.get(RAISED, 0) > state.records.get(LOWERED, 0)
        wanted = raised if has_ended(state) else self.regular.due(clock)
        # Opacities come back in the steps between two resets.
        recovery = self.when.interval(clock) * (self.when.only_multiples_of or 1)
        if not wanted or clock.step + recovery > clock.iterations:
            return False
        state.records[LOWERED] = clock.step
        return super().apply(state, dataset, clock)


@dataclass(frozen=True)
class DensifyWhilePropagating(Densify):
    """Densifies at an interval of its own while normals are propagated, and as at any other time once that has ended.

    Attributes:
        regular: what densifies then.
    """

    regular: Densify = field(kw_only=True)

    def due(self, clock: Clock) -> bool:
        """Return whether to act after this step, before or after the end."""
        return super().due(clock) or self.regular.due(clock)

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Edits `state`, if this is a moment of the interval that holds."""
        turn: Densify = self.regular if has_ended(state) else Densify(self.densifier, self.part)
        return turn.due(clock) and turn.apply(state, dataset, clock)


@dataclass(frozen=True)
class RefineEnvironment(AtMoments):
    """Doubles the environment's texels at certain moments, twice where two fall on one step.

    A normal has a gradient only as far as the texels that its reflection meets reach. Large texels at first let normals
    find their way from farther off; small ones make the reflection sharp in the end.

    Attributes:
        largest: texels along a face that are enough.
    """

    largest: int
    name: str = "refine environment"

    @torch.no_grad()
    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Edits `state`, until the environment is as fine as it gets; the optimiser forgets its moments."""
        environment = state.scene.environment
        if environment.size >= self.largest:
            return False
        doublings = sum(round(moment * clock.iterations) == clock.step for moment in self.moments)
        finer = resize_environment(environment, min(2**doublings * environment.size, self.largest))
        state.scene = replace(state.scene, environment=finer)
        return True


def has_ended(state: TrainState) -> bool:
    """Return whether normal propagation is over."""
    return ENDED in state.records


def found_nothing(state: TrainState) -> bool:
    """Return whether normal propagation is over, and nothing reflects."""
    return has_ended(state) and state.records[MOST] < FOUND
