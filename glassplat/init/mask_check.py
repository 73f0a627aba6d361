"""Which of a pane's masks fit the others, once its plane is known."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from glassplat.init.annotation import PaneView
from glassplat.init.consistency import agreement_of_each
from glassplat.init.edges import edge_matches
from glassplat.init.plane_objective import MIDDLE
from glassplat.init.ransac import FramedPlanes

Array = NDArray[np.float64]
log = logging.getLogger("glassplat.init")

LEAST_MEETING, LEAST_OF_MEDIAN = 0.3, 0.5
"""A mask does not fit if its outline meets the others by less than this, or by less than this share of the median."""
EDGES_PER_VIEW = 100


def report_masks(label: int, plane: FramedPlanes, views: Sequence[PaneView]) -> None:
    """Logs how well each mask of a pane fits the others on its plane, and warns of those that do not, by name."""
    meeting, overlap = meeting_of_each(plane, views), agreement_of_each(plane.planes, views)
    found = [f"{view.name} {_percent(share)}" for view, share in zip(views, meeting, strict=True)]
    areas = ", ".join(f"{told} ({area:.2f})" for told, area in zip(found, overlap, strict=True))
    log.info("pane %d: outlines of the masks that meet those of the others (and overlap): %s", label, areas)
    odd = odd_ones(meeting).nonzero()[0]
    if len(odd):
        log.warning(
            "pane %d: %d of its %d masks do not fit the others, their outlines hardly meet on any plane: %s; check "
            "that each belongs to its photograph, and that label %d means the same flat pane in it",
            label, len(odd), len(views), ", ".join(found[number] for number in odd), label,
        )  # fmt: skip


def _percent(share: float) -> str:
    return "nothing to compare" if np.isnan(share) else f"{share:.0%}"


def odd_ones(meeting: Array) -> NDArray[np.bool_]:
    """[V] which masks do not fit the others, from what `meeting_of_each` says; all of them may not."""
    known = meeting[~np.isnan(meeting)]
    limit = max(LEAST_MEETING, LEAST_OF_MEDIAN * float(np.median(known))) if len(known) else 0.0
    return np.asarray(meeting < limit)


def meeting_of_each(plane: FramedPlanes, views: Sequence[PaneView]) -> Array:
    """[V] share of each mask's outline that meets those of the others on one plane; NaN where nothing is compared.

    The overlap of the areas does not tell: masks of one pane from elsewhere overlap by half and more, and a post that
    hides half of a pane costs as much. Outlines that are hidden meet nothing, but those of a wrong mask do not either,
    nor do the others meet them.
    """
    views = [_without_shared_edges(view) for view in views]
    tolerance = max(MIDDLE, *(1 / view.diagonal for view in views))
    matches = edge_matches(plane.planes, views, edges_per_view=EDGES_PER_VIEW)
    met = 1 / (1 + matches.residuals(plane.frames, tolerance)[:, 0] ** 2)
    compared = matches.compared[:, 0] & ~np.isnan(met)
    shares = np.full(len(views), np.nan)
    for number in range(len(views)):
        concerned = compared & (matches.sources == number)
        concerned[number] |= compared[number]
        if concerned.any():
            shares[number] = met[concerned].mean()
    return shares


def _without_shared_edges(view: PaneView) -> PaneView:
    """The view without what other panes may hide: no edge between them counts, and no distance is known there."""
    from scipy import ndimage

    beside: NDArray[np.bool_] = ndimage.binary_dilation(view.hidden, iterations=2)
    column, row = np.floor(view.edge).astype(np.int64).T
    kept = ~beside[np.minimum(row, beside.shape[0] - 1), np.minimum(column, beside.shape[1] - 1)]
    distance = np.where(beside, np.nan, view.distance)
    return replace(view, edge=view.edge[kept], outward=view.outward[kept], distance=distance)
