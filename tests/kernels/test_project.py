"""The projection kernel agrees with its twin, with finite differences, and with itself on any number of threads."""

from __future__ import annotations

import gc
import math
import weakref

import pytest
import torch
from torch import Tensor

from glassplat.kernels.project import GradientSum, project
from glassplat.kernels.project.reference import project as reference_project
from glassplat.kernels.records import CameraBatch, Projected, RawGaussians
from tests.kernels.gaussians_and_cameras import (
    HEIGHT,
    WIDTH,
    draw,
    needle_before_camera,
    poisoned,
    random_cameras,
    random_gaussians,
)
from tests.kernels.threads import assert_threads_change_no_bit

NEAR = 0.2
TOLERANCE = {torch.float32: 5e-6, torch.float64: 1e-12}


def gradients(projected: Projected, gaussians: RawGaussians, cameras: CameraBatch, seed: int = 0) -> dict[str, Tensor]:
    """Gradients of all inputs for random cotangents of all outputs."""
    cotangents = [draw(*output.shape, seed=seed + i).to(output.dtype) for i, output in enumerate(projected[:5])]
    # Without coefficients the twin's colours are constant.
    pairs = [(output, g) for output, g in zip(projected[:5], cotangents, strict=True) if output.requires_grad]
    inputs = gaussians._asdict() | {"cam_from_world": cameras.cam_from_world}
    outputs, weights = zip(*pairs, strict=True)
    found = torch.autograd.grad(outputs, list(inputs.values()), weights, allow_unused=True, materialize_grads=True)
    return dict(zip(inputs, found, strict=True))


def assert_parallel(ours: Tensor, theirs: Tensor, tolerance: float, name: str) -> None:
    """Checks the relative norm of the difference, and that there is no systematic scale between the two."""
    assert ours.shape == theirs.shape, name
    norm = theirs.norm()
    assert (ours - theirs).norm() <= tolerance * norm, name
    if norm > 0:
        assert (ours * theirs).sum() / norm**2 == pytest.approx(1, abs=tolerance), name


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("coefficients", "degree"), [(16, 3), (9, 2), (16, 1), (1, 0), (0, 0)])
def test_values_and_gradients_agree_with_the_reference(dtype: torch.dtype, coefficients: int, degree: int) -> None:
    gaussians = random_gaussians(700, coefficients=coefficients, dtype=dtype)
    cameras = random_cameras(3, clip=True, dtype=dtype)
    ours = project(gaussians, cameras, sh_degree=degree, near=NEAR)
    theirs = reference_project(gaussians, cameras, sh_degree=degree, near=NEAR)
    assert 0.1 < (ours.radii > 0).double().mean() < 0.8
    assert torch.equal(ours.radii > 0, theirs.radii > 0)
    for name, a, b in zip(Projected._fields, ours, theirs, strict=True):
        assert_parallel(a.detach(), b.detach(), TOLERANCE[dtype], name)
    mine, reference = gradients(ours, gaussians, cameras), gradients(theirs, gaussians, cameras)
    for name, gradient in mine.items():
        assert_parallel(gradient, reference[name], 10 * TOLERANCE[dtype], name)


@pytest.mark.parametrize("count", [0, 1])
@pytest.mark.parametrize("num_cameras", [0, 1, 2])
def test_few_gaussians_to_project(count: int, num_cameras: int) -> None:
    gaussians, cameras = random_gaussians(count), random_cameras(num_cameras)
    ours = project(gaussians, cameras, sh_degree=3, near=NEAR)
    theirs = reference_project(gaussians, cameras, sh_degree=3, near=NEAR)
    assert ours.colors.shape == (num_cameras, count, 3)
    torch.testing.assert_close(ours, theirs)
    torch.testing.assert_close(gradients(ours, gaussians, cameras), gradients(theirs, gaussians, cameras))


def test_gradients_agree_with_finite_differences() -> None:
    gaussians, cameras = random_gaussians(9), random_cameras(2)

    def outputs(*tensors: Tensor) -> tuple[Tensor, ...]:
        batch = cameras._replace(cam_from_world=tensors[5])
        return tuple(project(RawGaussians(*tensors[:5]), batch, sh_degree=3, near=NEAR)[:5])

    visible = project(gaussians, cameras, sh_degree=3, near=NEAR).radii[..., 0] > 0
    assert visible.sum() > 6
    assert torch.autograd.gradcheck(outputs, (*gaussians, cameras.cam_from_world), eps=1e-6, atol=1e-6, rtol=1e-5)


def test_the_ellipse_follows_the_tangent_only_near_the_image() -> None:
    """Far off screen the Jacobian keeps its value at the border, and its gradient is zero there."""
    means = torch.tensor([[6.0, -3.0, 2.0], [0.5, 0.1, 2.0]], dtype=torch.float64, requires_grad=True)
    scales = torch.full((2, 3), math.log(2.5), dtype=torch.float64, requires_grad=True)
    gaussians = random_gaussians(2)._replace(means=means, log_scales=scales)
    cameras = random_cameras(1)
    ours = project(gaussians, cameras, sh_degree=0, near=NEAR)
    theirs = reference_project(gaussians, cameras, sh_degree=0, near=NEAR)
    assert (ours.radii > 0).all()
    assert (ours.means2d[0, 0, 0] > 1.3 * WIDTH) and (ours.means2d[0, 0, 1] < -0.3 * HEIGHT)
    torch.testing.assert_close(gradients(ours, gaussians, cameras), gradients(theirs, gaussians, cameras))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_gaussian_with_nan_culls_only_itself(dtype: torch.dtype) -> None:
    clean = random_gaussians(60, dtype=dtype)
    cameras = random_cameras(2, dtype=dtype)
    expected = project(clean, cameras, sh_degree=3, near=NEAR)
    seen = (expected.radii[..., 0] > 0).all(dim=0).nonzero()[:, 0]
    gaussians, victims = poisoned(clean, seen)
    ours = project(gaussians, cameras, sh_degree=3, near=NEAR)
    found = gradients(ours, gaussians, cameras)
    healthy = torch.ones(60, dtype=torch.bool)
    healthy[victims] = False
    for a, b in zip(ours, expected, strict=True):
        assert not a[:, victims].any()
        assert torch.equal(a[:, healthy], b[:, healthy])
    assert all(gradient.isfinite().all() for gradient in found.values())
    assert all(not found[name][victims].any() for name in RawGaussians._fields)
    theirs = reference_project(gaussians, cameras, sh_degree=3, near=NEAR)
    assert torch.equal(theirs.radii > 0, ours.radii > 0)
    for name, gradient in gradients(theirs, gaussians, cameras).items():
        assert_parallel(found[name], gradient, 10 * TOLERANCE[dtype], name)


def test_a_zero_quaternion_has_no_direction_and_is_culled() -> None:
    gaussians = random_gaussians(40)
    gaussians.quats.data[3] = 0
    ours = project(gaussians, random_cameras(1), sh_degree=3, near=NEAR)
    assert not ours.radii[:, 3].any()
    assert ours.radii.any()


def test_culled_splats_pass_no_gradient_whatever_comes_in() -> None:
    gaussians, cameras = random_gaussians(50), random_cameras(1)
    ours = project(gaussians, cameras, sh_degree=3, near=100.0)
    assert not any(output.any() for output in ours)
    cotangents = [torch.full_like(output, math.nan) for output in ours[:5]]
    inputs = [*gaussians, cameras.cam_from_world]
    assert all(not gradient.any() for gradient in torch.autograd.grad(ours[:5], inputs, cotangents))


def test_harmonics_above_the_active_degree_are_ignored() -> None:
    gaussians, cameras = random_gaussians(80), random_cameras(1)
    cut = gaussians._replace(sh=gaussians.sh[:, :4].detach().requires_grad_())
    ours, short = (project(g, cameras, sh_degree=1, near=NEAR) for g in (gaussians, cut))
    assert torch.equal(ours.colors, short.colors)
    found = gradients(ours, gaussians, cameras)["sh"]
    assert torch.equal(found[:, :4], gradients(short, cut, cameras)["sh"])
    assert not found[:, 4:].any()


def test_the_clip_plane_cuts_by_centre() -> None:
    gaussians, cameras = random_gaussians(200), random_cameras(2)
    planes = torch.tensor([[0.0, 0.0, 1.0, -4.0], [1.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    whole = project(gaussians, cameras, sh_degree=0, near=NEAR).radii[..., 0] > 0
    cut = project(gaussians, cameras._replace(clip_planes=planes), sh_degree=0, near=NEAR).radii[..., 0] > 0
    kept = gaussians.means @ planes[:, :3].T + planes[:, 3] > 0
    assert torch.equal(cut, whole & kept.T)
    assert (cut != whole).any(dim=1).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_window_keeps_what_reaches_into_it(dtype: torch.dtype) -> None:
    gaussians, cameras = random_gaussians(400, dtype=dtype), random_cameras(3, dtype=dtype)
    windows = torch.tensor([[5.0, 8.0, 12.0, 30.0], [0.0, 0.0, 44.0, 36.0], [20.0, 3.0, 21.0, 4.0]], dtype=dtype)
    whole = project(gaussians, cameras, sh_degree=1, near=NEAR)
    found = project(gaussians, cameras._replace(windows=windows), sh_degree=1, near=NEAR)
    low, high = whole.means2d - whole.radii, whole.means2d + whole.radii
    reaches = ((high > windows[:, None, :2]) & (low < windows[:, None, 2:])).all(dim=-1) & (whole.radii[..., 0] > 0)
    assert 0 < int(reaches[2].sum()) < int(reaches[0].sum()) < int(reaches[1].sum())
    for tensor, full in zip(found, whole, strict=True):
        chosen = reaches.reshape(reaches.shape + (1,) * (full.dim() - 2))
        assert torch.equal(tensor, torch.where(chosen, full, 0))
    theirs = reference_project(gaussians, cameras._replace(windows=windows), sh_degree=1, near=NEAR)
    assert torch.equal(found.radii > 0, theirs.radii > 0)


def test_coverage_sinks_to_the_bound_at_the_edge_of_the_extents() -> None:
    """At the ellipse's rightmost and topmost points, opacity exp(-q / 2) is 1/255."""
    ours = project(random_gaussians(300), random_cameras(1), sh_degree=0, near=NEAR)
    visible = ours.radii[..., 0] > 0
    (xx, xy, yy), opacity, radii = ours.conics[visible].unbind(-1), ours.opacities[visible], ours.radii[visible]
    for dx, dy in ((radii[:, 0], -xy / yy * radii[:, 0]), (-xy / xx * radii[:, 1], radii[:, 1])):
        alpha = opacity * torch.exp(-0.5 * (xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy))
        torch.testing.assert_close(alpha, torch.full_like(alpha, 1 / 255))


def test_needles_stay_positive_definite_in_single_precision() -> None:
    gaussians = random_gaussians(400, dtype=torch.float32)
    gaussians.log_scales.data[:, 0], gaussians.log_scales.data[:, 1:] = 3.0, -9.0
    conics = project(gaussians, random_cameras(1, dtype=torch.float32), sh_degree=0, near=NEAR).conics
    xx, xy, yy = conics.double()[conics[..., 0] > 0].unbind(-1)
    assert len(xx) > 100
    assert (xx > 0).all()
    assert (yy > 0).all()
    assert (xx * yy - xy * xy > -1e-5 * xx * yy).all()


@pytest.mark.parametrize("angle", [0.3, 0.785, 1.2])
def test_gradients_of_needles_do_not_cancel_in_single_precision(angle: float) -> None:
    """A splat of 300 px by 0.5 px, whose image rotates strongly with its angle."""
    found = {}
    for dtype in (torch.float32, torch.float64):
        needle, camera = needle_before_camera(angle, dtype)
        conics = project(needle, camera, sh_degree=0, near=NEAR).conics
        cotangent = torch.tensor([[[700.0, 650.0, 690.0]]], dtype=dtype)
        inputs = [needle.means, needle.quats, needle.log_scales, camera.cam_from_world]
        found[dtype] = torch.autograd.grad(conics, inputs, cotangent)
    for ours, exact in zip(found[torch.float32], found[torch.float64], strict=True):
        assert_parallel(ours.double(), exact, 1e-3, "gradient")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_same_bits_on_any_number_of_threads(dtype: torch.dtype) -> None:
    gaussians, cameras = random_gaussians(3000, dtype=dtype), random_cameras(3, dtype=dtype)

    def everything() -> list[Tensor]:
        found = project(gaussians, cameras, sh_degree=3, near=NEAR)
        return [*found, *gradients(found, gaussians, cameras).values()]

    assert_threads_change_no_bit(everything)


def test_inputs_need_not_be_contiguous() -> None:
    gaussians, cameras = random_gaussians(50), random_cameras(2)
    strided = RawGaussians(*(torch.stack([t, t], dim=-1)[..., 0].detach().requires_grad_() for t in gaussians))
    ours, theirs = (project(g, cameras, sh_degree=3, near=NEAR) for g in (strided, gaussians))
    assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))
    one_cotangent = torch.autograd.grad(ours.colors.sum(), list(strided))
    assert all(gradient.isfinite().all() for gradient in one_cotangent)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"quats": torch.zeros(5, 3)}, ValueError, r"quats has shape \(5, 3\); expected \(5, 4\)"),
        ({"sh": torch.zeros(5, 9, 2)}, ValueError, r"sh has shape \(5, 9, 2\); expected \(5, 9, 3\)"),
        ({"sh": torch.zeros(5, 4, 3)}, ValueError, "sh_degree is 2, .* sh holds 4 coefficients"),
        ({"log_scales": torch.zeros(5, 3, dtype=torch.float64)}, TypeError, "log_scales is torch.float64"),
        ({"means": torch.zeros(5, 3, dtype=torch.int32)}, TypeError, "expected float32 or float64"),
        (
            {"means": torch.zeros(5, 3, device="meta")},
            TypeError,
            "means is on meta, but only the CPU and NVIDIA GPUs have kernels",
        ),
    ],
)
def test_bad_gaussians_are_refused(change: dict[str, Tensor], error: type[Exception], message: str) -> None:
    good = random_gaussians(5, coefficients=9, dtype=torch.float32)
    with pytest.raises(error, match=message):
        project(good._replace(**change), random_cameras(1, dtype=torch.float32), sh_degree=2, near=NEAR)


def test_bad_cameras_and_options_are_refused() -> None:
    gaussians, cameras = random_gaussians(5), random_cameras(2)
    with pytest.raises(ValueError, match=r"clip_planes has shape \(1, 4\); expected \(2, 4\)"):
        project(gaussians, cameras._replace(clip_planes=cameras.intrinsics[:1]), sh_degree=0, near=NEAR)
    with pytest.raises(ValueError, match="sh_degree is 4"):
        project(gaussians, cameras, sh_degree=4, near=NEAR)
    with pytest.raises(ValueError, match=r"near is -1\.0"):
        project(gaussians, cameras, sh_degree=0, near=-1.0)


@pytest.mark.parametrize("asked", [(0, 1, 2), (0, 2), (1, 2), (0, 1), (0,), (1,), (2,)])
def test_gradients_of_several_projections_add_up_where_they_are_made(asked: tuple[int, ...]) -> None:
    gaussians, batches = random_gaussians(700), [random_cameras(n, clip=n > 1) for n in (1, 2, 1)]

    def slopes(gradient_sum: GradientSum | None) -> tuple[Tensor, ...]:
        found = [project(gaussians, batch, sh_degree=3, near=NEAR, gradient_sum=gradient_sum) for batch in batches]
        loss = sum((1 + i) * field.sin().sum() for i in asked for field in found[i][:5])
        inputs = [*gaussians, *(batch.cam_from_world for batch in batches)]
        once = torch.autograd.grad(loss, inputs, retain_graph=True, allow_unused=True, materialize_grads=True)
        # State left by one pass must not enter the next one, nor must a pass that asks only for poses.
        torch.autograd.grad(loss, batches[asked[-1]].cam_from_world, retain_graph=True)
        again = torch.autograd.grad(loss, inputs, allow_unused=True, materialize_grads=True)
        assert all(torch.equal(a, b) for a, b in zip(once, again, strict=True))
        return once

    for name, together, apart in zip(
        [*RawGaussians._fields, "pose 0", "pose 1", "pose 2"], slopes(GradientSum()), slopes(None), strict=True
    ):
        assert_parallel(together, apart, 1e-12, name)


def test_a_sum_of_gradients_frees_its_graph() -> None:
    gaussians, gradient_sum = random_gaussians(5), GradientSum()
    first = project(gaussians, random_cameras(1), sh_degree=3, near=NEAR, gradient_sum=gradient_sum)
    second = project(gaussians, random_cameras(1), sh_degree=3, near=NEAR, gradient_sum=gradient_sum)
    torch.autograd.grad(first.means2d.sum() + second.means2d.sum(), gaussians.means)
    assert gradient_sum.found == []
    node = weakref.ref(first.means2d.grad_fn)
    gc.disable()
    try:
        del first, second, gradient_sum
        assert node() is None
    finally:
        gc.enable()
