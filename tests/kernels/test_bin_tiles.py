"""Tiles list every splat that covers one of their pixels, nearest first, and hardly any others."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from torch import Tensor

from glassplat.kernels.project import project
from glassplat.kernels.records import TILE, Splats, TileBins
from glassplat.kernels.tiles import bin_tiles, tile_grid
from glassplat.kernels.tiles.reference import bin_tiles as reference_bin_tiles
from tests.kernels.gaussians_and_cameras import HEIGHT, WIDTH, as_splats, draw, random_cameras, random_gaussians
from tests.kernels.threads import assert_threads_change_no_bit


def projected_splats(count: int, cameras: int, dtype: torch.dtype = torch.float32) -> Splats:
    gaussians, batch = random_gaussians(count, dtype=dtype), random_cameras(cameras, dtype=dtype)
    return as_splats(project(gaussians, batch, sh_degree=0, near=0.2))


def ellipses(centers: Tensor, lengths: Tensor, angles: Tensor, opacities: Tensor, depths: Tensor) -> Splats:
    """Splats of one camera from their standard deviations [G, 2] along axes rotated by an angle; float32."""
    cos, sin = angles.cos(), angles.sin()
    axes = torch.stack([torch.stack([cos, -sin], -1), torch.stack([sin, cos], -1)], -2)
    covariance = axes @ torch.diag_embed(lengths**2) @ axes.mT
    conics = torch.linalg.inv(covariance)
    reach = 2 * torch.log(255 * opacities).clamp(min=0)
    radii = (reach[:, None] * covariance.diagonal(dim1=-2, dim2=-1)).sqrt()
    conics = torch.stack([conics[:, 0, 0], conics[:, 0, 1], conics[:, 1, 1]], -1)
    return Splats(*(tensor[None].float().contiguous() for tensor in (centers, conics, opacities, depths, radii)))


def random_ellipses(count: int, longest: float, shortest: float, seed: int = 0) -> Splats:
    noise = torch.rand(count, 8, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    size = torch.tensor([WIDTH, HEIGHT])
    lengths = torch.stack([longest * noise[:, 0], shortest * (0.5 + noise[:, 1])], -1)
    return ellipses((2 * noise[:, 2:4] - 0.5) * size, lengths, math.pi * noise[:, 4], noise[:, 5], 1 + noise[:, 6])


def lists(bins: TileBins) -> list[list[int]]:
    """Splats of every tile."""
    splats = bins.pair_splats.tolist()
    offsets = bins.tile_offsets.tolist()
    return [splats[begin:end] for begin, end in itertools.pairwise(offsets)]


def assert_consistent(bins: TileBins) -> None:
    """The list per splat is the inverse of the list per tile, slots in ascending order."""
    owners = torch.arange(len(bins.splat_offsets) - 1).repeat_interleave(bins.splat_offsets.diff())
    assert torch.equal(bins.pair_splats.long()[bins.pair_slots.long()], owners)
    assert torch.equal(bins.pair_slots.sort().values, torch.arange(len(owners), dtype=torch.int32))
    assert bins.tile_offsets[-1] == bins.splat_offsets[-1] == len(bins.pair_splats) == len(bins.pair_slots)
    assert [tensor.dtype for tensor in bins[:5]] == [torch.int32, torch.int64, torch.int32, torch.int64, torch.int32]


def assert_hardly_more(ours: TileBins, theirs: TileBins, excess: float) -> None:
    """Every pair of the twin is listed, in the twin's order, plus at most a share `excess` of further pairs."""
    assert_consistent(ours)
    for mine, reference in zip(lists(ours), lists(theirs), strict=True):
        wanted = set(reference)
        assert [splat for splat in mine if splat in wanted] == reference
    assert len(ours.pair_splats) <= (1 + excess) * len(theirs.pair_splats)
    assert len(theirs.pair_splats) > 0
    assert torch.equal(ours.active, theirs.active)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_tiles_of_several_cameras_agree_with_brute_force(dtype: torch.dtype) -> None:
    splats = projected_splats(900, 3, dtype)
    ours, theirs = (f(splats, WIDTH, HEIGHT) for f in (bin_tiles, reference_bin_tiles))
    assert_hardly_more(ours, theirs, excess=0.01)
    assert (ours.width, ours.height, ours.num_cameras) == (WIDTH, HEIGHT, 3)
    assert torch.equal(ours.active, torch.arange(3 * math.prod(tile_grid(WIDTH, HEIGHT)), dtype=torch.int32))


@pytest.mark.parametrize(
    ("longest", "shortest", "excess"),
    [(3.0, 1.0, 0.05), (1000.0, 300.0, 0.0), (60.0, 0.55, 0.05), (2000.0, 0.55, 0.1), (0.6, 0.6, 0.1)],
    ids=["usual", "huge", "thin", "needles", "dots"],
)
def test_ellipses_of_all_shapes(longest: float, shortest: float, excess: float) -> None:
    splats = random_ellipses(400, longest, shortest)
    assert_hardly_more(bin_tiles(splats, WIDTH, HEIGHT), reference_bin_tiles(splats, WIDTH, HEIGHT), excess)


def test_tiles_cover_pixels_at_the_image_border_and_at_the_minimum_coverage() -> None:
    """Opacities around 1/255 give dots that reach at most one pixel centre."""
    opacities = 1 / 255 + 1e-5 * draw(500, seed=3)
    centers = torch.randint(-1, 46, (500, 2), generator=torch.Generator().manual_seed(1)) + 0.5
    splats = ellipses(centers.double(), torch.ones(500, 2).double(), draw(500, seed=4), opacities, torch.ones(500))
    splats = splats._replace(radii=torch.ones(1, 500, 2))
    ours, theirs = (f(splats, WIDTH, HEIGHT) for f in (bin_tiles, reference_bin_tiles))
    assert_hardly_more(ours, theirs, excess=0.1)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (16, 16), (17, 15), (33, 64)])
def test_images_of_any_size(width: int, height: int) -> None:
    splats = random_ellipses(200, 8.0, 2.0)
    assert tile_grid(width, height) == (math.ceil(height / TILE), math.ceil(width / TILE))
    assert_hardly_more(bin_tiles(splats, width, height), reference_bin_tiles(splats, width, height), excess=0.1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_depths_are_ordered_and_ties_keep_their_order(dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(5)
    count = 20_000
    depths = 10.0 ** torch.randint(-4, 5, (2, count), generator=generator).to(dtype)
    depths *= 1 + torch.randint(0, 3, (2, count), generator=generator).to(dtype) * torch.finfo(dtype).eps
    splats = Splats(
        means2d=torch.full((2, count, 2), 8.0, dtype=dtype),
        conics=torch.tensor([1.0, 0.0, 1.0], dtype=dtype).expand(2, count, 3),
        opacities=torch.full((2, count), 0.5, dtype=dtype),
        depths=depths,
        radii=torch.ones(2, count, 2, dtype=dtype) * (torch.rand(2, count, 1, generator=generator) > 0.3),
    )
    for camera, listed in enumerate(lists(bin_tiles(splats, 16, 16))):
        order = depths[camera].argsort(stable=True)
        visible = order[splats.radii[camera, order, 0] > 0]
        assert listed == (visible + camera * count).tolist()


def test_splats_go_to_active_tiles_only() -> None:
    splats = projected_splats(500, 2)
    mask = torch.rand(2, *tile_grid(WIDTH, HEIGHT), generator=torch.Generator().manual_seed(2)) > 0.5
    ours = bin_tiles(splats, WIDTH, HEIGHT, mask)
    everything = lists(bin_tiles(splats, WIDTH, HEIGHT))
    assert ours.active.tolist() == mask.flatten().nonzero()[:, 0].tolist()
    assert_hardly_more(ours, reference_bin_tiles(splats, WIDTH, HEIGHT, mask), excess=0.01)
    assert lists(ours) == [tile if on else [] for tile, on in zip(everything, mask.flatten(), strict=True)]


def test_no_tile_is_active() -> None:
    ours = bin_tiles(
        projected_splats(50, 1), WIDTH, HEIGHT, torch.zeros(1, *tile_grid(WIDTH, HEIGHT), dtype=torch.bool)
    )
    assert_consistent(ours)
    assert len(ours.active) == len(ours.pair_splats) == 0


@pytest.mark.parametrize(("cameras", "count"), [(0, 0), (0, 7), (2, 0), (1, 1)])
def test_few_splats_to_bin(cameras: int, count: int) -> None:
    splats = projected_splats(count, cameras)
    ours = bin_tiles(splats, WIDTH, HEIGHT)
    assert_consistent(ours)
    assert len(ours.tile_offsets) == cameras * math.prod(tile_grid(WIDTH, HEIGHT)) + 1
    assert len(ours.splat_offsets) == cameras * count + 1


def test_splats_that_are_not_finite_are_skipped() -> None:
    splats = random_ellipses(40, 5.0, 2.0)
    expected = lists(bin_tiles(splats, WIDTH, HEIGHT))
    victims = {3: "means2d", 8: "opacities", 20: "radii"}
    for victim, name in victims.items():
        getattr(splats, name)[0, victim] = math.nan
    assert lists(bin_tiles(splats, WIDTH, HEIGHT)) == [[s for s in tile if s not in victims] for tile in expected]


def test_the_same_lists_on_any_number_of_threads() -> None:
    splats = projected_splats(30_000, 2)
    assert_threads_change_no_bit(lambda: bin_tiles(splats, WIDTH, HEIGHT)[:5])
    assert len(bin_tiles(splats, WIDTH, HEIGHT).pair_splats) > 10_000


def test_bad_input_is_refused() -> None:
    splats = projected_splats(4, 2)
    with pytest.raises(ValueError, match="the image is 0 x 5 pixels"):
        bin_tiles(splats, 0, 5)
    with pytest.raises(ValueError, match=r"radii has shape \(2, 3, 2\); expected \(2, 4, 2\)"):
        bin_tiles(splats._replace(radii=splats.radii[:, :3]), WIDTH, HEIGHT)
    with pytest.raises(ValueError, match=r"depths has shape \(8,\); expected \(cameras, splats\)"):
        bin_tiles(splats._replace(depths=splats.depths.flatten()), WIDTH, HEIGHT)
    with pytest.raises(TypeError, match=r"conics is torch\.float64"):
        bin_tiles(splats._replace(conics=splats.conics.double()), WIDTH, HEIGHT)
    with pytest.raises(ValueError, match=r"active_tiles is torch\.bool of shape \(1, 3, 3\); expected bool"):
        bin_tiles(splats, WIDTH, HEIGHT, torch.ones(1, 3, 3, dtype=torch.bool))
