"""The recipe of `splat`: 3D Gaussian Splatting, or 2D Gaussian Splatting with discs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from glassplat.options import ESSENTIAL, Color, Internal, NotNegative, Share, ShDegree
from glassplat.training.options import (
    DefaultDensify,
    GaussianRates,
    Intervals,
    McmcDensify,
    MethodRecipe,
    PhotoExposure,
    PoseRefinement,
    Strategy,
)

Primitive = Literal["ellipsoid", "disc"]


@dataclass(frozen=True)
class DiscTerms:
    """Terms that keep discs on one surface (2DGS, Section 4.2); ellipsoids have none.

    Attributes:
        distortion_weight: of how far apart along a ray lies what a pixel shows; 2DGS takes 1000 for bounded scenes.
        distortion_start: share of the run after which it counts.
        normal_weight: of how far the discs' normals are from those of their depths.
        normal_start: share of the run after which it counts.
    """

    distortion_weight: NotNegative = 100.0
    distortion_start: Share = 3_000 / 30_000
    normal_weight: NotNegative = 0.05
    normal_start: Share = 7_000 / 30_000


@dataclass(frozen=True)
class SplatRecipe(MethodRecipe):
    """Plain Gaussian Splatting, the baseline: of ellipsoids (3DGS) or discs (2DGS).

    Attributes:
        primitive: what the scene is made of: ellipsoids, or discs, which have normals and lie on surfaces.
        sh_degree: highest degree of the view-dependent colour.
        ssim_weight: lambda, share of D-SSIM in the photometric loss.
        view_dependence_weight: of the squares of the spherical harmonics beyond the constant one.
        background: colour behind everything, sRGB; None is white where photographs are transparent, else black.
        rates: learning rates.
        intervals: when opacities are reset and the SH degree grows.
        strategy: what decides how many Gaussians there are and where; `densify` or `mcmc` holds its options.
        densify: when and how Gaussians are added and pruned under `default`.
        mcmc: when and how Gaussians are relocated and added under `mcmc`.
        seed_unexplained: add ellipsoids where photographs agree on something that the scene lacks, twice early in a
            run; not under `mcmc`, which moves its own.
        discs: what keeps discs on one surface.
        exposure: whether the exposure of each photograph is learned.
        poses: whether the camera of each photograph is corrected.
    """

    method = "splat"
    functions = "glassplat.methods.splat:splat"

    primitive: Annotated[Primitive, ESSENTIAL] = "ellipsoid"
    sh_degree: Annotated[ShDegree, ESSENTIAL] = 3
    ssim_weight: Share = 0.2
    view_dependence_weight: NotNegative = 0.0
    background: Annotated[Color | None, ESSENTIAL] = None
    rates: GaussianRates = field(default_factory=GaussianRates)
    intervals: Intervals = field(default_factory=Intervals)
    strategy: Annotated[Strategy, ESSENTIAL] = "default"
    densify: DefaultDensify = field(default_factory=DefaultDensify)
    mcmc: McmcDensify = field(default_factory=McmcDensify)
    seed_unexplained: Internal[bool] = True
    discs: DiscTerms = field(default_factory=DiscTerms)
    exposure: PhotoExposure = field(default_factory=PhotoExposure)
    poses: PoseRefinement = field(default_factory=PoseRefinement)

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
