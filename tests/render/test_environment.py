"""Conversion of environments to panoramas and back, and rotation with the world."""

from __future__ import annotations

import math

import pytest
import torch

from glassplat.kernels.environment import cube_lookup
from glassplat.render.deferred import (
    environment_from_equirect,
    equirect_from_environment,
    panorama_directions,
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
    """A different colour for each face."""
    colors = torch.linspace(-2, 2, 18).reshape(6, 1, 1, 3)
    return Environment(colors.expand(6, 4, 4, 3).contiguous())


def test_lookups_in_texel_directions_return_texels() -> None:
    environment = smooth(5)
    found = cube_lookup(environment.raw, texel_directions(5).float())
    torch.testing.assert_close(found, environment.raw)


def test_a_panorama_is_oriented_as_the_conventions_say() -> None:
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
def test_a_panorama_converts_back_to_its_environment(height: int) -> None:
    environment = smooth()
    back = environment_from_equirect(equirect_from_environment(environment, height), SIZE)
    difference = torch.sigmoid(back.raw) - torch.sigmoid(environment.raw)
    assert back.size == SIZE
    assert float(difference.abs().max()) < (0.04 if height < 32 else 0.006)


def test_pixels_are_means_of_what_they_cover() -> None:
    generator = torch.Generator().manual_seed(0)
    noise = Environment(1.6 * Environment.random(32, generator=generator).raw)
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
    with pytest.raises(ValueError, match=r"shape \(\); expected"):
        environment_from_equirect(torch.tensor(0.5), 4)
    with pytest.raises(ValueError, match="non-finite"):
        environment_from_equirect(torch.full((4, 8, 3), torch.nan), 4)
    with pytest.raises(ValueError, match="size is 0"):
        environment_from_equirect(torch.zeros(4, 8, 3), 0)
