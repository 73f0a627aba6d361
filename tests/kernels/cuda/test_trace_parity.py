"""The CUDA kernels of `trace` and `build_bvh` against the twin: on a GPU, or on tiny inputs in Numba's simulator.

`test_simulator.py` runs this file once more with the simulator on.
"""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from glassplat.kernels.backend.devices import SIMULATED
from glassplat.kernels.records import RawGaussians, Rays
from glassplat.kernels.trace import build_bvh, shapes_of, trace
from glassplat.kernels.trace import cpu as build_cpu
from glassplat.kernels.trace import cuda as tracer
from glassplat.kernels.trace.reference import trace as twin
from tests.kernels.cuda.agreement import DEVICE, DTYPES, close, many, on_a_device_or_skipped, on_device
from tests.kernels.test_trace import (
    DISCS,
    ELLIPSOIDS,
    bvh_of,
    cloud,
    far_discs,
    one_disc,
    ray,
    rays_around,
    with_gradients,
)

on_a_device_or_skipped()

pytestmark = [pytest.mark.filterwarnings("ignore::RuntimeWarning")]


def check(gaussians: RawGaussians, rays: Rays, degree: int) -> list[Tensor]:
    """Compares the outputs and all gradients with the twin; returns the outputs."""
    found = with_gradients(trace, on_device(gaussians), on_device(rays), degree)
    expected = with_gradients(twin, gaussians, rays, degree)
    for tensor, other in zip(found, expected, strict=True):
        close(tensor, other, 10)
    return expected


@pytest.mark.parametrize("scales", [DISCS, ELLIPSOIDS])
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    ("count", "num_rays", "degree"), [(0, 5, 0), (1, 3, 1), (9, 0, 2), (many(70, 600), many(9, 700), 3)]
)
def test_trace_and_gradients(scales: int, dtype: torch.dtype, count: int, num_rays: int, degree: int) -> None:
    check(cloud(count, scales, dtype=dtype), rays_around(num_rays, dtype=dtype), degree)


@pytest.mark.parametrize("scales", [DISCS, ELLIPSOIDS])
def test_more_hits_than_a_search_returns(scales: int) -> None:
    gaussians = cloud(many(110, 9000), scales, size=0.4 if SIMULATED else -0.7)
    faint = gaussians._replace(logit_opacities=torch.full_like(gaussians.logit_opacities, -4.5))
    expected = check(faint, rays_around(many(3, 60)), 1)
    assert int(expected[3].max()) > 32


@pytest.mark.parametrize("scales", [DISCS, ELLIPSOIDS])
def test_hits_that_are_not_kept_are_found_again(scales: int, monkeypatch: pytest.MonkeyPatch) -> None:
    gaussians = on_device(cloud(many(70, 600), scales, size=-0.5))
    rays = on_device(rays_around(many(9, 700)))
    kept = with_gradients(trace, gaussians, rays, 1)
    few = int(kept[3].median())
    assert int(kept[3].max()) > few > int(kept[3].min())
    monkeypatch.setattr(tracer, "MOST_KEPT", few)
    assert all(torch.equal(a, b) for a, b in zip(kept, with_gradients(trace, gaussians, rays, 1), strict=True))


def test_a_gaussian_hit_by_more_rays_than_a_warp_has_lanes() -> None:
    disc = one_disc(logit_opacities=torch.zeros(1))
    disc = disc._replace(sh=torch.randn(1, 4, 3, generator=torch.Generator().manual_seed(5)).double())
    across = torch.linspace(-0.5, 0.5, 70, dtype=torch.float64)
    origins = torch.stack([across, across.flip(0) * 0.3, torch.zeros_like(across)], dim=1)
    directions = torch.stack([0.1 * across, -0.2 * across, torch.ones_like(across)], dim=1)
    expected = check(disc, Rays(origins, directions), 1)
    assert int(expected[3].sum()) == 70


@pytest.mark.parametrize("scales", [DISCS, ELLIPSOIDS])
def test_gradients_match_finite_differences(scales: int) -> None:
    gaussians, rays = on_device(cloud(many(8, 12), scales, size=-0.5)), on_device(rays_around(many(4, 6)))
    bvh = bvh_of(gaussians)

    def of_leaves(*leaves: Tensor) -> tuple[Tensor, ...]:
        return tuple(trace(RawGaussians(*leaves[:5]), Rays(*leaves[5:]), bvh, sh_degree=3, near=0.0)[:3])

    leaves = [tensor.detach().clone().requires_grad_() for tensor in (*gaussians, *rays)]
    assert int(of_leaves(*leaves)[1].count_nonzero()) >= 2
    assert torch.autograd.gradcheck(of_leaves, leaves, eps=1e-7, atol=1e-5, fast_mode=True)


@pytest.mark.parametrize("which", range(5))
def test_rays_miss_a_gaussian_that_is_not_finite(which: int) -> None:
    gaussians, rays = cloud(20, DISCS), rays_around(4)
    gaussians[which][7] = math.nan
    assert all(bool(x.isfinite().all()) for x in check(gaussians, rays, 1))


def test_an_invalid_ray_hits_nothing() -> None:
    gaussians, rays = cloud(20, DISCS, size=0.0), rays_around(5)
    for r, bad in enumerate([(0.0, 0.0, 0.0), (math.nan, 0.0, 1.0), (math.inf, 0.0, 0.0), (1e200, 1e200, 0.0)]):
        rays.directions[r] = torch.tensor(bad)
    found = with_gradients(trace, on_device(gaussians), on_device(rays), 1)
    assert found[3].tolist()[:4] == [0, 0, 0, 0] and int(found[3][4]) > 0
    assert all(bool(x.isfinite().all()) for x in found)


@pytest.mark.parametrize("changes", [{"log_scales": torch.full((1, 2), -800.0)}, {"quats": torch.zeros(1, 4)}])
def test_rays_miss_a_disc_without_size_or_orientation(changes: dict[str, Tensor]) -> None:
    found = with_gradients(trace, on_device(one_disc(**changes)), on_device(ray((0.1, 0, 0), (0, 0, 1))), 0)
    assert int(found[3]) == 0 and all(bool(x.isfinite().all()) for x in found)


def test_equal_distances_keep_the_order_of_the_gaussians() -> None:
    pile = RawGaussians(*(x.repeat(40, *(1,) * (x.dim() - 1)) for x in one_disc(logit_opacities=torch.tensor([-2.0]))))
    pile.sh[:, 0] = torch.randn(40, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    expected = check(pile, ray((0.1, 0.2, 0.0), (0.0, 0.0, 1.0)), 0)
    assert int(expected[3]) == 40


@pytest.mark.parametrize("scales", [DISCS, ELLIPSOIDS])
def test_the_length_of_a_ray_direction_does_not_matter(scales: int) -> None:
    gaussians, rays = cloud(many(30, 600), scales, dtype=torch.float32), rays_around(many(9, 700), dtype=torch.float32)
    own, expected = on_device(gaussians), twin(gaussians, rays, None, sh_degree=0, near=0.0)
    found = trace(own, on_device(Rays(rays.origins, 2.0**-61 * rays.directions)), bvh_of(own), sh_degree=0, near=0.0)
    assert int(expected.hits.sum()) > 3
    assert torch.equal(found.hits.cpu(), expected.hits)
    close(found.colors, expected.colors)


def test_boxes_far_from_the_origin_lose_no_hit_to_rounding() -> None:
    discs, rays = far_discs(many(40, 400))
    own = on_device(discs)
    found = trace(own, on_device(rays), bvh_of(own), sh_degree=0, near=0.0)
    assert torch.equal(found.hits.cpu(), twin(discs, rays, None, sh_degree=0, near=0.0).hits)


def test_it_traces_to_the_same_bits_every_time() -> None:
    gaussians = on_device(cloud(many(40, 5000), DISCS, dtype=torch.float32, size=-0.5))
    rays = on_device(rays_around(many(8, 5000), dtype=torch.float32))
    first, second = with_gradients(trace, gaussians, rays, 2), with_gradients(trace, gaussians, rays, 2)
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize("scales", [DISCS, ELLIPSOIDS])
@pytest.mark.parametrize("count", [0, 1, 8, 9, many(70, 5000)])
def test_the_hierarchy_is_that_of_the_cpu(scales: int, count: int) -> None:
    gaussians = cloud(count, scales)
    if count > 8:
        gaussians.means[3, 1], gaussians.log_scales[5, 0] = math.nan, math.inf
        gaussians.logit_opacities[6] = -9.0
    shapes = shapes_of(gaussians)
    found = build_bvh(on_device(shapes), flat=scales == DISCS)
    expected = build_cpu.build_bvh(shapes, flat=scales == DISCS)
    assert found.order.device.type == DEVICE.type
    assert torch.equal(found.order.cpu(), expected.order)
    assert torch.equal(found.level_offsets.cpu(), expected.level_offsets)
    torch.testing.assert_close(found.boxes.cpu(), expected.boxes)
