"""The whole pipeline from Gaussians to gradients on a GPU, at sizes too large for the simulator and the twins."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from glassplat.captures.dataset import load_dataset
from glassplat.cli.runs import open_run
from glassplat.kernels.backend.devices import SIMULATED, cuda_problem
from glassplat.kernels.composite import composite
from glassplat.kernels.project import project
from glassplat.kernels.records import CameraBatch, Deviation, RawGaussians, Splats, TileBins
from glassplat.kernels.tiles import bin_tiles
from glassplat.methods.recipe import RECIPES, recipe_of
from glassplat.model.training import Training
from glassplat.render.traced import traced_surroundings
from glassplat.scene.gaussians import Gaussians
from glassplat.training.options import PhotoExposure, PoseRefinement
from tests.kernels.gaussians_and_cameras import draw
from tests.training.tiny_capture import write_tiny_capture

if SIMULATED or (problem := cuda_problem()) is not None:
    reason = "the simulator is too slow" if SIMULATED else f"no GPU to run the CUDA kernels on: {problem}"
    pytest.skip(reason, allow_module_level=True)

CPU, DEVICE = torch.device("cpu"), torch.device("cuda")


class Rendered(NamedTuple):
    """Bins, outputs and gradients for one camera."""

    bins: TileBins
    outputs: list[Tensor]
    gradients: list[Tensor]


def gaussians(count: int, *, size: float) -> list[Tensor]:
    """Gaussians in front of a camera at the origin, of about this size at a distance of 4."""
    means = torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64) + torch.tensor([2.0, 1.5, 0.8]) * draw(count, 3, seed=1)
    log_scales = torch.log(torch.tensor(size)) + 0.5 * draw(count, 3, seed=3)
    return [means, draw(count, 4, seed=2), log_scales, draw(count, seed=4), 0.4 * draw(count, 16, 3, seed=5)]


def rendered(tensors: list[Tensor], width: int, height: int, *, device: torch.device, dtype: torch.dtype) -> Rendered:
    """Image, coverage and deviation of the Gaussians, and gradients of random sums of them."""

    def moved(tensor: Tensor) -> Tensor:
        return tensor.to(device, dtype)

    leaves = [moved(tensor).requires_grad_() for tensor in tensors]
    focal = 0.7 * max(width, height)
    intrinsics = torch.tensor([[focal, focal, width / 2, height / 2]], dtype=torch.float64)
    camera = CameraBatch(moved(torch.eye(4)[None]), moved(intrinsics), width, height)
    seen = project(RawGaussians(*leaves), camera, sh_degree=3, near=0.05)
    splats = Splats(seen.means2d, seen.conics, seen.opacities, seen.depths, seen.radii)
    bins = bin_tiles(splats, width, height)
    channels = torch.cat([seen.colors, seen.depths[..., None]], dim=-1)
    where = moved(draw(1, height, width, seed=8).clamp(min=0))
    outputs = list(composite(splats, channels, bins, deviation=Deviation(3, where, True)))
    outputs = [outputs[0], outputs[1], outputs[3]]
    cotangents = [moved(draw(*output.shape, seed=20 + i)) for i, output in enumerate(outputs)]
    gradients = torch.autograd.grad(outputs, leaves, cotangents)
    return Rendered(bins, [output.detach() for output in outputs], list(gradients))


def check_statistics(found: Tensor, expected: Tensor, tolerance: float = 1e-3) -> None:
    """Checks norm, direction and mean of the error: a bias too small to show in single entries adds up over many."""
    own, want = found.to(CPU, torch.float64).flatten(), expected.flatten()
    assert torch.isfinite(own).all()
    assert abs(own.norm() / want.norm() - 1) < tolerance
    assert torch.nn.functional.cosine_similarity(own, want, dim=0) > 1 - tolerance
    assert (own - want).norm() < 5 * tolerance * want.norm()
    assert abs((own - want).sum()) < tolerance * want.abs().sum()


def check_against_the_cpu(tensors: list[Tensor], width: int, height: int) -> None:
    """Checks that float32 on the GPU agrees with float64 on the CPU."""
    found = rendered(tensors, width, height, device=DEVICE, dtype=torch.float32)
    expected = rendered(tensors, width, height, device=CPU, dtype=torch.float64)
    assert len(expected.bins.pair_splats) > 0
    for own, want in zip((*found.outputs, *found.gradients), (*expected.outputs, *expected.gradients), strict=True):
        check_statistics(own, want)


def test_gradients_of_many_gaussians_have_no_bias() -> None:
    check_against_the_cpu(gaussians(50_000, size=0.02), 640, 352)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1001, 5), (3, 701), (333, 17), (16, 48)])
def test_images_of_any_shape(width: int, height: int) -> None:
    check_against_the_cpu(gaussians(3000, size=0.06), width, height)


@pytest.mark.parametrize("count", [0, 1])
def test_few_gaussians(count: int) -> None:
    tensors = gaussians(count, size=0.3)
    found = rendered(tensors, 50, 30, device=DEVICE, dtype=torch.float32)
    expected = rendered(tensors, 50, 30, device=CPU, dtype=torch.float64)
    for own, want in zip((*found.outputs, *found.gradients), (*expected.outputs, *expected.gradients), strict=True):
        torch.testing.assert_close(own.to(CPU, torch.float64), want, rtol=1e-3, atol=1e-3)


def test_ten_million_pairs() -> None:
    tensors = gaussians(400_000, size=0.12)
    first, second = (rendered(tensors, 1280, 720, device=DEVICE, dtype=torch.float32) for _ in range(2))
    bins = first.bins
    assert len(bins.pair_splats) > 10_000_000
    check_bins(bins)
    for own, again in zip((*first.outputs, *first.gradients), (*second.outputs, *second.gradients), strict=True):
        assert torch.isfinite(own).all()
        assert torch.equal(own, again)
    expected = rendered(tensors, 1280, 720, device=CPU, dtype=torch.float64)
    for own, want in zip((*first.outputs, *first.gradients), (*expected.outputs, *expected.gradients), strict=True):
        check_statistics(own, want)


def check_bins(bins: TileBins) -> None:
    """Checks that every pair belongs to exactly one tile and can be found from its splat."""
    pairs = len(bins.pair_splats)
    assert int(bins.tile_offsets[-1]) == int(bins.splat_offsets[-1]) == pairs
    assert torch.equal(bins.pair_slots.sort().values, torch.arange(pairs, dtype=torch.int32, device=DEVICE))
    owners = torch.arange(len(bins.splat_offsets) - 1, device=DEVICE).repeat_interleave(bins.splat_offsets.diff())
    assert torch.equal(bins.pair_splats[bins.pair_slots.long()].long(), owners)


def test_rays_hit_the_same_on_gpu_and_cpu() -> None:
    part = Gaussians(*(tensor.float() for tensor in gaussians(2000, size=0.05)), active_sh_degree=3)
    origins, directions = torch.zeros(100, 3), torch.tensor([0.0, 0.0, 1.0]) + 0.3 * draw(100, 3, seed=9).float()
    on_cpu = traced_surroundings(part, origins, directions, 0.0)
    on_gpu = traced_surroundings(part.to(DEVICE), origins.to(DEVICE), directions.to(DEVICE), 0.0)
    assert on_gpu.colors.device.type == DEVICE.type
    torch.testing.assert_close(on_gpu.colors.cpu(), on_cpu.colors, atol=1e-3, rtol=0)


@pytest.mark.parametrize("method", RECIPES)
def test_every_method_trains_and_is_opened_with_all_corrections(method: str, tmp_path: Path) -> None:
    dataset = load_dataset(write_tiny_capture(tmp_path / "capture"))
    recipe = replace(recipe_of(method), exposure=PhotoExposure(1e-3), poses=PoseRefinement(1e-4))
    if hasattr(recipe, "least_iterations"):
        recipe = replace(recipe, least_iterations=1)  # A run this short would not reach its reflections.
    model = Training(dataset, recipe, iterations=80, device=DEVICE.type, output=tmp_path / "run").run()
    run = open_run(tmp_path / "run", DEVICE.type)
    for view in run.dataset.test:
        own, again = model.image(view.name), run.renderer(run.scene, view.camera).rgb.detach().cpu().clamp(0, 1)
        torch.testing.assert_close(own, again, atol=1e-4, rtol=0)
