"""The search for a pane's plane: hypotheses from points and masks, judged and refined by the masks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from glassplat.init.consistency import mask_agreement
from glassplat.init.plane_moves import planes_nearby, planes_through_masks
from glassplat.init.plane_objective import COARSE, FINE, MIDDLE, USUAL_FRAME, Objective
from glassplat.init.plane_refinement import refined
from glassplat.init.ransac import FramedPlanes, joined, random_planes

Array = NDArray[np.float64]

AGREEMENT_WEIGHT = 0.1
"""Weight of the agreement of the masks against that of their edges, which know of frames."""
BEAM, CHILDREN = 12, 30
"""Number of hypotheses that are followed, and of the planes tried around each of them in each round."""
ROUNDS = ((0.3, 0.1, 2 * COARSE), (0.1, 0.03, COARSE))
"""Spread of these (radians, distances of the cameras from the pane) and tolerance of the edges, for each round."""
SHAKE = (0.03, 0.01, MIDDLE)
"""The same for the last round, between two refinements."""
FRAME_SPREAD = 0.5
"""Standard deviation of the logarithm of the height of frames in each round."""
COARSE_EDGES = 200
"""Edge points, in all views together, while hypotheses are many."""
PIXELS = 600
"""Pixels whose rays are followed to compare masks, in all views together."""


def best_plane(objective: Objective, *, hypotheses: int, refine: int, rng: np.random.Generator) -> FramedPlanes:
    """The one plane on which the masks of all views coincide best.

    Hypotheses pass through triplets of points, as in RANSAC, and through pixels of the masks, because a pane may have
    no points on its frame. The agreement of the masks ranks them. The best ones are followed by random search, refined,
    shaken and refined again, as the loss has many local minima where posts or plants hide parts of the pane.

    Args:
        objective: views of the pane, at least two, and candidate points, of which there may be none.
        hypotheses: number of planes drawn through triplets of points, and again through the masks.
        refine: number of planes that are refined at last.
        rng: source of randomness.
    """
    beam = _hypotheses(objective, hypotheses, rng)
    for tilt, shift, tolerance in ROUNDS:
        beam = _followed(beam, objective, (tilt, shift), tolerance, rng)
    beam = refined(beam, objective, (COARSE, MIDDLE))
    tilt, shift, tolerance = SHAKE
    shaken = _followed(beam, objective, (tilt, shift), tolerance, rng)
    best_first = np.argsort(_cost(beam, objective, (COARSE, MIDDLE)), kind="stable")
    leading = joined([beam.select(best_first[:refine]), shaken.select(np.arange(min(refine, len(shaken))))])
    finished = refined(leading, objective, (MIDDLE, FINE))
    return finished.select(np.array([np.argmin(_cost(finished, objective, (COARSE, MIDDLE, FINE)))]))


def _hypotheses(objective: Objective, count: int, rng: np.random.Generator) -> FramedPlanes:
    """The planes, of those drawn through points and masks, on which the masks agree best."""
    drawn = [planes_through_masks(objective.views, count, rng)]
    if len(objective.points) >= 3:
        through = random_planes(objective.points, count, rng)
        drawn.append(through.select(np.argsort(-objective.support(through), kind="stable")[: count // 4]))
    usual = USUAL_FRAME * objective.extent
    planes = joined([FramedPlanes(part, np.full(len(part), usual)) for part in drawn])
    scores = _agreement(planes, objective) + AGREEMENT_WEIGHT * objective.support(planes.planes)
    return planes.select(np.argsort(-scores, kind="stable")[:BEAM])


def _followed(
    beam: FramedPlanes, objective: Objective, spread: tuple[float, float], tolerance: float, rng: np.random.Generator
) -> FramedPlanes:
    """The best plane around each of the beam's, best first."""
    tilt, shift = spread
    shifts = shift * objective.reach(beam.planes)
    around = planes_nearby(beam.planes, objective.anchors(beam.planes), CHILDREN, tilt=tilt, shift=shifts, rng=rng)
    factors = np.exp(FRAME_SPREAD * rng.standard_normal((len(beam), 1 + CHILDREN)))
    factors[:, 0] = 1
    family = FramedPlanes(around, (beam.frames[:, None] * factors).ravel())
    costs = objective.terms(family, tolerance, edges=COARSE_EDGES).cost.reshape(factors.shape)
    best = np.arange(len(beam)) * (1 + CHILDREN) + costs.argmin(axis=1)
    return family.select(best[np.argsort(costs.min(axis=1), kind="stable")])


def _cost(planes: FramedPlanes, objective: Objective, tolerances: tuple[float, ...]) -> Array:
    """[H] what tells against planes, their masks included, at several tolerances."""
    costs = [objective.terms(planes, tolerance).cost for tolerance in tolerances]
    mean: Array = np.mean(costs, axis=0) - AGREEMENT_WEIGHT * _agreement(planes, objective)
    return mean


def _agreement(planes: FramedPlanes, objective: Objective) -> Array:
    return mask_agreement(planes.planes, objective.views, pixels_per_view=PIXELS // len(objective.views))
