"""Panes fitted to masks: planes, rectangles, glass and mirrors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from glassplat.options import CLEAR_GLASS, ESSENTIAL, Internal, OpenShare, PaneLabel, PositiveShare, Range, Seed, Share


class PlaneFitError(ValueError):
    """No plane could be fitted to a pane; the message names the pane and what to annotate."""


@dataclass(frozen=True)
class PlaneFit:
    """Options for finding planes from masks.

    Attributes:
        mirror_labels: labels of panes that are mirrors; their R0 is fixed close to one.
        glass_reflectance: initial and expected R0 of glass; by default that of a clear pane.
        mirror_reflectance: base reflectance of mirrors; one has no finite logit.
        band: half width of the band along a mask's edge in which candidates lie, as a share of the
            image diagonal; the paper's 20 pixels at 960x720.
        inlier_distance: inlier distance of RANSAC, as a share of the scene extent.
        hypotheses: number of planes drawn by RANSAC, and again from the masks.
        refined: number of the best planes that are refined in the end.
        most_views: maximum number of annotated views to use; a few that are far apart suffice.
        least_agreement: intersection over union of the masks on the plane below which the fit is refused.
        margin: factor on the rectangle's sides, which must not cut into the pane.
        seed: random seed of RANSAC.
    """

    mirror_labels: Annotated[tuple[PaneLabel, ...], ESSENTIAL] = ()
    glass_reflectance: OpenShare = CLEAR_GLASS
    mirror_reflectance: Internal[OpenShare] = 0.999
    band: Internal[PositiveShare] = 20 / 1200
    inlier_distance: Internal[PositiveShare] = 0.01
    hypotheses: Internal[Annotated[int, Range(1, 1_000_000)]] = 4000
    refined: Internal[Annotated[int, Range(1, 1000)]] = 4
    most_views: Internal[Annotated[int, Range(2, 1000)]] = 12
    least_agreement: Share = 0.5
    margin: Internal[Annotated[float, Range(0.1, 10)]] = 1.08
    seed: Internal[Seed] = 0
