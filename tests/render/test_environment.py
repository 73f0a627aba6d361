"""Environments as panoramas and back, and turned with the world."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from glassplat.kernels.environment import cube_lookup
from glassplat.render.deferred import (
    environment_from_equirect,
    equirect_from_environment,
    panorama_directions,
    rotated,
    texel_directions,
)
from glassplat.scene.scene import Environment

SIZE = 16


def smooth(size: int = SIZE) -> Environment:
    """An environment whose logits change slowly and differ in every direction."""
    directions = torch.nn.functional.normalize(texel_directions(size), dim=-1)
    mixed = directions @ torch.tensor([[1.0, 0.4, -0.3], [-0.2, 1.1, 0.5], [0.6, -0.1, 0.9]], dtype=torch.float64)
    return Environment((mixed + 0.3 * torch.sin(2 * directions)).float())


def faces_only() -> Environment:
    """Each face in a colour of its own."""
    colors = torch.linspace(-2, 2, 18).reshape(6, 1, 1, 3)
    return Environment(colors.expand(6, 4, 4, 3).contiguous())


def colors_in(environment: Environment, directions: Tensor) -> Tensor:
    return torch.sigmoid(cube_lookup(environment.raw, directions.to(environment.raw)))


def test_texel_directions_are_where_the_lookup_meets_texels() -> None:
    environment = smooth(5)
    found = cube_lookup(environment.raw, texel_directions(5).float())
    torch.testing.assert_close(found, environment.raw)


def test_a_panorama_lies_as_the_conventions_say() -> None:
    directions = panorama_directions(32)
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(32, 64, dtype=torch.float64))
    panorama = equirect_from_environment(faces_only(), 32)
    assert panorama.shape == (32, 64, 3)
    plus_x, minus_x, plus_y, minus_y, plus_z, minus_z = torch.sigmoid(faces_only().raw[:, 0, 0])
    for (row, column), color in {
        (16, 32): plus_x, (16, 0): minus_x, (16, 63): minus_x, (16, 16): plus_y, (16, 48): minus_y,
        (0, 5): plus_z, (0, 40): plus_z, (31, 20): minus_z,
    }.items():  # fmt: skip
        torch.testing.assert_close(panorama[row, column], color)


@pytest.mark.parametrize("height", [8, 32, 50])
def test_a_panorama_leads_back_to_its_environment(height: int) -> None:
    environment = smooth()
    back = environment_from_equirect(equirect_from_environment(environment, height), SIZE)
    difference = torch.sigmoid(back.raw) - torch.sigmoid(environment.raw)
    assert back.size == SIZE
    assert float(difference.abs().max()) < (0.04 if height < 32 else 0.006)


def test_pixels_are_means_of_what_they_cover() -> None:
    generator = torch.Generator().manual_seed(0)
    noise = Environment.random(32, generator=generator, spread=8.0)
    overall = torch.sigmoid(noise.raw).mean()
    small = equirect_from_environment(noise, 2)
    assert float((small - overall).abs().max()) < 0.06
    image = torch.rand(64, 128, 3, generator=generator)
    assert float((torch.sigmoid(environment_from_equirect(image, 1).raw) - 0.5).abs().max()) < 0.06


def test_black_and_white_stay_finite() -> None:
    image = torch.zeros(4, 8, 3)
    image[:, :4] = 1
    raw = environment_from_equirect(image, 4).raw
    assert bool(raw.isfinite().all()) and 6.8 < float(raw.max()) < 7 and -7 < float(raw.min()) < -6.8


@pytest.mark.parametrize("seed", [0, 1])
def test_what_was_in_a_direction_is_in_the_rotated_direction(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=generator))[0]
    directions = torch.randn(500, 3, generator=generator)
    environment = smooth(32)
    turned = rotated(environment, rotation)
    expected = colors_in(environment, directions)
    torch.testing.assert_close(colors_in(turned, directions @ rotation.T), expected, atol=0.005, rtol=0)


def test_quarter_turns_move_texels_as_they_are() -> None:
    environment = Environment.random(5, generator=torch.Generator().manual_seed(1))
    quarter = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turned = rotated(environment, quarter)
    assert not torch.allclose(turned.raw, environment.raw)
    # What +x showed, +y shows now: there columns run along z, and rows along x, which was -y.
    torch.testing.assert_close(turned.raw[2], environment.raw[0].transpose(0, 1).flip(0))
    for _ in range(3):
        turned = rotated(turned, quarter)
    torch.testing.assert_close(turned.raw, environment.raw, atol=1e-4, rtol=0)


def test_the_region_turns_along() -> None:
    quarter = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turned = rotated(Environment(smooth(2).raw, (1.0, 2.0, 3.0, 4.0)), quarter)
    assert turned.region == (-2.0, 1.0, 3.0, 4.0)
    assert rotated(Environment.empty(), quarter).is_empty


def test_a_panorama_has_gradients() -> None:
    environment = smooth(3)
    raw = environment.raw.requires_grad_()
    (gradient,) = torch.autograd.grad(equirect_from_environment(Environment(raw), 8).sum(), raw)
    assert float(gradient.min()) > 0 and math.isfinite(float(gradient.max()))


def test_bad_input_is_named() -> None:
    with pytest.raises(ValueError, match="no environment"):
        equirect_from_environment(Environment.empty(), 8)
    with pytest.raises(ValueError, match="height is 0"):
        equirect_from_environment(smooth(), 0)
    with pytest.raises(ValueError, match=r"shape \(4, 4, 3\); expected \(H, 2 H, 3\)"):
        environment_from_equirect(torch.zeros(4, 4, 3), 4)
    with pytest.raises(ValueError, match="not finite"):
        environment_from_equirect(torch.full((4, 8, 3), torch.nan), 4)
    with pytest.raises(ValueError, match="size is 0"):
        environment_from_equirect(torch.zeros(4, 8, 3), 0)
    with pytest.raises(ValueError, match="rotation matrix"):
        rotated(smooth(), 2 * torch.eye(3))
