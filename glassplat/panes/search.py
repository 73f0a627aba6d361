"""The search for a pane's plane: hypotheses from points and masks, ranked and refined by the masks.

If a pane mirrors many measured points, these help to position it.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from glassplat.kernels.plane_search import Field, sum_mirrored
from glassplat.panes.masks import FramedPlanes, join_planes, random_planes
from glassplat.panes.objective import (
    COARSE_TOLERANCE,
    EDGE_POINTS,
    MIDDLE_TOLERANCE,
    TOLERANCES,
    USUAL_FRAME,
    JointObjective,
    Objective,
    Terms,
    move_planes,
    planes_through_masks,
    sample_nearby,
)

Array = NDArray[np.float64]
Evidence = Objective | JointObjective

ITERATIONS = 15
"""Maximum number of Gauss-Newton steps for each tolerance."""
STEP = 3e-4
"""Step of the numerical derivative, a fraction of a pixel: in radians, distances of the cameras, scene extents."""
SMALLEST_CURVATURE = 1e-12
"""Added to the Gauss-Newton matrix, in the units of `_scales`, so that parameters without influence stay."""
FIRST_DAMPING, DAMPING_DECREASE, DAMPING_INCREASE = 1e-2, 0.3, 5.0
"""Damping as a share of the matrix's diagonal, and its factors after steps that lower the cost and that do not."""
NOTICEABLE_CHANGE = 0.01
"""Change of the cost that counts as noticeable, as a share of its maximum."""
CONVERGED_CHANGE = 1e-4
"""Change of a parameter below which a plane has converged."""


def refine_planes(planes: FramedPlanes, objective: Evidence, tolerances: Sequence[float]) -> FramedPlanes:
    """Each plane after minimising the objective over tilt, offset and height of the frame.

    The Geman-McClure loss ignores outliers, as it must: where the pane is occluded, the mask's edge is not the pane's
    and matches no other view.

    Args:
        planes: H planes to start from.
        objective: evidence for the plane.
        tolerances: distances of mask edges at which the loss is one half, in image diagonals, applied in sequence.
    """
    for tolerance in tolerances:
        planes = _minimise(planes, objective, tolerance)
    return planes


def _minimise(planes: FramedPlanes, objective: Evidence, tolerance: float) -> FramedPlanes:
    """All planes after damped Gauss-Newton steps; converged planes are moved no further."""
    count = len(planes)
    damping, active = np.full(count, FIRST_DAMPING), np.arange(count)
    anchors, scales = objective.anchors(planes), _scales(planes, objective)
    for _ in range(ITERATIONS):
        moving = planes.select(active)
        cost, hessian, gradient = _gauss_newton(moving, objective, tolerance, anchors[active], scales[active])
        diagonal = np.einsum("hii->hi", hessian) + np.finfo(np.float64).eps
        damped = hessian + (damping[active, None] * diagonal)[:, None] * np.eye(4)
        steps = -np.linalg.solve(damped + SMALLEST_CURVATURE * np.eye(4), gradient[..., None])[..., 0]
        moved = _step_planes(moving, anchors[active], steps * scales[active])
        better = objective.terms(moved, tolerance).cost < cost
        chosen = np.arange(count)
        chosen[active[better]] = count + np.flatnonzero(better)
        planes = join_planes([planes, moved]).select(chosen)
        damping[active] *= np.where(better, DAMPING_DECREASE, DAMPING_INCREASE)
        active = active[np.abs(steps).max(axis=1) > CONVERGED_CHANGE]
        if not len(active):
            break
    return planes


def _scales(planes: FramedPlanes, objective: Evidence) -> Array:
    """[H, 4] units of each plane's parameters: a radian for two tilts, a distance of the cameras, a scene extent."""
    ones = np.ones(len(planes))
    return np.stack([ones, ones, objective.camera_distance(planes), objective.extent * ones], axis=1)


def _gauss_newton(
    planes: FramedPlanes, objective: Evidence, tolerance: float, anchors: Array, scales: Array
) -> tuple[Array, Array, Array]:
    """The cost [H] of planes, and its Gauss-Newton matrix [H, 4, 4] and gradient [H, 4] (halved)."""
    here, moved_residuals = _perturbed_terms(planes, objective, tolerance, anchors, scales)
    jacobian = (moved_residuals - here.residuals) / STEP
    weighted = jacobian * _loss_weights(here)
    return here.cost, _derivative_products(weighted, jacobian), np.einsum("ahm,hm->ha", weighted, here.residuals)


def _perturbed_terms(
    planes: FramedPlanes, objective: Evidence, tolerance: float, anchors: Array, scales: Array
) -> tuple[Terms, Array]:
    """The terms of planes, and the residuals [4, H, M] after a small step along each axis."""
    count = len(planes)
    nearby = [planes]
    for axis in range(4):
        nearby.append(_step_planes(planes, anchors, STEP * np.eye(4)[axis] * scales))
    terms = objective.terms(join_planes(nearby), tolerance)
    residuals = terms.residuals.reshape(5, count, -1)
    return Terms(residuals[0], terms.weights[:count], terms.rest[:count]), residuals[1:]


def _loss_weights(terms: Terms) -> Array:
    """[H, M] weights with which least squares have the gradient of the Geman-McClure loss."""
    weights: Array = terms.weights / (1 + terms.residuals**2) ** 2
    return weights


def _derivative_products(first: Array, second: Array) -> Array:
    """[H, 4, 4] sums of products of derivatives [4, H, M]."""
    found: Array = np.einsum("ahm,bhm->hab", first, second)
    return found


def _step_planes(planes: FramedPlanes, anchors: Array, steps: Array) -> FramedPlanes:
    """The planes after steps [H, 4]: two tilts, a shift, and a change of the frame's height, clamped at 0."""
    return replace(move_planes(planes, anchors, steps[:, :3]), frames=np.maximum(planes.frames + steps[:, 3], 0))


def tilt_uncertainty(planes: FramedPlanes, objective: Evidence, tolerance: float) -> Array:
    """[H] angle in radians by which each plane can tilt before its cost changes by `NOTICEABLE_CHANGE`.

    It follows from the Gauss-Newton matrix at the plane, where shift and frame height are free to adapt.
    """
    anchors, scales = objective.anchors(planes), _scales(planes, objective)
    here, residuals = _perturbed_terms(planes, objective, tolerance, anchors, scales)
    # Where an edge point enters or leaves an image, its residual jumps from or to zero, which is not a derivative.
    jacobian = np.where((residuals == 0) == (here.residuals == 0), residuals - here.residuals, 0) / STEP
    hessian = _derivative_products(jacobian * _loss_weights(here), jacobian)
    tilt_covariance = np.linalg.inv(hessian + SMALLEST_CURVATURE * np.eye(4))[:, :2, :2]
    widest: Array = np.sqrt(NOTICEABLE_CHANGE * np.linalg.eigvalsh(tilt_covariance)[:, -1])
    return widest


AGREEMENT_WEIGHT = 0.1
"""Weight of the agreement of the masks relative to that of their edges, which account for frames."""
POOL_SIZE, LEAST_OF_BEST = 200, 0.5
"""Number of hypotheses with the best mask agreement whose edges are compared, and the share of the best agreement below
which edges are not considered."""
KEPT_BY_AREAS, KEPT_BY_EDGES, SAMPLES_EACH = 12, 6, 30
"""Number of hypotheses that are kept for the agreement of masks, and for that of edges, and of the planes tried around
each of them in each round."""
SEARCH_ROUNDS = ((0.3, 0.1, 2 * COARSE_TOLERANCE), (0.1, 0.03, COARSE_TOLERANCE))
"""Spread of these (radians, distances of the cameras from the pane) and tolerance of the edges, for each round."""
PERTURBATION = (0.03, 0.01, MIDDLE_TOLERANCE)
"""The same for the last round, between two refinements."""
MOST_STARTS = 6
"""Maximum number of planes from which the search for a joint plane starts."""
FRAME_SPREAD = 0.5
"""Standard deviation of the logarithm of the height of frames in each round."""
COARSE_EDGES = 200
"""Number of edge points over all views together, while there are many hypotheses."""
HIGHEST_FRAME = 0.1
"""Height of a frame above its glass, in scene extents, above which a plane is treated as wrong."""


def best_plane(objective: Objective, *, hypotheses: int, refine: int, rng: np.random.Generator) -> FramedPlanes:
    """The one plane on which the masks of all views coincide best.

    Hypotheses pass through triplets of points, as in RANSAC, and through pixels of the masks, because a pane may have
    no points on its frame. The agreement of the masks ranks them. The best ones are improved by random search, refined,
    perturbed and refined again, because the loss has many local minima where posts or plants occlude parts of the pane.

    Args:
        objective: views of the pane, at least two, and candidate points, possibly none.
        hypotheses: number of planes drawn through triplets of points, and again through the masks.
        refine: number of planes in the last refinement.
        rng: source of randomness.
    """
    beam = first_hypotheses(objective, hypotheses, rng)
    for search_round in SEARCH_ROUNDS:
        beam = _follow_beam(beam, objective, search_round, rng)
    # If a pane is occluded in every mask, planes far behind impossibly high frames may fit better than its own.
    beam = _possible_frames(_best_planes(refine_planes(beam, objective, TOLERANCES[:2]), objective), objective)
    perturbed = _follow_beam(beam, objective, PERTURBATION, rng)
    best_first = np.argsort(contradiction(beam, objective, TOLERANCES[:2]), kind="stable")
    leading = join_planes([beam.select(best_first[:refine]), perturbed.select(np.arange(min(refine, len(perturbed))))])
    finished = _possible_frames(_best_planes(refine_planes(leading, objective, TOLERANCES[1:]), objective), objective)
    return finished.select(np.array([np.argmin(contradiction(finished, objective))]))


def best_joint_plane(objective: JointObjective, starts: FramedPlanes, rng: np.random.Generator) -> FramedPlanes:
    """The one plane on which the masks of several panes coincide best, near the planes of the single panes.

    Args:
        objective: evidence for all panes.
        starts: the plane of each pane, fitted alone; of many, only those on which all masks coincide best are used.
        rng: source of randomness.
    """
    beam = starts
    if len(starts) > MOST_STARTS:
        costs = contradiction(starts, objective, (COARSE_TOLERANCE,), edges=COARSE_EDGES)
        beam = starts.select(np.argsort(costs, kind="stable")[:MOST_STARTS])
    for search_round in (*SEARCH_ROUNDS[1:], PERTURBATION):
        beam = join_planes([beam, _follow_beam(beam, objective, search_round, rng)])
    finished = _possible_frames(refine_planes(beam, objective, TOLERANCES), objective)
    return finished.select(np.array([np.argmin(contradiction(finished, objective))]))


def contradiction(
    planes: FramedPlanes, objective: Evidence, tolerances: tuple[float, ...] = TOLERANCES, *, edges: int = EDGE_POINTS
) -> Array:
    """[H] evidence against planes: cost, averaged over tolerances, less mask agreement; no unit, near 0 on the pane."""
    costs = [objective.terms(planes, tolerance, edges=edges).cost for tolerance in tolerances]
    mean: Array = np.mean(costs, axis=0) - AGREEMENT_WEIGHT * objective.agreement(planes)
    return mean


def first_hypotheses(objective: Objective, count: int, rng: np.random.Generator) -> FramedPlanes:
    """The planes, of those drawn through points and masks, on which the masks or their edges agree best.

    Areas guide the search from afar. But if a pane fills most of the photographs, they agree by more than nine tenths
    even on planes that are off by a right angle, and only edges discriminate.
    """
    drawn = [planes_through_masks(objective.views, count, rng)]
    if len(objective.points) >= 3:
        through = random_planes(objective.points, count, rng)
        drawn.append(through.select(np.argsort(-objective.inlier_share(through), kind="stable")[: count // 4]))
    planes = join_planes(drawn)
    planes = replace(planes, frames=np.full(len(planes), USUAL_FRAME * objective.extent))
    scores = objective.agreement(planes) + AGREEMENT_WEIGHT * objective.inlier_share(planes)
    pool = planes.select(np.argsort(-scores, kind="stable")[:POOL_SIZE])
    best_first = _best_planes(pool, objective, least=KEPT_BY_AREAS)
    costs = contradiction(best_first, objective, (SEARCH_ROUNDS[0][2],), edges=COARSE_EDGES)
    by_edges = np.argsort(costs, kind="stable")
    by_areas = np.arange(len(best_first))[:KEPT_BY_AREAS]
    return best_first.select(np.concatenate([by_areas, by_edges[by_edges >= KEPT_BY_AREAS][:KEPT_BY_EDGES]]))


def _follow_beam(
    beam: FramedPlanes, objective: Evidence, search_round: tuple[float, float, float], rng: np.random.Generator
) -> FramedPlanes:
    """The best of the planes sampled around each plane of the beam, best first."""
    tilt, shift, tolerance = search_round
    shifts = shift * objective.camera_distance(beam)
    around = sample_nearby(beam, objective.anchors(beam), SAMPLES_EACH, tilt=tilt, shift=shifts, rng=rng)
    factors = np.exp(FRAME_SPREAD * rng.standard_normal((len(beam), 1 + SAMPLES_EACH)))
    factors[:, 0] = 1
    family = replace(around, frames=(beam.frames[:, None] * factors).ravel())
    costs = objective.terms(family, tolerance, edges=COARSE_EDGES).cost.reshape(factors.shape)
    best = np.arange(len(beam)) * (1 + SAMPLES_EACH) + costs.argmin(axis=1)
    return family.select(best[np.argsort(costs.min(axis=1), kind="stable")])


def _possible_frames(planes: FramedPlanes, objective: Evidence) -> FramedPlanes:
    """The planes whose frames have a possible height; all planes if there are none."""
    kept = np.flatnonzero(_has_possible_frames(planes, objective))
    return planes.select(kept) if len(kept) else planes


def _has_possible_frames(planes: FramedPlanes, objective: Evidence) -> NDArray[np.bool_]:
    """[K] bool: planes whose frames have a possible height."""
    possible: NDArray[np.bool_] = planes.frames <= HIGHEST_FRAME * objective.extent
    return possible


def _best_planes(planes: FramedPlanes, objective: Evidence, *, least: int = 0) -> FramedPlanes:
    """The first `least` planes, and all others whose mask agreement is not far below the best.

    Where other panes or posts occlude much of a pane, edges that meet by chance may fit better than its own.
    """
    agreement = objective.agreement(planes)
    kept = (agreement >= LEAST_OF_BEST * agreement.max()) | (np.arange(len(planes)) < least)
    return planes.select(np.flatnonzero(kept))


log = logging.getLogger("glassplat.panes")


class PlaneCandidate(NamedTuple):
    """A plane, and the name of the points that it was fitted to."""

    source: str
    plane: FramedPlanes


def score(plane: FramedPlanes, evidence: Objective) -> float:
    """Support of masks and points for a plane, free of scale: 1 if all outlines meet and all points lie on it."""
    return 1 - float(contradiction(plane, evidence)[0])


def highest_scoring_plane(label: int, fits: Sequence[PlaneCandidate], evidence: Objective) -> FramedPlanes:
    """The plane with the highest score, the first one of equals; logs all scores.

    Planes behind impossibly high frames count only if there are no others.

    Args:
        label: of the pane.
        fits: at least one.
        evidence: the masks, and measured points rather than points made by training. A first scene explains reflections
            by Gaussians behind the pane, many of them in empty space.
    """
    scores = [score(fit.plane, evidence) for fit in fits]
    possible = [n for n, fit in enumerate(fits) if _has_possible_frames(fit.plane, evidence)[0]]
    kept = max(possible or range(len(fits)), key=scores.__getitem__)
    for fit, found in zip(fits, scores, strict=True):
        apart = np.degrees(angle(fit.plane, fits[kept].plane))
        verdict = "kept" if fit is fits[kept] else f"{apart:.2f} degrees from the one that is kept"
        log.debug(
            "pane %d: the plane fitted to %s scores %.3f, with %.0f %% of %d points along its edge on it; %s",
            label, fit.source, found, 100 * evidence.inlier_share(fit.plane)[0], len(evidence.points), verdict,
        )  # fmt: skip
    return fits[kept].plane


def angle(one: FramedPlanes, other: FramedPlanes) -> float:
    """Angle in radians between the first planes of two sets, regardless of the signs of their normals."""
    first, second = one.normals[0], other.normals[0]
    return float(np.arctan2(np.linalg.norm(np.cross(first, second)), abs(first @ second)))


IMAGE_TILT, IMAGE_TILT_STEP = 15.0, 0.75
"""Range and step of both tilts in the search around the plane of the masks, in degrees."""
IMAGE_SHIFT, IMAGE_SHIFT_STEP = 0.06, 0.01
"""The same for the shift, in scene extents."""
IMAGE_TOLERANCE = 0.01
"""Standard deviation of the distance between a point and the mirror image of another that match, in scene extents."""
LEAST_IMAGES, LEAST_PEAK, PEAK_WIDTH = 12.0, 1.4, 3.0
"""Pairs of points and mirror images that determine a plane, and their minimum ratio to those of any plane tilted by
more than the given degrees. Of 27 panes in synthetic rooms, 10 have such a peak, within 0.6 degrees of the truth."""
MOST_BEFORE = 0.5
"""Share of the pairs that the plane of the masks needs to count as equally good."""
MOST_IMAGES, MOST_CELLS = 500, 200
"""Maximum number of points that are mirrored, and of cells of the field of the others along its longest side."""
HALVINGS = 4
"""Refinements of the best plane, each with half the steps of the one before."""


class MirrorImages(NamedTuple):
    """The plane about which measured points are mirror images of others.

    Attributes:
        plane: H = 1 plane.
        pairs: number of pairs of a point and a mirror image, each weighted by proximity.
        before: number of pairs on the plane at which the search starts.
        peak: ratio of the number of pairs to that of the best plane tilted elsewhere.
    """

    plane: FramedPlanes
    pairs: float
    before: float
    peak: float

    @property
    def is_clear(self) -> bool:
        """Return whether the pairs determine a plane, and another one than before."""
        elsewhere = self.before < MOST_BEFORE * self.pairs
        return elsewhere and self.pairs >= LEAST_IMAGES and self.peak >= LEAST_PEAK


def plane_of_mirror_images(
    plane: FramedPlanes, middle: Array, behind: Array, others: Array, extent: float
) -> MirrorImages | None:
    """The plane near the first one of `plane` that maps most points seen through a pane onto others.

    Structure from motion places points on mirrored objects at their virtual positions. The true plane of a mirror maps
    them onto the objects themselves, which a plane of ragged masks misses by twice its error. Behind glass they are few
    among real points, which match others by chance.

    Args:
        plane: at which the search starts.
        middle: [3] point of the pane, about which planes are tilted.
        behind: [V, 3] points that are seen through the pane.
        others: [P, 3] all other points.
        extent: radius of the capture in world units.

    Returns:
        The best plane, clear or not; None if there are too few points.
    """
    if len(behind) < LEAST_IMAGES or len(others) < LEAST_IMAGES:
        return None
    from scipy.spatial import cKDTree

    behind = behind[np.random.default_rng(0).permutation(len(behind))[:MOST_IMAGES]]
    tolerance = IMAGE_TOLERANCE * extent
    near = _proximity_field(others, tolerance)
    turns = np.tan(np.radians(np.arange(-IMAGE_TILT, IMAGE_TILT + 1e-9, IMAGE_TILT_STEP)))
    shifts = extent * np.arange(-IMAGE_SHIFT, IMAGE_SHIFT + 1e-9, IMAGE_SHIFT_STEP)

    def moved_planes(steps: Array) -> FramedPlanes:
        index = np.zeros(len(steps), np.int64)
        return move_planes(plane.select(index), middle[None][index], steps)

    steps = np.stack(np.meshgrid(turns, turns, shifts, indexing="ij"), axis=-1)
    planes = moved_planes(steps.reshape(-1, 3))
    counts = sum_mirrored(planes.normals, planes.offsets, behind, near).reshape(steps.shape[:3])
    best = steps[np.unravel_index(counts.argmax(), counts.shape)]
    tilts = np.arctan(steps[..., :2]) - np.arctan(best[:2])
    elsewhere = counts[np.linalg.norm(tilts, axis=-1) > np.radians(PEAK_WIDTH)].max()
    # The cells of the field are coarse; exact distances refine the plane within a step.
    tree = cKDTree(others)

    def pairs(steps: Array) -> Array:
        planes = moved_planes(steps)
        images = behind - 2 * planes.distances(behind)[..., None] * planes.normals[:, None]
        return np.asarray(np.exp(-0.5 * (tree.query(images)[0] / tolerance) ** 2).sum(axis=1))

    size = np.array([np.radians(IMAGE_TILT_STEP), np.radians(IMAGE_TILT_STEP), extent * IMAGE_SHIFT_STEP])
    for _ in range(HALVINGS):
        size = size / 2
        around = best + size * (np.indices((3, 3, 3)).reshape(3, -1).T - 1)
        best = around[pairs(around).argmax()]
    found, before = pairs(np.stack([best, np.zeros(3)]))
    peak = counts.max() / max(elsewhere, np.finfo(np.float64).tiny)
    return MirrorImages(moved_planes(best[None]), float(found), float(before), float(peak))


def _proximity_field(points: Array, tolerance: float) -> Field:
    """Proximity to the points, from 1 at a point to 0 far away; Gaussian, with the tolerance as standard deviation.

    The outermost points are left out.
    """
    from scipy import ndimage

    low, high = np.percentile(points, (1, 99), axis=0)
    inner = points[((points >= low) & (points <= high)).all(axis=1)]
    cell = max(tolerance / 2, float((high - low).max()) / MOST_CELLS)
    corner = low - 4 * cell
    shape = np.ceil((high - corner) / cell).astype(np.int64) + 5
    empty = np.ones(shape, np.bool_)
    empty[tuple(((inner - corner) / cell).astype(np.int64).T)] = False
    nearest = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    # Squared distances in cells are small whole numbers, so that each is converted once.
    squared = sum((there - here) ** 2 for there, here in zip(nearest, np.ogrid[tuple(map(slice, shape))], strict=True))
    away = (cell / tolerance) * np.sqrt(np.arange(squared.max() + 1))
    return Field(np.exp(-0.5 * away**2).astype(np.float32)[squared], corner, cell)
