"""Contributions of Gaussians to views."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from glassplat.render.layers import contributions, window_means, window_sums
from glassplat.render.planar import Planar
from glassplat.render.splat import Splat
from glassplat.scene.panes import Planes
from tests.render.tiny_scene import camera_at, showcase

CAMERA = camera_at(0.0, 0.0, -0.2)


def test_without_panes_they_add_up_to_the_coverage() -> None:
    scene = replace(showcase(), planes=Planes.empty())
    coverage = Splat()(scene, CAMERA).layers["alpha"]
    torch.testing.assert_close(contributions(scene, CAMERA).sum(), coverage.sum())


def test_gaussians_seen_only_in_the_pane_count() -> None:
    scene = showcase()
    direct, with_panes = (contributions(s, CAMERA) for s in (replace(scene, planes=Planes.empty()), scene))
    assert bool((with_panes >= direct).all())
    behind_the_camera = scene.primary.means[:, 2] < -0.2
    assert float(direct[behind_the_camera].max()) == 0 and float(with_panes[behind_the_camera].max()) > 1


def test_gaussians_without_contribution_can_be_removed() -> None:
    scene = showcase()
    means = scene.primary.means.clone()
    means[0] = torch.tensor([50.0, 0.0, 1.0])
    scene = replace(scene, primary=scene.primary.with_tensors({"means": means}))
    busy = contributions(scene, CAMERA) > 0
    assert busy.tolist() == [False] + [True] * (len(means) - 1)
    left = replace(scene, primary=scene.primary.select(busy))
    torch.testing.assert_close(Planar()(left, CAMERA).rgb, Planar()(scene, CAMERA).rgb)


def test_contributions_leave_no_autograd_graph() -> None:
    scene = showcase()
    means = scene.primary.means.requires_grad_()
    found = contributions(replace(scene, primary=scene.primary.with_tensors({"means": means})), CAMERA)
    assert not found.requires_grad and means.grad is None


@pytest.mark.parametrize("reach", [0, 1, 2, 9])
def test_sums_and_means_over_windows_are_those_of_every_pixel_by_itself(reach: int) -> None:
    image, region = torch.rand(6, 8, 2, dtype=torch.float64), torch.rand(6, 8) < 0.6
    for row in range(6):
        for column in range(8):
            window = slice(max(row - reach, 0), row + reach + 1), slice(max(column - reach, 0), column + reach + 1)
            inside = image[window][region[window]]
            torch.testing.assert_close(window_sums(image, reach)[row, column], image[window].sum(dim=(0, 1)))
            expected = inside.sum(dim=0) / max(len(inside), 1)
            torch.testing.assert_close(window_means(image, region, reach)[row, column], expected)
    broken = torch.where(region[..., None], image, torch.nan)
    assert torch.equal(window_means(broken, region, reach), window_means(image, region, reach))
