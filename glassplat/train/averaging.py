"""The mean of the last steps in place of the last step."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from glassplat.train.stage import Clock
from glassplat.train.state import TrainState

LONGEST_SHARE = 0.1
"""Share of the run over which the mean may reach, because a short run still changes much during its last pass."""
STEPS = "averaged steps"


@dataclass(frozen=True)
class AverageLast:
    """Gives the scene, at the end of the run, the mean of its parameters over the last passes over the views.

    Each step pulls the scene towards one view, and learning rates are high to the end; the mean over a pass has no
    favourite view (averaged gradient descent: Polyak and Juditsky 1992; not in the papers).

    Attributes:
        passes: over the training views; 0 keeps the parameters of the last step.
    """

    passes: float

    def __call__(self, state: TrainState, clock: Clock, visible: Tensor | None) -> None:
        """Edits `state`; should the set of Gaussians change meanwhile, the mean begins anew."""
        length = min(round(self.passes * clock.views), int(LONGEST_SHARE * clock.iterations))
        if clock.step <= clock.iterations - length:
            return
        parameters = state.scene.parameters()
        shapes, known = ({name: t.shape for name, t in tensors.items()} for tensors in (parameters, state.means))
        if shapes != known or STEPS not in state.records:
            state.means = {name: tensor.detach().clone() for name, tensor in parameters.items()}
            state.records[STEPS] = 0
        state.records[STEPS] += 1
        for name, tensor in parameters.items():
            state.means[name].lerp_(tensor.detach(), 1 / state.records[STEPS])
        if clock.step == clock.iterations:
            state.scene, state.means = state.scene.with_parameters(state.means), {}
            del state.records[STEPS]
