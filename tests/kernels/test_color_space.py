"""The sRGB curve and its inverse."""

from __future__ import annotations

import torch

from glassplat.kernels.maths.images import linear_from_srgb, srgb_from_linear


def test_the_two_curves_are_inverse_and_increase() -> None:
    values = torch.linspace(-0.2, 1.5, 2000, dtype=torch.float64)
    linear = linear_from_srgb(values)
    torch.testing.assert_close(srgb_from_linear(linear), values, rtol=0, atol=2e-5)
    assert bool((linear.diff() > 0).all())


def test_known_values() -> None:
    known = torch.tensor([0.0, 0.04045, 0.5, 1.0], dtype=torch.float64)
    expected = torch.tensor([0.0, 0.0031308, 0.2140411, 1.0], dtype=torch.float64)
    torch.testing.assert_close(linear_from_srgb(known), expected, rtol=0, atol=1e-6)


def test_gradients_are_finite_everywhere() -> None:
    values = torch.tensor([-0.5, 0.0, 0.001, 0.03, 0.05, 0.3, 2.0], requires_grad=True)
    gradient = torch.autograd.grad(srgb_from_linear(linear_from_srgb(values)).sum(), values)[0]
    torch.testing.assert_close(gradient, torch.ones_like(values), rtol=1e-3, atol=1e-3)
