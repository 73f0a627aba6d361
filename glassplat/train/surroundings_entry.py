"""How the stage begins in which near things are mirrored: with surroundings that rays can meet."""

from __future__ import annotations

from dataclasses import dataclass, replace

from torch import Tensor

from glassplat.data.dataset import Dataset
from glassplat.densify.edit import apply_edit
from glassplat.densify.order import in_morton_order
from glassplat.init.points import as_discs
from glassplat.init.surroundings import (
    copied_surroundings,
    joined,
    percentile_box,
    suitable_cells,
    surroundings_in_box,
)
from glassplat.scene.gaussians import Gaussians
from glassplat.train.mirror_options import SurroundingsStart
from glassplat.train.state import TrainState


@dataclass(frozen=True)
class AddSurroundings:
    """Surrounds the scene with Gaussians for reflections to show, drawn by the run's seed.

    Attributes:
        start: what they are.
        sh_degree: highest degree of their colours.
    """

    start: SurroundingsStart
    sh_degree: int

    def __call__(self, state: TrainState, dataset: Dataset, matte: Tensor) -> None:
        """Edits `state`; `matte` [N] bool tells which primary Gaussians may be copied."""
        parts = [part for part in self._parts(state, dataset, matte) if len(part)]
        # A scene in which everything reflects has nothing to copy.
        found = joined(*(parts or [self._in_box(state, dataset)]))
        ordered, _ = apply_edit(found, {}, in_morton_order(found.means), part="surroundings")
        state.scene = replace(state.scene, surroundings=ordered)

    def _parts(self, state: TrainState, dataset: Dataset, matte: Tensor) -> list[Gaussians]:
        parts = []
        if self.start.source != "box":
            parts.append(copied_surroundings(state.scene.primary, matte, sh_degree=self.sh_degree))
        if self.start.source != "scene":
            parts.append(self._in_box(state, dataset))
        return parts

    def _in_box(self, state: TrainState, dataset: Dataset) -> Gaussians:
        camera = dataset.train[0].camera
        cells = self.start.cells or suitable_cells(camera.width * camera.height, self.start.per_cell)
        found = surroundings_in_box(
            percentile_box(dataset.points, self.start.outside),
            cells=cells,
            per_cell=self.start.per_cell,
            sh_degree=self.sh_degree,
            opacity=self.start.opacity,
            generator=state.generator("surroundings"),
        )
        return as_discs(found, seed=state.seed) if state.scene.primary.are_discs else found
