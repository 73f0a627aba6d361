"""The recipe of `splat`: 3D Gaussian Splatting, or 2D Gaussian Splatting with discs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from glassplat.options import ESSENTIAL, Internal, NonNegative, Share
from glassplat.training.options import (
    DefaultDensify,
    GaussianRates,
    Intervals,
    McmcDensify,
    MethodRecipe,
)

Primitive = Literal["ellipsoid", "disc"]


@dataclass(frozen=True)
class DiscTerms:
    """Terms that keep discs on one surface (2DGS, Section 4.2); ellipsoids have none.

    Attributes:
        distortion_weight: weight of the depth distortion; 2DGS uses 1000 for bounded scenes.
        distortion_start: share of the run after which it applies, but not before step 400.
        normal_weight: weight of the difference between the discs' normals and those of their depths.
        normal_start: share of the run after which it applies.
    """

    distortion_weight: NonNegative = 100.0
    distortion_start: Share = 3_000 / 30_000
    normal_weight: NonNegative = 0.05
    normal_start: Share = 7_000 / 30_000


@dataclass(frozen=True)
class SplatRecipe(MethodRecipe):
    """Plain Gaussian Splatting as a baseline, with ellipsoids (3DGS) or discs (2DGS).

    Attributes:
        primitive: primitives of the scene: ellipsoids, or discs, which lie on surfaces and have normals.
        seed_unexplained: add ellipsoids where photographs agree on a missing object, twice early in a run; not with
            `mcmc`, which relocates its own.
        discs: loss terms that keep discs on one surface.
    """

    method = "splat"
    functions = "glassplat.methods.splat:splat"

    primitive: Annotated[Primitive, ESSENTIAL] = "ellipsoid"
    seed_unexplained: Internal[bool] = True
    discs: DiscTerms = field(default_factory=DiscTerms)

    @classmethod
    def paper(cls) -> SplatRecipe:
        """As published: 3DGS, or 3DGS-MCMC with that strategy, or 2DGS with discs (docs/splat.md)."""
        return cls(
            rates=GaussianRates(short_run_power=0.0),
            intervals=Intervals(averaged_passes=0.0),
            seed_unexplained=False,
            densify=DefaultDensify.published(),
            mcmc=McmcDensify.published(),
        )
