"""The recipe of `splat`: 3D Gaussian Splatting."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from glassplat.data.dataset import Dataset
from glassplat.densify.default import DefaultDensify
from glassplat.init.points import gaussians_from_points
from glassplat.losses.photometric import dssim, l1
from glassplat.losses.term import LossTerm
from glassplat.render.splat import Splat
from glassplat.scene.scene import Scene
from glassplat.train.actions import Densify, GrowSh, ResetOpacity
from glassplat.train.optimizer import Rate
from glassplat.train.stage import Action, Every, Stage


@dataclass(frozen=True)
class GaussianRates:
    """Learning rates of a set of Gaussians (3DGS).

    Attributes:
        means: position, per scene extent, at the start of the run; decays to `means_end`.
        sh: constant SH coefficient; the others get a twentieth.
        opacity, scale, rotation: of the raw values.
        intensity: of the reflection intensity's logarithm.
    """

    means: float = 1.6e-4
    means_end: float = 1.6e-6
    sh: float = 2.5e-3
    opacity: float = 5e-2
    scale: float = 5e-3
    rotation: float = 1e-3
    intensity: float = 5e-3

    def of(self, part: str) -> dict[str, Rate]:
        """The rates by dotted parameter name."""
        return {
            f"{part}.means": Rate(self.means, self.means_end, per_extent=True),
            f"{part}.sh": Rate(self.sh, rest=1 / 20),
            f"{part}.logit_opacities": Rate(self.opacity),
            f"{part}.log_scales": Rate(self.scale),
            f"{part}.quats": Rate(self.rotation),
        }


@dataclass(frozen=True)
class Rhythm:
    """When opacities are disturbed and the SH degree grows, in shares of the run (3DGS: of 30,000 iterations).

    Every third beat resets the opacities, as in 3DGS; `planar` perturbs them at the other two, so that
    the two never meet (TR-Gaussians, Section III-C3).

    Attributes:
        beat: distance between beats, as a share of the run.
        least: fewest iterations between beats; what a beat disturbs needs as many to recover.
        reset_stop: share of the run after which no reset happens.
        sh: distance between rises of the SH degree, as a share of the run.
    """

    beat: float = 1 / 30
    least: int = 250
    reset_stop: float = 0.45
    sh: float = 1 / 30


def photometric_terms(ssim_weight: float) -> tuple[LossTerm, ...]:
    """(1 - lambda) L1 + lambda D-SSIM (TR-Gaussians, Eq. 18)."""
    return LossTerm("l1", 1 - ssim_weight, l1), LossTerm("dssim", ssim_weight, dssim)


def growth_actions(rhythm: Rhythm, densifier: DefaultDensify) -> tuple[Action, ...]:
    """Densification and SH growth of the primary Gaussians."""
    return Densify(densifier), GrowSh(Every(rhythm.sh))


def opacity_resets(rhythm: Rhythm) -> ResetOpacity:
    """The recurring opacity reset."""
    return ResetOpacity(Every(rhythm.beat, 0.0, rhythm.reset_stop, rhythm.least, only_multiples_of=3))


@dataclass(frozen=True)
class SplatRecipe:
    """Plain 3D Gaussian Splatting, the baseline.

    Attributes:
        sh_degree: highest degree of the view-dependent colour.
        ssim_weight: lambda, share of D-SSIM in the photometric loss.
        background: colour behind everything, sRGB.
        rates: learning rates.
        rhythm: when opacities are reset and the SH degree grows.
        densify: when and how Gaussians are added and pruned.
    """

    method: ClassVar[str] = "splat"

    sh_degree: int = 3
    ssim_weight: float = 0.2
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rates: GaussianRates = field(default_factory=GaussianRates)
    rhythm: Rhythm = field(default_factory=Rhythm)
    densify: DefaultDensify = field(default_factory=DefaultDensify)

    def initialise(self, dataset: Dataset) -> Scene:
        """The first scene: one Gaussian per point."""
        return Scene(gaussians_from_points(dataset.points, sh_degree=self.sh_degree), dataset.extent)

    def renderer(self) -> Splat:
        """The renderer of the finished scene, with all its layers."""
        return Splat(self.background)

    def stages(self, seed: int) -> tuple[Stage, ...]:
        """One stage."""
        return (
            Stage(
                name="splat",
                share=1.0,
                renderer=Splat(self.background, depth=False),
                losses=photometric_terms(self.ssim_weight),
                rates=self.rates.of("primary"),
                actions=(
                    *growth_actions(self.rhythm, self.densify),
                    opacity_resets(self.rhythm),
                ),
            ),
        )
