"""The CUDA kernels of discs against their PyTorch twins: on a GPU, or on tiny inputs in Numba's simulator.

`test_simulator.py` runs this file once more with the simulator on.
"""

from __future__ import annotations

import pytest
import torch

from glassplat.kernels.backend.devices import SIMULATED
from glassplat.kernels.composite import composite_discs
from glassplat.kernels.composite.reference import composite_discs as composite_twin
from glassplat.kernels.project import project_discs
from glassplat.kernels.project.reference import project_discs as project_twin
from glassplat.kernels.records import CameraBatch
from tests.kernels.cuda.agreement import DTYPES, check_gradients, close, many, on_a_device_or_skipped, on_device
from tests.kernels.gaussians_and_cameras import random_cameras
from tests.kernels.test_composite_discs import NEAR, Case, cameras_of, case_of, scattered, with_gradients
from tests.kernels.test_project_discs import SMOOTH, random_discs

on_a_device_or_skipped()

pytestmark = [pytest.mark.filterwarnings("ignore::RuntimeWarning")]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    ("count", "cameras", "degree"), [(many(24, 3000), 2, 3), (many(5, 700), 1, 1), (1, 1, 0), (0, 1, 3)]
)
def test_project_discs(count: int, cameras: int, degree: int, dtype: torch.dtype) -> None:
    discs, batch = random_discs(count, dtype=dtype), random_cameras(cameras, clip=cameras > 1, dtype=dtype)
    own, own_batch = on_device(discs), on_device(batch)
    found = project_discs(own, own_batch, sh_degree=degree, near=NEAR)
    expected = project_twin(discs, batch, sh_degree=degree, near=NEAR)
    for name, value in expected._asdict().items():
        close(getattr(found, name), value, 10)
    leaves = [*discs, batch.cam_from_world]
    check_gradients(found[:SMOOTH], expected[:SMOOTH], [*own, own_batch.cam_from_world], leaves)


def test_project_discs_without_colours_culls_what_is_not_finite() -> None:
    discs, batch = random_discs(6, coefficients=0), random_cameras(1)
    poison = discs._replace(means=discs.means.detach().index_fill(0, torch.tensor([2]), torch.nan))
    windows = torch.tensor([[10.0, 5.0, 30.0, 30.0]], dtype=torch.float64)
    batch = CameraBatch(batch.cam_from_world, batch.intrinsics, batch.width, batch.height, None, windows)
    found = project_discs(on_device(poison), on_device(batch), sh_degree=0, near=NEAR)
    for name, value in project_twin(poison, batch, sh_degree=0, near=NEAR)._asdict().items():
        close(getattr(found, name), value)


SIZE = (20, 5) if SIMULATED else (120, 70)


def check_blending(case: Case, factor: float = 1.0) -> None:
    own = Case(*(on_device(value) for value in case))
    found, expected = with_gradients(own, composite_discs), with_gradients(case, composite_twin)
    for name, value in expected.items():
        close(found[name], value, 10 * factor)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    ("count", "cameras", "channels", "low_pass"),
    [(many(14, 300), 2, 6, 0.7), (many(8, 100), 1, 3, 0.0), (1, 1, 1, 0.7), (0, 1, 3, 0.7)],
)
def test_composite_discs(count: int, cameras: int, channels: int, low_pass: float, dtype: torch.dtype) -> None:
    raw = scattered(count, size=-0.9, dtype=dtype)
    check_blending(case_of(raw, cameras_of(cameras, SIZE, dtype), channels=channels, low_pass=low_pass))


def test_many_opaque_discs_span_buckets() -> None:
    case = case_of(scattered(many(80, 900), size=-0.3, opacity=1.0), cameras_of(1, (17, 3)))
    assert int(case.bins.tile_offsets.diff().max()) > 32
    check_blending(case)


def test_discs_blend_to_the_same_bits_every_time() -> None:
    case = case_of(scattered(many(30, 500), size=-0.9, dtype=torch.float32), cameras_of(1, (16, 4), torch.float32))
    own = Case(*(on_device(value) for value in case))
    first, second = with_gradients(own, composite_discs), with_gradients(own, composite_discs)
    assert all(torch.equal(first[name], second[name]) for name in first)
