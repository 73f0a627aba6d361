"""How the stage begins in which near things are mirrored: with surroundings that rays can meet."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

from torch import Tensor

from glassplat.data.dataset import Dataset
from glassplat.data.ranges import ESSENTIAL, InnerShare, Range
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
from glassplat.train.state import TrainState


@dataclass(frozen=True)
class SurroundingsStart:
    """What the first surroundings are.

    Attributes:
        source: Gaussians all over the box of the scene (the paper's), or copies of what stands in the scene and does
            not reflect, or both.
        cells: along an edge of the box; None takes as many as suit the photographs, 32 at the most (paper: 32).
        per_cell: Gaussians in each cell.
        outside: share of the points left out of the box at either end of each axis.
        opacity: of those in the box.
    """

    source: Annotated[Literal["box", "scene", "both"], ESSENTIAL] = "scene"
    cells: Annotated[int, Range(1, 256)] | None = None
    per_cell: Annotated[int, Range(1, 1000)] = 5
    outside: Annotated[float, Range(0, 0.45)] = 0.005
    opacity: InnerShare = 0.1


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
