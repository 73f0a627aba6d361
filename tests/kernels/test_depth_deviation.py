from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numba
import pytest
import torch
from torch import Tensor

from glassplat.kernels.bin_tiles import bin_tiles
from glassplat.kernels.composite import composite
from glassplat.kernels.depth_deviation import depth_deviation
from glassplat.kernels.reference.depth_deviation import depth_deviation as depth_deviation_twin
from glassplat.kernels.splats import Splats, TileBins

MakeSplats = Callable[..., Splats]
INPUTS = ("means2d", "conics", "opacities", "depths", "depth_map")


class Case(NamedTuple):
    """What a call of `depth_deviation` takes."""

    splats: Splats
    depth_map: Tensor
    bins: TileBins
    num_primary: int


def case_of(splats: Splats, size: tuple[int, int], *, glass: int = 0, tiles: Tensor | None = None) -> Case:
    """A random depth map to the splats, of which the last `glass` of each camera are glass."""
    cameras, count = splats.opacities.shape
    generator = torch.Generator().manual_seed(5)
    depth_map = 1 + 9 * torch.rand(cameras, size[1], size[0], generator=generator, dtype=torch.float64)
    bins = bin_tiles(splats, *size, tiles)
    return Case(splats, depth_map.to(splats.means2d.dtype), bins, count - glass)


def with_gradients(case: Case, function: Callable[..., Tensor]) -> dict[str, Tensor]:
    """The deviation and, for random cotangents, the gradients of all inputs."""
    inputs = {name: t.detach().requires_grad_() for name, t in case.splats._asdict().items() if name in INPUTS}
    inputs["depth_map"] = case.depth_map.detach().requires_grad_()
    splats = case.splats._replace(**{name: inputs[name] for name in INPUTS[:-1]})
    deviation = function(splats, inputs["depth_map"], case.bins, num_primary=case.num_primary)
    generator = torch.Generator().manual_seed(6)
    cotangent = torch.randn(deviation.shape, generator=generator, dtype=torch.float64).to(deviation.dtype)
    total = (deviation * cotangent).sum() + 0 * sum(t.sum() for t in inputs.values())
    gradients = torch.autograd.grad(total, list(inputs.values()))
    found = {"deviation": deviation.detach()}
    return found | {f"v_{name}": g for name, g in zip(inputs, gradients, strict=True)}


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 2e-5), (torch.float64, 1e-12)])
@pytest.mark.parametrize(
    ("shape", "glass", "size"),
    [((1, 0), 0, (20, 20)), ((1, 1), 0, (16, 20)), ((2, 50), 10, (40, 37)), ((1, 120), 0, (17, 19))],
)
def test_kernel_matches_its_twin(
    random_splats: MakeSplats, dtype: torch.dtype, tolerance: float,
    shape: tuple[int, int], glass: int, size: tuple[int, int],
) -> None:  # fmt: skip
    case = case_of(random_splats(shape, size, dtype=dtype, sigmas=(2.0, 9.0)), size, glass=glass)
    found, expected = with_gradients(case, depth_deviation), with_gradients(case, depth_deviation_twin)
    for name, want in expected.items():
        difference, norm = float((found[name] - want).double().norm()), float(want.double().norm())
        assert difference <= tolerance * max(norm, 1e-3), name


def test_gradients_match_finite_differences(random_splats: MakeSplats) -> None:
    size = (18, 17)
    case = case_of(random_splats((1, 6), size, opacities=(0.3, 0.8), sigmas=(2.0, 6.0), seed=4), size, glass=1)

    cotangent = torch.randn_like(case.depth_map)

    def weighted(means2d: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, depth_map: Tensor) -> Tensor:
        moved = Splats(means2d, conics, opacities, depths, case.splats.radii)
        deviation = depth_deviation(moved, depth_map, case.bins, num_primary=case.num_primary)
        return (deviation * cotangent).sum()

    inputs = [t.detach().clone().requires_grad_() for t in (*case.splats[:4], case.depth_map)]
    assert torch.autograd.gradcheck(weighted, inputs, eps=1e-7, atol=1e-6, rtol=1e-6)


def test_it_is_the_blended_distance(random_splats: MakeSplats) -> None:
    """With a depth map nearer than everything, |z - D| needs no absolute value and `composite` can blend it."""
    size = (40, 30)
    splats = random_splats((1, 60), size)
    bins = bin_tiles(splats, *size)
    blended = composite(splats, splats.depths[..., None], bins)
    nearest = torch.full((1, 30, 40), 0.5, dtype=torch.float64)
    expected = blended.image[..., 0] - 0.5 * blended.alpha
    torch.testing.assert_close(depth_deviation(splats, nearest, bins), expected)


def test_a_surface_at_the_depth_map_deviates_nowhere(random_splats: MakeSplats) -> None:
    splats = random_splats((1, 30), (20, 20))._replace(depths=torch.full((1, 30), 3.0, dtype=torch.float64))
    case = case_of(splats, (20, 20))._replace(depth_map=torch.full((1, 20, 20), 3.0, dtype=torch.float64))
    found = with_gradients(case, depth_deviation)
    assert not any(bool(tensor.any()) for tensor in found.values())


def test_bins_may_have_fewer_active_tiles_than_pairs(random_splats: MakeSplats) -> None:
    size = (60, 40)
    tiles = torch.zeros(1, 3, 4, dtype=torch.bool)
    tiles[0, 1, 1] = tiles[0, 2, 3] = True
    splats = random_splats((1, 80), size, dtype=torch.float32)
    few = case_of(splats, size, tiles=tiles)
    active = torch.nonzero(tiles.flatten()).flatten().to(torch.int32)
    shortened = few._replace(bins=bin_tiles(splats, *size)._replace(active=active))
    expected = with_gradients(few, depth_deviation)
    assert all(torch.equal(t, expected[name]) for name, t in with_gradients(shortened, depth_deviation).items())
    assert expected["deviation"][0, 16:32, 16:32].any()
    assert not expected["deviation"][0, :16].any()


def test_the_number_of_threads_changes_no_bit(random_splats: MakeSplats) -> None:
    size = (100, 70)
    case = case_of(random_splats((2, 200), size, dtype=torch.float32), size, glass=20)
    both = with_gradients(case, depth_deviation)
    numba.set_num_threads(1)
    one = with_gradients(case, depth_deviation)
    assert all(torch.equal(one[name], both[name]) for name in both)


def test_a_map_of_another_size_is_refused(random_splats: MakeSplats) -> None:
    case = case_of(random_splats((1, 5), (20, 20)), (20, 20))
    with pytest.raises(ValueError, match=r"depth_map has shape \[1, 20, 19\], expected \[1, 20, 20\]"):
        depth_deviation(case.splats, case.depth_map[..., 1:], case.bins)
