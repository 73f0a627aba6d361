"""`trace` and `build_bvh`, compared with the twin, which has no hierarchy, and finite differences; bad inputs."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from glassplat.kernels.records import Bvh, RawGaussians, Rays, Traced
from glassplat.kernels.trace import build_bvh, cpu, shapes_of, trace
from glassplat.kernels.trace.bvh import hilbert_codes
from glassplat.kernels.trace.reference import trace as twin
from tests.kernels.threads import assert_threads_change_no_bit

DISCS, ELLIPSOIDS = 2, 3
DTYPES = [(torch.float32, 1e-4), (torch.float64, 1e-11)]


def cloud(count: int, scales: int, *, dtype: torch.dtype = torch.float64, size: float = -2.0) -> RawGaussians:
    """Gaussians around the origin, large and small, faint and opaque."""
    generator = torch.Generator().manual_seed(1)
    shapes = ((count, 3), (count, 4), (count, scales), (count,), (count, 16, 3))
    means, quats, spread, opacities, sh = (torch.randn(s, generator=generator, dtype=torch.float64) for s in shapes)
    return RawGaussians(*(x.to(dtype) for x in (1.5 * means, quats, size + 0.7 * spread, 2 * opacities, 0.6 * sh)))


def rays_around(count: int, *, dtype: torch.dtype = torch.float64) -> Rays:
    """Rays of different lengths from around the cloud towards its centre, some of them starting inside."""
    generator = torch.Generator().manual_seed(2)
    origins, targets = 3 * torch.randn(2, count, 3, generator=generator, dtype=torch.float64)
    lengths = 0.2 + torch.rand(count, 1, generator=generator, dtype=torch.float64)
    return Rays(origins.to(dtype), ((0.2 * targets - origins) * lengths).to(dtype))


def bvh_of(gaussians: RawGaussians) -> Bvh:
    return build_bvh(shapes_of(gaussians), flat=gaussians.log_scales.shape[1] == DISCS)


def traced(gaussians: RawGaussians, rays: Rays, *, sh_degree: int = 3, near: float = 0.0) -> Traced:
    return trace(gaussians, rays, bvh_of(gaussians), sh_degree=sh_degree, near=near)


def with_gradients(function: Callable[..., Traced], gaussians: RawGaussians, rays: Rays, degree: int) -> list[Tensor]:
    """All outputs, and the gradients of a random sum of them."""
    contributions = torch.zeros_like(gaussians.means[:, :2])
    leaves = [tensor.detach().clone().requires_grad_() for tensor in (*gaussians, *rays, contributions)]
    own, own_rays = RawGaussians(*leaves[:5]), Rays(*leaves[5:7])
    found = function(own, own_rays, bvh_of(own), sh_degree=degree, near=0.05, contributions=leaves[7])
    generator = torch.Generator().manual_seed(3)
    weights = [torch.randn(x.shape, generator=generator, dtype=torch.float64).to(x) for x in found[:3]]
    total = torch.stack([(weight * value).sum() for weight, value in zip(weights, found, strict=False)]).sum()
    return [*(x.detach() for x in found), *torch.autograd.grad(total, leaves)]


@pytest.mark.parametrize("scales", [DISCS, ELLIPSOIDS])
@pytest.mark.parametrize(("dtype", "tolerance"), DTYPES)
@pytest.mark.parametrize(
    ("count", "num_rays", "degree"), [(0, 5, 0), (1, 3, 1), (9, 0, 2), (600, 700, 3), (70, 300, 0)]
)
def test_trace_and_gradients_match_the_reference(
    scales: int, dtype: torch.dtype, tolerance: float, count: int, num_rays: int, degree: int
) -> None:
    gaussians, rays = cloud(count, scales, dtype=dtype), rays_around(num_rays, dtype=dtype)
    found, expected = (with_gradients(f, gaussians, rays, degree) for f in (trace, twin))
    assert torch.equal(found[3], expected[3])
    for tensor, other in zip(found, expected, strict=True):
        scale = max(float(other.abs().max()), 1e-3) if other.numel() else 1.0
        torch.testing.assert_close(tensor, other, rtol=0, atol=tolerance * scale)


@pytest.mark.parametrize("scales", [DISCS, ELLIPSOIDS])
def test_hundreds_of_hits_on_a_ray_come_in_order(scales: int) -> None:
    gaussians = cloud(9000, scales, size=-0.7)
    faint = gaussians._replace(logit_opacities=torch.full((9000,), -4.8, dtype=torch.float64))
    rays = rays_around(60)
    found, expected = traced(faint, rays), twin(faint, rays, None, sh_degree=3, near=0.0)
    assert int(expected.hits.max()) > 400
    assert torch.equal(found.hits, expected.hits)
    torch.testing.assert_close(found.colors, expected.colors, rtol=0, atol=1e-12)


@pytest.mark.parametrize("scales", [DISCS, ELLIPSOIDS])
def test_gradients_match_finite_differences(scales: int) -> None:
    gaussians, rays = cloud(12, scales, size=-0.7), rays_around(6)
    bvh = bvh_of(gaussians)

    def of_leaves(*leaves: Tensor) -> tuple[Tensor, ...]:
        return tuple(trace(RawGaussians(*leaves[:5]), Rays(*leaves[5:]), bvh, sh_degree=3, near=0.0)[:3])

    leaves = [tensor.clone().requires_grad_() for tensor in (*gaussians, *rays)]
    assert int(of_leaves(*leaves)[1].count_nonzero()) >= 4
    assert torch.autograd.gradcheck(of_leaves, leaves, eps=1e-7, atol=1e-5, fast_mode=True)


@pytest.mark.parametrize("scales", [DISCS, ELLIPSOIDS])
def test_the_gradient_of_contributions_is_what_gaussians_add_to_rays(scales: int) -> None:
    gaussians, rays = cloud(60, scales, size=-0.7), rays_around(50)
    contributions = torch.zeros(60, 2, dtype=torch.float64, requires_grad=True)
    found = trace(gaussians, rays, bvh_of(gaussians), sh_degree=0, near=0.0, contributions=contributions)
    (met,) = torch.autograd.grad(found.alphas.square().sum(), contributions)
    assert int((met[:, 0] > 0).sum()) > 20 and bool((met[met[:, 0] == 0] == 0).all())
    torch.testing.assert_close(met.sum(dim=0), torch.stack([found.alphas.sum(), found.depths.sum()]))


@pytest.mark.parametrize("scales", [DISCS, ELLIPSOIDS])
def test_hits_that_are_not_kept_are_found_again(scales: int, monkeypatch: pytest.MonkeyPatch) -> None:
    gaussians, rays = cloud(500, scales, size=-0.7), rays_around(80)
    kept = with_gradients(trace, gaussians, rays, 1)
    few = int(kept[3].median())
    assert int(kept[3].max()) > few > int(kept[3].min())
    monkeypatch.setattr(cpu, "MOST_KEPT", few)
    assert all(torch.equal(a, b) for a, b in zip(kept, with_gradients(trace, gaussians, rays, 1), strict=True))


def test_thin_ellipsoids_have_the_gradients_of_float64_in_float32() -> None:
    gaussians, rays = cloud(40, ELLIPSOIDS), rays_around(200)
    # As thin as training leaves them: a millionth of the standard deviation of the other axes.
    thin = gaussians._replace(log_scales=gaussians.log_scales - torch.tensor([14.0, 0.0, 0.0]))
    narrow, narrow_rays = RawGaussians(*(x.float() for x in thin)), Rays(*(x.float() for x in rays))
    found = with_gradients(trace, narrow, narrow_rays, 2)
    exact = RawGaussians(*(x.double() for x in narrow)), Rays(*(x.double() for x in narrow_rays))
    expected = with_gradients(trace, *exact, 2)
    assert torch.equal(found[3], expected[3])
    for tensor, other in zip(found, expected, strict=True):
        assert float((tensor.double() - other).norm()) <= 1e-3 * float(other.double().norm())


@pytest.mark.parametrize("scales", [DISCS, ELLIPSOIDS])
def test_threads_do_not_change_a_bit(scales: int) -> None:
    gaussians, rays = cloud(500, scales, dtype=torch.float32), rays_around(900, dtype=torch.float32)
    assert_threads_change_no_bit(lambda: with_gradients(trace, gaussians, rays, 2))


@pytest.mark.parametrize("scales", [DISCS, ELLIPSOIDS])
@pytest.mark.parametrize("poison", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("which", range(5))
def test_rays_miss_a_gaussian_that_is_not_finite(scales: int, poison: float, which: int) -> None:
    gaussians, rays = cloud(40, scales), rays_around(50)
    others = RawGaussians(*(torch.cat([x[:7], x[8:]]) for x in gaussians))
    bad = RawGaussians(*(x.clone() for x in gaussians))
    bad[which][7] = poison
    found, expected = with_gradients(trace, bad, rays, 3), with_gradients(trace, others, rays, 3)
    assert all(bool(x.isfinite().all()) for x in found)
    for tensor, other in zip(found[:4], expected[:4], strict=True):
        torch.testing.assert_close(tensor, other)


@pytest.mark.parametrize(
    "direction", [(0.0, 0.0, 0.0), (math.nan, 0.0, 1.0), (math.inf, 0.0, 0.0), (1e200, 1e200, 0.0)]
)
def test_an_invalid_ray_hits_nothing(direction: tuple[float, float, float]) -> None:
    gaussians, rays = cloud(40, DISCS, size=0.0), rays_around(3)
    rays.directions[1] = torch.tensor(direction)
    found = with_gradients(trace, gaussians, rays, 1)
    assert int(found[3][1]) == 0 and int(found[3][0]) > 0
    assert all(bool(x.isfinite().all()) for x in found)
    assert bool((found[0][1] == 0).all() and (found[-2][1] == 0).all())


def one_disc(**changes: Tensor) -> RawGaussians:
    """A nearly opaque, white disc of standard deviation 1 in the plane z = 2."""
    values = {
        "means": torch.tensor([[0.0, 0.0, 2.0]]),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        "log_scales": torch.zeros(1, 2),
        "logit_opacities": torch.tensor([20.0]),
        "sh": torch.full((1, 1, 3), 0.5 / 0.28209479177387814),
    } | changes
    return RawGaussians(*(x.double() for x in values.values()))


def ray(origin: tuple[float, ...], direction: tuple[float, ...]) -> Rays:
    return Rays(torch.tensor([origin], dtype=torch.float64), torch.tensor([direction], dtype=torch.float64))


def test_rays_hit_a_disc_in_its_plane() -> None:
    found = traced(one_disc(), ray((1.0, 0.0, 0.0), (0.0, 0.0, 4.0)), sh_degree=0)
    alpha = math.exp(-0.5)
    assert float(found.alphas) == pytest.approx(alpha)
    assert float(found.depths / found.alphas) == pytest.approx(2.0)
    assert found.colors[0].tolist() == pytest.approx([alpha] * 3)


def test_coverage_is_clamped_and_ends_at_three_deviations() -> None:
    inside, outside = (traced(one_disc(), ray((x, 0.0, 0.0), (0.0, 0.0, 1.0)), sh_degree=0) for x in (2.99, 3.01))
    assert float(traced(one_disc(), ray((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), sh_degree=0).alphas) == pytest.approx(0.99)
    assert float(inside.alphas) > 0 and float(outside.alphas) == 0


@pytest.mark.parametrize("origin", [(0.0, 0.0, 2.0), (0.0, 0.0, 3.0)])
def test_rays_hit_nothing_behind_or_at_their_origin(origin: tuple[float, ...]) -> None:
    assert int(traced(one_disc(), ray(origin, (0.0, 0.0, 1.0)), sh_degree=0).hits) == 0


def test_rays_miss_a_disc_seen_edge_on() -> None:
    assert int(traced(one_disc(), ray((-2.0, 0.0, 2.0), (1.0, 0.0, 1e-5)), sh_degree=0).hits) == 0


def test_hits_before_the_near_distance_are_left_out() -> None:
    along = ray((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    assert int(traced(one_disc(), along, sh_degree=0, near=1.9).hits) == 1
    assert int(traced(one_disc(), along, sh_degree=0, near=2.1).hits) == 0


def test_rays_end_at_opaque_gaussians() -> None:
    row = RawGaussians(*(x.repeat(50, *(1,) * (x.dim() - 1)) for x in one_disc()))
    row.means[:, 2] = torch.linspace(1, 5, 50)
    # Each transmits a hundredth of the light: the third would reduce it to less than 1e-4.
    assert int(traced(row, ray((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), sh_degree=0).hits) == 2


def test_equal_distances_keep_the_order_of_the_gaussians() -> None:
    pile = RawGaussians(*(x.repeat(40, *(1,) * (x.dim() - 1)) for x in one_disc(logit_opacities=torch.tensor([-2.0]))))
    pile.sh[:, 0] = torch.randn(40, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    along = ray((0.1, 0.2, 0.0), (0.0, 0.0, 1.0))
    found, expected = traced(pile, along, sh_degree=0), twin(pile, along, None, sh_degree=0, near=0.0)
    assert int(found.hits) == int(expected.hits) == 40
    torch.testing.assert_close(found.colors, expected.colors)


def test_rays_miss_a_disc_of_size_zero() -> None:
    point = one_disc(log_scales=torch.full((1, 2), -800.0))
    found = with_gradients(trace, point, ray((0.1, 0.0, 0.0), (0.0, 0.0, 1.0)), 0)
    assert int(found[3]) == 0 and all(bool(x.isfinite().all()) for x in found)


@pytest.mark.parametrize("count", [1, 8, 9, 64, 65, 1000])
def test_every_gaussian_has_one_place_in_the_hierarchy(count: int) -> None:
    bvh = bvh_of(cloud(count, DISCS))
    assert sorted(bvh.order.tolist()) == list(range(count))
    assert int(bvh.level_offsets[-1]) == len(bvh.boxes)
    top = bvh.boxes[-1]
    full = top[0] <= top[3]
    assert bool((top[:3, full].amin(1) <= cloud(count, DISCS).means.amin(0)).all())


def test_neighbours_on_the_curve_are_neighbours_in_space() -> None:
    grid = torch.cartesian_prod(*[torch.arange(8.0)] * 3)
    along = grid[hilbert_codes(grid).argsort()]
    assert bool((along.diff(dim=0).abs().sum(1) == 1).all())


def test_places_on_the_curve_need_no_extent() -> None:
    points = torch.tensor([[1.0, 2.0, 3.0]]).repeat(4, 1)
    points[2, 1] = math.nan
    assert hilbert_codes(points).argsort(stable=True).tolist() == [0, 1, 3, 2]


def test_moving_rays_and_gaussians_together_changes_nothing() -> None:
    gaussians, rays = cloud(200, DISCS), rays_around(100)
    shift = torch.tensor([3.0, -2.0, 5.0], dtype=torch.float64)
    moved = traced(gaussians._replace(means=gaussians.means + shift), Rays(rays.origins + shift, rays.directions))
    torch.testing.assert_close(moved.colors, traced(gaussians, rays).colors)


@pytest.mark.parametrize(("dtype", "factor"), [(torch.float64, 7.0), (torch.float32, 2.0**-61)])
@pytest.mark.parametrize("scales", [DISCS, ELLIPSOIDS])
def test_the_length_of_a_direction_changes_nothing(scales: int, dtype: torch.dtype, factor: float) -> None:
    gaussians, rays = cloud(200, scales, dtype=dtype), rays_around(100, dtype=dtype)
    other_length = traced(gaussians, Rays(rays.origins, factor * rays.directions))
    for tensor, other in zip(other_length, traced(gaussians, rays), strict=True):
        torch.testing.assert_close(tensor, other)


def far_discs(count: int) -> tuple[RawGaussians, Rays]:
    """Discs far from the world's origin in single precision, and a ray towards each.

    Their boxes round to points. Eight discs share each centre, so that the boxes of their parents are points too.
    """
    generator = torch.Generator().manual_seed(3)
    draws = torch.randn(3, count, 3, generator=generator, dtype=torch.float64)
    means = (torch.tensor([1e4, -1e4, 0.7e4]) + 0.5 * draws[0, : count // 8].repeat_interleave(8, 0)).float()
    origins = (means.double() + torch.nn.functional.normalize(draws[1], dim=1)).float()
    directions = (means.double() + 1e-4 * draws[2] - origins.double()).float()
    quats = torch.randn(count, 4, generator=generator)
    discs = means, quats, torch.full((count, 2), math.log(1e-4)), torch.zeros(count), torch.zeros(count, 1, 3)
    return RawGaussians(*discs), Rays(origins, directions)


def test_boxes_far_from_the_origin_lose_no_hit_to_rounding() -> None:
    discs, rays = far_discs(400)
    found, expected = traced(discs, rays, sh_degree=0), twin(discs, rays, None, sh_degree=0, near=0.0)
    assert int(expected.hits.sum()) > 300
    assert torch.equal(found.hits, expected.hits)


def test_a_hierarchy_of_other_gaussians_is_refused() -> None:
    with pytest.raises(ValueError, match="bvh is over 5 Gaussians and there are 6; build it again"):
        trace(cloud(6, DISCS), rays_around(2), bvh_of(cloud(5, DISCS)), sh_degree=0, near=0.0)


@pytest.mark.parametrize(("degree", "near"), [(4, 0.0), (-1, 0.0), (0, -1.0), (0, math.nan)])
def test_options_out_of_range_are_refused(degree: int, near: float) -> None:
    with pytest.raises(ValueError, match=r"sh_degree is|near is"):
        traced(cloud(3, DISCS), rays_around(2), sh_degree=degree, near=near)
