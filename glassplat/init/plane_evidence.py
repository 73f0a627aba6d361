"""Which of several planes the capture supports: its masks, and the points that were measured along their edges."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from glassplat.init.plane_objective import Objective
from glassplat.init.plane_search import contradiction
from glassplat.init.ransac import FramedPlanes

log = logging.getLogger("glassplat.init")


class Fit(NamedTuple):
    """A plane and what it was fitted to, for messages."""

    source: str
    plane: FramedPlanes


def score(plane: FramedPlanes, evidence: Objective) -> float:
    """How well masks and points support a plane: 1 where all outlines meet and all points lie on it, free of scale."""
    return 1 - float(contradiction(plane, evidence)[0])


def best_supported(label: int, fits: Sequence[Fit], evidence: Objective) -> FramedPlanes:
    """The plane with the highest score, the first one of equals; says so in the log.

    Args:
        label: of the pane.
        fits: at least one.
        evidence: the masks, and the points that were measured, not made by training. A first scene explains reflections
            by Gaussians behind the pane, and many of them lie where nothing is.
    """
    scores = [score(fit.plane, evidence) for fit in fits]
    kept = int(np.argmax(scores))
    for fit, found in zip(fits, scores, strict=True):
        apart = np.degrees(angle(fit.plane, fits[kept].plane))
        verdict = "kept" if fit is fits[kept] else f"{apart:.2f} degrees from the one that is kept"
        log.info(
            "pane %d: the plane fitted to %s scores %.3f, with %.0f %% of %d points along its edge on it; %s",
            label, fit.source, found, 100 * evidence.support(fit.plane.planes)[0], len(evidence.points), verdict,
        )  # fmt: skip
    return fits[kept].plane


def angle(one: FramedPlanes, other: FramedPlanes) -> float:
    """Radians between the first planes of two sets, whichever way they face."""
    first, second = one.planes.normals[0], other.planes.normals[0]
    return float(np.arctan2(np.linalg.norm(np.cross(first, second)), abs(first @ second)))
