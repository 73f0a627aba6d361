"""Do the masks of several views agree about a plane, and on which plane do they agree best?

A plane maps every pixel of one view to a pixel of another. On the pane's own plane the mask of the
first view lands on the mask of the second; on any other plane parallax pulls them apart. Outside of
an image nothing is known, so that a mask which leaves its image is no contradiction; nor is anything
known where a mask shows another pane, which may stand in front.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from glassplat.init.annotation import PaneView
from glassplat.init.ransac import PlaneEquations

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

UNKNOWN_WEIGHT = 0.05
"""Weight of what leaves the other image, against planes on which hardly anything can be compared."""


def meet(planes: PlaneEquations, origin: Array, directions: Array) -> tuple[Array, Mask]:
    """Points [H, P, 3] where rays meet planes, and whether that is in front of their origin.

    Args:
        planes: H planes.
        origin: [3] where all rays start.
        directions: [P, 3] their directions.
    """
    slope = planes.normals @ directions.T
    height = planes.offsets - planes.normals @ origin
    along = height[:, None] / np.where(np.abs(slope) < 1e-9, 1e-9, slope)
    hit = along > 0
    return origin + np.where(hit, along, 0)[..., None] * directions, hit


def mask_agreement(planes: PlaneEquations, views: Sequence[PaneView], *, pixels_per_view: int = 400) -> Array:
    """[H] how well the masks agree on each plane: intersection over union, pooled over pairs of views.

    Args:
        planes: hypotheses.
        views: annotated views of one pane, at least two.
        pixels_per_view: number of rays that are followed from each view.
    """
    both, either = _overlaps(planes, views, pixels_per_view)
    agreement: Array = both.sum(axis=(0, 1)) / np.maximum(either.sum(axis=(0, 1)), 1)
    return agreement


def agreement_of_each(plane: PlaneEquations, views: Sequence[PaneView], *, pixels_per_view: int = 400) -> Array:
    """[V] how well the mask of each view agrees with those of all others on one plane; as `mask_agreement`."""
    both, either = (pairs[..., 0] + pairs[..., 0].T for pairs in _overlaps(plane, views, pixels_per_view))
    agreement: Array = both.sum(axis=1) / np.maximum(either.sum(axis=1), 1)
    return agreement


def _overlaps(planes: PlaneEquations, views: Sequence[PaneView], pixels_per_view: int) -> tuple[Array, Array]:
    """Pixels of each view on the pane in another one as well, and on it in either; [V, V, H], from and to."""
    count = len(views)
    both, either = np.zeros((2, count, count, len(planes)))
    for number, source in enumerate(views):
        pixels = source.grid(pixels_per_view)
        pixels = pixels[source.tells(pixels, np.ones(len(pixels), dtype=bool))]
        on_pane = source.covers(pixels, np.ones(len(pixels), dtype=bool))
        points, hit = meet(planes, source.center, source.directions(pixels))
        for other, target in enumerate(views):
            if target is not source:
                landed, held = target.project(points)
                held = target.tells(landed, held & hit)
                covered = target.covers(landed, held)
                both[number, other] = (covered & on_pane).sum(axis=1)
                unknown = (hit & on_pane & ~held).sum(axis=1)
                # A plane behind the camera cannot hold a pane that the camera sees.
                missed = (on_pane & ~hit).sum(axis=1)
                either[number, other] = (held & (covered | on_pane)).sum(axis=1) + missed + UNKNOWN_WEIGHT * unknown
    return both, either
