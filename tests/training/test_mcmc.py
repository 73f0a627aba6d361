"""Relocation, growth and noise of the MCMC strategy."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from glassplat.scene.camera import rotation_from_quat
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene
from glassplat.training.actions import AddNoise
from glassplat.training.densify import (
    MOST_COPIES,
    rank_among_equals,
    relocate,
    relocate_and_grow,
    sgld_noise,
    shared_contribution,
)
from glassplat.training.options import FASTEST_ITERATIONS, PUBLISHED_ITERATIONS, McmcDensify, Rate
from glassplat.training.stage import Clock, TrainState

OPTIONS = McmcDensify()


def make_gaussians(opacities: list[float], seed: int = 0) -> Gaussians:
    count = len(opacities)
    rng = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.arange(3.0 * count).reshape(count, 3),
        quats=torch.randn(count, 4, generator=rng),
        log_scales=torch.randn(count, 3, generator=rng) - 2,
        logit_opacities=torch.logit(torch.tensor(opacities)),
        sh=torch.randn(count, 4, 3, generator=rng),
        channels={"log_intensity": torch.randn(count, generator=rng)},
    )


def make_moments(gaussians: Gaussians) -> dict[str, tuple[Tensor, Tensor]]:
    return {f"primary.{name}": (t + 10, t.square() + 20) for name, t in gaussians.tensors().items()}


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def composited(opacities: Tensor, sigma: float, line: Tensor) -> Tensor:
    """Alpha [X] along a line of Gaussians at one position, blended one behind the other."""
    transmittance = torch.ones_like(line)
    for opacity in opacities:
        transmittance = transmittance * (1 - opacity * torch.exp(-0.5 * (line / sigma) ** 2))
    return 1 - transmittance


@pytest.mark.parametrize("copies", [1, 2, 3, 10, MOST_COPIES])
@pytest.mark.parametrize("opacity", [0.006, 0.3, 0.9, 0.9999])
def test_copies_render_like_the_one_they_replace(copies: int, opacity: float) -> None:
    line = torch.linspace(-30, 30, 60_001, dtype=torch.float64)
    logit = torch.logit(torch.tensor([opacity], dtype=torch.float64))
    raw, shrink = shared_contribution(logit, torch.tensor([copies]))
    shared = composited(torch.sigmoid(raw).repeat(copies), math.exp(shrink.item()), line)
    single = composited(torch.tensor([opacity], dtype=torch.float64), 1.0, line)
    assert shared.max().item() == pytest.approx(opacity, rel=1e-9)
    assert torch.trapezoid(shared, line).item() == pytest.approx(torch.trapezoid(single, line).item(), rel=1e-6)


def test_one_copy_changes_nothing() -> None:
    logits = torch.linspace(-8, 8, 50, dtype=torch.float64)
    raw, shrink = shared_contribution(logits, torch.ones(50, dtype=torch.int64))
    assert torch.allclose(raw, logits, atol=1e-9)
    assert torch.allclose(shrink, torch.zeros(50, dtype=torch.float64), atol=1e-9)


def test_extreme_opacities_stay_finite() -> None:
    logits = torch.tensor([-80.0, -20.0, 17.0, 60.0, math.inf])
    for copies in (2, MOST_COPIES):
        raw, shrink = shared_contribution(logits, torch.full((5,), copies))
        assert torch.isfinite(raw).all() and torch.isfinite(shrink).all()
        assert (shrink <= 1e-6).all()


def test_dead_gaussians_are_relocated_to_live_ones_and_share_their_opacity() -> None:
    before = make_gaussians([0.9, 0.001, 0.4, 0.005, 0.002, 0.6])
    after, _ = relocate_and_grow(OPTIONS, before, {}, cap=0, generator=rng())
    live = [0, 2, 5]
    assert len(after) == len(before)
    assert torch.equal(after.means[live], before.means[live])
    transparency = dict.fromkeys(live, 1.0)
    for row in range(len(after)):
        (place,) = [k for k in live if torch.equal(after.means[row], before.means[k])]
        assert torch.equal(after.sh[row], before.sh[place])
        transparency[place] *= 1 - torch.sigmoid(after.logit_opacities[row]).item()
    for place, left in transparency.items():
        assert 1 - left == pytest.approx(torch.sigmoid(before.logit_opacities[place]).item(), rel=1e-5)


def test_live_ones_are_drawn_in_proportion_to_their_opacity() -> None:
    opacities = [0.8, 0.2] * 100 + [0.001] * 1000
    edit = relocate(make_gaussians(opacities), rng())
    moved = edit.source[200:]
    assert (moved < 200).all()
    assert (moved % 2 == 0).float().mean().item() == pytest.approx(0.8, abs=0.04)


def test_moments_start_again_where_values_changed() -> None:
    before = make_gaussians([0.9, 0.001] + [0.006] * 4)
    after, moments = relocate_and_grow(OPTIONS, before, make_moments(before), cap=0, generator=rng())
    changed = after.logit_opacities != before.logit_opacities
    assert changed.sum() == 2
    for name, tensor in before.tensors().items():
        first, second = moments[f"primary.{name}"]
        assert not first[changed].any() and not second[changed].any()
        assert torch.equal(first[~changed], tensor[~changed] + 10)


@pytest.mark.parametrize(("cap", "expected"), [(1000, 105), (103, 103), (100, 100), (50, 100)])
def test_growth_is_a_twentieth_up_to_the_cap(cap: int, expected: int) -> None:
    before = make_gaussians([0.5] * 100)
    after, moments = relocate_and_grow(OPTIONS, before, make_moments(before), cap=cap, generator=rng())
    assert len(after) == expected
    new = moments["primary.means"][0][100:]
    assert new.shape == (expected - 100, 3) and not new.any()
    assert all((after.means[row] == before.means).all(dim=1).any() for row in range(100, expected))


def test_relocations_per_gaussian_are_limited_to_the_exact_sum() -> None:
    before = make_gaussians([0.8] + [0.001] * 200)
    after, _ = relocate_and_grow(OPTIONS, before, {}, cap=0, generator=rng())
    together = (after.means == before.means[0]).all(dim=1)
    assert together.sum() == MOST_COPIES
    opacities = torch.sigmoid(after.logit_opacities[together].double())
    assert 1 - (1 - opacities).prod().item() == pytest.approx(0.8, rel=1e-5)
    assert torch.equal(after.logit_opacities[~together], before.logit_opacities[~together])


@pytest.mark.parametrize("opacities", [[], [0.001], [0.001, 0.002, 0.004]], ids=["none", "one dead", "all dead"])
def test_relocation_without_live_gaussians_does_nothing(opacities: list[float]) -> None:
    before = make_gaussians(opacities)
    after, moments = relocate_and_grow(OPTIONS, before, make_moments(before), cap=100, generator=rng())
    for name, tensor in before.tensors().items():
        assert torch.equal(after.tensors()[name], tensor)
        assert torch.equal(moments[f"primary.{name}"][0], tensor + 10)
    assert sgld_noise(OPTIONS, before, rate=1e-4, extent=1.0, generator=rng()).shape == before.means.shape


def test_a_single_live_gaussian_is_duplicated() -> None:
    before = make_gaussians([0.75])
    after, _ = relocate_and_grow(OPTIONS, before, {}, cap=100, generator=rng())
    assert torch.sigmoid(after.logit_opacities).tolist() == pytest.approx([0.5, 0.5])
    # Along a line G has the integral sigma and G^2 sigma / sqrt(2): 0.75 sigma = (2 * 0.5 - 0.25 / sqrt(2)) sigma'.
    smaller = before.log_scales + math.log(0.75 / (1 - 0.25 / math.sqrt(2)))
    torch.testing.assert_close(after.log_scales, smaller.repeat(2, 1))


def test_growth_puts_no_more_into_one_place_than_the_sum_is_exact_for() -> None:
    before = make_gaussians([0.95] + [0.0051] * 100)
    after, _ = relocate_and_grow(McmcDensify(growth=2.0), before, {}, cap=1000, generator=rng())
    assert (after.means == before.means[0]).all(dim=1).sum() == MOST_COPIES and len(after) > 120


def test_the_same_seed_gives_the_same_set_and_another_seed_another() -> None:
    before = make_gaussians([0.9, 0.001, 0.5, 0.3, 0.002] * 20)
    sets = [relocate_and_grow(OPTIONS, before, {}, cap=1000, generator=rng(seed))[0] for seed in (3, 3, 4)]
    assert all(torch.equal(t, sets[1].tensors()[name]) for name, t in sets[0].tensors().items())
    assert not torch.equal(sets[0].means, sets[2].means)
    noises = [sgld_noise(OPTIONS, before, rate=1e-4, extent=1.0, generator=rng(seed)) for seed in (3, 3, 4)]
    assert torch.equal(noises[0], noises[1]) and not torch.equal(noises[0], noises[2])


def test_noise_moves_only_transparent_gaussians() -> None:
    gaussians = make_gaussians([0.99, 0.005, 0.5])
    noise = sgld_noise(OPTIONS, gaussians, rate=1.6e-4, extent=1.0, generator=rng())
    assert torch.equal(gaussians.means[0] + noise[0], gaussians.means[0])
    assert noise[1].norm() > 1e-3
    assert noise[2].norm() < 1e-15


def test_noise_is_shaped_by_the_covariance() -> None:
    count = 40_000
    one = make_gaussians([0.005])
    noise = sgld_noise(
        OPTIONS, one.select(torch.zeros(count, dtype=torch.int64)), rate=1e-3, extent=2.0, generator=rng()
    )
    rotation = rotation_from_quat(one.quats[0])
    covariance = rotation @ torch.diag((2 * one.log_scales[0]).exp()) @ rotation.T
    expected = (5e5 * 1e-3 * 0.5 / 2.0 * covariance) @ (5e5 * 1e-3 * 0.5 / 2.0 * covariance).T
    assert torch.allclose(torch.cov(noise.T), expected, rtol=0.1, atol=0.03 * expected.abs().max().item())


def test_noise_does_not_depend_on_the_units_of_the_capture() -> None:
    metres = make_gaussians([0.004] * 5)
    millimetres = metres.with_tensors({"log_scales": metres.log_scales + math.log(1000)})
    small = sgld_noise(OPTIONS, metres, rate=1e-4, extent=3.0, generator=rng())
    large = sgld_noise(OPTIONS, millimetres, rate=1e-4, extent=3000.0, generator=rng())
    assert torch.allclose(large, 1000 * small, rtol=1e-4)


def test_published_noise_is_in_world_units() -> None:
    gaussians, extent, rate = make_gaussians([0.005] * 5), 6.6, 1.6e-4
    published = sgld_noise(McmcDensify.published(), gaussians, rate=rate, extent=extent, generator=rng())
    eta = torch.randn(gaussians.means.shape, generator=rng(), dtype=gaussians.means.dtype)
    rotations = rotation_from_quat(gaussians.quats)
    covariances = rotations @ torch.diag_embed((2 * gaussians.log_scales).exp()) @ rotations.transpose(1, 2)
    expected = 5e5 * (rate * extent) * 0.5 * (covariances @ eta[..., None]).squeeze(-1)
    torch.testing.assert_close(published, expected, rtol=1e-3, atol=1e-6)


def test_a_step_of_training_adds_noise_in_the_same_units() -> None:
    gaussians, extent = make_gaussians([0.005] * 5), 3.0
    state = TrainState(Scene(gaussians, extent), seed=4)
    AddNoise(McmcDensify.published(), Rate(1.6e-4, per_extent=True))(state, Clock(0, 10, 1), None)
    rate = 1.6e-4 * (PUBLISHED_ITERATIONS / FASTEST_ITERATIONS) ** Rate(1.0).short_run_power
    generator = TrainState(Scene(gaussians, extent), seed=4).generator("explore")
    expected = sgld_noise(McmcDensify.published(), gaussians, rate=rate, extent=extent, generator=generator)
    torch.testing.assert_close(state.scene.primary.means - gaussians.means, expected, rtol=1e-3, atol=1e-6)


def test_ranks_count_earlier_equals() -> None:
    assert rank_among_equals(torch.tensor([4, 7, 4, 4, 7, 1])).tolist() == [0, 0, 1, 2, 1, 0]
    assert rank_among_equals(torch.zeros(0, dtype=torch.int64)).shape == (0,)


def test_noise_leaves_discs_in_their_plane() -> None:
    solid = make_gaussians([0.01] * 40)
    discs = Gaussians(**{**vars(solid), "log_scales": solid.log_scales[:, :2].contiguous()})
    offsets = sgld_noise(McmcDensify(), discs, rate=1.0, extent=1.0, generator=torch.Generator().manual_seed(0))
    normals = rotation_from_quat(discs.quats)[:, :, 2]
    assert float((offsets * normals).sum(1).abs().max()) < 1e-4 * float(offsets.norm(dim=1).max())
