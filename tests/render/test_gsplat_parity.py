"""`rasterization`, forward and backward, compared with the PyTorch functions that gsplat tests its own kernels with."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest
import torch
from torch import Tensor

import glassplat
from tests.render.test_rasterization import CAMERAS, COUNT, FAR, HEIGHT, INTRINSICS, NAMES, NEAR, WIDTH, draws


@pytest.fixture(scope="module")
def theirs() -> ModuleType:
    """gsplat's functions without their package, whose import would search for a CUDA toolkit."""
    package = importlib.util.find_spec("gsplat")
    if package is None or package.origin is None:
        pytest.skip("gsplat is not installed")
    path = Path(package.origin).parent / "cuda" / "_torch_impl.py"
    spec = importlib.util.spec_from_file_location("gsplat_torch", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def rendered(theirs: ModuleType, of: dict[str, Tensor], degree: int | None) -> tuple[Tensor, Tensor]:
    """Images and coverage: gsplat's projection and harmonics, blended as both programs document it."""
    covars, _ = theirs._quat_scale_to_covar_preci(of["quats"], of["scales"], True, False, triu=False)
    radii, means2d, depths, conics, _ = theirs._fully_fused_projection(
        of["means"], covars, of["viewmats"], INTRINSICS, WIDTH, HEIGHT, 0.3, NEAR, FAR
    )
    colors = of["colors"].expand(CAMERAS, *of["colors"].shape)
    if degree is not None:
        eyes = torch.inverse(of["viewmats"])[:, :3, 3]
        colors = (theirs._spherical_harmonics(degree, of["means"] - eyes[:, None], colors) + 0.5).clamp(min=0)
    rows, columns = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    images, coverages = [], []
    for camera in range(CAMERAS):
        image, light = torch.zeros(HEIGHT, WIDTH, 3).double(), torch.ones(HEIGHT, WIDTH).double()
        is_open = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
        for index in depths[camera].argsort().tolist():
            if not bool((radii[camera, index] > 0).all()):
                continue
            x, y = (columns - means2d[camera, index, 0], rows - means2d[camera, index, 1])
            xx, xy, yy = conics[camera, index]
            alpha = (of["opacities"][index] * torch.exp(-(xx * x * x + yy * y * y) / 2 - xy * x * y)).clamp(max=0.99)
            is_open = is_open & ~((alpha >= 1 / 255) & (light * (1 - alpha) <= 1e-4))
            alpha = torch.where(is_open & (alpha >= 1 / 255), alpha, 0)
            image = image + (light * alpha)[..., None] * colors[camera, index]
            light = light * (1 - alpha)
        images.append(image + light[..., None] * of["backgrounds"][camera])
        coverages.append(1 - light[..., None])
    return torch.stack(images), torch.stack(coverages)


def along_motions(gradient: Tensor, viewmats: Tensor) -> Tensor:
    """[C, 6] derivatives along rotations and translations of each camera; only these keep a view matrix valid."""
    motions = torch.zeros(6, 4, 4, dtype=torch.float64)
    for axis in range(3):
        motions[axis, (axis + 1) % 3, (axis + 2) % 3], motions[axis, (axis + 2) % 3, (axis + 1) % 3] = -1, 1
        motions[3 + axis, axis, 3] = 1
    return torch.einsum("cij,mik,ckj->cm", gradient.double(), motions, viewmats.detach().double())


@pytest.mark.parametrize("degree", [None, 0, 1, 2, 3])
def test_images_and_gradients_are_those_of_gsplat(theirs: ModuleType, degree: int | None) -> None:
    shape = (COUNT, 3) if degree is None else (COUNT, (degree + 1) ** 2, 3)
    for seed in (5, 6):
        exact = {name: value.requires_grad_() for name, value in draws(seed, shape, 3).items()}
        ours = {name: value.detach().float().requires_grad_() for name, value in exact.items()}
        image, alpha, _ = glassplat.rasterization(
            **ours, Ks=INTRINSICS.float(), width=WIDTH, height=HEIGHT, sh_degree=degree, near_plane=NEAR, far_plane=FAR
        )
        expected, coverage = rendered(theirs, exact, degree)
        torch.testing.assert_close(image.double(), expected, atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(alpha.double(), coverage, atol=1e-4, rtol=1e-4)
        weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        found = torch.autograd.grad((image * weights.float()).sum() + alpha.square().sum(), list(ours.values()))
        wanted = torch.autograd.grad((expected * weights).sum() + coverage.square().sum(), list(exact.values()))
        for name, one, other in zip(exact, found, wanted, strict=True):
            if name == "viewmats":
                one, other = (along_motions(gradient, exact[name]) for gradient in (one, other))
            assert float((one.double() - other).norm() / other.norm()) < 1e-4, name
    assert set(exact) == set(NAMES)
