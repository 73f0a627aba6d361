"""Recipes of `deferred` (3D Gaussian Splatting with Deferred Reflection) and `traced` (EnvGS)."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Annotated, Any, Literal

from glassplat.methods.splat_recipe import Primitive
from glassplat.options import (
    ESSENTIAL,
    Coordinate,
    Internal,
    Length,
    NonNegative,
    OpenShare,
    PositiveCount,
    Share,
)
from glassplat.scene import SH_ZERO
from glassplat.training.options import (
    DefaultDensify,
    GaussianRates,
    Intervals,
    McmcDensify,
    MethodRecipe,
    MirrorSearch,
    NormalPropagation,
    PropagationSchedule,
    ReflectionRates,
    SurroundingsOptions,
    SurroundingsStart,
    Texels,
)


@dataclass(frozen=True)
class GlossyOptions(MethodRecipe):
    """Options of `deferred` and `traced`, which learn a reflection strength and a normal for every Gaussian.

    Attributes:
        sh_degree: maximum SH degree of the view-dependent colour; by default it grows after propagation.
        bootstrap: share of the run without reflection, at least 300 steps (paper: a few thousand). If mirrors are
            searched for afterwards it is a run of `splat`, else the SH degree stays 0.
        texels: final edge length of the environment's cube faces.
        first_texels: initial edge length.
        first_strength: reflection strength of every Gaussian at the start.
        search: search for mirrors at the start of reflections.
        region: sphere outside which nothing reflects: centre and radius, in world units; by default the place that the
            cameras surround.
        find_region: determine the place that the cameras surround; otherwise, everything may reflect without a
            `region`, as in the paper.
        outside_weight: weight of the mean strength outside the region.
        strength_weight: weight of the mean strength of all Gaussians, which keeps matte surfaces from reflecting a
            little (not in the paper).
        consistency_weight: weight of the difference between normals and those of the depths, during propagation.
        monocular_weight: weight of the difference between normals and estimated ones in `normals/` next to the
            photographs, if there are any (3DGS-DR: none; EnvGS: 0.01).
        propagation: normal propagation and colour sabotage.
        schedule: schedule of propagation and sabotage.
        least_iterations: length of the shortest run with reflections. In a shorter one, colours could not adapt to the
            reflections; it trains like `splat`.
        raise_rates_matte: raise the learning rates to those of `splat` once nothing reflective was found, and in runs
            too short for reflections.
        raise_rates_found: raise them after propagation even if something reflects; earlier, high rates would corrupt
            its normals.
        propagation_interval: steps between densifications during propagation; None keeps `densify.interval`.
        rates: learning rates of the Gaussians; in short runs they are higher before and after propagation, but not
            during it, which would corrupt normals.
        reflection_rates: learning rates of strength and environment.
    """

    bootstrap: Share = 0.06
    texels: Annotated[Texels, ESSENTIAL] = 64
    first_texels: Texels = 16
    first_strength: Internal[OpenShare] = 1e-3
    search: Internal[MirrorSearch] = field(default_factory=MirrorSearch)
    region: Annotated[tuple[Coordinate, Coordinate, Coordinate, Length] | None, ESSENTIAL] = None
    find_region: Internal[bool] = True
    outside_weight: NonNegative = 0.4
    strength_weight: NonNegative = 0.005
    consistency_weight: NonNegative = 0.3
    monocular_weight: NonNegative = 0.5
    propagation: Internal[NormalPropagation] = field(default_factory=NormalPropagation)
    schedule: PropagationSchedule = field(default_factory=PropagationSchedule)
    least_iterations: PositiveCount = 6000
    raise_rates_matte: Internal[bool] = True
    raise_rates_found: Internal[bool] = True
    propagation_interval: Internal[PositiveCount | None] = None
    rates: GaussianRates = field(default_factory=partial(GaussianRates, short_run_power=0.0))
    reflection_rates: Internal[ReflectionRates] = field(default_factory=ReflectionRates)
    intervals: Intervals = field(default_factory=lambda: Intervals(opacity=0.005, least=150))

    @property
    def initial_texels(self) -> int:
        """Edge length of the faces of the initial environment."""
        return min(self.first_texels, self.texels)

    def contradiction(self) -> str | None:
        """Contradiction between the options, if any."""
        if self.schedule.stop <= self.bootstrap:
            return (
                f"--schedule.stop is {self.schedule.stop} and --bootstrap {self.bootstrap}; normals spread in between, "
                "so expected --schedule.stop to be larger"
            )
        return None


def _published(
    iterations: int, *, normals: int, resets: int, densify: int, prune_opacity: float = 0.005
) -> dict[str, Any]:
    """The options that both papers, or their code, have in common.

    Args:
        iterations: of a run of the public code.
        normals: step until which normals spread.
        resets: step until which opacities are reset.
        densify: step until which Gaussians are added.
        prune_opacity: opacity below which Gaussians are removed.
    """
    return {
        "bootstrap": 3000 / iterations,
        "search": MirrorSearch(begin_found=False, estimated_normals=False),
        "find_region": False,
        "strength_weight": 0.0,
        "propagation": NormalPropagation(sabotage=0.4 * SH_ZERO),
        "schedule": PropagationSchedule(end="fixed", stop=normals / iterations, pause=200, last_reset=False),
        "least_iterations": 1,
        "raise_rates_matte": False,
        "raise_rates_found": False,
        "intervals": Intervals(1000 / iterations, 150, resets / iterations, 1000 / iterations, averaged_passes=0.0),
        "densify": replace(
            DefaultDensify.published(),
            start=500 / iterations,
            stop=densify / iterations,
            prune_large_start=3000 / iterations,
            prune_opacity=prune_opacity,
        ),
        "mcmc": McmcDensify.published(),
    }


DEFERRED_CODE_ITERATIONS = 61_000
"""Length of the runs of the public code on synthetic scenes."""


@dataclass(frozen=True)
class DeferredRecipe(GlossyOptions):
    """3DGS-DR: a reflection strength and a normal for every Gaussian, an environment map, deferred shading."""

    method = "deferred"
    functions = "glassplat.methods.glossy:deferred"

    @classmethod
    def paper(cls) -> DeferredRecipe:
        """As published; if paper and public code disagree, with the constants of the code (docs/deferred.md)."""
        return cls(
            **_published(DEFERRED_CODE_ITERATIONS, normals=24_000, resets=29_000, densify=30_000),
            texels=128,
            first_texels=128,
            consistency_weight=0.0,
            monocular_weight=0.0,
            propagation_interval=500,
            rates=GaussianRates(decay=30_000 / DEFERRED_CODE_ITERATIONS, short_run_power=0.0),
            reflection_rates=ReflectionRates(strength=6e-3),
        )


TRACED_CODE_ITERATIONS = 40_000
"""Length of a run of the public code, except for two captures with longer runs."""
Mirrors = Literal["both", "surroundings", "environment"]


@dataclass(frozen=True)
class TracedRecipe(GlossyOptions):
    """EnvGS: a reflection strength and a normal for every Gaussian, and ray-traced Gaussians as surroundings.

    Attributes:
        primitive: primitives of scene and surroundings: ellipsoids, or discs (paper).
        harmonics_from_start: increase the SH degree from the first step on (public code), not only after propagation.
        mirrors: what is reflected: `surroundings` (paper), an `environment` map at infinity (ablation), or `both`, the
            environment behind the surroundings.
        joint: reflections also train the surfaces; otherwise only the surroundings (ablation).
        least_strength: strength above which rays are traced; below, only the environment is reflected. Without an
            environment, training traces all rays.
        surroundings: Gaussians that are reflected.
        normals_throughout: keep the term of `consistency_weight` after propagation; for discs, use it and that of
            `monocular_weight` from the first step on (paper).
    """

    method = "traced"
    functions = "glassplat.methods.glossy:traced"

    primitive: Annotated[Primitive, ESSENTIAL] = "ellipsoid"
    harmonics_from_start: bool = False
    mirrors: Annotated[Mirrors, ESSENTIAL] = "both"
    joint: Internal[bool] = True
    least_strength: Annotated[Share, ESSENTIAL] = 0.02
    surroundings: SurroundingsOptions = field(default_factory=SurroundingsOptions)
    normals_throughout: Internal[bool] = False
    bootstrap: Share = 0.25
    intervals: Intervals = field(default_factory=lambda: Intervals(opacity=0.0214, least=150))

    @classmethod
    def paper(cls) -> TracedRecipe:
        """As published, for real captures; what the paper leaves open is as in its code (docs/traced.md)."""
        plain = GaussianRates(decay=30_000 / TRACED_CODE_ITERATIONS, short_run_power=0.0)
        return cls(
            **_published(TRACED_CODE_ITERATIONS, normals=18_000, resets=21_000, densify=21_000, prune_opacity=0.05),
            primitive="disc",
            sh_degree=2,
            harmonics_from_start=True,
            mirrors="surroundings",
            least_strength=0.0,
            surroundings=SurroundingsOptions(
                start=SurroundingsStart(source="box", cells=32),
                sh_degree=2,
                rates=plain,
                densify=replace(
                    DefaultDensify.published(),
                    interval=500,
                    start=3000 / TRACED_CODE_ITERATIONS,
                    stop=21_000 / TRACED_CODE_ITERATIONS,
                    gradient_threshold=1e-4,
                    prune_opacity=0.05,
                    prune_large_start=6000 / TRACED_CODE_ITERATIONS,
                    cap=630_000,
                    contribution_moments=(0.8,),
                ),
                reset=6000 / TRACED_CODE_ITERATIONS,
            ),
            consistency_weight=0.04,
            normals_throughout=True,
            monocular_weight=0.01,
            rates=plain,
            reflection_rates=ReflectionRates(strength=1e-2),
        )

    def distant(self) -> DeferredRecipe:
        """The recipe of `deferred` with the same options."""
        return DeferredRecipe(**{shared.name: getattr(self, shared.name) for shared in fields(GlossyOptions)})
