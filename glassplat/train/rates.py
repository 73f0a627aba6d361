"""Learning rates, and how they follow the run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from glassplat.data.ranges import (
    Internal,
    LearningRate,
    PositiveShare,
    Range,
    Share,
)

PUBLISHED_ITERATIONS = 30_000
"""Length of the runs for which 3DGS, and TR-Gaussians after it, chose their learning rates."""
FASTEST_ITERATIONS = 3_000
"""Shorter runs learn no faster than one of this length, the shortest for which higher rates were measured."""


@dataclass(frozen=True)
class Rate:
    """A learning rate over the run.

    Attributes:
        start: rate at the first iteration.
        end: rate that it decays to exponentially; None keeps `start`.
        decay: share of the run at which `end` is reached.
        per_extent: multiply by the scene extent (for positions).
        rest: factor for every SH coefficient but the constant one; only for `sh`.
        short_run_power: a run of fewer iterations than the published 30,000 multiplies the rate by their ratio to this
            power (`FASTEST_ITERATIONS` at the least), because Adam moves a parameter by about its rate at every step,
            however small the gradient.
    """

    start: float
    end: float | None = None
    decay: float = 1.0
    per_extent: bool = False
    rest: float | None = None
    short_run_power: float = 0.0

    def at(self, progress: float, extent: float, iterations: int = PUBLISHED_ITERATIONS) -> float:
        """The rate at a progress in [0, 1] of a run of so many iterations."""
        length = min(max(iterations, FASTEST_ITERATIONS), PUBLISHED_ITERATIONS)
        scale = (PUBLISHED_ITERATIONS / length) ** self.short_run_power
        if self.per_extent:
            scale *= extent
        if self.end is None or self.start == 0:
            return self.start * scale
        decayed = min(progress / self.decay, 1.0)
        return float(self.start ** (1 - decayed) * self.end**decayed * scale)


@dataclass(frozen=True)
class GaussianRates:
    """Learning rates of a set of Gaussians (3DGS).

    Attributes:
        means: position, per scene extent, at the start of the run; decays to `means_end`.
        decay: share of the run at which it has done so.
        sh: constant SH coefficient; the others get a twentieth.
        opacity, scale, rotation: of the raw values.
        intensity: of the reflection intensity's logarithm.
        short_run_power: in a run of n < 30,000 iterations the rates of position, colour, scale and rotation are
            (30,000 / n) to this power times as large, n being 3,000 at the least; 0 keeps the published ones
            (docs/experiments.md).
    """

    means: LearningRate = 1.6e-4
    means_end: Internal[PositiveShare] = 1.6e-6
    decay: Internal[PositiveShare] = 1.0
    sh: LearningRate = 2.5e-3
    opacity: LearningRate = 5e-2
    scale: LearningRate = 5e-3
    rotation: LearningRate = 1e-3
    intensity: Internal[LearningRate] = 5e-3
    short_run_power: Internal[Annotated[float, Range(0, 2)]] = 0.5

    def of(self, part: str) -> dict[str, Rate]:
        """The rates by dotted parameter name."""
        power = self.short_run_power
        return {
            f"{part}.means": Rate(self.means, self.means_end, decay=self.decay, per_extent=True, short_run_power=power),
            f"{part}.sh": Rate(self.sh, rest=1 / 20, short_run_power=power),
            f"{part}.logit_opacities": Rate(self.opacity),
            f"{part}.log_scales": Rate(self.scale, short_run_power=power),
            f"{part}.quats": Rate(self.rotation, short_run_power=power),
        }


@dataclass(frozen=True)
class PlaneRates:
    """Learning rates of planes and glass, which the paper leaves out; see docs/experiments.md.

    Attributes:
        center: plane position in stage 2, per scene extent.
        normal: plane normal in stage 2.
        reflectance: logit of R0.
        mark: logit of the glass mark.
        transmittance: its logarithm, where panes may be tinted.
        joint_factor: factor on `center` and `normal` in stage 3 (paper: 0.1).
    """

    center: LearningRate = 1e-4
    normal: LearningRate = 1e-4
    reflectance: LearningRate = 1e-2
    mark: LearningRate = 5e-2
    transmittance: LearningRate = 5e-3
    joint_factor: Share = 0.1

    def of(self, factor: float) -> dict[str, Rate]:
        """The rates by dotted parameter name."""
        return {
            "planes.centers": Rate(self.center * factor, per_extent=True),
            "planes.raw_normals": Rate(self.normal * factor),
            "planes.logit_reflectances": Rate(self.reflectance),
            "planes.log_transmittances": Rate(self.transmittance),
            "glass.logit_mark": Rate(self.mark),
        }


@dataclass(frozen=True)
class ReflectionRates:
    """Learning rates of what reflects.

    Attributes:
        strength: logit of the reflection strength.
        environment: raw texels of the environment.
    """

    strength: LearningRate = 2e-2
    environment: LearningRate = 5e-2

    def of(self) -> dict[str, Rate]:
        """The rates by dotted parameter name."""
        return {"primary.logit_strength": Rate(self.strength), "environment.raw": Rate(self.environment)}
