"""Heights of uneven glass and their slopes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from scipy.interpolate import BSpline

from glassplat.scene.plane import Planes
from glassplat.scene.uneven import mean_square_slopes, slopes_at, without_tilt


def drawn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def ramp(rows: int, columns: int, down: float, along: float) -> torch.Tensor:
    """Heights [1, R, C] that rise by so much from one value to the next."""
    r, c = (torch.arange(count, dtype=torch.float64) for count in (rows, columns))
    return (down * r[:, None] + along * c[None])[None]


def test_slopes_are_those_of_cubic_splines() -> None:
    heights, places = drawn(1, 5, 7), torch.tensor([[-1.0, -1.0], [-0.3, 0.7], [0.99, 0.2], [1.0, 1.0]]).double()
    slopes = slopes_at(heights, torch.zeros(4, dtype=torch.int64), places)

    def basis(count: int, place: float, order: int) -> torch.Tensor:
        step = 2 / (count - 3)
        knots = -1 + step * (torch.arange(count + 4, dtype=torch.float64) - 3)
        spline = BSpline(knots.numpy(), torch.eye(count, dtype=torch.float64).numpy(), 3)
        return torch.from_numpy(spline(place - 1e-12, nu=order))

    for (x, y), slope in zip(places.tolist(), slopes, strict=True):
        along = basis(5, y, 0) @ heights[0] @ basis(7, x, 1)
        down = basis(5, y, 1) @ heights[0] @ basis(7, x, 0)
        torch.testing.assert_close(slope, torch.stack([along, down]), atol=1e-8, rtol=1e-8)


def test_a_ramp_has_one_slope_all_over_and_the_rim_counts_for_what_is_beyond() -> None:
    places = torch.tensor([[-1.0, 0.3], [0.1, -0.9], [3.0, -7.0]]).double()
    slopes = slopes_at(ramp(6, 9, 0.3, -0.2), torch.zeros(3, dtype=torch.int64), places)
    torch.testing.assert_close(slopes, torch.tensor([[-0.2 * 3, 0.3 * 1.5]]).double().expand(3, 2))


def test_each_place_has_its_own_pane() -> None:
    heights, place = drawn(3, 4, 6), torch.tensor([[0.2, -0.4]]).double()
    together = slopes_at(heights, torch.tensor([2, 0]), place.expand(2, 2))
    for row, pane in enumerate((2, 0)):
        alone = slopes_at(heights[pane : pane + 1], torch.zeros(1, dtype=torch.int64), place)
        assert torch.equal(together[row], alone[0])


def test_gradients_of_slopes_match_finite_differences() -> None:
    heights, places, panes = drawn(2, 4, 5).requires_grad_(), drawn(6, 2, seed=1).tanh(), torch.tensor([0, 1] * 3)
    assert torch.autograd.gradcheck(lambda h: slopes_at(h, panes, places), heights)
    assert torch.autograd.gradcheck(without_tilt, heights)


def test_the_tilt_is_taken_off_and_nothing_else() -> None:
    heights = drawn(1, 6, 8)
    level = without_tilt(heights)
    torch.testing.assert_close(without_tilt(heights + ramp(6, 8, 0.7, -0.4) + 3), level)
    torch.testing.assert_close(without_tilt(level), level)
    assert float(without_tilt(ramp(6, 8, 0.7, -0.4)).abs().max()) < 1e-12


def test_mean_squares_of_slopes() -> None:
    heights, half_sizes = ramp(6, 9, 0.3, -0.2), torch.tensor([[2.0, 0.5]]).double()
    expected = (0.2 * 3 / 2.0) ** 2 + (0.3 * 1.5 / 0.5) ** 2
    torch.testing.assert_close(mean_square_slopes(heights, half_sizes), torch.tensor([expected]).double())


def test_even_and_uneven_panes_join() -> None:
    even, wavy = (Planes.rectangle((0, 0, 0), (0, 0, 1), (1, 1), label=label) for label in (1, 2))
    wavy = replace(wavy, heights=torch.ones(1, 5, 4))
    for both in (even.joined(wavy), wavy.joined(even)):
        assert both.labels == (1, 2) and both.heights is not None
        assert torch.equal(both.heights, torch.stack([torch.zeros(5, 4), torch.ones(5, 4)]))
    assert even.joined(replace(even, labels=(3,))).heights is None


@pytest.mark.parametrize("count", [4, 9])
def test_panes_that_may_wave_are_even_at_first(count: int) -> None:
    planes = Planes.rectangle((0, 0, 0), (0, 0, 1), (1, 1)).that_may_wave(count)
    assert planes.heights is not None and torch.equal(planes.heights, torch.zeros(1, count, count))
    assert planes.that_may_wave(7) is planes
