"""Mirror-like surfaces are found, and turned into mirrors that face as their depths indicate."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from glassplat.captures.view import CAMERA_FROM_NORMAL_MAP, NORMALS_FOLDER, View, normals_reader
from glassplat.methods.mirrors import (
    LEAST_NORMAL_LENGTH,
    mirror_lookalikes,
    nearest_neighbours,
    normals_from_views,
    residual_spreads,
    rotate_to_normals,
    turn_into_mirrors,
)
from glassplat.render.layers import contributions
from glassplat.render.splat import Splat
from glassplat.scene import SH_ZERO
from glassplat.scene.camera import Camera, rotation_from_quat
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Environment, Scene
from glassplat.training.densify import as_discs
from glassplat.training.options import MirrorSearch
from tests.training.brightened_views import brightened_views

SIZE, GREY = 96, 0.4
TILT_DEG = 35.0
SEARCH = MirrorSearch()


def slope(*, discs: bool = False) -> Scene:
    """A grey wall of 24 x 24 Gaussians that leans back by `TILT_DEG`, each with a random rotation."""
    generator = torch.Generator().manual_seed(0)
    along = torch.linspace(-1, 1, 24)
    x, y = torch.meshgrid(along, along, indexing="xy")
    z = 4 + math.tan(math.radians(TILT_DEG)) * y
    means = torch.stack([x, y, z], dim=-1).reshape(-1, 3)
    count = len(means)
    gaussians = Gaussians(
        means=means,
        quats=torch.randn(count, 4, generator=generator),
        log_scales=torch.tensor([0.06, 0.06, 0.05]).log().repeat(count, 1),
        logit_opacities=torch.full((count,), 1.0),
        sh=torch.cat([torch.full((count, 1, 3), (GREY - 0.5) / SH_ZERO), torch.full((count, 3, 3), 0.05)], dim=1),
        channels={"logit_strength": torch.full((count,), -7.0)},
        active_sh_degree=1,
    )
    if discs:
        gaussians = as_discs(gaussians)
    return Scene(gaussians, 1.0, environment=Environment(torch.zeros(6, 2, 2, 3)))


def camera() -> Camera:
    return Camera(torch.eye(4), 120.0, 120.0, SIZE / 2, SIZE / 2, SIZE, SIZE)


def views(*left: float) -> list[View]:
    """Photographs of the wall, each with the left half brighter by the given amount."""
    plain = slope()
    with torch.no_grad():
        base = Splat()(replace(plain, primary=replace(plain.primary, active_sh_degree=0)), camera()).rgb
    return brightened_views(base, camera(), GREY, *left)


def normal_axes(gaussians: Gaussians) -> Tensor:
    """[N, 3] the shortest axis of ellipsoids."""
    shortest = gaussians.log_scales.argmin(dim=1)
    return rotation_from_quat(gaussians.quats).gather(2, shortest[:, None, None].expand(-1, 3, 1))[..., 0]


def true_normal() -> Tensor:
    tilt = math.radians(TILT_DEG)
    return torch.tensor([0.0, math.sin(tilt), -math.cos(tilt)])


def inner(scene: Scene) -> Tensor:
    """[N] bool: Gaussians well inside the wall."""
    return scene.primary.means[:, :2].abs().amax(dim=1) < 0.6


def test_view_dependent_surfaces_look_like_a_mirror() -> None:
    scene = slope()
    seen, found = mirror_lookalikes(SEARCH, scene, views(0.2, -0.2, 0.2, -0.2), Splat())
    x = scene.primary.means[:, 0]
    assert bool(seen.all()) and bool(found[x < -0.3].all()) and not bool(found[x > 0.3].any())


def test_a_residual_spreads_by_its_standard_deviation() -> None:
    scene = slope()
    plain = replace(scene, primary=replace(scene.primary, active_sh_degree=0))
    shown, spreads = residual_spreads(plain, views(0.2, -0.1, 0.2, -0.1), Splat())
    left = inner(scene) & (scene.primary.means[:, 0] < -0.2)
    torch.testing.assert_close(spreads[left], torch.full_like(spreads[left], 0.15), rtol=0.1, atol=0)
    torch.testing.assert_close(shown, 4 * residual_spreads(plain, views(0.0), Splat())[0])


def test_view_independent_errors_do_not_look_like_a_mirror() -> None:
    assert not bool(mirror_lookalikes(SEARCH, slope(), views(0.2, 0.2, 0.2), Splat())[1].any())


def test_mirrors_are_found_in_the_region_and_among_visible_gaussians() -> None:
    scene = slope()
    elsewhere = replace(scene, environment=replace(scene.environment, region=(9.0, 0.0, 0.0, 1.0)))
    assert not bool(mirror_lookalikes(SEARCH, elsewhere, views(0.2, -0.2), Splat())[1].any())
    behind = scene.with_parameters({"primary.means": scene.primary.means * torch.tensor([1.0, 1.0, -1.0])})
    seen, found = mirror_lookalikes(SEARCH, behind, views(0.2, -0.2), Splat())
    assert not bool(seen.any()) and not bool(found.any())


@pytest.mark.parametrize("discs", [False, True])
def test_depths_determine_the_side_of_a_surface(discs: bool) -> None:
    scene = slope(discs=discs)
    with torch.no_grad():
        sums = normals_from_views(scene, views(0.0))[inner(scene)]
    # A disc seen edge-on covers no pixel, and some are hidden by others.
    told = sums.norm(dim=1) > LEAST_NORMAL_LENGTH
    normals = normalize(sums[told], dim=1)
    assert float(told.float().mean()) > 0.8
    assert float((normals @ true_normal()).mean()) > math.cos(math.radians(4))


def test_a_surface_counts_by_the_cosine_at_which_it_is_seen() -> None:
    scene = slope()
    with torch.no_grad():
        sums, pixels = normals_from_views(scene, views(0.0)), contributions(scene, camera())
    rays = normalize(scene.primary.means, dim=1)
    chosen = inner(scene) & (pixels > 1)
    expected = (pixels * -(rays @ true_normal()))[chosen]
    torch.testing.assert_close(sums.norm(dim=1)[chosen], expected, rtol=0.05, atol=0)


@pytest.mark.parametrize("estimated", [True, False])
def test_estimated_normals_determine_the_side_before_depths_do(tmp_path: Path, estimated: bool) -> None:
    scene, elsewhere = slope(), torch.tensor([0.6, 0.0, -0.8])
    (tmp_path / NORMALS_FOLDER).mkdir()
    in_picture = (elsewhere * torch.tensor(CAMERA_FROM_NORMAL_MAP)).expand(SIZE, SIZE, 3)
    np.save(tmp_path / NORMALS_FOLDER / "0.npy", in_picture.numpy())
    (view,) = views(0.0)
    view = replace(view, read_normals=normals_reader(tmp_path / NORMALS_FOLDER / "0.npy", view.camera))
    chosen = inner(scene)
    made = turn_into_mirrors(replace(SEARCH, estimated_normals=estimated), scene, [view], chosen).select(chosen)
    expected = elsewhere if estimated else true_normal()
    assert float((normal_axes(made) @ expected).abs().min()) > math.cos(math.radians(8))


def test_a_found_mirror_becomes_flat_and_nothing_else_changes() -> None:
    scene = slope()
    chosen = inner(scene) & (scene.primary.means[:, 0] < 0)
    mirrors = turn_into_mirrors(SEARCH, scene, views(0.0), chosen)
    for name, tensor in mirrors.tensors().items():
        assert torch.equal(tensor[~chosen], scene.primary.tensors()[name][~chosen]), name
    found = mirrors.select(chosen)
    assert float((normal_axes(found) @ true_normal()).abs().min()) > math.cos(math.radians(8))
    assert torch.sigmoid(found.channels["logit_strength"]).tolist() == pytest.approx([0.73] * len(found))
    assert bool((torch.sigmoid(found.logit_opacities) > 0.9 - 1e-6).all())
    assert not bool(found.sh[:, 1:].any()) and torch.equal(found.sh[:, 0], scene.primary.sh[chosen, 0])
    least, middle = found.log_scales.sort(dim=1).values[:, :2].unbind(1)
    assert bool((least <= middle + math.log(0.37) + 1e-6).all())


def test_a_normal_is_turned_on_the_shortest_way() -> None:
    generator = torch.Generator().manual_seed(1)
    gaussians = slope().primary
    wanted = normalize(torch.randn(len(gaussians), 3, generator=generator), dim=1)
    quats, _ = rotate_to_normals(gaussians, wanted, 0.0)
    before, after = rotation_from_quat(gaussians.quats)[..., 2], rotation_from_quat(quats)[..., 2]
    torch.testing.assert_close((after * wanted).sum(1).abs(), torch.ones(len(wanted)), atol=1e-5, rtol=0)
    # The axis rotates no further than the angle between both lines.
    turn = (after * before).sum(1)
    torch.testing.assert_close(turn, (before * wanted).sum(1).abs(), atol=1e-5, rtol=0)


def test_a_normal_that_is_right_or_opposite_stays() -> None:
    gaussians = slope().primary
    now = normal_axes(gaussians)
    for wanted in (now, -now):
        quats, _ = rotate_to_normals(gaussians, wanted, 0.0)
        torch.testing.assert_close(rotation_from_quat(quats), rotation_from_quat(gaussians.quats), atol=1e-5, rtol=0)


def test_discs_are_turned_and_keep_their_size() -> None:
    discs = slope(discs=True).primary
    wanted = true_normal().expand(len(discs), 3)
    quats, log_scales = rotate_to_normals(discs, wanted, -1.0)
    assert torch.equal(log_scales, discs.log_scales)
    cosines = (rotation_from_quat(quats)[..., 2] * wanted).sum(1).abs()
    torch.testing.assert_close(cosines, torch.ones(len(discs)), atol=1e-5, rtol=0)


def test_each_point_is_its_own_first_neighbour() -> None:
    points = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [1.2, 0, 0]])
    assert nearest_neighbours(points, 2).tolist() == [[0, 1], [1, 2], [2, 1]]
    assert nearest_neighbours(points, 9).shape == (3, 3)
    assert nearest_neighbours(points[:0], 4).shape[0] == 0
