"""Panes proposed for a capture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from glassplat.data.colmap_library import quiet_pycolmap
from glassplat.data.view import View
from glassplat.scene.eye import Eye
from glassplat.suggest.features import photo_features
from glassplat.suggest.matching import Observations, matched
from glassplat.suggest.mirror_matches import MirrorMatches
from glassplat.suggest.mirror_planes import MirrorPlane, mirror_planes
from glassplat.suggest.pane_extent import pane_corners
from glassplat.suggest.tracks import triangulated

Array = NDArray[np.float64]
Listener = Callable[[str, int, int], None]

MOST_VIEWS = 100
"""Photographs that are compared; of more, every second, third, ... is taken."""


@dataclass(frozen=True)
class Suggestion:
    """A pane that photographs speak for.

    Attributes:
        corners: [4, 3] of its rectangle in the world, in order round it.
        normal: [3] unit normal towards most of the cameras that saw mirror images in it.
        places: how many different things are seen mirrored in it and directly too.
        matches: pairs of photographs and things that agree with it.
        views: photographs that show a mirror image in it.
    """

    corners: Array
    normal: Array
    places: int
    matches: int
    views: int

    def described(self) -> str:
        """For people: what speaks for it, and where it is, in the capture's own units."""
        sides = np.linalg.norm(np.diff(self.corners[:3], axis=0), axis=1)
        middle, normal = (_written(row) for row in (self.corners.mean(axis=0), self.normal))
        return (
            f"{sides[0]:.3g} x {sides[1]:.3g}, centre ({middle}), normal ({normal}): {self.places} things are seen in "
            f"it and directly too, in {self.views} photographs"
        )


def _written(row: Array) -> str:
    return ", ".join(f"{value:.2f}" for value in row)


def suggested_panes(views: Sequence[View], extent: float, listen: Listener) -> list[Suggestion]:
    """Panes in which photographs show mirrored what others show directly; the best supported first.

    No masks and no learned weights are needed. What is not to be seen directly in any photograph is no help, nor is
    what looks the same in a mirror.

    Args:
        views: of the capture, with true poses.
        extent: of the cameras, world units.
        listen: is told what is done, and how many of how many.
    """
    quiet_pycolmap()
    chosen = views[:: -(-len(views) // MOST_VIEWS)]
    eyes = [Eye.of(view.camera) for view in chosen]
    features = []
    for number, view in enumerate(chosen):
        listen("looking for features", number, len(chosen))
        features.append(photo_features(view))
    seen = Observations.of(features, eyes)
    pairs = matched(features, seen, lambda done, count: listen("comparing with mirror images", done, count))
    listen("looking for planes", 0, 1)
    matches = MirrorMatches.of(seen, triangulated(seen, pairs.direct), pairs.mirrored)
    return [_suggestion(one, matches, chosen) for one in mirror_planes(matches, extent)]


def _suggestion(found: MirrorPlane, matches: MirrorMatches, views: Sequence[View]) -> Suggestion:
    seen, virtual = matches.seen, matches.virtual[found.matches]
    facing = np.sign(found.plane.heights(seen.centers_of(virtual))).sum()
    corners = pane_corners(found.plane, seen, virtual, lambda number: _grey(views[number]))
    return Suggestion(
        corners=corners,
        normal=found.plane.normal if facing >= 0 else -found.plane.normal,
        places=found.places,
        matches=len(found.matches),
        views=len(np.unique(seen.view[virtual])),
    )


def _grey(view: View) -> NDArray[np.uint8]:
    return np.asarray(Image.fromarray(view.read_photo().numpy()).convert("L"))
