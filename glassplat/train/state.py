"""Everything that changes during a run, and nothing else."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from glassplat.densify.default import ScreenStatistics
from glassplat.scene.scene import Scene
from glassplat.train.optimizer import Optimizer


@dataclass
class TrainState:
    """The mutable state of a run.

    Attributes:
        scene: the scene as trained so far.
        seed: fixes every random choice of the run.
        step: iterations done.
        optimizer: Adam's moments.
        statistics: screen gradients collected for densification, by scene part.
        seconds: time spent training so far, over all sittings.
        records: numbers that an action keeps from one turn to the next, by name.
        means: running means of the parameters over the last steps of the run, see `AverageLast`.
        method: the name of what is trained, so that a checkpoint tells whose it is; None where nobody said.
    """

    scene: Scene
    seed: int
    step: int = 0
    optimizer: Optimizer = field(default_factory=Optimizer)
    statistics: dict[str, ScreenStatistics] = field(default_factory=dict)
    seconds: float = 0.0
    records: dict[str, float] = field(default_factory=dict)
    means: dict[str, Tensor] = field(default_factory=dict)
    method: str | None = None

    def generator(self, purpose: str) -> torch.Generator:
        """A random generator for one purpose at this step.

        It depends on the seed, the step and the purpose alone, so that a resumed run draws the same numbers, and is
        for tensors on the scene's device; each kind of device has numbers of its own.
        """
        key = zlib.crc32(f"{self.seed}/{self.step}/{purpose}".encode())
        return torch.Generator(self.scene.primary.means.device).manual_seed(key)

    def to(self, device: torch.device | str) -> TrainState:
        """The same state on another device."""
        moments = {
            name: (first.to(device), second.to(device)) for name, (first, second) in self.optimizer.moments.items()
        }
        statistics = {
            part: ScreenStatistics(**{name: tensor.to(device) for name, tensor in vars(known).items()})
            for part, known in self.statistics.items()
        }
        optimizer = replace(self.optimizer, moments=moments)
        means = {name: mean.to(device) for name, mean in self.means.items()}
        return replace(self, scene=self.scene.to(device), optimizer=optimizer, statistics=statistics, means=means)
