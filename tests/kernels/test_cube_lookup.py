"""`cube_lookup` against its twin, and the continuity of cube maps across the edges of their faces."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from glassplat.kernels.environment import cube_lookup
from glassplat.kernels.environment.reference import cube_lookup as twin
from tests.kernels.threads import assert_threads_change_no_bit

EDGES = [d for d in itertools.product((-1, 0, 1), repeat=3) if d.count(0) == 1]
CORNERS = list(itertools.product((-1, 1), repeat=3))


def normal(*shape: int, seed: int, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def with_gradients(function: Callable[..., Tensor], texels: Tensor, directions: Tensor) -> list[Tensor]:
    inputs = [tensor.detach().requires_grad_() for tensor in (texels, directions)]
    found = function(*inputs)
    total = (found * normal(*found.shape, seed=9, dtype=found.dtype)).sum()
    return [found.detach(), *torch.autograd.grad(total, inputs)]


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 2e-5), (torch.float64, 1e-12)])
@pytest.mark.parametrize(("size", "depth", "count"), [(1, 3, 200), (2, 1, 200), (7, 3, 2000), (16, 5, 1), (4, 3, 0)])
def test_lookup_matches_the_reference(dtype: torch.dtype, tolerance: float, size: int, depth: int, count: int) -> None:
    texels, directions = normal(6, size, size, depth, seed=1, dtype=dtype), normal(count, 3, seed=2, dtype=dtype)
    found, expected = (with_gradients(f, texels, directions) for f in (cube_lookup, twin))
    for tensor, other in zip(found, expected, strict=True):
        scale = max(1.0, float(other.abs().max())) if other.numel() else 1.0
        torch.testing.assert_close(tensor, other, rtol=tolerance, atol=tolerance * scale)


@pytest.mark.parametrize("size", [1, 2, 5])
def test_gradients_match_finite_differences(size: int) -> None:
    texels, directions = normal(6, size, size, 2, seed=3).requires_grad_(), normal(12, 3, seed=4).requires_grad_()
    assert torch.autograd.gradcheck(cube_lookup, (texels, directions), eps=1e-7, atol=1e-5, fast_mode=True)


@pytest.mark.parametrize("size", [1, 2, 5])
def test_the_map_is_continuous_at_every_edge_and_corner(size: int) -> None:
    texels = normal(6, size, size, 3, seed=5)
    for place in (*EDGES, *CORNERS):
        at = torch.tensor(place, dtype=torch.float64)
        free = (at == 0).double()
        # Along an edge, and at a small step in every direction from each of its points.
        points = at + free * torch.linspace(-0.999, 0.999, 41, dtype=torch.float64)[:, None]
        steps = torch.nn.functional.normalize(normal(30, 1, 3, seed=6), dim=-1)
        here, beside = cube_lookup(texels, points), cube_lookup(texels, points + 1e-9 * steps)
        assert float((beside - here).abs().max()) < 1e-7, place


def test_a_step_changes_the_map_by_no_more_than_its_steepest_slope() -> None:
    texels = normal(6, 4, 4, 1, seed=7)
    directions = torch.nn.functional.normalize(normal(20000, 3, seed=8), dim=-1)
    moved = directions + 1e-6 * normal(20000, 3, seed=9)
    steepest = 4 * float(texels.max() - texels.min()) * 3
    change = (cube_lookup(texels, moved) - cube_lookup(texels, directions)).abs()[:, 0]
    assert bool((change <= steepest * (moved - directions).norm(dim=-1)).all())


def test_three_texels_contribute_equally_at_a_corner() -> None:
    texels = normal(6, 3, 3, 1, seed=10)
    corner = torch.tensor([[1.0, -1.0, 1.0]], dtype=torch.float64)
    # Faces +x (columns y, rows z), -y (columns z, rows x) and +z (columns x, rows y).
    three = torch.stack([texels[0, 2, 0], texels[3, 2, 2], texels[4, 0, 2]])
    torch.testing.assert_close(cube_lookup(texels, corner), three.mean(0)[None])


def test_lookups_at_texel_centres_return_texels() -> None:
    size = 4
    texels = normal(6, size, size, 2, seed=11)
    centers = (2 * torch.arange(size, dtype=torch.float64) + 1) / size - 1
    rows, columns = torch.meshgrid(centers, centers, indexing="ij")
    for face in range(6):
        axis, sign = face // 2, 1 - 2 * (face % 2)
        directions = torch.empty(size, size, 3, dtype=torch.float64)
        directions[..., axis], directions[..., (axis + 1) % 3], directions[..., (axis + 2) % 3] = sign, columns, rows
        torch.testing.assert_close(cube_lookup(texels, directions), texels[face])


def test_a_constant_map_shows_its_constant() -> None:
    texels = torch.tensor([0.25, -3.0, 7.0]).expand(6, 5, 5, 3)
    found = cube_lookup(texels, normal(500, 3, seed=12, dtype=torch.float32))
    torch.testing.assert_close(found, texels[0, 0, :1].expand(500, 3))


def test_a_map_of_directions_returns_the_requested_direction() -> None:
    size = 64
    centers = (2 * torch.arange(size, dtype=torch.float64) + 1) / size - 1
    rows, columns = torch.meshgrid(centers, centers, indexing="ij")
    texels = torch.empty(6, size, size, 3, dtype=torch.float64)
    for face in range(6):
        axis, sign = face // 2, 1 - 2 * (face % 2)
        texels[face, ..., axis], texels[face, ..., (axis + 1) % 3], texels[face, ..., (axis + 2) % 3] = (
            sign,
            columns,
            rows,
        )
    texels = torch.nn.functional.normalize(texels, dim=-1)
    directions = torch.nn.functional.normalize(normal(5000, 3, seed=13), dim=-1)
    assert float((cube_lookup(texels, directions) - directions).norm(dim=-1).max()) < 0.01


def test_the_length_of_a_direction_has_no_effect() -> None:
    texels, directions = normal(6, 5, 5, 3, seed=14), normal(10, 20, 3, seed=15).requires_grad_()
    found = cube_lookup(texels, directions)
    assert found.shape == (10, 20, 3)
    torch.testing.assert_close(cube_lookup(texels, 1e-6 * directions), found)
    (gradient,) = torch.autograd.grad((found * normal(10, 20, 3, seed=16)).sum(), directions)
    assert float((gradient * directions).sum(-1).detach().abs().max()) < 1e-11


@pytest.mark.parametrize("bad", [[0.0, 0.0, 0.0], [float("nan"), 1.0, 0.0], [float("inf"), float("inf"), 0.0]])
def test_a_zero_direction_gives_nan_and_does_not_affect_others(bad: list[float]) -> None:
    texels = normal(6, 3, 3, 2, seed=17)
    directions = torch.cat([torch.tensor([bad], dtype=torch.float64), normal(3, 3, seed=18)])
    for function in (cube_lookup, twin):
        found = function(texels, directions)
        assert bool(found[0].isnan().all()) and bool(found[1:].isfinite().all())
    with_gradients(cube_lookup, texels, directions)


def test_threads_do_not_change_a_bit() -> None:
    texels, directions = normal(6, 9, 9, 3, seed=19).float(), normal(5000, 3, seed=20).float()
    assert_threads_change_no_bit(lambda: with_gradients(cube_lookup, texels, directions))


def test_bad_input_is_named() -> None:
    for shape in ((6, 2, 3, 3), (5, 2, 2, 3), (6, 0, 0, 3), (6, 2, 2)):
        with pytest.raises(ValueError, match="six square faces"):
            cube_lookup(torch.zeros(shape), torch.zeros(4, 3))
    with pytest.raises(ValueError, match="directions has shape"):
        cube_lookup(torch.zeros(6, 2, 2, 3), torch.zeros(4, 2))
    with pytest.raises(TypeError, match=r"directions is torch\.float64 and texels is torch\.float32"):
        cube_lookup(torch.zeros(6, 2, 2, 3), torch.zeros(4, 3).double())
