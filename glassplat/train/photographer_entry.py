"""Learning who took the photographs, beside what they show."""

from __future__ import annotations

from dataclasses import dataclass, replace

from glassplat.data.dataset import Dataset
from glassplat.densify.options import DefaultDensify
from glassplat.init.photographer import first_photographer
from glassplat.render.planar import Planar
from glassplat.scene.photographer import upward
from glassplat.train.actions import Densify
from glassplat.train.photograph_options import Photographer
from glassplat.train.stage import Entry, Stage, Work, carried_out
from glassplat.train.state import TrainState

PART = "photographer"


@dataclass(frozen=True)
class AddPhotographer:
    """Puts somebody behind the camera once there are panes.

    Attributes:
        options: who.
        seed: of the first Gaussians' places.
        after: what comes before that: it finds the panes.
    """

    options: Photographer
    seed: int
    after: Entry | None

    def __call__(self, state: TrainState, dataset: Dataset) -> Work:
        """Edits `state`, and tells how far it is."""
        if self.after is not None:
            yield from carried_out(self.after(state, dataset))
        cameras = [view.camera for view in dataset.train]
        body = first_photographer(
            state.scene.planes,
            cameras,
            count=self.options.count,
            sh_degree=self.options.sh_degree,
            seed=self.seed,
        )
        up = upward(cameras) if self.options.upright else None
        state.scene = replace(state.scene, photographer=body, up=up)
        return True


def photographer_learnt(
    options: Photographer, stages: tuple[Stage, ...], densify: DefaultDensify, seed: int
) -> tuple[Stage, ...]:
    """The stages: in those that know panes the photographer is shown and learns, from the first of them on."""
    if not options.learn:
        return stages
    first = next(number for number, stage in enumerate(stages) if isinstance(stage.renderer, Planar))
    entry = AddPhotographer(options, seed, after=stages[first].entry)
    learning = [_learning(options, stage, densify) for stage in stages[first:]]
    return (*stages[:first], replace(learning[0], entry=entry), *learning[1:])


def _learning(options: Photographer, stage: Stage, densify: DefaultDensify) -> Stage:
    assert isinstance(stage.renderer, Planar)
    return replace(
        stage,
        renderer=replace(stage.renderer, photographer="present"),
        rates={**stage.rates, **options.rates.of(PART)},
        actions=(*stage.actions, Densify(densify, part=PART)),
    )
