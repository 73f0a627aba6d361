"""Training of `planar`: TR-Gaussians in three stages."""

from __future__ import annotations

import logging
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from glassplat.captures.dataset import Dataset
from glassplat.captures.view import PointCloud
from glassplat.methods.planar_recipe import PlanarRecipe, check_marked
from glassplat.methods.splat import image_term, strategy_of
from glassplat.options import BLACK, CLEAR_GLASS
from glassplat.panes import PlaneFit, PlaneFitError, material
from glassplat.panes.fit import fit_planes, with_mirrors
from glassplat.render.panes import nearest_hits, panes_in_camera
from glassplat.render.planar import Planar, ReflectionGradient
from glassplat.render.splat import Splat
from glassplat.scene import logit
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import mirrored_gaussians
from glassplat.scene.panes import Planes, coplanar_groups, name_labels
from glassplat.scene.scene import Scene, glass_gaussians
from glassplat.training import actions, losses
from glassplat.training.corrections import with_learned_corrections, with_learned_photographer, with_neutral_corrections
from glassplat.training.densify import NEIGHBOURS
from glassplat.training.messages import Working
from glassplat.training.options import PUBLISHED_ITERATIONS, Rate
from glassplat.training.stage import RESET_TURN, AtShares, Clock, Every, PostStep, Stage, TrainState, Work

log = logging.getLogger("glassplat.training")

LEAST_INSIDE_SHARE = 0.25
"""Minimum share of a pane's marked pixels inside the rectangle of planes.json."""
LEAST_COVERAGE = 0.5
"""Share of the reflection covered by Gaussians below which photographs do not show the room directly."""


@dataclass(frozen=True)
class PaneSetup:
    """Fits the planes and places the glass at the start of reflections (Appendix A).

    Attributes:
        recipe: options of panes.
        seed: random seed of the glass Gaussians' positions.
    """

    recipe: PlanarRecipe
    seed: int

    def __call__(self, state: TrainState, dataset: Dataset) -> Work:
        """Edits `state`, and yields its progress."""
        recipe = self.recipe
        yield Working("fitting planes to the masks", 0, 1)
        scene = self.with_glass(state.scene, capture_planes(dataset, state.scene.primary.means, recipe.plane_fit))
        if recipe.detect_mirrors or recipe.plane_fit.mirror_labels:
            # The search for mirrors aligns them.
            scene = self.with_glass(scene, (yield from self.find_mirrors(scene, dataset)))
        planes = scene.planes if recipe.fixed_mirrors else replace(scene.planes, mirrors=())
        state.scene = replace(scene, planes=planes.that_may_tint() if recipe.tint else planes)
        state.statistics.clear()
        for mirrors in coplanar_panes(planes, mirrors=True):
            yield Working(f"moving Gaussians from behind {name_panes(mirrors, 'mirror')} to the front", 0, 1)
            mirror_virtual_gaussians(state, dataset, mirrors)
        for panes in coplanar_panes(planes, mirrors=False) if recipe.seed_reflections else ():
            yield from seed_reflection(state, dataset, panes)
        return True

    def with_glass(self, scene: Scene, planes: Planes) -> Scene:
        """The scene with these planes, and glass on them."""
        glass = glass_gaussians(planes, count=self.recipe.glass_count, seed=self.seed)
        return replace(scene, planes=planes, glass=glass)

    def find_mirrors(self, scene: Scene, dataset: Dataset) -> Generator[Working, None, Planes]:
        """The scene's planes with further mirrors marked and aligned.

        Mirrors named in the recipe are added, otherwise detected ones; planes of planes.json are as stated there.
        """
        fit = self.recipe.plane_fit
        given = Planes.empty() if dataset.planes is None else dataset.planes
        known = scene.planes.mirrors
        fitted = [label for label in scene.planes.labels if label not in (*given.labels, *known)]
        candidates = yield from mirror_candidates(scene, dataset, fitted)
        detected = detected_mirrors(scene.planes, candidates)
        mirrors = tuple(dict.fromkeys((*known, *(fit.mirror_labels or detected))))
        log.info("mirrors among the panes: %s", name_labels(mirrors) or "none")
        aligned = [candidates[label].pane for label in detected if label in mirrors]
        return with_mirrors(with_poses_of(scene.planes, aligned), mirrors, fit.mirror_reflectance)


def with_poses_of(planes: Planes, panes: Sequence[Planes]) -> Planes:
    """The planes with centres and normals replaced from `panes`, single planes by label."""
    centers, normals = planes.centers.clone(), planes.raw_normals.clone()
    for pane in panes:
        row = planes.labels.index(pane.labels[0])
        centers[row], normals[row] = pane.centers[0], pane.raw_normals[0]
    return replace(planes, centers=centers, raw_normals=normals)


def clamp_transmittances(state: TrainState, clock: Clock, visible: Tensor | None) -> None:
    """Clamps log transmittances at 0: glass does not add light."""
    logarithms = state.scene.planes.log_transmittances
    if logarithms is not None:
        logarithms.detach().clamp_(max=0)


def capture_planes(dataset: Dataset, centers: Tensor | None, fit: PlaneFit) -> Planes:
    """The planes of all panes: those of planes.json, and others fitted to masks.

    Args:
        dataset: the capture.
        centers: [N, 3] centres of Gaussians; None for the capture's points.
        fit: options of plane fitting.

    Raises:
        PlaneFitError: the masks do not determine a plane.
    """
    given = Planes.empty() if dataset.planes is None else _prepare_given_planes(dataset.planes, fit)
    labels = [label for label in dataset.pane_labels if label not in given.labels]
    shown = [(view.name, view.camera, view.pane_labels) for view in dataset.train if view.pane_labels is not None]
    if dataset.planes is not None:
        _check_given_planes(dataset.planes, [(camera, seen) for _, camera, seen in shown])
    if not labels and len(given):
        return given if centers is None else given.to(centers.device)
    _check_training_masks(labels, [seen for _, _, seen in shown], dataset)
    points = dataset.points.positions
    fitted = fit_planes(
        points if centers is None else centers,
        [(camera, labels) for _, camera, labels in shown],
        extent=dataset.extent,
        measured=points if dataset.measured_points and centers is not None else None,
        names=[name for name, _, _ in shown],
        labels=labels or None,
        options=fit,
        unmarked=[(view.name, view.camera) for view in dataset.train if view.pane_labels is None],
    )
    return fitted if not len(given) else given.to(fitted.centers.device).concat(fitted)


def _check_given_planes(planes: Planes, masks: Sequence[tuple[Camera, Tensor]]) -> None:
    """Raises PlaneFitError if a plane of planes.json contradicts its masks."""
    for row, label in enumerate(planes.labels):
        marked = inside = 0
        for camera, labels in masks:
            pixels = labels == label
            if (count := int(pixels.sum())) > 0:
                hits = nearest_hits(panes_in_camera(planes.select([row]), camera), camera)
                marked, inside = marked + count, inside + int((pixels & (hits.pane == 0)).sum())
        if inside < LEAST_INSIDE_SHARE * marked:
            raise PlaneFitError(
                f"planes.json and the masks disagree about the position of pane {label}: {inside / marked:.0%} of the "
                "pixels that show it lie in the rectangle of the file. Were the poses estimated anew? Mark it again, "
                "or remove it from the file"
            )


def _check_training_masks(labels: Sequence[int], masks: Sequence[Tensor], dataset: Dataset) -> None:
    """Raises PlaneFitError if only test photographs mark a pane."""
    for label in labels:
        if any(bool((mask == label).any()) for mask in masks):
            continue
        shown = ((view.name, view.pane_labels) for view in dataset.test)
        if held_out := [name for name, seen in shown if seen is not None and bool((seen == label).any())]:
            raise PlaneFitError(
                f"pane {label} is marked only in {', '.join(held_out)}, which are test photographs; expected it "
                "in at least two others, better three, from positions far apart"
            )


def _prepare_given_planes(planes: Planes, fit: PlaneFit) -> Planes:
    """Given rectangles with the margin of fitted ones, marked mirrors, and the initial R0."""
    is_clear = (planes.base_reflectances - CLEAR_GLASS).abs() < 1e-5
    initial = torch.full_like(planes.logit_reflectances, logit(fit.glass_reflectance))
    logits = torch.where(is_clear, initial, planes.logit_reflectances)
    mirrors = tuple(dict.fromkeys((*planes.mirrors, *fit.mirror_labels)))
    log.info("from the capture's planes.json: %s", ", ".join(f"pane {label}" for label in planes.labels))
    prepared = replace(planes, logit_reflectances=logits, half_sizes=fit.margin * planes.half_sizes)
    return with_mirrors(prepared, mirrors, fit.mirror_reflectance)


def mirror_candidates(
    scene: Scene, dataset: Dataset, labels: Sequence[int]
) -> Generator[Working, None, dict[int, material.MirrorCandidate]]:
    """Mirror score of each pane, by label."""
    photographs = material.reduced_photographs(scene, dataset.train) if labels else []
    candidates = {}
    for done, label in enumerate(labels):
        yield Working("detecting mirrors", done, len(labels))
        candidates[label] = material.mirror_candidate(scene, label, photographs)
    return candidates


def detected_mirrors(planes: Planes, candidates: Mapping[int, material.MirrorCandidate]) -> list[int]:
    """Labels of the panes that are mirrors; between panes of glass in the same plane, only if unambiguous."""
    mirrors = {label for label, found in candidates.items() if found.is_mirror}
    rows = [row for row, label in enumerate(planes.labels) if label in candidates]
    for group in coplanar_groups(planes, rows):
        labels = {planes.labels[row] for row in group}
        if any(candidates[label].is_known for label in labels - mirrors):
            mirrors -= {label for label in labels if candidates[label].regression.slope < material.SURE_SLOPE}
    return [label for label in candidates if label in mirrors]


def coplanar_panes(planes: Planes, *, mirrors: bool) -> list[Planes]:
    """The mirrors, or the other panes, grouped by plane.

    Reflections of a glass front lie behind all of its panes, and most views show them through neighbouring ones.
    """
    rows = [row for row, label in enumerate(planes.labels) if (label in planes.mirrors) == mirrors]
    return [planes.select(group) for group in coplanar_groups(planes, rows)]


def name_panes(panes: Planes, kind: str) -> str:
    """Panes in messages: "pane 2", "panes 2, 3", "panes 1 to 24"."""
    return f"{kind}{'s' if len(panes) > 1 else ''} {name_labels(panes.labels)}"


def is_reflection_uncovered(scene: Scene, panes: Planes, cameras: Sequence[Camera]) -> Work:
    """Return whether Gaussians cover almost nothing of the reflections of panes; False if no view shows any."""
    covered, whole = 0.0, 0
    for done, camera in enumerate(cameras):
        yield Working(f"searching for what {name_panes(panes, 'pane')} can reflect", done, len(cameras))
        with torch.no_grad():
            mirrored = material.mirrored_image(replace(scene, planes=panes), camera)
        covered, whole = covered + float(mirrored.coverage.sum()), whole + int(mirrored.seen.sum())
    return covered < LEAST_COVERAGE * whole


def mirror_virtual_gaussians(state: TrainState, dataset: Dataset, mirrors: Planes) -> None:
    """Moves Gaussians of the first stage from behind a mirror, or several in one plane, to their true positions in
    front.
    """
    virtual = material.virtual_points(state.scene.primary.means, mirrors, [view.camera for view in dataset.train])
    if moved := mirror_gaussians(state, virtual, mirrors):
        log.info("%d Gaussians behind %s moved to the front", moved, name_panes(mirrors, "mirror"))


@dataclass(frozen=True)
class DetectMirrors(AtShares):
    """Detects mirrors that were missed in the setup of panes, when Gaussians covered too little of what they reflect.

    If there are any, the glass of all panes is placed anew.

    Attributes:
        panes: the setup of panes, which detected the other mirrors.
    """

    panes: PaneSetup
    name: str = "detect mirrors"

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> Work:
        """Edits `state` if necessary, and yields its progress."""
        known = state.scene.planes.mirrors
        planes = yield from self.panes.find_mirrors(state.scene, dataset)
        rows = [row for row, label in enumerate(planes.labels) if label in planes.mirrors and label not in known]
        if rows:
            state.scene = self.panes.with_glass(state.scene, planes)
            for name in [name for name in state.optimizer.moments if name.startswith("glass.")]:
                del state.optimizer.moments[name]
            state.statistics.clear()
            for mirrors in coplanar_panes(planes.select(rows), mirrors=True):
                mirror_virtual_gaussians(state, dataset, mirrors)
        return bool(rows)


TURN_AFTER = 0.005
"""Share of a run after the start of joint optimisation at which reflections behind glass are moved, and mirrors are
detected again: before the first opacity reset. Repetitions would move real objects."""


@dataclass(frozen=True)
class TurnReflections(AtShares):
    """Moves Gaussians behind panes of glass that represent reflections to their true positions in front
    (lab/layers.md).
    """

    name: str = "turn reflections"

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> Work:
        """Edits `state` if necessary, and yields its progress."""
        cameras = [view.camera for view in dataset.train]
        glass_panes, moved = coplanar_panes(state.scene.planes, mirrors=False), 0
        for done, panes in enumerate(glass_panes):
            yield Working(f"searching behind {name_panes(panes, 'pane')} for reflections", done, len(glass_panes))
            moved += mirror_gaussians(state, material.reflections_behind(state.scene, panes, cameras), panes)
        if moved:
            log.info("%d Gaussians behind glass moved to the front", moved)
        return moved > 0


LAMP_SEARCH_AT, FILL_UNSEEN_AT = (0.4, 0.6), (0.5,)
"""Shares of a run of the search for lamps, and of filling parts that no view shows."""


@dataclass(frozen=True)
class LightLamps(AtShares):
    """Removes images of lamps from behind glass, and makes the lamps as bright as their reflections.

    Attributes:
        renderer: renders the finished scene.
    """

    renderer: Planar
    name: str = "light lamps"

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> Work:
        """Edits `state` if necessary, and yields its progress."""
        yield Working("searching for lamps that panes reflect", 0, 1)
        scene = state.scene
        rows = [row for row, label in enumerate(scene.planes.labels) if label not in scene.planes.mirrors]
        if not rows:
            return False
        photographs = material.reduced_photographs(scene, dataset.train)
        lamps = material.mirrored_lamps(scene, scene.planes.select(rows), photographs, renderer=self.renderer)
        if lamps is None:
            return False
        log_gains = scene.primary.channels["log_intensity"] + lamps.gains.log()
        state.scene = replace(scene, primary=scene.primary.with_tensors({"log_intensity": log_gains}))
        actions.keep_gaussians(state, ~lamps.images)
        count, lit = int(lamps.images.sum()), lamps.gains > 1
        log.info(
            "%d Gaussians behind glass were images of lamps; %d of the lamps are brighter now", count, int(lit.sum())
        )
        return True


@dataclass(frozen=True)
class FillUnseen(AtShares):
    """Adds Gaussians, up to a cap if any, for reflections of objects that no photograph shows and the scene lacks."""

    shares: tuple[float, ...] = FILL_UNSEEN_AT
    cap: int | None = None
    name: str = "fill unseen"

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> Work:
        """Edits `state` if necessary, and yields its progress."""
        cameras, added = [view.camera for view in dataset.train], 0
        glass_panes = coplanar_panes(state.scene.planes, mirrors=False)
        for done, panes in enumerate(glass_panes):
            yield Working(f"searching for what {name_panes(panes, 'pane')} can reflect", done, len(glass_panes))
            positions, color, cell = material.unseen_positions(state.scene, panes, cameras)
            if actions.may_add(len(positions), state.scene.primary, self.cap):
                colors = (255 * color).round().to(torch.uint8).expand(len(positions), 3)
                cloud = PointCloud(positions.cpu(), colors.cpu())
                seeds = actions.make_seeds(state.scene.primary, cloud, opacity=0.7, size=0.7 * cell)
                actions.add_primary_gaussians(state, seeds)
                added += len(positions)
        if added:
            log.info("%d Gaussians added for reflections of unseen parts", added)
        return added > 0


def mirror_gaussians(state: TrainState, virtual: Tensor, panes: Planes) -> int:
    """Mirrors some primary Gaussians at coplanar panes; returns their number."""
    count = int(virtual.sum())
    if count:
        mirrored = mirrored_gaussians(state.scene.primary.select(virtual), panes.centers[0], panes.normals[0])
        actions.keep_gaussians(state, ~virtual)
        actions.add_primary_gaussians(state, mirrored)
    return count


def seed_reflection(state: TrainState, dataset: Dataset, panes: Planes) -> Work:
    """Adds mirror images of SfM points behind coplanar panes that have almost nothing to reflect.

    SfM places points of reflected objects at their virtual positions, behind the pane. In a capture from the front,
    these are the only evidence of reflected objects; mirror images of true points behind the pane are wrong, and fade.
    """
    cameras = [view.camera for view in dataset.train]
    # The coverage is expensive, so it is checked last.
    if not dataset.measured_points or not (yield from is_reflection_uncovered(state.scene, panes, cameras)):
        return False
    points = dataset.points
    device = panes.centers.device
    virtual = material.virtual_points(points.positions.to(device), panes, cameras).cpu()
    if int(virtual.sum()) <= NEIGHBOURS:  # Too few to estimate their size.
        return False
    behind = replace(points, positions=points.positions[virtual], colors=points.colors[virtual])
    seeds = mirrored_gaussians(actions.make_seeds(state.scene.primary, behind), panes.centers[0], panes.normals[0])
    actions.add_primary_gaussians(state, seeds)
    log.info(
        "no photograph directly shows what is reflected by %s: %d points behind added as mirror images in front",
        name_panes(panes, "pane"),
        len(seeds),
    )
    return True


def planar_scene(recipe: PlanarRecipe, dataset: Dataset) -> Scene:
    """The initial scene: one Gaussian per point, without planes.

    Raises:
        PlaneFitError: a mirror is named that is none of the panes, or the masks do not determine a plane. The planes
            are fitted to the measured points once and forgotten, because a bad mask should end a run before the first
            iteration and not at the second stage.
    """
    known = (*dataset.pane_labels, *(() if dataset.planes is None else dataset.planes.labels))
    check_marked(dataset.root, known, is_annotated=any(view.is_annotated for view in (*dataset.train, *dataset.test)))
    if unknown := [label for label in recipe.plane_fit.mirror_labels if label not in known]:
        raise PlaneFitError(f"plane_fit.mirror_labels names pane {unknown[0]}; expected some of {name_labels(known)}")
    if dataset.measured_points:
        capture_planes(dataset, None, recipe.plane_fit)
    scene = Scene(_first_strategy(recipe).initial_gaussians(dataset.points, recipe.sh_degree), dataset.extent)
    return with_neutral_corrections(recipe, scene, dataset)


def planar_renderer(recipe: PlanarRecipe) -> Planar:
    """The renderer of the finished scene, with all its layers."""
    return Planar(
        recipe.background or BLACK,
        fresnel=recipe.fresnel,
        intensity=recipe.intensity,
        blend=recipe.blend,
        nearest_only=recipe.panes == "nearest",
    )


PUBLISHED_SHARES, MOST_FIRST_STEPS = (0.1, 0.1, 0.8), 350
"""Lengths of the three stages (paper), and by default the maximum length of each of the first two: usually enough to
recognise mirrors, which needs opaque Gaussians, but too short to model reflections behind panes well (lab/layers.md).
"""


def stage_shares(given: tuple[float, float, float] | None, iterations: int) -> tuple[float, float, float]:
    """Lengths of the three stages in relation to each other, in a run of some iterations."""
    shares = given or PUBLISHED_SHARES
    if given or shares[0] * iterations <= MOST_FIRST_STEPS:
        return shares
    first = MOST_FIRST_STEPS / iterations
    return first, first, 1 - 2 * first


def planar_stages(recipe: PlanarRecipe, seed: int, iterations: int = PUBLISHED_ITERATIONS) -> tuple[Stage, ...]:
    """Initialisation, plane adjustment, joint optimisation (Section III-C4)."""
    first, second, third = shares = stage_shares(recipe.stage_shares, iterations)
    adjustment, joint = first / sum(shares), (first + second) / sum(shares)
    strategy = _first_strategy(recipe)
    initialisation = Stage(
        name="1 initialisation",
        share=first,
        renderer=Splat(recipe.background or BLACK, depth=False),
        losses=(image_term(recipe.ssim_weight), *strategy.terms),
        rates=recipe.rates.of("primary", recipe.view_dependence_weight),
        actions=(*strategy.edits, actions.GrowSh(Every(recipe.intervals.sh)), *_early_resets(recipe, strategy)),
        post_steps=strategy.post_steps,
        densify_until=strategy.densify_until,
    )
    stages: tuple[Stage, ...] = (
        initialisation,
        _adjustment_stage(recipe, adjustment, second, seed),
        _joint_stage(recipe, joint, third, seed),
    )
    stages = with_learned_photographer(recipe.photographer, stages, recipe.densify, seed)
    return with_learned_corrections(recipe, stages)


JOINT_RATE_FACTOR = 0.1
"""Factor on the learning rates of plane poses in stage 3 (paper)."""


def plane_rates(factor: float = 1.0) -> dict[str, Rate]:
    """Learning rates of planes and glass, which the paper does not give; see lab/training.md. Those of centres, per
    scene extent, and normals are multiplied by a factor.
    """
    return {
        "planes.centers": Rate(1e-4 * factor, per_extent=True),
        "planes.raw_normals": Rate(1e-4 * factor),
        "planes.logit_reflectances": Rate(1e-2),
        "planes.log_transmittances": Rate(5e-3),
        "glass.logit_mark": Rate(5e-2),
    }


def _adjustment_stage(recipe: PlanarRecipe, start: float, share: float, seed: int) -> Stage:
    """Stage 2: the reflection's gradient reaches the planes, not the Gaussians."""
    strategy = _first_strategy(recipe)
    return Stage(
        name="2 plane adjustment",
        share=share,
        renderer=_training_renderer(recipe, "planes"),
        losses=_shared_terms(recipe, strategy),
        rates=_gaussian_rates(recipe) | plane_rates(),
        actions=(
            *strategy.edits,
            actions.GrowSh(Every(recipe.intervals.sh)),
            actions.Densify(recipe.densify, part="glass"),
            *_seed_actions(recipe, start + min(SEED_AFTER_ADJUSTMENT, 0.5 * share)),
            *_early_resets(recipe, strategy),
        ),
        post_steps=(*_glass_post_steps(recipe), *strategy.post_steps),
        setup=PaneSetup(recipe, seed),
        densify_until=recipe.densify.stop,
    )


def _joint_stage(recipe: PlanarRecipe, start: float, share: float, seed: int) -> Stage:
    """Stage 3: joint optimisation, with perturbed opacities and slowly moving planes."""
    strategy = strategy_of(recipe)
    turn = TurnReflections((start + TURN_AFTER,)), LightLamps(LAMP_SEARCH_AT, planar_renderer(recipe))
    detect = DetectMirrors((start + TURN_AFTER,), PaneSetup(recipe, seed))
    is_automatic = recipe.detect_mirrors and recipe.fixed_mirrors and not recipe.plane_fit.mirror_labels
    perturb_at = Every(
        recipe.intervals.opacity,
        start + TURN_AFTER,
        recipe.perturbation.stop,
        recipe.intervals.least,
        skip_multiples_of=RESET_TURN,
    )
    return Stage(
        name="3 joint optimisation",
        share=share,
        renderer=_training_renderer(recipe, "all"),
        losses=_shared_terms(recipe, strategy),
        rates=_gaussian_rates(recipe)
        | plane_rates(JOINT_RATE_FACTOR)
        | ({"primary.log_intensity": Rate(recipe.rates.intensity)} if recipe.intensity else {}),
        actions=(
            *((detect,) if is_automatic else ()),
            *(turn if recipe.turn_reflections else ()),
            *_seed_actions(recipe, start + SEED_AFTER_JOINT),
            *strategy.edits,
            actions.GrowSh(Every(recipe.intervals.sh)),
            actions.Densify(recipe.densify, part="glass"),
            *strategy.resets,
            *_mcmc_resets(recipe, start + MCMC_RESET_AFTER),
            *((FillUnseen(cap=strategy.cap),) if recipe.seed_reflections else ()),
            actions.PerturbOpacity(perturb_at, recipe.perturbation.amplitude, recipe.perturbation.bounds),
        ),
        post_steps=(*_glass_post_steps(recipe), *strategy.post_steps),
        densify_until=recipe.densify.stop,
    )


def _first_strategy(recipe: PlanarRecipe) -> actions.DensificationStrategy:
    """Strategy of the first two stages.

    `mcmc` represents reflections behind glass by many faint Gaussians at noisy positions, which are hard to recognise.
    If they are to be moved to the front, it begins after these stages (lab/gaussians.md#mcmc).
    """
    if recipe.strategy != "mcmc" or not recipe.turn_reflections:
        return strategy_of(recipe)
    densify = actions.Densify(recipe.densify, mcmc=recipe.mcmc)
    return replace(strategy_of(replace(recipe, strategy="default")), edits=(densify,), cap=recipe.mcmc.cap)


def _gaussian_rates(recipe: PlanarRecipe) -> dict[str, Rate]:
    """Learning rates of primary and glass Gaussians."""
    return recipe.rates.of("primary", recipe.view_dependence_weight) | recipe.rates.of("glass")


def _glass_post_steps(recipe: PlanarRecipe) -> tuple[PostStep, ...]:
    """Steps that clamp transmittances, before parameters are averaged."""
    return (clamp_transmittances,) if recipe.tint else ()


def _shared_terms(recipe: PlanarRecipe, strategy: actions.DensificationStrategy) -> tuple[losses.LossTerm, ...]:
    """The terms of both stages with reflections whose weight is not zero."""
    weights = recipe.weights
    conflict = losses.cell_gradient_conflict if recipe.conflict == "cells" else losses.gradient_conflict
    reflectance = losses.ReflectancePrior(recipe.plane_fit.glass_reflectance)
    of_reflection = losses.weighted_terms(
        losses.LossTerm("depth", weights.depth, losses.depth_deviation),
        losses.LossTerm("conflict", weights.conflict, conflict),
        losses.LossTerm("mask", weights.mask, losses.mask_difference),
        losses.LossTerm("intensity", weights.intensity, losses.intensity_prior),
        losses.LossTerm("reflectance", weights.reflectance, reflectance),
        losses.LossTerm("tint", recipe.tint_weight if recipe.tint else 0.0, losses.tint_prior),
    )
    return (image_term(recipe.ssim_weight), *of_reflection, *strategy.terms)


def _early_resets(recipe: PlanarRecipe, strategy: actions.DensificationStrategy) -> tuple[actions.ResetOpacity, ...]:
    """The opacity resets of the first two stages, if enabled."""
    return strategy.resets if recipe.early_resets else ()


SEED_AFTER_ADJUSTMENT, SEED_AFTER_JOINT = 0.005, 0.003
"""Shares of a run after the start of plane adjustment and of joint optimisation at which missing objects are searched
for: early, but with known panes, behind which nothing is added."""


def _seed_actions(recipe: PlanarRecipe, share: float) -> tuple[actions.SeedUnexplained, ...]:
    """The search for missing objects, if enabled."""
    seed = actions.SeedUnexplained((share,), planar_renderer(recipe), strategy_of(recipe).cap)
    return (seed,) if recipe.seed_unexplained else ()


MCMC_RESET_AFTER = 0.02
"""Share of a run after the start of joint optimisation at which `mcmc` resets opacities: after reflections behind
glass were moved, which needs opaque Gaussians."""


def _mcmc_resets(recipe: PlanarRecipe, start: float) -> tuple[actions.ResetOpacity, ...]:
    """The single reset of `mcmc`, after a share of the run; `default` has its own."""
    # A second one would be after the stop.
    once = Every(start, stop=1.5 * start)
    return (actions.ResetOpacity(once),) if recipe.strategy == "mcmc" and recipe.turn_reflections else ()


def _training_renderer(recipe: PlanarRecipe, gradient: ReflectionGradient) -> Planar:
    return replace(
        planar_renderer(recipe),
        reflection_gradient=gradient,
        deviation=recipe.weights.depth != 0,
        deviation_depth_gradient=recipe.moving_mean,
        separate_mirrored=recipe.densify_by == "direct",
    )
