"""Derivatives of an image behind a pane by its layers, compared with finite differences and the twin."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from glassplat.kernels.maths.images import linear_from_srgb, srgb_from_linear
from glassplat.kernels.panes import layer_derivatives, sample_derivatives
from glassplat.kernels.panes.reference import layer_derivatives as reference_layer_derivatives
from tests.kernels.threads import assert_threads_change_no_bit


def grey_layers(height: int = 5, width: int = 7) -> tuple[Tensor, Tensor, Tensor]:
    layers = torch.rand(3, height, width, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    transmission, reflection = (layer[..., None].expand(-1, -1, 3) for layer in layers[:2])
    return 0.5 * layers[2], transmission, reflection


def some_pixels(height: int, width: int) -> Tensor:
    return torch.rand(height, width, generator=torch.Generator().manual_seed(2)) > 0.5


def test_image_derivatives_match_finite_differences() -> None:
    (strength, behind, reflected), step = grey_layers(), 1e-6

    def image(transmission: Tensor, reflection: Tensor) -> Tensor:
        share = strength[..., None]
        return srgb_from_linear((1 - share) * linear_from_srgb(transmission) + share * linear_from_srgb(reflection))

    everywhere = torch.ones(5, 7, dtype=torch.bool)
    through, mirrored = layer_derivatives(strength, behind, reflected, everywhere, linear=True)
    by_behind = (image(behind + step, reflected) - image(behind - step, reflected)) / (2 * step)
    by_reflected = (image(behind, reflected + step) - image(behind, reflected - step)) / (2 * step)
    torch.testing.assert_close(through, by_behind[..., 0], rtol=1e-6, atol=0)
    torch.testing.assert_close(mirrored, by_reflected[..., 0], rtol=1e-6, atol=0)
    assert float(torch.stack([through, mirrored]).amax()) < 1


def test_derivatives_in_srgb_are_the_strength_and_its_complement() -> None:
    (strength, *layers), where = grey_layers(), some_pixels(5, 7)
    through, mirrored = layer_derivatives(strength, *layers, where, linear=False)
    torch.testing.assert_close(through, torch.where(where, 1 - strength, 1.0))
    torch.testing.assert_close(mirrored, torch.where(where, strength, 0.0))


def test_the_derivative_by_the_reflection_falls_with_the_brightness_behind() -> None:
    grey, where = torch.linspace(0.1, 0.9, 9, dtype=torch.float64)[None], torch.ones(1, 9, dtype=torch.bool)
    behind = grey[..., None].expand(-1, -1, 3)
    strength = torch.full_like(grey, 0.1)
    through, mirrored = layer_derivatives(strength, behind, torch.full_like(behind, 0.5), where, linear=True)
    assert bool((mirrored.diff() < 0).all())
    assert bool((through.diff() > 0).all())
    assert mirrored[0, 4] == pytest.approx(0.1)  # Both layers are equally bright.


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 3e-5), (torch.float64, 1e-11)])
@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("size", [(1, 1), (33, 70)])
def test_agrees_with_the_reference(size: tuple[int, int], linear: bool, dtype: torch.dtype, tolerance: float) -> None:
    generator = torch.Generator().manual_seed(0)
    strength = torch.rand(size, generator=generator, dtype=torch.float64).to(dtype)
    layers = [1.3 * torch.rand(*size, 3, generator=generator, dtype=torch.float64).to(dtype) - 0.1 for _ in range(2)]
    where = some_pixels(*size)
    found = layer_derivatives(strength, *layers, where, linear=linear)
    for own, wanted in zip(found, reference_layer_derivatives(strength, *layers, where, linear=linear), strict=True):
        torch.testing.assert_close(own, wanted, rtol=tolerance, atol=tolerance)


def test_excluded_pixels_may_have_any_value() -> None:
    broken = torch.full((4, 6), torch.nan)
    layers = broken[..., None].expand(-1, -1, 3)
    through, mirrored = layer_derivatives(broken, layers, layers, torch.zeros(4, 6, dtype=torch.bool), linear=True)
    assert bool((through == 1).all()) and bool((mirrored == 0).all())


def test_the_number_of_threads_changes_no_bit() -> None:
    layers, where = [layer.float() for layer in grey_layers(90, 70)], some_pixels(90, 70)
    assert_threads_change_no_bit(lambda: layer_derivatives(*layers, where, linear=True))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"reflection": torch.zeros(4, 5, 3)}, ValueError, r"reflection has shape \(4, 5, 3\); expected \(4, 6, 3\)"),
        ({"where": torch.zeros(4, 6)}, TypeError, r"where is torch.float32 of shape \(4, 6\); expected bool"),
    ],
)
def test_bad_input_is_refused(change: dict[str, Tensor], error: type[Exception], message: str) -> None:
    arguments = {"strength": torch.zeros(4, 6), "where": torch.zeros(4, 6, dtype=torch.bool)}
    arguments |= {name: torch.zeros(4, 6, 3) for name in ("transmission", "reflection")}
    with pytest.raises(error, match=message):
        layer_derivatives(**(arguments | change), linear=True)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_derivatives_are_sampled_at_centres_behind_the_surface(dtype: torch.dtype) -> None:
    derivatives = torch.tensor([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]], dtype=dtype)
    near = torch.tensor([[2.0, 2.0, torch.inf], [2.0, 2.0, 2.0]], dtype=dtype)
    nan, inf = torch.nan, torch.inf
    means = [
        (1.9, 0.5),
        (1.9, 1.99),
        (1.9, 0.5),
        (2.5, 0.5),
        (-7.0, 9.0),
        (nan, 1.5),
        (inf, 1.5),
        (-inf, inf),
        (1e30, 0),
    ]
    depths = [3.0, 3.0, 1.0, 3.0, 3.0, 3.0, 3.0, 3.0, 0.0]
    found = sample_derivatives(
        derivatives, near, torch.tensor([means], dtype=dtype), torch.tensor([depths], dtype=dtype)
    )
    expected = [0.2, 0.5, 1.0, 1.0, 0.4, 0.4, 0.6, 0.4, 1.0]  # Clamped to the border; NaN to the first.
    torch.testing.assert_close(found, torch.tensor([expected], dtype=dtype), rtol=0, atol=0)
