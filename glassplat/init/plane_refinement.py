"""Planes moved to where the masks agree best, many at a time: Levenberg-Marquardt with reweighting."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from glassplat.init.plane_moves import moved
from glassplat.init.plane_objective import Objective, Terms
from glassplat.init.ransac import FramedPlanes, joined

Array = NDArray[np.float64]

ITERATIONS = 15
STEP = 3e-4
"""Step of the numerical derivative: radians, distances of the cameras, scene extents. A fraction of a pixel."""
SMALLEST_CURVATURE = 1e-12
FIRST_DAMPING, EASE, STIFFEN = 1e-2, 0.3, 5.0
NOTICEABLE = 0.01
"""Share of the largest possible cost."""
SETTLED = 1e-4
"""Change of a parameter below which a plane has arrived."""


def refined(planes: FramedPlanes, objective: Objective, tolerances: Sequence[float]) -> FramedPlanes:
    """Each plane after tilt, offset and height of the frame have minimised the objective.

    The Geman-McClure loss ignores what is far off, and it must: where something stands before the pane, the mask's edge
    is not the pane's and matches no other view.

    Args:
        planes: H planes to start from.
        objective: what is known about the pane.
        tolerances: distances of mask edges at which the loss is one half, in image diagonals, one after the other.
    """
    for tolerance in tolerances:
        planes = _minimised(planes, objective, tolerance)
    return planes


def _minimised(planes: FramedPlanes, objective: Objective, tolerance: float) -> FramedPlanes:
    """All planes after damped steps; those that have arrived are left where they are."""
    count = len(planes)
    damping, active = np.full(count, FIRST_DAMPING), np.arange(count)
    anchors, scales = objective.anchors(planes.planes), _scales(planes, objective)
    for _ in range(ITERATIONS):
        moving = planes.select(active)
        cost, hessian, gradient = _quadratic(moving, objective, tolerance, anchors[active], scales[active])
        diagonal = np.einsum("hii->hi", hessian) + np.finfo(np.float64).eps
        damped = hessian + (damping[active, None] * diagonal)[:, None] * np.eye(4)
        steps = -np.linalg.solve(damped + SMALLEST_CURVATURE * np.eye(4), gradient[..., None])[..., 0]
        tried = _stepped(moving, anchors[active], steps * scales[active])
        better = objective.terms(tried, tolerance).cost < cost
        planes = _replaced(planes, active[better], tried.select(np.flatnonzero(better)))
        damping[active] *= np.where(better, EASE, STIFFEN)
        active = active[np.abs(steps).max(axis=1) > SETTLED]
        if not len(active):
            break
    return planes


def _scales(planes: FramedPlanes, objective: Objective) -> Array:
    """[H, 4] what a step of one means for each plane: a radian twice, a distance of the cameras, a scene extent."""
    ones = np.ones(len(planes))
    return np.stack([ones, ones, objective.reach(planes.planes), objective.extent * ones], axis=1)


def _quadratic(
    planes: FramedPlanes, objective: Objective, tolerance: float, anchors: Array, scales: Array
) -> tuple[Array, Array, Array]:
    """The cost [H] of planes, and its Gauss-Newton matrix [H, 4, 4] and gradient [H, 4] (halved)."""
    here, moved_residuals = _nearby(planes, objective, tolerance, anchors, scales)
    jacobian = (moved_residuals - here.residuals) / STEP
    weighted = jacobian * _pull(here)
    return here.cost, _products(weighted, jacobian), np.einsum("ahm,hm->ha", weighted, here.residuals)


def _nearby(
    planes: FramedPlanes, objective: Objective, tolerance: float, anchors: Array, scales: Array
) -> tuple[Terms, Array]:
    """The terms of planes, and the residuals [4, H, M] after a small step along each axis."""
    count = len(planes)
    nearby = [planes]
    for axis in range(4):
        nearby.append(_stepped(planes, anchors, STEP * np.eye(4)[axis] * scales))
    terms = objective.terms(joined(nearby), tolerance)
    residuals = terms.residuals.reshape(5, count, -1)
    return Terms(residuals[0], terms.weights[:count], terms.rest[:count]), residuals[1:]


def _pull(terms: Terms) -> Array:
    """[H, M] weights with which least squares have the slope of the Geman-McClure loss."""
    weights: Array = terms.weights / (1 + terms.residuals**2) ** 2
    return weights


def _products(first: Array, second: Array) -> Array:
    """[H, 4, 4] sums of products of slopes [4, H, M]."""
    found: Array = np.einsum("ahm,bhm->hab", first, second)
    return found


def _stepped(planes: FramedPlanes, anchors: Array, steps: Array) -> FramedPlanes:
    """The planes after steps [H, 4]: two tilts, a shift, a change of the frame, which has no negative height."""
    return FramedPlanes(moved(planes.planes, anchors, steps[:, :3]), np.maximum(planes.frames + steps[:, 3], 0))


def _replaced(planes: FramedPlanes, index: NDArray[np.int64], others: FramedPlanes) -> FramedPlanes:
    """The planes, with those at `index` replaced by others."""
    order = np.arange(len(planes))
    order[index] = len(planes) + np.arange(len(index))
    return joined([planes, others]).select(order)


def doubt(planes: FramedPlanes, objective: Objective, tolerance: float) -> Array:
    """[H] angle, radians, by which each plane could turn before its cost shows a change of `NOTICEABLE`.

    The plane is free to shift and the frame to grow meanwhile. The Gauss-Newton matrix at the plane tells.
    """
    anchors, scales = objective.anchors(planes.planes), _scales(planes, objective)
    here, residuals = _nearby(planes, objective, tolerance, anchors, scales)
    # Where an edge comes into an image, or leaves it, a residual jumps from zero or to it, which is no slope.
    jacobian = np.where((residuals == 0) == (here.residuals == 0), residuals - here.residuals, 0) / STEP
    hessian = _products(jacobian * _pull(here), jacobian)
    turns = np.linalg.inv(hessian + SMALLEST_CURVATURE * np.eye(4))[:, :2, :2]
    widest: Array = np.sqrt(NOTICEABLE * np.linalg.eigvalsh(turns)[:, -1])
    return widest
