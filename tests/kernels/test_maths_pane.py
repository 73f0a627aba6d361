"""The laws of reflection, observed through `blend_panes`: one pixel for each pair of a reflectance and an angle."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from glassplat.kernels import Fresnel
from glassplat.kernels.maths.pane import LAWS
from glassplat.kernels.panes import blend_panes
from glassplat.kernels.panes.reference import two_surfaces

BASES = (1e-6, 1e-4, 1e-2, 0.077, 0.3, 0.7, 0.9, 0.99, 0.999)
COSINES = (1e-4, 1e-3, 0.01, 0.05, 0.2, 0.4, 0.6, 0.8, 0.95, 0.999)


def strengths(bases: Tensor, cosines: Tensor, fresnel: Fresnel = "pane") -> Tensor:
    """Strength [N] of N panes. Each fills a pixel whose ray is the optical axis, and is tilted to the given cosine."""
    count = len(bases)
    rgb = bases.new_zeros(1, count, 3)
    normals = torch.stack([(1 - cosines.detach() ** 2).sqrt(), 0 * cosines, cosines], dim=1)
    intrinsics = bases.new_tensor([1e30, 1e30, 0.0, 0.0])
    pane = torch.arange(count, dtype=torch.int32)[None]
    reflections = bases.new_zeros(count, 1, count, 4)
    blended = blend_panes(rgb, bases.new_ones(1, count), reflections, pane, normals, bases, intrinsics, fresnel=fresnel)
    return blended.strength[0]


def grid(
    bases: tuple[float, ...], cosines: tuple[float, ...], dtype: torch.dtype = torch.float64
) -> tuple[Tensor, ...]:
    """All pairs of a reflectance and a cosine, [N] each."""
    pairs = torch.cartesian_prod(torch.tensor(bases, dtype=dtype), torch.tensor(cosines, dtype=dtype))
    return pairs[:, 0].contiguous(), pairs[:, 1].contiguous()


def reflectance_of_index(index: float) -> float:
    """Reflectance of a pane at normal incidence: both surfaces and the light between them."""
    surface = ((index - 1) / (index + 1)) ** 2
    return 2 * surface / (1 + surface)


def light_that_comes_back(index: float, cosine: float) -> float:
    """Traces a ray through a pane with Snell's law, Fresnel's sine and tangent laws and repeated internal reflections,
    until no light is left.
    """
    outside = math.acos(cosine)
    inside = math.asin(math.sin(outside) / index)
    total = 0.0
    for law in (math.sin, math.tan):
        surface = (law(outside - inside) / law(outside + inside)) ** 2
        total += surface
        within = 1 - surface
        for _ in range(5000):
            within *= surface
            total += within * (1 - surface)
            within *= surface
    return total / 2


@pytest.mark.parametrize("index", [1.01, 1.33, 1.5, 2.4, 10.0])
def test_a_pane_reflects_what_a_ray_loses_on_its_way_through(index: float) -> None:
    cosines = (0.02, 0.1, 0.35, 0.5, 0.65, 0.8, 0.95, 0.999)
    expected = [light_that_comes_back(index, cosine) for cosine in cosines]
    found = strengths(*grid((reflectance_of_index(index),), cosines))
    torch.testing.assert_close(found, torch.tensor(expected, dtype=torch.float64), rtol=1e-9, atol=1e-12)


def test_a_window_pane_reflects_a_thirteenth_head_on() -> None:
    assert reflectance_of_index(1.5) == pytest.approx(0.08 / 1.04)
    base = torch.tensor([0.08 / 1.04], dtype=torch.float64)
    assert float(strengths(base, torch.tensor([0.5], dtype=torch.float64))) == pytest.approx(
        light_that_comes_back(1.5, 0.5)
    )


@pytest.mark.parametrize("fresnel", LAWS)
def test_at_normal_incidence_the_strength_is_the_base_reflectance(fresnel: Fresnel) -> None:
    bases, cosines = grid(BASES, (1.0,))
    torch.testing.assert_close(strengths(bases, cosines, fresnel), bases, rtol=1e-12, atol=0)


@pytest.mark.parametrize("fresnel", ["pane", "schlick"])
def test_glass_reflects_more_the_more_grazing_the_angle_up_to_everything(fresnel: Fresnel) -> None:
    cosines = torch.linspace(1e-5, 1.0, 400, dtype=torch.float64)
    for base in (0.02, 0.077, 0.2):
        found = strengths(torch.full_like(cosines, base), cosines, fresnel)
        assert bool((found.diff() < 0).all())
        assert float(found[0]) > 0.9998


def test_a_pane_reflects_more_than_one_surface_of_its_reflectance() -> None:
    bases, cosines = grid((0.05, 0.077, 0.15), tuple(torch.linspace(0.05, 0.9, 20).tolist()))
    assert bool((strengths(bases, cosines, "pane") > strengths(bases, cosines, "schlick")).all())


def test_schlicks_law_is_that_of_the_paper() -> None:
    bases, cosines = grid(BASES, COSINES)
    expected = bases + (1 - bases) * (1 - cosines) ** 5
    torch.testing.assert_close(strengths(bases, cosines, "schlick"), expected, rtol=1e-12, atol=0)
    assert torch.equal(strengths(bases, cosines, "none"), bases)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("cosine", [0.0, 1e-9, 1e-6, 0.3, 1.0])
def test_glass_that_reflects_nothing_and_perfect_mirrors(cosine: float, dtype: torch.dtype) -> None:
    bases = torch.tensor([0.0, 1.0], dtype=dtype, requires_grad=True)
    cosines = torch.full((2,), cosine, dtype=dtype, requires_grad=True)
    found = strengths(bases, cosines)
    assert float(found[0].detach()) == 0
    torch.testing.assert_close(found[1].detach(), torch.tensor(1.0, dtype=dtype))
    for slope in torch.autograd.grad(found.sum(), [bases, cosines]):
        assert bool(slope.isfinite().all())


@pytest.mark.parametrize(("dtype", "digits"), [(torch.float32, 3e-6), (torch.float64, 1e-9)])
def test_no_digits_are_lost_from_almost_no_reflectance_to_almost_all(dtype: torch.dtype, digits: float) -> None:
    leaves = [tensor.requires_grad_() for tensor in grid(BASES, COSINES, dtype)]
    exact = [leaf.detach().double().requires_grad_() for leaf in leaves]
    found, expected = strengths(*leaves), two_surfaces(*exact)
    torch.testing.assert_close(found.double(), expected, rtol=digits, atol=0)
    slopes, wanted = torch.autograd.grad(found.sum(), leaves), torch.autograd.grad(expected.sum(), exact)
    for slope, want in zip(slopes, wanted, strict=True):
        torch.testing.assert_close(slope.double(), want, rtol=30 * digits, atol=digits)


@pytest.mark.parametrize("fresnel", LAWS)
def test_derivatives_match_finite_differences(fresnel: Fresnel) -> None:
    leaves = [tensor.requires_grad_() for tensor in grid((0.01, 0.077, 0.3, 0.95), (0.1, 0.3, 0.6, 0.9))]
    assert torch.autograd.gradcheck(lambda *pair: strengths(*pair, fresnel), leaves, eps=1e-7, rtol=1e-5)
