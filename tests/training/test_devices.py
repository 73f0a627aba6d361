"""Training creates its tensors on the device of the scene, which can be checked without a GPU."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch.overrides import TorchFunctionMode

from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.training.loop import train
from glassplat.training.options import DefaultDensify
from glassplat.training.stage import TrainState
from tests.training.tiny_capture import place_true_planes, tiny_capture

FACTORIES = {
    torch.zeros, torch.ones, torch.empty, torch.full, torch.eye, torch.arange, torch.linspace, torch.tensor,
    torch.rand, torch.randn, torch.from_numpy,
}  # fmt: skip
# Code for the CPU's kernels, for a run's initial state, which is moved as a whole, and for data, which stays in memory.
ON_THE_CPU = (
    "/cpu.py",
    "/cpu_",
    "/panes/",
    "/captures/",
    "/methods/surroundings.py",
    "/scene/gaussians.py",
    "/scene/panes.py",
    "/scene/scene.py",
    "/scene/corrections.py",
)


class WithoutDevice(TorchFunctionMode):
    """Collects the source lines of the package that create a tensor without a device."""

    def __init__(self) -> None:
        super().__init__()
        self.places: set[str] = set()

    def __torch_function__(
        self,
        function: Callable[..., Any],
        types: Sequence[type],
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        if function in FACTORIES and (kwargs or {}).get("device") is None:
            frame = sys._getframe(1)
            while frame.f_back is not None and "/torch/" in frame.f_code.co_filename:
                frame = frame.f_back
            path = frame.f_code.co_filename
            if "/glassplat/" in path and not any(part in path for part in ON_THE_CPU):
                self.places.add(f"{path}:{frame.f_lineno}")
        return function(*args, **(kwargs or {}))


def trained(steps: int) -> TrainState:
    """A state after some steps through all stages, with densification and perturbed opacities."""
    recipe = PlanarRecipe(
        sh_degree=1,
        stage_shares=(0.2, 0.3, 0.5),
        densify=DefaultDensify(interval=1, start=0.0, stop=1.0, gradient_threshold=0.0, cap=60),
    )
    stages = tuple(replace(s, setup=place_true_planes) if s.setup else s for s in recipe.stages(seed=0))
    state = TrainState(SplatRecipe(sh_degree=1).initialise(tiny_capture()), seed=0)
    for _ in train(stages, tiny_capture(), state, steps):
        pass
    return state


def test_training_says_where_it_creates_tensors() -> None:
    tiny_capture()
    with WithoutDevice() as mode:
        trained(12)
    assert not mode.places


def test_a_state_moves_as_a_whole() -> None:
    state = trained(4)
    moved = state.to("meta")
    tensors = [*moved.scene.parameters().values(), *(t for pair in moved.optimizer.moments.values() for t in pair)]
    tensors += [tensor for known in moved.statistics.values() for tensor in known]
    assert {tensor.device.type for tensor in tensors} == {"meta"}
    assert moved.step == 4
    assert moved.optimizer.updates == state.optimizer.updates
