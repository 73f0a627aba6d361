"""`pane_hits` and `blend_panes` against their twins."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from glassplat.kernels import Fresnel
from glassplat.kernels.maths.pane import LAWS
from glassplat.kernels.panes import blend_panes, pane_hits
from glassplat.kernels.panes.reference import blend_panes as blend_twin
from glassplat.kernels.panes.reference import pane_hits as hits_twin
from glassplat.kernels.records import BlendedPanes, PaneHits, Panes
from tests.kernels.threads import assert_threads_change_no_bit

WIDTH, HEIGHT = 53, 37
INPUTS = ("transmission", "mask", "reflections", "normals", "base_reflectances")


def random_panes(count: int, dtype: torch.dtype, seed: int = 0) -> tuple[Panes, Tensor]:
    """Rectangles of any tilt around the optical axis, some behind the camera, and intrinsics."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    frames = torch.linalg.qr(draw(count, 3, 3))[0]
    centers = draw(count, 3)
    centers[:, 2] += 2.5
    half_sizes = 0.3 + draw(count, 2).abs()
    intrinsics = torch.tensor([40.0, 42.0, WIDTH / 2 + 0.3, HEIGHT / 2 - 0.4], dtype=torch.float64)
    panes = Panes(centers, frames[:, 0].contiguous(), frames[:, 1:].contiguous(), half_sizes)
    return Panes(*(tensor.to(dtype) for tensor in panes)), intrinsics.to(dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [0, 1, 3, 8])
@pytest.mark.parametrize("masked", [False, True])
def test_hits_match_the_reference(dtype: torch.dtype, count: int, masked: bool) -> None:
    panes, intrinsics = random_panes(count, dtype)
    generator = torch.Generator().manual_seed(1)
    mask = (torch.rand(HEIGHT, WIDTH, generator=generator) > 0.9).to(dtype) if masked else None
    found, expected = (hits(panes, intrinsics, WIDTH, HEIGHT, mask) for hits in (pane_hits, hits_twin))
    assert count == 0 or len(expected.pane.unique()) > min(count, 2)
    agree(found, expected)
    # All panes along the rays, one behind another, until none is left.
    met = []
    while bool((expected.pane >= 0).any()):
        met.append(expected.pane)
        found = pane_hits(panes, intrinsics, WIDTH, HEIGHT, mask, beyond=found)
        expected = hits_twin(panes, intrinsics, WIDTH, HEIGHT, mask, beyond=expected)
        agree(found, expected)
    assert len(met) == {0: 0, 1: 1, 3: 1, 8: 3}[count]


def agree(found: PaneHits, expected: PaneHits) -> None:
    torch.testing.assert_close(found.depth, expected.depth)
    for tensor, twin in zip(found, expected, strict=True):
        assert tensor is found.depth or torch.equal(tensor, twin)


def test_panes_on_a_ray_come_nearest_first_and_each_once() -> None:
    panes, intrinsics = random_panes(8, torch.float32)
    before = pane_hits(panes, intrinsics, WIDTH, HEIGHT)
    after = pane_hits(panes, intrinsics, WIDTH, HEIGHT, beyond=before)
    there = after.pane >= 0
    assert 0.1 < float(there.float().mean()) < 0.9
    assert bool((after.depth > before.depth)[there].all() and (after.pane != before.pane)[there].all())
    assert bool((after.depth[~there] == torch.inf).all())


def test_a_ray_hits_one_of_two_coincident_panes() -> None:
    panes, intrinsics = random_panes(1, torch.float32)
    twice = Panes(*(tensor.repeat(2, *[1] * (tensor.ndim - 1)) for tensor in panes))
    first = pane_hits(twice, intrinsics, WIDTH, HEIGHT)
    assert not bool((pane_hits(twice, intrinsics, WIDTH, HEIGHT, beyond=first).pane >= 0).any())


@pytest.mark.parametrize("seed", range(6))
def test_panes_of_one_plane_that_overlap_are_one_surface(seed: int) -> None:
    """Adjacent panes of a front, whose rectangles are larger than their glass; rounding would separate them."""
    panes, intrinsics = random_panes(1, torch.float32, seed=seed)
    aside = 0.5 * panes.half_sizes[:, :1] * panes.axes[:, 0]
    beside = panes._replace(centers=panes.centers + aside)
    both = Panes(*(torch.cat(pair) for pair in zip(panes, beside, strict=True)))
    first = pane_hits(both, intrinsics, WIDTH, HEIGHT)
    assert first.pane.unique().tolist() == [-1, 0, 1]
    assert not bool((pane_hits(both, intrinsics, WIDTH, HEIGHT, beyond=first).pane >= 0).any())


def test_a_plane_through_the_camera_is_not_hit() -> None:
    panes, intrinsics = random_panes(1, torch.float64)
    edge_on = Panes(
        torch.tensor([[0.0, 0.0, 2.0]], dtype=torch.float64),
        torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64),
        torch.tensor([[[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]], dtype=torch.float64),
        panes.half_sizes,
    )
    assert bool((pane_hits(edge_on, intrinsics, WIDTH, HEIGHT).pane == -1).all())


def blend_case(dtype: torch.dtype, count: int = 3) -> dict[str, Tensor]:
    """Random arguments of `blend_panes`: a tenth of the mask is 0, some colours are dark, some very bright."""
    panes, intrinsics = random_panes(count, dtype)
    generator = torch.Generator().manual_seed(2)

    def draw(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64).to(dtype)

    mask = draw(HEIGHT, WIDTH)
    return {
        "transmission": 1.2 * draw(HEIGHT, WIDTH, 3) ** 3,
        "mask": torch.where(mask < 0.1, 0, mask),
        "reflections": intrinsics.new_tensor([1.2, 1.2, 1.2, 4.0]) * draw(count, HEIGHT, WIDTH, 4) ** 3
        - intrinsics.new_tensor([0, 0, 0, 1]),
        "pane": pane_hits(panes, intrinsics, WIDTH, HEIGHT).pane,
        "normals": panes.normals,
        "base_reflectances": 0.9 * draw(count),
        "intrinsics": intrinsics,
    }


STRENGTH = ("normals", "base_reflectances")
"""Inputs of the strength, except for the mask."""


def with_gradients(case: dict[str, Tensor], function: Callable[..., BlendedPanes], **switches: object) -> list[Tensor]:
    inputs = {name: case[name].detach().requires_grad_() for name in INPUTS}
    result = function(**(case | inputs), **switches)
    generator = torch.Generator().manual_seed(3)
    total = sum(
        (t * torch.randn(t.shape, generator=generator, dtype=torch.float64).to(t.dtype)).sum() for t in result
    ) + 0 * sum(t.sum() for t in inputs.values())
    return [*(t.detach() for t in result), *torch.autograd.grad(total, list(inputs.values()))]


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 2e-5), (torch.float64, 1e-11)])
@pytest.mark.parametrize("fresnel", LAWS)
@pytest.mark.parametrize("intensity", [True, False])
@pytest.mark.parametrize("linear", [True, False])
def test_blend_matches_the_reference(
    dtype: torch.dtype, tolerance: float, fresnel: Fresnel, intensity: bool, linear: bool
) -> None:
    case = blend_case(dtype)
    switches = {"fresnel": fresnel, "intensity": intensity, "linear": linear}
    found, expected = (with_gradients(case, f, **switches) for f in (blend_panes, blend_twin))
    for tensor, twin in zip(found, expected, strict=True):
        torch.testing.assert_close(tensor, twin, rtol=tolerance, atol=tolerance * max(1.0, float(twin.abs().max())))


@pytest.mark.parametrize("name", INPUTS)
@pytest.mark.parametrize("fresnel", LAWS)
def test_blend_gradients_match_finite_differences(name: str, fresnel: Fresnel) -> None:
    case = blend_case(torch.float64)
    if name == "mask":
        case["mask"] = case["mask"].clamp(min=0.05)
    if name in STRENGTH:
        case["reflections"] = case["reflections"].clamp(max=case["reflections"].new_tensor([2.0, 2.0, 2.0, 0.4]))
    values = case[name].requires_grad_()
    directions = [torch.randn(values.shape, generator=torch.Generator().manual_seed(s)).double() for s in (4, 5)]

    def objective(moved: Tensor) -> Tensor:
        return sum(
            (t * torch.cos(torch.arange(t.numel()).reshape(t.shape))).sum()
            for t in blend_panes(**(case | {name: moved}), fresnel=fresnel)
        )

    (gradient,) = torch.autograd.grad(objective(values), values)
    with torch.no_grad():
        for direction in directions:
            slope = (objective(values + 1e-7 * direction) - objective(values - 1e-7 * direction)) / 2e-7
            assert math.isclose(float(slope), float((gradient * direction).sum()), rel_tol=1e-4, abs_tol=1e-4)


@pytest.mark.parametrize("linear", [True, False])
def test_lamp_reflections_are_no_evidence_for_the_strength(linear: bool) -> None:
    case = blend_case(torch.float64)
    case["reflections"][..., :3], case["reflections"][..., 3] = 0.5, 0.0
    case["reflections"][:, :, ::2, 3] = 9.0
    by_strength = {}
    for name in ("all", "dim"):
        leaves = {leaf: case[leaf].detach().requires_grad_() for leaf in (*STRENGTH, "reflections", "mask")}
        rgb = blend_panes(**(case | leaves), linear=linear).rgb
        (rgb if name == "all" else rgb[:, 1::2]).square().sum().backward()
        by_strength[name] = {leaf: leaves[leaf].grad for leaf in leaves}
    for leaf in STRENGTH:
        torch.testing.assert_close(by_strength["all"][leaf], by_strength["dim"][leaf])
        assert bool(by_strength["all"][leaf].any())
    assert bool(by_strength["all"]["reflections"][:, :, ::2].any()) and bool(by_strength["all"]["mask"][:, ::2].any())


@pytest.mark.parametrize("fresnel", ["pane", "none"])
def test_pixels_without_a_pane_equal_the_transmission_bit_for_bit(fresnel: Fresnel) -> None:
    case = blend_case(torch.float32)
    case["base_reflectances"][1] = 0
    result = blend_panes(**case, fresnel=fresnel)
    shown = (case["pane"] >= 0) & (case["mask"] > 0)
    assert bool(shown.any()) and not bool(shown.all())
    plain = ~shown | (case["pane"] == 1)
    assert torch.equal(result.rgb[plain], case["transmission"][plain])
    assert float(result.strength[~shown].abs().max()) == 0 == float(result.reflection[~shown].abs().max())


def test_the_sign_of_a_normal_does_not_matter() -> None:
    case = blend_case(torch.float64)
    for tensor, flipped in zip(blend_panes(**case), blend_panes(**(case | {"normals": -case["normals"]})), strict=True):
        assert torch.equal(tensor, flipped)


def test_threads_do_not_change_a_bit() -> None:
    case = blend_case(torch.float32)
    assert_threads_change_no_bit(lambda: with_gradients(case, blend_panes))


def test_bad_input_is_named() -> None:
    case = blend_case(torch.float32)
    with pytest.raises(ValueError, match="reflections"):
        blend_panes(**(case | {"reflections": case["reflections"][:1]}))
    with pytest.raises(TypeError, match="int32"):
        blend_panes(**(case | {"pane": case["pane"].long()}))
    with pytest.raises(ValueError, match="fresnel is True; expected one of 'pane', 'schlick', 'none'"):
        blend_panes(**case, fresnel=True)  # type: ignore[arg-type]
    panes, intrinsics = random_panes(2, torch.float32)
    with pytest.raises(ValueError, match="mask"):
        pane_hits(panes, intrinsics, WIDTH, HEIGHT, torch.ones(3, 3))
    hits = pane_hits(panes, intrinsics, WIDTH, HEIGHT)
    for wrong in (hits.pane.long(), hits.pane[:3], hits.pane.to("meta")):
        with pytest.raises(TypeError, match=r"beyond\.pane is "):
            pane_hits(panes, intrinsics, WIDTH, HEIGHT, beyond=hits._replace(pane=wrong))
    turned = hits._replace(pane=hits.pane.T.contiguous().T, depth=hits.depth.T.contiguous().T)
    agree(*(pane_hits(panes, intrinsics, WIDTH, HEIGHT, beyond=before) for before in (turned, hits)))
