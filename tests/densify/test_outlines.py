"""The ellipsoid that outlines describe is found, and Gaussians on it face as it does."""

from __future__ import annotations

import math

import pytest
import torch

from glassplat.data.view import View
from glassplat.densify.outlines import (
    Ellipsoid,
    Mirrored,
    Outlines,
    fitted_ellipsoid,
    mirrored_by,
    on_surface,
    outlines_of,
    refined_ellipsoid,
    reflection_error,
    surface_gaussians,
)
from glassplat.kernels.environment import surface_channels
from glassplat.render.planar import Planar
from glassplat.render.traced import traced_colors
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene
from tests.render.tiny_scene import random_gaussians

TRUE = Ellipsoid(
    torch.tensor([0.2, -0.1, 3.0]),
    torch.tensor([0.5, 0.4, 0.3]).log(),
    torch.nn.functional.normalize(torch.tensor([1.0, 0.2, -0.1, 0.3]), dim=0),
)


def cameras() -> list[Camera]:
    """Twelve all around."""
    eyes = [(3 * math.cos(a) + 0.2, math.sin(2 * a), 3 * math.sin(a) + 3) for a in torch.arange(12) * math.pi / 6]
    return [Camera.look_at(eye, (0.2, -0.1, 3.0), up=(0, -1, 0), width=48, height=36) for eye in eyes]


def true_outlines() -> Outlines:
    """What all cameras see of the true ellipsoid."""
    directions = torch.cat([camera.ray_directions().reshape(-1, 3) for camera in cameras()])
    origins = torch.cat([camera.center.expand(48 * 36, 3) for camera in cameras()])
    unlabelled = Outlines(origins, directions, torch.zeros(len(origins)))
    return Outlines(origins, directions, (TRUE.misses(unlabelled) < 1).float())


def test_an_ellipsoid_is_found_from_its_outlines() -> None:
    outlines = true_outlines()
    assert 0.02 < float(outlines.inside.mean()) < 0.3
    means = TRUE.center + 0.2 * torch.randn(60, 3, generator=torch.Generator().manual_seed(1))
    found = fitted_ellipsoid(outlines, means, torch.Generator().manual_seed(2))
    torch.testing.assert_close(found.center, TRUE.center, atol=0.02, rtol=0)
    assert found.overlap(outlines) > 0.95
    # The same body, whatever its axes are called.
    places, _ = on_surface(TRUE, 200)
    radii = found.in_units(places - found.center).norm(dim=1)
    torch.testing.assert_close(radii, torch.ones(200), atol=0.06, rtol=0)


def test_outlines_of_something_else_do_not_agree() -> None:
    outlines = true_outlines()
    striped = Outlines(outlines.origins, outlines.directions, (outlines.directions[:, 0] * 40).floor() % 2)
    found = fitted_ellipsoid(striped, TRUE.center + torch.randn(60, 3), torch.Generator().manual_seed(2))
    assert found.overlap(striped) < 0.7


def test_places_lie_on_the_surface_and_normals_across_it() -> None:
    places, normals = on_surface(TRUE, 500)
    torch.testing.assert_close(TRUE.in_units(places - TRUE.center).norm(dim=1), torch.ones(500))
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(500))
    # Towards a neighbour there is nearly no way along the normal.
    steps = torch.cdist(places, places) + 9 * torch.eye(500)
    towards = torch.nn.functional.normalize(places[steps.argmin(dim=1)] - places, dim=1)
    assert float((towards * normals).sum(1).abs().max()) < 0.2
    assert float(((places - TRUE.center) * normals).sum(1).min()) > 0


def test_gaussians_on_it_are_flat_and_face_outwards() -> None:
    like = random_gaussians(20, (0.2, -0.1, 3.0), seed=3)
    like = like.with_tensors({name: tensor.float() for name, tensor in like.tensors().items()})
    made = surface_gaussians(like, TRUE, 300)
    places, normals = on_surface(TRUE, 300)
    assert torch.equal(made.means, places)
    rows = torch.cdist(places, like.means).argmin(dim=1)
    assert torch.equal(made.sh, like.sh[rows])
    assert torch.equal(made.channels["log_intensity"], like.channels["log_intensity"][rows])
    eye = torch.tensor([0.2, -0.1, 0.0])
    seen = surface_channels(
        torch.zeros(300, 3), torch.ones(300, 2), made.quats, made.log_scales, made.means, torch.zeros(300), eye
    )[:, 3:6]
    facing = ((eye - places) * normals).sum(1)
    expected = normals * facing.sign()[:, None]
    torch.testing.assert_close(seen[facing.abs() > 0.05], expected[facing.abs() > 0.05], atol=1e-4, rtol=0)


def block_scene() -> tuple[Scene, torch.Tensor, list[View]]:
    """An opaque chosen Gaussian, one before it, and one behind it."""
    means = torch.tensor([[0.0, 0.0, 3.0], [0.3, 0.0, 2.0], [0.0, 0.0, 6.0]])
    scene = Scene(
        Gaussians(
            means=means,
            quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(3, 1),
            log_scales=torch.log(torch.tensor([[0.3] * 3, [0.1] * 3, [3.0] * 3])),
            logit_opacities=torch.full((3,), 8.0),
            sh=torch.zeros(3, 1, 3),
        ),
        extent=1.0,
    )
    camera = Camera.look_at((0, 0, 0), (0, 0, 1), up=(0, -1, 0), width=60, height=60)
    photo = torch.zeros(60, 60, 3, dtype=torch.uint8)
    return scene, torch.tensor([True, False, False]), [View.in_memory("0.png", camera, photo=photo)]


def test_what_stands_before_a_mirror_says_nothing_of_its_outline() -> None:
    scene, chosen, views = block_scene()
    outlines = outlines_of(scene, views, chosen)
    inside = outlines.inside > 0.5
    assert 50 < int(inside.sum()) < 1500
    towards = outlines.directions / outlines.directions[:, 2:]
    before = (towards[:, 0] - 0.15).square() + towards[:, 1].square() < 0.03**2
    assert not bool(before.any())
    assert bool((~inside).any())
    middle = towards[:, :2].norm(dim=1)
    assert float(middle[inside].max()) < float(middle[~inside].max())


def test_without_a_view_of_it_there_are_no_outlines() -> None:
    scene, chosen, views = block_scene()
    assert len(outlines_of(scene, views, ~chosen & False).inside) == 0


def surrounded() -> Scene:
    """Large coloured Gaussians all around the true ellipsoid, which reflections show."""
    generator = torch.Generator().manual_seed(4)
    places = torch.nn.functional.normalize(torch.randn(80, 3, generator=generator), dim=1)
    around = Gaussians(
        means=TRUE.center + 8 * places,
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(80, 1),
        log_scales=torch.full((80, 3), 0.4),
        logit_opacities=torch.full((80,), 3.0),
        sh=2 * torch.randn(80, 1, 3, generator=generator),
    )
    return Scene(Gaussians.empty(1, ("logit_strength",)), extent=3.0, surroundings=around)


def what_is_mirrored(scene: Scene) -> Mirrored:
    """What the true ellipsoid shows of it."""
    outlines = true_outlines()
    inside = outlines.inside > 0.5
    origins, directions = outlines.origins[inside], outlines.directions[inside]
    shown = Mirrored(origins, directions, torch.zeros_like(origins))
    # Of rays at the very rim nothing is asked.
    rows = (TRUE.misses(Outlines(origins, directions, origins[:, 0])) < 0.98).nonzero().squeeze(1)
    colors = torch.stack([reflected_color(scene, shown, row) for row in rows[::30]])
    return Mirrored(origins[rows[::30]], directions[rows[::30]], colors)


def reflected_color(scene: Scene, shown: Mirrored, row: torch.Tensor) -> torch.Tensor:
    """[3] by the law of reflection, from the depth that a ray finds step by step."""
    origin, direction = shown.origins[row], shown.directions[row]
    low, high = torch.tensor(1.0), (TRUE.center - origin).norm()
    for length in torch.linspace(1, float(high) + 0.5, 80):
        if float(TRUE.in_units((origin + length * direction - TRUE.center)[None]).norm()) < 1:
            high = length
            break
        low = length
    for _ in range(18):
        middle = (low + high) / 2
        within = float(TRUE.in_units((origin + middle * direction - TRUE.center)[None]).norm()) < 1
        low, high = (low, middle) if within else (middle, high)
    place = (origin + high * direction).requires_grad_()
    TRUE.in_units((place - TRUE.center)[None]).square().sum().backward()
    assert place.grad is not None
    normal = torch.nn.functional.normalize(place.grad, dim=0)
    onwards = direction - 2 * (direction @ normal) * normal
    return traced_colors(scene, place.detach()[None], onwards[None], 0.01, (0.0, 0.0, 0.0))[0]


def test_what_an_ellipsoid_mirrors_tells_its_shape(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("glassplat.densify.outlines.REFINE_STEPS", 120)
    monkeypatch.setattr("glassplat.densify.outlines.RAYS", 100)
    scene = surrounded()
    mirrored = what_is_mirrored(scene)
    every = torch.arange(len(mirrored.colors))
    assert float(reflection_error(TRUE, scene, mirrored, every)) < 2e-3
    start = Ellipsoid(TRUE.center + torch.tensor([0.02, 0.03, -0.02]), TRUE.log_radii + 0.1, TRUE.quat)
    before = float(reflection_error(start, scene, mirrored, every))
    found = refined_ellipsoid(start, true_outlines(), mirrored, scene, torch.Generator().manual_seed(5))
    assert before > 0.03
    assert float(reflection_error(found, scene, mirrored, every)) < 0.7 * before
    assert float((found.center - TRUE.center).norm()) < float((start.center - TRUE.center).norm())


def test_views_show_mirrors_without_what_panes_before_them_reflect() -> None:
    scene, chosen, views = block_scene()
    mirrored = mirrored_by(scene, views, chosen, Planar())
    assert 50 < len(mirrored.colors) < 1500
    assert float(mirrored.colors.abs().max()) == 0
    torch.testing.assert_close(mirrored.directions.norm(dim=1), torch.ones(len(mirrored.colors)))
