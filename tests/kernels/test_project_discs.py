"""The projection of discs agrees with its twin, with finite differences, and with itself on any number of threads."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from glassplat.kernels.project import project_discs
from glassplat.kernels.project.reference import project_discs as twin
from glassplat.kernels.records import CameraBatch, ProjectedDiscs, RawGaussians
from tests.kernels.gaussians_and_cameras import HEIGHT, WIDTH, draw, poisoned, random_cameras, random_gaussians
from tests.kernels.threads import assert_threads_change_no_bit

NEAR = 0.2
SMOOTH = 6
TOLERANCE = {torch.float32: 2e-5, torch.float64: 1e-11}


def random_discs(count: int, *, coefficients: int = 16, dtype: torch.dtype = torch.float64) -> RawGaussians:
    """Discs around (0, 0, 4), some of them behind the cameras, off screen, too faint or across the near plane."""
    solid = random_gaussians(count, coefficients=coefficients, dtype=dtype)
    log_scales = solid.log_scales.detach()[:, :2].contiguous()
    log_scales[::20] += 2.5
    return solid._replace(log_scales=log_scales.requires_grad_())


def gradients(projected: ProjectedDiscs, gaussians: RawGaussians, cameras: CameraBatch) -> dict[str, Tensor]:
    """Gradients of all inputs for random cotangents of all differentiable outputs."""
    # Without coefficients the twin's colours are constant.
    smooth = [(i, output) for i, output in enumerate(projected[:SMOOTH]) if output.requires_grad]
    outputs = [output for _, output in smooth]
    cotangents = [draw(*output.shape, seed=i).to(output.dtype) for i, output in smooth]
    inputs = gaussians._asdict() | {"cam_from_world": cameras.cam_from_world}
    found = torch.autograd.grad(outputs, list(inputs.values()), cotangents, allow_unused=True, materialize_grads=True)
    return dict(zip(inputs, found, strict=True))


def assert_near(ours: Tensor, theirs: Tensor, tolerance: float, name: str) -> None:
    assert ours.shape == theirs.shape, name
    assert (ours - theirs).norm() <= tolerance * theirs.norm(), name


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("coefficients", "degree"), [(16, 3), (1, 0), (0, 0)])
def test_values_and_gradients_agree_with_the_reference(dtype: torch.dtype, coefficients: int, degree: int) -> None:
    discs, cameras = (
        random_discs(700, coefficients=coefficients, dtype=dtype),
        random_cameras(3, clip=True, dtype=dtype),
    )
    ours, theirs = (f(discs, cameras, sh_degree=degree, near=NEAR) for f in (project_discs, twin))
    assert torch.equal(ours.radii > 0, theirs.radii > 0)
    assert 300 < int((ours.radii[..., 0] > 0).sum()) < 1500
    assert bool(((ours.outline_conics == 0).all(-1) & (ours.radii[..., 0] > 0)).any())
    for name, want in theirs._asdict().items():
        assert_near(getattr(ours, name), want, TOLERANCE[dtype], name)
    expected = gradients(theirs, discs, cameras)
    for name, found in gradients(ours, discs, cameras).items():
        if coefficients or name != "sh":
            assert_near(found, expected[name], 10 * TOLERANCE[dtype], name)


@pytest.mark.parametrize(("count", "num_cameras"), [(0, 1), (1, 1), (5, 0), (9, 2)])
def test_any_number_of_discs_and_cameras(count: int, num_cameras: int) -> None:
    discs, cameras = random_discs(count), random_cameras(num_cameras)
    ours, theirs = (f(discs, cameras, sh_degree=3, near=NEAR) for f in (project_discs, twin))
    assert ours.maps.shape == (num_cameras, count, 6)
    torch.testing.assert_close(ours, theirs)
    torch.testing.assert_close(gradients(ours, discs, cameras), gradients(theirs, discs, cameras))


def test_gradients_agree_with_finite_differences() -> None:
    discs, cameras = random_discs(9), random_cameras(2)

    def outputs(*tensors: Tensor) -> tuple[Tensor, ...]:
        batch = cameras._replace(cam_from_world=tensors[5])
        return tuple(project_discs(RawGaussians(*tensors[:5]), batch, sh_degree=3, near=NEAR)[:SMOOTH])

    assert int((project_discs(discs, cameras, sh_degree=3, near=NEAR).radii[..., 0] > 0).sum()) > 6
    assert torch.autograd.gradcheck(outputs, (*discs, cameras.cam_from_world), eps=1e-6, atol=1e-5, rtol=1e-4)


def test_the_map_gives_the_intersection_of_ray_and_disc() -> None:
    """Compared with the intersection solved in world space, for rays through pixels around each disc's centre."""
    discs, cameras = random_discs(200), random_cameras(1)
    found = project_discs(discs, cameras, sh_degree=0, near=NEAR)
    pose, (fx, fy, cx, cy) = cameras.cam_from_world[0], cameras.intrinsics[0]
    shift = torch.tensor([0.3, -0.2], dtype=torch.float64)
    for n in (found.radii[0, :, 0] > 0).nonzero()[:, 0].tolist():
        pixel = found.means2d[0, n] + shift
        ray = torch.stack([(pixel[0] - cx) / fx, (pixel[1] - cy) / fy, torch.ones_like(fx)])
        map_of = found.maps[0, n].reshape(3, 2)
        u, v, e = map_of[0] @ shift, map_of[1] @ shift, 1 + map_of[2] @ shift
        rotation, scales = rotation_of(discs.quats[n]), discs.log_scales[n].exp()
        place = discs.means[n] + (u * scales[0] * rotation[:, 0] + v * scales[1] * rotation[:, 1]) / e
        in_camera = pose[:3, :3] @ place + pose[:3, 3]
        torch.testing.assert_close(in_camera, ray * found.depths[0, n] / e)
        torch.testing.assert_close(found.normals[0, n].abs(), rotation[:, 2].abs())


def rotation_of(quat: Tensor) -> Tensor:
    from glassplat.scene.camera import rotation_from_quat

    return rotation_from_quat(quat[None])[0]


def test_normals_face_the_camera() -> None:
    discs, cameras = random_discs(300), random_cameras(2)
    found = project_discs(discs, cameras, sh_degree=0, near=NEAR)
    linear, offset = cameras.cam_from_world[:, :3, :3], cameras.cam_from_world[:, :3, 3]
    centers = -(linear.mT @ offset[..., None])[..., 0]
    towards = ((centers[:, None] - discs.means) * found.normals).sum(-1)
    assert bool((towards[found.radii[..., 0] > 0] > 0).all())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_disc_with_nan_culls_only_itself(dtype: torch.dtype) -> None:
    clean, cameras = random_discs(60, dtype=dtype), random_cameras(2, dtype=dtype)
    expected = project_discs(clean, cameras, sh_degree=3, near=NEAR)
    seen = (expected.radii[..., 0] > 0).all(dim=0).nonzero()[:, 0]
    discs, victims = poisoned(clean, seen)
    ours = project_discs(discs, cameras, sh_degree=3, near=NEAR)
    found = gradients(ours, discs, cameras)
    healthy = torch.ones(60, dtype=torch.bool)
    healthy[victims] = False
    for a, b in zip(ours, expected, strict=True):
        assert not a[:, victims].any()
        assert torch.equal(a[:, healthy], b[:, healthy])
    assert all(gradient.isfinite().all() for gradient in found.values())
    assert all(not found[name][victims].any() for name in RawGaussians._fields)
    theirs = twin(discs, cameras, sh_degree=3, near=NEAR)
    assert torch.equal(theirs.radii > 0, ours.radii > 0)


def one_disc(**changes: list[float]) -> RawGaussians:
    """A disc that faces a camera at the origin from two units away."""
    values = {
        "means": [0.0, 0.0, 2.0], "quats": [1.0, 0.0, 0.0, 0.0], "log_scales": [-2.0, -1.0], "logit_opacities": 1.0,
        "sh": [[0.1, 0.2, 0.3]],
    } | changes  # fmt: skip
    return RawGaussians(*(torch.tensor([v], dtype=torch.float64, requires_grad=True) for v in values.values()))


def front_camera() -> CameraBatch:
    intrinsics = torch.tensor([[40.0, 40.0, WIDTH / 2, HEIGHT / 2]], dtype=torch.float64)
    return CameraBatch(torch.eye(4, dtype=torch.float64)[None], intrinsics, WIDTH, HEIGHT)


HALF = math.sqrt(0.5)
CULLED = {
    "from its edge": {"quats": [HALF, HALF, 0.0, 0.0]},
    "behind the camera": {"means": [0.0, 0.0, -2.0]},
    "before the near plane": {"means": [0.0, 0.0, 0.1]},
    "of no size": {"log_scales": [-800.0, -1.0]},
    "of no orientation": {"quats": [0.0, 0.0, 0.0, 0.0]},
    "too faint": {"logit_opacities": -6.0},
    "outside the image": {"means": [9.0, 0.0, 2.0]},
}


@pytest.mark.parametrize("changes", CULLED.values(), ids=CULLED.keys())
def test_invisible_discs_are_culled(changes: dict[str, list[float]]) -> None:
    assert float(project_discs(one_disc(), front_camera(), sh_degree=0, near=NEAR).radii[0, 0, 0]) > 0
    disc = one_disc(**changes)
    for function in (project_discs, twin):
        found = function(disc, front_camera(), sh_degree=0, near=NEAR)
        assert not any(output.any() for output in found)
        cotangents = [torch.full_like(output, math.nan) for output in found[:SMOOTH]]
        if function is project_discs:
            assert not any(g.any() for g in torch.autograd.grad(found[:SMOOTH], list(disc), cotangents))


def test_a_disc_across_the_near_plane_may_cover_the_whole_image() -> None:
    tilted = one_disc(quats=[0.8, 0.6, 0.0, 0.0], log_scales=[1.0, 1.0])
    found = project_discs(tilted, front_camera(), sh_degree=0, near=NEAR)
    assert not found.outline_conics.any()
    assert found.radii[0, 0].tolist() == [WIDTH, HEIGHT]


def test_a_disc_across_the_near_plane_is_culled_if_its_visible_part_is_outside_the_image() -> None:
    """No culled disc is visible: a camera with a much wider image draws nothing within the window."""
    generator = torch.Generator().manual_seed(4)
    means = torch.randn(400, 3, generator=generator, dtype=torch.float64) * torch.tensor([0.4, 0.4, 0.2]) + 0.3
    raw = RawGaussians(
        means, torch.randn(400, 4, generator=generator, dtype=torch.float64),
        torch.full((400, 2), -2.0, dtype=torch.float64), torch.full((400,), 3.0, dtype=torch.float64),
        torch.zeros(400, 1, 3, dtype=torch.float64),
    )  # fmt: skip
    camera, margin = front_camera(), 400
    shift = torch.tensor([0.0, 0.0, margin, margin], dtype=torch.float64)
    wide = camera._replace(intrinsics=camera.intrinsics + shift, width=WIDTH + 2 * margin, height=HEIGHT + 2 * margin)
    found, everything = (project_discs(raw, c, sh_degree=0, near=0.05) for c in (camera, wide))
    crossing = (everything.outline_conics[0] == 0).all(-1) & (everything.radii[0, :, 0] > 0)
    lost = crossing & (found.radii[0, :, 0] == 0)
    assert int(lost.sum()) > 20 and int((crossing & ~lost).sum()) > 20
    x, y = torch.meshgrid(torch.arange(WIDTH) + 0.5 + margin, torch.arange(HEIGHT) + 0.5 + margin, indexing="xy")
    offset = torch.stack([x, y], -1)[:, :, None] - everything.means2d[0, lost]
    u, v, e = ((offset * everything.maps[0, lost, i : i + 2]).sum(-1) for i in (0, 2, 4))
    e = 1 + e
    shown = (e > 0) & (everything.depths[0, lost] > 0.05 * e) & (u * u + v * v <= 9 * e * e)
    assert not shown.any()


def test_threads_do_not_change_a_bit() -> None:
    discs, cameras = random_discs(2000, dtype=torch.float32), random_cameras(2, dtype=torch.float32)

    def everything() -> list[Tensor]:
        found = project_discs(discs, cameras, sh_degree=3, near=NEAR)
        return [*found, *gradients(found, discs, cameras).values()]

    assert_threads_change_no_bit(everything)


def test_wrong_inputs_are_named() -> None:
    with pytest.raises(ValueError, match=r"log_scales has shape \(3, 3\); expected \(3, 2\)"):
        project_discs(random_gaussians(3), random_cameras(1), sh_degree=0, near=NEAR)
    with pytest.raises(ValueError, match="near is -1"):
        project_discs(random_discs(3), random_cameras(1), sh_degree=0, near=-1)
