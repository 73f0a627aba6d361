"""Suggested panes as the page proposes them: outlines to look at, and marks that make a pane of one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glassplat.annotate.outline import seen_outline
from glassplat.annotate.pane_fit import corner_information, tilt_deviation
from glassplat.annotate.pane_shape import PaneShape, polygon_pane, rectangle_pane
from glassplat.data.view import View
from glassplat.scene.eye import Eye
from glassplat.suggest.suggestion import Suggestion

Array = NDArray[np.float64]

MARKED = 3
"""Photographs in which an accepted pane is marked."""
SAME_TILT = np.cos(np.radians(10))
BESIDE = 1.0
"""Of a photograph's sides: how far beside it a corner is still marked."""


def proposals(
    suggestions: Sequence[Suggestion], known: Sequence[PaneShape], views: Sequence[View], eyes: Sequence[Eye]
) -> list[dict[str, Any]]:
    """What the page shows of suggestions, those left out that are panes already.

    Args:
        suggestions: panes in the world.
        known: shapes of the panes that are marked.
        views: of the capture.
        eyes: their cameras.
    """
    return [_proposal(one, views, eyes) for one in suggestions if not any(_is_same(one, shape) for shape in known)]


def _proposal(suggestion: Suggestion, views: Sequence[View], eyes: Sequence[Eye]) -> dict[str, Any]:
    shape = rectangle_pane(polygon_pane(suggestion.corners))
    corners = shape.corners()
    chosen = marked_views(shape, eyes)
    return {
        "text": suggestion.described(),
        "outlines": [np.round(seen_outline(eye, corners), 2).tolist() for eye in eyes],
        "corners": [
            {views[number].name: np.round(eyes[number].project(corner), 2).tolist() for number in chosen}
            for corner in corners
        ],
        "view": chosen[0],
    }


def marked_views(shape: PaneShape, eyes: Sequence[Eye]) -> list[int]:
    """The views in which marks of all corners make a plane surest, the one that shows it best first."""
    corners = shape.corners()
    open_views = [number for number, eye in enumerate(eyes) if (eye.in_camera(corners)[:, 2] > 0).all()]
    near = [number for number in open_views if eyes[number].holds(corners, BESIDE).all()]
    rest = near if len(near) > 1 else open_views
    information = {number: corner_information(eyes[number], shape) for number in rest}
    chosen = [max(rest, key=lambda number: (int(eyes[number].holds(corners).sum()), -number))] if rest else [0]
    while len(chosen) < min(MARKED, len(rest)):
        known = sum(information[number] for number in chosen)
        left = [number for number in rest if number not in chosen]
        chosen.append(min(left, key=lambda number: tilt_deviation(known + information[number])))
    return chosen


def _is_same(suggestion: Suggestion, shape: PaneShape) -> bool:
    """Whether a pane is marked already: nearly the same plane, and one holds the middle of the other."""
    corners = shape.corners()
    middle, reach = corners.mean(axis=0), np.linalg.norm(np.ptp(corners, axis=0)) / 2
    away = suggestion.corners.mean(axis=0) - middle
    normal = shape.frame[2]
    is_flush = abs(away @ normal) < 0.2 * reach and abs(suggestion.normal @ normal) > SAME_TILT
    return bool(is_flush and np.linalg.norm(away) < reach)
