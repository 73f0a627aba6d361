"""Recurring edits of the training state."""

from __future__ import annotations

from dataclasses import dataclass, replace

from glassplat.data.dataset import Dataset
from glassplat.densify.default import DefaultDensify, reset_opacity
from glassplat.densify.perturb import perturb_opacities
from glassplat.scene.gaussians import Gaussians
from glassplat.train.stage import Clock, Every
from glassplat.train.state import TrainState


def gaussian_moments(state: TrainState, part: str) -> dict:
    """The optimiser's moments of one set of Gaussians, by tensor name."""
    prefix = f"{part}."
    return {name.removeprefix(prefix): m for name, m in state.optimizer.moments.items() if name.startswith(prefix)}


def put_gaussians(state: TrainState, part: str, gaussians: Gaussians, moments: dict) -> None:
    """Puts an edited set and its moments back."""
    state.scene = replace(state.scene, **{part: gaussians})
    state.optimizer.moments.update({f"{part}.{name}": m for name, m in moments.items()})


@dataclass(frozen=True)
class GrowSh:
    """Raises the SH degree in use by one, up to the highest that is stored."""

    when: Every
    part: str = "primary"
    name: str = "grow SH"

    def due(self, clock: Clock) -> bool:
        """Whether to act after this step."""
        return self.when.due(clock)

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> None:
        """Edits `state`."""
        gaussians = state.scene.gaussian_sets()[self.part]
        degree = min(gaussians.active_sh_degree + 1, gaussians.max_sh_degree)
        state.scene = replace(state.scene, **{self.part: replace(gaussians, active_sh_degree=degree)})


@dataclass(frozen=True)
class Densify:
    """Clones, splits and prunes one set of Gaussians by its screen gradients."""

    when: Every
    densifier: DefaultDensify
    part: str = "primary"

    @property
    def name(self) -> str:
        """What the log calls it."""
        return f"densify {self.part}"

    def due(self, clock: Clock) -> bool:
        """Whether to act after this step; never more often than about once per pass over the views."""
        return replace(self.when, least=max(self.when.least, min(clock.views, 100))).due(clock)

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> None:
        """Edits `state`."""
        statistics = state.statistics.pop(self.part, None)
        gaussians = state.scene.gaussian_sets()[self.part]
        if statistics is None or len(gaussians) == 0:
            return
        edited, moments = self.densifier.densify(
            gaussians,
            gaussian_moments(state, self.part),
            statistics,
            extent=state.scene.extent,
            generator=state.generator(self.name),
        )
        put_gaussians(state, self.part, edited, moments)


@dataclass(frozen=True)
class ResetOpacity:
    """Lowers the opacity of the primary Gaussians to a ceiling (3DGS)."""

    when: Every
    ceiling: float = 0.01
    name: str = "reset opacity"

    def due(self, clock: Clock) -> bool:
        """Whether to act after this step."""
        return self.when.due(clock)

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> None:
        """Edits `state`."""
        gaussians, moments = reset_opacity(
            state.scene.primary, gaussian_moments(state, "primary"), ceiling=self.ceiling
        )
        put_gaussians(state, "primary", gaussians, moments)


@dataclass(frozen=True)
class PerturbOpacity:
    """Adds noise to the opacity of what is seen through a pane (TR-Gaussians, Section III-C3)."""

    when: Every
    amplitude: float = 0.4
    name: str = "perturb opacity"

    def due(self, clock: Clock) -> bool:
        """Whether to act after this step."""
        return self.when.due(clock)

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> None:
        """Edits `state`."""
        if len(state.scene.planes) == 0:
            return
        cameras = [view.camera for view in dataset.train]
        state.scene = replace(
            state.scene,
            primary=perturb_opacities(
                state.scene.primary,
                state.scene.planes,
                cameras,
                amplitude=self.amplitude,
                generator=state.generator(self.name),
            )[0],
        )
