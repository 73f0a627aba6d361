"""Search for mirrors in a matte scene, and propagation of normals from them (3DGS-DR, Section 3.3).

3DGS-DR and EnvGS start with almost no reflection, which spreads from where it happens to explain something. By then, a
mirror has learned its reflections as its own texture. But mirrors can be detected earlier, because their colours vary
with the view, and depths give rough normals, from which training finds the right ones.

The amount of reflection is measured over pixels of the views. The paper counts reflective Gaussians; but a mirror ball
that fills a third of the images may have a hundredth of the Gaussians, and in a matte scene, as many reflect slightly.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from glassplat.captures.dataset import Dataset
from glassplat.captures.view import View, estimated_normals, sample_evenly
from glassplat.render.deferred import blend_surface, cell_side, depth_normals, resize_environment, view_directions
from glassplat.render.frame import Renderer
from glassplat.render.layers import contributions, gather_pixels
from glassplat.scene import SH_ZERO, logit
from glassplat.scene.camera import Camera, quat_product, rotation_from_quat, to_device
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene
from glassplat.training.actions import Densify, GrowSh, ResetOpacity
from glassplat.training.densify import Moments, zero_moments
from glassplat.training.losses import residual, valid_pixels
from glassplat.training.options import GaussianRates, MirrorSearch, NormalPropagation, Rate
from glassplat.training.stage import RESET_TURN, AtShares, Clock, Every, TrainState

if TYPE_CHECKING:
    from glassplat.methods.glossy_recipes import GlossyOptions

LEAST_SHOWN = 0.1
"""Minimum contribution of a visible Gaussian, in pixels over all views."""


MEASURED_VIEWS = 12
"""Number of training views in which the amount of reflection is measured."""
REFLECTIVE = 0.1
"""Strength above which Gaussians count as reflective (paper)."""
VARYING = 0.04
"""Standard deviation of the residual over the views, sRGB, above which it is view-dependent."""


@torch.no_grad()
def reflective_share(scene: Scene, views: Sequence[View]) -> float:
    """Reflected share of the visible scene in its region: the mean strength."""
    shown = sum(
        (contributions(scene, view.camera) for view in sample_evenly(views, MEASURED_VIEWS)),
        torch.zeros((), dtype=torch.float32),
    )
    return mean_in_region(scene, shown, torch.sigmoid(scene.primary.channels["logit_strength"]))


@torch.no_grad()
def view_dependent_share(scene: Scene, views: Sequence[View], renderer: Renderer) -> float:
    """Share of the visible scene in its region that does not reflect, although its residual is view-dependent."""
    shown, spreads = residual_spreads(scene, sample_evenly(views, MEASURED_VIEWS), renderer)
    reflects = scene.primary.channels["logit_strength"] > logit(REFLECTIVE)
    return mean_in_region(scene, shown, ~reflects & (spreads > VARYING))


def mean_in_region(scene: Scene, shown: Tensor, values: Tensor) -> float:
    """Mean of values [N] over the Gaussians in the region, weighted by visibility [N]; 0 if there are none."""
    shown = torch.where(scene.environment.surrounds(scene.primary.means), shown, 0)
    return float((shown * values).sum() / shown.sum().clamp(min=1e-6))


def residual_spreads(scene: Scene, views: Sequence[View], renderer: Renderer) -> tuple[Tensor, Tensor]:
    """Visibility of each primary Gaussian, in pixels, and the spread of its residual over the views; [N] each.

    A Gaussian's residual in a view is the difference between photograph and render, averaged over its pixels with its
    blending weights. Unresolved detail has the same residual in all views, reflections a different one in each.
    Ignored pixels are excluded: a residual of 0 there would look view-dependent.
    """
    count, device = len(scene.primary), scene.primary.means.device
    shown, squares = torch.zeros(2, count, device=device, dtype=torch.float32)
    sums = torch.zeros(count, 3, device=device, dtype=torch.float32)
    for view in views:
        counted = valid_pixels(view, device).to(shown.dtype)
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

    This is the gradient of the sum of residual times render with respect to the Gaussian's colour.
    """
    with torch.enable_grad():
        sh = scene.primary.sh.detach().requires_grad_()
        frame = renderer(scene.with_parameters({"primary.sh": sh}), view.camera)
        (gradient,) = torch.autograd.grad(
            (residual(frame, view, scene) * frame.layers.get("base", frame.rgb)).sum(), sh
        )
    return gradient[:, 0] / SH_ZERO


COLOR_NEIGHBOURS, NORMAL_NEIGHBOURS = 16, 4
"""Number of neighbours, including itself, over which spreads and normals are averaged."""
LEAST_NORMAL_LENGTH = 1e-3
"""Minimum length of a sum of normals, in pixels, for a direction."""


@torch.no_grad()
def mirror_lookalikes(
    options: MirrorSearch, scene: Scene, views: Sequence[View], renderer: Renderer
) -> tuple[Tensor, Tensor]:
    """[N] bool each: visible primary Gaussians, and those that look like mirrors.

    The latter are Gaussians of the region of the scene's environment whose residual varies with the view. Neighbours
    are averaged, because a single Gaussian may be on an unresolved pattern.
    """
    plain = replace(scene, primary=replace(scene.primary, active_sh_degree=0))
    shown, spreads = residual_spreads(plain, sample_evenly(views, options.views), renderer)
    seen = shown > LEAST_SHOWN
    rows = seen.nonzero().squeeze(1)
    variances = torch.zeros_like(spreads)
    neighbours = nearest_neighbours(scene.primary.means[rows], COLOR_NEIGHBOURS)
    weights, values = shown[rows][neighbours], spreads[rows].square()[neighbours]
    variances[rows] = (weights * values).sum(1) / weights.sum(1)
    return seen, seen & (variances > options.spread**2) & scene.environment.surrounds(scene.primary.means)


@torch.no_grad()
def turn_into_mirrors(options: MirrorSearch, scene: Scene, views: Sequence[View], chosen: Tensor) -> Gaussians:
    """The primary Gaussians with the chosen [N] ones turned into mirrors, with normals from the views
    (`normals_from_views`).

    Their constant colours stay, and view-dependent ones are removed: reflections will explain these.
    """
    gaussians = scene.primary
    chosen_views = sample_evenly(views, options.views)
    normals = normals_from_views(scene, chosen_views, options.estimated_normals)
    rotated = chosen & (normals.norm(dim=1) > LEAST_NORMAL_LENGTH)
    rows = rotated.nonzero().squeeze(1)
    neighbours = nearest_neighbours(gaussians.means[rows], NORMAL_NEIGHBOURS)
    normals[rows] = normals[rows][neighbours].sum(1)
    quats, log_scales = rotate_to_normals(gaussians, normalize(normals, dim=1), math.log(options.flatness))
    sh = gaussians.sh.clone()
    sh[chosen, 1:] = 0
    strengths, opacities = gaussians.channels["logit_strength"], gaussians.logit_opacities
    return gaussians.with_tensors(
        {
            "quats": torch.where(rotated[:, None], quats, gaussians.quats),
            "log_scales": torch.where(rotated[:, None], log_scales, gaussians.log_scales),
            "logit_strength": strengths.masked_fill(chosen, logit(options.strength)),
            "logit_opacities": torch.where(chosen, opacities.clamp(min=logit(options.least_opacity)), opacities),
            "sh": sh,
        }
    )


def nearest_neighbours(points: Tensor, count: int) -> Tensor:
    """[N, count] rows of the nearest neighbours of points [N, 3], starting with itself; fewer if there are fewer
    points.
    """
    if not len(points):
        return torch.zeros(0, 1, dtype=torch.int64, device=points.device)
    from scipy.spatial import cKDTree  # Slow to import, and rarely needed.

    positions = points.detach().cpu().numpy()
    _, rows = cKDTree(positions).query(positions, k=range(1, min(count, len(positions)) + 1), workers=-1)
    return torch.from_numpy(rows).to(points.device)


def normals_from_views(scene: Scene, views: Sequence[View], estimated: bool = False) -> Tensor:
    """[N, 3] normals of the depth maps, summed over the pixels of each primary Gaussian, world axes.

    Weighted by the cosine of the viewing angle.

    Args:
        scene: the scene.
        views: views to average over.
        estimated: use normals estimated from photographs if available, instead of those of depth maps.
    """
    normals = torch.zeros_like(scene.primary.means)
    for view in views:
        camera = view.camera.to(normals.device)
        known = estimated_normals(view) if estimated else None
        image = depth_map_normals(scene, camera) if known is None else to_device(known, normals.device)
        cosines = -(image * normalize(view_directions(camera), dim=-1)).sum(-1, keepdim=True)
        normals += gather_pixels(scene, camera, image * cosines.clamp(min=0))
    return normals


def depth_map_normals(scene: Scene, camera: Camera) -> Tensor:
    """[H, W, 3] normals of a camera's depth map, interpolated between its cells, world axes; zero where unreliable."""
    surface = blend_surface(scene, camera, background=(0.0, 0.0, 0.0))
    cells, trusted = depth_normals(surface.depth, surface.alpha, camera)
    height, width = (cell_side(camera) * count for count in trusted.shape)
    reliable = (cells * trusted[..., None]).permute(2, 0, 1)[None]
    large = interpolate(reliable, (height, width), mode="bilinear")[0].permute(1, 2, 0)
    image = cells.new_zeros(*surface.depth.shape, 3)
    image[:height, :width] = normalize(large, dim=-1)
    return image


def rotate_to_normals(gaussians: Gaussians, normals: Tensor, log_flatness: float) -> tuple[Tensor, Tensor]:
    """Orientations [N, 4] and log scales of Gaussians, rotated by the smallest angle to the given normals [N, 3].

    Ellipsoids become flat.
    """
    axes, log_scales = rotation_from_quat(gaussians.quats), gaussians.log_scales
    shortest = torch.full_like(log_scales[:, 0], 2).long() if gaussians.are_discs else log_scales.argmin(dim=1)
    now = axes.gather(2, shortest[:, None, None].expand(-1, 3, 1))[..., 0]
    # A normal and its opposite are equivalent.
    wanted = torch.where((now * normals).sum(1, keepdim=True) < 0, -normals, normals)
    half_turn = torch.cat([1 + (now * wanted).sum(1, keepdim=True), torch.linalg.cross(now, wanted)], dim=1)
    quats = quat_product(normalize(half_turn, dim=1), normalize(gaussians.quats, dim=1))
    if gaussians.are_discs:
        return quats, log_scales
    least, middle = log_scales.sort(dim=1).values[:, :2].unbind(1)
    flat = torch.minimum(least, middle + log_flatness)
    return quats, log_scales.scatter(1, shortest[:, None], flat[:, None])


@torch.no_grad()
def propagate_normals(options: NormalPropagation, gaussians: Gaussians, moments: Moments) -> tuple[Gaussians, Moments]:
    """Raises opacities and strengths, and grows reflective Gaussians; moments of changed values are zeroed."""
    opacities = gaussians.logit_opacities.clamp(min=logit(options.least_opacity))
    strengths = gaussians.channels["logit_strength"].clamp(min=logit(options.least_strength))
    grows = (strengths >= logit(options.reflective))[:, None]
    if not gaussians.are_discs:  # The shortest axis is the normal.
        grows = grows & ~torch.nn.functional.one_hot(gaussians.log_scales.argmin(dim=1), 3).bool()
    log_scales = gaussians.log_scales + math.log(options.growth) * grows
    changed = {"logit_opacities": opacities, "logit_strength": strengths, "log_scales": log_scales}
    return gaussians.with_tensors(changed), zero_moments(moments, [f"primary.{name}" for name in changed])


@torch.no_grad()
def sabotage_colors(
    options: NormalPropagation, gaussians: Gaussians, moments: Moments, generator: torch.Generator
) -> tuple[Gaussians, Moments]:
    """Adds noise to the constant colours of non-reflective Gaussians, so that these cannot explain reflections."""
    if options.sabotage == 0:
        return gaussians, moments
    unit = torch.rand(gaussians.sh[:, 0].shape, generator=generator, device=gaussians.sh.device, dtype=torch.float32)
    matte = gaussians.channels["logit_strength"] <= logit(options.sabotaged)
    sh = gaussians.sh.clone()
    sh[:, 0] += torch.where(matte[:, None], options.sabotage * (2 * unit - 1) / SH_ZERO, 0)
    return gaussians.with_tensors({"sh": sh}), zero_moments(moments, ["primary.sh"], matte)


log = logging.getLogger("glassplat.training")

PROPAGATION_ENDED, MOST_REFLECTIVE = "propagation ended", "most reflective"
LAST_GROWTH, VIEW_DEPENDENT = "reflective grew", "turns with the view"
"""Keys of `TrainState.records`: step of the end, largest reflected share, step of its last growth, and the
view-dependent, non-reflective share."""
OPACITIES_RAISED, OPACITIES_LOWERED = "opacities raised", "opacities lowered"
"""Further keys: the last step of each."""
LEAST_GROWTH = 0.01
"""Minimum increase of the reflected share that counts as growth; not a ratio, which would let the noise of a matte
scene count forever."""
LEAST_REFLECTIVE = 0.03
"""Reflected share above which something reflective has been found."""
LEAST_VIEW_DEPENDENT = 0.16
"""View-dependent share below which propagation costs more than it gains: two metal eggs with 0.07 lost 1.3 dB at 7000
iterations, a mirror ball with 0.30 gained (lab/glossy.md)."""
NOTHING_FOUND = "step %d: little or nothing reflective was found, so normal propagation stops%s; %s"
AS_SPLAT = ", and the rest of the run uses the learning rates of splat"
MATTE_ADVICE = (
    "at most %.0f %% of the visible scene changes with the viewing direction. If something reflects anyway, "
    "give its location with --region X Y Z RADIUS"
)
EMPTY_ADVICE = (
    "no Gaussian lies in the sphere outside which nothing reflects, of radius %.3g around (%.3g, %.3g, %.3g). "
    "--region X Y Z RADIUS sets another one, in the units of the capture's poses"
)
OVERLOOKED_ADVICE = (
    "but %.0f %% of the visible scene changes with the viewing direction. More --iterations give propagation "
    "more time, and --region X Y Z RADIUS tells where something reflects"
)


@dataclass(frozen=True)
class Propagate:
    """Propagates normals and sabotages the colours of non-reflective Gaussians, until reflection stops growing.

    If nothing reflective is found, the run continues like `splat`, with advice in the log.

    Attributes:
        recipe: options of propagation and sabotage, and their schedule.
        renderer: renderer of the stage, whose frames have a layer `base`.
    """

    recipe: GlossyOptions
    renderer: Renderer
    name: str = "propagate normals"

    @property
    def when(self) -> Every:
        """Intervals of propagation; the end is checked at skipped intervals, too."""
        intervals, stop = self.recipe.intervals, self.recipe.schedule.stop
        return Every(intervals.opacity, 0.0, stop, intervals.least, skip_multiples_of=RESET_TURN)

    @property
    def matte_rates(self) -> dict[str, Rate]:
        """Factors, by parameter name, that raise the learning rates to those of `splat`; evaluated for the run."""
        if not self.recipe.raise_rates_matte:
            return {}
        splat = GaussianRates()
        factor = Rate(1.0, short_run_power=splat.short_run_power - self.recipe.rates.short_run_power)
        return {name: factor for name, rate in splat.of("primary").items() if rate.short_run_power}

    def due(self, clock: Clock) -> bool:
        """Return whether to act after this step."""
        return replace(self.when, skip_multiples_of=None).due(clock) or clock.step == self._last_step(clock)

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Edits `state`, until propagation has ended."""
        if propagation_has_ended(state):
            return False
        if clock.step < min(self._first_step(clock), self._last_step(clock)):
            return False
        if clock.step >= self._last_step(clock) or self._has_settled(state, dataset, clock):
            self._end_propagation(state, dataset, clock)
            return False
        if not self.when.due(clock):
            return False
        options, primary, moments = self.recipe.propagation, state.scene.primary, state.optimizer.moments
        primary, moments = propagate_normals(options, primary, moments)
        primary, moments = sabotage_colors(options, primary, moments, state.generator(self.name))
        state.scene, state.optimizer.moments = replace(state.scene, primary=primary), moments
        state.optimizer.paused["primary.logit_opacities"] = self.recipe.schedule.pause
        state.records[OPACITIES_RAISED] = clock.step
        return True

    def _first_step(self, clock: Clock) -> int:
        """The first step reserved for a reset.

        Before it, remains of random points would be made opaque, and hide the surfaces.
        """
        return self.when.interval(clock) * RESET_TURN

    def _last_step(self, clock: Clock) -> int:
        """The latest step at which it ends."""
        return round(self.recipe.schedule.stop * clock.iterations)

    def _has_settled(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Return whether reflection has stopped growing for long enough; updates the records."""
        if self.recipe.schedule.end == "fixed":
            return False
        share = reflective_share(state.scene, dataset.train)
        if LAST_GROWTH not in state.records or share > state.records[MOST_REFLECTIVE] + LEAST_GROWTH:
            state.records |= {MOST_REFLECTIVE: share, LAST_GROWTH: clock.step}
        waited = (clock.step - state.records[LAST_GROWTH]) / self.when.interval(clock)
        return waited >= self.recipe.schedule.patience or self._looks_matte(state, dataset, clock)

    def _looks_matte(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Return whether nothing reflects or is view-dependent; updates the record.

        This is checked before opacities are first raised, and one interval after a reset. At other times, floaters are
        view-dependent.
        """
        if state.records[MOST_REFLECTIVE] >= LEAST_REFLECTIVE:
            return False
        if VIEW_DEPENDENT not in state.records or clock.step % self._first_step(clock) == self.when.interval(clock):
            state.records[VIEW_DEPENDENT] = view_dependent_share(state.scene, dataset.train, self.renderer)
        return state.records[VIEW_DEPENDENT] < LEAST_VIEW_DEPENDENT

    def _end_propagation(self, state: TrainState, dataset: Dataset, clock: Clock) -> None:
        """Records the end, and logs what was found."""
        state.records[PROPAGATION_ENDED] = clock.step
        share = max(reflective_share(state.scene, dataset.train), state.records.get(MOST_REFLECTIVE, 0.0))
        state.records[MOST_REFLECTIVE] = share
        if share < LEAST_REFLECTIVE or self.recipe.raise_rates_found:
            # Faster, if there are no normals to corrupt.
            state.optimizer.raised_rates = {
                name: rate.at(0.0, 1.0, clock.iterations) for name, rate in self.matte_rates.items()
            }
        if share >= LEAST_REFLECTIVE:
            log.info(
                "step %d: normal propagation has ended, %.0f %% of the visible scene is reflection",
                clock.step,
                100 * share,
            )
            return
        region = state.scene.environment.region
        if region is not None and not bool(state.scene.environment.surrounds(state.scene.primary.means).any()):
            *center, radius = region
            advice = EMPTY_ADVICE % (radius, *center)
        else:
            varying = state.records.get(VIEW_DEPENDENT)
            if varying is None:
                varying = view_dependent_share(state.scene, dataset.train, self.renderer)
            advice = (MATTE_ADVICE if varying < LEAST_VIEW_DEPENDENT else OVERLOOKED_ADVICE) % (100 * varying)
        log.warning(NOTHING_FOUND, clock.step, AS_SPLAT if self.matte_rates else "", advice)


@dataclass(frozen=True)
class GrowShAfterPropagation(GrowSh):
    """Raises the SH degree, but not during propagation, when view-dependent colours would explain reflections."""

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Edits `state` after propagation."""
        return propagation_has_ended(state) and super().apply(state, dataset, clock)


@dataclass(frozen=True)
class ResetRaised(ResetOpacity):
    """Resets opacities regularly during propagation, and once afterwards if they were raised since the last reset.

    Propagation raises every opacity, including those of floaters, such as in the hole of a ring, most of which only a
    reset lowers again. Opacities need as many steps as between two resets to recover, so without these a reset does
    more harm than floaters.

    Attributes:
        when: times of resets, to the end of the run.
        regular: times of resets during propagation.
    """

    regular: Every = field(kw_only=True)

    @staticmethod
    def replacing(reset: ResetOpacity) -> ResetRaised:
        """The action that replaces regular resets, at the same times and their continuation."""
        return ResetRaised(replace(reset.when, stop=1.0), reset.ceiling, regular=reset.when)

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Edits `state` if opacities have been raised and there is time to recover."""
        raised = state.records.get(OPACITIES_RAISED, 0) > state.records.get(OPACITIES_LOWERED, 0)
        wanted = raised if propagation_has_ended(state) else self.regular.due(clock)
        # Opacities recover within the steps between two resets.
        recovery = self.when.interval(clock) * (self.when.only_multiples_of or 1)
        if not wanted or clock.step + recovery > clock.iterations:
            return False
        state.records[OPACITIES_LOWERED] = clock.step
        return super().apply(state, dataset, clock)


@dataclass(frozen=True)
class DensifyWhilePropagating(Densify):
    """Densifies at a different interval during propagation.

    Attributes:
        regular: densification after propagation.
    """

    regular: Densify = field(kw_only=True)

    def due(self, clock: Clock) -> bool:
        """Return whether to act after this step, before or after the end."""
        return super().due(clock) or self.regular.due(clock)

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Edits `state`, if due in the current phase."""
        densify: Densify = self.regular if propagation_has_ended(state) else Densify(self.densifier, self.part)
        return densify.due(clock) and densify.apply(state, dataset, clock)


@dataclass(frozen=True)
class RefineEnvironment(AtShares):
    """Doubles the environment's resolution at certain times.

    Normals get gradients only within the texel that their reflection hits. Large texels initially let normals converge
    from farther away; small ones finally make the reflection sharp.

    Attributes:
        largest: final number of texels along a face.
    """

    largest: int
    name: str = "refine environment"

    @torch.no_grad()
    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Edits `state`; moments of the environment are zeroed."""
        environment = state.scene.environment
        doublings = sum(round(share * clock.iterations) == clock.step for share in self.shares)
        finer = resize_environment(environment, min(2**doublings * environment.size, self.largest))
        state.scene = replace(state.scene, environment=finer)
        return True


def propagation_has_ended(state: TrainState) -> bool:
    """Return whether propagation has ended."""
    return PROPAGATION_ENDED in state.records


def found_nothing(state: TrainState) -> bool:
    """Return whether propagation has ended, and nothing reflects."""
    return propagation_has_ended(state) and state.records[MOST_REFLECTIVE] < LEAST_REFLECTIVE
