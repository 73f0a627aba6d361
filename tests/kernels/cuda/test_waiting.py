"""Number of times a frame and a training step wait for the GPU, counted on a stand-in for one."""

from __future__ import annotations

import ast
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

import glassplat.kernels
from glassplat.captures.view import View
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.render.planar import Planar
from glassplat.render.splat import Splat
from glassplat.scene.camera import constant
from glassplat.scene.scene import Scene
from glassplat.training.loop import collect_statistics, differentiate, update_parameters
from glassplat.training.stage import TrainState
from tests.kernels.cuda.waiting import KERNEL_WAITS, Waits, as_on_a_gpu
from tests.training.tiny_capture import tiny_capture, true_scene

KERNELS = Path(glassplat.kernels.__file__).parent
WAITING = {"tolist", "item", "cpu", "numpy", "nonzero", "unique", "masked_select", "new_tensor", "tensor"}


@pytest.fixture
def waits(monkeypatch: pytest.MonkeyPatch) -> Waits:
    found = Waits()
    as_on_a_gpu(monkeypatch, found)
    return found


def step(recipe: PlanarRecipe | SplatRecipe, stage: int, scene: Scene, view: View, waits: Waits) -> list[str]:
    """Waits of the second step on a view; the first one creates the cached tensors."""
    state, chosen = TrainState(scene, seed=0), recipe.stages(seed=0)[stage]
    for _ in range(2):
        waits.places.clear()
        with waits:
            result = differentiate(chosen, state.scene, view, with_records=True)
            update_parameters(chosen, state, result.gradients, iterations=100)
            collect_statistics(state.statistics, result, view)
    return waits.places


def test_a_splat_frame_synchronizes_once(waits: Waits) -> None:
    scene, view = true_scene(), tiny_capture().train[0]
    waits.places.clear()
    for _ in range(2):
        waits.places.clear()
        with waits, torch.no_grad():
            Splat()(scene, view.camera)
    assert waits.places == ["kernel bin_tiles"]


def test_a_planar_frame_synchronizes_three_times(waits: Waits) -> None:
    scene, view = true_scene(), tiny_capture().train[0]
    for _ in range(2):
        waits.places.clear()
        with waits, torch.no_grad():
            Planar()(scene, view.camera)
    assert {"panes_in_camera", "mirrored_views"} <= waits.asked
    assert sorted(place.partition(":")[0] for place in waits.places) == [
        "kernel bin_tiles",
        "kernel bin_tiles",
        "render/panes.py",
    ]


@pytest.mark.parametrize("annotated", [True, False])
def test_a_planar_step_synchronizes_four_times(waits: Waits, annotated: bool) -> None:
    view = next(view for view in tiny_capture().train if view.is_annotated == annotated)
    places = step(PlanarRecipe(), 2, true_scene(), view, waits)
    assert len(places) == 4, places
    assert places.count("kernel bin_tiles") == 2


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_a_splat_step_synchronizes_twice(waits: Waits, strategy: str) -> None:
    places = step(SplatRecipe(strategy=strategy), 0, true_scene(), tiny_capture().train[0], waits)
    assert len(places) == 2, places


def test_the_stand_in_counts_synchronizations(waits: Waits) -> None:
    values, mask = torch.arange(4.0), torch.tensor([True, False, True, False])
    source = "\n".join(
        [
            "float(values[0])", "values[mask]", "mask.nonzero()", "values.tolist()", "bool(mask.any())",
            "torch.tensor([1.0, 2.0])", "values.new_tensor([1.0])", "values[[0, 1]]",
        ]
    )  # fmt: skip
    for line in source.splitlines():
        waits.places.clear()
        with waits:
            eval(compile(line, "/glassplat/line.py", "eval"), {"values": values, "mask": mask, "torch": torch})
        assert len(waits.places) >= 1, line
    waits.places.clear()
    with waits:
        eval(compile("values.sum() * 2 + values[1:].mean()", "/glassplat/line.py", "eval"), {"values": values})
    assert waits.places == []


def test_the_cuda_kernels_synchronize_as_counted_by_the_stand_in() -> None:
    found: dict[str, int] = {}
    for path in sorted(path for path in KERNELS.glob("*/cuda*.py") if path.parent.name != "backend"):
        for function in ast.parse(path.read_text()).body:
            for node in ast.walk(function):
                if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in WAITING:
                    name = getattr(function, "name", path.name)
                    found[name] = found.get(name, 0) + 1
    assert found == KERNEL_WAITS


def test_terms_skipped_on_a_gpu_do_not_change_statistics(monkeypatch: pytest.MonkeyPatch) -> None:
    def differentiated() -> tuple[dict[str, float], dict[str, Tensor], list[Tensor]]:
        found = differentiate(
            PlanarRecipe().stages(seed=0)[2], true_scene(), tiny_capture().train[0], with_records=True
        )
        return found.losses, found.gradients, [torch.as_tensor(record.weight) for record, *_ in found.screen]

    own = differentiated()
    as_on_a_gpu(monkeypatch, Waits())
    other = differentiated()
    assert own[0] == pytest.approx(other[0], rel=1e-5)
    for name, gradient in own[1].items():
        torch.testing.assert_close(other[1][name], gradient, rtol=1e-4, atol=1e-7)
    for weight, expected in zip(other[2], own[2], strict=True):
        torch.testing.assert_close(weight, expected, rtol=1e-5, atol=1e-6)


def test_constants_are_made_once_for_each_type_and_device() -> None:
    first = constant((1.0, 2.0), torch.float32, torch.device("cpu"))
    assert constant((1.0, 2.0), torch.float32, torch.device("cpu")) is first
    assert constant((1.0, 2.0), torch.float64, torch.device("cpu")).dtype == torch.float64
    camera = replace(tiny_capture().train[0].camera, fx=31.5)
    assert camera.intrinsics.tolist() == pytest.approx([31.5, camera.fy, camera.cx, camera.cy])
