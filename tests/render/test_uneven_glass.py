"""What uneven glass mirrors: rays that its slopes turn."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from glassplat.kernels.records import Projected
from glassplat.render.planar import Planar
from glassplat.render.seen_panes import SeenPanes, nearest_hits, panes_in_camera, seen_panes
from glassplat.render.uneven_glass import in_uneven_glass
from glassplat.scene.camera import Camera
from glassplat.scene.plane import Planes
from glassplat.scene.uneven import slopes_at
from tests.render.tiny_scene import camera_at, joined, pane, random_gaussians, showcase

CAMERA = camera_at(0.0, 0.0, -0.2)


def uneven(planes: Planes, slope: float = 0.01) -> Planes:
    """About as steep as `slope`."""
    generator = torch.Generator().manual_seed(4)
    heights = torch.randn(len(planes), 6, 7, generator=generator, dtype=torch.float64)
    return replace(planes, heights=slope * heights * planes.half_sizes.min() / 4)


def seen_by(planes: Planes, camera: Camera = CAMERA) -> SeenPanes:
    seen = seen_panes(planes, camera, nearest_hits(panes_in_camera(planes, camera), camera))
    assert seen is not None
    return seen


def turned_normal(planes: Planes, place: Tensor) -> Tensor:
    """[3] of the first pane at a place [3] in the world."""
    assert planes.level_heights is not None
    axes = torch.stack(planes.axes(), dim=1)[0]
    where = (axes @ (place - planes.centers[0])) / planes.half_sizes[0]
    slopes = slopes_at(planes.level_heights, torch.zeros(1, dtype=torch.int64), where[None])[0] / planes.half_sizes[0]
    return torch.nn.functional.normalize(planes.normals[0] - slopes @ axes, dim=0)


def bent_ray(planes: Planes, camera: Camera, pixel: Tensor) -> tuple[Tensor, Tensor]:
    """Where a pixel's ray meets the first pane, and where it goes on to, in the world."""
    focal, middle = camera.intrinsics.split(2)
    towards = torch.cat([(pixel - middle) / focal, torch.ones(1, dtype=torch.float64)]) @ camera.cam_from_world[:3, :3]
    normal, eye = planes.normals[0], camera.center
    place = eye + ((planes.centers[0] - eye) @ normal) / (towards @ normal) * towards
    turned = turned_normal(planes, place)
    return place, torch.nn.functional.normalize(towards - 2 * (towards @ turned) * turned, dim=0)


def mirror_image(planes: Planes, camera: Camera, place: Tensor) -> Projected:
    """Of a place [3] in the world, as an even pane shows it."""
    normal = planes.normals[0]
    virtual = place - 2 * ((place - planes.centers[0]) @ normal) * normal
    x, y, z = camera.cam_from_world[:3, :3] @ virtual + camera.cam_from_world[:3, 3]
    on_screen = torch.stack([x / z * camera.fx + camera.cx, y / z * camera.fy + camera.cy])
    one = torch.ones(1, 1, dtype=torch.float64)
    means2d, radii = on_screen[None, None], torch.ones(1, 1, 2, dtype=torch.float64)
    return Projected(means2d, torch.ones(1, 1, 3), z[None, None], one, torch.ones(1, 1, 3), radii)


@pytest.mark.parametrize("distance", [0.3, 2.0, 1e6])
@pytest.mark.parametrize(("x", "y"), [(7.5, 20.0), (20.0, 14.0), (33.0, 5.5)])
def test_things_are_seen_where_the_exactly_mirrored_ray_meets_them(distance: float, x: float, y: float) -> None:
    planes, pixel = uneven(pane(2.0, half=1.5)), torch.tensor([x, y], dtype=torch.float64)
    place, onward = bent_ray(planes, CAMERA, pixel)
    even = mirror_image(planes, CAMERA, place + distance * onward)
    shown = in_uneven_glass(even, seen_by(planes), CAMERA).means2d[0, 0]
    moved = float((even.means2d[0, 0] - pixel).norm())
    assert moved > 0.005
    assert float((shown - pixel).norm()) < 0.05 * moved


def test_the_error_falls_with_the_square_of_the_slopes() -> None:
    errors = []
    for slope in (0.01, 0.001):
        planes, pixel = uneven(pane(2.0, half=1.5), slope), torch.tensor([30.0, 9.0], dtype=torch.float64)
        place, onward = bent_ray(planes, CAMERA, pixel)
        even = mirror_image(planes, CAMERA, place + 3 * onward)
        errors.append(float((in_uneven_glass(even, seen_by(planes), CAMERA).means2d[0, 0] - pixel).norm()))
    assert errors[1] < 0.02 * errors[0]


def test_glass_without_heights_is_left_alone_and_that_of_height_0_moves_nothing() -> None:
    planes = pane(2.0)
    even = mirror_image(planes, CAMERA, torch.tensor([0.1, 0.2, -2.0], dtype=torch.float64))
    assert in_uneven_glass(even, seen_by(planes), CAMERA) is even
    flat = planes.that_may_wave(5)
    assert torch.equal(in_uneven_glass(even, seen_by(flat), CAMERA).means2d, even.means2d)


def test_even_glass_renders_the_same_bits_with_heights_and_without() -> None:
    plain, flat = (Planar()(showcase(planes), CAMERA) for planes in (pane(2.0), pane(2.0).that_may_wave(6)))
    assert torch.equal(plain.rgb, flat.rgb)


def test_waves_change_the_reflection_and_nothing_else() -> None:
    plain, wavy = (Planar()(showcase(planes), CAMERA) for planes in (pane(2.0), uneven(pane(2.0), 0.1)))
    assert float((plain.layers["reflection"] - wavy.layers["reflection"]).abs().max()) > 0.01
    for name in ("transmission", "strength", "mask", "depth", "without_panes"):
        assert torch.equal(plain.layers[name], wavy.layers[name]), name


def test_a_pane_that_is_waved_leaves_the_others_alone() -> None:
    """Two panes side by side, of which the second is waved."""
    left, right = pane(2.0, half=0.5), pane(2.0, half=0.5, label=2)
    left = replace(left, centers=left.centers - torch.tensor([0.55, 0, 0]))
    right = replace(right, centers=right.centers + torch.tensor([0.55, 0, 0]))
    even = joined(left, right)
    tilt = uneven(even, 0.1)
    assert tilt.heights is not None
    heights = tilt.heights.clone()
    heights[0] = 0
    plain, wavy = (Planar()(showcase(p), CAMERA).layers["reflection"] for p in (even, replace(even, heights=heights)))
    changed = (plain - wavy).abs().amax(dim=-1) > 1e-9
    index = nearest_hits(panes_in_camera(even, CAMERA), CAMERA).pane
    assert bool(changed[index == 1].any()) and not bool(changed[index == 0].any())


def test_the_photographer_is_mirrored_by_the_same_glass() -> None:
    body = random_gaussians(10, (0.0, 0.1, -0.5), seed=5)
    body = replace(body, channels={}, sh=body.sh[:, :1], active_sh_degree=0)
    only = replace(showcase(), photographer=body, up=(0.0, -1.0, 0.0))
    only = replace(only, primary=only.primary.with_tensors({"logit_opacities": torch.full((30,), -20.0).double()}))
    renderer = Planar(photographer="present")
    glass = pane(2.0), uneven(pane(2.0), 0.1)
    even, wavy = (renderer(replace(only, planes=p), CAMERA).layers["reflection"] for p in glass)
    assert float((even - wavy).abs().max()) > 0.01


def test_gradients_match_finite_differences_through_the_whole_renderer() -> None:
    scene, renderer = showcase(uneven(pane(2.0, half=2.0))), Planar()
    weights = torch.randn(28, 40, 3, generator=torch.Generator().manual_seed(9), dtype=torch.float64)

    def objective(values: Tensor) -> Tensor:
        return (renderer(scene.with_parameters({"planes.heights": values}), CAMERA).rgb * weights).sum()

    values = scene.parameters()["planes.heights"].clone().requires_grad_()
    (gradient,) = torch.autograd.grad(objective(values), values)
    steepest = gradient.abs().flatten().argsort(descending=True)[:4]
    for index in steepest.tolist():
        step = torch.zeros_like(values)
        step.view(-1)[index] = 1e-7
        with torch.no_grad():
            numerical = (objective(values + step) - objective(values - step)) / 2e-7
        torch.testing.assert_close(gradient.flatten()[index], numerical, rtol=1e-3, atol=1e-4)


def test_gradients_have_the_same_bits_for_any_number_of_threads() -> None:
    generator, seen = torch.Generator().manual_seed(2), seen_by(uneven(pane(2.0, half=1.5)))
    count = 20_000
    means2d = 40 * torch.rand(1, count, 2, generator=generator, dtype=torch.float64)
    rest = (torch.ones(1, count, 3), 3 + torch.rand(1, count, generator=generator, dtype=torch.float64))
    mirrored = Projected(means2d, *rest, torch.ones(1, count), torch.ones(1, count, 3), torch.ones(1, count, 2))
    gradients, before = [], torch.get_num_threads()
    for threads in (1, 3):
        torch.set_num_threads(threads)
        try:
            heights = seen.planes.tensors()["heights"].clone().requires_grad_()
            bent = in_uneven_glass(mirrored, replace(seen, planes=replace(seen.planes, heights=heights)), CAMERA)
            (gradient,) = torch.autograd.grad(bent.means2d.square().sum(), heights)
        finally:
            torch.set_num_threads(before)
        gradients.append(gradient)
    assert torch.equal(*gradients)


def test_nothing_mirrored() -> None:
    planes = uneven(pane(2.0))
    nothing = mirror_image(planes, CAMERA, torch.tensor([0.1, 0.2, -2.0], dtype=torch.float64))
    nothing = nothing._replace(radii=torch.zeros_like(nothing.radii))
    assert torch.equal(in_uneven_glass(nothing, seen_by(planes), CAMERA).means2d, nothing.means2d)
