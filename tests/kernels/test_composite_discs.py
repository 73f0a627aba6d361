"""Blended discs, compared with the twin, with finite differences and with rays."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from glassplat.kernels.composite import BlendedDiscs, composite_discs
from glassplat.kernels.composite.reference import composite_discs as twin
from glassplat.kernels.maths.disc import LOW_PASS
from glassplat.kernels.panes.reference import ray_grid
from glassplat.kernels.project import project_discs
from glassplat.kernels.records import CameraBatch, Discs, ProjectedDiscs, RawGaussians, Rays, TileBins
from glassplat.kernels.tiles import bin_tiles
from glassplat.kernels.trace import build_bvh, shapes_of, trace
from tests.kernels.gaussians_and_cameras import draw
from tests.kernels.threads import assert_threads_change_no_bit

NEAR = 0.3
INPUTS = ("means2d", "maps", "opacities", "depths", "channels", "absgrad")


class Case(NamedTuple):
    """All arguments of a call; `inputs` are its differentiable tensors."""

    discs: Discs
    channels: Tensor
    bins: TileBins
    absgrad: Tensor
    low_pass: float = LOW_PASS

    def __call__(self, function: Callable[..., BlendedDiscs]) -> BlendedDiscs:
        return function(
            self.discs, self.channels, self.bins, near=NEAR, low_pass=self.low_pass, absgrad=self.absgrad
        )  # fmt: skip

    def inputs(self) -> list[Tensor]:
        return [*self.discs[:4], self.channels, self.absgrad]

    def with_inputs(self, *tensors: Tensor) -> Case:
        discs = Discs(*tensors[:4], self.discs.outlines)
        return self._replace(discs=discs, channels=tensors[4], absgrad=tensors[5])


def scattered(
    count: int, *, size: float = -1.5, opacity: float = 0.0, dtype: torch.dtype = torch.float64
) -> RawGaussians:
    """Discs in front of a camera at the origin, at all angles, some across the near plane or outside the image."""
    tensors = (
        torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64) + draw(count, 3, seed=1) * torch.tensor([1.2, 1.0, 1.0]),
        draw(count, 4, seed=2),
        size + 0.7 * draw(count, 2, seed=3),
        opacity + 2 * draw(count, seed=4),
        0.6 * draw(count, 1, 3, seed=5),
    )
    return RawGaussians(*(tensor.to(dtype) for tensor in tensors))


def cameras_of(count: int, size: tuple[int, int], dtype: torch.dtype = torch.float64) -> CameraBatch:
    """Cameras near the origin, of which every second one is mirrored."""
    poses = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    poses[:, :3, 3] = 0.1 * draw(count, 3, seed=6)
    poses[1::2, 0, 0] = -1
    focal = 1.2 * max(size)
    intrinsics = torch.tensor([[focal, 1.1 * focal, size[0] / 2 + 0.3, size[1] / 2]], dtype=torch.float64)
    return CameraBatch(poses.to(dtype), intrinsics.repeat(count, 1).to(dtype), *size)


def case_of(raw: RawGaussians, cameras: CameraBatch, *, channels: int = 3, low_pass: float = LOW_PASS) -> Case:
    found = project_discs(raw, cameras, sh_degree=0, near=NEAR)
    values = draw(*found.depths.shape, channels, seed=8).to(found.depths.dtype)
    return Case(
        discs_of(found), values, bin_tiles(found.outlines, cameras.width, cameras.height),
        torch.zeros_like(found.means2d), low_pass,
    )  # fmt: skip


def discs_of(found: ProjectedDiscs) -> Discs:
    return Discs(found.means2d, found.maps, found.opacities, found.depths, found.outlines)


def with_gradients(case: Case, function: Callable[..., BlendedDiscs]) -> dict[str, Tensor]:
    """Outputs and, for random cotangents, the gradients of all inputs."""
    inputs = [tensor.detach().clone().requires_grad_() for tensor in case.inputs()]
    outputs = case.with_inputs(*inputs)(function)
    cotangents = [draw(*o.shape, seed=20 + i).to(o) for i, o in enumerate(outputs)]
    # Differences of inverse depths are small and are scaled up so that an error in them shows among the rest.
    cotangents[4] = 100 * cotangents[4]
    # The twin does not touch inputs that reach no pixel; the added zero gives them a gradient of zero.
    total = sum((o * c).sum() for o, c in zip(outputs, cotangents, strict=True)) + 0 * sum(i.sum() for i in inputs)
    gradients = torch.autograd.grad(total, inputs)
    named = outputs._asdict() | {f"v_{name}": g for name, g in zip(INPUTS, gradients, strict=True)}
    return {name: tensor.detach() for name, tensor in named.items()}


def assert_close(found: dict[str, Tensor], expected: dict[str, Tensor], tolerance: float) -> None:
    """Checks the relative norm of the difference per tensor."""
    for name, want in expected.items():
        got, want = found[name].double().flatten(), want.double().flatten()
        assert float((got - want).norm()) <= tolerance * max(float(want.norm()), 1e-3), name


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 3e-4), (torch.float64, 1e-10)])
@pytest.mark.parametrize("low_pass", [LOW_PASS, 0.0])
@pytest.mark.parametrize(
    ("cameras", "count", "channels", "size"),
    [(1, 0, 3, (20, 20)), (1, 1, 1, (16, 16)), (1, 40, 1, (37, 29)), (2, 80, 6, (40, 33)), (1, 60, 9, (17, 50))],
)
def test_kernel_matches_the_reference(
    dtype: torch.dtype,
    tolerance: float,
    low_pass: float,
    cameras: int,
    count: int,
    channels: int,
    size: tuple[int, int],
) -> None:
    case = case_of(
        scattered(count, dtype=dtype), cameras_of(cameras, size, dtype), channels=channels, low_pass=low_pass
    )
    found = with_gradients(case, composite_discs)
    assert count < 40 or float(found["distortion"].max()) > 1e-4
    assert_close(found, with_gradients(case, twin), tolerance)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 2e-3), (torch.float64, 1e-10)])
def test_opaque_splats_end_a_pixel_where_the_reference_ends_it(dtype: torch.dtype, tolerance: float) -> None:
    case = case_of(scattered(300, size=-0.3, opacity=4.0, dtype=dtype), cameras_of(1, (24, 20), dtype))
    found = with_gradients(case, composite_discs)
    assert float(found["alpha"].min()) > 0.99
    assert int(found["v_channels"].abs().sum(-1).count_nonzero()) < 200
    assert_close(found, with_gradients(case, twin), tolerance)


@pytest.mark.parametrize("low_pass", [LOW_PASS, 0.0])
def test_gradients_match_finite_differences(low_pass: float) -> None:
    case = case_of(scattered(9, size=-0.8), cameras_of(1, (13, 11)), channels=2, low_pass=low_pass)
    cotangents = [draw(*output.shape, seed=30 + i) for i, output in enumerate(case(composite_discs))]

    def weighted(*tensors: Tensor) -> Tensor:
        outputs = case.with_inputs(*tensors, case.absgrad)(composite_discs)
        return torch.stack([(o * c).sum() for o, c in zip(outputs, cotangents, strict=True)])

    inputs = [tensor.detach().clone().requires_grad_() for tensor in case.inputs()[:5]]
    assert torch.autograd.gradcheck(weighted, inputs, eps=1e-7, atol=1e-5, rtol=1e-5)


def test_from_raw_discs_to_images_gradients_match_finite_differences() -> None:
    raw, cameras = scattered(6, size=-0.8), cameras_of(1, (13, 11))
    weights = [draw(1, 11, 13, *rest, seed=40 + i) for i, rest in enumerate(((6,), (), (), (), ()))]

    def of_leaves(*leaves: Tensor) -> Tensor:
        found = project_discs(RawGaussians(*leaves), cameras, sh_degree=0, near=NEAR)
        bins = bin_tiles(found.outlines, cameras.width, cameras.height)
        channels = torch.cat([found.colors, found.normals], dim=-1)
        outputs = composite_discs(discs_of(found), channels, bins, near=NEAR)
        return torch.stack([(o * w).sum() for o, w in zip(outputs, weights, strict=True)])

    leaves = [tensor.clone().requires_grad_() for tensor in raw]
    assert torch.autograd.gradcheck(of_leaves, leaves, eps=1e-7, atol=1e-5, rtol=1e-4)


def layered(count: int) -> RawGaussians:
    """Discs that roughly face the camera, each wholly behind the previous one, so that their order is unambiguous."""
    raw = scattered(count, size=-1.6, opacity=1.0)
    raw.means[:, 2] = torch.linspace(2, 9, count)
    raw.means[:, :2] *= raw.means[:, 2:] / 4
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64) + 0.08 * draw(count, 4, seed=9)
    return raw._replace(quats=quats, log_scales=raw.log_scales.clamp(max=-2.2))


def test_primary_rays_match_rasterisation_without_low_pass_filter() -> None:
    raw, cameras = layered(60), cameras_of(1, (48, 40))
    found = project_discs(raw, cameras, sh_degree=0, near=NEAR)
    bins = bin_tiles(found.outlines, 48, 40)
    blended = composite_discs(discs_of(found), found.colors, bins, near=NEAR, low_pass=0.0)
    pose = cameras.cam_from_world[0]
    directions = (ray_grid(cameras.intrinsics[0], 48, 40) @ pose[:3, :3]).reshape(-1, 3).contiguous()
    origins = (-pose[:3, :3].T @ pose[:3, 3]).expand_as(directions).contiguous()
    bvh = build_bvh(shapes_of(raw), flat=True)
    traced = trace(raw, Rays(origins, directions), bvh, sh_degree=0, near=NEAR)
    assert float((traced.alphas > 0).double().mean()) > 0.2
    torch.testing.assert_close(blended.image.reshape(-1, 3), traced.colors, rtol=0, atol=1e-10)
    torch.testing.assert_close(blended.alpha.flatten(), traced.alphas, rtol=0, atol=1e-10)
    along = traced.depths / directions.norm(dim=-1)
    torch.testing.assert_close(blended.depth.flatten(), along, rtol=0, atol=1e-10)


def one_disc(**changes: list[float]) -> RawGaussians:
    """A large, half opaque disc that faces a camera at the origin from two units away."""
    values = {
        "means": [0.0, 0.0, 2.0], "quats": [1.0, 0.0, 0.0, 0.0], "log_scales": [3.0, 3.0], "logit_opacities": 0.0,
        "sh": [[0.1, 0.2, 0.3]],
    } | changes  # fmt: skip
    return RawGaussians(*(torch.tensor([v], dtype=torch.float64) for v in values.values()))


def stacked(*discs: RawGaussians) -> RawGaussians:
    return RawGaussians(*(torch.cat(tensors) for tensors in zip(*discs, strict=True)))


def facing_camera(size: tuple[int, int] = (16, 16)) -> CameraBatch:
    intrinsics = torch.tensor([[40.0, 40.0, size[0] / 2, size[1] / 2]], dtype=torch.float64)
    return CameraBatch(torch.eye(4, dtype=torch.float64)[None], intrinsics, *size)


def test_depths_and_distortion_of_two_layers() -> None:
    raw = stacked(one_disc(logit_opacities=math.log(1.5)), one_disc(means=[0.0, 0.0, 4.0]))
    found = case_of(raw, facing_camera())(composite_discs)
    near, far = 0.6, 0.4 * 0.5
    for image, expected in (
        (found.depth, near * 2 + far * 4), (found.median, 2.0), (found.distortion, near * far * 0.25**2)
    ):  # fmt: skip
        torch.testing.assert_close(image, torch.full_like(image, expected), rtol=2e-2, atol=0)


def test_the_median_depth_is_behind_what_lets_half_of_the_light_through() -> None:
    raw = stacked(one_disc(logit_opacities=-1.0), one_disc(means=[0.0, 0.0, 4.0]))
    median = case_of(raw, facing_camera())(composite_discs).median
    torch.testing.assert_close(median, torch.full_like(median, 4.0))


def test_one_surface_has_no_distortion_however_it_is_tilted() -> None:
    tilt = [math.cos(0.4), math.sin(0.4), 0.0, 0.0]
    raw = stacked(one_disc(quats=tilt), one_disc(quats=tilt), one_disc(quats=tilt))
    found = case_of(raw, facing_camera())(composite_discs)
    assert float(found.distortion.max()) < 1e-15 and float(found.depth.std()) > 0.1


def test_a_disc_seen_edge_on_is_drawn_by_the_low_pass_filter() -> None:
    tilt = [math.cos(math.pi / 4 - 2e-3), math.sin(math.pi / 4 - 2e-3), 0.0, 0.0]
    case = case_of(one_disc(quats=tilt, log_scales=[-3.0, -3.0], logit_opacities=9.0), facing_camera())
    found = case(composite_discs)
    assert int((found.alpha > 0.05).sum()) == 12
    assert int((case._replace(low_pass=0.0)(composite_discs).alpha > 0.1).sum()) < 4
    torch.testing.assert_close(
        found.median[found.median > 0], torch.full((int((found.median > 0).sum()),), 2.0, dtype=torch.float64)
    )


def test_gaussians_before_the_near_plane_are_invisible() -> None:
    tilt = [math.cos(0.75), math.sin(0.75), 0.0, 0.0]
    case = case_of(one_disc(quats=tilt, log_scales=[2.0, 2.0], logit_opacities=9.0), facing_camera((40, 64)))
    assert not case.discs.outlines.conics.any()
    found = with_gradients(case, composite_discs)
    assert float(found["median"][found["median"] > 0].min()) > NEAR
    assert bool((found["alpha"] == 0).any()) and bool((found["alpha"] > 0.9).any())
    assert_close(found, with_gradients(case, twin), 1e-10)


def test_gradients_of_pixels_add_up_without_their_signs() -> None:
    case = case_of(scattered(12, size=-0.8), cameras_of(1, (11, 9)), channels=1)
    means2d, absgrad = case.discs.means2d.detach().requires_grad_(), case.absgrad.requires_grad_()
    outputs = case._replace(discs=case.discs._replace(means2d=means2d), absgrad=absgrad)(composite_discs)
    values = outputs.image.sum(-1) + outputs.depth
    total = torch.zeros_like(means2d)
    for pixel in values.flatten():
        total += torch.autograd.grad(pixel, means2d, retain_graph=True)[0].abs()
    (found,) = torch.autograd.grad(values.sum(), absgrad, retain_graph=True)
    torch.testing.assert_close(found, total)


def test_only_active_tiles_are_drawn() -> None:
    size = (60, 40)
    raw, cameras = scattered(50, dtype=torch.float32), cameras_of(2, size, torch.float32)
    full = case_of(raw, cameras)
    tiles = torch.zeros(2, 3, 4, dtype=torch.bool)
    tiles[0, 1, 2] = tiles[1, 0, 0] = tiles[1, 2, 3] = True
    few = full._replace(bins=bin_tiles(full.discs.outlines, *size, tiles))
    seen = tiles.repeat_interleave(16, 1).repeat_interleave(16, 2)[:, :40, :60]
    for everywhere, there in zip(full(composite_discs), few(composite_discs), strict=True):
        assert torch.equal(there[seen], everywhere[seen])
        assert not there[~seen].any()
    assert_close(with_gradients(few, composite_discs), with_gradients(few, twin), 1e-3)

    # Bins of every tile with a shorter list of active ones must give the same result.
    shortened = full._replace(bins=full.bins._replace(active=few.bins.active))
    expected = with_gradients(few, composite_discs)
    assert all(torch.equal(t, expected[name]) for name, t in with_gradients(shortened, composite_discs).items())


def test_the_number_of_threads_changes_no_bit() -> None:
    case = case_of(scattered(400, dtype=torch.float32), cameras_of(2, (100, 70), torch.float32))
    assert_threads_change_no_bit(lambda: with_gradients(case, composite_discs).values())


@pytest.mark.parametrize("field", ["means2d", "maps", "opacities", "depths"])
@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
def test_a_disc_with_broken_geometry_is_not_drawn(field: str, value: float) -> None:
    case = case_of(scattered(30, dtype=torch.float32), cameras_of(1, (40, 40), torch.float32))
    victim = int((case.discs.opacities[0] > 0.5).nonzero()[0])
    broken = getattr(case.discs, field).clone()
    broken[0, victim] = value
    found = with_gradients(case._replace(discs=case.discs._replace(**{field: broken})), composite_discs)
    outlines = case.discs.outlines
    culled = outlines.radii.clone()
    culled[0, victim] = 0
    without = outlines._replace(radii=culled)
    expected = case._replace(bins=bin_tiles(without, 40, 40))(composite_discs)
    torch.testing.assert_close(found["image"], expected.image)
    assert all(bool(found[f"v_{name}"].isfinite().all()) for name in INPUTS)
    assert not found["v_channels"][0, victim].any()


def test_a_nan_channel_affects_only_its_tiles() -> None:
    case = case_of(scattered(60, size=-3.0, dtype=torch.float32), cameras_of(1, (80, 80), torch.float32))
    clean = case(composite_discs).image
    victim = int((case.discs.opacities[0] > 0.5).nonzero()[0])
    poisoned = case.channels.clone()
    poisoned[0, victim] = torch.nan
    image = case._replace(channels=poisoned)(composite_discs).image
    reached = torch.zeros(5, 5, dtype=torch.bool)
    pairs = torch.repeat_interleave(torch.arange(25), case.bins.tile_offsets.diff())
    reached.view(-1)[pairs[case.bins.pair_splats == victim]] = True
    outside = ~reached.repeat_interleave(16, 0).repeat_interleave(16, 1)
    assert torch.equal(image[0][outside], clean[0][outside])
    assert image.isnan().any()


def test_wrong_inputs_are_named() -> None:
    case = case_of(scattered(5), cameras_of(1, (20, 20)))
    with pytest.raises(ValueError, match=r"D in 1\.\.32"):
        composite_discs(case.discs, torch.zeros(1, 5, 33, dtype=torch.float64), case.bins, near=NEAR)
    with pytest.raises(ValueError, match=r"absgrad has shape \(1, 4, 2\); expected \(1, 5, 2\)"):
        composite_discs(case.discs, case.channels, case.bins, near=NEAR, absgrad=case.absgrad[:, 1:])
    with pytest.raises(TypeError, match=r"channels is torch\.float32 and means2d is torch\.float64"):
        composite_discs(case.discs, case.channels.float(), case.bins, near=NEAR)
    with pytest.raises(TypeError, match="channels is on meta, but only the CPU"):
        composite_discs(case.discs, case.channels.to("meta"), case.bins, near=NEAR)
    with pytest.raises(ValueError, match="near is -1"):
        composite_discs(case.discs, case.channels, case.bins, near=-1)
    other = case_of(scattered(4), cameras_of(1, (20, 20)))
    with pytest.raises(ValueError, match="bin the outlines of these very discs"):
        composite_discs(case.discs, case.channels, other.bins, near=NEAR)
