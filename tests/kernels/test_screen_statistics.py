"""The statistics of densification, compared with their twin and with values computed by hand."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from glassplat.kernels.screen_statistics import Sums, Views, add_views
from tests.kernels.threads import assert_threads_change_no_bit


@torch.no_grad()
def add_views_in_torch(sums: Sums, views: Views) -> None:
    """The definition of `add_views`, for checked tensors."""
    visible = (views.radii > 0).all(dim=-1)
    rows = slice(None) if views.direct else slice(0, 1)
    for total, gradient in ((sums.gradient_sum, views.v_means2d), (sums.absgrad_sum, views.v_absgrad)):
        across, down = gradient[..., 0] * (views.width / 2), gradient[..., 1] * (views.height / 2)
        total[rows] += torch.where(visible, torch.hypot(across, down), 0).sum(dim=0)
    sums.view_count[rows] += (views.weight * visible.to(views.radii.dtype)).sum(dim=0)


def no_views(count: int, dtype: torch.dtype = torch.float32) -> Sums:
    return Sums(*torch.zeros(3, 2, count, dtype=dtype))


def some_views(cameras: int, count: int, dtype: torch.dtype = torch.float32, *, weighted: bool, direct: bool) -> Views:
    generator = torch.Generator().manual_seed(0)
    v_means, v_absgrad, radii = torch.randn(3, cameras, count, 2, generator=generator, dtype=torch.float64).to(dtype)
    weight = torch.rand(cameras, count, generator=generator, dtype=torch.float64).to(dtype) if weighted else 0.3
    return Views(v_means, v_absgrad, 9 * radii, 40, 30, weight, direct)


def added(views: Views, dtype: torch.dtype = torch.float32) -> Sums:
    sums = no_views(views.radii.shape[1], dtype)
    add_views(sums, views)
    return sums


def test_visible_views_count_in_device_coordinates() -> None:
    gradient = torch.tensor([[[3.0, 0.0], [0.0, 1.0], [5.0, 5.0]], [[0.0, 1.0], [9.0, 9.0], [5.0, 5.0]]])
    radii = torch.tensor([[[4.0, 2], [1, 1], [0, 0]], [[8, 40], [0, 3], [0, 0]]])
    sums = added(Views(gradient, 2 * gradient, radii, width=400, height=200))
    assert sums.gradient_sum.tolist() == [[3 * 200 + 1 * 100, 100, 0]] * 2
    assert sums.absgrad_sum.tolist() == [[2 * (3 * 200 + 1 * 100), 200, 0]] * 2
    assert sums.view_count.tolist() == [[2, 1, 0]] * 2


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
@pytest.mark.parametrize("direct", [False, True])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize(("cameras", "count"), [(1, 2500), (3, 40), (1, 1), (2, 0)])
def test_agrees_with_the_reference(
    cameras: int, count: int, weighted: bool, direct: bool, dtype: torch.dtype, tolerance: float
) -> None:
    views = some_views(cameras, count, dtype, weighted=weighted, direct=direct)
    found, expected = added(views, dtype), no_views(count, dtype)
    add_views_in_torch(expected, views)
    for _ in range(2):
        for own, wanted in zip(found, expected, strict=True):
            torch.testing.assert_close(own, wanted, rtol=tolerance, atol=tolerance)
        add_views(found, views)
        add_views_in_torch(expected, views)


def test_unseen_gaussians_add_nothing_to_statistics() -> None:
    broken = torch.full((1, 4, 2), torch.nan)
    radii = torch.tensor([[[0.0, 0.0], [0.0, 3.0], [torch.nan, 1.0], [-1.0, 1.0]]])
    sums = added(Views(broken, broken, radii, 40, 30))
    assert not any(total.any() for total in sums)


def test_the_number_of_threads_changes_no_bit() -> None:
    views = some_views(2, 5000, weighted=True, direct=True)
    assert_threads_change_no_bit(lambda: added(views))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"radii": torch.zeros(1, 3, 2)}, ValueError, r"gradient_sum has shape \(2, 4\); expected \(2, 3\)"),
        ({"v_absgrad": torch.zeros(2, 4, 2)}, ValueError, r"v_absgrad has shape \(2, 4, 2\); expected \(1, 4, 2\)"),
        ({"weight": torch.zeros(4)}, ValueError, r"weight has shape \(4,\); expected \(1, 4\)"),
        ({"radii": torch.zeros(1, 4, 2).double()}, TypeError, "radii is torch.float64"),
    ],
)
def test_bad_input_is_refused(change: dict[str, Tensor], error: type[Exception], message: str) -> None:
    views = Views(*torch.zeros(3, 1, 4, 2), 40, 30)._replace(**change)
    with pytest.raises(error, match=message):
        add_views(no_views(4), views)
