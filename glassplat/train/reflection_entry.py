"""How the stage begins in which things learn to reflect."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace

from glassplat.data.dataset import Dataset
from glassplat.densify.edit import forget
from glassplat.densify.mirrors import made_mirrors, mirror_lookalikes
from glassplat.densify.options import MirrorSearch
from glassplat.render.frame import Renderer
from glassplat.train.environment_entry import AddEnvironment
from glassplat.train.messages import Working
from glassplat.train.state import TrainState
from glassplat.train.surroundings_entry import AddSurroundings


@dataclass(frozen=True)
class BeginReflections:
    """Adds what is there to be mirrored, and takes for mirrors what looks like them.

    Attributes:
        environment: adds an environment; None where only near things are mirrored.
        surroundings: adds what is near; None where only the environment is mirrored.
        mirrors: what looks like a mirror.
        renderer: that of the stage before.
        harmonics_wait: where mirrors were found, colours are again the same from all sides, until harmonics rise anew:
            what they had learnt by then is what those mirrors show.
    """

    environment: AddEnvironment | None
    surroundings: AddSurroundings | None
    mirrors: MirrorSearch
    renderer: Renderer
    harmonics_wait: bool = False

    def __call__(self, state: TrainState, dataset: Dataset) -> Generator[Working, None, bool]:
        """Edits `state`."""
        if self.environment is not None:
            self.environment(state, dataset)
        if self.surroundings is None and not self.mirrors.begin_found:
            return True
        yield Working("looking for mirrors", 0, 1)
        seen, mirrors = mirror_lookalikes(self.mirrors, state.scene, dataset.train, self.renderer)
        if self.surroundings is not None:
            self.surroundings(state, dataset, seen & ~mirrors)
        if self.mirrors.begin_found:
            primary = made_mirrors(self.mirrors, state.scene, dataset.train, mirrors)
            if self.harmonics_wait and bool(mirrors.any()):
                primary = replace(primary, active_sh_degree=0)
            state.scene = replace(state.scene, primary=primary)
            names = [f"primary.{name}" for name in primary.tensors()]
            state.optimizer.moments = forget(state.optimizer.moments, names, mirrors)
        return True
