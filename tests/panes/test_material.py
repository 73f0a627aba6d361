"""Mirrors are distinguished from glass by how the photographs depend on the mirrored scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from glassplat.captures.view import View
from glassplat.panes.material import (
    FEWEST_PIXELS,
    LEAST_SHARE,
    MEAN_WINDOW,
    MIRROR_CORRELATION,
    REDUCED_WIDTH,
    MirrorRegression,
    degrees_between,
    mirror_candidate,
    reduced_photograph,
    reduced_photographs,
    regress_on_mirrored,
    subtract_local_mean,
)
from glassplat.render.layers import window_sums
from glassplat.render.planar import Planar
from glassplat.scene.corrections import Exposures
from glassplat.scene.scene import Scene, glass_gaussians
from tests.render.tiny_scene import camera_at, in_single_precision, pane, showcase, shown_panes


def scene_with(base_reflectance: float) -> Scene:
    scene = in_single_precision(showcase(pane(2.0, half=0.8, base_reflectance=base_reflectance)))
    solid = scene.primary.with_tensors(
        {
            "logit_opacities": torch.full((len(scene.primary),), 5.0),
            "log_scales": scene.primary.log_scales + 1.2,
        }
    )
    return replace(scene, glass=glass_gaussians(scene.planes, opacity=0.99), primary=solid)


def photographs(scene: Scene) -> list[View]:
    views = []
    for x in (-0.4, 0.0, 0.4):
        camera = camera_at(x, 0.0, -0.3)
        camera = replace(camera, cam_from_world=camera.cam_from_world.float())
        with torch.no_grad():
            photo = (255 * Planar()(scene, camera).rgb.clamp(0, 1)).to(torch.uint8)
        labels = shown_panes(scene.planes, camera)[0].to(torch.uint8)
        views.append(View.in_memory(f"{x}", camera, photo=photo, pane_labels=labels))
    return views


def mirror_labels(scene: Scene, views: Sequence[View]) -> tuple[int, ...]:
    """Labels of the panes that are found to be mirrors."""
    photographed = reduced_photographs(scene, views)
    judged = {label: mirror_candidate(scene, label, photographed) for label in scene.planes.labels}
    return tuple(label for label, found in judged.items() if found.is_mirror)


@pytest.mark.parametrize(("base_reflectance", "expected"), [(0.995, (1,)), (0.08, ())])
def test_a_mirror_is_found_and_glass_is_not(base_reflectance: float, expected: tuple[int, ...]) -> None:
    views = photographs(scene_with(base_reflectance))
    unknown = scene_with(0.2)
    assert mirror_labels(unknown, views) == expected


def test_glass_in_front_of_darkness_is_no_mirror() -> None:
    # sRGB is steep in the dark: an eighth of the light looks like four tenths of the brightness.
    scene = scene_with(0.15)
    before = scene.primary.means[:, 2] < scene.planes.centers[0, 2]
    dark = replace(scene, primary=scene.primary.select(before))
    views = photographs(dark)
    found = mirror_candidate(dark, 1, reduced_photographs(dark, views))
    assert found.regression.correlation > MIRROR_CORRELATION
    assert found.regression.slope == pytest.approx(0.15, abs=0.05)
    assert not found.is_mirror


def test_an_exposure_does_not_turn_a_mirror_into_glass() -> None:
    """Photographed at 0.3 of its brightness, a mirror has the slope of glass."""
    affine = torch.zeros(3, 3, 4)
    affine[:, :, :3] = -0.7 * torch.eye(3)
    views = photographs(scene_with(0.995))
    exposures = Exposures(affine, tuple(view.name for view in views))
    dark = [
        View.in_memory(v.name, v.camera, photo=(exposures.apply(v.photo.float(), v.name)).to(torch.uint8),
                       pane_labels=v.pane_labels)
        for v in views
    ]  # fmt: skip
    assert mirror_labels(scene_with(0.2), dark) == ()
    assert mirror_labels(replace(scene_with(0.2), exposures=exposures), dark) == (1,)


def test_a_pane_with_little_evidence_stays_glass() -> None:
    """A glass front may reflect objects that no photograph shows; some spots may agree with the scene by chance."""
    scene = scene_with(0.2)
    found = mirror_candidate(scene, 1, reduced_photographs(scene, photographs(scene_with(0.995))))
    assert found.is_mirror and FEWEST_PIXELS <= found.compared <= found.shown
    assert not found._replace(shown=round(1.05 * found.compared / LEAST_SHARE)).is_mirror
    assert not found._replace(compared=FEWEST_PIXELS - 1).is_mirror


def test_a_mirror_is_found_and_put_right_where_its_fitted_plane_is_tilted() -> None:
    """A plane tilted by two degrees mirrors objects four degrees away from those in the photograph."""
    true, unknown = scene_with(0.995), scene_with(0.2)
    tilt = torch.tensor([[math.tan(math.radians(2.0)), 0.0, 0.0]])
    tilted = replace(unknown, planes=replace(unknown.planes, raw_normals=unknown.planes.normals + tilt))
    before = degrees_between(tilted.planes.normals[0], true.planes.normals[0])
    found = mirror_candidate(tilted, 1, reduced_photographs(tilted, photographs(true)))
    assert before == pytest.approx(2.0, abs=0.01)
    assert found.is_mirror
    assert degrees_between(found.pane.normals[0], true.planes.normals[0]) < 0.2
    torch.testing.assert_close(found.pane.half_sizes, tilted.planes.half_sizes)


def test_a_mirror_stays_where_its_fitted_plane_is_right() -> None:
    """Aligning moves even a true plane slightly, for hardly any gain."""
    unknown = scene_with(0.2)
    found = mirror_candidate(unknown, 1, reduced_photographs(unknown, photographs(scene_with(0.995))))
    assert found.is_mirror
    assert torch.equal(found.pane.centers, unknown.planes.centers)
    torch.testing.assert_close(found.pane.normals, unknown.planes.normals)


def test_photographs_are_reduced_with_all_that_belongs_to_them() -> None:
    scene = scene_with(0.2)
    camera = replace(camera_at(0.0, 0.0, -0.3), width=4 * REDUCED_WIDTH, height=3 * REDUCED_WIDTH)
    photo = torch.full((camera.height, camera.width, 3), 51, dtype=torch.uint8)
    labels = torch.zeros(camera.height, camera.width, dtype=torch.uint8)
    labels[:, : 2 * REDUCED_WIDTH] = 1
    view = View.in_memory("x", camera, photo=photo, pane_labels=labels)
    ignoring = replace(view, read_ignored=lambda: (torch.arange(camera.height) < 6)[:, None].expand_as(labels))
    found = reduced_photograph(scene, ignoring)
    assert (found.camera.width, found.camera.height) == (REDUCED_WIDTH, 3 * REDUCED_WIDTH // 4)
    assert found.camera.fx == pytest.approx(camera.fx / 4)
    torch.testing.assert_close(found.pixels, torch.full((150, 200, 3), 0.2))
    assert found.labels is not None and (found.labels[:, :100] == 1).all() and (found.labels[:, 100:] == 0).all()
    assert not found.valid[:2].any() and found.valid[2:].all()


def test_views_without_masks_are_evidence_for_mirrors() -> None:
    views = [replace(view, read_pane_labels=None) for view in photographs(scene_with(0.995))]
    assert mirror_labels(scene_with(0.2), views) == (1,)


def test_likeness_is_slope_and_correlation() -> None:
    mirrored = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    found = regress_on_mirrored(mirrored, 0.1 * mirrored)
    assert found.slope == pytest.approx(0.1, abs=1e-4)
    assert found.correlation == pytest.approx(1.0, abs=1e-4)
    assert not found.is_mirror


@pytest.mark.parametrize(
    ("slope", "correlation", "expected"),
    [(0.46, 0.42, True), (0.89, 0.25, True), (0.50, 0.27, False), (0.30, 0.40, False), (0.89, 0.10, False)],
)
def test_a_slope_near_one_needs_less_correlation(slope: float, correlation: float, expected: bool) -> None:
    assert MirrorRegression(slope, correlation).is_mirror == expected


def test_local_means_ignore_what_lies_outside_the_region() -> None:
    image = torch.full((20, 30, 3), 0.3)
    region = torch.zeros(20, 30, dtype=torch.bool)
    region[:, :15] = True
    image[:, 15:] = 100.0
    torch.testing.assert_close(subtract_local_mean(image, region)[region], torch.zeros(300, 3), atol=1e-6, rtol=0)


def mean_by_pooling(image: torch.Tensor, region: torch.Tensor) -> torch.Tensor:
    """The definition, which sums every window separately."""
    side = 2 * max(round(MEAN_WINDOW * image.shape[1] / 2), 1) + 1
    inside = region.to(image.dtype)[..., None]
    stacked = torch.cat([image * inside, inside], dim=-1).permute(2, 0, 1)[None]
    sums = torch.nn.functional.avg_pool2d(stacked, side, stride=1, padding=side // 2)[0].permute(1, 2, 0)
    return sums[..., :3] / sums[..., 3:].clamp(min=1e-6)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (31, 48), (90, 7), (20, 200)])
def test_local_means_are_those_of_every_window_by_itself(size: tuple[int, int]) -> None:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(*size, 3, generator=generator)
    region = torch.rand(size, generator=generator) < 0.3
    expected = image - mean_by_pooling(image, region)
    torch.testing.assert_close(subtract_local_mean(image, region), expected, atol=1e-6, rtol=0)


def test_the_work_of_window_sums_does_not_depend_on_the_window() -> None:
    """On photographs of 3000 pixels the window has 450 x 450 pixels: summed one by one, hours for ten views."""

    def work(reach: int) -> int:
        with CountedElements() as counted:
            window_sums(torch.ones(60, 400, 4), reach)
        return counted.elements

    assert work(1) == work(30) == work(350)


class CountedElements(TorchDispatchMode):
    """Counts the elements returned by operations; rejects pooling and convolution, whose work grows with windows."""

    elements = 0

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        assert "pool" not in func.name() and "conv" not in func.name(), "work that grows with the window"
        result = func(*args, **(kwargs or {}))
        self.elements += result.numel() if isinstance(result, torch.Tensor) else 0
        return result
