"""Points become small spheres of their own colour."""

from __future__ import annotations

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
import torch

from glassplat.captures.capture import RawPoints
from glassplat.captures.view import PointCloud
from glassplat.kernels.project import project
from glassplat.kernels.records import CameraBatch, RawGaussians
from glassplat.scene import SH_ZERO
from glassplat.training.densify import gaussians_from_points


def cloud(count: int, seed: int = 0) -> PointCloud:
    generator = np.random.default_rng(seed)
    return PointCloud.of(
        RawPoints.from_arrays(generator.normal(size=(count, 3)), generator.integers(0, 256, (count, 3)))
    )


def test_every_point_is_one_gaussian_of_its_colour() -> None:
    points = cloud(50)
    gaussians = gaussians_from_points(points)
    assert (len(gaussians), gaussians.sh.shape[1], gaussians.active_sh_degree) == (50, 16, 0)
    colors = (0.5 + SH_ZERO * gaussians.sh[:, 0]) * 255
    found = {tuple(row) for row in torch.cat([gaussians.means, colors.round()], dim=1).tolist()}
    expected = {tuple(row) for row in torch.cat([points.positions, points.colors.float()], dim=1).tolist()}
    assert found == expected
    assert not gaussians.sh[:, 1:].any()
    torch.testing.assert_close(torch.sigmoid(gaussians.logit_opacities), torch.full((50,), 0.1))
    assert set(gaussians.channels) == {"log_intensity"}
    assert not gaussians.channels["log_intensity"].any()
    assert all(tensor.dtype == torch.float32 and tensor.is_contiguous() for tensor in gaussians.tensors().values())


@pytest.mark.parametrize("degree", [0, 3])
def test_black_points_learn_their_colour(degree: int) -> None:
    black = PointCloud.of(RawPoints.from_arrays(np.eye(3) + np.array([0, 0, 4]), np.zeros((3, 3), np.int64)))
    gaussians = gaussians_from_points(black, opacity=0.9)
    raw = RawGaussians(**{name: getattr(gaussians, name) for name in RawGaussians._fields})
    raw.sh.requires_grad_()
    cameras = CameraBatch(torch.eye(4)[None], torch.tensor([[40.0, 40.0, 20.0, 20.0]]), 40, 40)
    project(raw, cameras, sh_degree=degree, near=0.1).colors.sum().backward()
    assert raw.sh.grad is not None
    assert bool((raw.sh.grad[:, 0] > 0).all())


def test_scale_is_the_mean_distance_to_three_neighbours() -> None:
    gaussians = gaussians_from_points(cloud(40))
    distances = torch.cdist(gaussians.means.double(), gaussians.means.double()).sort(dim=1).values
    expected = distances[:, 1:4].mean(dim=1).float()
    torch.testing.assert_close(gaussians.log_scales.exp(), expected[:, None].repeat(1, 3))


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_few_points_have_a_size(count: int) -> None:
    scales = gaussians_from_points(cloud(count)).log_scales.exp()
    assert torch.isfinite(scales).all()
    assert (scales > 0).all()


def test_points_that_coincide_have_a_size() -> None:
    positions = np.repeat([[0.0, 0, 0], [1.0, 0, 0]], 5, axis=0)
    points = PointCloud.of(RawPoints.from_arrays(positions, np.zeros_like(positions)))
    torch.testing.assert_close(gaussians_from_points(points).log_scales.exp(), torch.full((10, 3), 1e-6))


@pytest.mark.parametrize(("degree", "coefficients"), [(0, 1), (1, 4), (2, 9), (3, 16)])
def test_degree_and_opacity_are_taken(degree: int, coefficients: int) -> None:
    gaussians = gaussians_from_points(cloud(5), sh_degree=degree, opacity=0.5)
    assert gaussians.sh.shape == (5, coefficients, 3)
    assert not gaussians.logit_opacities.any()


def interleaved(cell: tuple[int, int, int]) -> int:
    """The Morton code, bit by bit."""
    return sum(((cell[axis] >> bit) & 1) << (3 * bit + axis) for bit in range(21) for axis in range(3))


@hypothesis.given(st.lists(st.tuples(*[st.integers(0, 2**21 - 1)] * 3), min_size=1, max_size=20))
def test_order_follows_the_z_curve(cells: list[tuple[int, int, int]]) -> None:
    corners = [(0, 0, 0), (2**21 - 1,) * 3]  # They extend the bounding box to the whole grid, so that cells are exact.
    cells = corners + cells
    points = PointCloud.of(RawPoints.from_arrays(np.array(cells, np.float64), np.zeros((len(cells), 3))))
    placed = [tuple(map(int, mean)) for mean in gaussians_from_points(points).means.tolist()]
    assert [interleaved(cell) for cell in placed] == sorted(map(interleaved, cells))
    assert sorted(placed) == sorted(cells)


def test_the_spread_is_a_share_of_the_distance() -> None:
    whole, tenth = (gaussians_from_points(cloud(5), spread=spread).log_scales.exp() for spread in (1.0, 0.1))
    torch.testing.assert_close(tenth, 0.1 * whole)


def test_points_that_cannot_be_used() -> None:
    with pytest.raises(ValueError, match="no points"):
        gaussians_from_points(cloud(0))
    broken = cloud(4)
    broken.positions[1, 2] = float("nan")
    broken.positions[3, 0] = float("inf")
    with pytest.raises(ValueError, match="2 of 4 points are not finite"):
        gaussians_from_points(broken)
    for arguments in ({"sh_degree": 4}, {"sh_degree": -1}, {"opacity": 0.0}, {"opacity": 1.0}):
        with pytest.raises(ValueError, match="sh_degree is"):
            gaussians_from_points(cloud(4), **arguments)
    with pytest.raises(ValueError, match="spread is 0"):
        gaussians_from_points(cloud(4), spread=0.0)


def test_point_cloud_checks_itself() -> None:
    with pytest.raises(ValueError, match="shape"):
        PointCloud(torch.zeros(3, 3), torch.zeros(2, 3, dtype=torch.uint8))
    with pytest.raises(TypeError, match="float32 positions and uint8 colors"):
        PointCloud(torch.zeros(3, 3), torch.zeros(3, 3))
