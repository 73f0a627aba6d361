"""Glass Gaussians on panes."""

import math

import pytest
import torch

from glassplat.scene.camera import rotation_from_quat
from glassplat.scene.panes import Planes
from glassplat.scene.scene import glass_gaussians

PLANES = Planes(
    centers=torch.tensor([[1.0, 2.0, 3.0], [0.0, 0.0, -1.0]]),
    raw_normals=torch.tensor([[0.0, 2.0, 2.0], [1.0, 0.2, 0.0]]),
    logit_reflectances=torch.zeros(2),
    tangents=torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.5]]),
    half_sizes=torch.tensor([[2.0, 0.5], [1.0, 1.0]]),
    labels=(1, 2),
)


def test_discs_cover_each_rectangle_without_leaving_it() -> None:
    glass = glass_gaussians(PLANES, count=1000, seed=3)
    assert len(glass) == 2000
    tangents, bitangents = PLANES.axes()
    for index, means in enumerate(glass.means.split(1000)):
        away = means - PLANES.centers[index]
        u, v = away @ tangents[index], away @ bitangents[index]
        half = PLANES.half_sizes[index]
        assert (away @ PLANES.normals[index]).abs().max() < 1e-5
        assert u.abs().max() <= half[0] + 1e-5
        assert v.abs().max() <= half[1] + 1e-5
        cells = torch.stack([(u / half[0] + 1) * 5, (v / half[1] + 1) * 5], dim=1).floor().clamp(0, 9)
        assert len(cells.unique(dim=0)) == 100


def test_discs_lie_flat_in_the_pane() -> None:
    glass = glass_gaussians(PLANES, count=100)
    rotations = rotation_from_quat(glass.quats)
    assert torch.linalg.det(rotations).min() == pytest.approx(1, abs=1e-5)
    thin = rotations[torch.arange(len(glass)), :, glass.log_scales.argmin(dim=1)]
    normals = PLANES.normals.repeat_interleave(len(glass) // 2, dim=0)
    assert (thin * normals).sum(dim=1).abs().min() == pytest.approx(1, abs=1e-5)
    spacing = math.sqrt(4 * 2.0 * 0.5 / 100)
    assert glass.log_scales[0].exp().tolist() == pytest.approx([0.7 * spacing, 0.7 * spacing, 0.035 * spacing])


def test_glass_has_a_mark_but_no_colour() -> None:
    glass = glass_gaussians(PLANES, count=50, opacity=0.3)
    assert glass.sh.shape == (len(glass), 0, 3)
    assert torch.sigmoid(glass.channels["logit_mark"]).tolist() == pytest.approx([0.99] * len(glass))
    assert torch.sigmoid(glass.logit_opacities).tolist() == pytest.approx([0.3] * len(glass))


def test_the_seed_alone_decides_the_places() -> None:
    assert torch.equal(glass_gaussians(PLANES, seed=1).means, glass_gaussians(PLANES, seed=1).means)
    assert not torch.equal(glass_gaussians(PLANES, seed=1).means, glass_gaussians(PLANES, seed=2).means)


def test_no_panes_no_glass() -> None:
    glass = glass_gaussians(Planes.empty())
    assert len(glass) == 0
    assert set(glass.channels) == {"logit_mark"}
