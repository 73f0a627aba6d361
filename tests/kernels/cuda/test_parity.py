"""Every CUDA kernel against its PyTorch twin, forward and backward: on a GPU, or on tiny inputs in Numba's simulator.

`test_simulator.py` runs this file once more with the simulator on.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from glassplat.kernels import adam as adam_operation
from glassplat.kernels import composite as composite_operation
from glassplat.kernels import environment as environment_operation
from glassplat.kernels import photometric as photometric_operation
from glassplat.kernels import project as project_operation
from glassplat.kernels import tiles as tiles_operation
from glassplat.kernels.adam import reference as adam_twin
from glassplat.kernels.backend.devices import SIMULATED, kernels_for
from glassplat.kernels.composite import reference as composite_twin
from glassplat.kernels.environment import reference as environment_twin
from glassplat.kernels.photometric import reference as photometric_twin
from glassplat.kernels.project import reference as project_twin
from glassplat.kernels.records import CameraBatch, Deviation, RawGaussians, Splats
from glassplat.kernels.screen_statistics import Sums, Views
from glassplat.kernels.tiles import reference as tiles_twin
from tests.kernels.cuda.agreement import (
    DEVICE,
    DTYPES,
    HEIGHT,
    WIDTH,
    check_gradients,
    close,
    many,
    on_a_device_or_skipped,
    on_device,
)
from tests.kernels.gaussians_and_cameras import draw, needle_before_camera, random_cameras, random_gaussians
from tests.kernels.test_screen_statistics import add_views_in_torch

on_a_device_or_skipped()

pytestmark = [
    # The simulator computes with NumPy's scalars, which warn where a GPU returns infinity.
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),
]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    ("count", "cameras", "degree"), [(many(9, 3000), 2, 3), (many(5, 700), 1, 1), (1, 1, 0), (0, 1, 3)]
)
def test_project(count: int, cameras: int, degree: int, dtype: torch.dtype) -> None:
    gaussians = random_gaussians(count, dtype=dtype)
    batch = random_cameras(cameras, clip=cameras > 1, dtype=dtype)
    own, own_batch = on_device(gaussians), on_device(batch)
    found = project_operation.project(own, own_batch, sh_degree=degree, near=0.1)
    expected = project_twin.project(gaussians, batch, sh_degree=degree, near=0.1)
    for name, value in expected._asdict().items():
        close(getattr(found, name), value, 10)
    leaves = [*gaussians, batch.cam_from_world]
    check_gradients(found[:5], expected[:5], [*own, own_batch.cam_from_world], leaves)


def test_gradients_of_needles_do_not_cancel_in_single_precision() -> None:
    found = {}
    for dtype in (torch.float32, torch.float64):
        needle, camera = needle_before_camera(0.785, dtype)
        own, own_camera = on_device(needle), on_device(camera)
        conics = project_operation.project(own, own_camera, sh_degree=0, near=0.1).conics
        cotangent = torch.tensor([[[700.0, 650.0, 690.0]]], dtype=dtype, device=DEVICE)
        found[dtype] = torch.autograd.grad(conics, own[:3], cotangent)
    for ours, exact in zip(found[torch.float32], found[torch.float64], strict=True):
        assert (ours - exact).norm() < 1e-3 * exact.norm()


def test_project_without_colours_culls_what_is_not_finite() -> None:
    gaussians = random_gaussians(6, coefficients=0)
    poison = gaussians._replace(means=gaussians.means.detach().index_fill(0, torch.tensor([2]), torch.nan))
    batch = random_cameras(1)
    windows = torch.tensor([[10.0, 5.0, 30.0, 30.0]], dtype=torch.float64)
    batch = CameraBatch(batch.cam_from_world, batch.intrinsics, batch.width, batch.height, None, windows)
    found = project_operation.project(on_device(poison), on_device(batch), sh_degree=0, near=0.1)
    expected = project_twin.project(poison, batch, sh_degree=0, near=0.1)
    for name, value in expected._asdict().items():
        close(getattr(found, name), value)


SplatMaker = Callable[..., Splats]


def listed(bins: Any) -> set[tuple[int, int]]:
    """The (tile, splat) pairs of bins."""
    sizes = bins.tile_offsets.diff().cpu()
    tiles = torch.arange(len(sizes)).repeat_interleave(sizes)
    return set(zip(tiles.tolist(), bins.pair_splats.cpu().tolist(), strict=True))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("masked", [False, True])
def test_bin_tiles(random_splats: SplatMaker, masked: bool, dtype: torch.dtype) -> None:
    splats = random_splats((2, many(12, 500)), (WIDTH, HEIGHT), dtype=dtype)
    splats.depths[:, 3] = splats.depths[:, 5]
    splats.radii[0, 1] = 0
    rows, columns = tiles_operation.tile_grid(WIDTH, HEIGHT)
    mask = draw(2, rows, columns, seed=4) > 0 if masked else None
    own_mask = None if mask is None else mask.to(DEVICE)
    found = tiles_operation.bin_tiles(on_device(splats), WIDTH, HEIGHT, own_mask)
    expected = tiles_twin.bin_tiles(splats, WIDTH, HEIGHT, mask)
    assert listed(expected) <= listed(found)
    assert len(listed(found) - listed(expected)) <= 0.02 * len(listed(expected)) + 1
    assert found.active.tolist() == expected.active.tolist()
    depths = splats.depths.flatten()[found.pair_splats.long().cpu()]
    for begin, end in zip(found.tile_offsets.tolist(), found.tile_offsets.tolist()[1:], strict=False):
        order = list(zip(depths[begin:end].tolist(), found.pair_splats[begin:end].tolist(), strict=True))
        assert order == sorted(order)
    owners = torch.arange(splats.depths.numel()).repeat_interleave(found.splat_offsets.diff().cpu())
    assert found.pair_splats.cpu()[found.pair_slots.long().cpu()].tolist() == owners.tolist()
    assert found.pair_slots.sort().values.tolist() == list(range(len(owners)))


@pytest.mark.parametrize("count", [0, 1])
def test_bin_tiles_of_few_splats(random_splats: SplatMaker, count: int) -> None:
    splats = random_splats((1, count), (WIDTH, HEIGHT))
    found = tiles_operation.bin_tiles(on_device(splats), WIDTH, HEIGHT)
    assert listed(tiles_twin.bin_tiles(splats, WIDTH, HEIGHT)) <= listed(found)
    assert found.splat_offsets.shape == (count + 1,)


def dots(cameras: int, count: int, size: tuple[int, int]) -> Splats:
    """Splats that each cover exactly one pixel, so that the result is unique; some lie at the same depth."""
    generator = torch.Generator().manual_seed(7)
    pixels = torch.rand(cameras, count, 2, generator=generator) * torch.tensor(size)
    ones = torch.ones(cameras, count)
    conics = torch.tensor([100.0, 0.0, 100.0]).repeat(cameras, count, 1)
    depths = torch.randint(1, 4, (cameras, count), generator=generator).float()
    return Splats(pixels.floor() + 0.5, conics, ones, depths, ones[..., None].repeat(1, 1, 2))


@pytest.mark.parametrize("active", ["every", "some", "none"])
@pytest.mark.parametrize(
    ("cameras", "count", "size"),
    [
        (0, 3, (20, 17)), (2, 0, (20, 17)), (1, 1, (70, 50)), (1, 30, (20, 17)), (3, 5, (33, 17)),
        # This many tiles need wider integers, and take seconds in the simulator.
        *([] if SIMULATED else [(1, 9, (16 * 40_000, 1)), (2, 3000, (300, 200))]),
    ],
    ids=str,
)  # fmt: skip
def test_unambiguous_bins_equal_those_of_the_reference(
    cameras: int, count: int, size: tuple[int, int], active: str
) -> None:
    splats = dots(cameras, count, size)
    shape = (cameras, *tiles_operation.tile_grid(*size))
    mask = None if active == "every" else (draw(*shape, seed=5) > (0 if active == "some" else torch.inf))
    found = tiles_operation.bin_tiles(on_device(splats), *size, None if mask is None else mask.to(DEVICE))
    expected = tiles_twin.bin_tiles(splats, *size, mask)
    for name, tensor in expected._asdict().items():
        own = getattr(found, name)
        if isinstance(tensor, Tensor):
            assert (own.dtype, own.is_contiguous(), own.tolist()) == (tensor.dtype, True, tensor.tolist()), name
        else:
            assert own == tensor


def test_splats_of_very_different_sizes_are_listed_in_their_tiles(random_splats: SplatMaker) -> None:
    size = 70, 50
    splats = random_splats((2, many(9, 900)), size, sigmas=(0.3, 9.0))
    splats.conics[1, 4] = torch.tensor([1e-6, 0.0, 1e-6])
    splats.radii[1, 4] = 1000
    found, expected = tiles_operation.bin_tiles(on_device(splats), *size), tiles_twin.bin_tiles(splats, *size)
    assert found.splat_offsets.diff()[splats.depths.shape[1] + 4] == 20
    assert listed(expected) <= listed(found)
    assert len(listed(found) - listed(expected)) <= 0.02 * len(listed(expected)) + 1


def test_pairs_that_were_counted_but_not_found_end_behind_the_last_tile(
    random_splats: SplatMaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    splats = on_device(random_splats((1, 6), (WIDTH, HEIGHT)))
    expected = tiles_operation.bin_tiles(splats, WIDTH, HEIGHT)
    module = kernels_for("tiles", DEVICE)
    count = module.count_tiles(np.float64)

    def one_more(*arguments: Any) -> None:
        count.over(*arguments)
        arguments[-1][1:].add_(1)

    monkeypatch.setattr(module, "count_tiles", lambda real: SimpleNamespace(over=one_more))
    found = tiles_operation.bin_tiles(splats, WIDTH, HEIGHT)
    assert torch.equal(found.tile_offsets, expected.tile_offsets)
    assert torch.equal(found.pair_splats[: len(expected.pair_splats)], expected.pair_splats)
    assert found.pair_splats[len(expected.pair_splats) :].sort().values.tolist() == list(range(6))
    assert found.pair_slots.sort().values.tolist() == list(range(len(expected.pair_splats) + 6))


Size = tuple[int, int]


def blended(
    splats: Splats, channels: Tensor, marks: Tensor, absgrad: Tensor, deviation: Deviation | None, own: bool, size: Size
) -> list[Tensor]:
    """Image, alpha, mask and deviation of all cameras with glass; the last camera's first tile is masked out."""
    binning, blending = (tiles_operation, composite_operation) if own else (tiles_twin, composite_twin)
    primary = splats.depths.shape[1] - marks.shape[1]
    mask = torch.ones(splats.depths.shape[0], *tiles_operation.tile_grid(*size), dtype=torch.bool)
    mask[-1, 0, 0] = False
    bins = binning.bin_tiles(splats, *size, mask.to(channels.device))
    options = {"marks": marks, "num_primary": primary, "deviation": deviation, "absgrad": absgrad}
    return list(blending.composite(splats, channels, bins, **options))


def check_composite(splats: Splats, glass: int, mean: bool | None, size: Size) -> None:
    """Checks all outputs and gradients. The last `glass` splats are glass; `mean` None asks for no deviation."""
    (cameras, count), dtype = splats.depths.shape, splats.depths.dtype
    splats = Splats(*(tensor.requires_grad_(i < 3) for i, tensor in enumerate(splats)))
    channels = draw(cameras, count, 4, seed=11).to(dtype).requires_grad_()
    marks = draw(cameras, glass, seed=12).to(dtype).sigmoid().requires_grad_()
    where = draw(cameras, *reversed(size), seed=13).to(dtype).clamp(min=0)
    if mean is not None:
        # Where a single splat is blended, its value is the mean, and rounding decides on which side it lies.
        everywhere = Deviation(3, torch.ones_like(where), mean)
        where = where * (blended(splats, channels, marks, None, everywhere, False, size)[3].detach() > 1e-6)
    absgrad = torch.zeros(cameras, count, 2, dtype=dtype, requires_grad=True)
    own_splats, own_channels, own_marks, own_absgrad = map(on_device, (splats, channels, marks, absgrad))
    request = None if mean is None else Deviation(3, where, mean)
    own_request = None if mean is None else Deviation(3, where.to(DEVICE), mean)
    found = blended(
        own_splats, own_channels, own_marks, own_absgrad, own_request, (tiles_operation, composite_operation), size
    )
    expected = blended(splats, channels, marks, absgrad, request, False, size)
    for value, want in zip(found, expected, strict=True):
        close(value, want)
    outputs = 3 if mean is None else 4
    own = [*own_splats[:3], own_channels, own_marks, own_absgrad]
    check_gradients(found[:outputs], expected[:outputs], own, [*splats[:3], channels, marks, absgrad])


@pytest.mark.parametrize(
    ("mean", "dtype", "size"),
    [
        (None, torch.float64, (WIDTH, HEIGHT)),
        # A few rows suffice for the simulator.
        (True, torch.float64, (19, 2)),
        (False, torch.float32, (18, 2)),
    ]
    if SIMULATED
    else [(mean, dtype, (WIDTH, HEIGHT)) for mean in (None, False, True) for dtype in DTYPES],
)
def test_composite(random_splats: SplatMaker, mean: bool | None, dtype: torch.dtype, size: Size) -> None:
    shape = (2, many(22, 300))
    splats = random_splats(shape, size, dtype=dtype, opacities=(0.3, 0.999), sigmas=(2.0, 9.0))
    check_composite(splats, many(6, 80), mean, size)


def test_the_deviation_of_a_splat_alone_has_no_gradient() -> None:
    fields = (torch.tensor([9.3, 1.2]), torch.tensor([0.01, 0.0, 0.01]), torch.tensor(0.8), torch.tensor(3.0))
    splats = on_device(Splats(*(field[None, None] for field in fields), torch.full((1, 1, 2), 40.0)))
    values = torch.full((1, 1, 1), 3.1, device=DEVICE, requires_grad=True)
    asked = Deviation(0, torch.ones(1, 2, 18, device=DEVICE))
    bins = tiles_operation.bin_tiles(splats, 18, 2)
    found = composite_operation.composite(splats, values, bins, deviation=asked)
    assert float(found.alpha.detach().sum()) > 20
    assert float(torch.autograd.grad(found.deviation.sum(), values)[0].abs()) < 1e-2


@pytest.mark.parametrize("dtype", DTYPES)
def test_composite_of_many_splats_of_one_tile(random_splats: SplatMaker, dtype: torch.dtype) -> None:
    size, shape = (7, 3), (2, many(100, 1000))
    splats = random_splats(shape, size, dtype=dtype, opacities=(0.01, many(40, 10) / 100), sigmas=(2.0, 9.0))
    assert tiles_twin.bin_tiles(splats, *size).tile_offsets[1] > 64
    check_composite(splats, many(25, 200), True, size)


@pytest.mark.parametrize(("count", "channels"), [(0, 3), (1, 1), (many(18, 60), 12)])
def test_composite_without_glass(random_splats: SplatMaker, count: int, channels: int) -> None:
    size = WIDTH, many(3, HEIGHT)
    splats = random_splats((1, count), size)
    splats = Splats(*(tensor.requires_grad_(i < 3) for i, tensor in enumerate(splats)))
    values = draw(1, count, channels, seed=3).requires_grad_()
    own, own_values = on_device(splats), on_device(values)
    found = composite_operation.composite(own, own_values, tiles_operation.bin_tiles(own, *size))
    expected = composite_twin.composite(splats, values, tiles_twin.bin_tiles(splats, *size))
    close(found.image, expected.image)
    close(found.alpha, expected.alpha)
    if count:
        leaves, own_leaves = [*splats[:3], values], [*own[:3], own_values]
        check_gradients([found.image, found.alpha], [expected.image, expected.alpha], own_leaves, leaves)


@pytest.mark.parametrize("weight", ["number", "scalar", "each"])
@pytest.mark.parametrize("dtype", DTYPES)
def test_screen_statistics(weight: str, dtype: torch.dtype) -> None:
    cameras, count = 2, many(9, 3000)
    v_means, v_absgrad, radii = (draw(cameras, count, 2, seed=seed).to(dtype) for seed in (1, 2, 3))
    weights = {
        "number": 0.7,
        "scalar": torch.tensor(0.7, dtype=dtype),
        "each": draw(cameras, count, seed=4).to(dtype).sigmoid(),
    }
    expected = Sums(*torch.zeros(3, 2, count, dtype=dtype))
    found = on_device(expected)
    for direct in (True, False):
        views = Views(v_means, v_absgrad, radii, 40, 30, weights[weight], direct)
        # In the simulator, tensors on the "device" are CPU tensors, for which the operation would use the CPU's kernel.
        kernels_for("project", DEVICE).add_views(found, on_device(views))
        add_views_in_torch(expected, views)
    for value, want in zip(found, expected, strict=True):
        close(value, want)


@pytest.mark.parametrize(("dtype", "differentiated"), [(torch.float64, True), (torch.float32, False)])
def test_photometric(dtype: torch.dtype, differentiated: bool) -> None:
    size = (many(9, HEIGHT), many(18, WIDTH), 3)
    image, target = torch.rand(size, dtype=dtype), (torch.rand(size) * 255).to(torch.uint8)
    image.requires_grad_(differentiated)
    own = on_device(image)
    found = photometric_operation.photometric(own, target.to(DEVICE))
    expected = photometric_twin.photometric(image, target)
    for value, want in zip(found, expected, strict=True):
        close(value, want)
    if differentiated:
        check_gradients(found, expected, [own], [image])


def directions_of(count: int) -> Tensor:
    """Random directions, then those of all edges, corners and faces of a cube, each with a slightly perturbed copy."""
    whole = torch.cartesian_prod(*3 * [torch.tensor([-1.0, 0.0, 1.0])])
    whole = whole[whole.abs().sum(1) > 0]
    return torch.cat([draw(count, 3, seed=6).float(), whole + 0.01 * draw(len(whole), 3, seed=7).float()])


@pytest.mark.parametrize(
    ("size", "depth", "count", "dtype"), [(1, 2, 5, torch.float64), (many(2, 16), 3, many(20, 9000), torch.float32)]
)
def test_cube_lookup(size: int, depth: int, count: int, dtype: torch.dtype) -> None:
    texels = draw(6, size, size, depth, seed=5).to(dtype).requires_grad_()
    directions = directions_of(count).to(dtype).requires_grad_()
    leaves, own = [texels, directions], [on_device(texels), on_device(directions)]
    found, expected = environment_operation.cube_lookup(*own), environment_twin.cube_lookup(*leaves)
    close(found, expected)
    check_gradients([found], [expected], own, leaves)


def test_cube_lookup_of_many_directions_of_one_texel_and_of_none() -> None:
    near = torch.tensor([0.1, 1.0, 0.2], dtype=torch.float64) + 0.02 * draw(70, 3, seed=1)
    for size, directions in ((2, near), (1, near[:0])):
        texels = draw(6, size, size, 1, seed=5).requires_grad_()
        leaves = [texels, directions.detach().requires_grad_()]
        own = [on_device(leaf) for leaf in leaves]
        found, expected = environment_operation.cube_lookup(*own), environment_twin.cube_lookup(*leaves)
        close(found, expected)
        check_gradients([found], [expected], own, leaves)


@pytest.mark.parametrize("dtype", DTYPES[: many(1, 2)])
def test_shade_environment(dtype: torch.dtype) -> None:
    height, width, size = many(7, HEIGHT), many(8, WIDTH), many(2, 16)
    normals = draw(height, width, 3, seed=2)
    normals[:, : width // 4], normals[1, width // 2] = 0, torch.tensor([1e-7, 0.0, 0.0])
    base, strength = draw(height, width, 3, seed=1).sigmoid(), draw(height, width, seed=3).clamp(min=0, max=1)
    texels, rotation = draw(6, size, size, 3, seed=4), torch.linalg.qr(draw(3, 3, seed=5))[0].to(dtype)
    intrinsics = torch.tensor([0.9 * width, 0.8 * width, width / 2 + 0.3, height / 2 - 0.4], dtype=dtype)
    blended = torch.cat([base, normals, strength[..., None], draw(height, width, 1, seed=6)], dim=-1)
    alpha = draw(height, width, seed=7).sigmoid()
    leaves = [tensor.to(dtype).detach().requires_grad_() for tensor in (blended, alpha, texels, rotation)]
    own = [on_device(leaf) for leaf in leaves]
    options = {"background": (0.5, 1.0, 0.25), "least_strength": 0.2}
    found = environment_operation.shade_environment(*own[:3], intrinsics.to(DEVICE), own[3], **options)
    expected = environment_twin.shade_environment(*leaves[:3], intrinsics, leaves[3], **options)
    for value, want in zip(found, expected, strict=True):
        close(value, want)
    check_gradients(found, expected, own, leaves)


@pytest.mark.parametrize("count", [0, 1, many(40, 4000)])
@pytest.mark.parametrize("dtype", DTYPES)
def test_surface_channels(count: int, dtype: torch.dtype) -> None:
    colors, quats, log_scales, means = (draw(count, k, seed=seed).to(dtype) for seed, k in enumerate((3, 4, 3, 3)))
    strengths, extra = draw(count, seed=5).to(dtype), draw(count, 2, seed=6).to(dtype)
    radii = (draw(count, 2, seed=7) > -1).to(dtype)
    log_scales[: count // 3], quats[count // 2 : count // 2 + 2] = -1, 0
    eye = torch.tensor([0.2, 0.1, -0.3], dtype=dtype)
    leaves = [tensor.requires_grad_() for tensor in (colors, quats, strengths, extra)]
    own = [on_device(leaf) for leaf in leaves]
    fixed = [tensor.to(DEVICE) for tensor in (radii, log_scales, means, eye)]
    found = environment_operation.surface_channels(own[0], fixed[0], own[1], *fixed[1:3], own[2], fixed[3], own[3])
    expected = environment_twin.surface_channels(colors, radii, quats, log_scales, means, strengths, eye, extra)
    close(found, expected)
    check_gradients([found], [expected], own, leaves)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("columns", [False, True])
def test_adam(columns: bool, dtype: torch.dtype) -> None:
    expected = [draw(many(50, 5000), 2, 3, seed=i).to(dtype) for i in range(2)]
    expected += [torch.zeros_like(expected[0]), torch.zeros_like(expected[0])]
    found = [tensor.clone().to(DEVICE) for tensor in expected]
    lr = torch.linspace(0.1, 0.6, 6, dtype=dtype) if columns else 0.3
    decay = torch.linspace(0.0, 0.5, 6, dtype=dtype) if columns else None
    for step in (1, 2, 3):
        adam_operation.adam([adam_operation.Update(*found, lr, step, decay)])
        adam_twin.adam([adam_operation.Update(*expected, lr, step, decay)])
    for value, want in zip(found, expected, strict=True):
        close(value, want)


@pytest.mark.parametrize("count", [1, 5, 6, 11])
def test_adam_of_many_parameters(count: int) -> None:
    """Boundaries of thread blocks, and of launches of several parameters, fall inside the list."""
    shapes = [(256,), (3, 4, 3), (257,), (0, 3), (1, 3), (130, 2), (7,), (2, 2, 3), (1,), (512,), (300,)][:count]
    found, expected = [], []
    for i, shape in enumerate(shapes):
        tensors = [draw(*shape, seed=4 * i + k) for k in range(3)] + [draw(*shape, seed=4 * i + 3).square()]
        columns = torch.linspace(0.1, 0.6, math.prod(shape[1:]), dtype=torch.float64)
        options = (columns if i % 3 == 1 else 0.1 + 0.1 * i, i + 1, columns / 2 if i % 2 else None)
        expected.append(adam_operation.Update(*tensors, *options))
        found.append(adam_operation.Update(*(tensor.to(DEVICE, copy=True) for tensor in tensors), *options))
    adam_operation.adam(found, betas=(0.8, 0.95))
    adam_twin.adam(expected, betas=(0.8, 0.95))
    for own, wanted in zip(found, expected, strict=True):
        for value, want in zip(own[:4], wanted[:4], strict=True):
            close(value, want)


def test_the_result_has_the_same_bits_every_time(random_splats: SplatMaker) -> None:
    size = WIDTH, many(3, HEIGHT)
    splats = on_device(random_splats((1, many(40, 2000)), size, dtype=torch.float32))
    splats = Splats(*(tensor.requires_grad_(i < 3) for i, tensor in enumerate(splats)))
    channels = draw(1, splats.depths.shape[1], 4, seed=2).float().to(DEVICE)
    results = []
    for _ in range(2):
        image = composite_operation.composite(splats, channels, tiles_operation.bin_tiles(splats, *size)).image
        results.append((image, *torch.autograd.grad(image.square().sum(), splats[:3])))
    for first, second in zip(*results, strict=True):
        assert torch.equal(first, second)


def test_raw_gaussians_are_not_modified() -> None:
    gaussians = RawGaussians(*(tensor.detach().to(DEVICE) for tensor in random_gaussians(4)))
    before = [tensor.clone() for tensor in gaussians]
    project_operation.project(gaussians, on_device(random_cameras(1)), sh_degree=3, near=0.1)
    assert all(torch.equal(tensor, copy) for tensor, copy in zip(gaussians, before, strict=True))


def test_intermediate_tensors_are_stored_only_for_gradients_and_freed_with_the_image(
    random_splats: SplatMaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    splats = on_device(random_splats((1, 3), (4, 2)))
    colors = draw(1, 3, 3, seed=1).to(DEVICE)
    bins = tiles_operation.bin_tiles(splats, 4, 2)
    module = kernels_for("composite", DEVICE)
    composite, stored = module.composite, []

    def noting(*arguments: Any, **options: Any) -> Any:
        result = composite(*arguments, **options)
        stored.append(weakref.ref(result[-1].kept))
        sizes.append(result[-1].kept.numel())
        return result

    sizes: list[int] = []
    monkeypatch.setattr(module, "composite", noting)
    composite_operation.composite(splats, colors, bins)
    with torch.no_grad():
        composite_operation.composite(splats, colors.requires_grad_(), bins)
    kept = composite_operation.composite(splats, colors, bins)
    assert sizes[:2] == [0, 0]
    assert sizes[2] > 0
    assert stored[2]() is not None
    del kept
    assert stored[2]() is None
